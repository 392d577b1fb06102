//! The locks of connection slots and body budgets. Unit tests use ones whose schedule a model checker can choose.

#[cfg(not(test))]
pub(crate) use parking_lot::{Mutex, MutexGuard};
#[cfg(test)]
pub(crate) use whereabouts_schedules::{Mutex, MutexGuard};
