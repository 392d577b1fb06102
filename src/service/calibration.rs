//! Measures in each map how far chance resemblance goes; see [`whereabouts_core::confidence`].

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::{Service, ServiceError};
use whereabouts_core::confidence::{COMPARED, NullDistribution};
use whereabouts_core::{Calibration, Evidence, Map};
use whereabouts_refine::{AttemptPolicy, NegativeEvidence, Refiner};
use whereabouts_store::IndexState;

/// How often it is looked for maps that have changed.
const LOOK: Duration = Duration::from_millis(500);

/// Where a look takes long, because there are many maps, the pause is so many times as long.
const PAUSE_PER_LOOK: u32 = 10;

/// But no longer than this: measuring takes long too.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

/// How long to wait for one image while the threads that refine are busy: jobs have priority.
const ATTEMPTS: AttemptPolicy = AttemptPolicy {
    attempts: 301,
    pause: Duration::from_millis(200),
    longest_pause: Duration::from_millis(200),
};

/// A map is measured again when its number of images has changed by one in so many.
const CHANGED: usize = 5;

impl Service {
    /// Measures maps when their images have changed, until `shutdown`.
    pub async fn keep_calibrated(&self, shutdown: CancellationToken) {
        let mut seen = BTreeMap::new();
        let mut pause = LOOK;
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(pause) => {}
            }
            let began = Instant::now();
            let measured = tokio::select! {
                () = shutdown.cancelled() => return,
                measured = self.calibrate_settled(&mut seen) => measured,
            };
            if let Err(error) = measured {
                // A map was removed or reindexed meanwhile; the next look sees to it.
                tracing::debug!(%error, "a map could not be measured");
            }
            pause = LOOK.max(began.elapsed() * PAUSE_PER_LOOK).min(LONGEST_PAUSE);
        }
    }

    /// Measures the maps that need it and have as many images as at the last look.
    async fn calibrate_settled(
        &self,
        seen: &mut BTreeMap<Uuid, usize>,
    ) -> Result<(), ServiceError> {
        let maps = self.maps.maps().await?;
        seen.retain(|uid, _| maps.iter().any(|map| map.uid == *uid));
        for map in maps {
            let IndexState { images, .. } = self.maps.index_state(&map).await?;
            let settled = seen.insert(map.uid, images) == Some(images);
            if settled && self.is_due(&map, images).await? {
                let refiner = self.refiner.as_deref();
                self.calibrate(&map, refiner.and_then(Refiner::negative_evidence)).await?;
            }
        }
        Ok(())
    }

    async fn is_due(&self, map: &Map, images: usize) -> Result<bool, ServiceError> {
        let Some(known) = self.maps.calibration(map).await? else { return Ok(images > 1) };
        Ok(!known.complete
            || known.settings != self.settings.calibration
            || known.images.abs_diff(images) * CHANGED > known.images)
    }

    /// Measures a map: first by similarity, which takes a moment, then by the evidence of a refiner, if it
    /// measures any. What is measured counts at once.
    pub async fn calibrate(
        &self,
        map: &Map,
        refiner: Option<&dyn NegativeEvidence>,
    ) -> Result<(), ServiceError> {
        let settings = self.settings.calibration;
        let IndexState { images, .. } = self.maps.index_state(map).await?;
        let asked =
            self.maps.hard_negatives(map, settings, COMPARED.max(settings.candidates)).await?;
        let similarity = NullDistribution::from(values(asked.iter().filter_map(|asked| {
            Evidence::similarity(&asked.others, &asked.others.first()?.image_id)
        })));
        let mut measured = Calibration { images, settings, similarity, ..Calibration::default() };
        self.maps.put_calibration(map, measured.clone()).await?;
        if let Some(refiner) = refiner {
            let step = asked.len().div_ceil(settings.refined.max(1)).max(1);
            let mut found = Vec::new();
            for mut asked in asked.into_iter().step_by(step) {
                asked.others.truncate(settings.candidates);
                // A map that cannot be measured completely is measured as far as possible.
                let measure = || refiner.best_negative(map, &asked);
                found.extend(ATTEMPTS.run(measure).await.ok().flatten());
            }
            measured.agreement = NullDistribution::from(values(found.into_iter()));
        }
        measured.complete = true;
        tracing::info!(
            map = %map.name, images, asked = measured.similarity.len(),
            refined = measured.agreement.len(), "measured what chance resemblance is like"
        );
        Ok(self.maps.put_calibration(map, measured).await?)
    }
}

fn values(evidence: impl Iterator<Item = Evidence>) -> Vec<f32> {
    evidence
        .map(|evidence| match evidence {
            Evidence::Similarity(value) | Evidence::Agreement(value) => value,
        })
        .collect()
}
