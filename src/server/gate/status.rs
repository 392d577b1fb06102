//! The status of a response, whatever protocol it is in.

use axum::response::Response;

/// The HTTP status of a response. A gRPC response, whose HTTP status is always 200, counts as the status
/// nearest to its code.
pub(super) fn status_of(response: &Response) -> u16 {
    #[cfg(feature = "grpc")]
    if let Some(status) = super::grpc_status::as_http(response) {
        return status;
    }
    response.status().as_u16()
}
