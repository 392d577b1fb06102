//! Bounds the number of open connections, and evicts an idle one for a new one.

use std::collections::BTreeMap;
use std::sync::Arc;

use tokio_util::sync::CancellationToken;

use crate::sync::{Mutex, MutexGuard};

/// Slots for connections. Clones share them.
#[derive(Debug, Clone)]
pub(super) struct Slots {
    shared: Arc<Shared>,
}

/// The slot of one connection, free again when dropped.
#[derive(Debug)]
pub(super) struct Slot {
    shared: Arc<Shared>,
    evicted: CancellationToken,
    activity: Mutex<Activity>,
}

/// What a connection is doing.
#[derive(Debug)]
enum Activity {
    /// No request is in progress; this is its key among the idle connections.
    Idle(u64),
    /// The number of requests in progress.
    Busy(usize),
}

#[derive(Debug)]
struct Shared {
    most: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Connections that were evicted do not count.
    open: usize,
    next_key: u64,
    /// Connections without a request in progress, the longest idle first.
    idle: BTreeMap<u64, CancellationToken>,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock()
    }
}

impl State {
    fn add_idle(&mut self, evicted: &CancellationToken) -> u64 {
        let key = self.next_key;
        self.next_key += 1;
        // A connection that was evicted during a request has no slot left to give.
        if !evicted.is_cancelled() {
            self.idle.insert(key, evicted.clone());
        }
        key
    }
}

impl Slots {
    pub fn new(most: usize) -> Self {
        Self { shared: Arc::new(Shared { most, state: Mutex::default() }) }
    }

    /// Returns a free slot, evicting the connection that has been idle longest if there is none; `None` if all
    /// are busy.
    pub fn take(&self) -> Option<Slot> {
        let mut state = self.shared.lock();
        if state.open < self.shared.most {
            state.open += 1;
        } else {
            let (_, longest_idle) = state.idle.pop_first()?;
            longest_idle.cancel();
        }
        let evicted = CancellationToken::new();
        let key = state.add_idle(&evicted);
        Some(Slot {
            shared: Arc::clone(&self.shared),
            evicted,
            activity: Mutex::new(Activity::Idle(key)),
        })
    }
}

impl Slot {
    /// Returns when this connection is evicted.
    pub async fn evicted(&self) {
        self.evicted.cancelled().await;
    }

    /// Whether no request is in progress.
    pub fn is_idle(&self) -> bool {
        matches!(*self.activity.lock(), Activity::Idle(_))
    }

    pub fn request_began(&self) {
        let mut activity = self.activity.lock();
        *activity = match *activity {
            Activity::Idle(key) => {
                self.shared.lock().idle.remove(&key);
                Activity::Busy(1)
            }
            Activity::Busy(requests) => Activity::Busy(requests + 1),
        };
    }

    pub fn request_ended(&self) {
        let mut activity = self.activity.lock();
        *activity = match *activity {
            Activity::Busy(requests) if requests > 1 => Activity::Busy(requests - 1),
            _ => Activity::Idle(self.shared.lock().add_idle(&self.evicted)),
        };
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.request_began();
        let mut state = self.shared.lock();
        if !self.evicted.is_cancelled() {
            state.open -= 1;
        }
    }
}

#[cfg(test)]
mod schedules;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_connection_that_has_been_idle_longest_is_evicted() {
        let slots = Slots::new(3);
        let (a, b, c) = (slots.take().unwrap(), slots.take().unwrap(), slots.take().unwrap());
        a.request_began();
        a.request_ended();
        c.request_began();
        c.request_began();
        c.request_ended();
        let d = slots.take().unwrap();
        assert!(b.evicted.is_cancelled() && !a.evicted.is_cancelled());
        d.request_began();
        let e = slots.take().unwrap();
        assert!(a.evicted.is_cancelled());
        e.request_began();
        assert!(slots.take().is_none(), "all are busy");
        drop((a, b, c));
        assert!(slots.take().is_some());
        assert_eq!(slots.shared.lock().open, 2);
    }
}
