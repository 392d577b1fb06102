//! What a frame says about where a robot is, whatever the kind and scale of its descriptor.
//!
//! Light, weather and camera change all descriptors of a drive alike, and what a map's images have in common says
//! nothing about the place. Both means are therefore subtracted: with the map's mean m, and the mean c of the track's
//! frames so far, in which m counts as [`PRIOR`] frames,
//!
//! > z(j) = ((q − c) · (x(j) − m) / |x(j) − m|), standardised over the map
//!
//! The weight of image j is ω + (1 − ω) e(j) / ē, with e(j) = exp(β z(j)) and ē its mean over the map. ω is the share
//! of frames without information because, for example, a bus blocks the camera; it bounds the weight of one frame.
//!
//! Frames that differ little from the ones before are no new evidence. How much two frames differ is measured in units
//! of the difference of two neighbours in the map: the *novelty* of a frame.

use std::collections::VecDeque;

use whereabouts_core::dot;

/// Frames that the mean of the map counts as in the mean of a track.
const PRIOR: f64 = 8.0;

/// Frames after which the mean of a track forgets the oldest.
const MEMORY: f64 = 100.0;

/// Number of frames that a new one is compared with, so that a van which drives past is not news twice.
const COMPARED: usize = 3;

/// Novelty from which on a frame is evidence in full.
const NEW: f64 = 0.5;

/// Share of its evidence that the first frame without novelty keeps; later ones keep less.
const REPEATED: f64 = 0.3;

/// Smallest standard deviation of similarities.
const MIN_DEVIATION: f64 = 1e-9;

/// The weight of each image by one frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Weights {
    known: Vec<(u32, f64)>,
    rest: f64,
}

impl Weights {
    /// The weights of some images of a map of `count`, by their similarities without the means; `sample` are those of
    /// images that stand for all.
    pub fn new(
        similar: &[(u32, f32)],
        sample: &[f32],
        count: usize,
        (sharpness, outliers): (f64, f64),
    ) -> Self {
        let number = sample.len().max(1) as f64;
        let mean = sample.iter().map(|s| f64::from(*s)).sum::<f64>() / number;
        let square = |s: &f32| (f64::from(*s) - mean).powi(2);
        let deviation = (sample.iter().map(square).sum::<f64>() / number).sqrt();
        let e = |s: f32| (sharpness * (f64::from(s) - mean) / deviation.max(MIN_DEVIATION)).exp();
        let usual = sample.iter().map(|s| e(*s)).sum::<f64>() / number;
        let usual = if sample.is_empty() { 1.0 } else { usual };
        let weight = |s: f32| outliers + (1.0 - outliers) * e(s) / usual;
        let known: Vec<_> = similar.iter().map(|(image, s)| (*image, weight(*s))).collect();
        // All weights together have the mean 1, but a sample knows that only roughly.
        let rest = count as f64 - known.iter().map(|(_, weight)| weight).sum::<f64>();
        let rest = rest / count.saturating_sub(known.len()).max(1) as f64;
        Self { known, rest: rest.clamp(outliers, 1.0) }
    }

    /// The weights by image.
    pub fn known(&self) -> &[(u32, f64)] {
        &self.known
    }

    /// The mean weight of all other images.
    pub fn rest(&self) -> f64 {
        self.rest
    }
}

/// The frames of a track so far.
#[derive(Debug, Clone, Default)]
pub(super) struct Frames {
    sum: Vec<f32>,
    /// The weight of all frames in `sum`.
    weight: f64,
    last: VecDeque<Vec<f32>>,
    /// Frames without novelty in a row.
    repeated: u32,
}

impl Frames {
    /// How much a frame differs from the ones before; `None` if there are none. `usual` is the difference of neighbours
    /// in the map.
    pub fn novelty(&self, frame: &[f32], usual: f32) -> Option<f64> {
        let differences = self.last.iter().map(|last| (1.0 - dot(last, frame)) / usual);
        differences.map(f64::from).min_by(f64::total_cmp).map(|novelty| novelty.max(0.0))
    }

    /// Adds a frame. Returns the share of its evidence that is new.
    pub fn add(&mut self, frame: &[f32], novelty: Option<f64>) -> f64 {
        let fresh = novelty.map_or(1.0, |novelty| {
            self.repeated = if novelty < NEW { self.repeated + 1 } else { 0 };
            let kept = REPEATED / f64::from(self.repeated.max(1)).sqrt();
            (novelty / NEW).max(kept).min(1.0)
        });
        if self.sum.len() != frame.len() {
            *self = Self { sum: vec![0.0; frame.len()], ..Self::default() };
        }
        if self.weight > MEMORY {
            let kept = (MEMORY / self.weight) as f32;
            self.sum.iter_mut().for_each(|number| *number *= kept);
            self.weight = MEMORY;
        }
        self.sum.iter_mut().zip(frame).for_each(|(sum, number)| *sum += fresh as f32 * number);
        self.weight += fresh;
        if self.last.len() == COMPARED {
            self.last.pop_front();
        }
        self.last.push_back(frame.to_vec());
        fresh
    }

    /// A frame without the mean of the track.
    pub fn centred(&self, frame: &[f32], map: &[f32]) -> Vec<f32> {
        let (prior, total) = (PRIOR as f32, (PRIOR + self.weight) as f32);
        let sums = self.sum.iter().copied().chain(std::iter::repeat(0.0));
        let centre = sums.zip(map).map(|(sum, mean)| (sum + prior * mean) / total);
        frame.iter().zip(centre).map(|(number, centre)| number - centre).collect()
    }
}
