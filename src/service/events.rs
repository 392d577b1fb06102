//! Streams of job events: the states, described pairs and end of one job, or the changes of all jobs. How they are
//! sent is for the server.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;

use futures_util::{Stream, stream};
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;
use uuid::Uuid;

use super::jobs::no_job;
use super::{Jobs, ServiceError};
use whereabouts_api::{JobChange, JobStatus, Missed, PairDescribed};
use whereabouts_core::{ImageId, Job, JobState, MapName};
use whereabouts_store::{JobRecord, JobStore};

/// An event of one job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEvent {
    /// Its state or its number of attempts changed.
    State(JobStatus),
    /// One more pair was described.
    Described(PairDescribed),
    /// It has ended; the last event.
    Ended(Box<Job>),
}

/// An event of any job.
#[derive(Debug, Clone, PartialEq)]
pub enum AnyJobEvent {
    /// A job made progress or ended.
    Changed(JobChange),
    /// Events were lost because the stream was read too slowly.
    Missed(Missed),
}

impl Jobs {
    /// Streams the changes of the jobs of a map, or of all maps, from now on. Ends only when the store is closed or
    /// fails.
    pub fn follow_all(
        &self,
        map: Option<MapName>,
    ) -> impl Stream<Item = AnyJobEvent> + Send + use<> {
        let follower = AllFollower {
            changes: self.store.changes(),
            jobs: Arc::clone(&self.store),
            map,
            reported: HashMap::new(),
        };
        stream::unfold(follower, |mut follower| async {
            follower.next().await.map(|event| (event, follower))
        })
    }

    /// Streams the events of a job from its beginning until it has ended.
    pub async fn follow(
        &self,
        id: Uuid,
    ) -> Result<impl Stream<Item = JobEvent> + Send + use<>, ServiceError> {
        let mut follower = Follower {
            changes: self.store.changes(),
            jobs: self.clone(),
            id,
            status: None,
            reported: HashSet::new(),
            pending: VecDeque::new(),
            ended: false,
        };
        match self.store.job(id).await? {
            Some(record) => follower.update(self.measured(record).await),
            None => return Err(no_job(id)),
        }
        Ok(stream::unfold(follower, |mut follower| async {
            follower.next().await.map(|event| (event, follower))
        }))
    }
}

/// Turns notifications of changed jobs into events, without repeats.
struct AllFollower {
    jobs: Arc<dyn JobStore>,
    changes: Receiver<Uuid>,
    map: Option<MapName>,
    /// What was last reported of jobs that have not ended: state, attempts, described pairs.
    reported: HashMap<Uuid, (JobState, u32, usize)>,
}

impl AllFollower {
    async fn next(&mut self) -> Option<AnyJobEvent> {
        loop {
            let id = match self.changes.recv().await {
                Ok(id) => id,
                Err(RecvError::Lagged(changes)) => {
                    // What was reported may be out of date.
                    self.reported.clear();
                    return Some(AnyJobEvent::Missed(Missed { changes }));
                }
                Err(RecvError::Closed) => return None,
            };
            let record = match self.jobs.job(id).await {
                Ok(Some(record)) => record,
                // Removed after it had ended.
                Ok(None) => {
                    self.reported.remove(&id);
                    continue;
                }
                Err(error) => {
                    tracing::error!(job = %id, %error, "a followed job could not be read");
                    return None;
                }
            };
            let JobRecord { job, candidates, .. } = record;
            let now = (job.state, job.attempts, job.descriptions.len());
            let before = match job.state.is_final() {
                true => self.reported.remove(&id),
                false => self.reported.insert(id, now),
            };
            let is_followed = self.map.as_ref().is_none_or(|map| *map == job.map);
            if is_followed && before != Some(now) {
                return Some(AnyJobEvent::Changed(JobChange {
                    id,
                    map: job.map,
                    state: job.state,
                    attempts: job.attempts,
                    described: job.descriptions.len(),
                    of: candidates.len(),
                    error: job.error,
                }));
            }
        }
    }
}

/// Turns notifications of one job into its events, without repeats.
struct Follower {
    jobs: Jobs,
    changes: Receiver<Uuid>,
    id: Uuid,
    status: Option<JobStatus>,
    reported: HashSet<ImageId>,
    pending: VecDeque<JobEvent>,
    ended: bool,
}

impl Follower {
    async fn next(&mut self) -> Option<JobEvent> {
        loop {
            if let Some(event) = self.pending.pop_front() {
                return Some(event);
            }
            if self.ended {
                return None;
            }
            match self.changes.recv().await {
                Ok(changed) if changed != self.id => continue,
                // A lost notification may have been of this job.
                Ok(_) | Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return None,
            }
            match self.jobs.store.job(self.id).await {
                Ok(Some(record)) => {
                    let record = self.jobs.measured(record).await;
                    self.update(record);
                }
                Ok(None) => return None,
                Err(error) => {
                    tracing::error!(job = %self.id, %error, "a followed job could not be read");
                    return None;
                }
            }
        }
    }

    fn update(&mut self, record: JobRecord) {
        let JobRecord { job, candidates, .. } = record;
        let status =
            JobStatus { state: job.state, attempts: job.attempts, error: job.error.clone() };
        if !job.state.is_final() && self.status.as_ref() != Some(&status) {
            self.pending.push_back(JobEvent::State(status.clone()));
            self.status = Some(status);
        }
        for description in &job.descriptions {
            if self.reported.insert(description.image_id.clone()) {
                self.pending.push_back(JobEvent::Described(PairDescribed {
                    described: self.reported.len(),
                    of: candidates.len(),
                    description: description.clone(),
                }));
            }
        }
        if job.state.is_final() {
            self.ended = true;
            self.pending.push_back(JobEvent::Ended(Box::new(job)));
        }
    }
}
