//! What can go wrong in a use case, and of which kind it is.

use std::time::Duration;

use crate::domain::{InvalidName, PoseError};
use crate::retrieve::{ExtractError, Overloaded, Refusal, Refused};
use crate::store::StoreError;

/// The kinds that a caller can tell apart; HTTP and gRPC map each to one status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ErrorKind {
    /// The request cannot be read.
    Malformed,
    /// It is not known who asks.
    Unauthorized,
    /// Who asks may not do this.
    Forbidden,
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
    /// The body came too slowly.
    TooSlow,
    /// The caller's deadline has passed.
    DeadlinePassed,
    /// The service is starting or draining.
    Unavailable,
    /// The service failed.
    Internal,
}

impl ErrorKind {
    /// The kind in a word, for programs.
    pub fn word(self) -> &'static str {
        match self {
            Self::Malformed => "malformed",
            Self::Unauthorized => "unauthorized",
            Self::Forbidden => "forbidden",
            Self::NotFound => "not-found",
            Self::Conflict => "conflict",
            Self::TooLarge => "too-large",
            Self::UnsupportedMedia => "media-type",
            Self::Unprocessable => "unprocessable",
            Self::Overloaded => "overloaded",
            Self::Full => "disk-full",
            Self::TooSlow => "too-slow",
            Self::DeadlinePassed => "deadline-passed",
            Self::Unavailable => "unavailable",
            Self::Internal => "internal",
        }
    }

    /// When it is worth trying again, where nothing better is known.
    pub fn retry_after(self) -> Option<Duration> {
        match self {
            Self::Overloaded => Some(Duration::from_secs(1)),
            Self::Unavailable => Some(Duration::from_secs(2)),
            _ => None,
        }
    }
}

/// What went wrong, in a sentence for the caller.
#[derive(Debug, thiserror::Error)]
#[error("{detail}")]
pub struct ServiceError {
    /// Of which kind it is.
    pub kind: ErrorKind,
    /// What happened and what to do next.
    pub detail: String,
    /// When it is worth trying again, where that is known.
    pub retry_after: Option<Duration>,
}

impl ServiceError {
    /// An error of the given kind.
    pub fn new(kind: ErrorKind, detail: impl Into<String>) -> Self {
        Self { kind, detail: detail.into(), retry_after: kind.retry_after() }
    }

    /// The same, with when it is worth trying again.
    pub fn retry_after(self, pause: Duration) -> Self {
        Self { retry_after: Some(pause), ..self }
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

impl From<Refused> for ServiceError {
    fn from(refused: Refused) -> Self {
        let advice = match refused.reason {
            Refusal::DeadlineTooSoon => "allow more time, or try again after Retry-After",
            Refusal::QueueFull | Refusal::WaitTooLong => "try again after Retry-After",
        };
        Self::new(ErrorKind::Overloaded, format!("{refused}; {advice}"))
            .retry_after(refused.retry_after)
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
