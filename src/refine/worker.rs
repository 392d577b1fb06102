//! The worker: takes a job, has it refined, writes down how it ended.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use jiff::{SignedDuration, Timestamp};
use tokio::sync::broadcast::error::RecvError;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::patience::until;
use super::{JobServiceTime, Progress, RefineError, RefineMetrics, Refinement, Refiner};
use whereabouts_core::{Estimate, Job, JobState};
use whereabouts_store::{Claim, JobRecord, JobStore, MapStore, Release, Step, StoreError};
use whereabouts_telemetry::traces;

/// Bounds on a worker's patience.
#[derive(Debug, Clone, Copy)]
pub struct WorkerSettings {
    /// How long a job is held without a sign of life.
    pub lease: Duration,
    /// The longest a job may take.
    pub timeout: Duration,
    /// How often a job is tried.
    pub attempts: u32,
    /// The pause before the second try; it doubles each time.
    pub retry_pause: Duration,
    /// The least confidence of a known place.
    pub known_confidence: f64,
    /// How many workers there are.
    pub side_by_side: usize,
}

/// Refines one job after another.
pub struct Worker {
    /// The queue.
    pub jobs: Arc<dyn JobStore>,
    /// What the maps are like.
    pub maps: Arc<dyn MapStore>,
    /// Who refines.
    pub refiner: Arc<dyn Refiner>,
    /// What is counted.
    pub metrics: Arc<RefineMetrics>,
    /// Learns how long jobs take.
    pub pace: JobServiceTime,
    /// Its patience.
    pub settings: WorkerSettings,
}

/// Why a refinement was given up.
enum Stopped {
    Failed(RefineError),
    NoLongerOurs,
    ShuttingDown,
}

impl Worker {
    /// Works until `shutdown`. A job in progress then goes back to the queue.
    pub async fn run(&self, shutdown: CancellationToken) {
        let mut changes = self.jobs.changes();
        while !shutdown.is_cancelled() {
            match self.step(&shutdown).await {
                Ok(true) => continue,
                Ok(false) => {}
                Err(error) => tracing::error!(%error, "the job queue cannot be worked on"),
            }
            // A notice wakes the worker at once; the pause finds jobs whose time has come.
            let pause = tokio::time::sleep(self.settings.lease.min(Duration::from_secs(1)));
            tokio::select! {
                () = shutdown.cancelled() => {}
                () = pause => {}
                _ = changes.recv() => {}
            }
        }
    }

    /// Takes one job and sees it through; `false` if none waits.
    pub async fn step(&self, shutdown: &CancellationToken) -> Result<bool, StoreError> {
        let until = after(self.settings.lease);
        let Some(record) = self.jobs.claim(Timestamp::now(), until).await? else {
            return Ok(false);
        };
        let (job, claim, began) = (record.job.clone(), record.claim(), Instant::now());
        let traceparent = record.traceparent.as_deref();
        let span = traces::job(job.id, job.refiner.as_str(), job.attempts, traceparent);
        match self.refine(&record, shutdown).instrument(span).await {
            Ok(refinement) => {
                self.record(began.elapsed());
                let estimate = self.estimate(&record, &refinement).await;
                self.end(claim, succeeded(job, refinement, estimate)).await?;
            }
            Err(Stopped::NoLongerOurs) => {}
            Err(Stopped::ShuttingDown) => {
                let why = "the server was stopped".to_owned();
                let release = Release { why, not_before: None, counts: false };
                self.release(claim, release).await?;
            }
            Err(Stopped::Failed(RefineError::Deferred { why, after: pause })) => {
                tracing::info!(job = %job.id, why, seconds = pause.as_secs(), "a job waits");
                let release = Release { why, not_before: Some(after(pause)), counts: false };
                self.release(claim, release).await?;
            }
            Err(Stopped::Failed(RefineError::Transient(why)))
                if job.attempts < self.settings.attempts =>
            {
                tracing::warn!(job = %job.id, attempt = job.attempts, why, "a job is tried again");
                let doubled = 2_u32.saturating_pow(job.attempts.saturating_sub(1));
                let pause = self.settings.retry_pause.saturating_mul(doubled);
                let release = Release { why, not_before: Some(after(pause)), counts: true };
                self.release(claim, release).await?;
            }
            Err(Stopped::Failed(error)) => self.fail(claim, job, &error).await?,
        }
        Ok(true)
    }

    /// Ends a job with what it has so far.
    async fn fail(&self, claim: Claim, job: Job, error: &RefineError) -> Result<(), StoreError> {
        let job = match self.jobs.job(job.id).await? {
            Some(record) => record.job,
            None => job,
        };
        self.end(claim, failed(job, error)).await
    }

    async fn refine(
        &self,
        record: &JobRecord,
        shutdown: &CancellationToken,
    ) -> Result<Refinement, Stopped> {
        let timeout = self.settings.timeout;
        let progress = JobProgress { jobs: self.jobs.as_ref(), claim: record.claim() };
        tokio::select! {
            () = shutdown.cancelled() => Err(Stopped::ShuttingDown),
            () = self.taken_away(record.claim()) => Err(Stopped::NoLongerOurs),
            outcome = tokio::time::timeout(timeout, self.refiner.refine(record, &progress)) => match outcome {
                Ok(refined) => refined.map_err(Stopped::Failed),
                Err(_) => Err(Stopped::Failed(RefineError::Transient(format!(
                    "it took longer than {} s (jobs.timeout_s)",
                    timeout.as_secs()
                )))),
            },
        }
    }

    /// Returns when the job has been cancelled, even if it is queued again by the time of a look, or
    /// when another worker has it.
    async fn taken_away(&self, claim: Claim) {
        let mut changes = self.jobs.changes();
        loop {
            let look = match changes.recv().await {
                Ok(changed) => changed == claim.job,
                Err(RecvError::Lagged(_)) => true,
                Err(RecvError::Closed) => return std::future::pending().await,
            };
            if look
                && let Ok(Some(record)) = self.jobs.job(claim.job).await
                && !record.is_held_by(claim)
            {
                return;
            }
        }
    }

    /// The first of the refined order, and how sure it is.
    async fn estimate(&self, record: &JobRecord, refinement: &Refinement) -> Option<Estimate> {
        let first = refinement.ranking.first()?;
        let calibration = match self.maps.map(&record.job.map).await {
            Ok(Some(map)) if map.uid == record.map_uid => self.maps.calibration(&map).await,
            _ => Ok(None),
        };
        let calibration = calibration.ok().flatten().unwrap_or_default();
        let confidence = calibration.refined_confidence(
            &record.candidates,
            &first.image_id,
            refinement.evidence,
        );
        let known_from = self.settings.known_confidence;
        Some(Estimate::new(&first.image_id, first.pose, confidence, known_from))
    }

    fn record(&self, took: Duration) {
        let mut pace = self.pace.lock();
        pace.record(took, self.settings.side_by_side);
    }

    async fn end(&self, claim: Claim, job: Job) -> Result<(), StoreError> {
        self.metrics.job_ended(&job);
        self.insist(|| self.jobs.finish(claim, job.clone())).await
    }

    async fn release(&self, claim: Claim, release: Release) -> Result<(), StoreError> {
        self.insist(|| self.jobs.release(claim, release.clone())).await
    }

    /// Tells a store that is away for a while how a job has ended, as long as the job is this worker's:
    /// what was worked out is not to be lost.
    async fn insist<F>(&self, tell: impl Fn() -> F) -> Result<(), StoreError>
    where
        F: Future<Output = Result<(), StoreError>>,
    {
        until(self.settings.lease, tell).await
    }
}

/// Writes the steps of a refinement into its job.
struct JobProgress<'a> {
    jobs: &'a dyn JobStore,
    claim: Claim,
}

#[async_trait]
impl Progress for JobProgress<'_> {
    async fn step(&self, step: Step) {
        if let Err(error) = self.jobs.progress(self.claim, step).await {
            // The refinement says it all again at its end.
            tracing::error!(job = %self.claim.job, %error, "a step of a job could not be written down");
        }
    }
}

/// So long from now.
fn after(pause: Duration) -> Timestamp {
    let pause = SignedDuration::try_from(pause).unwrap_or(SignedDuration::MAX);
    Timestamp::now().saturating_add(pause).unwrap_or(Timestamp::MAX)
}

fn succeeded(job: Job, refinement: Refinement, estimate: Option<Estimate>) -> Job {
    let Refinement { descriptions, ranking, reasoning, usage, degraded, .. } = refinement;
    let reasoning_took_ms = refinement.reasoning_took_ms;
    Job {
        state: if degraded.is_some() { JobState::Degraded } else { JobState::Succeeded },
        finished_at: Some(Timestamp::now()),
        descriptions,
        ranking: Some(ranking),
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
