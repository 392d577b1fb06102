//! Locks with the interface of parking_lot that shuttle schedules within a check.

use std::ops::{Deref, DerefMut};
use std::sync::PoisonError;
use std::time::Duration;

use crate::is_checking;

/// A mutual exclusion lock, as `parking_lot::Mutex`.
#[derive(Debug)]
pub enum Mutex<T> {
    /// Of a thread of the operating system.
    Real(parking_lot::Mutex<T>),
    /// Of a thread that shuttle schedules.
    Checked(shuttle::sync::Mutex<T>),
}

/// Access to what a [`Mutex`] protects, until it is dropped.
#[derive(Debug)]
pub enum MutexGuard<'a, T> {
    /// Of a real lock.
    Real(parking_lot::MutexGuard<'a, T>),
    /// Of a checked lock; `None` while [`Condvar::wait`] has given it away.
    Checked(Option<shuttle::sync::MutexGuard<'a, T>>),
}

impl<T> Mutex<T> {
    /// A lock that is free.
    pub fn new(value: T) -> Self {
        match is_checking() {
            true => Self::Checked(shuttle::sync::Mutex::new(value)),
            false => Self::Real(parking_lot::Mutex::new(value)),
        }
    }

    /// Blocks until the lock is free, and takes it. A panic of an earlier holder is no error.
    pub fn lock(&self) -> MutexGuard<'_, T> {
        match self {
            Self::Real(lock) => MutexGuard::Real(lock.lock()),
            Self::Checked(lock) => {
                MutexGuard::Checked(Some(lock.lock().unwrap_or_else(PoisonError::into_inner)))
            }
        }
    }
}

impl<T: Default> Default for Mutex<T> {
    fn default() -> Self {
        Self::new(T::default())
    }
}

impl<T> From<T> for Mutex<T> {
    fn from(value: T) -> Self {
        Self::new(value)
    }
}

impl<T> Deref for MutexGuard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        match self {
            Self::Real(guard) => guard,
            Self::Checked(Some(guard)) => guard,
            Self::Checked(None) => unreachable!("the guard is only away while its thread waits"),
        }
    }
}

impl<T> DerefMut for MutexGuard<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        match self {
            Self::Real(guard) => guard,
            Self::Checked(Some(guard)) => guard,
            Self::Checked(None) => unreachable!("the guard is only away while its thread waits"),
        }
    }
}

/// A condition variable, as `parking_lot::Condvar`.
#[derive(Debug)]
pub enum Condvar {
    /// Of threads of the operating system.
    Real(parking_lot::Condvar),
    /// Of threads that shuttle schedules.
    Checked(shuttle::sync::Condvar),
}

impl Condvar {
    /// A condition variable that no thread waits for.
    pub fn new() -> Self {
        match is_checking() {
            true => Self::Checked(shuttle::sync::Condvar::new()),
            false => Self::Real(parking_lot::Condvar::new()),
        }
    }

    /// Releases the lock, waits for a notification and takes the lock again.
    pub fn wait<T>(&self, guard: &mut MutexGuard<'_, T>) {
        match (self, guard) {
            (Self::Real(condvar), MutexGuard::Real(guard)) => condvar.wait(guard),
            (Self::Checked(condvar), MutexGuard::Checked(guard)) => {
                let waited = guard.take().map(|guard| condvar.wait(guard));
                *guard = waited.map(|guard| guard.unwrap_or_else(PoisonError::into_inner));
            }
            _ => unreachable!("a condition variable and its lock come from the same test"),
        }
    }

    /// Waits while `condition` holds, for at most `timeout`. In a check the timeout never passes.
    pub fn wait_while_for<T>(
        &self,
        guard: &mut MutexGuard<'_, T>,
        mut condition: impl FnMut(&mut T) -> bool,
        timeout: Duration,
    ) {
        if let (Self::Real(condvar), MutexGuard::Real(guard)) = (self, &mut *guard) {
            condvar.wait_while_for(guard, condition, timeout);
            return;
        }
        while condition(guard) {
            self.wait(guard);
        }
    }

    /// Wakes one waiting thread.
    pub fn notify_one(&self) {
        match self {
            Self::Real(condvar) => drop(condvar.notify_one()),
            Self::Checked(condvar) => condvar.notify_one(),
        }
    }

    /// Wakes all waiting threads.
    pub fn notify_all(&self) {
        match self {
            Self::Real(condvar) => drop(condvar.notify_all()),
            Self::Checked(condvar) => condvar.notify_all(),
        }
    }
}

impl Default for Condvar {
    fn default() -> Self {
        Self::new()
    }
}
