//! The reasoning call over all descriptions, and one repair call if its answer cannot be used.

use std::time::Duration;

use whereabouts_core::Digest;
use whereabouts_store::Step;

use super::MllmRefiner;
use super::client::{Answer, Call, estimate_tokens};
use super::describe::DescribedPair;
use super::prompts::{self, Notes, clean};
use super::reason::{AnswerError, Labels, Verdict};
use super::retry::CallError;
use super::run::RefineRun;
use super::spend::cost_of;
use super::wire::Message;

/// The model's order of the candidates, and the duration of the call that gave it.
pub(super) struct ModelRanking {
    pub verdict: Verdict,
    pub took: Duration,
}

impl MllmRefiner {
    /// Has the reasoning model rank the described candidates.
    pub(super) async fn rank(
        &self,
        run: &RefineRun<'_>,
        described: &[DescribedPair],
    ) -> Result<ModelRanking, CallError> {
        let candidates = described.iter().map(|described| described.index).collect();
        let job = run.input.id;
        let labels = Labels::new(candidates, self.settings.hide_coarse_rank.then_some(job));
        let mut conversation = vec![Message::user(self.reasoning_prompt(run, described, &labels))];
        let first = self.ask(run, &labels, &conversation).await?;
        let (verdict, took) = match parse(&labels, &first) {
            Ok(verdict) => (verdict, first.took),
            Err(why) => {
                tracing::info!(%job, why, "asking the reasoning model to repair its answer");
                let names: Vec<&str> = labels.iter().map(|(label, _)| label).collect();
                conversation.push(Message::assistant(self.quoted(&first)));
                conversation.push(Message::user(prompts::repair(&why, &names)));
                let second = self.ask(run, &labels, &conversation).await?;
                let verdict = parse(&labels, &second).map_err(|why| {
                    CallError::Permanent(format!(
                        "the reasoning model gave no ranking twice: {why}"
                    ))
                })?;
                (verdict, second.took)
            }
        };
        let reasoning = self.explained(run, &labels, &verdict.reasoning);
        Ok(ModelRanking { verdict: Verdict { reasoning, ..verdict }, took })
    }

    fn reasoning_prompt(
        &self,
        run: &RefineRun<'_>,
        described: &[DescribedPair],
        labels: &Labels,
    ) -> String {
        let text_of = |candidate: usize| {
            described.iter().find(|described| described.index == candidate).map(|d| d.text.as_str())
        };
        // Bounded again, because cached descriptions may be older than the bound.
        let notes: Vec<(&str, String)> = labels
            .iter()
            .map(|(label, candidate)| {
                let text = text_of(candidate).unwrap_or_default();
                (label, clean(text, self.settings.description_max_chars))
            })
            .collect();
        let notes: Vec<Notes<'_>> =
            notes.iter().map(|(label, text)| Notes { label, text }).collect();
        // Derived from the random bits of the job's id, which the describing model has not seen.
        let boundary = Digest::of(format!("boundary {}", run.input.id).as_bytes()).hex();
        prompts::reason(run.input.map.scene, &notes, &boundary[..16])
    }

    async fn ask(
        &self,
        run: &RefineRun<'_>,
        labels: &Labels,
        conversation: &[Message],
    ) -> Result<Answer, CallError> {
        let call = Call {
            model: &self.settings.reason_model,
            prompt_tokens: conversation.iter().map(|message| estimate_tokens(message.text())).sum(),
            messages: conversation.to_vec(),
            schema: Some(labels.schema()),
        };
        let answer = self.paid_call(run, &call).await?;
        let usage = cost_of(&answer);
        self.record_spend(run, usage, None).await;
        run.progress.step(Step { usage, description: None }).await;
        Ok(answer)
    }

    /// Returns an unusable answer as the model is shown it again. Servers reject an empty message.
    fn quoted(&self, answer: &Answer) -> String {
        let text = clean(&answer.text, self.settings.description_max_chars);
        if text.is_empty() { "(nothing)".to_owned() } else { text }
    }

    /// Appends to the reasoning which image each label stands for, because readers see no labels elsewhere.
    fn explained(&self, run: &RefineRun<'_>, labels: &Labels, reasoning: &str) -> String {
        let reasoning = clean(reasoning, self.settings.description_max_chars);
        let legend: Vec<String> = labels
            .iter()
            .map(|(label, index)| format!("{label} = {}", run.input.candidates[index].image_id))
            .collect();
        format!("{reasoning}\n\n({})", legend.join(", ")).trim_start().to_owned()
    }
}

fn parse(labels: &Labels, answer: &Answer) -> Result<Verdict, String> {
    labels.parse(&answer.text).map_err(|error: AnswerError| match &answer.cut {
        Some(cut) => format!("{error} ({cut})"),
        None => error.to_string(),
    })
}
