//! The forms of one request: simpler ones are sent while it is refused, and the one that is accepted is kept.

use std::sync::atomic::Ordering;

use super::capability::{Capabilities, NextTry, Sent};
use super::client::{Answer, Call, MllmClient};
use super::failure::{Failure, FailureKind};
use super::settings::MaxTokensField;
use super::tokens::estimate;

/// The most forms of one request that are tried.
const MAX_FORMS: usize = 5;

impl MllmClient {
    /// Sends a request, and simpler ones while it is refused.
    pub(super) async fn exchange(&self, call: &Call<'_>) -> Result<Answer, Failure> {
        let known = self.capabilities();
        let (mut capabilities, mut first) = (known, None);
        let room = known.prompt_room().filter(|room| *room < call.prompt_tokens);
        let mut short = room.is_some() && call.shorter.is_some();
        for _ in 0..MAX_FORMS {
            let sent = self.sent(call, &capabilities, short);
            let failure = match self.send(call, &capabilities, sent).await {
                Ok(answer) => {
                    if first.is_some() {
                        self.accepted(capabilities, sent);
                    }
                    return Ok(answer);
                }
                Err(failure) => failure,
            };
            let next = match failure.kind {
                // Not the form is the reason.
                _ if failure.turned_away => return Err(failure),
                FailureKind::Request => capabilities.after(&failure.why, sent, false),
                FailureKind::Server => self.after_fault(&capabilities, &failure, sent),
                // A server that has answered other calls may refuse the format of an answer in this way.
                FailureKind::NotFound | FailureKind::Key
                    if sent.structured
                        && matches!(failure.status, Some(403 | 404))
                        && self.is_proven.load(Ordering::Relaxed) =>
                {
                    let plainest = capabilities.plainest();
                    (plainest != capabilities)
                        .then_some(NextTry { capabilities: plainest, short: sent.short })
                }
                // Not the refusal that this began with, but as good a reason to end.
                _ => return Err(failure),
            };
            first.get_or_insert(failure);
            let Some(next) = next else { break };
            (capabilities, short) = (next.capabilities, next.short);
        }
        let none = || Failure::new(FailureKind::Request, "no request was made".to_owned());
        Err(first.unwrap_or_else(none))
    }

    /// Some servers fail where they should refuse: on a format of the answer that they cannot compile.
    fn after_fault(
        &self,
        capabilities: &Capabilities,
        failure: &Failure,
        sent: Sent,
    ) -> Option<NextTry> {
        if !matches!(failure.status, Some(500 | 501) | None) {
            return None;
        }
        let named = capabilities.after(&failure.why, sent, true);
        let plainest = capabilities.plainest();
        let plain = || NextTry { capabilities: plainest, short: sent.short };
        named.or_else(|| {
            let is_first = sent.structured && !self.tried_plain.swap(true, Ordering::Relaxed);
            (is_first && plainest != *capabilities).then(plain)
        })
    }

    /// Keeps the form in which a request was accepted after it had been refused.
    fn accepted(&self, mut form: Capabilities, sent: Sent) {
        if sent.short && form.context.is_none() {
            form.learn_context(sent.prompt_tokens, sent.answer_tokens);
        }
        tracing::info!(
            format = form.format.as_str(),
            temperature = form.temperature,
            max_tokens_field = form.max_tokens_field.map(MaxTokensField::as_str),
            system_message = form.system,
            context = form.context,
            "the MLLM server refused a request, and accepts it in this form"
        );
        self.revise(|known| {
            if known.left_out_by(&form) > 1 {
                self.wants_check.store(true, Ordering::Relaxed);
            }
            *known = Capabilities {
                two_pictures: known.two_pictures,
                slots: known.slots,
                checked_at: known.checked_at,
                ..form
            };
        });
    }

    pub(super) fn sent(&self, call: &Call<'_>, capabilities: &Capabilities, short: bool) -> Sent {
        let prompt_tokens = match &call.shorter {
            Some(shorter) if short => shorter.iter().map(|m| estimate(&m.text())).sum(),
            _ => call.prompt_tokens,
        };
        Sent {
            structured: call.labels.is_some_and(|labels| capabilities.format.of(labels).is_some()),
            prompt_tokens,
            answer_tokens: capabilities.fit(call.max_tokens, prompt_tokens),
            short,
            can_be_shorter: call.shorter.is_some(),
        }
    }
}
