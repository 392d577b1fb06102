//! State transitions of records and the errors they share, the same for every store.

use jiff::Timestamp;
use uuid::Uuid;

use super::{
    IdempotencyRecord, JobRecord, LocatedImage, Progress, Release, Step, StoreError, StoredDelivery,
};
use whereabouts_core::{
    Attempt, Delivery, DeliveryState, Descriptor, Disposition, Image, Job, JobState, Map, Message,
    Priority, Recording, StoredWebhook, Usage, WebhookEvent,
};

/// Returns images in the order of recording.
pub(super) fn in_order(mut images: Vec<(LocatedImage, Option<Recording>)>) -> Vec<LocatedImage> {
    Recording::sort(&mut images, |(image, recording)| (image.slot, *recording));
    images.into_iter().map(|(image, _)| image).collect()
}

impl JobRecord {
    /// Starts an attempt by a worker.
    pub(super) fn start_attempt(&mut self, now: Timestamp) {
        self.job.state = JobState::Running;
        self.job.error = None;
        self.job.started_at.get_or_insert(now);
        self.job.attempts += 1;
        self.claims += 1;
    }

    /// Returns the job to the queue.
    pub(super) fn requeue(&mut self, release: &Release) {
        self.job.state = JobState::Queued;
        self.job.error = Some(release.why.clone());
        if !release.counts {
            self.job.attempts = self.job.attempts.saturating_sub(1);
        }
    }

    /// Cancels the job. Returns `false` if it had already ended.
    pub(super) fn cancel(&mut self, now: Timestamp) -> bool {
        if self.job.state.is_final() {
            return false;
        }
        self.job.state = JobState::Cancelled;
        self.job.finished_at = Some(now);
        true
    }

    /// Queues a failed, cancelled or degraded job again. With `fresh_since`, which has descriptions from before
    /// bought again, any job that has ended.
    pub(super) fn retry(&mut self, fresh_since: Option<Timestamp>) -> Result<(), StoreError> {
        let job = &mut self.job;
        match job.state {
            JobState::Failed | JobState::Cancelled | JobState::Degraded => {}
            JobState::Succeeded if fresh_since.is_some() => {}
            state => {
                return Err(StoreError::Conflict(format!(
                    "the job is {state}; only a failed, degraded or cancelled one is retried, and with \
                     fresh=true also one that has succeeded"
                )));
            }
        }
        job.state = JobState::Queued;
        job.fresh_since = fresh_since;
        (job.attempts, job.usage, job.finished_at, job.error) = (0, Usage::default(), None, None);
        Ok(())
    }

    /// Adds the cost of a step, and its description, which replaces an earlier one of the same image.
    pub fn add(&mut self, step: Step) {
        let Self { job, candidates, .. } = self;
        job.usage += step.usage;
        if let Some(description) = step.description {
            job.descriptions.retain(|earlier| earlier.image_id != description.image_id);
            job.descriptions.push(description);
            job.descriptions.sort_by_key(|description| {
                candidates.iter().position(|candidate| candidate.image_id == description.image_id)
            });
        }
    }
}

impl IdempotencyRecord {
    /// Replaces a record that no longer counts, and inherits the job queued for the same request.
    pub(super) fn replacing(mut self, earlier: &Self) -> Self {
        if let (Progress::Running { job, .. }, Progress::Running { job: Some(queued), .. }) =
            (&mut self.progress, &earlier.progress)
            && self.fingerprint == earlier.fingerprint
        {
            *job = Some(*queued);
        }
        self
    }

    /// Returns the job queued for the request, while the request has no response.
    pub(super) fn job(&self) -> Option<Uuid> {
        match self.progress {
            Progress::Running { job, .. } => job,
            Progress::Answered(_) => None,
        }
    }

    /// Records the job queued for the request.
    pub(super) fn set_job(&mut self, id: Uuid) {
        if let Progress::Running { job, .. } = &mut self.progress {
            *job = Some(id);
        }
    }
}

/// Returns when an ended job ended.
pub(super) fn ended_at(job: &Job) -> Timestamp {
    job.finished_at.unwrap_or(job.created_at)
}

/// Returns the deliveries to send because a job has ended.
pub(super) fn deliveries_for(
    job: &Job,
    webhooks: impl IntoIterator<Item = StoredWebhook>,
) -> Result<Vec<StoredDelivery>, StoreError> {
    let Some(event) = WebhookEvent::of(job.state) else { return Ok(Vec::new()) };
    let now = Timestamp::now();
    let timestamp = job.finished_at.unwrap_or(now);
    let message = Message { event, timestamp, data: job };
    let body =
        serde_json::to_vec(&message).map_err(|error| StoreError::Failed(error.to_string()))?;
    let subscribed = webhooks.into_iter().filter(|stored| stored.webhook.subscribes_to(event, job));
    let delivery = |stored: StoredWebhook| StoredDelivery {
        delivery: Delivery::queued(stored.webhook.id, event, Some(job.id), now),
        body: body.clone(),
    };
    Ok(subscribed.map(delivery).collect())
}

/// What a map contains, as far as it limits changes of the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MapContent {
    /// No images.
    Empty,
    /// Images, none of which has a pose.
    WithoutPoses,
    /// Images with poses.
    WithPoses,
}

/// Returns the record to store when a map is changed from `stored` to `requested`.
pub(super) fn changed_map(
    stored: Map,
    requested: Map,
    content: impl FnOnce() -> Result<MapContent, StoreError>,
) -> Result<Map, StoreError> {
    if stored.revision != requested.revision {
        return Err(StoreError::Superseded(stored.name));
    }
    let same_descriptors = stored.is_compatible_with(&requested);
    let same_frame = stored.frame == requested.frame;
    // A new uid gives descriptors of another shape a folder or table of their own.
    let mut uid = stored.uid;
    if !(same_descriptors && same_frame) {
        match content()? {
            MapContent::Empty => uid = requested.uid,
            MapContent::WithoutPoses if same_descriptors => {}
            MapContent::WithPoses if same_descriptors => {
                return Err(StoreError::Conflict(format!(
                    "images of the map {} have poses in the coordinate frame {}, so that is fixed and cannot \
                     become {}; remove their poses first (PATCH each image with {{\"pose\": null}}), or index them in \
                     a new map",
                    stored.name, stored.frame, requested.frame
                )));
            }
            MapContent::WithoutPoses | MapContent::WithPoses => {
                return Err(StoreError::Conflict(format!(
                    "the map {} has images, so its model ({} at {} precision) and descriptor ({}) are \
                     fixed; `whereabouts index --reindex` changes both",
                    stored.name, stored.model, stored.precision, stored.descriptor
                )));
            }
        }
    }
    Ok(Map { uid, created_at: stored.created_at, ..requested })
}

/// Refuses a pose in another coordinate frame than the map's, which was changed after the caller read it.
pub(super) fn check_frame(map: &Map, image: &Image) -> Result<(), StoreError> {
    match image.pose {
        Some(pose) if pose.frame() != map.frame => Err(StoreError::Superseded(map.name.clone())),
        _ => Ok(()),
    }
}

/// Returns the stored image if it has the bytes that were sent, otherwise a conflict.
pub(super) fn same_bytes(present: Image, sent: &Image) -> Result<Image, StoreError> {
    if present.digest == sent.digest {
        return Ok(present);
    }
    Err(StoreError::Conflict(format!(
        "the image id {:?} is taken by an image with other bytes ({}); choose another id, or delete \
         that image first",
        sent.id.as_str(),
        present.digest
    )))
}

pub(super) fn removed(map: &Map) -> StoreError {
    StoreError::NotFound(format!("the map {} was removed", map.name))
}

/// Refuses a query descriptor whose dimension differs from the map's.
pub(super) fn check_dim(map: &Map, query: &Descriptor) -> Result<(), StoreError> {
    if query.dim() == map.dim {
        return Ok(());
    }
    Err(StoreError::Conflict(format!(
        "the query's descriptor has {} dimensions, those of the map have {}",
        query.dim(),
        map.dim
    )))
}

pub(super) fn being_reindexed(map: &Map) -> StoreError {
    StoreError::Conflict(format!("the map {} is already being reindexed", map.name))
}

/// Returns the sort key of a priority in the queue; lower numbers go first.
pub(super) fn queue_rank(priority: Priority) -> u8 {
    match priority {
        Priority::High => 0,
        Priority::Normal => 1,
        Priority::Low => 2,
    }
}

/// Returns when a job was submitted, from the timestamp in its id.
pub(super) fn submitted_at(id: Uuid) -> Option<Timestamp> {
    let (seconds, nanoseconds) = id.get_timestamp()?.to_unix();
    Timestamp::new(seconds.cast_signed(), nanoseconds.cast_signed()).ok()
}

pub(super) fn no_job(id: Uuid) -> StoreError {
    StoreError::NotFound(format!("there is no job {id}"))
}

pub(super) fn no_webhook(id: Uuid) -> StoreError {
    StoreError::NotFound(format!("there is no webhook {id}; GET /webhooks lists the existing ones"))
}

pub(super) fn no_delivery(id: Uuid) -> StoreError {
    StoreError::NotFound(format!(
        "the webhook has no delivery {id}; ended deliveries are removed after a while \
         (webhooks.keep_days, webhooks.max_deliveries)"
    ))
}

/// Refuses a webhook that is disabled.
pub(super) fn check_enabled(stored: &StoredWebhook) -> Result<(), StoreError> {
    if stored.webhook.disabled_at.is_none() {
        return Ok(());
    }
    let why = stored.webhook.disabled_reason.as_deref().unwrap_or_default();
    Err(StoreError::Conflict(format!("the webhook is disabled ({why}); create another one")))
}

/// Disables a webhook. Returns `false` if it already was.
pub(super) fn disable(stored: &mut StoredWebhook, at: Timestamp, why: &str) -> bool {
    let webhook = &mut stored.webhook;
    if webhook.disabled_at.is_some() {
        return false;
    }
    webhook.disabled_at = Some(at);
    webhook.disabled_reason = Some(why.to_owned());
    true
}

/// Returns a delivery as it is after an attempt; `None` if it was no longer waiting. An attempt that is recorded
/// already, by a call that failed after its commit, counts once.
pub(super) fn attempted(delivery: Delivery, attempt: Attempt) -> Option<Delivery> {
    if delivery.last_attempt_at == Some(attempt.at) {
        return Some(delivery);
    }
    // A success counts even if the delivery was given up while the attempt ran.
    let counts =
        delivery.state == DeliveryState::Waiting || attempt.disposition == Disposition::Delivered;
    counts.then(|| delivery.with_attempt(attempt))
}

pub(super) fn too_many_webhooks(max: usize) -> StoreError {
    StoreError::Conflict(format!(
        "there are already {max} webhooks, the maximum (webhooks.max); delete one first"
    ))
}

/// Refuses to requeue a delivery that is still waiting.
pub(super) fn check_ended(delivery: &Delivery) -> Result<(), StoreError> {
    match delivery.next_attempt_at {
        None => Ok(()),
        Some(next) => Err(StoreError::Conflict(format!(
            "the delivery waits anyway, and is tried at {next:.0}; there is nothing to do"
        ))),
    }
}
