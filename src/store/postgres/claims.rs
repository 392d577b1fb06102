//! The claims that this process knows to be its own.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use parking_lot::{Mutex, MutexGuard};
use uuid::Uuid;

use super::super::Claim;

/// The jobs that workers of this process hold. If the database says that this process holds another job,
/// that job was claimed in a transaction whose result was lost, and may be claimed again.
#[derive(Default)]
pub(super) struct LocalClaims(Mutex<HashMap<Uuid, (Claim, Instant)>>);

impl LocalClaims {
    fn jobs(&self) -> MutexGuard<'_, HashMap<Uuid, (Claim, Instant)>> {
        self.0.lock()
    }

    /// Returns the jobs whose leases have not expired.
    pub fn all(&self) -> Vec<Uuid> {
        let (mut jobs, now) = (self.jobs(), Instant::now());
        jobs.retain(|_, (_, until)| *until > now);
        jobs.keys().copied().collect()
    }

    pub fn has(&self, job: Uuid) -> bool {
        self.jobs().get(&job).is_some_and(|(_, until)| *until > Instant::now())
    }

    /// Registers a claim for a number of seconds. Dropping the guard removes it again, unless
    /// [`ClaimGuard::keep`] was called.
    pub fn hold(&self, claim: Claim, for_s: f64) -> ClaimGuard<'_> {
        let until = Instant::now() + Duration::from_secs_f64(for_s);
        self.jobs().insert(claim.job, (claim, until));
        ClaimGuard { claims: self, claim: Some(claim) }
    }

    /// Removes a claim, but not a later one of the same job.
    pub fn release(&self, claim: Claim) {
        let mut jobs = self.jobs();
        if jobs.get(&claim.job).is_some_and(|(current, _)| *current == claim) {
            jobs.remove(&claim.job);
        }
    }
}

/// A claim whose transaction is being committed.
pub(super) struct ClaimGuard<'a> {
    claims: &'a LocalClaims,
    claim: Option<Claim>,
}

impl ClaimGuard<'_> {
    /// Keeps the claim, because the transaction was committed.
    pub fn keep(mut self) {
        self.claim = None;
    }
}

impl Drop for ClaimGuard<'_> {
    fn drop(&mut self) {
        if let Some(claim) = self.claim {
            self.claims.release(claim);
        }
    }
}
