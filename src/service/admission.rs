//! What is asked of whoever brings a picture, before anything is done for it.

use super::{Service, ServiceError};
use whereabouts_vision::{AdmissionRequest, Permit, Rejected};

impl Service {
    /// Whether there is room for a picture; whoever is refused need not send it.
    pub fn check_admission(&self, demand: AdmissionRequest) -> Result<(), ServiceError> {
        self.admission.check(demand).map_err(|refused| self.counted(refused))
    }

    /// Waits for the permit to decode and infer one picture.
    pub(super) async fn admit(&self, demand: AdmissionRequest) -> Result<Permit, ServiceError> {
        self.admission.acquire(demand).await.map_err(|refused| self.counted(refused))
    }

    fn counted(&self, refused: Rejected) -> ServiceError {
        self.metrics.refusals.count(refused.reason.into());
        refused.into()
    }
}
