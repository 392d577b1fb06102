//! The section `[mllm]`: the server, the prompts, and the limits on spend.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::budget::SpendLimits;
use super::endpoint;
use whereabouts_core::Secret;

/// `[mllm]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MllmSettings {
    /// The part of the URL before `/chat/completions`.
    pub base_url: String,
    /// The key; empty for none.
    pub api_key: Secret,
    /// A file that holds the key; empty for none.
    pub api_key_file: PathBuf,
    /// The header that carries the key.
    pub key_header: KeyHeader,
    /// The `api-version` of the URL's query, as Azure wants it; empty for none.
    pub api_version: String,
    /// The model that describes pairs.
    pub describe_model: String,
    /// The model that ranks.
    pub reason_model: String,
    /// The base URL of the server of the model that ranks; empty for the same server.
    pub reason_base_url: String,
    /// The key of that server; empty for none.
    pub reason_api_key: Secret,
    /// A file that holds the key of that server; empty for none.
    pub reason_api_key_file: PathBuf,
    /// Whether the server is asked at start what it can do.
    pub check_at_start: bool,
    /// The most concurrent calls.
    pub concurrency: usize,
    /// The longest edge of a sent picture, in pixels.
    pub image_max_edge: u32,
    /// The most memory for pictures that are kept for other pairs, in bytes.
    pub pictures_bytes: usize,
    /// Sampling temperature, 0 to 2; a negative number sends none.
    pub temperature: f64,
    /// The longest answer, in tokens.
    pub max_tokens: u32,
    /// The field that bounds the answer.
    pub max_tokens_field: MaxTokensField,
    /// The longest call, in seconds.
    pub timeout_s: u64,
    /// Attempts at a call.
    pub attempts: u32,
    /// The pause before the second attempt, in milliseconds; it doubles with each further one.
    pub backoff_ms: u64,
    /// The longest `Retry-After` that is honoured, in seconds.
    pub retry_after_max_s: u64,
    /// The most calls per minute; 0 for no limit.
    pub requests_per_minute: u32,
    /// The most tokens per minute; 0 for no limit.
    pub tokens_per_minute: u64,
    /// The most tokens for one job; 0 for no limit.
    pub tokens_per_job: u64,
    /// The most money for one job; 0 for no limit.
    pub money_per_job: f64,
    /// The most tokens for one day (UTC); 0 for no limit.
    pub tokens_per_day: u64,
    /// The most money for one day (UTC); 0 for no limit.
    pub money_per_day: f64,
    /// The price of a million tokens sent.
    pub price_prompt: f64,
    /// The price of a million tokens received.
    pub price_completion: f64,
    /// Whether the prompt asks to look for each object of the frame in the candidate.
    pub object_matching: bool,
    /// Whether the prompt lists what not to mention.
    pub constraints: bool,
    /// Whether the coarse order is hidden from the reasoning model.
    pub hide_coarse_rank: bool,
    /// Failed calls in a row that open the circuit breaker.
    pub breaker_failures: u32,
    /// How long the circuit breaker stays open, in seconds.
    pub breaker_open_s: u64,
    /// What becomes of a job while no call may be made.
    pub on_unavailable: OnUnavailable,
    /// The largest accepted answer, in bytes.
    pub answer_max_bytes: usize,
    /// The longest description, in characters; longer ones are cut.
    pub description_max_chars: usize,
    /// The cosine similarity from which descriptions of an earlier frame stand in for those of a new one;
    /// 0 for never.
    pub similar_frame_min: f32,
    /// Described frames that are kept for that, in each map.
    pub similar_frames_kept: usize,
}

/// A server, and the models that are used there.
#[derive(Debug, Clone)]
pub struct ServerSettings {
    /// The setting that holds the base URL, for error messages.
    pub url_key: &'static str,
    /// The base URL as it was set.
    pub base_url: String,
    /// The key; empty for none.
    pub api_key: Secret,
    /// A file that holds the key; empty for none.
    pub api_key_file: PathBuf,
    /// The header that carries the key.
    pub key_header: KeyHeader,
    /// The `api-version` of the URL's query; empty for none.
    pub api_version: String,
    /// The models that are used there.
    pub models: Vec<String>,
}

/// The header that carries the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum KeyHeader {
    /// `Authorization: Bearer …`
    Authorization,
    /// `api-key: …`, for Azure.
    ApiKey,
}

/// The request field that bounds the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaxTokensField {
    /// The newer name.
    MaxCompletionTokens,
    /// The older name.
    MaxTokens,
}

impl MaxTokensField {
    /// Returns its name in a request.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::MaxCompletionTokens => "max_completion_tokens",
            Self::MaxTokens => "max_tokens",
        }
    }
}

/// What becomes of a job while no call may be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnUnavailable {
    /// The refiner `local` refines it.
    Local,
    /// It is deferred.
    Wait,
}

/// Why the settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MllmSettingsError {
    /// The key file cannot be read.
    #[error(
        "the key file {path} (mllm.api_key_file, mllm.reason_api_key_file) cannot be read: {source}"
    )]
    KeyFile {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The key contains characters that are not allowed in a header.
    #[error("the key of mllm.api_key or mllm.api_key_file holds characters no header can carry")]
    Key,
    /// The URL is not valid.
    #[error("{key} {url:?} is not a URL of http or https: {reason}")]
    Url {
        /// The setting's name.
        key: &'static str,
        /// The setting.
        url: String,
        /// What is wrong with it.
        reason: String,
    },
    /// Settings contradict each other.
    #[error("{0}")]
    Contradiction(String),
    /// The HTTP client cannot be created.
    #[error("the HTTP client cannot start: {0}")]
    Client(String),
}

impl MllmSettings {
    /// Returns what is wrong with these settings, if anything is. `job_timeout_s` is the longest a job may
    /// take, in seconds.
    pub fn validate(&self, job_timeout_s: u64) -> Option<String> {
        let at_least_one = [
            ("concurrency", self.concurrency as u64),
            ("image_max_edge", self.image_max_edge.into()),
            ("max_tokens", self.max_tokens.into()),
            ("timeout_s", self.timeout_s),
            ("attempts", self.attempts.into()),
            ("breaker_failures", self.breaker_failures.into()),
            ("answer_max_bytes", self.answer_max_bytes as u64),
            ("description_max_chars", self.description_max_chars as u64),
        ];
        if let Some((key, _)) = at_least_one.iter().find(|(_, value)| *value == 0) {
            return Some(format!("mllm.{key} must be at least 1"));
        }
        if self.temperature.is_nan() || self.temperature > 2.0 {
            return Some("mllm.temperature must be 0 to 2, or negative to send none".into());
        }
        if !(0.0..=1.0).contains(&self.similar_frame_min) {
            return Some("mllm.similar_frame_min must be 0 (never) to 1".into());
        }
        let money =
            [self.money_per_job, self.money_per_day, self.price_prompt, self.price_completion];
        if money.iter().any(|value| !value.is_finite() || *value < 0.0) {
            return Some("mllm: prices and bounds on money must not be negative".into());
        }
        let priced = self.price_prompt > 0.0 || self.price_completion > 0.0;
        if (self.money_per_job > 0.0 || self.money_per_day > 0.0) && !priced {
            return Some(
                "mllm.money_per_job and mllm.money_per_day need mllm.price_prompt or \
                 mllm.price_completion"
                    .into(),
            );
        }
        if !self.api_key.is_empty() && !self.api_key_file.as_os_str().is_empty() {
            return Some("give mllm.api_key or mllm.api_key_file, not both".into());
        }
        if !self.reason_api_key.is_empty() && !self.reason_api_key_file.as_os_str().is_empty() {
            return Some("give mllm.reason_api_key or mllm.reason_api_key_file, not both".into());
        }
        let servers = [self.describing(), self.reasoning()];
        if let Some(error) = servers.iter().find_map(|server| endpoint::url(server).err()) {
            return Some(error.to_string());
        }
        if job_timeout_s <= self.timeout_s {
            return Some(format!(
                "jobs.timeout_s ({job_timeout_s}) must outlast mllm.timeout_s ({}), or a slow call \
                 would take its job with it",
                self.timeout_s
            ));
        }
        None
    }

    /// Returns the server of the model that describes.
    pub fn describing(&self) -> ServerSettings {
        let mut models = vec![self.describe_model.clone()];
        if !self.has_two_servers() && self.reason_model != self.describe_model {
            models.push(self.reason_model.clone());
        }
        ServerSettings {
            url_key: "mllm.base_url",
            base_url: self.base_url.clone(),
            api_key: self.api_key.clone(),
            api_key_file: self.api_key_file.clone(),
            key_header: self.key_header,
            api_version: self.api_version.clone(),
            models,
        }
    }

    /// Returns the server of the model that ranks.
    pub fn reasoning(&self) -> ServerSettings {
        if !self.has_two_servers() {
            return self.describing();
        }
        ServerSettings {
            url_key: "mllm.reason_base_url",
            base_url: self.reason_base_url.clone(),
            api_key: self.reason_api_key.clone(),
            api_key_file: self.reason_api_key_file.clone(),
            key_header: self.key_header,
            api_version: self.api_version.clone(),
            models: vec![self.reason_model.clone()],
        }
    }

    /// Whether the models have servers of their own.
    pub fn has_two_servers(&self) -> bool {
        !self.reason_base_url.trim().is_empty()
    }

    /// Returns the longest time a call may take.
    pub fn timeout(&self) -> Duration {
        Duration::from_secs(self.timeout_s)
    }

    /// Returns the limits on spend.
    pub fn limits(&self) -> SpendLimits {
        SpendLimits {
            tokens_per_job: self.tokens_per_job,
            money_per_job: self.money_per_job,
            tokens_per_day: self.tokens_per_day,
            money_per_day: self.money_per_day,
            price_prompt: self.price_prompt,
            price_completion: self.price_completion,
        }
    }
}

impl ServerSettings {
    /// Returns the key, or reads it from its file.
    pub fn key(&self) -> Result<Secret, MllmSettingsError> {
        if self.api_key_file.as_os_str().is_empty() {
            return Ok(self.api_key.clone());
        }
        std::fs::read_to_string(&self.api_key_file).map(|text| Secret::new(&text)).map_err(
            |source| MllmSettingsError::KeyFile { path: self.api_key_file.clone(), source },
        )
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    #[derive(Deserialize)]
    struct File {
        mllm: MllmSettings,
    }

    /// Returns the defaults of the configuration file.
    pub fn defaults() -> MllmSettings {
        toml::from_str::<File>(include_str!("../../../deploy/whereabouts.toml")).unwrap().mllm
    }

    #[test]
    fn the_defaults_are_complete_and_consistent() {
        assert_eq!(defaults().validate(300), None);
    }

    #[test]
    fn a_call_timeout_longer_than_the_jobs_is_rejected() {
        assert!(defaults().validate(60).unwrap().contains("outlast"));
    }

    #[test]
    fn a_limit_on_money_needs_prices() {
        let settings = MllmSettings { money_per_day: 5.0, ..defaults() };
        assert!(settings.validate(300).unwrap().contains("price"));
        assert_eq!(MllmSettings { price_prompt: 2.5, ..settings }.validate(300), None);
    }

    #[test]
    fn a_key_read_from_a_file_loses_its_line_end() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "sk-from-file\n").unwrap();
        let settings = MllmSettings { api_key_file: file.path().to_owned(), ..defaults() };
        assert_eq!(settings.describing().key().unwrap(), Secret::new("sk-from-file"));
        let missing = MllmSettings { api_key_file: "no-such-file".into(), ..defaults() };
        assert!(missing.describing().key().unwrap_err().to_string().contains("no-such-file"));
    }

    #[test]
    fn the_models_may_have_servers_of_their_own() {
        let one = MllmSettings { reason_model: "r".into(), ..defaults() };
        assert_eq!(one.reasoning().models, ["gpt-4o", "r"]);
        let two = MllmSettings {
            reason_base_url: "http://other/v1".into(),
            api_key: Secret::new("sk-one"),
            ..one
        };
        let (describing, reasoning) = (two.describing(), two.reasoning());
        assert_eq!((describing.models.len(), reasoning.models.as_slice()), (1, &["r".into()][..]));
        assert!(reasoning.api_key.is_empty(), "a key is for its own server only");
    }

    #[test]
    fn a_base_url_that_cannot_be_meant_is_refused_at_start() {
        let settings = MllmSettings { reason_base_url: "host:80/v1".into(), ..defaults() };
        assert!(settings.validate(300).unwrap().contains("mllm.reason_base_url"));
    }

    #[test]
    fn settings_do_not_show_the_key() {
        let settings = MllmSettings { api_key: Secret::new("sk-shown"), ..defaults() };
        assert!(!format!("{settings:?}").contains("sk-shown"));
        assert!(!serde_json::to_string(&settings).unwrap().contains("sk-shown"));
    }
}
