//! How many connections are open, and which of them makes room.

use std::collections::BTreeMap;
use std::sync::Arc;

use parking_lot::{Mutex, MutexGuard};
use tokio_util::sync::CancellationToken;

/// Places for connections. Clones share them.
#[derive(Debug, Clone)]
pub(super) struct Slots {
    shared: Arc<Shared>,
}

/// The place of one connection, free again when dropped.
#[derive(Debug)]
pub(super) struct Slot {
    shared: Arc<Shared>,
    evicted: CancellationToken,
    use_of: Mutex<Use>,
}

/// What a connection is doing.
#[derive(Debug)]
enum Use {
    /// Nothing; this is its key among the idle ones.
    Idle(u64),
    /// So many requests.
    Busy(usize),
}

#[derive(Debug)]
struct Shared {
    most: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Those that were told to go not counted.
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
        self.idle.insert(key, evicted.clone());
        key
    }
}

impl Slots {
    pub fn new(most: usize) -> Self {
        Self { shared: Arc::new(Shared { most, state: Mutex::default() }) }
    }

    /// A place, if need be that of the connection that has been idle for longest; `None` if all are
    /// busy.
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
        Some(Slot { shared: Arc::clone(&self.shared), evicted, use_of: Mutex::new(Use::Idle(key)) })
    }
}

impl Slot {
    /// Returns when another connection has been given this place.
    pub async fn taken_away(&self) {
        self.evicted.cancelled().await;
    }

    pub fn request_began(&self) {
        let mut use_of = self.use_of();
        *use_of = match *use_of {
            Use::Idle(key) => {
                self.shared.lock().idle.remove(&key);
                Use::Busy(1)
            }
            Use::Busy(requests) => Use::Busy(requests + 1),
        };
    }

    pub fn request_ended(&self) {
        let mut use_of = self.use_of();
        *use_of = match *use_of {
            Use::Busy(requests) if requests > 1 => Use::Busy(requests - 1),
            _ => Use::Idle(self.shared.lock().add_idle(&self.evicted)),
        };
    }

    fn use_of(&self) -> MutexGuard<'_, Use> {
        self.use_of.lock()
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
mod tests {
    use super::*;

    #[test]
    fn the_longest_idle_makes_room() {
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
