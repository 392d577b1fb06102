//! Calibration: measures the null distributions of each map, on which confidence rests, in the background; see
//! [`whereabouts_core::confidence`].

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::{Reindexer, ServiceError};
use whereabouts_core::confidence::{COMPARED, NullDistribution, neighbour_weights};
use whereabouts_core::{Calibration, CalibrationSettings, Descriptor, Evidence, ImageId, Map};
use whereabouts_refine::{AttemptPolicy, PaidNegatives, RefineError, Refiner};
use whereabouts_store::{HardNegatives, IndexState, MapStore};

/// Pause between two scans for maps that have changed.
const SCAN_PAUSE: Duration = Duration::from_millis(500);

/// The pause is at least this many times the duration of the scan, so that many maps do not keep the store busy.
const PAUSE_PER_SCAN: u32 = 10;

/// Maximum pause: calibration itself counts as part of the scan.
const MAX_PAUSE: Duration = Duration::from_secs(10);

/// How long to wait for one image while the threads that refine are busy: jobs have priority.
const ATTEMPTS: AttemptPolicy = AttemptPolicy {
    attempts: 301,
    pause: Duration::from_millis(200),
    longest_pause: Duration::from_millis(200),
};

/// A map is calibrated again when one in this many of its images was added, removed or given another pose.
const CHANGED_SHARE: usize = 5;

/// `[confidence]`
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceSettings {
    /// Maximum number of images used as queries.
    pub images: usize,
    /// Number of these queries that are also refined.
    pub refined: usize,
    /// Images added this shortly before or after one, in order of addition, count as the same place.
    pub place_images: usize,
    /// Images whose poses are within this many metres count as the same place.
    pub place_m: f64,
    /// Maximum number of calls to a paid model for the calibration of one map; 0 for none.
    pub model_calls: usize,
}

/// The fewest verdicts of a model on images of other places from which its certainty is calibrated: fewer cannot give a
/// confidence of 0.9.
const FEWEST_VERDICTS: usize = 9;

impl ConfidenceSettings {
    /// Returns how a map is calibrated if a job compares this many candidates.
    pub fn calibration(&self, candidates: usize) -> CalibrationSettings {
        let Self { images, refined, place_images, place_m, model_calls } = *self;
        CalibrationSettings { images, refined, candidates, place_images, place_m, model_calls }
    }

    /// Returns what is invalid if the model compares this many candidates; `None` if the settings are valid.
    pub fn validate(&self, candidates: usize) -> Option<String> {
        let fewest = FEWEST_VERDICTS * (candidates + 1);
        (self.model_calls > 0 && self.model_calls < fewest).then(|| {
            format!(
                "confidence.model_calls must be 0, or at least {fewest}: {FEWEST_VERDICTS} images at \
                 {candidates} + 1 calls each (refine.candidates), or no answer could reach a confidence of 0.9"
            )
        })
    }
}

/// Calibrates maps: measures how similar images of different places look in each.
pub struct Calibrator {
    /// The maps.
    pub store: Arc<dyn MapStore>,
    /// The refiner, whose agreement is measured too, if one is configured.
    pub refiner: Option<Arc<dyn Refiner>>,
    /// How many images are measured, and which count as the same place.
    pub settings: CalibrationSettings,
    /// Number of candidates about which a paid model is asked.
    pub model_candidates: usize,
    /// Fits vocabularies without the images that are asked about, for maps that have one of their own; `None` where no map
    /// has.
    pub reindexer: Option<Reindexer>,
}

impl Calibrator {
    /// Calibrates maps after their images have changed, until `shutdown`.
    pub async fn run(&self, shutdown: CancellationToken) {
        let mut seen = BTreeMap::new();
        let mut pause = SCAN_PAUSE;
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
                // For example, a map was deleted or reindexed meanwhile. The next scan tries again.
                tracing::debug!(%error, "a map could not be calibrated");
            }
            pause = SCAN_PAUSE.max(began.elapsed() * PAUSE_PER_SCAN).min(MAX_PAUSE);
        }
    }

    /// Calibrates the maps that need it and whose images and poses have not changed since the last scan.
    async fn calibrate_settled(
        &self,
        seen: &mut BTreeMap<Uuid, (usize, u64)>,
    ) -> Result<(), ServiceError> {
        let maps = self.store.maps().await?;
        seen.retain(|uid, _| maps.iter().any(|map| map.uid == *uid));
        for map in maps {
            let IndexState { images, moved, .. } = self.store.index_state(&map).await?;
            let settled = seen.insert(map.uid, (images, moved)) == Some((images, moved));
            if settled && self.is_due(&map, images, moved).await? {
                let refiner = self.refiner.as_deref();
                self.calibrate(&map, refiner).await?;
            }
        }
        Ok(())
    }

    async fn is_due(&self, map: &Map, images: usize, moved: u64) -> Result<bool, ServiceError> {
        let Some(known) = self.store.calibration(map).await? else { return Ok(images > 1) };
        let moved = usize::try_from(moved.abs_diff(known.moved)).unwrap_or(usize::MAX);
        let changed = known.images.abs_diff(images).saturating_add(moved);
        Ok(!known.complete
            || known.evidence != Calibration::EVIDENCE
            || known.settings != self.settings
            || changed.saturating_mul(CHANGED_SHARE) > known.images)
    }

    /// Calibrates a map: first similarity, which is fast, then the agreement that `refiner` finds, then the verdicts of
    /// its model, if calls for that are allowed. Each is in effect as soon as it is measured.
    pub async fn calibrate(
        &self,
        map: &Map,
        refiner: Option<&dyn Refiner>,
    ) -> Result<(), ServiceError> {
        let settings = self.settings;
        let IndexState { images, moved, .. } = self.store.index_state(map).await?;
        let asked =
            self.store.hard_negatives(map, settings, COMPARED.max(settings.candidates)).await?;
        let mut measured = Calibration {
            images,
            moved,
            settings,
            neighbours: self.neighbours(map, &asked).await?,
            ..Calibration::default()
        };
        let left_out = match &self.reindexer {
            Some(reindexer) => reindexer.cross_fitted(map, settings, COMPARED).await?,
            None => None,
        };
        let of_similarity = left_out.as_deref().unwrap_or(&asked);
        measured.similarity =
            NullDistribution::from(values(of_similarity.iter().filter_map(|asked| {
                measured.similarity_evidence(&asked.others, &asked.others.first()?.image_id)
            })));
        self.store.put_calibration(map, measured.clone()).await?;
        if let Some(refiner) = refiner.and_then(Refiner::negative_evidence) {
            let mut found = Vec::new();
            for mut asked in sampled(&asked, settings.refined) {
                asked.others.truncate(settings.candidates);
                // A map that cannot be measured completely is measured as far as possible.
                let measure =
                    || async { refiner.best_negative(map, &asked).await.map_err(retried_soon) };
                found.extend(ATTEMPTS.run(measure).await.into_iter().flatten());
            }
            let (verdicts, agreement): (Vec<Evidence>, Vec<Evidence>) =
                found.into_iter().partition(|found| matches!(found, Evidence::Verdict(_)));
            measured.agreement = NullDistribution::from(values(agreement.into_iter()));
            measured.verdict = NullDistribution::from(values(verdicts.into_iter()));
            self.store.put_calibration(map, measured.clone()).await?;
        }
        if let Some(model) = refiner.and_then(Refiner::paid_negatives) {
            let verdicts = self.ask_the_model(map, model, &asked).await;
            if verdicts.len() >= FEWEST_VERDICTS {
                measured.model_asked = verdicts.len();
                measured.verdict = NullDistribution::from(values(verdicts.into_iter()));
            }
        }
        measured.complete = true;
        tracing::info!(
            map = %map.name, images, asked = measured.similarity.len(),
            refined = measured.agreement.len(), model = measured.model_asked, "the map was calibrated"
        );
        Ok(self.store.put_calibration(map, measured).await?)
    }

    /// Measures what images have in common with those that were added soon after them.
    async fn neighbours(
        &self,
        map: &Map,
        asked: &[HardNegatives],
    ) -> Result<Vec<f32>, ServiceError> {
        let images = self.store.index_state(map).await?.images;
        let radius = self.settings.place_radius(images);
        let ids: Vec<ImageId> = asked.iter().map(|asked| asked.image_id.clone()).collect();
        let slots = self.store.slots(map, &ids).await?;
        let slots: Vec<usize> =
            slots.into_iter().flatten().flat_map(|slot| slot..=slot + radius).collect();
        let descriptors = self.store.descriptors(map, slots).await?;
        let runs: Vec<&[Option<Descriptor>]> = descriptors.chunks_exact(radius + 1).collect();
        let (mut near, mut far) = (vec![Vec::new(); radius], Vec::new());
        for (at, run) in runs.iter().enumerate() {
            let Some(image) = &run[0] else { continue };
            for (near, other) in near.iter_mut().zip(&run[1..]) {
                near.extend(other.as_ref().map(|other| image.similarity(other)));
            }
            let other = &runs[(at + runs.len() / 2) % runs.len()][0];
            far.extend(other.as_ref().map(|other| image.similarity(other)));
        }
        Ok(neighbour_weights(&near, &far))
    }

    /// Returns the model's verdicts on images of other places, as far as the allowed number of calls goes. Ends with the
    /// first failure: what it would cost to go on is not known.
    async fn ask_the_model(
        &self,
        map: &Map,
        model: &dyn PaidNegatives,
        asked: &[HardNegatives],
    ) -> Vec<Evidence> {
        let settings = self.settings;
        let cost = model.cost(self.model_candidates);
        let count = (settings.model_calls / cost.calls.max(1)).min(asked.len());
        if count < FEWEST_VERDICTS {
            return Vec::new();
        }
        tracing::info!(
            map = %map.name, images = count, calls = count * cost.calls,
            tokens = count as u64 * cost.tokens, money = count as f64 * cost.money,
            "the calibration asks the model; this is the most it should cost (confidence.model_calls)"
        );
        let mut verdicts = Vec::new();
        for mut asked in sampled(asked, count).take(count) {
            asked.others.truncate(self.model_candidates);
            match model.verdict(map, &asked).await {
                Ok(verdict) => verdicts.extend(verdict),
                Err(error) => {
                    tracing::warn!(map = %map.name, %error, done = verdicts.len(), "the model's certainty could not be calibrated");
                    break;
                }
            }
        }
        verdicts
    }
}

/// Returns a sample of at most `count` of them, spread evenly.
fn sampled(asked: &[HardNegatives], count: usize) -> impl Iterator<Item = HardNegatives> {
    let count = count.min(asked.len());
    (0..count).map(move |index| asked[index * asked.len() / count].clone())
}

fn values(evidence: impl Iterator<Item = Evidence>) -> Vec<f32> {
    evidence
        .map(|evidence| match evidence {
            Evidence::Similarity(value) | Evidence::Agreement(value) => value,
            Evidence::Verdict(verdict) | Evidence::Concurring { verdict, .. } => verdict,
        })
        .collect()
}

/// Makes a deferred measurement transient: calibration has nothing else to do meanwhile.
fn retried_soon(error: RefineError) -> RefineError {
    match error {
        RefineError::Deferred { why, .. } => RefineError::Transient(why),
        error => error,
    }
}
