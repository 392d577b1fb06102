//! Settings of the index.

use serde::{Deserialize, Serialize};

/// `[index]`
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IndexSettings {
    /// Maps with at most this many images are searched exactly, without a graph.
    pub exact_up_to: usize,
    /// HNSW M: neighbours per point.
    pub m: usize,
    /// HNSW ef_construction: points examined per insertion.
    pub ef_construction: usize,
    /// HNSW ef_search: points examined per search; raised to k if that is larger.
    pub ef_search: usize,
    /// Threads that build graphs; 0 for half of the cores.
    pub threads: usize,
    /// A sealed graph is rebuilt when this share of its points, 0 to 1, has been removed.
    pub max_dead_share: f32,
    /// Recall monitoring: seconds between two searches that are repeated exactly; 0 for none.
    pub check_s: u64,
}

impl IndexSettings {
    /// Returns why the settings are invalid, or `None` if they are valid.
    pub fn validate(&self) -> Option<String> {
        let at_least_one = [
            ("m", self.m),
            ("ef_construction", self.ef_construction),
            ("ef_search", self.ef_search),
        ];
        if let Some((key, _)) = at_least_one.into_iter().find(|(_, value)| *value == 0) {
            return Some(format!("index.{key} must be at least 1"));
        }
        (self.m > 256).then(|| "index.m must not exceed 256".into())
    }

    /// Number of threads that build graphs.
    pub fn build_threads(&self) -> usize {
        match self.threads {
            0 => (std::thread::available_parallelism().map_or(1, usize::from) / 2).max(1),
            threads => threads,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_rows::SETTINGS;
    use super::*;

    #[test]
    fn invalid_settings_name_the_key() {
        assert_eq!(SETTINGS.validate(), None);
        let why = IndexSettings { ef_search: 0, ..SETTINGS }.validate().unwrap();
        assert_eq!(why, "index.ef_search must be at least 1");
        let why = IndexSettings { m: 257, ..SETTINGS }.validate().unwrap();
        assert_eq!(why, "index.m must not exceed 256");
    }
}
