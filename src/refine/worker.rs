//! The worker: claims jobs, has them refined side by side, and records the outcomes.

mod in_progress;

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use tokio::sync::broadcast::error::RecvError;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;
use whereabouts_core::{Estimate, Job, JobState, TextLine};
use whereabouts_store::{Claim, JobRecord, JobStore, MapStore, Release, Step, StoreError};
use whereabouts_telemetry::traces;

use self::in_progress::{InProgress, Turn, Turns};
use super::store_retry::retry_for;
use super::{
    FrameReader, FrameTexts, JobServiceTime, JobSettings, NextAttempt, Progress, QueryFrame,
    RefineError, RefineInput, RefineMetrics, Refinement, Refiner,
};

/// Refines jobs, the oldest first.
///
/// `jobs.workers` jobs at a time use this machine. A job that waits for a network ([`Progress::waiting`]) does not
/// count among them: another is claimed as soon as the refiner can make use of it ([`Refiner::room`]), up to
/// `jobs.in_progress`. A process thus claims what it can work on, and leaves the rest to others that share the queue.
pub struct Worker {
    /// The queue.
    pub jobs: Arc<dyn JobStore>,
    /// The maps and their calibration.
    pub maps: Arc<dyn MapStore>,
    /// The refiner.
    pub refiner: Arc<dyn Refiner>,
    /// Reads the text in frames, if something does.
    pub reader: Option<Arc<dyn FrameReader>>,
    /// Counts jobs.
    pub metrics: Arc<RefineMetrics>,
    /// Averages the time that jobs take.
    pub service_time: JobServiceTime,
    /// The settings of jobs.
    pub settings: JobSettings,
    /// The least confidence of a known place.
    pub known_confidence: f64,
}

/// The outcome of one attempt.
enum AttemptOutcome {
    Refined(Box<Refinement>, Option<Vec<TextLine>>),
    Failed(RefineError),
    /// The job was cancelled, or another worker has claimed it.
    ClaimLost,
    ShuttingDown,
}

impl Worker {
    /// Works until `shutdown`. Jobs in progress then go back to the queue.
    pub async fn run(self, shutdown: CancellationToken) {
        let worker = Arc::new(self);
        let mut changes = worker.jobs.changes();
        let turns = Turns::new(worker.settings.workers);
        let mut jobs = InProgress::default();
        loop {
            let in_progress = jobs.len();
            tokio::select! {
                biased;
                () = shutdown.cancelled() => break,
                () = jobs.one_ends(), if !jobs.is_empty() => continue,
                () = worker.is_ready(&turns, in_progress) => {}
            }
            // Not in the selection above: a claim that is dropped half-way may have been made.
            match worker.claim().await {
                Ok(Some(record)) => {
                    let (id, turn) = (record.job.id, turns.take());
                    let (worker, shutdown) = (Arc::clone(&worker), shutdown.clone());
                    jobs.spawn(id, async move { worker.work_on(record, turn, &shutdown).await });
                    continue;
                }
                Ok(None) => {}
                Err(error) => tracing::error!(%error, "the job queue cannot be worked on"),
            }
            // A change wakes the worker at once; polling finds jobs whose pause or lease has ended.
            let poll = tokio::time::sleep(worker.settings.lease.min(Duration::from_secs(1)));
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = poll => {}
                () = jobs.others_change(&mut changes) => {}
            }
        }
        while !jobs.is_empty() {
            jobs.one_ends().await;
        }
    }

    /// Returns once another job may be claimed.
    async fn is_ready(&self, turns: &Turns, in_progress: usize) {
        if in_progress >= self.settings.in_progress.max(self.settings.workers) {
            // Until one ends.
            return std::future::pending().await;
        }
        loop {
            turns.any().await;
            self.refiner.room().await;
            if turns.has_any() {
                return;
            }
        }
    }

    async fn claim(&self) -> Result<Option<JobRecord>, StoreError> {
        self.jobs.claim(Timestamp::now(), from_now(self.settings.lease)).await
    }

    /// Makes one attempt at a claimed job, and records its outcome.
    async fn work_on(
        &self,
        record: JobRecord,
        turn: Turn,
        shutdown: &CancellationToken,
    ) -> Result<(), StoreError> {
        let (job, claim, began) = (record.job.clone(), record.claim(), Instant::now());
        let _counted = self.metrics.job_begins();
        let traceparent = record.traceparent.as_deref();
        let span = traces::job(job.id, job.refiner.as_str(), job.attempts, traceparent);
        match self.attempt(&record, &turn, shutdown).instrument(span).await {
            AttemptOutcome::Refined(refinement, texts) => {
                self.record_time(began.elapsed());
                let estimate = self.estimate(&record, &refinement).await;
                let job = Job { texts, ..succeeded(job, *refinement, estimate) };
                self.finish(claim, job).await
            }
            AttemptOutcome::Failed(error) => self.after_failure(claim, job, error).await,
            AttemptOutcome::ClaimLost => Ok(()),
            AttemptOutcome::ShuttingDown => {
                let why = "the server was stopped".to_owned();
                let release = Release { why, not_before: None, counts: false };
                self.release(claim, release).await
            }
        }
    }

    /// Puts a job back into the queue if it is to be attempted again, and ends it otherwise.
    async fn after_failure(
        &self,
        claim: Claim,
        job: Job,
        error: RefineError,
    ) -> Result<(), StoreError> {
        match self.settings.attempt_policy().next(job.attempts, &error) {
            NextAttempt::Never => self.fail(claim, job, &error).await,
            NextAttempt::After { pause, counts } => {
                let (why, seconds) = (error.to_string(), pause.as_secs());
                if counts {
                    tracing::warn!(job = %job.id, attempt = job.attempts, why, seconds, "a job is retried later");
                } else {
                    tracing::info!(job = %job.id, why, seconds, "a job is deferred");
                }
                let release = Release { why, not_before: Some(from_now(pause)), counts };
                self.release(claim, release).await
            }
        }
    }

    /// Ends a job with the descriptions and costs that are recorded so far.
    async fn fail(&self, claim: Claim, job: Job, error: &RefineError) -> Result<(), StoreError> {
        let job = match self.jobs.job(job.id).await? {
            Some(record) => record.job,
            None => job,
        };
        self.finish(claim, failed(job, error)).await
    }

    async fn attempt(
        &self,
        record: &JobRecord,
        turn: &Turn,
        shutdown: &CancellationToken,
    ) -> AttemptOutcome {
        let timeout = self.settings.timeout;
        tokio::select! {
            () = shutdown.cancelled() => AttemptOutcome::ShuttingDown,
            () = self.claim_lost(record.claim()) => AttemptOutcome::ClaimLost,
            refined = tokio::time::timeout(timeout, self.refine_and_read(record, turn)) => match refined {
                Ok((Ok(refinement), texts)) => AttemptOutcome::Refined(Box::new(refinement), texts),
                Ok((Err(error), _)) => AttemptOutcome::Failed(error),
                Err(_) => AttemptOutcome::Failed(RefineError::Transient(format!(
                    "it took longer than {} s (jobs.timeout_s)",
                    timeout.as_secs()
                ))),
            },
        }
    }

    /// Refines a job and reads the text in its frame meanwhile.
    async fn refine_and_read(
        &self,
        record: &JobRecord,
        turn: &Turn,
    ) -> (Result<Refinement, RefineError>, Option<Vec<TextLine>>) {
        let texts = match self.reader.clone() {
            Some(reader) => {
                let (map, frame) = (record.job.map.clone(), record.query.digest);
                FrameTexts::of(async move { reader.read_frame(&map, &frame).await })
            }
            None => FrameTexts::default(),
        };
        let (refinement, texts) =
            tokio::join!(self.refine(record, turn, texts.clone()), texts.get());
        (refinement, texts.map(|lines| lines.to_vec()))
    }

    async fn refine(
        &self,
        record: &JobRecord,
        turn: &Turn,
        texts: FrameTexts,
    ) -> Result<Refinement, RefineError> {
        let input = RefineInput::of_job(record, self.maps.as_ref()).await?;
        let input = RefineInput {
            attempts_left: self.settings.attempts.saturating_sub(record.job.attempts),
            frame: QueryFrame { texts, ..input.frame },
            ..input
        };
        let progress = JobProgress { jobs: self.jobs.as_ref(), claim: record.claim(), turn };
        self.refiner.refine(&input, &progress).await
    }

    /// Returns when the job has been cancelled, even if it was queued again since, or when another worker
    /// has claimed it.
    async fn claim_lost(&self, claim: Claim) {
        let mut changes = self.jobs.changes();
        loop {
            let changed = match changes.recv().await {
                Ok(changed) => changed == claim.job,
                Err(RecvError::Lagged(_)) => true,
                Err(RecvError::Closed) => return std::future::pending().await,
            };
            if changed
                && let Ok(Some(record)) = self.jobs.job(claim.job).await
                && !record.is_held_by(claim)
            {
                return;
            }
        }
    }

    /// Returns the first of the refined ranking with its confidence.
    async fn estimate(&self, record: &JobRecord, refinement: &Refinement) -> Option<Estimate> {
        let first = refinement.ranking.first()?;
        let calibration = record.calibration(self.maps.as_ref()).await;
        let calibration = calibration.ok().flatten().unwrap_or_default();
        let confidence = calibration.refined_confidence(
            &record.candidates,
            &first.image_id,
            refinement.evidence,
        );
        let known_from = self.known_confidence;
        let estimate = Estimate::new(&first.image_id, first.pose, confidence, known_from)
            .with_evidence(refinement.evidence);
        let unknown = record.query.uninformative.as_deref().or(refinement.why_unknown());
        Some(estimate.unless(unknown))
    }

    fn record_time(&self, took: Duration) {
        self.service_time.lock().record(took, self.metrics.jobs_in_progress());
    }

    async fn finish(&self, claim: Claim, job: Job) -> Result<(), StoreError> {
        self.metrics.job_ended(&job);
        self.retry_while_claimed(|| self.jobs.finish(claim, job.clone())).await
    }

    async fn release(&self, claim: Claim, release: Release) -> Result<(), StoreError> {
        self.retry_while_claimed(|| self.jobs.release(claim, release.clone())).await
    }

    /// Retries a write while the store is unavailable, for as long as the claim lasts: the outcome of the
    /// attempt should not be lost.
    async fn retry_while_claimed<F>(&self, write: impl Fn() -> F) -> Result<(), StoreError>
    where
        F: Future<Output = Result<(), StoreError>>,
    {
        retry_for(self.settings.lease, write).await
    }
}

/// Records the steps of a refinement in its job.
struct JobProgress<'a> {
    jobs: &'a dyn JobStore,
    claim: Claim,
    turn: &'a Turn,
}

#[async_trait]
impl Progress for JobProgress<'_> {
    async fn step(&self, step: Step) {
        if let Err(error) = self.jobs.progress(self.claim, step).await {
            // The outcome of the refinement contains the step again.
            tracing::error!(job = %self.claim.job, %error, "a step of a job could not be recorded");
        }
    }

    fn waiting(&self, waits: bool) {
        self.turn.lend(waits);
    }
}

fn from_now(pause: Duration) -> Timestamp {
    let pause = SignedDuration::try_from(pause).unwrap_or(SignedDuration::MAX);
    Timestamp::now().saturating_add(pause).unwrap_or(Timestamp::MAX)
}

fn succeeded(job: Job, refinement: Refinement, estimate: Option<Estimate>) -> Job {
    let Refinement { descriptions, ranking, verdicts, reasoning, usage, degraded, .. } = refinement;
    let reasoning_took_ms = refinement.reasoning_took_ms;
    Job {
        state: if degraded.is_some() { JobState::Degraded } else { JobState::Succeeded },
        finished_at: Some(Timestamp::now()),
        descriptions,
        ranking: Some(ranking),
        verdicts,
        estimate,
        reasoning,
        reasoning_took_ms,
        usage: job.usage + usage,
        error: degraded,
        ..job
    }
}

fn failed(job: Job, error: &RefineError) -> Job {
    Job {
        state: JobState::Failed,
        finished_at: Some(Timestamp::now()),
        error: Some(error.to_string()),
        ..job
    }
}

#[cfg(test)]
mod tests;
