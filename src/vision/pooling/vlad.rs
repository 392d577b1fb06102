//! VLAD: sums of residuals to the centres of a vocabulary.
//!
//! Jégou et al., *Aggregating local descriptors into a compact image representation*, 2010, with intra-normalisation
//! (Arandjelović and Zisserman, *All about VLAD*, 2013) and soft assignment (Philbin et al., *Lost in quantization*,
//! 2008), over horizontal bands of the picture. AnyLoc (Keetha et al., 2023) is the case of one band, hard assignment
//! and no weighting.

use std::path::Path;

use half::f16;
use multiversion::multiversion;

use super::LocalFeatures;
use crate::manifest::{Vlad, Weighting};
use whereabouts_core::dot;

/// Lowest weight of a cell, so that a picture without reliable cells still has a descriptor.
const MIN_WEIGHT: f32 = 1e-6;

/// Cells whose similarities are computed together, so that each number of the vocabulary is loaded once for all.
const TOGETHER: usize = 4;

/// The numbers that the compiler keeps in vector registers.
const LANES: usize = 16;

/// A vocabulary in memory: that of a model, or one that was [fitted](super::OwnVocabulary::fit) on the images of a map.
#[derive(Debug, PartialEq)]
pub struct Vocabulary {
    pub(super) settings: Vlad,
    pub(super) channels: usize,
    /// `centres × channels`.
    pub(super) centres: Vec<f32>,
    /// The centres at unit norm, transposed to `channels × padded`.
    directions: Vec<f32>,
    /// `centres`, rounded up to a multiple of [`LANES`].
    padded: usize,
    /// For each band and centre, `block × channels`; empty if residual sums are kept whole.
    pub(super) blocks: Vec<f32>,
    /// `expanded × dimension`; empty if there is none.
    pub(super) projection: Vec<f32>,
}

impl Vocabulary {
    /// Reads the vocabulary of a model; see [`from_bytes`](Self::from_bytes).
    pub(super) fn read(path: &Path, settings: &Vlad, channels: usize) -> Result<Self, String> {
        let bytes = std::fs::read(path).map_err(|error| error.to_string())?;
        Self::from_bytes(&bytes, settings, channels)
    }

    /// Reads a vocabulary: 16-bit floats in little-endian order, first the centres (`centres × channels`), then for
    /// each band and centre the matrix that shortens its residual sum (`channels × block`), then the projection
    /// (`rows · centres · block × dimension`). Those that the manifest does not declare are left out. The error says
    /// what is wrong with the file.
    pub(super) fn from_bytes(
        bytes: &[u8],
        settings: &Vlad,
        channels: usize,
    ) -> Result<Self, String> {
        let Vlad { centres: count, rows, block, dimension, .. } = *settings;
        let expanded = settings.expanded(channels);
        let lengths = [
            count * channels,
            block.map_or(0, |block| rows * count * channels * block),
            if dimension == expanded { 0 } else { expanded * dimension },
        ];
        let expected = 2 * lengths.iter().sum::<usize>();
        if bytes.len() != expected {
            return Err(format!(
                "it has {} bytes, but a vocabulary as the manifest declares it has {expected}",
                bytes.len()
            ));
        }
        let (halves, _) = bytes.as_chunks::<2>();
        let mut numbers = halves.iter().map(|half| f16::from_le_bytes(*half).to_f32());
        let [centres, blocks, projection] =
            lengths.map(|length| numbers.by_ref().take(length).collect::<Vec<f32>>());
        let mut all = centres.iter().chain(&blocks).chain(&projection);
        if !all.all(|number| number.is_finite()) {
            return Err("it contains a number that is not finite".to_owned());
        }
        let blocks = transposed(&blocks, channels, block.unwrap_or(1));
        Ok(Self::new(settings.clone(), channels, centres, blocks, projection))
    }

    /// Prepares a vocabulary of which `blocks` are stored as `block × channels`.
    pub(super) fn new(
        settings: Vlad,
        channels: usize,
        centres: Vec<f32>,
        blocks: Vec<f32>,
        projection: Vec<f32>,
    ) -> Self {
        let padded = settings.centres.next_multiple_of(LANES);
        let mut directions = vec![0.0; channels * padded];
        for (k, centre) in centres.chunks_exact(channels).enumerate() {
            let scale = 1.0 / norm(centre).max(1e-12);
            centre.iter().enumerate().for_each(|(c, x)| directions[c * padded + k] = x * scale);
        }
        Self { settings, channels, centres, directions, padded, blocks, projection }
    }

    /// Writes the vocabulary as `from_bytes` reads it.
    pub fn to_bytes(&self) -> Vec<u8> {
        let block = self.settings.block.unwrap_or(1);
        let blocks = transposed(&self.blocks, block, self.channels);
        let numbers = self.centres.iter().chain(&blocks).chain(&self.projection);
        numbers.flat_map(|&number| f16::from_f32(number).to_le_bytes()).collect()
    }

    /// Aggregates the local features of a picture.
    pub(super) fn aggregate(&self, features: &LocalFeatures) -> Vec<f32> {
        let (rows, count, channels) = (self.settings.rows, self.settings.centres, self.channels);
        let (cells, weights) = self.cells(features);
        let mut sums = vec![0.0; rows * count * channels];
        let mut masses = vec![0.0; rows * count];
        let mut similarities = vec![0.0; TOGETHER * self.padded];
        let mut nearest = Vec::with_capacity(count);
        for first in (0..weights.len()).step_by(TOGETHER) {
            let end = (first + TOGETHER).min(weights.len());
            let group = &cells[first * channels..(first + TOGETHER) * channels];
            multiply(group, &self.directions, channels, &mut similarities);
            for cell in first..end {
                let start = (cell - first) * self.padded;
                self.assign(&similarities[start..start + count], weights[cell], &mut nearest);
                let band = cell / features.width * rows / features.height;
                let numbers = &cells[cell * channels..(cell + 1) * channels];
                for &(k, share) in &nearest {
                    let slot = band * count + k;
                    masses[slot] += share;
                    add(&mut sums[slot * channels..(slot + 1) * channels], numbers, share);
                }
            }
        }
        for (slot, sum) in sums.chunks_exact_mut(channels).enumerate() {
            let k = slot % count;
            add(sum, &self.centres[k * channels..(k + 1) * channels], -masses[slot]);
            let length = norm(sum);
            if length > 1e-12 {
                sum.iter_mut().for_each(|x| *x /= length);
            }
        }
        self.project(self.shorten(sums))
    }

    /// The cells at unit norm, padded with zeros to a multiple of [`TOGETHER`], and the weight of each. A cell without
    /// a direction has no weight.
    fn cells(&self, features: &LocalFeatures) -> (Vec<f32>, Vec<f32>) {
        let count = features.height * features.width;
        let mut cells = features.cells.clone();
        let reliability = match self.settings.weighting {
            Weighting::None => None,
            Weighting::Reliability => features.reliability.as_deref(),
        };
        let mut weights = Vec::with_capacity(count);
        for (index, cell) in cells.chunks_exact_mut(self.channels).enumerate() {
            let length = norm(cell);
            if length > 1e-12 && length.is_finite() {
                cell.iter_mut().for_each(|x| *x /= length);
                weights.push(reliability.map_or(1.0, |map| map[index].max(MIN_WEIGHT)));
            } else {
                cell.fill(0.0);
                weights.push(0.0);
            }
        }
        cells.resize(count.next_multiple_of(TOGETHER) * self.channels, 0.0);
        (cells, weights)
    }

    /// Finds the centres that share a cell, and the share of each.
    fn assign(&self, similarities: &[f32], weight: f32, nearest: &mut Vec<(usize, f32)>) {
        nearest.clear();
        let best = similarities.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let Some(sharpness) = self.settings.sharpness else {
            let first = similarities.iter().position(|&s| s == best);
            nearest.extend(first.map(|k| (k, weight)));
            return;
        };
        let least = best + self.settings.least_share.ln() / sharpness;
        let mut total = 0.0;
        for (k, &similarity) in similarities.iter().enumerate() {
            if similarity >= least {
                let share = (sharpness * (similarity - best)).exp();
                total += share;
                nearest.push((k, share));
            }
        }
        nearest.iter_mut().for_each(|(_, share)| *share *= weight / total);
    }

    /// Shortens each residual sum by the matrix of its band and centre.
    fn shorten(&self, sums: Vec<f32>) -> Vec<f32> {
        let Some(block) = self.settings.block else { return sums };
        let mut short = vec![0.0; sums.len() / self.channels * block];
        let matrices = self.blocks.chunks_exact(self.channels * block);
        let slots = sums.chunks_exact(self.channels).zip(short.chunks_exact_mut(block));
        for ((sum, short), matrix) in slots.zip(matrices) {
            let columns = matrix.chunks_exact(self.channels);
            short.iter_mut().zip(columns).for_each(|(out, column)| *out = dot(sum, column));
        }
        short
    }

    fn project(&self, expanded: Vec<f32>) -> Vec<f32> {
        match self.projection.is_empty() {
            true => expanded,
            false => self.projected(&expanded),
        }
    }

    /// Multiplies with the projection.
    pub(super) fn projected(&self, expanded: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; self.settings.dimension];
        let rows = self.projection.chunks_exact(self.settings.dimension);
        // A centre without features has a sum of zeros.
        for (&x, row) in expanded.iter().zip(rows).filter(|(x, _)| **x != 0.0) {
            add(&mut out, row, x);
        }
        out
    }
}

pub(super) fn norm(numbers: &[f32]) -> f32 {
    dot(numbers, numbers).sqrt()
}

/// Transposes matrices of `rows × columns`.
fn transposed(matrices: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    let mut out = Vec::with_capacity(matrices.len());
    for matrix in matrices.chunks_exact(rows * columns) {
        for column in 0..columns {
            out.extend((0..rows).map(|row| matrix[row * columns + column]));
        }
    }
    out
}

/// Adds `factor · from` to `to`.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn add(to: &mut [f32], from: &[f32], factor: f32) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += factor * from;
    }
}

/// Multiplies [`TOGETHER`] cells of `channels` numbers with a matrix of `channels` rows, whose length is a multiple of
/// [`LANES`]. There is no AVX-512 variant, because the compiler makes a much slower one.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn multiply(cells: &[f32], matrix: &[f32], channels: usize, out: &mut [f32]) {
    let width = matrix.len() / channels;
    for at in (0..width).step_by(LANES) {
        let mut sums = [[0.0_f32; LANES]; TOGETHER];
        for channel in 0..channels {
            let row = &matrix[channel * width + at..][..LANES];
            for cell in 0..TOGETHER {
                let x = cells[cell * channels + channel];
                for lane in 0..LANES {
                    sums[cell][lane] += x * row[lane];
                }
            }
        }
        for (cell, sums) in sums.iter().enumerate() {
            out[cell * width + at..][..LANES].copy_from_slice(sums);
        }
    }
}

#[cfg(test)]
mod tests;
