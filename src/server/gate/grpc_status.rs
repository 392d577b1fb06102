//! Errors as gRPC statuses. The only place that maps the kind of an error to a gRPC code.

use std::time::Duration;

use axum::response::Response;
use tonic::{Code, Status};
use tonic_types::{ErrorDetails, StatusExt};

use super::problem::Problem;
use whereabouts_api::ErrorKind;
use whereabouts_service::ServiceError;

/// The domain of all errors (`google.rpc.ErrorInfo.domain`).
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

/// A status with details for programs: `ErrorInfo`, whose reason is the kind of the problem, and `RetryInfo`
/// where it is known when to try again.
fn status(kind: ErrorKind, detail: &str, retry_after: Option<Duration>) -> Status {
    let mut details = ErrorDetails::new();
    let reason = kind.word().replace('-', "_").to_uppercase();
    details.set_error_info(reason, DOMAIN, []);
    if let Some(pause) = retry_after {
        details.set_retry_info(Some(pause));
    }
    Status::with_error_details(code_of(kind), detail, details)
}

/// An error of the service as a status.
pub(crate) fn of(error: ServiceError) -> Status {
    if error.kind == ErrorKind::Internal {
        tracing::error!(detail = error.detail, "a call failed");
    }
    status(error.kind, &error.detail, error.retry_after)
}

impl From<Problem> for Status {
    fn from(problem: Problem) -> Self {
        status(problem.kind(), problem.detail(), problem.retry_after())
    }
}

/// The HTTP status nearest to the gRPC code in the headers of a response, for counts and logs; `None` for a
/// response whose code follows its body.
pub(super) fn as_http(response: &Response) -> Option<u16> {
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
    fn a_status_carries_the_reason_and_the_retry_delay() {
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
