//! Errors as statuses of gRPC. This is the one place that maps an error's kind to a code.

use std::time::Duration;

use axum::response::Response;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use super::proto;
use whereabouts_api::ErrorKind;
use whereabouts_service::ServiceError;

/// Whose errors they are (`google.rpc.ErrorInfo.domain`).
const DOMAIN: &str = "whereabouts";

fn code_of(kind: ErrorKind) -> Code {
    match kind {
        ErrorKind::Malformed | ErrorKind::UnsupportedMedia | ErrorKind::Unprocessable => {
            Code::InvalidArgument
        }
        ErrorKind::Unauthorized => Code::Unauthenticated,
        ErrorKind::Forbidden => Code::PermissionDenied,
        ErrorKind::NotFound => Code::NotFound,
        ErrorKind::Conflict => Code::FailedPrecondition,
        ErrorKind::TooLarge => Code::OutOfRange,
        ErrorKind::Overloaded | ErrorKind::Full => Code::ResourceExhausted,
        ErrorKind::TooSlow | ErrorKind::DeadlinePassed => Code::DeadlineExceeded,
        ErrorKind::Unavailable => Code::Unavailable,
        ErrorKind::Internal => Code::Internal,
    }
}

/// A status with what programs want to know: `ErrorInfo`, whose reason is the kind of the problem, and
/// `RetryInfo` where it is known when to try again.
pub fn status(kind: ErrorKind, detail: &str, retry_after: Option<Duration>) -> Status {
    let mut details = ErrorDetails::new();
    let reason = kind.word().replace('-', "_").to_uppercase();
    details.set_error_info(reason, DOMAIN, []);
    if let Some(pause) = retry_after {
        details.set_retry_info(Some(pause));
    }
    Status::with_error_details(code_of(kind), detail, details)
}

/// An error of the service as a status.
pub(super) fn of(error: ServiceError) -> Status {
    if error.kind == ErrorKind::Internal {
        tracing::error!(detail = error.detail, "a call failed");
    }
    status(error.kind, &error.detail, error.retry_after)
}

/// The same of one thing among several.
pub(super) fn problem(error: ServiceError) -> proto::Problem {
    proto::Problem {
        kind: error.kind.word().to_owned(),
        detail: error.detail,
        // None is too long for a duration of protobuf.
        retry_after: error.retry_after.and_then(|pause| pause.try_into().ok()),
    }
}

/// The status of HTTP that comes nearest to what a response of gRPC says before its body, for counts and
/// logs.
pub fn as_http(response: &Response) -> Option<u16> {
    let code = response.headers().get(Status::GRPC_STATUS)?;
    Some(match Code::from_bytes(code.as_bytes()) {
        Code::Ok => 200,
        Code::Cancelled => 499,
        Code::InvalidArgument => 400,
        Code::OutOfRange => 413,
        Code::FailedPrecondition | Code::AlreadyExists | Code::Aborted => 409,
        Code::Unauthenticated => 401,
        Code::PermissionDenied => 403,
        Code::NotFound => 404,
        Code::ResourceExhausted => 429,
        Code::Unimplemented => 501,
        Code::Unavailable => 503,
        Code::DeadlineExceeded => 504,
        Code::Unknown | Code::Internal | Code::DataLoss => 500,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_says_what_it_is_and_when_to_come_again() {
        let error = ServiceError::new(ErrorKind::Overloaded, "later")
            .retry_after(Duration::from_millis(1500));
        let status = of(error);
        assert_eq!((status.code(), status.message()), (Code::ResourceExhausted, "later"));
        let details = status.get_error_details();
        assert_eq!(details.error_info().unwrap().reason, "OVERLOADED");
        let pause = details.retry_info().unwrap().retry_delay;
        assert_eq!(pause, Some(Duration::from_millis(1500)));
        let response = status.into_http::<axum::body::Body>();
        assert_eq!(as_http(&response), Some(429));
    }
}
