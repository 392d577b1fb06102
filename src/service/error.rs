//! What can go wrong in a use case, and of which kind it is.

use crate::domain::{InvalidName, PoseError};
use crate::retrieve::{ExtractError, Overloaded};
use crate::store::StoreError;

/// The kinds that a caller can tell apart; HTTP maps each to one status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ErrorKind {
    /// The request cannot be read.
    Malformed,
    /// There is no such thing.
    NotFound,
    /// It contradicts what is stored.
    Conflict,
    /// The body is larger than the bound.
    TooLarge,
    /// The body is not of a type that is taken.
    UnsupportedMedia,
    /// The request can be read, but a value is out of range or a picture cannot be decoded.
    Unprocessable,
    /// A queue is full.
    Overloaded,
    /// The disk is full.
    Full,
    /// The service is starting or draining.
    Unavailable,
    /// The service failed.
    Internal,
}

/// What went wrong, in a sentence for the caller.
#[derive(Debug, thiserror::Error)]
#[error("{detail}")]
pub struct ServiceError {
    /// Of which kind it is.
    pub kind: ErrorKind,
    /// What happened and what to do next.
    pub detail: String,
}

impl ServiceError {
    /// An error of the given kind.
    pub fn new(kind: ErrorKind, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into() }
    }

    /// The request cannot be read.
    pub fn malformed(detail: impl Into<String>) -> Self {
        Self::new(ErrorKind::Malformed, detail)
    }

    /// There is no such thing.
    pub fn not_found(detail: impl Into<String>) -> Self {
        Self::new(ErrorKind::NotFound, detail)
    }

    /// A value is out of range.
    pub fn unprocessable(detail: impl Into<String>) -> Self {
        Self::new(ErrorKind::Unprocessable, detail)
    }
}

impl From<StoreError> for ServiceError {
    fn from(error: StoreError) -> Self {
        let kind = match &error {
            StoreError::NotFound(_) => ErrorKind::NotFound,
            StoreError::Conflict(_) | StoreError::Superseded(_) => ErrorKind::Conflict,
            StoreError::QueueFull { .. } => ErrorKind::Overloaded,
            StoreError::Full { .. } => ErrorKind::Full,
            StoreError::Failed(_) | StoreError::Damaged(_) => ErrorKind::Internal,
        };
        let advice = match &error {
            StoreError::QueueFull { .. } => "; try again later, or ask with refine=off",
            _ => "",
        };
        Self::new(kind, format!("{error}{advice}"))
    }
}

impl From<Overloaded> for ServiceError {
    fn from(error: Overloaded) -> Self {
        Self::new(ErrorKind::Overloaded, format!("{error}; try again in a moment"))
    }
}

impl From<ExtractError> for ServiceError {
    fn from(error: ExtractError) -> Self {
        let kind = match &error {
            ExtractError::Decode(_) | ExtractError::Preprocess(_) | ExtractError::Pooling(_) => {
                ErrorKind::Unprocessable
            }
            _ => ErrorKind::Internal,
        };
        Self::new(kind, error.to_string())
    }
}

impl From<PoseError> for ServiceError {
    fn from(error: PoseError) -> Self {
        Self::unprocessable(error.to_string())
    }
}

impl From<InvalidName> for ServiceError {
    fn from(error: InvalidName) -> Self {
        Self::malformed(error.to_string())
    }
}
