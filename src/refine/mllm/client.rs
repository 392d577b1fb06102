//! The client of one MLLM server, with its timeouts, retries and rate limits.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use jiff::Timestamp;
use parking_lot::Mutex;
use reqwest::header::HeaderMap;
use reqwest::{Url, redirect};
use tokio::sync::watch;

use super::breaker::Breaker;
use super::capability::Capabilities;
use super::endpoint;
use super::failure::Failure;
use super::gate::{CallGate, CallPlace, Permit};
use super::limit::CallPurpose;
use super::rate::RateLimiter;
use super::response::Flaw;
use super::retry::{CallError, CallRetryPolicy};
use super::settings::{MllmSettings, MllmSettingsError, ServerSettings};
use super::wire::Message;
use whereabouts_core::{ModelServer, ModelTrouble, Secret};
use whereabouts_store::TokenBuckets;

/// How long calls wait for the check of the server.
const CHECK_WAIT: Duration = Duration::from_secs(10);

/// One call to a model.
#[derive(Debug, Clone)]
pub struct Call<'a> {
    /// The model.
    pub model: &'a str,
    /// The conversation so far.
    pub messages: Vec<Message>,
    /// The same in fewer words, for servers with a short context.
    pub shorter: Option<Vec<Message>>,
    /// The labels of the candidates, if the answer is to rank them.
    pub labels: Option<&'a [String]>,
    /// The estimated size of the conversation, in tokens.
    pub prompt_tokens: u64,
    /// The longest answer, in tokens.
    pub max_tokens: u32,
}

/// A model's answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// The text, without thinking; may be empty.
    pub text: String,
    /// What the model thought.
    pub thinking: String,
    /// Why the text is not a whole answer, if it is none.
    pub flaw: Option<Flaw>,
    /// Tokens sent.
    pub prompt_tokens: u64,
    /// Tokens received.
    pub completion_tokens: u64,
    /// Whether the token counts are estimates, because the server does not report any that can be believed.
    pub estimated: bool,
    /// Time from sending the request to the end of the answer.
    pub took: Duration,
}

/// Makes calls to one server, within its limits.
#[derive(Debug)]
pub struct MllmClient {
    pub(super) http: reqwest::Client,
    pub(super) url: Url,
    pub(super) headers: HeaderMap,
    pub(super) key: Secret,
    pub(super) temperature: f64,
    pub(super) max_tokens: u32,
    pub(super) timeout: Duration,
    pub(super) answer_max_bytes: usize,
    models: Vec<String>,
    capabilities: Mutex<Capabilities>,
    pub(super) retry: CallRetryPolicy,
    pub(super) breaker: Breaker,
    pub(super) rate: RateLimiter,
    pub(super) trouble: Mutex<Option<ModelTrouble>>,
    /// Why no answer of the last job could be used, by what the calls were for. Answers arrive, so this is no failure of
    /// calls.
    useless: Mutex<[Option<ModelTrouble>; 2]>,
    /// Lets as many calls pass at once as the server bears.
    pub(super) gate: Arc<CallGate>,
    /// Whether the server has answered a call since it last refused all.
    pub(super) is_proven: AtomicBool,
    /// Held by the call that finds out whether the server answers.
    pub(super) scout: tokio::sync::Mutex<()>,
    /// Whether a failing server was tried without a format of the answer.
    pub(super) tried_plain: AtomicBool,
    /// Whether so much was left out of a request that the server is to be checked again; once is enough.
    pub(super) wants_check: AtomicBool,
    checked_again: AtomicBool,
    /// Whether the last check got no answer, so that it is not known what the server can do.
    is_unchecked: AtomicBool,
    /// Whether calls wait until the server has been checked.
    checking: watch::Sender<bool>,
}

impl MllmClient {
    /// Creates a client for a server of the settings. The buckets enforce its rate limits.
    pub fn new(
        settings: &MllmSettings,
        server: &ServerSettings,
        buckets: TokenBuckets,
    ) -> Result<Self, MllmSettingsError> {
        // reqwest panics without a crypto provider. This is an error if one is installed already, which is
        // fine.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let key = server.key()?;
        let http = reqwest::Client::builder()
            // A redirect would send the key to another server.
            .redirect(redirect::Policy::none())
            .connect_timeout(settings.timeout().min(Duration::from_secs(10)))
            .build()
            .map_err(|error| MllmSettingsError::Client(error.to_string()))?;
        let backoff = Duration::from_millis(settings.backoff_ms);
        Ok(Self {
            http,
            url: endpoint::url(server)?,
            headers: endpoint::headers(&key, server.key_header)?,
            key,
            temperature: settings.temperature,
            max_tokens: settings.max_tokens,
            timeout: settings.timeout(),
            answer_max_bytes: settings.answer_max_bytes,
            models: server.models.clone(),
            capabilities: Mutex::new(Capabilities::assumed(
                settings.temperature >= 0.0,
                settings.max_tokens_field,
            )),
            retry: CallRetryPolicy {
                attempts: settings.attempts,
                backoff,
                longest_retry_after: Duration::from_secs(settings.retry_after_max_s),
            },
            breaker: Breaker::new(
                settings.breaker_failures,
                Duration::from_secs(settings.breaker_open_s),
            ),
            rate: RateLimiter::new(
                settings.requests_per_minute,
                settings.tokens_per_minute,
                buckets,
            ),
            trouble: Mutex::default(),
            useless: Mutex::default(),
            gate: CallGate::new(settings.concurrency, backoff),
            is_proven: AtomicBool::new(false),
            scout: tokio::sync::Mutex::default(),
            tried_plain: AtomicBool::new(false),
            wants_check: AtomicBool::new(false),
            checked_again: AtomicBool::new(false),
            is_unchecked: AtomicBool::new(false),
            checking: watch::Sender::new(false),
        })
    }

    /// Waits for the check of the server, if there is one.
    pub(super) async fn ready(&self) {
        let mut checking = self.checking.subscribe();
        // What a slow server can do is found out by the first calls as well.
        let checked = checking.wait_for(|checking| !checking);
        let _ = tokio::time::timeout(CHECK_WAIT, checked).await;
    }

    /// Makes a call that has its permit, with retries as the settings allow, which wait at that place for theirs.
    /// Dropping the future cancels it.
    pub(super) async fn call(
        &self,
        call: &Call<'_>,
        place: CallPlace,
        permit: Permit,
    ) -> Result<Answer, CallError> {
        let mut first = Some(permit);
        self.retry.run(|| self.attempt(call, place, first.take())).await
    }

    /// Returns the longest answer that calls ask for, in tokens.
    pub fn max_tokens(&self) -> u32 {
        self.max_tokens
    }

    /// Returns what the server can do, as far as it is known.
    pub fn capabilities(&self) -> Capabilities {
        *self.capabilities.lock()
    }

    /// Records what the server can do.
    pub(super) fn revise(&self, change: impl FnOnce(&mut Capabilities)) {
        let slots = {
            let mut capabilities = self.capabilities.lock();
            change(&mut capabilities);
            capabilities.slots
        };
        if let Some(slots) = slots {
            self.gate.adjust(|limit| limit.bound_by(slots));
        }
    }

    /// Returns the gate that calls pass.
    pub(super) fn gate(&self) -> &Arc<CallGate> {
        &self.gate
    }

    /// Whether to check the server again: to find out what of all that was left out it does not support, or because it
    /// did not answer the last check. Not while calls are suspended.
    pub(super) fn take_wants_check(&self) -> bool {
        let left_out = self.wants_check.swap(false, Ordering::Relaxed)
            && !self.checked_again.swap(true, Ordering::Relaxed);
        left_out || (!self.is_suspended() && self.is_unchecked.swap(false, Ordering::Relaxed))
    }

    /// Has the server checked again with the next job, because it did not answer.
    pub(super) fn stays_unchecked(&self) {
        self.is_unchecked.store(true, Ordering::Relaxed);
    }

    /// Suspends calls, because the server was found to refuse all.
    pub(super) async fn suspend(&self) {
        if let Ok(admission) = self.breaker.admit().await {
            admission.refused();
        }
    }

    /// Says that a check has found out what of all that was left out the server does not support.
    pub(super) fn settled(&self) {
        self.wants_check.store(false, Ordering::Relaxed);
    }

    /// Has calls wait until [`Self::checked`].
    pub(super) fn check_begins(&self) {
        self.checking.send_replace(true);
    }

    /// Lets calls go on.
    pub(super) fn checked(&self) {
        self.checking.send_replace(false);
    }

    /// Returns whether the circuit breaker is open.
    pub fn is_suspended(&self) -> bool {
        self.breaker.is_open()
    }

    /// Returns the URL of chat completions, which may contain credentials.
    pub fn url(&self) -> &Url {
        &self.url
    }

    /// Returns the base URL as it may be shown.
    pub fn shown_url(&self) -> String {
        endpoint::shown(&self.url)
    }

    /// Returns what the API shows of this server.
    pub fn report(&self) -> ModelServer {
        let wait = self.breaker.open_for();
        ModelServer {
            url: self.shown_url(),
            models: self.models.clone(),
            suspended: wait.is_some(),
            suspended_for_s: wait.map(|wait| wait.as_secs_f64()),
            trouble: self.trouble(),
            capabilities: self.capabilities().report(self.gate.levels().limit),
        }
    }

    /// Notes that no answer to a job's calls of that purpose could be used, or that one could.
    pub(super) fn answers_are(&self, purpose: CallPurpose, useless: Option<&str>) {
        self.useless.lock()[purpose as usize] = useless.map(|why| ModelTrouble {
            at: Timestamp::now(),
            kind: "no_answer".to_owned(),
            status: None,
            message: why.to_owned(),
        });
    }

    /// Returns the last failure since a call succeeded, or why answers cannot be used.
    fn trouble(&self) -> Option<ModelTrouble> {
        let failed = self.trouble.lock().clone();
        failed.or_else(|| self.useless.lock().iter().flatten().next().cloned())
    }

    /// Notes that a check got an answer.
    pub(super) fn proven(&self) {
        self.is_proven.store(true, Ordering::Relaxed);
    }

    /// Keeps a failure for those who ask why.
    pub(super) fn note(&self, failure: &Failure) {
        let Failure { kind, status, why, .. } = failure;
        tracing::warn!(kind = kind.as_str(), status, why, "a call to the MLLM failed");
        self.remember(failure);
    }

    pub(super) fn remember(&self, failure: &Failure) {
        let Failure { kind, status, why, .. } = failure;
        *self.trouble.lock() = Some(ModelTrouble {
            at: Timestamp::now(),
            kind: kind.as_str().to_owned(),
            status: *status,
            message: why.clone(),
        });
    }

    pub(super) fn last_trouble(&self) -> String {
        self.trouble.lock().as_ref().map(|trouble| trouble.message.clone()).unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::super::settings::KeyHeader;
    use super::super::settings::tests::defaults;
    use super::*;
    use reqwest::header::AUTHORIZATION;

    fn client(settings: &MllmSettings) -> Result<MllmClient, MllmSettingsError> {
        MllmClient::new(settings, &settings.describing(), TokenBuckets::default())
    }

    #[test]
    fn azure_gets_its_version_in_the_query_and_its_key_in_an_api_key_header() {
        let settings = MllmSettings {
            base_url: "https://x.openai.azure.com/openai/deployments/gpt/".into(),
            api_version: "2024-10-21".into(),
            key_header: KeyHeader::ApiKey,
            api_key: Secret::new("azure-key"),
            ..defaults()
        };
        let client = client(&settings).unwrap();
        assert_eq!(
            client.url.as_str(),
            "https://x.openai.azure.com/openai/deployments/gpt/chat/completions\
             ?api-version=2024-10-21"
        );
        assert_eq!(client.headers["api-key"], "azure-key");
        assert!(!client.headers.contains_key(AUTHORIZATION));
    }

    #[test]
    fn the_client_does_not_show_its_key() {
        let settings = MllmSettings { api_key: Secret::new("sk-shown"), ..defaults() };
        let client = client(&settings).unwrap();
        assert!(!format!("{client:?}").contains("sk-shown"));
        assert_eq!(client.quotable("no sk-shown"), "no [hidden]");
        assert!(client.quotable(&"x\n".repeat(1000)).len() < 1000);
    }

    #[test]
    fn a_key_that_no_header_can_carry_is_rejected_without_showing_it() {
        let settings = MllmSettings { api_key: Secret::new("bad\nkey"), ..defaults() };
        let error = client(&settings).unwrap_err();
        assert!(!format!("{error} {error:?}").contains("bad"));
    }
}
