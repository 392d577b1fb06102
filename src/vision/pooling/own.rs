//! A vocabulary of a map's own: the centres of the model's, and a projection fitted on the map's images.
//!
//! What a model's projection loses differs from map to map; in a building whose corridors look alike it is what tells
//! them apart. The projection of a map keeps the cosines between the images that it was fitted on and any frame as they
//! were before it: its first directions span these images. The rest are random directions outside of this span, so that
//! the cosine of other images, added later, is neither larger nor smaller on average (Johnson and Lindenstrauss, 1984).
//! docs/evaluation.md has the measurements.

use whereabouts_core::{DenseFeatures, Descriptor, DescriptorError, dot};

use super::LocalFeatures;
use super::spectrum::{leading, orthonormalise, sign};
use super::vlad::{Vocabulary, add, norm};

/// Numbers to which each residual sum is shortened before the projection.
pub(crate) const OWN_BLOCK: usize = 16;

/// The share of the descriptor that the map's own directions may take, in quarters.
const OWN_QUARTERS: usize = 3;

/// Directions are divided by their energy to this power: 0 would leave them as they are, 0.5 would whiten.
const WHITENING: f64 = 0.1;

/// Directions with less energy than this, relative to the first, are rounding errors.
const LEAST_ENERGY: f64 = 1e-6;

/// Fits vocabularies for the maps of one model and kind of descriptor.
#[derive(Debug)]
pub struct OwnVocabulary {
    /// Without a projection.
    expanding: Vocabulary,
    dimension: usize,
}

impl OwnVocabulary {
    pub(crate) fn new(model: &Vocabulary) -> Option<Self> {
        let (channels, dimension) = (model.channels, model.settings.dimension);
        let mut settings = model.settings.own(OWN_BLOCK, channels)?;
        settings.dimension = settings.expanded(channels);
        let block = settings.block.unwrap_or(channels);
        let slots = settings.rows * settings.centres;
        let mut blocks = Vec::with_capacity(slots * block * channels);
        for slot in 0..slots {
            let mut axes: Vec<Vec<f32>> = (0..block)
                .map(|k| (0..channels).map(|c| sign(slot * block + k, c)).collect())
                .collect();
            orthonormalise(&mut axes);
            axes.into_iter().for_each(|axis| blocks.extend(axis));
        }
        let centres = model.centres.clone();
        let expanding = Vocabulary::new(settings, channels, centres, blocks, Vec::new());
        Some(Self { expanding, dimension })
    }

    /// Reads a vocabulary that was written with [`Vocabulary::to_bytes`].
    pub(crate) fn read(&self, bytes: &[u8]) -> Result<Vocabulary, String> {
        let mut settings = self.expanding.settings.clone();
        settings.dimension = self.dimension;
        Vocabulary::from_bytes(bytes, &settings, self.expanding.channels)
    }

    /// Aggregates a picture to the numbers that the projection shortens, at unit norm.
    pub fn expand(&self, dense: &DenseFeatures) -> Vec<f32> {
        let features = LocalFeatures {
            height: dense.height(),
            width: dense.width(),
            channels: dense.channels(),
            cells: dense.cells().to_vec(),
            cls: None,
            reliability: dense.reliability().map(<[f32]>::to_vec),
        };
        let mut numbers = self.expanding.aggregate(&features);
        let scale = 1.0 / norm(&numbers).max(1e-12);
        numbers.iter_mut().for_each(|x| *x *= scale);
        numbers
    }

    /// Fits a vocabulary on expanded pictures. The error says what is wrong with them.
    pub fn fit(&self, pictures: &[&[f32]]) -> Result<Vocabulary, String> {
        let (count, expanded) = (pictures.len(), self.expanding.settings.dimension);
        let gram: Vec<f32> = pictures
            .iter()
            .flat_map(|a| pictures.iter().map(|b| dot(a, b) / count.max(1) as f32))
            .collect();
        let most = count.min(self.dimension * OWN_QUARTERS / 4);
        let mut directions = leading(&gram, count, most);
        let first = directions.first().map_or(0.0, |(energy, _)| *energy);
        directions.retain(|(energy, _)| *energy > LEAST_ENERGY * first);
        let Some((last, _)) = directions.last() else {
            return Err("the images have no local features".to_owned());
        };
        let weight = |energy: f64| (energy / first).powf(-WHITENING) as f32;
        let least = weight(*last);
        let mut columns: Vec<Vec<f32>> = Vec::with_capacity(self.dimension);
        for (_, shares) in &directions {
            let mut axis = vec![0.0; expanded];
            shares.iter().zip(pictures).for_each(|(&share, from)| add(&mut axis, from, share));
            let scale = 1.0 / norm(&axis).max(1e-12);
            axis.iter_mut().for_each(|x| *x *= scale);
            columns.push(axis);
        }
        let own = columns.len();
        let size = least / ((self.dimension - own).max(1) as f32).sqrt();
        for k in own..self.dimension {
            let mut axis: Vec<f32> = (0..expanded).map(|row| size * sign(k, row)).collect();
            for other in &columns[..own] {
                let share = dot(&axis, other);
                add(&mut axis, other, -share);
            }
            columns.push(axis);
        }
        for (axis, (energy, _)) in columns.iter_mut().zip(&directions) {
            axis.iter_mut().for_each(|x| *x *= weight(*energy));
        }
        let mut projection = vec![0.0; expanded * self.dimension];
        for (row, numbers) in projection.chunks_exact_mut(self.dimension).enumerate() {
            numbers.iter_mut().zip(&columns).for_each(|(to, column)| *to = column[row]);
        }
        let Vocabulary { centres, blocks, channels, settings, .. } = &self.expanding;
        let fitted = Vocabulary::new(
            settings.clone(),
            *channels,
            centres.clone(),
            blocks.clone(),
            projection,
        );
        // As it will be read, in 16 bits.
        self.read(&fitted.to_bytes())
    }
}

impl Vocabulary {
    /// The descriptor of an [expanded](OwnVocabulary::expand) picture.
    pub fn describe(&self, expanded: &[f32]) -> Result<Descriptor, DescriptorError> {
        Descriptor::normalised(self.projected(expanded))
    }
}

#[cfg(test)]
mod tests;
