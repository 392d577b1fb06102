//! How much a frame shows: whether it has the structure that any picture of a place has.
//!
//! A covered lens, fog, the empty buffer of a camera or pure noise resemble some image of a map more than the others,
//! by chance, so similarity cannot tell that they show nothing. The picture itself can. Scenes have edges at all
//! scales, with amplitudes that hardly depend on the scale (Field, *Relations between the statistics of natural images
//! and the response properties of cortical cells*, 1987). Noise fades with every averaging, and a blurred picture
//! has edges only at the largest scale.
//!
//! Test patterns and pictures of which a part is missing are recognised by how regular they are
//! ([`regularity`]).
//!
//! Edges are measured as second differences, which a brightness gradient does not have, on the picture that the model
//! sees, averaged to 64, 32 and 16 columns. The thresholds were measured: see docs/evaluation.md.

mod regularity;

use std::fmt;

use self::regularity::{beyond_low_rank, kurtosis};
use super::manifest::Input;
use super::preprocess::Tensor;

pub use self::regularity::Dead;

/// Longest edge of the finest of the three scales.
const FINE: usize = 64;

/// Second difference, in grey levels of 255, that counts as an edge at the middle scale: several times what noise and
/// compression leave there.
const EDGE: f32 = 4.0;

/// Minimum share of the picture at the middle scale that has edges.
const MIN_EDGES: f32 = 0.08;

/// Ratio of the mean second difference at the coarse scale to that at the fine one. White noise has a quarter,
/// scenes have 0.6 to 4.9, and a picture blurred over a twentieth of its width has more than 7.
const MIN_PERSISTENCE: f32 = 0.45;
const MAX_PERSISTENCE: f32 = 6.0;

/// Minimum share of the energy that no four products of a column and a row explain. Scenes have 0.10 to 0.64, test
/// patterns at most 0.05.
const MIN_BEYOND_LOW_RANK: f32 = 0.07;

/// Minimum kurtosis of the edges. Scenes have 3.6 to 170, rings and checkerboards with noise about 2.
const MIN_EDGE_KURTOSIS: f32 = 2.6;

/// Maximum share of the picture that has one value all along rows or columns, and the same without the values of a dark
/// or over-exposed part. Scenes have none, over-exposed ones up to 0.5 and 0.
const MAX_DEAD: Dead = Dead { any: 0.45, grey: 0.35 };

/// The structure of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Information {
    /// Share of the picture that has edges, 0 to 1.
    pub edges: f32,
    /// Amplitude of the edges at the coarse scale, relative to the fine scale.
    pub persistence: f32,
    /// Share of the energy that is in no pattern of stripes and squares, 0 to 1.
    pub irregular: f32,
    /// How unequal the edges are: the kurtosis of their amplitudes at the fine scale.
    pub edge_kurtosis: f32,
    /// What is missing.
    pub dead: Dead,
}

/// Why a frame shows no place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Uninformative {
    /// It is nearly uniform.
    Blank,
    /// It is noise.
    Noise,
    /// It is blurred beyond recognition.
    Blurred,
    /// It is a pattern of stripes, squares or rings, as of a test card.
    Pattern,
    /// A large part of it is missing.
    Incomplete,
}

impl Information {
    /// Measures the structure of a preprocessed picture.
    pub(super) fn of(tensor: &Tensor, input: &Input) -> Self {
        let fine = Grey::reduced(tensor, input);
        let middle = fine.halved();
        let coarse = middle.halved();
        let (at_fine, at_middle, at_coarse) = (fine.edges(), middle.edges(), coarse.edges());
        let strong = at_middle.iter().filter(|&&edge| edge > EDGE).count();
        // Keeps the ratio at one where there is nothing.
        const FLOOR: f32 = 0.2;
        Self {
            edges: strong as f32 / at_middle.len().max(1) as f32,
            persistence: (mean(&at_coarse) + FLOOR) / (mean(&at_fine) + FLOOR),
            irregular: beyond_low_rank(&fine),
            edge_kurtosis: kurtosis(&at_fine),
            dead: Dead::of(tensor.width, Lumas::of(tensor, input).rows()),
        }
    }

    /// Why the picture shows no place; `None` if it has enough structure.
    pub fn lack(self) -> Option<Uninformative> {
        if self.persistence < MIN_PERSISTENCE {
            let is_faint = self.edges < MIN_EDGES;
            Some(if is_faint { Uninformative::Blank } else { Uninformative::Noise })
        } else if self.edges < MIN_EDGES {
            Some(Uninformative::Blank)
        } else if self.persistence > MAX_PERSISTENCE {
            Some(Uninformative::Blurred)
        } else if self.irregular < MIN_BEYOND_LOW_RANK || self.edge_kurtosis < MIN_EDGE_KURTOSIS {
            Some(Uninformative::Pattern)
        } else if self.dead.any > MAX_DEAD.any || self.dead.grey > MAX_DEAD.grey {
            Some(Uninformative::Incomplete)
        } else {
            None
        }
    }
}

impl Uninformative {
    /// The word for metrics.
    pub fn word(self) -> &'static str {
        match self {
            Self::Blank => "blank",
            Self::Noise => "noise",
            Self::Blurred => "blurred",
            Self::Pattern => "pattern",
            Self::Incomplete => "incomplete",
        }
    }
}

impl fmt::Display for Uninformative {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Blank => {
                "the frame shows hardly any structure, as with a covered lens, darkness, fog, a bare wall or an \
                 empty camera buffer, so the place cannot be known from it"
            }
            Self::Noise => {
                "the frame is noise without the structure of a scene, so the place cannot be known from it; check \
                 the camera"
            }
            Self::Blurred => {
                "the frame is blurred beyond recognition, so the place cannot be known from it; check the focus"
            }
            Self::Pattern => {
                "the frame is a regular pattern, as of a test card or a camera without a signal, so the place cannot be \
                 known from it"
            }
            Self::Incomplete => {
                "a large part of the frame has no content, as of a picture that was not transmitted or decoded to the \
                 end, so the place cannot be known from it"
            }
        })
    }
}

/// The luma of the pixels of a tensor.
struct Lumas<'a> {
    width: usize,
    height: usize,
    planes: [&'a [f32]; 3],
    weights: [f32; 3],
    offset: f32,
}

impl<'a> Lumas<'a> {
    fn of(tensor: &'a Tensor, input: &Input) -> Self {
        // Luma of Rec. 601, of numbers that are still normalised.
        const LUMA: [f32; 3] = [0.299, 0.587, 0.114];
        let (red, rest) = tensor.data.split_at(tensor.width * tensor.height);
        let (green, blue) = rest.split_at(tensor.width * tensor.height);
        Self {
            width: tensor.width,
            height: tensor.height,
            planes: [red, green, blue],
            weights: [0, 1, 2].map(|channel| LUMA[channel] * input.std[channel]),
            offset: (0..3).map(|channel| LUMA[channel] * input.mean[channel]).sum(),
        }
    }

    /// Adds the numbers of a row to `sums`, which [`level`](Self::level) makes grey levels of.
    fn add_row(&self, y: usize, sums: &mut [f32]) {
        let row = y * self.width..(y + 1) * self.width;
        let [red, green, blue] = self.planes.map(|plane| &plane[row.clone()]);
        for (sum, ((r, g), b)) in sums.iter_mut().zip(red.iter().zip(green).zip(blue)) {
            *sum += self.weights[0] * r + self.weights[1] * g + self.weights[2] * b;
        }
    }

    /// Converts a number of a row to a grey level, 0 to 255.
    fn level(&self, number: f32) -> f32 {
        255.0 * (number + self.offset)
    }

    /// The rows in grey levels.
    fn rows(&self) -> impl Iterator<Item = Vec<f32>> {
        (0..self.height).map(|y| {
            let mut row = vec![0.0; self.width];
            self.add_row(y, &mut row);
            row.iter_mut().for_each(|value| *value = self.level(*value));
            row
        })
    }
}

/// A small grey picture.
struct Grey {
    width: usize,
    height: usize,
    /// Row by row, 0 to 255.
    values: Vec<f32>,
}

impl Grey {
    /// Averages the channels and areas of a tensor.
    fn reduced(tensor: &Tensor, input: &Input) -> Self {
        let (from_width, from_height) = (tensor.width, tensor.height);
        let longest = from_width.max(from_height).max(1);
        let fit = |edge: usize| (edge * FINE.min(longest)).div_ceil(longest).max(1);
        let (width, height) = (fit(from_width), fit(from_height));
        let columns: Vec<usize> = (0..from_width).map(|x| x * width / from_width).collect();
        let pixels = Lumas::of(tensor, input);
        let mut values = Vec::with_capacity(width * height);
        for to_row in 0..height {
            let first = |row: usize| (row * from_height).div_ceil(height);
            let rows = first(to_row)..first(to_row + 1);
            // The rows are added first, which the compiler vectorises, and the columns once for all of them.
            let mut lumas = vec![0.0; from_width];
            rows.clone().for_each(|y| pixels.add_row(y, &mut lumas));
            let mut sums = vec![(0.0, 0u32); width];
            for (luma, column) in lumas.iter().zip(&columns) {
                let (sum, count) = &mut sums[*column];
                (*sum, *count) = (*sum + luma, *count + 1);
            }
            let rows = rows.len() as f32;
            let value = |(sum, count): (f32, u32)| pixels.level(sum / (count as f32 * rows));
            values.extend(sums.into_iter().map(value));
        }
        Self { width, height, values }
    }

    /// Averages blocks of 2 × 2.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let at = |x: usize, y: usize| self.values[y * self.width + x];
        let block =
            |x: usize, y: usize| (at(x, y) + at(x + 1, y) + at(x, y + 1) + at(x + 1, y + 1)) / 4.0;
        let values = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Self { width, height, values: values.map(|(x, y)| block(2 * x, 2 * y)).collect() }
    }

    /// The larger of the horizontal and the vertical second difference, for each inner cell.
    fn edges(&self) -> Vec<f32> {
        let at = |x: usize, y: usize| self.values[y * self.width + x];
        let inner = (1..self.height.saturating_sub(1))
            .flat_map(|y| (1..self.width.saturating_sub(1)).map(move |x| (x, y)));
        let edge = |(x, y): (usize, usize)| {
            let middle = 2.0 * at(x, y);
            let across = (at(x - 1, y) + at(x + 1, y) - middle).abs();
            across.max((at(x, y - 1) + at(x, y + 1) - middle).abs())
        };
        inner.map(edge).collect()
    }
}

fn mean(values: &[f32]) -> f32 {
    values.iter().sum::<f32>() / values.len().max(1) as f32
}

#[cfg(test)]
mod tests;
