//! `/webhooks`.

use axum::Json;
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};
use uuid::Uuid;

use super::body::{JsonBody, Params, Segments};
use crate::gate::Problem;
use crate::gate::Ready;
use whereabouts_api::{DeliveryPage, MadeWebhook, NewWebhook};
use whereabouts_core::{Delivery, DeliveryState, Webhook};
use whereabouts_service::{self};

/// All webhooks.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct WebhookList {
    /// The newest first.
    webhooks: Vec<Webhook>,
}

/// Create a webhook
///
/// From now on, the end of each job is posted to its URL, signed as *Standard Webhooks* specifies. The secret is
/// shown in this answer only.
#[utoipa::path(post, path = "/webhooks", tag = "webhooks", request_body = NewWebhook, responses(
    (status = 201, body = MadeWebhook, description = "Created"),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "There are too many webhooks", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "The URL is not valid or leads to an address that is not public, or no event is named", content_type = "application/problem+json"),
))]
pub(super) async fn create_webhook(
    Ready(service): Ready,
    JsonBody(new): JsonBody<NewWebhook>,
) -> Result<(StatusCode, Json<MadeWebhook>), Problem> {
    Ok((StatusCode::CREATED, Json(service.webhooks.create(new).await?)))
}

/// List the webhooks
#[utoipa::path(get, path = "/webhooks", tag = "webhooks", responses((status = 200, body = WebhookList)))]
pub(super) async fn list_webhooks(Ready(service): Ready) -> Result<Json<WebhookList>, Problem> {
    Ok(Json(WebhookList { webhooks: service.webhooks.list().await? }))
}

/// One webhook
#[utoipa::path(get, path = "/webhooks/{id}", tag = "webhooks", params(("id" = Uuid, Path)), responses(
    (status = 200, body = Webhook),
    (status = 404, body = Problem, description = "No such webhook", content_type = "application/problem+json"),
))]
pub(super) async fn get_webhook(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<Json<Webhook>, Problem> {
    Ok(Json(service.webhooks.get(uuid("webhook", &id)?).await?))
}

/// Remove a webhook
///
/// Removes its deliveries too. A message that is being sent still arrives.
#[utoipa::path(delete, path = "/webhooks/{id}", tag = "webhooks", params(("id" = Uuid, Path)), responses(
    (status = 204, description = "Removed"),
    (status = 404, body = Problem, description = "No such webhook", content_type = "application/problem+json"),
))]
pub(super) async fn delete_webhook(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<StatusCode, Problem> {
    service.webhooks.delete(uuid("webhook", &id)?).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Test a webhook
///
/// Queues a message of the type `ping`; the deliveries of the webhook show its outcome.
#[utoipa::path(post, path = "/webhooks/{id}/test", tag = "webhooks", params(("id" = Uuid, Path)), responses(
    (status = 202, body = Delivery, description = "Queued"),
    (status = 404, body = Problem, description = "No such webhook", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "It is disabled", content_type = "application/problem+json"),
))]
pub(super) async fn test_webhook(
    Ready(service): Ready,
    Segments(id): Segments<String>,
) -> Result<(StatusCode, Json<Delivery>), Problem> {
    let queued = service.webhooks.test(uuid("webhook", &id)?).await?;
    Ok((StatusCode::ACCEPTED, Json(queued)))
}

#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields)]
pub(super) struct ListParams {
    /// Only deliveries in this state.
    state: Option<DeliveryState>,
    /// Deliveries in a page, 1 to 1000; 100 by default.
    limit: Option<usize>,
    /// `next_cursor` of the previous page.
    cursor: Option<String>,
}

/// List the deliveries of a webhook, newest first
///
/// Deliveries that have ended are removed after a while; a dead one is no longer retried.
#[utoipa::path(get, path = "/webhooks/{id}/deliveries", tag = "webhooks",
    params(("id" = Uuid, Path), ListParams), responses(
    (status = 200, body = DeliveryPage),
    (status = 400, body = Problem, description = "Malformed", content_type = "application/problem+json"),
    (status = 404, body = Problem, description = "No such webhook", content_type = "application/problem+json"),
    (status = 422, body = Problem, description = "limit is out of range", content_type = "application/problem+json"),
))]
pub(super) async fn list_deliveries(
    Ready(service): Ready,
    Segments(id): Segments<String>,
    Params(params): Params<ListParams>,
) -> Result<Json<DeliveryPage>, Problem> {
    let id = uuid("webhook", &id)?;
    let cursor = params.cursor.as_deref().map(|cursor| uuid("delivery", cursor)).transpose()?;
    Ok(Json(service.webhooks.deliveries(id, params.state, cursor, params.limit).await?))
}

/// Deliver a message again
///
/// A delivery that succeeded or is dead is queued again under the same id.
#[utoipa::path(post, path = "/webhooks/{id}/deliveries/{delivery}/redeliver", tag = "webhooks",
    params(("id" = Uuid, Path), ("delivery" = Uuid, Path)), responses(
    (status = 202, body = Delivery, description = "Queued"),
    (status = 404, body = Problem, description = "No such webhook or delivery", content_type = "application/problem+json"),
    (status = 409, body = Problem, description = "It is queued already, or the webhook is disabled", content_type = "application/problem+json"),
))]
pub(super) async fn redeliver(
    Ready(service): Ready,
    Segments((id, delivery)): Segments<(String, String)>,
) -> Result<(StatusCode, Json<Delivery>), Problem> {
    let (id, delivery) = (uuid("webhook", &id)?, uuid("delivery", &delivery)?);
    Ok((StatusCode::ACCEPTED, Json(service.webhooks.redeliver(id, delivery).await?)))
}

fn uuid(of: &str, text: &str) -> Result<Uuid, Problem> {
    Ok(whereabouts_service::uuid(of, text)?)
}
