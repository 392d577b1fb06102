//! Cached descriptions.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{CachedDescription, Digest};

/// A page of cached descriptions.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct DescriptionPage {
    /// The descriptions, in the order of their keys.
    pub descriptions: Vec<KeyedDescription>,
    /// Cursor of the next page; null on the last one.
    #[schema(nullable, value_type = String)]
    pub next_cursor: Option<Digest>,
}

/// A cached description with its key.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct KeyedDescription {
    /// The key, which covers everything that shapes the text.
    #[schema(value_type = String)]
    pub key: Digest,
    /// The description.
    #[serde(flatten)]
    pub description: CachedDescription,
}

/// How many descriptions were removed.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct PurgedDescriptions {
    /// Their number.
    pub removed: usize,
}
