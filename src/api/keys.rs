//! API keys.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use whereabouts_core::{ApiKey, KeyLimits, MapName, Role};

/// A key that is wanted.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NewKey {
    /// What people call it, 1 to 100 bytes.
    pub name: String,
    /// What its holder may do.
    pub role: Role,
    /// In which maps, which need not be there yet; in all, if there is none.
    #[serde(default)]
    pub maps: Vec<MapName>,
    /// How often.
    #[serde(default)]
    pub limits: KeyLimits,
    /// For how many days, 1 to 36500; null for ever.
    #[serde(default)]
    #[schema(nullable, minimum = 1, maximum = 36500)]
    pub expires_days: Option<u32>,
}

/// A key that was made.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub struct MadeKey {
    /// The key, to be sent as `Authorization: Bearer …`. It is shown this once.
    pub token: String,
    /// What is known of it.
    pub key: ApiKey,
}
