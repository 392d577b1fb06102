//! One request and its response over HTTP.

use std::borrow::Cow;
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use jiff::Timestamp;
use reqwest::Response;
use reqwest::header::{HeaderMap, LOCATION, RETRY_AFTER};

use super::capability::{Capabilities, Sent};
use super::client::{Answer, Call, MllmClient};
use super::error_body::error_message;
use super::failure::{Failure, FailureKind};
use super::response::{self, Reply, Unreadable};
use super::retry::{retry_after, retry_after_ms};
use super::settings::MaxTokensField;
use super::tokens::estimate;
use super::wire::{ChatRequest, Message, without_system};

/// How much of an error's body is read, in bytes, and how much of it is quoted, in characters.
const ERROR_BODY_BYTES: usize = 64 << 10;
const QUOTED_CHARS: usize = 300;

/// Token counts beyond these multiples of what was sent and asked for are not believed.
const ABSURD_PROMPT: u64 = 100;
const ABSURD_ANSWER: u64 = 16;

impl MllmClient {
    /// Sends one request in the form that the capabilities allow.
    pub(super) async fn send(
        &self,
        call: &Call<'_>,
        capabilities: &Capabilities,
        sent: Sent,
    ) -> Result<Answer, Failure> {
        let body = self.body(call, capabilities, sent)?;
        let request = self.http.post(self.url.clone()).headers(self.headers.clone()).body(body);
        let began = Instant::now();
        let exchange = async {
            let response = request.send().await.map_err(|error| {
                let failure = self.broken(error);
                // A server whose listen queue is full resets connections, or does not take them.
                let turned_away =
                    matches!(failure.kind, FailureKind::Connection | FailureKind::Refused);
                Failure { turned_away, ..failure }
            })?;
            if response.status().is_success() {
                let reply = self.read_answer(response).await?;
                Ok(answered(reply, sent, began.elapsed()))
            } else {
                Err(self.read_error(response).await)
            }
        };
        tokio::time::timeout(self.timeout, exchange).await.unwrap_or_else(|_| {
            let why = format!(
                "the MLLM server gave no answer within {} s (mllm.timeout_s)",
                self.timeout.as_secs()
            );
            Err(Failure::new(FailureKind::Timeout, why))
        })
    }

    fn body(
        &self,
        call: &Call<'_>,
        capabilities: &Capabilities,
        sent: Sent,
    ) -> Result<Vec<u8>, Failure> {
        let messages = match &call.shorter {
            Some(shorter) if sent.short => shorter,
            _ => &call.messages,
        };
        let messages: Cow<'_, [Message]> = match capabilities.system {
            true => Cow::Borrowed(messages.as_slice()),
            false => Cow::Owned(without_system(messages)),
        };
        let bound =
            |field| (capabilities.max_tokens_field == Some(field)).then_some(sent.answer_tokens);
        let request = ChatRequest {
            model: call.model,
            messages: &messages,
            temperature: capabilities.temperature.then_some(self.temperature),
            max_tokens: bound(MaxTokensField::MaxTokens),
            max_completion_tokens: bound(MaxTokensField::MaxCompletionTokens),
            response_format: call.labels.and_then(|labels| capabilities.format.of(labels)),
        };
        serde_json::to_vec(&request).map_err(|error| {
            Failure::new(FailureKind::LongAnswer, format!("the request cannot be written: {error}"))
        })
    }

    async fn read_answer(&self, response: Response) -> Result<Reply, Failure> {
        let (status, headers) = (response.status().as_u16(), response.headers().clone());
        let body = match self.read(response, self.answer_max_bytes).await? {
            (body, false) => body,
            // A retry would cost the same and be no shorter.
            (_, true) => {
                let why = format!(
                    "the answer is larger than {} bytes (mllm.answer_max_bytes)",
                    self.answer_max_bytes
                );
                return Err(Failure::new(FailureKind::LongAnswer, why));
            }
        };
        response::read(&body).map_err(|unreadable| match unreadable {
            Unreadable::NotChat(why) => {
                let why = format!(
                    "the MLLM server answered {status}, but the answer is not a chat completion: {}",
                    self.quotable(&why)
                );
                Failure { status: Some(status), ..Failure::new(FailureKind::NotChat, why) }
            }
            Unreadable::Error { status: inner, body, message } => {
                let wait = wait_asked_for(&headers);
                let mut failure =
                    Failure::of_response(inner, &body, &self.quotable(&message), wait);
                failure.why = format!("{} (an error inside of a {status})", failure.why);
                failure
            }
        })
    }

    async fn read_error(&self, response: Response) -> Failure {
        let status = response.status();
        let wait = wait_asked_for(response.headers());
        let location = response.headers().get(LOCATION).and_then(|value| value.to_str().ok());
        let location = location.map(|to| format!("a redirect to {to}"));
        let body = self.read(response, ERROR_BODY_BYTES).await.map(|(body, _)| body);
        let body = body.unwrap_or_default();
        let message = location.unwrap_or_else(|| error_message(&body));
        let message = match status.canonical_reason() {
            Some(reason) if message.trim().is_empty() => reason.to_owned(),
            _ => message,
        };
        let words = String::from_utf8_lossy(&body);
        Failure::of_response(Some(status.as_u16()), &words, &self.quotable(&message), wait)
    }

    /// Reads at most `limit` bytes, and returns whether there were more.
    pub(super) async fn read(
        &self,
        mut response: Response,
        limit: usize,
    ) -> Result<(Bytes, bool), Failure> {
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

    /// Returns a server's words fit for a log: short, on one line, without the key.
    pub(super) fn quotable(&self, message: &str) -> String {
        let line: String = message.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        self.key.scrub(line.trim()).chars().take(QUOTED_CHARS).collect()
    }

    fn broken(&self, error: reqwest::Error) -> Failure {
        // The URL may contain credentials. Of the chain of causes, only the last is informative.
        let error = error.without_url();
        let mut cause: &dyn std::error::Error = &error;
        let mut chain = error.to_string();
        while let Some(deeper) = cause.source() {
            cause = deeper;
            chain = format!("{chain}: {cause}");
        }
        let words = chain.to_lowercase();
        let says = |wanted: &[&str]| wanted.iter().any(|wanted| words.contains(wanted));
        let (kind, what) = if error.is_timeout() {
            (FailureKind::Timeout, "did not answer in time")
        } else if says(&["dns", "name resolution", "failed to lookup", "name or service"]) {
            (FailureKind::Name, "cannot be reached: its name has no address")
        } else if says(&[
            "certificate",
            "tls",
            "handshake",
            "corrupt message",
            "invalidcontenttype",
        ]) {
            (FailureKind::Tls, "cannot be reached: there is no trusted connection (TLS)")
        } else if says(&["refused"]) {
            (FailureKind::Refused, "cannot be reached: nothing listens there")
        } else if error.is_connect() {
            (FailureKind::Connection, "cannot be reached")
        } else {
            (FailureKind::Connection, "broke the connection")
        };
        let why = match cause.to_string() {
            last if last == error.to_string() => last,
            last => format!("{error}: {last}"),
        };
        Failure::new(kind, self.key.scrub(&format!("the MLLM server {what}: {why}")))
    }
}

/// Returns when the server wants to be asked again, by its most exact header.
fn wait_asked_for(headers: &HeaderMap) -> Option<Duration> {
    let text = |name: &str| headers.get(name).and_then(|value| value.to_str().ok());
    let exact = text("retry-after-ms").and_then(retry_after_ms);
    exact.or_else(|| retry_after(text(RETRY_AFTER.as_str())?, Timestamp::now()))
}

/// Converts a reply, and estimates the token counts that the server does not report, or not believably.
fn answered(reply: Reply, sent: Sent, took: Duration) -> Answer {
    let Reply { text, thinking, flaw, counted } = reply;
    let written = (estimate(&text) + estimate(&thinking)).max(1);
    let most_read = ABSURD_PROMPT * sent.prompt_tokens.max(1000);
    let most_written = ABSURD_ANSWER * u64::from(sent.answer_tokens).max(written);
    let prompt = counted.prompt.filter(|count| *count <= most_read);
    let completion = counted.completion.filter(|count| *count <= most_written);
    Answer {
        prompt_tokens: prompt.unwrap_or(sent.prompt_tokens.max(1)),
        completion_tokens: completion.unwrap_or(written),
        estimated: prompt.is_none() || completion.is_none(),
        text,
        thinking,
        flaw,
        took,
    }
}

#[cfg(test)]
mod tests {
    use super::super::tokens::Counted;
    use super::*;

    const SENT: Sent = Sent {
        structured: false,
        prompt_tokens: 50,
        answer_tokens: 100,
        short: false,
        can_be_shorter: false,
    };

    fn counted(prompt: Option<u64>, completion: Option<u64>) -> (u64, u64, bool) {
        let counted = Counted { prompt, completion };
        let reply = Reply { text: "abcdefgh".into(), counted, ..Reply::default() };
        let answer = answered(reply, SENT, Duration::ZERO);
        (answer.prompt_tokens, answer.completion_tokens, answer.estimated)
    }

    #[test]
    fn tokens_are_estimated_if_the_server_does_not_count_them_believably() {
        assert_eq!(counted(Some(70), Some(3)), (70, 3, false));
        assert_eq!(counted(None, None), (50, 2, true));
        assert_eq!(counted(Some(70), None), (70, 2, true));
        assert_eq!(counted(Some(4_000_000), Some(900_000)), (50, 2, true));
    }
}
