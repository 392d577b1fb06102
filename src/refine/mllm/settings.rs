//! `[mllm]`: how the multimodal LLM is reached, what it is asked, and what it may cost.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::budget::Limits;
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
    /// The model that compares pictures.
    pub describe_model: String,
    /// The model that ranks.
    pub reason_model: String,
    /// Calls in progress at most.
    pub concurrency: usize,
    /// The longest edge of a picture that is sent, in pixels.
    pub image_max_edge: u32,
    /// Sampling temperature, 0 to 2; a negative number sends none.
    pub temperature: f64,
    /// The longest answer, in tokens.
    pub max_tokens: u32,
    /// The field that bounds the answer.
    pub max_tokens_field: MaxTokensField,
    /// The longest call, in seconds.
    pub timeout_s: u64,
    /// How often a call is tried.
    pub attempts: u32,
    /// The first pause between two tries, in milliseconds.
    pub backoff_ms: u64,
    /// The longest `Retry-After` that is waited for, in seconds.
    pub retry_after_max_s: u64,
    /// Calls a minute; 0 for no limit.
    pub requests_per_minute: u32,
    /// Tokens a minute; 0 for no limit.
    pub tokens_per_minute: u64,
    /// Tokens of one job; 0 for no limit.
    pub tokens_per_job: u64,
    /// Money for one job; 0 for no limit.
    pub money_per_job: f64,
    /// Tokens of one day (UTC); 0 for no limit.
    pub tokens_per_day: u64,
    /// Money for one day (UTC); 0 for no limit.
    pub money_per_day: f64,
    /// Money for a million tokens sent.
    pub price_prompt: f64,
    /// Money for a million tokens received.
    pub price_completion: f64,
    /// Whether each object of the frame is looked for in the candidate.
    pub object_matching: bool,
    /// Whether the prompt says what not to speak of.
    pub constraints: bool,
    /// Whether the coarse order is hidden from the reasoning model.
    pub hide_coarse_rank: bool,
    /// Failed calls in a row that open the breaker.
    pub breaker_failures: u32,
    /// How long an open breaker lets nothing pass, in seconds.
    pub breaker_open_s: u64,
    /// What a job does while no call may be made.
    pub on_unavailable: OnUnavailable,
    /// The largest answer that is read, in bytes.
    pub answer_max_bytes: usize,
    /// What is kept of one description, in characters.
    pub description_max_chars: usize,
    /// The cosine similarity from which the descriptions of an earlier frame stand in for those of
    /// a new one; 0 for never.
    pub similar_frame_min: f32,
    /// Described frames that are remembered for that, in each map.
    pub similar_frames_kept: usize,
}

/// The header that carries the key.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum KeyHeader {
    /// `Authorization: Bearer …`
    Authorization,
    /// `api-key: …`, as Azure has it.
    ApiKey,
}

/// The field that bounds the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaxTokensField {
    /// The newer name.
    MaxCompletionTokens,
    /// The older name.
    MaxTokens,
}

/// What a job does while no call may be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnUnavailable {
    /// Another refiner takes it.
    Local,
    /// It waits.
    Wait,
}

/// Settings with which no model can be reached.
#[derive(Debug, thiserror::Error)]
pub enum MllmSettingsError {
    /// The key file cannot be read.
    #[error("mllm.api_key_file {path} cannot be read: {source}")]
    KeyFile {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The key has characters that no header can carry.
    #[error("the key of mllm.api_key or mllm.api_key_file holds characters no header can carry")]
    Key,
    /// The URL is none.
    #[error("mllm.base_url {url:?} is not a URL of http or https: {reason}")]
    Url {
        /// What was given.
        url: String,
        /// Why it is refused.
        reason: String,
    },
    /// Values contradict each other.
    #[error("{0}")]
    Contradiction(String),
    /// The HTTP client cannot start.
    #[error("the HTTP client cannot start: {0}")]
    Client(String),
}

impl MllmSettings {
    /// What contradicts itself in these settings, if anything does. `job_timeout_s` is the longest
    /// a job may take, in seconds.
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
        if job_timeout_s <= self.timeout_s {
            return Some(format!(
                "jobs.timeout_s ({job_timeout_s}) must outlast mllm.timeout_s ({}), or a slow call \
                 would take its job with it",
                self.timeout_s
            ));
        }
        None
    }

    /// The key, from where the settings say.
    pub fn key(&self) -> Result<Secret, MllmSettingsError> {
        if self.api_key_file.as_os_str().is_empty() {
            return Ok(self.api_key.clone());
        }
        std::fs::read_to_string(&self.api_key_file).map(|text| Secret::new(&text)).map_err(
            |source| MllmSettingsError::KeyFile { path: self.api_key_file.clone(), source },
        )
    }

    /// The longest call.
    pub fn timeout(&self) -> Duration {
        Duration::from_secs(self.timeout_s)
    }

    /// What may be spent.
    pub fn limits(&self) -> Limits {
        Limits {
            tokens_per_job: self.tokens_per_job,
            money_per_job: self.money_per_job,
            tokens_per_day: self.tokens_per_day,
            money_per_day: self.money_per_day,
            price_prompt: self.price_prompt,
            price_completion: self.price_completion,
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    #[derive(Deserialize)]
    struct File {
        mllm: MllmSettings,
    }

    /// The defaults as the configuration file has them.
    pub fn defaults() -> MllmSettings {
        toml::from_str::<File>(include_str!("../../../deploy/whereabouts.toml")).unwrap().mllm
    }

    #[test]
    fn the_defaults_are_whole_and_consistent() {
        assert_eq!(defaults().validate(300), None);
    }

    #[test]
    fn a_call_longer_than_its_job_is_refused() {
        assert!(defaults().validate(60).unwrap().contains("outlast"));
    }

    #[test]
    fn a_bound_on_money_needs_prices() {
        let settings = MllmSettings { money_per_day: 5.0, ..defaults() };
        assert!(settings.validate(300).unwrap().contains("price"));
        assert_eq!(MllmSettings { price_prompt: 2.5, ..settings }.validate(300), None);
    }

    #[test]
    fn the_key_comes_from_a_file_without_its_line_end() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), "sk-from-file\n").unwrap();
        let settings = MllmSettings { api_key_file: file.path().to_owned(), ..defaults() };
        assert_eq!(settings.key().unwrap(), Secret::new("sk-from-file"));
        let missing = MllmSettings { api_key_file: "no-such-file".into(), ..defaults() };
        assert!(missing.key().unwrap_err().to_string().contains("no-such-file"));
    }

    #[test]
    fn settings_do_not_show_the_key() {
        let settings = MllmSettings { api_key: Secret::new("sk-shown"), ..defaults() };
        assert!(!format!("{settings:?}").contains("sk-shown"));
        assert!(!serde_json::to_string(&settings).unwrap().contains("sk-shown"));
    }
}
