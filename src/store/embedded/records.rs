//! Records as bytes in sled, and the errors of both.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::super::StoreError;

/// Returns the record with this key, if there is one.
pub(super) fn get<T: DeserializeOwned>(
    tree: &sled::Tree,
    key: &[u8],
) -> Result<Option<T>, StoreError> {
    tree.get(key).map_err(failed)?.map(|value| decode(&value)).transpose()
}

/// Stores a record.
pub(super) fn put<T: Serialize>(
    tree: &sled::Tree,
    key: &[u8],
    value: &T,
) -> Result<(), StoreError> {
    tree.insert(key, encode(value)?).map(drop).map_err(failed)
}

/// Writes a record as JSON.
pub(super) fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, StoreError> {
    serde_json::to_vec(value).map_err(|error| StoreError::Failed(error.to_string()))
}

/// Reads a record.
pub(super) fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, StoreError> {
    serde_json::from_slice(bytes).map_err(|error| {
        StoreError::Damaged(format!("a record cannot be read ({error}); restore a backup"))
    })
}

/// Converts an error of sled.
pub(super) fn failed(error: sled::Error) -> StoreError {
    match error {
        sled::Error::Corruption { .. } => StoreError::Damaged(
            "the files of the record database are inconsistent; restore a backup into another folder"
                .into(),
        ),
        error => StoreError::Failed(error.to_string()),
    }
}

/// Converts the error of a transaction whose closure never aborts it.
pub(super) fn transaction_failed(error: sled::transaction::TransactionError<()>) -> StoreError {
    match error {
        sled::transaction::TransactionError::Abort(()) => {
            StoreError::Failed("a transaction was aborted".into())
        }
        sled::transaction::TransactionError::Storage(error) => failed(error),
    }
}
