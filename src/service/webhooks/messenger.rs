//! One attempt to deliver a message: the POST request and its outcome. Retries are for `dispatcher`.

use std::time::Duration;

use jiff::Timestamp;
use reqwest::header::{CONTENT_TYPE, RETRY_AFTER};
use reqwest::{Client, Response, StatusCode, Url, redirect, retry};
use uuid::Uuid;

use super::WebhookSettings;
use super::address::{PublicOnly, check};
use super::signature::sign;
use whereabouts_core::StoredWebhook;
use whereabouts_refine::mllm::retry_after as parse_retry_after;

const USER_AGENT: &str = concat!("whereabouts/", env!("CARGO_PKG_VERSION"));

/// How much of a response body is read, in bytes, and for how long. The body is discarded; it is read so that the
/// receiver can finish its response.
const DRAINED_BYTES: usize = 16 << 10;
const DRAIN_TIMEOUT: Duration = Duration::from_secs(1);

/// The outcome of an attempt.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Reply {
    /// The receiver accepted the message.
    Accepted(StatusCode),
    /// The receiver wants no more messages (410 Gone).
    Gone,
    /// The message was not accepted.
    Failed {
        /// The status of the response, if there was one.
        status: Option<StatusCode>,
        /// What went wrong.
        why: String,
        /// The pause that the receiver asks for.
        retry_after: Option<Duration>,
    },
}

impl Reply {
    fn failed(why: impl Into<String>) -> Self {
        Self::Failed { status: None, why: why.into(), retry_after: None }
    }
}

/// The HTTP client that posts messages.
pub(super) struct Messenger {
    /// The client, or why there is none; a server without webhooks works without one.
    http: Result<Client, String>,
    timeout: Duration,
    allow_private: bool,
}

impl Messenger {
    pub fn new(settings: &WebhookSettings) -> Self {
        // reqwest panics without a provider. Fails if the process has chosen one already, which is fine.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let allow_private = settings.allow_private;
        let http = Client::builder()
            .user_agent(USER_AGENT)
            .dns_resolver(PublicOnly { allow_private })
            // A redirect could lead to a non-public address, and so could a proxy, which resolves names itself.
            .redirect(redirect::Policy::none())
            .no_proxy()
            // Each attempt is recorded.
            .retry(retry::never())
            // Messages to one webhook are rare; each one resolves and checks the address again.
            .pool_max_idle_per_host(0)
            .build()
            .map_err(|error| {
                format!(
                    "no message can be sent from this machine: {}; install CA certificates and restart \
                     the server",
                    describe(error)
                )
            });
        Self { http, timeout: settings.timeout(), allow_private }
    }

    /// Posts a message once.
    pub async fn post(&self, to: &StoredWebhook, id: Uuid, body: Vec<u8>) -> Reply {
        let Ok(url) = Url::parse(&to.webhook.url) else {
            return Reply::failed("the url cannot be parsed; create the webhook again");
        };
        // The settings may have changed since the webhook was created, and an address in the URL is not resolved.
        if let Err(why) = check(&url, self.allow_private) {
            return Reply::failed(why);
        }
        let http = match &self.http {
            Ok(http) => http,
            Err(why) => return Reply::failed(why),
        };
        let (id, now) = (id.to_string(), Timestamp::now());
        let request = http
            .post(url)
            .header(CONTENT_TYPE, "application/json")
            .header("webhook-id", &id)
            .header("webhook-timestamp", now.as_second())
            .header("webhook-signature", sign(&to.secret, &id, now, &body))
            .body(body);
        match tokio::time::timeout(self.timeout, request.send()).await {
            Ok(Ok(response)) => {
                let reply = outcome(&response);
                drain(response).await;
                reply
            }
            Ok(Err(error)) => Reply::failed(describe(error)),
            Err(_) => Reply::failed(format!(
                "no response within {} s (webhooks.timeout_s)",
                self.timeout.as_secs()
            )),
        }
    }
}

fn outcome(response: &Response) -> Reply {
    let status = response.status();
    match status {
        _ if status.is_success() => Reply::Accepted(status),
        StatusCode::GONE => Reply::Gone,
        _ => {
            let advice = if status.is_redirection() {
                "; redirects are not followed: create a webhook with the url that it leads to"
            } else {
                ""
            };
            let retry_after = match status {
                StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE => response
                    .headers()
                    .get(RETRY_AFTER)
                    .and_then(|value| parse_retry_after(value.to_str().ok()?, Timestamp::now())),
                _ => None,
            };
            Reply::Failed {
                status: Some(status),
                why: format!("the response was {status}{advice}"),
                retry_after,
            }
        }
    }
}

async fn drain(mut response: Response) {
    let reading = async {
        let mut left = DRAINED_BYTES;
        while let Ok(Some(chunk)) = response.chunk().await {
            match left.checked_sub(chunk.len()) {
                Some(rest) => left = rest,
                None => break,
            }
        }
    };
    // Errors do not matter: the status has decided the outcome.
    let _ = tokio::time::timeout(DRAIN_TIMEOUT, reading).await;
}

/// Describes an error with its root cause. The URL is left out, because it may contain credentials.
fn describe(error: reqwest::Error) -> String {
    let error = error.without_url();
    let mut cause: &dyn std::error::Error = &error;
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    match cause.to_string() == error.to_string() {
        true => error.to_string(),
        false => format!("{error}: {cause}"),
    }
}
