//! The share of the body memory that one request holds.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::sync::Mutex;

/// The share of the body memory held by one request. Released when the request is answered, or when ownership
/// moves to a decoded message. Clones share it.
#[derive(Debug, Clone, Default)]
pub(crate) struct BodyBudget(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    held: Option<OwnedSemaphorePermit>,
    /// The request has been answered: what still arrives is discarded and takes no memory.
    closed: bool,
}

impl BodyBudget {
    /// Reserves `bytes` of `memory`; false if there is not as much.
    pub fn try_add(&self, memory: &Arc<Semaphore>, bytes: usize) -> bool {
        if self.is_closed() {
            return true;
        }
        let count = u32::try_from(bytes).unwrap_or(u32::MAX);
        match Arc::clone(memory).try_acquire_many_owned(count) {
            Ok(permit) => self.add(permit),
            Err(_) => return false,
        }
        true
    }

    /// Adds memory that was reserved elsewhere.
    pub fn add(&self, permit: OwnedSemaphorePermit) {
        let mut state = self.0.lock();
        if state.closed {
            return;
        }
        match state.held.as_mut() {
            Some(held) => held.merge(permit),
            None => state.held = Some(permit),
        }
    }

    /// Moves the memory of all messages so far to the caller, who has decoded the last of them.
    #[cfg(feature = "grpc")]
    pub fn take(&self) -> Option<OwnedSemaphorePermit> {
        self.0.lock().held.take()
    }

    /// Releases everything, because the request has been answered.
    pub fn close(&self) {
        *self.0.lock() = State { held: None, closed: true };
    }

    /// Whether the request has been answered.
    pub fn is_closed(&self) -> bool {
        self.0.lock().closed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use whereabouts_schedules::{check, spawn};

    #[test]
    fn an_answered_request_holds_no_memory_whatever_still_arrives() {
        check(|| {
            let (budget, memory) = (BodyBudget::default(), Arc::new(Semaphore::new(5)));
            let arriving = [2, 1].map(|bytes| {
                let (budget, memory) = (budget.clone(), Arc::clone(&memory));
                spawn(move || {
                    for _ in 0..2 {
                        budget.try_add(&memory, bytes);
                    }
                })
            });
            let answering = budget.clone();
            let answered = spawn(move || answering.close());
            #[cfg(feature = "grpc")]
            drop(budget.take());
            arriving.into_iter().chain([answered]).for_each(|thread| thread.join().unwrap());
            assert!(budget.is_closed());
            assert_eq!(memory.available_permits(), 5);
        });
    }

    #[test]
    fn a_request_holds_what_it_could_reserve_and_no_more() {
        check(|| {
            let memory = Arc::new(Semaphore::new(3));
            let budgets = [BodyBudget::default(), BodyBudget::default()];
            let reserving = budgets.clone().map(|budget| {
                let memory = Arc::clone(&memory);
                spawn(move || {
                    [1, 1].into_iter().filter(|one| budget.try_add(&memory, *one)).count()
                })
            });
            let reserved = reserving.into_iter().map(|thread| thread.join().unwrap());
            assert_eq!(reserved.sum::<usize>(), 3);
            assert_eq!(memory.available_permits(), 0);
            drop(budgets);
            assert_eq!(memory.available_permits(), 3);
        });
    }
}
