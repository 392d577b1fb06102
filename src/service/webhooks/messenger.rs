//! One attempt: the message as it is posted, and what came of it.

use std::time::Duration;

use jiff::Timestamp;
use reqwest::header::{CONTENT_TYPE, RETRY_AFTER};
use reqwest::{Client, Response, StatusCode, Url, redirect, retry};
use uuid::Uuid;

use super::WebhookSettings;
use super::address::{PublicOnly, check};
use super::signature::sign;
use whereabouts_core::StoredWebhook;
use whereabouts_refine::mllm::retry_after;

const USER_AGENT: &str = concat!("whereabouts/", env!("CARGO_PKG_VERSION"));

/// What is read of an answer's body, in bytes, and for how long. Nobody looks at it: it is read so that
/// the other end sees its answer taken.
const ANSWER_BYTES: usize = 16 << 10;
const ANSWER_PATIENCE: Duration = Duration::from_secs(1);

/// What came of an attempt.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Reply {
    /// The other end took the message.
    Taken(StatusCode),
    /// It wants no message any more.
    Gone,
    /// It did not take it this time.
    Failed {
        /// Its answer, if there was one.
        status: Option<StatusCode>,
        /// What went wrong.
        why: String,
        /// When it wants to be asked again.
        retry_after: Option<Duration>,
    },
}

impl Reply {
    fn failed(why: impl Into<String>) -> Self {
        Self::Failed { status: None, why: why.into(), retry_after: None }
    }
}

/// Posts messages.
pub(super) struct Messenger {
    /// Or why there is none; a server that has no webhook can do without.
    http: Result<Client, String>,
    timeout: Duration,
    allow_private: bool,
}

impl Messenger {
    pub fn new(settings: &WebhookSettings) -> Self {
        // reqwest panics without one. Only the first call sets it; a library user may have chosen
        // another.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let allow_private = settings.allow_private;
        let http = Client::builder()
            .user_agent(USER_AGENT)
            .dns_resolver(PublicOnly { allow_private })
            // A redirect could lead to where the message must not go, and so could a proxy, which looks
            // names up by itself.
            .redirect(redirect::Policy::none())
            .no_proxy()
            // Each try is noted.
            .retry(retry::never())
            // Messages to one webhook are rare; each looks its address up anew.
            .pool_max_idle_per_host(0)
            .build()
            .map_err(|error| {
                format!(
                    "no message can be sent from this machine: {}; see to it that it has CA \
                     certificates, and start the server again",
                    cause(error)
                )
            });
        Self { http, timeout: settings.timeout(), allow_private }
    }

    /// Posts a message.
    pub async fn post(&self, to: &StoredWebhook, id: Uuid, body: Vec<u8>) -> Reply {
        let Ok(url) = Url::parse(&to.webhook.url) else {
            return Reply::failed("the url cannot be read; make the webhook anew");
        };
        // The settings may be others than when the webhook was made, and an address that stands in the
        // URL is not looked up.
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
                let reply = judge(&response);
                hear_out(response).await;
                reply
            }
            Ok(Err(error)) => Reply::failed(cause(error)),
            Err(_) => Reply::failed(format!(
                "no answer within {} s (webhooks.timeout_s)",
                self.timeout.as_secs()
            )),
        }
    }
}

fn judge(response: &Response) -> Reply {
    let status = response.status();
    match status {
        _ if status.is_success() => Reply::Taken(status),
        StatusCode::GONE => Reply::Gone,
        _ => {
            let advice = if status.is_redirection() {
                "; redirects are not followed: make a webhook with the url it leads to"
            } else {
                ""
            };
            let patience = match status {
                StatusCode::TOO_MANY_REQUESTS | StatusCode::SERVICE_UNAVAILABLE => response
                    .headers()
                    .get(RETRY_AFTER)
                    .and_then(|value| retry_after(value.to_str().ok()?, Timestamp::now())),
                _ => None,
            };
            Reply::Failed {
                status: Some(status),
                why: format!("the answer was {status}{advice}"),
                retry_after: patience,
            }
        }
    }
}

async fn hear_out(mut response: Response) {
    let reading = async {
        let mut left = ANSWER_BYTES;
        while let Ok(Some(chunk)) = response.chunk().await {
            match left.checked_sub(chunk.len()) {
                Some(rest) => left = rest,
                None => break,
            }
        }
    };
    // Whatever comes of it: the status has said what counts.
    let _ = tokio::time::timeout(ANSWER_PATIENCE, reading).await;
}

/// What went wrong. The URL, which may hold credentials, is left out, and of the chain of causes only the
/// end is news.
fn cause(error: reqwest::Error) -> String {
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
