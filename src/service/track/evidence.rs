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
//! What a frame says about whether the robot is on the map at all ([`presence`](super::presence)) follows from z, too.
//!
//! Frames that differ little from the ones before are no new evidence. How much two frames differ is measured in units
//! of the difference of two neighbours in the map: the *novelty* of a frame.

use std::collections::VecDeque;

use super::belief::Belief;
use super::presence::{LEVELS, Ratios, ratios};
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

/// A frame that differs from the last one by this many times as much as from an earlier one follows the earlier one.
const UNLIKE: f64 = 2.0;

/// Weight of a new frame in the share of those that follow an earlier one than the last.
const ALTERNATION_WEIGHT: f64 = 1.0 / 12.0;

/// The share that shows two cameras in one track. A van in three frames of ten makes it 0.2.
const ALTERNATION: f64 = 0.45;

/// Number of frames after which that is judged.
const ALTERNATING: u32 = 8;

/// Smallest standard deviation of similarities.
const MIN_DEVIATION: f64 = 1e-9;

/// The weight of each image by one frame.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Weights {
    known: Vec<(u32, f64)>,
    rest: f64,
    /// The standardised similarities of the images in `known`.
    standardised: Vec<f64>,
    /// Those of the sample.
    sample: Vec<f64>,
    /// The share of frames without information.
    outliers: f64,
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
        let z = |s: f32| (f64::from(s) - mean) / deviation.max(MIN_DEVIATION);
        let e = |s: f32| (sharpness * z(s)).exp();
        let usual = sample.iter().map(|s| e(*s)).sum::<f64>() / number;
        let usual = if sample.is_empty() { 1.0 } else { usual };
        let weight = |s: f32| outliers + (1.0 - outliers) * e(s) / usual;
        let known: Vec<_> = similar.iter().map(|(image, s)| (*image, weight(*s))).collect();
        // All weights together have the mean 1, but a sample knows that only roughly.
        let rest = count as f64 - known.iter().map(|(_, weight)| weight).sum::<f64>();
        let rest = rest / count.saturating_sub(known.len()).max(1) as f64;
        Self {
            known,
            rest: rest.clamp(outliers, 1.0),
            standardised: similar.iter().map(|(_, s)| z(*s)).collect(),
            sample: sample.iter().map(|s| z(*s)).collect(),
            outliers,
        }
    }

    /// How much more likely the frame is on a map of `count` images, where `belief` expects the robot, than off it.
    pub fn presence(&self, belief: &Belief, count: usize) -> Ratios {
        let weight = |z: f64| ratios(z).map(|r| self.outliers + (1.0 - self.outliers) * r);
        let mut sums = [0.0; LEVELS];
        let mut add = |share: f64, ratios: Ratios| {
            sums.iter_mut().zip(ratios).for_each(|(sum, ratio)| *sum += share * ratio);
        };
        for (image, mass) in belief.masses() {
            let at = self.known.binary_search_by_key(&image, |(image, _)| *image);
            add(mass, at.map_or([1.0; LEVELS], |at| weight(self.standardised[at])));
        }
        // Of a large map, the sample stands for all images that were not asked for.
        let all = self.known.len() >= count;
        let asked = if all { count } else { self.known.len().saturating_sub(self.sample.len()) };
        let rest = count.saturating_sub(asked) as f64 / self.sample.len().max(1) as f64;
        let share = belief.elsewhere() / count.max(1) as f64;
        self.standardised.iter().for_each(|z| add(share, weight(*z)));
        if !all {
            self.sample.iter().for_each(|z| add(share * (rest - 1.0), weight(*z)));
        }
        sums
    }

    /// Weights of some images, sorted by number, and that of all others.
    pub fn given(known: Vec<(u32, f64)>, rest: f64) -> Self {
        Self { known, rest, standardised: Vec::new(), sample: Vec::new(), outliers: 0.0 }
    }

    /// The mean weight where `belief` expects the robot on a map of `count` images.
    pub fn mean(&self, belief: &Belief, count: usize) -> f64 {
        let weight = |image: u32| {
            let at = self.known.binary_search_by_key(&image, |(image, _)| *image);
            at.map_or(self.rest, |at| self.known[at].1)
        };
        let known: f64 = belief.masses().iter().map(|(image, mass)| mass * weight(*image)).sum();
        let above: f64 = self.known.iter().map(|(_, weight)| weight - self.rest).sum();
        known + belief.elsewhere() * (self.rest + above / count.max(1) as f64)
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
    pub sum: Vec<f32>,
    /// The weight of all frames in `sum`.
    pub weight: f64,
    pub last: VecDeque<Vec<f32>>,
    /// Frames without novelty in a row.
    pub repeated: u32,
    /// How often a frame was unlike the last one, but like one before that.
    pub alternation: f64,
    /// Number of frames.
    pub count: u32,
}

impl Frames {
    /// How much a frame differs from the ones before; `None` if there are none. `usual` is the difference of neighbours
    /// in the map.
    pub fn novelty(&self, frame: &[f32], usual: f32) -> Option<f64> {
        let differences = self.last.iter().map(|last| (1.0 - dot(last, frame)) / usual);
        differences.map(f64::from).min_by(f64::total_cmp).map(|novelty| novelty.max(0.0))
    }

    /// Whether the frames are those of two cameras: they look like the one before the last rather than like the last.
    pub fn alternates(&self) -> bool {
        self.count >= ALTERNATING && self.alternation > ALTERNATION
    }

    /// Notes whether a frame follows the last one or another. `usual` is the difference of neighbours in the map.
    fn compare(&mut self, frame: &[f32], usual: f32) {
        let differences = || self.last.iter().map(|last| f64::from(1.0 - dot(last, frame)));
        let Some(last) = differences().next_back() else { return };
        let least = differences().fold(f64::INFINITY, f64::min);
        let is_other = last > NEW * f64::from(usual) && last > UNLIKE * least;
        self.alternation += ALTERNATION_WEIGHT * (f64::from(u8::from(is_other)) - self.alternation);
        self.count = self.count.saturating_add(1);
    }

    /// Adds a frame. Returns the share of its evidence that is new. `usual` is the difference of neighbours in the map.
    pub fn add(&mut self, frame: &[f32], novelty: Option<f64>, usual: f32) -> f64 {
        let fresh = novelty.map_or(1.0, |novelty| {
            self.repeated = if novelty < NEW { self.repeated + 1 } else { 0 };
            let kept = REPEATED / f64::from(self.repeated.max(1)).sqrt();
            (novelty / NEW).max(kept).min(1.0)
        });
        if self.sum.len() != frame.len() {
            *self = Self { sum: vec![0.0; frame.len()], ..Self::default() };
        }
        self.compare(frame, usual);
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
