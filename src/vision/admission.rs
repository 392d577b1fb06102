//! Who may have a picture decoded and inferred, and who waits for that.
//!
//! A permit stands for one picture in work. There are just as many as keep decoding and inference
//! busy; all others wait here, where their order is known and little memory is held, or are refused.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::{Mutex, MutexGuard};
use tokio::sync::oneshot;

use whereabouts_core::ServiceTime;

/// Bounds on what is in work and what waits.
#[derive(Debug, Clone, Copy)]
pub struct AdmissionSettings {
    /// Pictures in work at a time.
    pub permits: usize,
    /// Pictures that wait, those in the background not counted.
    pub queue: usize,
    /// The longest wait.
    pub max_wait: Duration,
    /// The longest time that a caller is told to stay away.
    pub max_retry_after: Duration,
}

/// What a permit is for, the most urgent first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum WorkClass {
    /// A robot wants to know where it is.
    Localize,
    /// A map grows, or a person looks at it.
    Index,
    /// Nobody waits for an answer: never refused, and served when no other waits.
    Background,
}

/// What a permit is for, and until when it is of use.
#[derive(Debug, Clone, Copy)]
pub struct AdmissionRequest {
    /// What it is for.
    pub class: WorkClass,
    /// When the caller no longer wants the answer.
    pub deadline: Option<Instant>,
}

impl AdmissionRequest {
    /// Of work that nobody waits for.
    pub const BACKGROUND: Self = Self { class: WorkClass::Background, deadline: None };
}

/// Why there is no permit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RejectReason {
    /// As many wait as may wait.
    QueueFull,
    /// It would wait longer than is allowed, or has.
    WaitTooLong,
    /// The answer would come after the deadline.
    DeadlineTooSoon,
}

/// There is no permit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{}", self.sentence())]
pub struct Rejected {
    /// Why not.
    pub reason: RejectReason,
    /// When what is in work and waits now should be done, at the pace of late, within bounds.
    pub retry_after: Duration,
    /// Pictures that wait.
    pub waiting: usize,
}

impl Rejected {
    fn sentence(&self) -> String {
        let Self { waiting, .. } = self;
        match self.reason {
            RejectReason::QueueFull => {
                format!("{waiting} pictures wait already, the bound (image.queue)")
            }
            RejectReason::WaitTooLong => format!(
                "{waiting} pictures wait already, and another would wait for longer than \
                 image.max_wait_ms allows"
            ),
            RejectReason::DeadlineTooSoon => format!(
                "{waiting} pictures wait already, so that the answer would come after the \
                 X-Deadline-Ms of the request"
            ),
        }
    }
}

/// What is in work and what waits at the moment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AdmissionLevels {
    /// Permits that there are.
    pub permits: usize,
    /// Permits in use.
    pub in_use: usize,
    /// Frames that wait.
    pub localize: usize,
    /// Images that wait to be indexed or shown.
    pub index: usize,
    /// Pictures that wait in the background.
    pub background: usize,
}

/// Gives out permits. Clones share them.
#[derive(Debug, Clone)]
pub struct Admission {
    shared: Arc<Shared>,
}

/// One picture in work; given back when dropped.
#[derive(Debug)]
pub struct Permit {
    shared: Arc<Shared>,
    since: Instant,
}

#[derive(Debug)]
struct Shared {
    settings: AdmissionSettings,
    line: Mutex<WaitQueue>,
}

type Waiter = oneshot::Sender<Permit>;

#[derive(Debug, Default)]
struct WaitQueue {
    in_use: usize,
    /// By class. Who has gone is still here until somebody looks.
    waiting: [VecDeque<Waiter>; 3],
    pace: ServiceTime,
}

enum Place {
    Inside(Permit),
    Waiting(oneshot::Receiver<Permit>),
}

impl Admission {
    /// All permits are free.
    pub fn new(settings: AdmissionSettings) -> Self {
        let settings = AdmissionSettings { permits: settings.permits.max(1), ..settings };
        Self { shared: Arc::new(Shared { settings, line: Mutex::default() }) }
    }

    /// Whether a permit is to be had; who would be refused hears so before it sends its picture.
    pub fn check(&self, demand: AdmissionRequest) -> Result<(), Rejected> {
        self.shared.check(&mut self.shared.lock(), demand)
    }

    /// Waits for a permit. A future that is dropped waits no longer.
    pub async fn acquire(&self, demand: AdmissionRequest) -> Result<Permit, Rejected> {
        let waiting = match self.shared.join(demand)? {
            Place::Inside(permit) => return Ok(permit),
            Place::Waiting(waiting) => waiting,
        };
        let refused = |reason| self.shared.refused(&self.shared.lock(), reason);
        let admitted = if demand.class == WorkClass::Background {
            waiting.await
        } else {
            match tokio::time::timeout(self.shared.settings.max_wait, waiting).await {
                Ok(admitted) => admitted,
                Err(_) => return Err(refused(RejectReason::WaitTooLong)),
            }
        };
        // Nobody else drops the other end but to make room.
        admitted.map_err(|_| refused(RejectReason::QueueFull))
    }

    /// The share of the queue that is taken, from 0 to 1.
    pub fn pressure(&self) -> f64 {
        let mut line = self.shared.lock();
        line.prune();
        line.bounded() as f64 / self.shared.settings.queue.max(1) as f64
    }

    /// When what is in work and waits now should be done, at the pace of late.
    pub fn retry_after(&self) -> Duration {
        self.shared.retry_after(&self.shared.lock())
    }

    /// A pause that callers may be told to make.
    pub fn clamp_pause(&self, pause: Duration) -> Duration {
        self.shared.clamp_pause(pause)
    }

    /// What is in work and what waits at the moment.
    pub fn levels(&self) -> AdmissionLevels {
        let mut line = self.shared.lock();
        line.prune();
        let [localize, index, background] = line.waiting.each_ref().map(VecDeque::len);
        let permits = self.shared.settings.permits;
        AdmissionLevels { permits, in_use: line.in_use, localize, index, background }
    }
}

impl Permit {
    /// The work was done to its end: its time tells those who come how long it takes.
    pub fn complete(&self) {
        let mut line = self.shared.lock();
        let side_by_side = line.in_use;
        line.pace.record(self.since.elapsed(), side_by_side);
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        self.shared.lock().in_use -= 1;
        self.shared.hand_out();
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, WaitQueue> {
        self.line.lock()
    }

    fn permit(self: &Arc<Self>) -> Permit {
        Permit { shared: Arc::clone(self), since: Instant::now() }
    }

    fn join(self: &Arc<Self>, demand: AdmissionRequest) -> Result<Place, Rejected> {
        let mut line = self.lock();
        self.check(&mut line, demand)?;
        if line.in_use < self.settings.permits {
            line.in_use += 1;
            return Ok(Place::Inside(self.permit()));
        }
        if demand.class == WorkClass::Localize && line.bounded() >= self.settings.queue {
            // What is to be indexed makes room: the last of it, which has waited least.
            line.waiting[WorkClass::Index as usize].pop_back();
        }
        let (waiter, waiting) = oneshot::channel();
        line.waiting[demand.class as usize].push_back(waiter);
        Ok(Place::Waiting(waiting))
    }

    fn check(&self, line: &mut WaitQueue, demand: AdmissionRequest) -> Result<(), Rejected> {
        line.prune();
        // Whoever is alone is served, whatever took long before.
        if demand.class == WorkClass::Background || line.in_use < self.settings.permits {
            return Ok(());
        }
        let gives_way = match demand.class {
            WorkClass::Localize => line.waiting[WorkClass::Index as usize].len(),
            WorkClass::Index | WorkClass::Background => 0,
        };
        if line.bounded() - gives_way >= self.settings.queue {
            return Err(self.refused(line, RejectReason::QueueFull));
        }
        let first = line.waiting.iter().take(demand.class as usize + 1);
        let wait = line.pace.until_done(first.map(VecDeque::len).sum::<usize>() + 1);
        if wait > self.settings.max_wait {
            return Err(self.refused(line, RejectReason::WaitTooLong));
        }
        let answered = Instant::now() + wait + line.pace.mean();
        if demand.deadline.is_some_and(|deadline| deadline < answered) {
            return Err(self.refused(line, RejectReason::DeadlineTooSoon));
        }
        Ok(())
    }

    fn refused(&self, line: &WaitQueue, reason: RejectReason) -> Rejected {
        Rejected { reason, retry_after: self.retry_after(line), waiting: line.bounded() }
    }

    fn retry_after(&self, line: &WaitQueue) -> Duration {
        self.clamp_pause(line.pace.until_done(line.bounded() + line.in_use))
    }

    fn clamp_pause(&self, pause: Duration) -> Duration {
        pause.min(self.settings.max_retry_after).max(Duration::from_secs(1))
    }

    /// Gives free permits to those who wait.
    fn hand_out(self: &Arc<Self>) {
        loop {
            let mut line = self.lock();
            if line.in_use >= self.settings.permits {
                return;
            }
            let next = line.waiting.iter_mut().find_map(VecDeque::pop_front);
            let Some(waiter) = next else { return };
            line.in_use += 1;
            drop(line);
            // If the waiter has gone, the permit comes back and is handed out again.
            let _ = waiter.send(self.permit());
        }
    }
}

impl WaitQueue {
    fn prune(&mut self) {
        for class in &mut self.waiting {
            class.retain(|waiter| !waiter.is_closed());
        }
    }

    /// Those whose number is bounded.
    fn bounded(&self) -> usize {
        self.waiting[..WorkClass::Background as usize].iter().map(VecDeque::len).sum()
    }
}

#[cfg(test)]
mod tests;
