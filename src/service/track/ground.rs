//! A map as tracks need it: its images in a plane, the paths among them, and what their descriptors have in common.

use std::cmp::Ordering;
use std::collections::HashMap;

use parking_lot::Mutex;

use super::grid::Grid;
use super::paths::Paths;
use whereabouts_core::{Descriptor, EARTH_RADIUS_M, ImageId, Pose, dot};
use whereabouts_store::LocatedImage;

/// Minimum usual distance of neighbours in metres, for maps that have several images of each spot.
const MIN_SPACING_M: f64 = 0.1;

/// Number of images that stand for all of a larger map.
const SAMPLE: usize = 512;

/// The order of the ids is that of recording if it makes the way through all images this much shorter than the order in
/// which they were added.
const SHORTER: f64 = 0.8;

/// Smallest difference of descriptors, for maps whose images are all equal.
const MIN_DIFFERENCE: f32 = 1e-6;

/// The images of a map that have a pose, numbered in the order of recording.
#[derive(Debug)]
pub(super) struct Ground {
    images: Vec<LocatedImage>,
    numbers: HashMap<ImageId, u32>,
    /// The images by their slots.
    by_slot: Vec<(usize, u32)>,
    pub grid: Grid,
    pub paths: Paths,
    /// Images spread evenly over the map; all of a small one.
    sample: Vec<u32>,
    /// What the descriptors of the sample have in common.
    common: Common,
    traits: Mutex<Traits>,
}

/// What the descriptors of a map have in common.
#[derive(Debug, Default)]
struct Common {
    mean: Vec<f32>,
    /// The usual difference, 1 − similarity, of neighbours.
    difference: f32,
    /// The descriptors of the sample: each frame is compared with them.
    sample: Vec<Option<Descriptor>>,
}

/// What sets each image apart; NaN until it is needed.
#[derive(Debug)]
struct Traits {
    /// How much it differs from the neighbour most like it, in units of the usual difference.
    changes: Vec<f32>,
    /// The length of its descriptor without the mean of the map.
    lengths: Vec<f32>,
}

impl Ground {
    /// Finds the paths of a map. [`learn_common`](Self::learn_common) must follow.
    pub fn new(images: Vec<LocatedImage>) -> Self {
        let images = in_order(images);
        let numbers = images.iter().map(|image| image.id.clone()).zip(0..).collect();
        let slots = images.iter().map(|image| image.slot);
        let mut by_slot: Vec<(usize, u32)> = slots.zip(0..).collect();
        by_slot.sort_unstable();
        let grid = Grid::new(in_a_plane(images.iter().map(|image| &image.pose)));
        let paths = Paths::new(&grid, MIN_SPACING_M);
        let step = images.len().div_ceil(SAMPLE).max(1);
        let sample = (0..images.len() as u32).step_by(step).collect();
        let unknown = vec![f32::NAN; images.len()];
        let traits = Mutex::new(Traits { changes: unknown.clone(), lengths: unknown });
        let common = Common::default();
        Self { images, numbers, by_slot, grid, paths, sample, common, traits }
    }

    /// The number of images.
    pub fn len(&self) -> usize {
        self.images.len()
    }

    pub fn id(&self, number: u32) -> &ImageId {
        &self.images[number as usize].id
    }

    pub fn pose(&self, number: u32) -> Pose {
        self.images[number as usize].pose
    }

    pub fn number(&self, id: &ImageId) -> Option<u32> {
        self.numbers.get(id).copied()
    }

    /// The slot of an image.
    pub fn slot(&self, number: u32) -> usize {
        self.images[number as usize].slot
    }

    /// The image in a slot.
    pub fn in_slot(&self, slot: usize) -> Option<u32> {
        let at = self.by_slot.binary_search_by_key(&slot, |(slot, _)| *slot).ok()?;
        Some(self.by_slot[at].1)
    }

    /// The slots of some images.
    pub fn slots(&self, images: &[u32]) -> Vec<usize> {
        images.iter().map(|image| self.images[*image as usize].slot).collect()
    }

    /// Images spread evenly over the map; all of a small one.
    pub fn sample(&self) -> &[u32] {
        &self.sample
    }

    /// The dot product of a vector and the descriptor of each image of the sample, if it could be read.
    pub fn sample_similarities(&self, vector: &[f32]) -> impl Iterator<Item = Option<f32>> {
        let rows = self.common.sample.iter();
        rows.map(move |row| row.as_ref().map(|row| dot(vector, row.as_slice())))
    }

    /// The mean of the descriptors; empty if none could be read.
    pub fn mean(&self) -> &[f32] {
        &self.common.mean
    }

    /// The usual difference, 1 − similarity, of the descriptors of neighbours.
    pub fn difference(&self) -> f32 {
        self.common.difference
    }

    /// The images whose descriptors [`learn_common`](Self::learn_common) needs.
    pub fn sample_with_neighbours(&self) -> Vec<u32> {
        self.with_neighbours(&self.sample)
    }

    /// Learns what the descriptors have in common, from those of
    /// [`sample_with_neighbours`](Self::sample_with_neighbours).
    pub fn learn_common(&mut self, known: &Known) {
        let mut mean = Vec::new();
        let mut differences = Vec::new();
        let mut count = 0.0_f32;
        for image in &self.sample {
            let Some(descriptor) = known.get(image) else { continue };
            mean.resize(descriptor.as_slice().len(), 0.0);
            mean.iter_mut().zip(descriptor.as_slice()).for_each(|(sum, number)| *sum += number);
            count += 1.0;
            differences.extend(self.differences(*image, known));
        }
        mean.iter_mut().for_each(|sum| *sum /= count);
        differences.sort_by(f32::total_cmp);
        let usual = differences.get(differences.len() / 2).copied().unwrap_or(1.0);
        let sample = self.sample.iter().map(|image| known.get(image).cloned()).collect();
        self.common = Common { mean, difference: usual.max(MIN_DIFFERENCE), sample };
        self.learn(&self.sample, known);
    }

    /// Which of these images are not known yet, with their neighbours.
    pub fn unknown(&self, images: &[u32]) -> Vec<u32> {
        let unknown: Vec<u32> = {
            let traits = self.traits.lock();
            let is_unknown = |image: &&u32| traits.lengths[**image as usize].is_nan();
            images.iter().filter(is_unknown).copied().collect()
        };
        self.with_neighbours(&unknown)
    }

    /// Learns what sets images apart, from their descriptors and those of their neighbours.
    pub fn learn(&self, images: &[u32], known: &Known) {
        let mut traits = self.traits.lock();
        for image in images {
            let Some(descriptor) = known.get(image) else { continue };
            let off = descriptor.as_slice().iter().zip(&self.common.mean);
            let square: f32 = off.map(|(number, mean)| (number - mean).powi(2)).sum();
            traits.lengths[*image as usize] = square.sqrt().max(MIN_DIFFERENCE);
            let least = self.differences(*image, known).min_by(f32::total_cmp);
            traits.changes[*image as usize] = least.map_or(0.0, |d| d / self.common.difference);
        }
    }

    /// How much images differ from their neighbours; 0 if that is not known.
    pub fn changes(&self, images: &[u32]) -> Vec<f32> {
        let traits = self.traits.lock();
        let change = |image: &u32| traits.changes[*image as usize];
        images.iter().map(change).map(|change| if change.is_nan() { 0.0 } else { change }).collect()
    }

    /// The lengths of descriptors without the mean of the map.
    pub fn lengths(&self, images: &[u32]) -> Vec<f32> {
        let traits = self.traits.lock();
        let length = |image: &u32| traits.lengths[*image as usize];
        images.iter().map(length).map(|length| if length.is_nan() { 1.0 } else { length }).collect()
    }

    fn differences<'a>(
        &'a self,
        image: u32,
        known: &'a Known,
    ) -> impl Iterator<Item = f32> + use<'a> {
        let own = known.get(&image);
        let others = self.paths.neighbours(image).filter_map(|other| known.get(&other));
        others.filter_map(move |other| Some(1.0 - dot(own?.as_slice(), other.as_slice())))
    }

    fn with_neighbours(&self, images: &[u32]) -> Vec<u32> {
        let mut all: Vec<u32> = images.to_vec();
        all.extend(images.iter().flat_map(|image| self.paths.neighbours(*image)));
        all.sort_unstable();
        all.dedup();
        all
    }
}

/// Descriptors by the number of their image.
pub(super) type Known = HashMap<u32, Descriptor>;

/// Sorts images that were added by several senders, or in no order, by their ids, if these are numbers along the way.
fn in_order(images: Vec<LocatedImage>) -> Vec<LocatedImage> {
    let mut by_id = images.clone();
    by_id.sort_by(|a, b| natural(a.id.as_str(), b.id.as_str()));
    if way(&by_id) < SHORTER * way(&images) { by_id } else { images }
}

/// The length of the way through all images in metres.
fn way(images: &[LocatedImage]) -> f64 {
    let positions = in_a_plane(images.iter().map(|image| &image.pose));
    positions.windows(2).map(|pair| (pair[0][0] - pair[1][0]).hypot(pair[0][1] - pair[1][1])).sum()
}

/// Compares texts so that numbers in them are in order: `frame-9` before `frame-10`.
fn natural(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a.as_bytes(), b.as_bytes());
    loop {
        let digits = |text: &[u8]| text.iter().take_while(|byte| byte.is_ascii_digit()).count();
        match (digits(a), digits(b)) {
            (m, n) if m > 0 && n > 0 => {
                let number = |digits: &[u8]| {
                    let zeros = digits.iter().take_while(|digit| **digit == b'0').count();
                    digits[zeros..].to_vec()
                };
                let (one, other) = (number(&a[..m]), number(&b[..n]));
                let order = one.len().cmp(&other.len()).then(one.cmp(&other));
                if order != Ordering::Equal {
                    return order;
                }
                (a, b) = (&a[m..], &b[n..]);
            }
            _ => match (a.first(), b.first()) {
                (Some(one), Some(other)) if one == other => (a, b) = (&a[1..], &b[1..]),
                (one, other) => return one.cmp(&other),
            },
        }
    }
}

/// Positions in metres; for geographic poses in the equirectangular projection around the first image, which is accurate
/// to a metre over some tens of kilometres.
fn in_a_plane<'a>(poses: impl Iterator<Item = &'a Pose> + Clone) -> Vec<[f64; 2]> {
    let origin = poses.clone().find_map(|pose| match pose {
        Pose::Geographic(pose) => Some((pose.lat, pose.lon)),
        Pose::Metric(_) => None,
    });
    let (lat, lon) = origin.unwrap_or_default();
    let place = |pose: &Pose| match pose {
        Pose::Metric(pose) => [pose.x, pose.y],
        Pose::Geographic(pose) => {
            // The shorter way around, across the date line.
            let east = (pose.lon - lon + 540.0).rem_euclid(360.0) - 180.0;
            let scale = EARTH_RADIUS_M * lat.to_radians().cos();
            [east.to_radians() * scale, (pose.lat - lat).to_radians() * EARTH_RADIUS_M]
        }
    };
    poses.map(place).collect()
}

#[cfg(test)]
mod tests;
