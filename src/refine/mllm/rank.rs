//! One call over all descriptions, and one more if its answer cannot be used.

use std::time::Duration;

use super::MllmRefiner;
use super::client::{Answer, Call, estimate_tokens};
use super::describe::{Described, Work, cost_of};
use super::prompts::{self, Notes, clean};
use super::reason::{AnswerError, Labels, Verdict};
use super::retry::CallError;
use super::wire::Message;
use whereabouts_core::Digest;
use whereabouts_store::Step;

/// An order of the candidates, and how long the call took which gave it.
pub(super) struct Ranked {
    pub verdict: Verdict,
    pub took: Duration,
}

impl MllmRefiner {
    /// Orders the described candidates by what was written about them.
    pub(super) async fn rank(
        &self,
        work: &Work<'_>,
        described: &[Described],
    ) -> Result<Ranked, CallError> {
        let candidates = described.iter().map(|described| described.index).collect();
        let job = work.record.job.id;
        let labels = Labels::new(candidates, self.settings.hide_coarse_rank.then_some(job));
        let mut talk = vec![Message::user(self.reasoning_prompt(work, described, &labels))];
        let first = self.ask(work, &labels, &talk).await?;
        let (verdict, took) = match read(&labels, &first) {
            Ok(verdict) => (verdict, first.took),
            Err(why) => {
                tracing::info!(%job, why, "the reasoning model is asked to repair its answer");
                let names: Vec<&str> = labels.iter().map(|(label, _)| label).collect();
                talk.push(Message::assistant(self.quoted(&first)));
                talk.push(Message::user(prompts::repair(&why, &names)));
                let second = self.ask(work, &labels, &talk).await?;
                let verdict = read(&labels, &second).map_err(|why| {
                    CallError::Permanent(format!(
                        "the reasoning model gave no ranking twice: {why}"
                    ))
                })?;
                (verdict, second.took)
            }
        };
        let reasoning = self.explained(work, &labels, &verdict.reasoning);
        Ok(Ranked { verdict: Verdict { reasoning, ..verdict }, took })
    }

    fn reasoning_prompt(
        &self,
        work: &Work<'_>,
        described: &[Described],
        labels: &Labels,
    ) -> String {
        let text_of = |candidate: usize| {
            described.iter().find(|described| described.index == candidate).map(|d| d.text.as_str())
        };
        // Bounded anew: what is stored may be older than the bound.
        let notes: Vec<(&str, String)> = labels
            .iter()
            .map(|(label, candidate)| {
                let text = text_of(candidate).unwrap_or_default();
                (label, clean(text, self.settings.description_max_chars))
            })
            .collect();
        let notes: Vec<Notes<'_>> =
            notes.iter().map(|(label, text)| Notes { label, text }).collect();
        // The id of the job holds random bits that no describing model was told.
        let boundary = Digest::of(format!("boundary {}", work.record.job.id).as_bytes()).hex();
        prompts::reason(work.scene, &notes, &boundary[..16])
    }

    async fn ask(
        &self,
        work: &Work<'_>,
        labels: &Labels,
        talk: &[Message],
    ) -> Result<Answer, CallError> {
        let call = Call {
            model: &self.settings.reason_model,
            prompt_tokens: talk.iter().map(|message| estimate_tokens(message.text())).sum(),
            messages: talk.to_vec(),
            schema: Some(labels.schema()),
        };
        let answer = self.call(work, &call).await?;
        let usage = cost_of(&answer);
        self.keep(work, usage, None).await;
        work.progress.step(Step { usage, description: None }).await;
        Ok(answer)
    }

    /// An unusable answer as it is shown to the model again. Servers refuse an empty message.
    fn quoted(&self, answer: &Answer) -> String {
        let text = clean(&answer.text, self.settings.description_max_chars);
        if text.is_empty() { "(nothing)".to_owned() } else { text }
    }

    /// The reasoning, and which image each label means: the labels are known to nobody else.
    fn explained(&self, work: &Work<'_>, labels: &Labels, reasoning: &str) -> String {
        let reasoning = clean(reasoning, self.settings.description_max_chars);
        let legend: Vec<String> = labels
            .iter()
            .map(|(label, index)| format!("{label} = {}", work.record.candidates[index].image_id))
            .collect();
        format!("{reasoning}\n\n({})", legend.join(", ")).trim_start().to_owned()
    }
}

fn read(labels: &Labels, answer: &Answer) -> Result<Verdict, String> {
    labels.read(&answer.text).map_err(|error: AnswerError| match &answer.cut {
        Some(cut) => format!("{error} ({cut})"),
        None => error.to_string(),
    })
}
