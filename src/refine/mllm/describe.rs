//! One description for each pair: known, on its way, or bought.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use futures_util::{StreamExt, stream};
use jiff::Timestamp;
use tokio::sync::OnceCell;

use super::budget::{Exceeded, JobBudget};
use super::cache::CachedDescription;
use super::client::{Answer, Call, estimate_tokens};
use super::pictures::{PictureError, SentPicture};
use super::prompts::{self, PROMPT_VERSION, Switches, clean};
use super::retry::CallError;
use super::wire::{Content, ImageUrl, Message, Part, Role};
use super::{MllmRefiner, RefineError};
use crate::domain::{Digest, Map, Scene, Usage};
use crate::store::{JobRecord, StoreError};

/// What one refinement goes along with.
pub(super) struct Work<'a> {
    pub record: &'a JobRecord,
    pub scene: Scene,
    pub budget: JobBudget,
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

/// A pair in words.
pub(super) struct Described {
    /// The candidate's place among the candidates.
    pub index: usize,
    /// The words.
    pub text: String,
    /// Whether no call was needed.
    pub cached: bool,
    /// What it cost this job.
    pub usage: Usage,
}

/// All pairs in words, as far as that went; both lists in coarse order.
#[derive(Default)]
pub(super) struct Findings {
    pub described: Vec<Described>,
    pub failed: Vec<CallError>,
}

impl<'a> Work<'a> {
    pub fn new(record: &'a JobRecord, scene: Scene, budget: JobBudget) -> Self {
        Self { record, scene, budget, usage: Mutex::default(), frame: OnceCell::new() }
    }

    /// What was bought so far.
    pub fn usage(&self) -> Usage {
        *self.usage.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a description into the account; what was bought is charged when it is answered.
    fn take(&self, index: usize, description: CachedDescription, cached: bool) -> Described {
        let CachedDescription { text, usage, .. } = description;
        let known = Usage { cached: 1, ..Usage::default() };
        if cached {
            self.charge(known);
        }
        Described { index, text, cached, usage: if cached { known } else { usage } }
    }

    fn charge(&self, cost: Usage) {
        let mut usage = self.usage.lock().unwrap_or_else(PoisonError::into_inner);
        *usage = sum(*usage, cost);
    }
}

/// Two costs together.
pub(super) fn sum(a: Usage, b: Usage) -> Usage {
    Usage {
        calls: a.calls + b.calls,
        cached: a.cached + b.cached,
        prompt_tokens: a.prompt_tokens + b.prompt_tokens,
        completion_tokens: a.completion_tokens + b.completion_tokens,
    }
}

fn cost_of(answer: &Answer) -> Usage {
    Usage {
        calls: 1,
        cached: 0,
        prompt_tokens: answer.prompt_tokens,
        completion_tokens: answer.completion_tokens,
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
        findings
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
        (pair.index, found.map(|description| work.take(pair.index, description, cached)))
    }

    /// The cache is looked at inside the flight: a flight that has just landed has filled it.
    async fn find(
        &self,
        work: &Work<'_>,
        pair: &Pair,
        bought: &AtomicBool,
    ) -> Result<CachedDescription, CallError> {
        if let Some(known) = self.cache.description(&pair.key).await.map_err(passing)? {
            return Ok(known);
        }
        let description = self.buy(work, pair).await?;
        bought.store(true, Ordering::Relaxed);
        Ok(description)
    }

    async fn buy(&self, work: &Work<'_>, pair: &Pair) -> Result<CachedDescription, CallError> {
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
        if text.is_empty() {
            let why = answer.cut.as_deref().unwrap_or("the model said nothing");
            return Err(CallError::Hopeless(format!("the description is empty: {why}")));
        }
        let usage = cost_of(&answer);
        let description = CachedDescription { text, usage, created_at: Timestamp::now() };
        self.keep(pair.key, description.clone()).await;
        Ok(description)
    }

    /// Stores what was paid for, on a task of its own: a job that is cancelled in this moment must
    /// not take the description with it.
    async fn keep(&self, key: Digest, description: CachedDescription) {
        let cache = Arc::clone(&self.cache);
        let keeping = tokio::spawn(async move { cache.keep_description(key, description).await });
        let outcome = keeping.await.map_err(|error| StoreError::Failed(error.to_string()));
        if let Err(error) = outcome.and_then(|kept| kept) {
            // The job has its text; only the next one will have to pay again.
            tracing::error!(%error, "a description could not be stored");
        }
    }

    /// Asks within the budget. Where so configured, waits while calls are suspended.
    pub(super) async fn call(&self, work: &Work<'_>, call: &Call<'_>) -> Result<Answer, CallError> {
        loop {
            let reserved = work
                .budget
                .reserve(call.prompt_tokens, self.client.max_tokens(), Timestamp::now())
                .map_err(|exceeded| match exceeded {
                    Exceeded::Job => CallError::JobSpent,
                    Exceeded::Day => CallError::DaySpent,
                })?;
            match self.client.call(call).await {
                Ok(answer) => {
                    reserved.settle(answer.prompt_tokens, answer.completion_tokens);
                    work.charge(cost_of(&answer));
                    return Ok(answer);
                }
                Err(CallError::Suspended { wait }) if self.waits() => {
                    drop(reserved);
                    tokio::time::sleep(wait).await;
                }
                Err(error) => return Err(error),
            }
        }
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
    CallError::Passing(error.to_string())
}

impl From<PictureError> for CallError {
    fn from(error: PictureError) -> Self {
        match error {
            PictureError::Missing | PictureError::Unfit(_) => Self::Hopeless(error.to_string()),
            PictureError::Store(_) | PictureError::Undone(_) => Self::Passing(error.to_string()),
        }
    }
}
