//! Settings: typed, with every default in one commented file, checked together at start.
//!
//! Defaults (`deploy/whereabouts.toml`) < the file of `--config` < environment < flags.

mod database;
mod model;
mod overrides;
mod refine;
mod refiner;

use std::path::{Path, PathBuf};

use figment::Figment;
use figment::providers::{Env, Format, Serialized, Toml};
use serde::{Deserialize, Serialize};

pub use self::database::{Database, ObjectStore};
pub use self::model::Model;
pub use self::overrides::Overrides;
pub use self::refine::Refine;
pub use self::refiner::RefinerChoice;
pub use crate::gate::ServerSettings;
use crate::http::Tiles;
use whereabouts_index::IndexSettings;
use whereabouts_refine::JobSettings;
use whereabouts_refine::cascade::CascadeSettings;
use whereabouts_refine::mllm::MllmSettings;
use whereabouts_service::{
    BulkSettings, ConfidenceSettings, IdempotencySettings, LocalizeSettings, ReadingSettings,
    TrackSettings, VocabularySettings, WebhookSettings,
};
use whereabouts_telemetry::{LogSettings, TraceSettings};
use whereabouts_vision::ImageSettings;

/// The default settings, every key with a comment.
pub const DEFAULTS: &str = include_str!("../../deploy/whereabouts.toml");

/// All settings.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The HTTP server.
    pub server: ServerSettings,
    /// The embedded store.
    pub data: Data,
    /// The store of many processes.
    pub database: Database,
    /// Where it keeps pictures.
    pub objects: ObjectStore,
    /// The model.
    pub model: Model,
    /// Decoding.
    pub image: ImageSettings,
    /// Search.
    pub index: IndexSettings,
    /// Who may ask.
    pub auth: Auth,
    /// Answers.
    pub localize: LocalizeSettings,
    /// How maps are measured.
    pub confidence: ConfidenceSettings,
    /// Vocabularies of maps' own.
    pub vocabulary: VocabularySettings,
    /// The text in pictures.
    pub reading: ReadingSettings,
    /// The frames of one robot, one after another.
    pub track: TrackSettings,
    /// Many images in one request.
    pub bulk: BulkSettings,
    /// Requests that may be sent again.
    pub idempotency: IdempotencySettings,
    /// Refinement jobs.
    pub jobs: JobSettings,
    /// Who is told of the ends of jobs.
    pub webhooks: WebhookSettings,
    /// The refiner.
    pub refine: Refine,
    /// When the refiner `cascade` asks the multimodal LLM.
    pub cascade: CascadeSettings,
    /// The multimodal LLM.
    pub mllm: MllmSettings,
    /// The operator's console.
    pub console: Console,
    /// Logs.
    pub log: LogSettings,
    /// Traces.
    pub traces: TraceSettings,
}

/// `[data]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Data {
    /// The folder of the embedded store.
    pub dir: PathBuf,
    /// sled's page cache, in bytes.
    pub db_cache_bytes: u64,
    /// Bytes of the disk that stay free.
    pub min_free_bytes: u64,
    /// The most changes in one commit.
    pub commit_batch: usize,
    /// Descriptions that were paid for, in bytes.
    pub description_cache_bytes: u64,
    /// How long they are used, in days.
    pub description_cache_days: u64,
    /// For how many days it is known what was spent.
    pub usage_days: u32,
}

/// `[auth]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Auth {
    /// Whether callers need a key.
    pub keys: KeysWanted,
}

/// Whether callers need a key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum KeysWanted {
    /// Unless the server listens on loopback.
    Auto,
    /// Always.
    Required,
    /// Never: anyone who can reach the server has full access.
    Off,
}

/// `[console]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Console {
    /// Where the pictures behind a plan come from; empty for none.
    pub tiles_url: String,
    /// Whom to thank for them.
    pub tiles_attribution: String,
}

impl Console {
    /// The server of map tiles, if there is one.
    pub fn tiles(&self) -> Option<Tiles> {
        let (url, attribution) = (self.tiles_url.clone(), self.tiles_attribution.clone());
        (!url.is_empty()).then_some(Tiles { url, attribution })
    }

    fn validate(&self) -> Option<String> {
        let url = &self.tiles_url;
        if url.is_empty() {
            return None;
        }
        // It becomes a part of a header.
        let whole = ["{z}", "{x}", "{y}"].iter().all(|part| url.contains(part));
        let plain = url.bytes().all(|byte| byte.is_ascii_graphic() && !b";,'\"".contains(&byte));
        let known = ["https://", "http://"].iter().any(|scheme| url.starts_with(scheme));
        (!(whole && plain && known)).then(|| {
            "console.tiles_url must be an address like https://HOST/{z}/{x}/{y}.png".to_owned()
        })
    }
}

/// Settings that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A value is missing, unknown or of the wrong type.
    #[error("the configuration cannot be read: {0}")]
    Malformed(Box<figment::Error>),
    /// The file that was named is not there.
    #[error("there is no configuration file {0}")]
    NoFile(PathBuf),
    /// Values contradict each other.
    #[error("the configuration contradicts itself: {0}")]
    Contradiction(String),
}

impl Config {
    /// Layers the defaults, the file, the environment and the flags.
    pub fn load(file: Option<&Path>, flags: &Overrides) -> Result<Self, ConfigError> {
        let mut layers = Figment::from(Toml::string(DEFAULTS));
        if let Some(file) = file {
            if !file.is_file() {
                return Err(ConfigError::NoFile(file.to_owned()));
            }
            layers = layers.merge(Toml::file_exact(file));
        }
        // A variable without "__" names no setting: WHEREABOUTS_DATA and the like are for others.
        let environment =
            Env::prefixed("WHEREABOUTS_").filter(|key| key.as_str().contains("__")).split("__");
        let config: Self = layers
            .merge(environment)
            .merge(Serialized::defaults(flags))
            .extract()
            .map_err(|error| ConfigError::Malformed(Box::new(error)))?;
        match config.validate() {
            Some(why) => Err(ConfigError::Contradiction(why)),
            None => Ok(config),
        }
    }

    /// Whether callers need a key.
    pub fn keys_required(&self) -> bool {
        match self.auth.keys {
            KeysWanted::Auto => !self.server.listen.ip().is_loopback(),
            KeysWanted::Required => true,
            KeysWanted::Off => false,
        }
    }

    fn contradiction_of_a_section(&self) -> Option<String> {
        let sections = self.server.validate().or_else(|| self.localize.validate());
        if let Some(why) = sections.or_else(|| self.jobs.validate()) {
            return Some(why);
        }
        if let Some(why) = self.confidence.validate(self.refine.candidates) {
            return Some(why);
        }
        if let Some(why) = self.vocabulary.validate().or_else(|| self.reading.validate()) {
            return Some(why);
        }
        if self.bulk.memory_bytes < self.server.body_limit_bytes {
            return Some("bulk.memory_bytes must not be less than server.body_limit_bytes".into());
        }
        if self.jobs.workers == 0 && !self.database.is_set() {
            return Some(
                "jobs.workers must be at least 1: only with a database (database.url) do other processes \
                 refine"
                    .into(),
            );
        }
        let timeout = self.server.request_timeout.as_secs();
        let console = || self.console.validate();
        let objects = || self.objects.validate(timeout);
        let scale = || match self.database.is_set() {
            true => self.database.validate().or_else(objects),
            false => None,
        };
        let traces = || self.traces.validate();
        self.track.validate().or_else(console).or_else(scale).or_else(traces)
    }

    fn validate(&self) -> Option<String> {
        let at_least_one = [
            ("data.usage_days", self.data.usage_days as usize),
            ("data.commit_batch", self.data.commit_batch),
            ("model.max_batch", self.model.max_batch),
            ("model.download_attempts", self.model.download_attempts as usize),
            ("model.download_stall_s", self.model.download_stall_s as usize),
            ("bulk.in_flight", self.bulk.in_flight),
            ("bulk.max_images", self.bulk.max_images),
            ("bulk.meta_bytes", self.bulk.meta_bytes),
            ("refine.candidates", self.refine.candidates),
            ("refine.local_candidates", self.refine.local_candidates),
        ];
        if let Some((key, _)) = at_least_one.iter().find(|(_, value)| *value == 0) {
            return Some(format!("{key} must be at least 1"));
        }
        if self.model.loaded < 2 {
            return Some("model.loaded must be at least 2: a reindex needs two models".into());
        }
        if self.refine.candidates.max(self.refine.local_candidates) > self.localize.max_k {
            return Some(
                "refine.candidates and refine.local_candidates must not exceed localize.max_k"
                    .into(),
            );
        }
        if !self.model.hub.starts_with("https://") && !self.model.hub.starts_with("http://") {
            return Some("model.hub must begin with https:// or http://".into());
        }
        if let Some(why) = self.image.validate().or_else(|| self.index.validate()) {
            return Some(why);
        }
        let settings = self.refiner_settings();
        let refiners = self.allowed_refiners().into_iter();
        if let Some(why) = refiners.into_iter().find_map(|entry| (entry.validate)(&settings)) {
            return Some(why);
        }
        if self.refine.allowed.contains(&RefinerChoice::OFF) {
            return Some(
                "refine.allowed lists refiners; requests need no permission for refine=off".into(),
            );
        }
        if let Some(why) = self.contradiction_of_a_section() {
            return Some(why);
        }
        self.webhooks.validate()
    }
}

/// The settings of a server that none were given.
#[cfg(test)]
pub(crate) fn defaults() -> Config {
    Config::load(None, &Overrides::default()).unwrap()
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_core::RefinerKind;

    fn with_file(text: &str) -> Result<Config, ConfigError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        Config::load(Some(file.path()), &Overrides::default())
    }

    #[test]
    fn the_defaults_are_whole_and_consistent() {
        let config = Config::load(None, &Overrides::default()).unwrap();
        assert_eq!(config.localize.k, 10);
        assert_eq!(config.refine.refiner.kind(), Some(RefinerKind::Local));
    }

    #[test]
    fn a_flag_goes_over_the_file() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "[model]\nname = \"a\"\nthreads = 3").unwrap();
        let flags = Overrides::default().model(Some("b".into()));
        let config = Config::load(Some(file.path()), &flags).unwrap();
        assert_eq!((config.model.name.as_str(), config.model.threads), ("b", 3));
    }

    #[test]
    fn a_misspelt_key_is_named() {
        let error = with_file("[server]\nlisen = \"1.2.3.4:5\"").unwrap_err().to_string();
        assert!(error.contains("lisen"), "{error}");
    }

    #[test]
    fn a_lease_shorter_than_the_job_is_refused() {
        let error = with_file("[jobs]\nlease_s = 10\ntimeout_s = 10").unwrap_err().to_string();
        assert!(error.contains("must outlast"), "{error}");
    }

    #[test]
    fn a_body_that_may_take_longer_than_its_request_is_refused() {
        let file = "[server]\nbody_timeout_s = 30\nrequest_timeout_s = 30";
        let error = with_file(file).unwrap_err().to_string();
        assert!(error.contains("must outlast"), "{error}");
    }

    #[test]
    fn a_missing_file_is_an_error() {
        let error = Config::load(Some(Path::new("no-such.toml")), &Overrides::default());
        assert!(matches!(error, Err(ConfigError::NoFile(_))));
    }
}
