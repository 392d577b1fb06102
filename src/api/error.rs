//! Error kinds shared by HTTP and gRPC.

use std::time::Duration;

/// The kind of an error. HTTP and gRPC each map a kind to one status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ErrorKind {
    /// The request is malformed.
    Malformed,
    /// The caller is not authenticated.
    Unauthorized,
    /// The caller lacks the permission.
    Forbidden,
    /// The resource does not exist.
    NotFound,
    /// The request conflicts with the stored state.
    Conflict,
    /// The request body exceeds the limit.
    TooLarge,
    /// The media type is not supported.
    UnsupportedMedia,
    /// A value is out of range, or a picture cannot be decoded.
    Unprocessable,
    /// A queue or rate limit is exhausted.
    Overloaded,
    /// The disk is full.
    Full,
    /// The request body arrived too slowly.
    TooSlow,
    /// The caller's deadline has passed.
    DeadlinePassed,
    /// The service is starting or draining.
    Unavailable,
    /// An internal error.
    Internal,
}

impl ErrorKind {
    /// The machine-readable name of the kind.
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

    /// Default for when a retry may succeed; `None` if a retry is not expected to help.
    pub fn retry_after(self) -> Option<Duration> {
        match self {
            Self::Overloaded => Some(Duration::from_secs(1)),
            Self::Unavailable => Some(Duration::from_secs(2)),
            _ => None,
        }
    }
}
