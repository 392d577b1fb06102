//! The client of one MLLM server, with its timeouts, retries and rate limits.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use jiff::Timestamp;
use reqwest::header::{HeaderMap, RETRY_AFTER};
use reqwest::{Response, StatusCode, Url, redirect};
use tokio::sync::Semaphore;
use tracing::Instrument;

use super::breaker::Breaker;
use super::endpoint;
use super::rate::RateLimiter;
use super::retry::{CallError, CallRetryPolicy, Failure, retry_after};
use super::settings::{MaxTokensField, MllmSettings, MllmSettingsError};
use super::wire::{ChatAnswer, ChatRequest, ErrorAnswer, Message, Reply, Schema};
use whereabouts_core::Secret;
use whereabouts_store::TokenBuckets;
use whereabouts_telemetry::traces;

/// How much of an error's body is read, in bytes, and how much of it is quoted, in characters.
const ERROR_BODY_BYTES: usize = 64 << 10;
const QUOTED_CHARS: usize = 300;

/// One call to a model.
#[derive(Debug)]
pub struct Call<'a> {
    /// The model.
    pub model: &'a str,
    /// The conversation so far.
    pub messages: Vec<Message>,
    /// The schema of the answer, for servers that support one.
    pub schema: Option<Schema>,
    /// The estimated size of the conversation, in tokens.
    pub prompt_tokens: u64,
}

/// A model's answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// The text; may be empty.
    pub text: String,
    /// Why the text was cut, if it was.
    pub cut: Option<String>,
    /// Tokens sent.
    pub prompt_tokens: u64,
    /// Tokens received.
    pub completion_tokens: u64,
    /// Whether the token counts are estimates, because the server does not report them.
    pub estimated: bool,
    /// Time from sending the request to the end of the answer.
    pub took: Duration,
}

/// Makes calls to one server, within its limits.
#[derive(Debug)]
pub struct MllmClient {
    http: reqwest::Client,
    url: Url,
    headers: HeaderMap,
    key: Secret,
    temperature: Option<f64>,
    max_tokens: u32,
    max_tokens_field: MaxTokensField,
    timeout: Duration,
    answer_max_bytes: usize,
    /// Whether the server may support `response_format`: it has not rejected it yet.
    structured: AtomicBool,
    retry: CallRetryPolicy,
    breaker: Breaker,
    rate: RateLimiter,
    /// One permit for each concurrent call.
    permits: Semaphore,
}

impl MllmClient {
    /// Creates a client for the server of the settings. The buckets enforce its rate limits.
    pub fn new(settings: &MllmSettings, buckets: TokenBuckets) -> Result<Self, MllmSettingsError> {
        // reqwest panics without a crypto provider. This is an error if one is installed already, which is
        // fine.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let key = settings.key()?;
        let http = reqwest::Client::builder()
            // A redirect would send the key to another server.
            .redirect(redirect::Policy::none())
            .connect_timeout(settings.timeout().min(Duration::from_secs(10)))
            .build()
            .map_err(|error| MllmSettingsError::Client(error.to_string()))?;
        Ok(Self {
            http,
            url: endpoint::url(settings)?,
            headers: endpoint::headers(&key, settings.key_header)?,
            key,
            temperature: (settings.temperature >= 0.0).then_some(settings.temperature),
            max_tokens: settings.max_tokens,
            max_tokens_field: settings.max_tokens_field,
            timeout: settings.timeout(),
            answer_max_bytes: settings.answer_max_bytes,
            structured: AtomicBool::new(true),
            retry: CallRetryPolicy {
                attempts: settings.attempts,
                backoff: Duration::from_millis(settings.backoff_ms),
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
            permits: Semaphore::new(settings.concurrency.max(1)),
        })
    }

    /// Makes a call, with retries as the settings allow. Dropping the future cancels it.
    pub async fn call(&self, call: &Call<'_>) -> Result<Answer, CallError> {
        self.retry.run(|| self.attempt(call)).await
    }

    /// Returns the longest answer, in tokens.
    pub fn max_tokens(&self) -> u64 {
        self.max_tokens.into()
    }

    /// Returns whether the circuit breaker is open.
    pub fn is_suspended(&self) -> bool {
        self.breaker.is_open()
    }

    async fn attempt(&self, call: &Call<'_>) -> Result<Answer, Failure> {
        // Cannot fail, because the semaphore is never closed.
        let _permit = self.permits.acquire().await;
        let admission = self.breaker.admit().await.map_err(Failure::Open)?;
        let most = call.prompt_tokens + self.max_tokens();
        self.rate.take(most).await;
        let purpose = if call.schema.is_some() { "reason" } else { "describe" };
        let span = traces::model_call(call.model, purpose);
        let outcome = self.exchange(call).instrument(span.clone()).await;
        let tokens = outcome.as_ref().map(|a| (a.prompt_tokens, a.completion_tokens));
        traces::model_answered(&span, tokens.map_err(|failure| format!("{failure:?}")));
        match &outcome {
            Err(failure) if failure.is_the_servers() => admission.failed(),
            _ => admission.succeeded(),
        }
        if let Ok(answer) = &outcome {
            self.rate.settle(most, answer.prompt_tokens + answer.completion_tokens).await;
        }
        outcome
    }

    /// Sends one request, and a second one if the server turns out not to support `response_format`.
    async fn exchange(&self, call: &Call<'_>) -> Result<Answer, Failure> {
        let schema = call.schema.as_ref().filter(|_| self.structured.load(Ordering::Relaxed));
        match self.send(call, schema).await {
            Err(Failure::Unstructured(why)) => {
                tracing::info!(
                    why,
                    "the MLLM server does not support response_format; relying on the prompt"
                );
                self.structured.store(false, Ordering::Relaxed);
                self.send(call, None).await
            }
            outcome => outcome,
        }
    }

    async fn send(&self, call: &Call<'_>, schema: Option<&Schema>) -> Result<Answer, Failure> {
        let body = self.body(call, schema)?;
        let request = self.http.post(self.url.clone()).headers(self.headers.clone()).body(body);
        let began = Instant::now();
        let exchange = async {
            let response = request.send().await.map_err(|error| self.broken(error))?;
            if response.status().is_success() {
                self.read_answer(call, response, began).await
            } else {
                Err(self.read_error(response, schema.is_some()).await)
            }
        };
        tokio::time::timeout(self.timeout, exchange).await.unwrap_or_else(|_| {
            let why = format!("no answer within {} s (mllm.timeout_s)", self.timeout.as_secs());
            Err(Failure::Broken { why, retry_after: None })
        })
    }

    fn body(&self, call: &Call<'_>, schema: Option<&Schema>) -> Result<Vec<u8>, Failure> {
        let bound = |field| (self.max_tokens_field == field).then_some(self.max_tokens);
        serde_json::to_vec(&ChatRequest {
            model: call.model,
            messages: &call.messages,
            temperature: self.temperature,
            max_tokens: bound(MaxTokensField::MaxTokens),
            max_completion_tokens: bound(MaxTokensField::MaxCompletionTokens),
            response_format: schema.map(Into::into),
        })
        .map_err(|error| Failure::Refused(format!("the request cannot be written: {error}")))
    }

    async fn read_answer(
        &self,
        call: &Call<'_>,
        response: Response,
        began: Instant,
    ) -> Result<Answer, Failure> {
        let broken = |why: String| Failure::Broken { why, retry_after: None };
        let body = match self.read(response, self.answer_max_bytes).await? {
            (body, false) => body,
            // Permanent: a retry would cost the same and be no shorter.
            (_, true) => {
                return Err(Failure::Refused(format!(
                    "the answer is larger than {} bytes (mllm.answer_max_bytes)",
                    self.answer_max_bytes
                )));
            }
        };
        let answer: ChatAnswer = serde_json::from_slice(&body)
            .map_err(|error| broken(format!("the answer is not a chat completion: {error}")))?;
        Ok(answered(answer.into(), call.prompt_tokens, began.elapsed()))
    }

    async fn read_error(&self, response: Response, structured: bool) -> Failure {
        let status = response.status();
        let wait = response.headers().get(RETRY_AFTER).and_then(|value| value.to_str().ok());
        let retry_after = wait.and_then(|value| retry_after(value, Timestamp::now()));
        let body = self.read(response, ERROR_BODY_BYTES).await.map(|(body, _)| body);
        let message = self.quotable(&body.unwrap_or_default());
        let why = format!("the MLLM server answered {status}: {message}");
        match status {
            StatusCode::TOO_MANY_REQUESTS => Failure::Busy { why, retry_after },
            StatusCode::BAD_REQUEST | StatusCode::UNPROCESSABLE_ENTITY
                if structured && rejects_schema(&message) =>
            {
                Failure::Unstructured(why)
            }
            StatusCode::REQUEST_TIMEOUT => Failure::Broken { why, retry_after },
            status if status.is_server_error() => Failure::Broken { why, retry_after },
            _ => Failure::Refused(why),
        }
    }

    /// Reads at most `limit` bytes, and returns whether there were more.
    async fn read(&self, mut response: Response, limit: usize) -> Result<(Bytes, bool), Failure> {
        let mut body = BytesMut::new();
        while let Some(chunk) = response.chunk().await.map_err(|error| self.broken(error))? {
            let room = limit - body.len();
            body.extend_from_slice(&chunk[..chunk.len().min(room)]);
            if chunk.len() > room {
                return Ok((body.freeze(), true));
            }
        }
        Ok((body.freeze(), false))
    }

    /// Returns a server's error message fit for a log: short, on one line, without the key.
    fn quotable(&self, body: &[u8]) -> String {
        let message = serde_json::from_slice(body)
            .map(ErrorAnswer::message)
            .unwrap_or_else(|_| String::from_utf8_lossy(body).into_owned());
        let line: String = message.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        self.key.scrub(&line).chars().take(QUOTED_CHARS).collect()
    }

    fn broken(&self, error: reqwest::Error) -> Failure {
        // The URL may contain credentials. Of the chain of causes, only the last is informative.
        let error = error.without_url();
        let mut cause: &dyn std::error::Error = &error;
        while let Some(deeper) = cause.source() {
            cause = deeper;
        }
        let why = if cause.to_string() == error.to_string() {
            error.to_string()
        } else {
            format!("{error}: {cause}")
        };
        let why = self.key.scrub(&format!("the MLLM server cannot be reached: {why}"));
        Failure::Broken { why, retry_after: None }
    }
}

/// Converts a reply, and estimates the token counts if the server does not report them.
fn answered(reply: Reply, prompt_tokens: u64, took: Duration) -> Answer {
    let Reply { text, cut, usage } = reply;
    let estimate = estimate_tokens(&text);
    Answer {
        prompt_tokens: usage.map_or(prompt_tokens, |usage| usage.prompt_tokens),
        completion_tokens: usage.map_or(estimate, |usage| usage.completion_tokens),
        estimated: usage.is_none(),
        text,
        cut,
        took,
    }
}

/// Estimates the tokens of a text: about four bytes of English make one.
pub fn estimate_tokens(text: &str) -> u64 {
    text.len().div_ceil(4) as u64
}

/// Returns whether an error message is about the schema of the answer.
fn rejects_schema(message: &str) -> bool {
    let message = message.to_lowercase();
    ["response_format", "json_schema", "structured output"]
        .iter()
        .any(|name| message.contains(name))
}

#[cfg(test)]
mod tests {
    use super::super::settings::KeyHeader;
    use super::super::settings::tests::defaults;
    use super::*;
    use reqwest::header::AUTHORIZATION;

    #[test]
    fn azure_gets_its_version_in_the_query_and_its_key_in_an_api_key_header() {
        let settings = MllmSettings {
            base_url: "https://x.openai.azure.com/openai/deployments/gpt/".into(),
            api_version: "2024-10-21".into(),
            key_header: KeyHeader::ApiKey,
            api_key: Secret::new("azure-key"),
            ..defaults()
        };
        let client = MllmClient::new(&settings, TokenBuckets::default()).unwrap();
        assert_eq!(
            client.url.as_str(),
            "https://x.openai.azure.com/openai/deployments/gpt/chat/completions\
             ?api-version=2024-10-21"
        );
        assert_eq!(client.headers["api-key"], "azure-key");
        assert!(!client.headers.contains_key(AUTHORIZATION));
    }

    #[test]
    fn an_invalid_url_is_rejected() {
        for base_url in ["", "api.openai.com/v1", "ftp://host/v1"] {
            let settings = MllmSettings { base_url: base_url.into(), ..defaults() };
            assert!(matches!(
                MllmClient::new(&settings, TokenBuckets::default()),
                Err(MllmSettingsError::Url { .. })
            ));
        }
    }

    #[test]
    fn the_client_does_not_show_its_key() {
        let settings = MllmSettings { api_key: Secret::new("sk-shown"), ..defaults() };
        let client = MllmClient::new(&settings, TokenBuckets::default()).unwrap();
        assert!(!format!("{client:?}").contains("sk-shown"));
        assert_eq!(client.quotable(b"{\"error\":{\"message\":\"no sk-shown\"}}"), "no [hidden]");
        assert_eq!(client.quotable(b"{\"error\":\"model not found\"}"), "model not found");
        assert_eq!(client.quotable("x\n".repeat(1000).as_bytes()).len(), QUOTED_CHARS);
    }

    #[test]
    fn a_key_that_no_header_can_carry_is_rejected_without_showing_it() {
        let settings = MllmSettings { api_key: Secret::new("bad\nkey"), ..defaults() };
        let error = MllmClient::new(&settings, TokenBuckets::default()).unwrap_err();
        assert!(!format!("{error} {error:?}").contains("bad"));
    }

    #[test]
    fn tokens_are_estimated_if_the_server_does_not_count_them() {
        let reply = Reply { text: "abcdefgh".into(), ..Reply::default() };
        let answer = answered(reply, 50, Duration::ZERO);
        assert_eq!((answer.prompt_tokens, answer.completion_tokens), (50, 2));
        assert!(answer.estimated);
    }
}
