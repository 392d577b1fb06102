//! The error of every use case: a kind, which HTTP and gRPC map to a status, and a sentence for the caller.
//! Also the conversions from the errors of the layers below.

use std::time::Duration;

use whereabouts_api::ErrorKind;
use whereabouts_core::{InvalidName, PoseError};
use whereabouts_store::StoreError;
use whereabouts_vision::{ExtractError, Overloaded, RejectReason, Rejected};

/// An error of a use case.
#[derive(Debug, thiserror::Error)]
#[error("{detail}")]
pub struct ServiceError {
    /// The kind, which decides the status.
    pub kind: ErrorKind,
    /// What happened and what the caller can do about it.
    pub detail: String,
    /// Pause before a retry is worthwhile, if known (`Retry-After`).
    pub retry_after: Option<Duration>,
}

impl ServiceError {
    /// An error of the given kind, with the default pause of that kind.
    pub fn new(kind: ErrorKind, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into(), retry_after: kind.retry_after() }
    }

    /// Sets the pause before a retry.
    pub fn retry_after(self, pause: Duration) -> Self {
        Self { retry_after: Some(pause), ..self }
    }

    /// The request cannot be parsed.
    pub fn malformed(detail: impl Into<String>) -> Self {
        Self::new(ErrorKind::Malformed, detail)
    }

    /// The requested resource does not exist.
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
            StoreError::Unavailable(_) => ErrorKind::Unavailable,
            StoreError::Failed(_) | StoreError::Damaged(_) => ErrorKind::Internal,
        };
        Self::new(kind, error.to_string())
    }
}

impl From<Overloaded> for ServiceError {
    fn from(error: Overloaded) -> Self {
        Self::new(ErrorKind::Overloaded, format!("{error}; try again in a moment"))
    }
}

impl From<Rejected> for ServiceError {
    fn from(rejected: Rejected) -> Self {
        let advice = match rejected.reason {
            RejectReason::DeadlineTooSoon => "allow more time, or try again after Retry-After",
            RejectReason::QueueFull | RejectReason::WaitTooLong => "try again after Retry-After",
        };
        Self::new(ErrorKind::Overloaded, format!("{rejected}; {advice}"))
            .retry_after(rejected.retry_after)
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
