//! Cross-fitting: what wrong answers look like in a map with a vocabulary of its own.
//!
//! A vocabulary keeps the cosines of the images that it was fitted on as they were. A frame is not among them, so an image
//! that is asked in its place must not be either: its similarities would be those of another distribution. The images of
//! a map are therefore divided into parts, and the images of each part are compared with the others by a vocabulary that
//! was fitted on the others. A part consists of runs of images as long as a place, so that the place is left out, too.

use std::sync::Arc;

use super::fitting::{Sample, blocking};
use super::{Reindexer, ServiceError};
use whereabouts_core::{CalibrationSettings, Candidate, Descriptor, Map};
use whereabouts_store::HardNegatives;
use whereabouts_vision::OwnVocabulary;

/// The number of parts, each of which is left out of one fit.
const PARTS: usize = 5;

/// At most one in this many images may be left out because it cannot be read.
const MOST_FAILED: usize = 5;

impl Reindexer {
    /// Samples the images of a map and returns the `k` hardest negatives of each, by a vocabulary that was fitted without
    /// it. `None` if the map has the model's vocabulary, or too few images to leave any out.
    pub(super) async fn cross_fitted(
        &self,
        map: &Map,
        settings: CalibrationSettings,
        k: usize,
    ) -> Result<Option<Vec<HardNegatives>>, ServiceError> {
        if map.vocabulary.is_none() {
            return Ok(None);
        }
        let (_, extractor, _) = self.maps.usable(&map.name).await?;
        let Some(own) = extractor.own_vocabulary(map.descriptor) else { return Ok(None) };
        let own = Arc::new(own);
        let images = self.sample(map).await?;
        let ids: Vec<_> = images.iter().map(|image| image.id.clone()).collect();
        let slots = self.maps.store.slots(map, &ids).await?;
        let mut images: Vec<_> = slots
            .into_iter()
            .zip(images)
            .filter_map(|(slot, image)| Some((slot?, image)))
            .collect();
        images.sort_unstable_by_key(|(slot, _)| *slot);
        let (count, mut failed) = (images.len(), 0);
        let mut samples = Vec::with_capacity(count);
        for (slot, image) in images {
            match self.expand(map, image, &extractor, map.descriptor, &own).await {
                Ok(sample) => samples.extend(sample.map(|sample| (slot, sample))),
                // A picture that is damaged does not leave a map without a calibration.
                Err(error) if (failed + 1) * MOST_FAILED <= count => {
                    failed += 1;
                    tracing::debug!(map = %map.name, %error, "an image is left out of a calibration");
                }
                Err(error) => return Err(error),
            }
        }
        blocking(move || compare(&own, &samples, settings, k)).await
    }
}

/// Parts of a map, of which each is left out of one fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Parts {
    count: usize,
    /// Images in a row that are in one part.
    run: usize,
}

impl Parts {
    /// Divides a map in which images up to `radius` before and after one show its place. `None` if it is too small.
    fn of(images: usize, radius: usize) -> Option<Self> {
        let run = 2 * radius + 1;
        let count = PARTS.min(images.div_ceil(run));
        (count > 1 && images > 2).then_some(Self { count, run })
    }

    /// The part of an image, given by its index in the order of addition.
    fn part(&self, image: usize) -> usize {
        image / self.run % self.count
    }
}

/// Compares samples, given with their slots in the order of addition, as [`Reindexer::cross_fitted`] says.
fn compare(
    own: &OwnVocabulary,
    samples: &[(usize, Sample)],
    settings: CalibrationSettings,
    k: usize,
) -> Result<Option<Vec<HardNegatives>>, ServiceError> {
    let count = samples.len();
    let Some(parts) = Parts::of(count, settings.place_radius(count)) else { return Ok(None) };
    let mut found = Vec::new();
    for part in 0..parts.count {
        let (asked, others): (Vec<usize>, Vec<usize>) =
            (0..count).partition(|at| parts.part(*at) == part);
        let pictures: Vec<&[f32]> =
            others.iter().map(|&at| samples[at].1.expanded.as_slice()).collect();
        let vocabulary = own.fit(&pictures).map_err(ServiceError::unprocessable)?;
        let describe = |at: usize| vocabulary.describe(&samples[at].1.expanded).ok();
        let described: Vec<(usize, Descriptor)> =
            others.iter().filter_map(|&at| Some((at, describe(at)?))).collect();
        for at in asked.into_iter().filter(|at| at % settings.step(count) == 0) {
            let Some(query) = describe(at) else { continue };
            let of_another_place = |other: usize| {
                let pose = |at: usize| samples[at].1.image.pose;
                settings.are_apart(count, (at, pose(at)), (other, pose(other)))
            };
            let mut similar: Vec<(usize, f32)> = described
                .iter()
                .filter(|(other, _)| of_another_place(*other))
                .map(|(other, descriptor)| (*other, query.similarity(descriptor)))
                .collect();
            similar.sort_unstable_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            let candidate = |(index, &(other, similarity)): (usize, &(usize, f32))| {
                let (slot, Sample { image, .. }) = &samples[other];
                Candidate {
                    rank: index + 1,
                    image_id: image.id.clone(),
                    similarity,
                    pose: image.pose,
                    order: Some(*slot),
                }
            };
            found.push(HardNegatives {
                image_id: samples[at].1.image.id.clone(),
                others: similar.iter().take(k).enumerate().map(candidate).collect(),
            });
        }
    }
    Ok(Some(found))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_image_is_left_out_of_one_fit_together_with_its_run() {
        for (images, radius) in [(3, 0), (12, 1), (64, 4), (111, 4), (1000, 4)] {
            let parts = Parts::of(images, radius).unwrap();
            let sizes: Vec<usize> = (0..parts.count)
                .map(|part| (0..images).filter(|image| parts.part(*image) == part).count())
                .collect();
            assert_eq!(sizes.iter().sum::<usize>(), images);
            // Something is left to ask about, and to fit on.
            assert!(sizes.iter().all(|size| (1..images - 1).contains(size)), "{images}: {sizes:?}");
            // The image in the middle of a run is left out with all images of its place.
            let run: Vec<usize> = (0..=2 * radius).map(|image| parts.part(image)).collect();
            assert!(run.iter().all(|part| *part == 0), "{images}: {run:?}");
        }
    }

    #[test]
    fn a_map_of_one_place_leaves_nothing_out() {
        assert_eq!([(0, 0), (1, 0), (2, 0), (9, 4)].map(|(n, r)| Parts::of(n, r)), [None; 4]);
    }
}
