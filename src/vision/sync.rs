//! The locks of this crate's queues. Unit tests use ones whose schedule a model checker can choose.

#[cfg(not(test))]
pub(crate) use parking_lot::{Condvar, Mutex, MutexGuard};
#[cfg(test)]
pub(crate) use whereabouts_schedules::{Condvar, Mutex, MutexGuard};
