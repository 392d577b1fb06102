//! A job as it goes on: every change of its state, every pair as it is described, and its end; and all jobs
//! in short.

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

/// Something that happened to a job.
#[derive(Debug, Clone, PartialEq)]
pub enum JobEvent {
    /// It is in another state, or in another attempt.
    State(JobStatus),
    /// One more pair is described.
    Described(PairDescribed),
    /// It has ended; no event follows.
    Ended(Box<Job>),
}

/// Something that happened to any job.
#[derive(Debug, Clone, PartialEq)]
pub enum AnyJobEvent {
    /// A job has come further, or has ended.
    Changed(JobChange),
    /// Some of that was not told.
    Missed(Missed),
}

impl Jobs {
    /// What happens from now on to the jobs of a map, or of all. Never ends by itself.
    pub fn follow_all(
        &self,
        map: Option<MapName>,
    ) -> impl Stream<Item = AnyJobEvent> + Send + use<> {
        let follower = AllFollower {
            changes: self.store.changes(),
            jobs: Arc::clone(&self.store),
            map,
            told: HashMap::new(),
        };
        stream::unfold(follower, |mut follower| async {
            follower.next().await.map(|event| (event, follower))
        })
    }

    /// What has happened to a job, and then what happens to it until it has ended.
    pub async fn follow(
        &self,
        id: Uuid,
    ) -> Result<impl Stream<Item = JobEvent> + Send + use<>, ServiceError> {
        let mut follower = Follower {
            changes: self.store.changes(),
            jobs: Arc::clone(&self.store),
            id,
            status: None,
            told: HashSet::new(),
            waiting: VecDeque::new(),
            ended: false,
        };
        match self.store.job(id).await? {
            Some(record) => follower.look_at(record),
            None => return Err(no_job(id)),
        }
        Ok(stream::unfold(follower, |mut follower| async {
            follower.next().await.map(|event| (event, follower))
        }))
    }
}

/// Follows all jobs.
struct AllFollower {
    jobs: Arc<dyn JobStore>,
    changes: Receiver<Uuid>,
    map: Option<MapName>,
    /// What was last told of jobs that have not ended: state, attempts, pairs.
    told: HashMap<Uuid, (JobState, u32, usize)>,
}

impl AllFollower {
    async fn next(&mut self) -> Option<AnyJobEvent> {
        loop {
            let id = match self.changes.recv().await {
                Ok(id) => id,
                Err(RecvError::Lagged(changes)) => {
                    // What was told of some is old by now.
                    self.told.clear();
                    return Some(AnyJobEvent::Missed(Missed { changes }));
                }
                Err(RecvError::Closed) => return None,
            };
            let record = match self.jobs.job(id).await {
                Ok(Some(record)) => record,
                // It was removed, as ended jobs are after a while.
                Ok(None) => {
                    self.told.remove(&id);
                    continue;
                }
                Err(error) => {
                    tracing::error!(job = %id, %error, "a job that is followed cannot be read");
                    return None;
                }
            };
            let JobRecord { job, candidates, .. } = record;
            let now = (job.state, job.attempts, job.descriptions.len());
            let before = match job.state.is_final() {
                true => self.told.remove(&id),
                false => self.told.insert(id, now),
            };
            let wanted = self.map.as_ref().is_none_or(|map| *map == job.map);
            if wanted && before != Some(now) {
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

/// Tells apart what it has told from what is new.
struct Follower {
    jobs: Arc<dyn JobStore>,
    changes: Receiver<Uuid>,
    id: Uuid,
    status: Option<JobStatus>,
    told: HashSet<ImageId>,
    waiting: VecDeque<JobEvent>,
    ended: bool,
}

impl Follower {
    async fn next(&mut self) -> Option<JobEvent> {
        loop {
            if let Some(event) = self.waiting.pop_front() {
                return Some(event);
            }
            if self.ended {
                return None;
            }
            match self.changes.recv().await {
                Ok(changed) if changed != self.id => continue,
                // After lost notices, any of which may have been the one, it is looked at too.
                Ok(_) | Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return None,
            }
            match self.jobs.job(self.id).await {
                Ok(Some(record)) => self.look_at(record),
                Ok(None) => return None,
                Err(error) => {
                    tracing::error!(job = %self.id, %error, "a job that is followed cannot be read");
                    return None;
                }
            }
        }
    }

    fn look_at(&mut self, record: JobRecord) {
        let JobRecord { job, candidates, .. } = record;
        let status =
            JobStatus { state: job.state, attempts: job.attempts, error: job.error.clone() };
        if !job.state.is_final() && self.status.as_ref() != Some(&status) {
            self.waiting.push_back(JobEvent::State(status.clone()));
            self.status = Some(status);
        }
        for description in &job.descriptions {
            if self.told.insert(description.image_id.clone()) {
                self.waiting.push_back(JobEvent::Described(PairDescribed {
                    described: self.told.len(),
                    of: candidates.len(),
                    description: description.clone(),
                }));
            }
        }
        if job.state.is_final() {
            self.ended = true;
            self.waiting.push_back(JobEvent::Ended(Box::new(job)));
        }
    }
}
