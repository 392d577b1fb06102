//! What a change makes of a record, whichever store keeps it.

use jiff::Timestamp;
use uuid::Uuid;

use super::{IdempotencyRecord, JobRecord, Progress, Release, Step, StoreError, StoredDelivery};
use whereabouts_core::{
    Attempt, Delivery, DeliveryState, Descriptor, Disposition, Image, Job, JobState, Map, Message,
    Priority, StoredWebhook, Usage, WebhookEvent,
};

impl JobRecord {
    /// Gives the job to a worker.
    pub(super) fn take(&mut self, now: Timestamp) {
        self.job.state = JobState::Running;
        self.job.error = None;
        self.job.started_at.get_or_insert(now);
        self.job.attempts += 1;
        self.claims += 1;
    }

    /// Gives the job back to the queue.
    pub(super) fn give_back(&mut self, release: &Release) {
        self.job.state = JobState::Queued;
        self.job.error = Some(release.why.clone());
        if !release.counts {
            self.job.attempts = self.job.attempts.saturating_sub(1);
        }
    }

    /// Ends a job that has not ended; `false` if it has.
    pub(super) fn cancel(&mut self, now: Timestamp) -> bool {
        if self.job.state.is_final() {
            return false;
        }
        self.job.state = JobState::Cancelled;
        self.job.finished_at = Some(now);
        true
    }

    /// Queues a job again that ended without success.
    pub(super) fn queue_again(&mut self) -> Result<(), StoreError> {
        let job = &mut self.job;
        match job.state {
            JobState::Failed | JobState::Cancelled | JobState::Degraded => {}
            state => {
                return Err(StoreError::Conflict(format!(
                    "the job is {state}; only a failed, degraded or cancelled one is retried"
                )));
            }
        }
        job.state = JobState::Queued;
        (job.attempts, job.usage, job.finished_at, job.error) = (0, Usage::default(), None, None);
        Ok(())
    }

    /// Adds a step: its cost, and its description in the place of one of the same image.
    pub fn add(&mut self, step: Step) {
        let Self { job, candidates, .. } = self;
        job.usage += step.usage;
        if let Some(description) = step.description {
            job.descriptions.retain(|known| known.image_id != description.image_id);
            job.descriptions.push(description);
            job.descriptions.sort_by_key(|description| {
                candidates.iter().position(|candidate| candidate.image_id == description.image_id)
            });
        }
    }
}

impl IdempotencyRecord {
    /// What takes the place of `known`, which counts no more: what was queued for the same request is queued.
    pub(super) fn in_place_of(mut self, known: &Self) -> Self {
        if let (Progress::Running { job, .. }, Progress::Running { job: Some(queued), .. }) =
            (&mut self.progress, &known.progress)
            && self.fingerprint == known.fingerprint
        {
            *job = Some(*queued);
        }
        self
    }

    /// The job that was queued for the request, while it has no answer.
    pub(super) fn job(&self) -> Option<Uuid> {
        match self.progress {
            Progress::Running { job, .. } => job,
            Progress::Answered(_) => None,
        }
    }

    /// Notes that a job was queued for the request.
    pub(super) fn queued(&mut self, id: Uuid) {
        if let Progress::Running { job, .. } = &mut self.progress {
            *job = Some(id);
        }
    }
}

/// When a job ended that has ended.
pub(super) fn ended_at(job: &Job) -> Timestamp {
    job.finished_at.unwrap_or(job.created_at)
}

/// What webhooks are to be told of a job that has just ended.
pub(super) fn news_of(
    job: &Job,
    webhooks: impl IntoIterator<Item = StoredWebhook>,
) -> Result<Vec<StoredDelivery>, StoreError> {
    let Some(event) = WebhookEvent::of(job.state) else { return Ok(Vec::new()) };
    let now = Timestamp::now();
    let timestamp = job.finished_at.unwrap_or(now);
    let message = Message { event, timestamp, data: job };
    let body =
        serde_json::to_vec(&message).map_err(|error| StoreError::Failed(error.to_string()))?;
    let wanting = webhooks.into_iter().filter(|stored| stored.webhook.subscribes_to(event, job));
    let delivery = |stored: StoredWebhook| StoredDelivery {
        delivery: Delivery::queued(stored.webhook.id, event, Some(job.id), now),
        body: body.clone(),
    };
    Ok(wanting.map(delivery).collect())
}

/// The map that is stored when `wanted` is put in the place of `stored`.
pub(super) fn changed_map(
    stored: Map,
    wanted: Map,
    has_images: impl FnOnce() -> bool,
) -> Result<Map, StoreError> {
    if stored.revision != wanted.revision {
        return Err(StoreError::Superseded(stored.name));
    }
    let same = stored.is_compatible_with(&wanted) && stored.frame == wanted.frame;
    if !same && has_images() {
        return Err(StoreError::Conflict(format!(
            "the map {} has images, so its model ({} at {} precision), descriptor ({}) and frame ({}) \
             are fixed; `whereabouts index --reindex` changes model and descriptor, a new map has any \
             frame",
            stored.name, stored.model, stored.precision, stored.descriptor, stored.frame
        )));
    }
    // Descriptors of another shape go elsewhere.
    let uid = if same { stored.uid } else { wanted.uid };
    Ok(Map { uid, created_at: stored.created_at, ..wanted })
}

/// The image that is there already, if it has the bytes that were sent.
pub(super) fn same_bytes(present: Image, sent: &Image) -> Result<Image, StoreError> {
    if present.digest == sent.digest {
        return Ok(present);
    }
    Err(StoreError::Conflict(format!(
        "the image id {:?} is taken by other bytes ({}); choose another id, or delete that image first",
        sent.id.as_str(),
        present.digest
    )))
}

pub(super) fn removed(map: &Map) -> StoreError {
    StoreError::NotFound(format!("the map {} was removed", map.name))
}

/// Refuses a descriptor that a map cannot be searched for.
pub(super) fn check_dim(map: &Map, query: &Descriptor) -> Result<(), StoreError> {
    if query.dim() == map.dim {
        return Ok(());
    }
    Err(StoreError::Conflict(format!(
        "a descriptor of {} numbers cannot be searched in a map of {}",
        query.dim(),
        map.dim
    )))
}

pub(super) fn being_reindexed(map: &Map) -> StoreError {
    StoreError::Conflict(format!("the map {} is being reindexed already", map.name))
}

/// A priority's place in the queue; those of a lower number go first.
pub(super) fn place(priority: Priority) -> u8 {
    match priority {
        Priority::High => 0,
        Priority::Normal => 1,
        Priority::Low => 2,
    }
}

/// When a job was submitted, which its id says.
pub(super) fn submitted_at(id: Uuid) -> Option<Timestamp> {
    let (seconds, nanoseconds) = id.get_timestamp()?.to_unix();
    Timestamp::new(seconds.cast_signed(), nanoseconds.cast_signed()).ok()
}

pub(super) fn no_job(id: Uuid) -> StoreError {
    StoreError::NotFound(format!("there is no job {id}"))
}

pub(super) fn no_webhook(id: Uuid) -> StoreError {
    StoreError::NotFound(format!("there is no webhook {id}; GET /webhooks lists those there are"))
}

pub(super) fn no_delivery(id: Uuid) -> StoreError {
    StoreError::NotFound(format!(
        "the webhook has no delivery {id}; one that has ended is removed in time (webhooks.keep_days, \
         webhooks.max_deliveries)"
    ))
}

/// Refuses to tell a webhook something that is to be told nothing.
pub(super) fn check_enabled(stored: &StoredWebhook) -> Result<(), StoreError> {
    if stored.webhook.disabled_at.is_none() {
        return Ok(());
    }
    let why = stored.webhook.disabled_reason.as_deref().unwrap_or_default();
    Err(StoreError::Conflict(format!("the webhook is disabled ({why}); make another one")))
}

/// From now on a webhook is to be told nothing; `false` if that was so before.
pub(super) fn disable(stored: &mut StoredWebhook, at: Timestamp, why: &str) -> bool {
    let webhook = &mut stored.webhook;
    if webhook.disabled_at.is_some() {
        return false;
    }
    webhook.disabled_at = Some(at);
    webhook.disabled_reason = Some(why.to_owned());
    true
}

/// A delivery after an attempt; `None` if it waits no more.
pub(super) fn attempted(known: Delivery, attempt: Attempt) -> Option<Delivery> {
    // What was given up meanwhile has been delivered all the same.
    let counts =
        known.state == DeliveryState::Waiting || attempt.disposition == Disposition::Delivered;
    counts.then(|| known.with_attempt(attempt))
}

pub(super) fn too_many_webhooks(most: usize) -> StoreError {
    StoreError::Conflict(format!(
        "there are {most} webhooks, the most (webhooks.max); delete one first"
    ))
}

/// Refuses to queue a delivery again that waits anyway.
pub(super) fn check_ended(delivery: &Delivery) -> Result<(), StoreError> {
    match delivery.next_attempt_at {
        None => Ok(()),
        Some(next) => Err(StoreError::Conflict(format!(
            "the delivery waits anyway, and is tried at {next:.0}; there is nothing to do"
        ))),
    }
}
