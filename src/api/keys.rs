//! API keys.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ApiKey, KeyLimits, MapName, Role};

/// A request to create an API key.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewKey {
    /// Name for people, 1 to 100 bytes.
    pub name: String,
    /// Role of the key.
    pub role: Role,
    /// Maps that the key may access, which need not exist yet; all maps if empty.
    #[serde(default)]
    pub maps: Vec<MapName>,
    /// Rate limits of the key.
    #[serde(default)]
    pub limits: KeyLimits,
    /// Lifetime in days, 1 to 36500; null for a key that does not expire.
    #[serde(default)]
    #[schema(nullable, minimum = 1, maximum = 36500)]
    pub expires_days: Option<u32>,
}

/// A newly created API key.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct MadeKey {
    /// The key, to be sent as `Authorization: Bearer …`. It is shown only in this response.
    pub token: String,
    /// The stored properties of the key.
    pub key: ApiKey,
}
