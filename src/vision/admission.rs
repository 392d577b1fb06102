//! Admission control for decoding and inference.
//!
//! A permit stands for one picture in progress. There are as many permits as it takes to keep decoding and
//! inference busy. Further requests wait here, ordered by priority and holding little memory, or are rejected.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use whereabouts_core::ServiceTime;

use super::sync::{Mutex, MutexGuard};

/// Limits on pictures in progress and in the queue.
#[derive(Debug, Clone, Copy)]
pub struct AdmissionSettings {
    /// Maximum pictures in progress.
    pub permits: usize,
    /// Maximum waiting pictures, not counting background work.
    pub queue: usize,
    /// Maximum wait for a permit.
    pub max_wait: Duration,
    /// Maximum `Retry-After`.
    pub max_retry_after: Duration,
}

/// The priority class of a request, most urgent first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum WorkClass {
    /// Localization of a frame.
    Localize,
    /// Indexing or showing an image.
    Index,
    /// Work without a waiting caller: never rejected, and served when no other request is waiting.
    Background,
}

/// A request for a permit.
#[derive(Debug, Clone, Copy)]
pub struct AdmissionRequest {
    /// Priority class.
    pub class: WorkClass,
    /// When the result is no longer useful to the caller.
    pub deadline: Option<Instant>,
}

impl AdmissionRequest {
    /// A request for background work.
    pub const BACKGROUND: Self = Self { class: WorkClass::Background, deadline: None };
}

/// Why a request was rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RejectReason {
    /// The queue is full.
    QueueFull,
    /// The wait would exceed the maximum, or has exceeded it.
    WaitTooLong,
    /// The result would not be ready before the deadline.
    DeadlineTooSoon,
}

/// A request was rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.sentence())]
pub struct Rejected {
    /// Why the request was rejected.
    pub reason: RejectReason,
    /// Estimated time until the current work is done, clamped to the configured maximum.
    pub retry_after: Duration,
    /// Pictures in the queue.
    pub waiting: usize,
}

impl Rejected {
    fn sentence(&self) -> String {
        let Self { waiting, .. } = self;
        match self.reason {
            RejectReason::QueueFull => {
                format!("the queue is full with {waiting} pictures (image.queue)")
            }
            RejectReason::WaitTooLong => format!(
                "{waiting} pictures are waiting, and another would wait longer than \
                 image.max_wait_ms allows"
            ),
            RejectReason::DeadlineTooSoon => format!(
                "{waiting} pictures are waiting, so the answer would miss the X-Deadline-Ms of the \
                 request"
            ),
        }
    }
}

/// Permits in use and requests waiting.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AdmissionLevels {
    /// Total permits.
    pub permits: usize,
    /// Permits in use.
    pub in_use: usize,
    /// Waiting frames.
    pub localize: usize,
    /// Images waiting to be indexed or shown.
    pub index: usize,
    /// Waiting background work.
    pub background: usize,
}

/// Issues permits. Clones share the same queue.
#[derive(Debug, Clone)]
pub struct Admission {
    shared: Arc<Shared>,
}

/// Permission to process one picture. Dropping it admits the next request.
#[derive(Debug)]
pub struct Permit {
    shared: Arc<Shared>,
    acquired: Instant,
}

#[derive(Debug)]
struct Shared {
    settings: AdmissionSettings,
    queue: Mutex<WaitQueue>,
}

type Waiter = oneshot::Sender<Permit>;

#[derive(Debug, Default)]
struct WaitQueue {
    in_use: usize,
    /// Waiters by class. A waiter whose caller has left stays until the next [`WaitQueue::prune`].
    waiting: [VecDeque<Waiter>; 3],
    service_time: ServiceTime,
}

enum Admitted {
    AtOnce(Permit),
    Queued(oneshot::Receiver<Permit>),
}

impl Admission {
    /// Creates an admission control with all permits free.
    pub fn new(settings: AdmissionSettings) -> Self {
        let settings = AdmissionSettings { permits: settings.permits.max(1), ..settings };
        Self { shared: Arc::new(Shared { settings, queue: Mutex::default() }) }
    }

    /// Checks whether a request would be rejected, so that the caller can be told before it uploads its picture.
    pub fn check(&self, request: AdmissionRequest) -> Result<(), Rejected> {
        self.shared.check(&mut self.shared.lock(), request)
    }

    /// Waits for a permit. Dropping the future leaves the queue.
    pub async fn acquire(&self, request: AdmissionRequest) -> Result<Permit, Rejected> {
        let permit = match self.shared.join(request)? {
            Admitted::AtOnce(permit) => return Ok(permit),
            Admitted::Queued(permit) => permit,
        };
        let rejected = |reason| self.shared.rejected(&self.shared.lock(), reason);
        let permit = if request.class == WorkClass::Background {
            permit.await
        } else {
            match tokio::time::timeout(self.shared.settings.max_wait, permit).await {
                Ok(permit) => permit,
                Err(_) => return Err(rejected(RejectReason::WaitTooLong)),
            }
        };
        // The sender is dropped only when the request is evicted to make room for a frame.
        permit.map_err(|_| rejected(RejectReason::QueueFull))
    }

    /// The fill level of the queue, 0 to 1.
    pub fn pressure(&self) -> f64 {
        let mut queue = self.shared.lock();
        queue.prune();
        queue.bounded() as f64 / self.shared.settings.queue.max(1) as f64
    }

    /// Estimated time until the current work is done, clamped to the configured maximum.
    pub fn retry_after(&self) -> Duration {
        self.shared.retry_after(&self.shared.lock())
    }

    /// Clamps a `Retry-After` to between one second and the configured maximum.
    pub fn clamp_pause(&self, pause: Duration) -> Duration {
        self.shared.clamp_pause(pause)
    }

    /// Permits in use and requests waiting.
    pub fn levels(&self) -> AdmissionLevels {
        let mut queue = self.shared.lock();
        queue.prune();
        let [localize, index, background] = queue.waiting.each_ref().map(VecDeque::len);
        let permits = self.shared.settings.permits;
        AdmissionLevels { permits, in_use: queue.in_use, localize, index, background }
    }
}

impl Permit {
    /// Records that the work was completed, so that its duration counts towards the average service time.
    pub fn complete(&self) {
        let mut queue = self.shared.lock();
        let concurrency = queue.in_use;
        queue.service_time.record(self.acquired.elapsed(), concurrency);
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut queue = self.shared.lock();
        queue.in_use -= 1;
        self.shared.admit_waiting(queue);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, WaitQueue> {
        self.queue.lock()
    }

    fn permit(self: &Arc<Self>) -> Permit {
        Permit { shared: Arc::clone(self), acquired: Instant::now() }
    }

    fn join(self: &Arc<Self>, request: AdmissionRequest) -> Result<Admitted, Rejected> {
        let mut queue = self.lock();
        self.check(&mut queue, request)?;
        if queue.in_use < self.settings.permits {
            queue.in_use += 1;
            return Ok(Admitted::AtOnce(self.permit()));
        }
        if request.class == WorkClass::Localize && queue.bounded() >= self.settings.queue {
            // Evict the index request that has waited least.
            queue.waiting[WorkClass::Index as usize].pop_back();
        }
        let (waiter, permit) = oneshot::channel();
        queue.waiting[request.class as usize].push_back(waiter);
        Ok(Admitted::Queued(permit))
    }

    fn check(&self, queue: &mut WaitQueue, request: AdmissionRequest) -> Result<(), Rejected> {
        queue.prune();
        // A request is never rejected while a permit is free, however slow earlier work was.
        if request.class == WorkClass::Background || queue.in_use < self.settings.permits {
            return Ok(());
        }
        let evictable = match request.class {
            WorkClass::Localize => queue.waiting[WorkClass::Index as usize].len(),
            WorkClass::Index | WorkClass::Background => 0,
        };
        if queue.bounded() - evictable >= self.settings.queue {
            return Err(self.rejected(queue, RejectReason::QueueFull));
        }
        let ahead = queue.waiting.iter().take(request.class as usize + 1);
        let wait = queue.service_time.until_done(ahead.map(VecDeque::len).sum::<usize>() + 1);
        if wait > self.settings.max_wait {
            return Err(self.rejected(queue, RejectReason::WaitTooLong));
        }
        let finished = Instant::now() + wait + queue.service_time.mean();
        if request.deadline.is_some_and(|deadline| deadline < finished) {
            return Err(self.rejected(queue, RejectReason::DeadlineTooSoon));
        }
        Ok(())
    }

    fn rejected(&self, queue: &WaitQueue, reason: RejectReason) -> Rejected {
        Rejected { reason, retry_after: self.retry_after(queue), waiting: queue.bounded() }
    }

    fn retry_after(&self, queue: &WaitQueue) -> Duration {
        self.clamp_pause(queue.service_time.until_done(queue.bounded() + queue.in_use))
    }

    fn clamp_pause(&self, pause: Duration) -> Duration {
        pause.min(self.settings.max_retry_after).max(Duration::from_secs(1))
    }

    /// Gives free permits to waiting requests. The lock is held since a permit became free, so that no
    /// newcomer overtakes a waiting request.
    fn admit_waiting(self: &Arc<Self>, mut queue: MutexGuard<'_, WaitQueue>) {
        while queue.in_use < self.settings.permits {
            let next = queue.waiting.iter_mut().find_map(VecDeque::pop_front);
            let Some(waiter) = next else { return };
            queue.in_use += 1;
            if let Err(unused) = waiter.send(self.permit()) {
                // The waiter has left. Dropping its permit, without the lock, admits the next one.
                drop(queue);
                return drop(unused);
            }
        }
    }
}

impl WaitQueue {
    /// Removes waiters whose caller has left.
    fn prune(&mut self) {
        for class in &mut self.waiting {
            class.retain(|waiter| !waiter.is_closed());
        }
    }

    /// Number of waiting requests that count towards the limit of the queue.
    fn bounded(&self) -> usize {
        self.waiting[..WorkClass::Background as usize].iter().map(VecDeque::len).sum()
    }
}

#[cfg(test)]
mod schedules;
#[cfg(test)]
mod tests;
