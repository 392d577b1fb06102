//! One description for each pair: known, on its way, or bought.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use futures_util::{StreamExt, stream};
use jiff::Timestamp;
use parking_lot::Mutex;
use tokio::sync::OnceCell;

use super::aside::SpendReservation;
use super::budget::{Exceeded, JobBudget};
use super::client::{Answer, Call, estimate_tokens};
use super::pictures::{PictureError, SentPicture};
use super::prompts::{self, PROMPT_VERSION, Switches, clean};
use super::purchase::DescriptionLease;
use super::retry::CallError;
use super::wire::{Content, ImageUrl, Message, Part, Role};
use super::{MllmRefiner, Progress, RefineError};
use crate::CacheLookup;
use crate::milliseconds;
use crate::patience::{insist, patiently};
use whereabouts_core::{CachedDescription, DescribedFrame, SimilarFrame, Spent};
use whereabouts_core::{
    Candidate, Description, Descriptor, Digest, Map, Scene, StandIn, Usage, utc_day,
};
use whereabouts_store::{JobRecord, Step, StoreError};

/// What one refinement goes along with.
pub(super) struct Work<'a> {
    pub record: &'a JobRecord,
    pub scene: Scene,
    pub budget: JobBudget,
    pub progress: &'a dyn Progress,
    /// The frame's descriptor, if it is like those that the map has now.
    pub descriptor: Option<&'a Descriptor>,
    /// Earlier frames that are nearly the same, whose descriptions may stand in.
    pub similar: Vec<SimilarFrame>,
    /// What was bought so far.
    usage: Mutex<Usage>,
    /// The frame, made ready when it is first needed: a job whose pairs are all known needs none.
    frame: OnceCell<SentPicture>,
}

/// A candidate that is still in the map.
pub(super) struct Pair {
    /// Its place among the candidates.
    pub index: usize,
    /// Its picture.
    pub digest: Digest,
    /// The key of its description.
    pub key: Digest,
}

/// A description, and of which frame it is if not of the job's own.
#[derive(Debug, Clone)]
pub(super) struct Found {
    description: CachedDescription,
    stands_in: Option<StandIn>,
    /// How long the call took, if it was just made.
    took: Option<Duration>,
}

/// A pair in words.
pub(super) struct Described {
    /// The candidate's place among the candidates.
    pub index: usize,
    /// The words.
    pub text: String,
    /// Whether no call was needed.
    pub cached: bool,
    /// The frame it is of, if that is an earlier one.
    pub stands_in: Option<StandIn>,
    /// How long the call took, if this job made it.
    pub took: Option<Duration>,
    /// What it cost this job.
    pub usage: Usage,
}

impl Described {
    /// As the job tells it.
    pub fn of(&self, candidates: &[Candidate]) -> Description {
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

/// All pairs in words, as far as that went; both lists in coarse order.
#[derive(Default)]
pub(super) struct Findings {
    pub described: Vec<Described>,
    pub failed: Vec<CallError>,
}

impl<'a> Work<'a> {
    pub fn new(
        record: &'a JobRecord,
        map: &Map,
        budget: JobBudget,
        progress: &'a dyn Progress,
    ) -> Self {
        let descriptor = record.query.descriptor.as_ref();
        Self {
            record,
            scene: map.scene,
            descriptor: descriptor.filter(|_| record.revision == map.revision),
            budget,
            progress,
            similar: Vec::new(),
            usage: Mutex::default(),
            frame: OnceCell::new(),
        }
    }

    /// What was bought so far.
    pub fn usage(&self) -> Usage {
        *self.usage.lock()
    }

    /// Takes a description into the account; what was bought is charged when it is answered.
    fn take(&self, index: usize, found: Found, cached: bool) -> Described {
        let Found { description: CachedDescription { text, usage, .. }, stands_in, took } = found;
        let known = Usage { cached: 1, ..Usage::default() };
        if cached {
            self.charge(known);
        }
        let usage = if cached { known } else { usage };
        let took = took.filter(|_| !cached);
        Described { index, text, cached, stands_in, took, usage }
    }

    fn charge(&self, cost: Usage) {
        *self.usage.lock() += cost;
    }
}

pub(super) fn cost_of(answer: &Answer) -> Usage {
    Usage {
        calls: 1,
        cached: 0,
        prompt_tokens: answer.prompt_tokens,
        completion_tokens: answer.completion_tokens,
        estimated: answer.estimated.into(),
    }
}

impl MllmRefiner {
    /// The candidates that are still in the map, in coarse order.
    pub(super) async fn pairs(
        &self,
        map: &Map,
        record: &JobRecord,
    ) -> Result<Vec<Pair>, RefineError> {
        let mut pairs = Vec::with_capacity(record.candidates.len());
        for (index, candidate) in record.candidates.iter().enumerate() {
            if let Some(image) = self.maps.image(map, &candidate.image_id).await? {
                let key = self.key(&record.query.digest, &image.digest, map.scene);
                pairs.push(Pair { index, digest: image.digest, key });
            }
        }
        Ok(pairs)
    }

    /// Earlier frames whose descriptions may stand in for those of this job.
    pub(super) async fn similar_frames(
        &self,
        work: &Work<'_>,
    ) -> Result<Vec<SimilarFrame>, RefineError> {
        let at_least = self.settings.similar_frame_min;
        match work.descriptor {
            Some(descriptor) if at_least > 0.0 => {
                Ok(self.cache.similar_frames(work.record.map_uid, descriptor, at_least).await?)
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Describes all pairs, several at once.
    pub(super) async fn describe_all(&self, work: &Work<'_>, pairs: &[Pair]) -> Findings {
        // Collected first: the compiler cannot see through a closure over borrowed pairs here.
        let calls: Vec<_> = pairs.iter().map(|pair| self.describe(work, pair)).collect();
        let mut outcomes: Vec<_> =
            stream::iter(calls).buffer_unordered(self.settings.concurrency).collect().await;
        outcomes.sort_by_key(|(index, _)| *index);
        let mut findings = Findings::default();
        for (index, outcome) in outcomes {
            match outcome {
                Ok(described) => findings.described.push(described),
                Err(error) => {
                    let image = &work.record.candidates[index].image_id;
                    tracing::warn!(job = %work.record.job.id, %image, %error, "a pair has no text");
                    findings.failed.push(error);
                }
            }
        }
        let known = findings.described.iter().filter(|described| described.cached).count();
        if known > 0 {
            let usage = Usage { cached: known as u32, ..Usage::default() };
            self.keep(work, usage, None).await;
        }
        if known < findings.described.len() {
            self.keep_frame(work).await;
        }
        findings
    }

    /// Remembers a frame some of whose descriptions are new.
    async fn keep_frame(&self, work: &Work<'_>) {
        let Some(descriptor) = work.descriptor.cloned() else { return };
        let (query, most) = (&work.record.query, self.settings.similar_frames_kept);
        let frame = DescribedFrame { query_id: query.id, digest: query.digest, descriptor };
        if let Err(error) = self.cache.keep_frame(work.record.map_uid, frame, most).await {
            // The next frame like it will have to be described.
            tracing::error!(%error, "a described frame could not be remembered");
        }
    }

    async fn describe(
        &self,
        work: &Work<'_>,
        pair: &Pair,
    ) -> (usize, Result<Described, CallError>) {
        let bought = AtomicBool::new(false);
        let find = || self.find(work, pair, &bought);
        let found = self.flights.join(pair.key, find).await;
        let cached = !bought.load(Ordering::Relaxed);
        let described = found.map(|found| work.take(pair.index, found, cached));
        if let Ok(described) = &described {
            let description = Some(described.of(&work.record.candidates));
            work.progress.step(Step { usage: described.usage, description }).await;
        }
        (pair.index, described)
    }

    /// The cache is looked at inside the flight: a flight that has just landed has filled it.
    async fn find(
        &self,
        work: &Work<'_>,
        pair: &Pair,
        bought: &AtomicBool,
    ) -> Result<Found, CallError> {
        if let Some(description) =
            patiently(|| self.cache.description(&pair.key)).await.map_err(passing)?
        {
            self.metrics.description_lookup(CacheLookup::Hit);
            return Ok(Found { description, stands_in: None, took: None });
        }
        for frame in &work.similar {
            let key = self.key(&frame.digest, &pair.digest, work.scene);
            if let Some(description) =
                patiently(|| self.cache.description(&key)).await.map_err(passing)?
            {
                self.metrics.description_lookup(CacheLookup::Similar);
                let stands_in = Some(frame.stand_in);
                return Ok(Found { description, stands_in, took: None });
            }
        }
        let _purchase =
            match DescriptionLease::begin(&self.cache, &pair.key).await.map_err(passing)? {
                Ok(purchase) => purchase,
                Err(description) => {
                    self.metrics.description_lookup(CacheLookup::Hit);
                    return Ok(Found { description, stands_in: None, took: None });
                }
            };
        self.metrics.description_lookup(CacheLookup::Miss);
        let (description, took) = self.buy(work, pair).await?;
        bought.store(true, Ordering::Relaxed);
        Ok(Found { description, stands_in: None, took: Some(took) })
    }

    async fn buy(
        &self,
        work: &Work<'_>,
        pair: &Pair,
    ) -> Result<(CachedDescription, Duration), CallError> {
        let frame = || self.pictures.picture(&work.record.query.digest);
        let frame = work.frame.get_or_try_init(frame).await?;
        let candidate = self.pictures.picture(&pair.digest).await?;
        let prompt = prompts::describe(work.scene, self.switches());
        let call = Call {
            model: &self.settings.describe_model,
            prompt_tokens: estimate_tokens(&prompt) + frame.tokens + candidate.tokens,
            messages: vec![question(prompt, frame, &candidate)],
            schema: None,
        };
        let answer = self.call(work, &call).await?;
        let text = clean(&answer.text, self.settings.description_max_chars);
        let usage = cost_of(&answer);
        if text.is_empty() {
            self.keep(work, usage, None).await;
            work.progress.step(Step { usage, description: None }).await;
            let why = answer.cut.as_deref().unwrap_or("the model said nothing");
            return Err(CallError::Permanent(format!("the description is empty: {why}")));
        }
        let description = CachedDescription { text, usage, created_at: Timestamp::now() };
        self.keep(work, usage, Some((pair.key, description.clone()))).await;
        Ok((description, answer.took))
    }

    /// Writes down what was paid, and what for, on a task of its own: a job that is cancelled in this
    /// moment must not take it along.
    pub(super) async fn keep(
        &self,
        work: &Work<'_>,
        usage: Usage,
        bought: Option<(Digest, CachedDescription)>,
    ) {
        let (cache, accounts) = (Arc::clone(&self.cache), Arc::clone(&self.usage));
        let spent = self.spent_now(work.record, usage);
        let keeping = tokio::spawn(async move {
            let describing = async {
                if let Some((key, description)) = bought {
                    let keep = || cache.keep_description(key, description.clone());
                    insist("a description, so that the next job has to pay again", keep).await;
                }
            };
            let accounting = insist("what was spent", || accounts.add_usage(spent.clone()));
            tokio::join!(describing, accounting)
        });
        if let Err(error) = keeping.await {
            tracing::error!(%error, "what was bought could not be written down");
        }
    }

    /// Asks within the budget.
    pub(super) async fn call(&self, work: &Work<'_>, call: &Call<'_>) -> Result<Answer, CallError> {
        let reserved = work
            .budget
            .reserve(call.prompt_tokens, self.client.max_tokens(), Timestamp::now())
            .map_err(|exceeded| match exceeded {
                Exceeded::Job => CallError::JobSpent,
                Exceeded::Day => CallError::DaySpent,
            })?;
        let aside = self.set_aside(call.prompt_tokens).await?;
        let answer = self.client.call(call).await?;
        reserved.settle(answer.prompt_tokens, answer.completion_tokens);
        if let Some(aside) = aside {
            aside.settle(self.budget.cost(answer.prompt_tokens, answer.completion_tokens));
        }
        work.charge(cost_of(&answer));
        Ok(answer)
    }

    /// Sets aside what a call may cost, where other processes spend too and a day has a limit.
    async fn set_aside(&self, prompt_tokens: u64) -> Result<Option<SpendReservation>, CallError> {
        let limit =
            Spent { tokens: self.settings.tokens_per_day, money: self.settings.money_per_day };
        let Some(shared) = self.shared.clone().filter(|_| limit != Spent::default()) else {
            return Ok(None);
        };
        let most = self.budget.cost(prompt_tokens, self.client.max_tokens());
        let aside = SpendReservation::set(shared, utc_day(Timestamp::now()), most, limit).await;
        aside.map_err(passing)?.map(Some).ok_or(CallError::DaySpent)
    }

    fn switches(&self) -> Switches {
        Switches {
            object_matching: self.settings.object_matching,
            constraints: self.settings.constraints,
        }
    }

    /// The key of a pair's description: all that shapes the text.
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

/// The two pictures are named in words beside them: models lose count of which is which.
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

fn passing(error: StoreError) -> CallError {
    CallError::Transient(error.to_string())
}

impl From<PictureError> for CallError {
    fn from(error: PictureError) -> Self {
        match error {
            PictureError::Missing | PictureError::Unfit(_) => Self::Permanent(error.to_string()),
            PictureError::Store(_) | PictureError::Undone(_) => Self::Transient(error.to_string()),
        }
    }
}
