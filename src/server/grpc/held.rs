//! The memory that the messages of a call, or a body, take.

use std::sync::Arc;

use parking_lot::{Mutex, MutexGuard};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// What the messages, or a body, that have come hold of the memory for bodies, until somebody takes it over
/// together with a message, or the request has been answered. Clones share it.
#[derive(Debug, Clone, Default)]
pub struct BodyBudget(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    held: Option<OwnedSemaphorePermit>,
    answered: bool,
}

impl BodyBudget {
    /// Takes so much of the memory, if there is as much.
    pub fn try_add(&self, memory: &Arc<Semaphore>, bytes: usize) -> bool {
        if self.is_answered() {
            return true;
        }
        let count = u32::try_from(bytes).unwrap_or(u32::MAX);
        match Arc::clone(memory).try_acquire_many_owned(count) {
            Ok(more) => self.add(more),
            Err(_) => return false,
        }
        true
    }

    /// Holds what has been taken.
    pub fn add(&self, more: OwnedSemaphorePermit) {
        let mut state = self.lock();
        if state.answered {
            return;
        }
        match state.held.as_mut() {
            Some(held) => held.merge(more),
            None => state.held = Some(more),
        }
    }

    /// What the messages so far hold, for whoever has taken the last of them.
    pub fn take(&self) -> Option<OwnedSemaphorePermit> {
        self.lock().held.take()
    }

    /// Gives all back: what still comes is thrown away.
    pub fn answered(&self) {
        *self.lock() = State { held: None, answered: true };
    }

    /// Whether the call has been answered.
    pub fn is_answered(&self) -> bool {
        self.lock().answered
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock()
    }
}
