//! The reasoning call over all descriptions, and one repair call if its answer cannot be used.

use std::time::Duration;

use whereabouts_core::{Certainty, Digest};
use whereabouts_store::Step;

use super::MllmRefiner;
use super::client::{Answer, Call};
use super::describe::DescribedPair;
use super::labels::{Labels, Verdict};
use super::prompts::{self, Notes, Prompt, clean};
use super::response::Flaw;
use super::retry::CallError;
use super::run::RefineRun;
use super::spend::cost_of;
use super::tokens::estimate;
use super::wire::Message;

/// The size of a prompt in fewer words, in tokens. With an answer, it fits into a context of 4,096.
const SHORT_PROMPT: u64 = 2600;

/// The least that is left of a description, in characters.
const LEAST_NOTES: usize = 160;

/// Characters of a token, at least, in what models write in English.
const CHARS_PER_TOKEN: u64 = 3;

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
        let mut call = self.reasoning_call(run, described, &labels);
        let first = self.ask(run, &call).await?;
        let (why, partial) = match parse(&labels, &first) {
            Ok(verdict) if verdict.left_out == 0 => {
                return Ok(self.ranked(run, &labels, verdict, first.took));
            }
            Ok(verdict) => {
                let why = format!("its ranking leaves out {} of the labels", verdict.left_out);
                (why, Some((verdict, first.took)))
            }
            Err(why) => (why, None),
        };
        tracing::info!(%job, why, "asking the reasoning model to repair its answer");
        let again = [
            Message::assistant(self.quoted(&first)),
            Message::user(prompts::repair(&why, labels.names())),
        ];
        call.prompt_tokens += again.iter().map(|message| estimate(&message.text())).sum::<u64>();
        call.messages.extend(again.clone());
        if let Some(shorter) = &mut call.shorter {
            shorter.extend(again);
        }
        // The first answer may have been cut off, or its thinking may have left no room for it.
        call.max_tokens = call.max_tokens.saturating_mul(2);
        let second = match (self.ask(run, &call).await, &partial) {
            (Ok(second), _) => second,
            (Err(error), None) => return Err(error),
            (Err(error), Some((verdict, took))) => {
                tracing::info!(%job, %error, "the answer could not be repaired");
                return Ok(self.ranked(run, &labels, verdict.clone(), *took));
            }
        };
        match (parse(&labels, &second), partial) {
            (Ok(verdict), Some((first, took))) if first.left_out < verdict.left_out => {
                Ok(self.ranked(run, &labels, first, took))
            }
            (Ok(verdict), _) => Ok(self.ranked(run, &labels, verdict, second.took)),
            (Err(_), Some((verdict, took))) => Ok(self.ranked(run, &labels, verdict, took)),
            (Err(why), None) => Err(CallError::NoAnswer(format!(
                "the reasoning model gave no ranking twice: {why}"
            ))),
        }
    }

    fn reasoning_call<'a>(
        &'a self,
        run: &RefineRun<'_>,
        described: &[DescribedPair],
        labels: &'a Labels,
    ) -> Call<'a> {
        let most = self.settings.description_max_chars;
        let mut prompt = self.reasoning_prompt(run, described, labels, most);
        if let Some(room) = self.reasoner.capabilities().prompt_room()
            && size(&prompt) > room
        {
            prompt = self.fitting(run, described, labels, room);
        }
        let prompt_tokens = size(&prompt);
        let shorter = (prompt_tokens > SHORT_PROMPT)
            .then(|| messages(self.fitting(run, described, labels, SHORT_PROMPT)));
        Call {
            model: &self.settings.reason_model,
            messages: messages(prompt),
            shorter,
            labels: Some(labels.names()),
            prompt_tokens,
            max_tokens: self.reasoner.max_tokens(),
        }
    }

    /// Returns the prompt with descriptions cut so that it fits.
    fn fitting(
        &self,
        run: &RefineRun<'_>,
        described: &[DescribedPair],
        labels: &Labels,
        room: u64,
    ) -> Prompt {
        let rules = size(&self.reasoning_prompt(run, described, labels, 0));
        let left = room.saturating_sub(rules) / described.len().max(1) as u64;
        let chars = usize::try_from(left * CHARS_PER_TOKEN).unwrap_or(usize::MAX).max(LEAST_NOTES);
        let most = chars.min(self.settings.description_max_chars);
        self.reasoning_prompt(run, described, labels, most)
    }

    /// Returns the prompt with descriptions of at most that many characters.
    fn reasoning_prompt(
        &self,
        run: &RefineRun<'_>,
        described: &[DescribedPair],
        labels: &Labels,
        most: usize,
    ) -> Prompt {
        let text_of = |candidate: usize| {
            described.iter().find(|described| described.index == candidate).map(|d| d.text.as_str())
        };
        // Bounded again, because cached descriptions may be older than the bound.
        let notes: Vec<(&str, String)> = labels
            .iter()
            .map(|(label, candidate)| (label, clean(text_of(candidate).unwrap_or_default(), most)))
            .collect();
        let notes: Vec<Notes<'_>> =
            notes.iter().map(|(label, text)| Notes { label, text }).collect();
        // Derived from the random bits of the job's id, which the describing model has not seen.
        let boundary = Digest::of(format!("boundary {}", run.input.id).as_bytes()).hex();
        prompts::reason(run.input.map.scene, &notes, &boundary[..16])
    }

    async fn ask(&self, run: &RefineRun<'_>, call: &Call<'_>) -> Result<Answer, CallError> {
        let answer = self.paid_call(run, &self.reasoner, call).await?;
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

    /// Appends to the reasoning how certain the model is and which image each label stands for, because readers see
    /// neither elsewhere.
    fn ranked(
        &self,
        run: &RefineRun<'_>,
        labels: &Labels,
        verdict: Verdict,
        took: Duration,
    ) -> ModelRanking {
        let reasoning = clean(&verdict.reasoning, self.settings.description_max_chars);
        let certainty = match verdict.certainty {
            Some(Certainty::Certain) => "\n\nThe model is certain of its first candidate.",
            Some(Certainty::Likely) => "\n\nThe model takes its first candidate for likely.",
            Some(Certainty::Unsure) => "\n\nThe model is unsure of its first candidate.",
            Some(Certainty::None) => {
                "\n\nThe model thinks that none of the candidates shows the place."
            }
            None => "",
        };
        let legend: Vec<String> = labels
            .iter()
            .map(|(label, index)| format!("{label} = {}", run.input.candidates[index].image_id))
            .collect();
        let reasoning = format!("{reasoning}{certainty}\n\n({})", legend.join(", "));
        let reasoning = reasoning.trim_start().to_owned();
        ModelRanking { verdict: Verdict { reasoning, ..verdict }, took }
    }
}

fn messages(prompt: Prompt) -> Vec<Message> {
    vec![Message::system(prompt.system), Message::user(prompt.user)]
}

fn size(prompt: &Prompt) -> u64 {
    estimate(&prompt.system) + estimate(&prompt.user)
}

fn parse(labels: &Labels, answer: &Answer) -> Result<Verdict, String> {
    match &answer.flaw {
        Some(flaw @ (Flaw::Filtered | Flaw::Refused(_))) => return Err(flaw.to_string()),
        Some(Flaw::Cut) | None => {}
    }
    let cut = answer.flaw == Some(Flaw::Cut);
    labels.parse(&answer.text, cut).map_err(|error| match &answer.flaw {
        Some(flaw) => format!("{error} ({flaw})"),
        None => error.to_string(),
    })
}
