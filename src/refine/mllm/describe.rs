//! One description for each pair: cached, in flight, or bought.

use std::time::Duration;

use futures_util::{StreamExt, stream};
use jiff::Timestamp;
use whereabouts_core::{
    CachedDescription, Candidate, DescribedFrame, Description, DescriptionSubject, Digest, ImageId,
    Scene, SimilarFrame, StandIn, Usage,
};
use whereabouts_store::Step;

use super::buy_once::FoundDescription;
use super::client::{Answer, Call};
use super::gate::WantedCall;
use super::judge;
use super::pictures::{PictureError, SentPicture};
use super::prompts::{self, PROMPT_VERSION, Prompt, Switches};
use super::retry::CallError;
use super::run::RefineRun;
use super::spend::cost_of;
use super::tokens::estimate;
use super::wire::{Message, Part};
use super::{MllmRefiner, RefineError};
use crate::{RefineInput, milliseconds};

/// The frame and a candidate that is still in the map.
pub(super) struct Pair {
    /// The candidate's index among the candidates.
    index: usize,
    /// The digest of the candidate's picture.
    digest: Digest,
    /// The cache key of the pair's description.
    key: Digest,
}

/// A described pair.
pub(super) struct DescribedPair {
    /// The candidate's index among the candidates.
    pub index: usize,
    /// The description.
    pub text: String,
    cached: bool,
    stands_in: Option<StandIn>,
    /// Duration of the call, if this job made it.
    took: Option<Duration>,
    /// The cost to this job.
    usage: Usage,
}

impl DescribedPair {
    /// Whether this job bought the description.
    pub fn is_bought(&self) -> bool {
        !self.cached
    }

    /// Returns the description as jobs report it.
    pub fn description(&self, candidates: &[Candidate]) -> Description {
        Description {
            image_id: candidates[self.index].image_id.clone(),
            text: self.text.clone(),
            cached: self.cached,
            stands_in: self.stands_in,
            took_ms: self.took.map(milliseconds),
            usage: self.usage,
        }
    }
}

/// Which pairs were described and which failed; both in coarse order.
#[derive(Default)]
pub(super) struct DescribedPairs {
    pub described: Vec<DescribedPair>,
    pub failed: Vec<UndescribedPair>,
}

/// A pair without a description.
pub(super) struct UndescribedPair {
    /// The candidate's index among the candidates.
    pub index: usize,
    /// Why there is none.
    pub why: CallError,
}

impl MllmRefiner {
    /// Returns the pairs whose candidates are still in the map, in coarse order.
    pub(super) async fn pairs(&self, input: &RefineInput) -> Result<Vec<Pair>, RefineError> {
        let ids: Vec<ImageId> =
            input.candidates.iter().map(|candidate| candidate.image_id.clone()).collect();
        let images = self.maps.images_by_id(&input.map, &ids).await?;
        let present = images.into_iter().enumerate().filter_map(|(index, image)| {
            let digest = image?.digest;
            let key = self.key(&input.frame.digest, &digest, input.map.scene);
            Some(Pair { index, digest, key })
        });
        Ok(present.collect())
    }

    /// Returns earlier frames whose descriptions may stand in for those of this frame.
    pub(super) async fn similar_frames(
        &self,
        input: &RefineInput,
    ) -> Result<Vec<SimilarFrame>, RefineError> {
        let at_least = self.settings.similar_frame_min;
        match &input.frame.descriptor {
            Some(descriptor) if at_least > 0.0 => {
                Ok(self.cache.similar_frames(input.map.uid, descriptor, at_least).await?)
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Describes all pairs side by side; the gate to the server says how many at a time.
    pub(super) async fn describe_all(&self, run: &RefineRun<'_>, pairs: &[Pair]) -> DescribedPairs {
        // Collected first: the compiler cannot see through a closure over borrowed pairs here.
        let wanted = self.describer.gate().want(pairs.len());
        run.progress.waiting(true);
        let calls: Vec<_> = pairs
            .iter()
            .zip(wanted)
            .map(|(pair, wanted)| self.describe(run, pair, wanted))
            .collect();
        // One more than can be in progress: an older job then always has the next call ready.
        let ready = self.settings.concurrency.saturating_add(1);
        let mut outcomes: Vec<_> = stream::iter(calls).buffer_unordered(ready).collect().await;
        outcomes.sort_by_key(|(index, _)| *index);
        let mut pairs = DescribedPairs::default();
        for (index, outcome) in outcomes {
            match outcome {
                Ok(described) => pairs.described.push(described),
                Err(error) => {
                    let image = &run.input.candidates[index].image_id;
                    tracing::warn!(job = %run.input.id, %image, %error, "a pair was not described");
                    pairs.failed.push(UndescribedPair { index, why: error });
                }
            }
        }
        let cached = pairs.described.iter().filter(|described| described.cached).count();
        if cached > 0 {
            let usage = Usage { cached: cached as u32, ..Usage::default() };
            self.record_spend(run, usage, None).await;
        }
        if cached < pairs.described.len() {
            self.keep_frame(run).await;
        }
        pairs
    }

    /// Remembers a frame some of whose descriptions are new, so that they can stand in later.
    async fn keep_frame(&self, run: &RefineRun<'_>) {
        let frame = &run.input.frame;
        let Some(descriptor) = frame.descriptor.clone() else { return };
        let most = self.settings.similar_frames_kept;
        let frame = DescribedFrame { query_id: frame.query_id, digest: frame.digest, descriptor };
        if let Err(error) = self.cache.keep_frame(run.input.map.uid, frame, most).await {
            // Similar frames will then be described again.
            tracing::error!(%error, "a described frame could not be recorded");
        }
    }

    async fn describe(
        &self,
        run: &RefineRun<'_>,
        pair: &Pair,
        // Until the pair is described or has failed, it keeps a call busy.
        _wanted: WantedCall,
    ) -> (usize, Result<DescribedPair, CallError>) {
        let scene = run.input.map.scene;
        let stand_in =
            |frame: &SimilarFrame| (self.key(&frame.digest, &pair.digest, scene), frame.stand_in);
        let stand_ins: Vec<_> = run.similar.iter().map(stand_in).collect();
        let since = run.input.fresh_since;
        let found =
            self.descriptions.find_or_buy(pair.key, since, &stand_ins, || self.buy(run, pair));
        let described = found.await.map(|found| described(run, pair.index, found));
        if let Ok(described) = &described {
            let description = Some(described.description(&run.input.candidates));
            run.progress.step(Step { usage: described.usage, description }).await;
        }
        (pair.index, described)
    }

    /// Buys a description. An answer that is none is asked for again, once.
    async fn buy(
        &self,
        run: &RefineRun<'_>,
        pair: &Pair,
    ) -> Result<(CachedDescription, Duration), CallError> {
        self.describer.ready().await;
        let place = run.place().of_pair(pair.index);
        // Queued before the pictures are ready, so that the pairs keep their order.
        let turn = self.describer.gate().queue(place);
        let prompt = prompts::describe(run.input.map.scene, self.switches());
        let mut call = if self.describer.capabilities().two_pictures == Some(false) {
            let both = self.pictures.both(&run.input.frame.digest, &pair.digest).await?;
            self.question_of_one(prompt, &both)
        } else {
            let frame = || self.pictures.picture(&run.input.frame.digest);
            let frame = run.frame.get_or_try_init(frame).await?;
            let candidate = self.pictures.of_image(&pair.digest).await?;
            self.question(prompt, frame, &candidate)
        };
        let first = self.paid_call_in_turn(run, &self.describer, &call, turn).await;
        let why = match self.judged(&first) {
            Ok(text) => return self.keep(run, pair, first?, text).await,
            Err(why) => why,
        };
        let answer = match first {
            Ok(answer) => answer,
            // A filter rejects the pair however often it is asked.
            Err(error) => return Err(error),
        };
        self.charge_for_nothing(run, &answer).await;
        tracing::info!(job = %run.input.id, why, "asking again for a description");
        if let Some(Message { content: super::wire::Content::Parts(parts), .. }) =
            call.messages.last_mut()
        {
            parts.push(Part::text(&prompts::describe_again(&why, self.switches())));
        }
        call.max_tokens = call.max_tokens.saturating_mul(2);
        let turn = self.describer.gate().queue(place);
        let second = self.paid_call_in_turn(run, &self.describer, &call, turn).await?;
        match judge::description(&second, self.switches(), self.settings.description_max_chars) {
            Ok(text) => self.keep(run, pair, second, text).await,
            Err(why) => {
                self.charge_for_nothing(run, &second).await;
                Err(CallError::NoAnswer(format!(
                    "the model gave no description, although it was asked twice: {why}"
                )))
            }
        }
    }

    /// Returns the description in an answer, or why there is none.
    fn judged(&self, answer: &Result<Answer, CallError>) -> Result<String, String> {
        let answer = answer.as_ref().map_err(ToString::to_string)?;
        judge::description(answer, self.switches(), self.settings.description_max_chars)
    }

    /// Records a bought description.
    async fn keep(
        &self,
        run: &RefineRun<'_>,
        pair: &Pair,
        answer: Answer,
        text: String,
    ) -> Result<(CachedDescription, Duration), CallError> {
        let usage = cost_of(&answer);
        let about = DescriptionSubject {
            map: run.input.map.name.clone(),
            image_id: run.input.candidates[pair.index].image_id.clone(),
            query_id: run.input.frame.query_id,
            server: self.describer.shown_url(),
            model: self.settings.describe_model.clone(),
        };
        let description =
            CachedDescription { text, usage, created_at: Timestamp::now(), about: Some(about) };
        self.record_spend(run, usage, Some((pair.key, description.clone()))).await;
        Ok((description, answer.took))
    }

    /// Records the cost of an answer that is no description.
    async fn charge_for_nothing(&self, run: &RefineRun<'_>, answer: &Answer) {
        let usage = cost_of(answer);
        self.record_spend(run, usage, None).await;
        run.progress.step(Step { usage, description: None }).await;
    }

    /// Names each picture in the text before it, because models lose count of which is which.
    fn question(&self, prompt: Prompt, frame: &SentPicture, candidate: &SentPicture) -> Call<'_> {
        let parts = vec![
            Part::text("FRAME:"),
            Part::picture(&frame.url),
            Part::text("CANDIDATE:"),
            Part::picture(&candidate.url),
            Part::text(&prompt.user),
        ];
        self.question_with(prompt, parts, frame.tokens + candidate.tokens)
    }

    /// Asks about both pictures in one.
    fn question_of_one(&self, prompt: Prompt, both: &SentPicture) -> Call<'_> {
        let parts = vec![
            Part::text(
                "The two photographs stand side by side in one picture, each with its name above it: the FRAME on \
                 the left, the CANDIDATE on the right.",
            ),
            Part::picture(&both.url),
            Part::text(&prompt.user),
        ];
        self.question_with(prompt, parts, both.tokens)
    }

    fn question_with(&self, prompt: Prompt, parts: Vec<Part>, picture_tokens: u64) -> Call<'_> {
        let text = estimate(&prompt.system) + estimate(&prompt.user);
        Call {
            model: &self.settings.describe_model,
            prompt_tokens: text + picture_tokens,
            messages: vec![Message::system(prompt.system), Message::parts(parts)],
            shorter: None,
            labels: None,
            max_tokens: self.describer.max_tokens(),
        }
    }

    fn switches(&self) -> Switches {
        Switches {
            object_matching: self.settings.object_matching,
            constraints: self.settings.constraints,
        }
    }

    /// Returns the cache key of a pair's description. It covers everything that shapes the text.
    fn key(&self, query: &Digest, candidate: &Digest, scene: Scene) -> Digest {
        let settings = &self.settings;
        let shapes = format!(
            "description\n{query}\n{candidate}\n{PROMPT_VERSION}\n{}\n{}\n{}\n{scene}\n{}\n{}\n{}\n{}",
            self.describer.url(),
            settings.object_matching,
            settings.constraints,
            settings.describe_model,
            settings.image_max_edge,
            settings.temperature,
            settings.max_tokens,
        );
        Digest::of(shapes.as_bytes())
    }
}

/// Counts a description for this job. The price of a bought one was charged with the call.
fn described(run: &RefineRun<'_>, index: usize, found: FoundDescription) -> DescribedPair {
    let FoundDescription { description, stands_in, took, cached } = found;
    let from_cache = Usage { cached: 1, ..Usage::default() };
    if cached {
        run.charge(from_cache);
    }
    let usage = if cached { from_cache } else { description.usage };
    DescribedPair { index, text: description.text, cached, stands_in, took, usage }
}

impl From<PictureError> for CallError {
    fn from(error: PictureError) -> Self {
        match error {
            PictureError::Missing | PictureError::Unfit(_) => Self::Permanent(error.to_string()),
            PictureError::Store(_) | PictureError::Undone(_) => Self::Transient(error.to_string()),
        }
    }
}
