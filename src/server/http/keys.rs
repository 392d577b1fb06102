//! `/keys`.

use axum::Json;
use axum::http::StatusCode;
use serde::Serialize;
use utoipa::ToSchema;

use super::body::{JsonBody, Segments};
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{MadeKey, NewKey};
use whereabouts_core::ApiKey;

/// All keys.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct KeyList {
    /// The newest first, including revoked and expired keys.
    keys: Vec<ApiKey>,
}

/// Create an API key
///
/// The key is shown in this answer only: the server stores a hash of it.
#[utoipa::path(post, path = "/keys", tag = "keys", request_body = NewKey, responses(
    (status = 201, body = MadeKey, description = "Created"),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "There are too many keys", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "A value is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn create_key(
    Ready(service): Ready,
    JsonBody(new): JsonBody<NewKey>,
) -> Result<(StatusCode, Json<MadeKey>), Problem> {
    Ok((StatusCode::CREATED, Json(service.keys.create(new).await?)))
}

/// List the API keys
#[utoipa::path(get, path = "/keys", tag = "keys", responses((status = 200, body = KeyList)))]
pub(super) async fn list_keys(Ready(service): Ready) -> Result<Json<KeyList>, Problem> {
    Ok(Json(KeyList { keys: service.keys.list() }))
}

/// Revoke an API key
///
/// It takes effect before the answer is sent. The key stays in the list.
#[utoipa::path(delete, path = "/keys/{id}", tag = "keys", params(("id" = String, Path)), responses(
    (status = 200, body = ApiKey, description = "Revoked, now or earlier"),
    (status = 404, body = Problem, description = "No such key", content_type = "application/problem+json"),
))]
pub(super) async fn revoke_key(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<Json<ApiKey>, Problem> {
    Ok(Json(service.keys.revoke(&id).await?))
}
