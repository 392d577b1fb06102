//! Kinds of errors.

use std::time::Duration;

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
