//! The audit log: one line for each call with a key that changes something.

use std::sync::Arc;

use axum::extract::Request;
use axum::http::Method;
use axum::response::Response;
use whereabouts_core::{ApiKey, Token};

use super::request_id::RequestId;
use super::status::status_of;

/// A call for the audit log; written when this is dropped, so that a call that was abandoned is logged too.
pub(super) struct AuditEntry {
    request_id: RequestId,
    key: Arc<ApiKey>,
    method: Method,
    path: String,
    /// `None` until the call has been answered.
    status: Option<u16>,
}

impl AuditEntry {
    pub fn of(request: &Request, key: &Arc<ApiKey>) -> Self {
        Self {
            request_id: request.extensions().get::<RequestId>().cloned().unwrap_or_default(),
            key: Arc::clone(key),
            method: request.method().clone(),
            path: without_secrets(request.uri().path()),
            status: None,
        }
    }

    pub fn answered(&mut self, response: &Response) {
        self.status = Some(status_of(response));
    }
}

impl Drop for AuditEntry {
    fn drop(&mut self) {
        let Self { request_id, key, method, path, status } = self;
        tracing::info!(
            target: "audit",
            request_id = %request_id.0, key = %key.id, key_name = %key.name, role = %key.role,
            %method, path, status, "{}", if status.is_some() { "a call" } else { "an abandoned call" }
        );
    }
}

/// A path as it may be logged: a key that was put into it by mistake is cut after its id.
pub(super) fn without_secrets(path: &str) -> String {
    match path.find(Token::PREFIX) {
        None => path.to_owned(),
        Some(at) => {
            let shown: String = path[at..].chars().take(Token::PREFIX.len() + Token::ID).collect();
            format!("{}{shown}…", &path[..at])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_in_a_path_is_not_logged() {
        let token = Token::new(&[0xa7; 38]);
        let logged = without_secrets(&format!("/keys/{}/x", token.reveal()));
        assert_eq!(logged, "/keys/wab_a7a7a7a7a7a7…");
        assert_eq!(without_secrets("/maps/yard"), "/maps/yard");
    }
}
