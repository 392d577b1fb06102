//! How regular a picture is: whether it is a pattern rather than a scene, and whether a part of it is missing.
//!
//! Stripes, checkerboards, colour bars and test cards are products of a few functions of the column and of the row:
//! the matrix of their grey levels, at the same contrast everywhere, has a very low rank. A scene keeps a good part of
//! its energy outside any few such products. Rings and gratings of any shape have edges of one amplitude; those of a
//! scene have a heavy-tailed distribution (Ruderman and Bialek, *Statistics of natural images: scaling in the woods*,
//! 1994). Rows that were never decoded or transmitted have one value all along, which no sensor gives.

use super::Grey;

/// The rank up to which a matrix of grey levels is explained.
const RANK: usize = 4;

/// Rounds of the subspace iteration. A matrix of at most rank [`RANK`] needs one.
const ROUNDS: usize = 12;

/// Cells to each side of one over which contrast is made even.
const REACH: usize = 3;

/// Grey levels added to the local contrast, so that noise is not made a pattern of.
const CONTRAST_FLOOR: f32 = 2.0;

/// Grey levels of 255 within which a row or column has one value.
const ONE_VALUE: f32 = 2.0;

/// Grey levels that a sensor can have all along: under-exposed and over-exposed ones.
const DARK: f32 = 10.0;
const BRIGHT: f32 = 245.0;

/// Returns the share of the energy of the picture, with its contrast made even, that the best matrix of rank [`RANK`]
/// leaves; 1 for a picture without any.
pub(super) fn beyond_low_rank(picture: &Grey) -> f32 {
    let even = even_contrast(picture);
    let (width, height) = (picture.width, picture.height);
    let row = |y: usize| &even[y * width..(y + 1) * width];
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
    // The Gram matrix of the rows, whose eigenvalues are the energies of the products.
    let gram: Vec<Vec<f32>> =
        (0..height).map(|a| (0..height).map(|b| dot(row(a), row(b))).collect()).collect();
    let energy: f32 = (0..height).map(|y| gram[y][y]).sum();
    if energy <= f32::EPSILON {
        return 1.0;
    }
    let times = |vector: &[f32]| -> Vec<f32> { gram.iter().map(|row| dot(row, vector)).collect() };
    // Any start will do that is no symmetric pattern itself.
    let start = |k: usize| (0..height).map(|y| ((y * (2 * k + 3) + k) as f32).sin()).collect();
    let mut basis: Vec<Vec<f32>> = (0..RANK.min(height)).map(start).collect();
    for _ in 0..ROUNDS {
        let images: Vec<Vec<f32>> = basis.iter().map(|vector| times(vector)).collect();
        basis = orthonormal(images);
    }
    let explained: f32 = basis.iter().map(|vector| dot(vector, &times(vector))).sum();
    (1.0 - explained / energy).clamp(0.0, 1.0)
}

/// Makes vectors orthonormal (modified Gram-Schmidt), twice for precision, and drops those that depend on others.
fn orthonormal(vectors: Vec<Vec<f32>>) -> Vec<Vec<f32>> {
    let norm = |vector: &[f32]| vector.iter().map(|x| x * x).sum::<f32>().sqrt();
    let mut done: Vec<Vec<f32>> = Vec::with_capacity(vectors.len());
    for mut vector in vectors {
        let before = norm(&vector);
        for _ in 0..2 {
            for other in &done {
                let along: f32 = vector.iter().zip(other).map(|(a, b)| a * b).sum();
                vector.iter_mut().zip(other).for_each(|(a, b)| *a -= along * b);
            }
        }
        let length = norm(&vector);
        if length > 1e-4 * before && length.is_normal() {
            vector.iter_mut().for_each(|x| *x /= length);
            done.push(vector);
        }
    }
    done
}

/// Subtracts the mean of the surroundings of each cell, and divides by their standard deviation.
fn even_contrast(picture: &Grey) -> Vec<f32> {
    let squares = picture.values.iter().map(|value| value * value).collect::<Vec<f32>>();
    let means = surroundings(&picture.values, picture.width, picture.height);
    let square_means = surroundings(&squares, picture.width, picture.height);
    let local = means.iter().zip(square_means);
    let even = |(&value, (mean, square)): (&f32, (&f32, f32))| {
        (value - mean) / ((square - mean * mean).max(0.0).sqrt() + CONTRAST_FLOOR)
    };
    picture.values.iter().zip(local).map(even).collect()
}

/// Averages each cell with those up to [`REACH`] away.
fn surroundings(values: &[f32], width: usize, height: usize) -> Vec<f32> {
    let window = |at: usize, end: usize| at.saturating_sub(REACH)..(at + REACH + 1).min(end);
    let mut across = vec![0.0; values.len()];
    for y in 0..height {
        let row = &values[y * width..(y + 1) * width];
        for x in 0..width {
            across[y * width + x] = super::mean(&row[window(x, width)]);
        }
    }
    let mut both = vec![0.0; values.len()];
    for y in 0..height {
        let rows = window(y, height);
        let share = 1.0 / rows.len() as f32;
        for from in rows {
            let (sums, row) = (&mut both[y * width..(y + 1) * width], &across[from * width..]);
            sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += value * share);
        }
    }
    both
}

/// Returns the kurtosis of values: 3 for a normal distribution, less for values of about one magnitude.
pub(super) fn kurtosis(values: &[f32]) -> f32 {
    let mean = super::mean(values);
    let moment = |power: i32| {
        values.iter().map(|value| (value - mean).powi(power)).sum::<f32>()
            / values.len().max(1) as f32
    };
    let variance = moment(2);
    if variance > f32::EPSILON { moment(4) / (variance * variance) } else { f32::INFINITY }
}

/// How much of a picture has one value all along its rows or its columns, whichever is more.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Dead {
    /// Share of the picture, 0 to 1.
    pub any: f32,
    /// The same, without values that a dark or over-exposed part of a scene has.
    pub grey: f32,
}

impl Dead {
    /// Measures a picture that is given row by row in grey levels of 255.
    pub(super) fn of(width: usize, rows: impl Iterator<Item = Vec<f32>>) -> Self {
        let mut columns = vec![(f32::INFINITY, f32::NEG_INFINITY); width];
        let mut by_row = Vec::new();
        for row in rows {
            let mut range = (f32::INFINITY, f32::NEG_INFINITY);
            for (&value, column) in row.iter().zip(&mut columns) {
                range = (range.0.min(value), range.1.max(value));
                *column = (column.0.min(value), column.1.max(value));
            }
            by_row.push(range);
        }
        let (of_rows, of_columns) = (Self::share(&by_row), Self::share(&columns));
        Self { any: of_rows.any.max(of_columns.any), grey: of_rows.grey.max(of_columns.grey) }
    }

    fn share(ranges: &[(f32, f32)]) -> Self {
        let dead = |(low, high): &&(f32, f32)| high - low < ONE_VALUE;
        let grey = |(low, high): &&(f32, f32)| *low > DARK && *high < BRIGHT;
        let count = ranges.len().max(1) as f32;
        Self {
            any: ranges.iter().filter(dead).count() as f32 / count,
            grey: ranges.iter().filter(dead).filter(grey).count() as f32 / count,
        }
    }
}
