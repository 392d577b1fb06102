//! Webhooks and their deliveries.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;
use whereabouts_core::{Delivery, MapName, Webhook, WebhookEvent, WebhookSecret};

/// A request to create a webhook.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewWebhook {
    /// URL to which messages are posted: https or http, without credentials and fragment.
    #[schema(format = "uri", min_length = 1, max_length = 2048)]
    pub url: String,
    /// Events that the webhook receives; by default, every event of a finished job.
    #[serde(default = "all_final_events")]
    #[schema(min_items = 1)]
    pub events: Vec<WebhookEvent>,
    /// Restricts the events to jobs of this map, which need not exist yet; null for all maps.
    #[serde(default)]
    #[schema(nullable)]
    pub map: Option<MapName>,
}

/// A newly created webhook.
#[derive(Debug, Clone, Serialize, ToSchema)]
pub struct MadeWebhook {
    /// The stored properties of the webhook.
    #[serde(flatten)]
    pub webhook: Webhook,
    /// Signing secret: `whsec_` and 32 bytes in base64. It is shown only in this response.
    #[schema(value_type = String)]
    pub secret: WebhookSecret,
}

/// A page of deliveries, newest first.
#[derive(Debug, Serialize, ToSchema)]
pub struct DeliveryPage {
    /// Deliveries on this page.
    pub deliveries: Vec<Delivery>,
    /// `cursor=` of the request for the next page; null on the last page.
    pub next_cursor: Option<Uuid>,
}

fn all_final_events() -> Vec<WebhookEvent> {
    WebhookEvent::ENDS.to_vec()
}
