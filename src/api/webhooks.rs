//! Webhooks and their deliveries.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use uuid::Uuid;
use whereabouts_core::{Delivery, MapName, Webhook, WebhookEvent, WebhookSecret};

/// A webhook that is wanted.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewWebhook {
    /// Where messages are to be posted: https or http, without credentials and fragment.
    #[schema(format = "uri", min_length = 1, max_length = 2048)]
    pub url: String,
    /// What it is to be told; all ends of jobs, if nothing is said.
    #[serde(default = "all_ends")]
    #[schema(min_items = 1)]
    pub events: Vec<WebhookEvent>,
    /// Only of jobs of this map, which need not be there yet; null for all.
    #[serde(default)]
    #[schema(nullable)]
    pub map: Option<MapName>,
}

/// A webhook that was made.
#[derive(Debug, Clone, Serialize, ToSchema)]
pub struct MadeWebhook {
    /// What is known of it.
    #[serde(flatten)]
    pub webhook: Webhook,
    /// What its messages are signed with: `whsec_` and 32 bytes in base64. It is shown this once.
    #[schema(value_type = String)]
    pub secret: WebhookSecret,
}

/// Some deliveries, newest first.
#[derive(Debug, Serialize, ToSchema)]
pub struct DeliveryPage {
    /// The deliveries.
    pub deliveries: Vec<Delivery>,
    /// Where the next page starts: `cursor=` of the next request. Null on the last page.
    pub next_cursor: Option<Uuid>,
}

fn all_ends() -> Vec<WebhookEvent> {
    WebhookEvent::ENDS.to_vec()
}
