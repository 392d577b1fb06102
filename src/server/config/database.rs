//! `[database]` and `[objects]`: the store of many processes.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use whereabouts_core::Secret;

/// `[database]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Database {
    /// PostgreSQL's address; empty for the embedded store.
    pub url: Secret,
    /// The most connections of a process.
    pub max_connections: u32,
    /// The longest a call may take, in milliseconds.
    pub timeout_ms: u64,
    /// After so long without a sign of life a process counts as dead, in seconds.
    pub lifetime_s: u64,
    /// Memory for building the index of a map, in MiB.
    pub index_memory_mib: u32,
}

/// `[objects]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectStore {
    /// Where pictures are kept; empty for a folder in the data folder.
    pub url: String,
    /// The address of a server that speaks S3; empty for Amazon's.
    pub endpoint: String,
    /// The region.
    pub region: String,
    /// Whether it may be spoken to without TLS.
    pub allow_http: bool,
    /// The longest a call may take, in milliseconds.
    pub timeout_ms: u64,
    /// Pictures that nothing refers to stay so long after they came, in seconds.
    pub keep_unneeded_s: u64,
}

/// A listener, a sign of life and an index in the making take one each; somebody must do the work.
const FEWEST_CONNECTIONS: u32 = 4;

impl Database {
    /// Whether there is one.
    pub fn is_set(&self) -> bool {
        !self.url.is_empty()
    }

    /// The longest a call may take.
    pub fn timeout(&self) -> Duration {
        Duration::from_millis(self.timeout_ms)
    }

    pub(super) fn validate(&self) -> Option<String> {
        if self.max_connections < FEWEST_CONNECTIONS {
            return Some(format!("database.max_connections must be at least {FEWEST_CONNECTIONS}"));
        }
        if self.timeout_ms == 0 || self.lifetime_s == 0 {
            return Some("database.timeout_ms and database.lifetime_s must be at least 1".into());
        }
        if self.lifetime_s * 1000 < 2 * self.timeout_ms {
            return Some(
                "database.lifetime_s must be at least twice database.timeout_ms, or one slow answer of the \
                 database would make a process count as dead"
                    .into(),
            );
        }
        None
    }
}

impl ObjectStore {
    /// The longest a call may take.
    pub fn timeout(&self) -> Duration {
        Duration::from_millis(self.timeout_ms)
    }

    pub(super) fn validate(&self, request_timeout_s: u64) -> Option<String> {
        if self.timeout_ms == 0 {
            return Some("objects.timeout_ms must be at least 1".into());
        }
        if self.keep_unneeded_s < 2 * request_timeout_s {
            return Some(
                "objects.keep_unneeded_s must be at least twice server.request_timeout_s, or a picture could \
                 be removed before its request has come to refer to it"
                    .into(),
            );
        }
        None
    }
}
