//! One description for each pair: cached, in flight, or bought.

use std::sync::Arc;
use std::time::Duration;

use futures_util::{StreamExt, stream};
use jiff::Timestamp;
use whereabouts_core::{
    CachedDescription, Candidate, DescribedFrame, Description, Digest, ImageId, Scene,
    SimilarFrame, StandIn, Usage,
};
use whereabouts_store::Step;

use super::buy_once::FoundDescription;
use super::client::{Call, estimate_tokens};
use super::pictures::{PictureError, SentPicture};
use super::prompts::{self, PROMPT_VERSION, Switches, clean};
use super::retry::CallError;
use super::run::RefineRun;
use super::spend::cost_of;
use super::wire::{Content, ImageUrl, Message, Part, Role};
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
    pub failed: Vec<CallError>,
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

    /// Describes all pairs, `mllm.concurrency` at a time.
    pub(super) async fn describe_all(&self, run: &RefineRun<'_>, pairs: &[Pair]) -> DescribedPairs {
        // Collected first: the compiler cannot see through a closure over borrowed pairs here.
        let calls: Vec<_> = pairs.iter().map(|pair| self.describe(run, pair)).collect();
        let mut outcomes: Vec<_> =
            stream::iter(calls).buffer_unordered(self.settings.concurrency).collect().await;
        outcomes.sort_by_key(|(index, _)| *index);
        let mut pairs = DescribedPairs::default();
        for (index, outcome) in outcomes {
            match outcome {
                Ok(described) => pairs.described.push(described),
                Err(error) => {
                    let image = &run.input.candidates[index].image_id;
                    tracing::warn!(job = %run.input.id, %image, %error, "a pair was not described");
                    pairs.failed.push(error);
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
    ) -> (usize, Result<DescribedPair, CallError>) {
        let scene = run.input.map.scene;
        let stand_in =
            |frame: &SimilarFrame| (self.key(&frame.digest, &pair.digest, scene), frame.stand_in);
        let stand_ins: Vec<_> = run.similar.iter().map(stand_in).collect();
        let found = self.descriptions.find_or_buy(pair.key, &stand_ins, || self.buy(run, pair));
        let described = found.await.map(|found| described(run, pair.index, found));
        if let Ok(described) = &described {
            let description = Some(described.description(&run.input.candidates));
            run.progress.step(Step { usage: described.usage, description }).await;
        }
        (pair.index, described)
    }

    async fn buy(
        &self,
        run: &RefineRun<'_>,
        pair: &Pair,
    ) -> Result<(CachedDescription, Duration), CallError> {
        let frame = || self.pictures.picture(&run.input.frame.digest);
        let frame = run.frame.get_or_try_init(frame).await?;
        let candidate = self.pictures.picture(&pair.digest).await?;
        let prompt = prompts::describe(run.input.map.scene, self.switches());
        let call = Call {
            model: &self.settings.describe_model,
            prompt_tokens: estimate_tokens(&prompt) + frame.tokens + candidate.tokens,
            messages: vec![question(prompt, frame, &candidate)],
            schema: None,
        };
        let answer = self.paid_call(run, &call).await?;
        let text = clean(&answer.text, self.settings.description_max_chars);
        let usage = cost_of(&answer);
        if text.is_empty() {
            self.record_spend(run, usage, None).await;
            run.progress.step(Step { usage, description: None }).await;
            let why = answer.cut.as_deref().unwrap_or("the model said nothing");
            return Err(CallError::Permanent(format!("the description is empty: {why}")));
        }
        let description = CachedDescription { text, usage, created_at: Timestamp::now() };
        self.record_spend(run, usage, Some((pair.key, description.clone()))).await;
        Ok((description, answer.took))
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
            "description\n{query}\n{candidate}\n{PROMPT_VERSION}\n{}\n{}\n{scene}\n{}\n{}\n{}\n{}",
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

/// Names each picture in the text before it, because models lose count of which is which.
fn question(prompt: String, frame: &SentPicture, candidate: &SentPicture) -> Message {
    let text = |text: &str| Part::Text { text: text.to_owned() };
    let picture = |picture: &SentPicture| Part::ImageUrl {
        image_url: ImageUrl { url: Arc::clone(&picture.url) },
    };
    let parts = vec![
        Part::Text { text: prompt },
        text("FRAME:"),
        picture(frame),
        text("CANDIDATE:"),
        picture(candidate),
    ];
    Message { role: Role::User, content: Content::Parts(parts) }
}

impl From<PictureError> for CallError {
    fn from(error: PictureError) -> Self {
        match error {
            PictureError::Missing | PictureError::Unfit(_) => Self::Permanent(error.to_string()),
            PictureError::Store(_) | PictureError::Undone(_) => Self::Transient(error.to_string()),
        }
    }
}
