//! What the workers of this process hold.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use parking_lot::{Mutex, MutexGuard};
use uuid::Uuid;

use super::super::Claim;

/// The jobs that workers of this process hold. One that the database says the process holds, and that is not
/// among these, was claimed in a transaction whose end was not heard.
#[derive(Default)]
pub(super) struct LocalClaims(Mutex<HashMap<Uuid, (Claim, Instant)>>);

impl LocalClaims {
    fn jobs(&self) -> MutexGuard<'_, HashMap<Uuid, (Claim, Instant)>> {
        self.0.lock()
    }

    /// Those whose leases have not ended.
    pub fn all(&self) -> Vec<Uuid> {
        let (mut jobs, now) = (self.jobs(), Instant::now());
        jobs.retain(|_, (_, until)| *until > now);
        jobs.keys().copied().collect()
    }

    pub fn has(&self, job: Uuid) -> bool {
        self.jobs().get(&job).is_some_and(|(_, until)| *until > Instant::now())
    }

    /// Holds a job as long as the returned value lives, or, if that is kept, until it is let go of or so many
    /// seconds have passed.
    pub fn hold(&self, claim: Claim, for_s: f64) -> ClaimGuard<'_> {
        let until = Instant::now() + Duration::from_secs_f64(for_s);
        self.jobs().insert(claim.job, (claim, until));
        ClaimGuard { held: self, claim: Some(claim) }
    }

    /// Not of a later claim: the job may have been taken again already.
    pub fn let_go(&self, claim: Claim) {
        let mut jobs = self.jobs();
        if jobs.get(&claim.job).is_some_and(|(known, _)| *known == claim) {
            jobs.remove(&claim.job);
        }
    }
}

/// A claim whose transaction is being ended.
pub(super) struct ClaimGuard<'a> {
    held: &'a LocalClaims,
    claim: Option<Claim>,
}

impl ClaimGuard<'_> {
    /// The transaction has ended well.
    pub fn keep(mut self) {
        self.claim = None;
    }
}

impl Drop for ClaimGuard<'_> {
    fn drop(&mut self) {
        if let Some(claim) = self.claim {
            self.held.let_go(claim);
        }
    }
}
