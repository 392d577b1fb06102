//! Nearest neighbours: compares every cell of one picture with every cell of another, in floating point. This serves
//! every processor, and is the reference for [`integers`](super::integers).
//!
//! Comparing 1,200 cells with as many is a matrix product of 1.4 million similarities, of which only the
//! highest of each row and each column matter. The product is therefore never stored: the sums of a few
//! query cells against a panel of candidate cells stay in registers from the first channel to the
//! comparison with the highest so far.

use pulp::{Arch, Simd, WithSimd};

/// Vectors of candidate cells in a panel.
const PANEL: usize = 2;
/// Query cells that are compared with a panel at a time, on processors with 32 wide registers and on
/// others. Times [`PANEL`], this is the number of sums, which fit into the registers with a few to spare.
const MANY_ROWS: usize = 12;
const FEW_ROWS: usize = 6;
/// Numbers in a vector of a processor with 32 wide registers.
const WIDE: usize = 16;
/// Bytes in a cache line. Reading a vector that straddles two lines takes two accesses.
const LINE: usize = 64;

/// The highest similarity of each cell of both pictures.
#[derive(Debug, Default)]
pub(super) struct Nearest {
    /// For each query cell, the first of its most similar candidate cells and their similarity;
    /// `NEG_INFINITY` if all similarities are NaN.
    pub of_query: Vec<(usize, f32)>,
    /// For each candidate cell, its highest similarity; padded to a whole panel.
    pub of_candidate: Vec<f32>,
    /// The candidate cells in the order in which they are read: by panel, then channel, then cell.
    panels: Vec<f32>,
}

impl Nearest {
    /// Compares the cells of two pictures, row-major with `channels` numbers each. Replaces earlier results
    /// and reuses their memory.
    pub fn find(&mut self, query: &[f32], candidate: &[f32], channels: usize) {
        self.of_query.clear();
        self.of_candidate.clear();
        self.panels.clear();
        Arch::new().dispatch(Comparison { query, candidate, channels, found: self });
    }
}

/// One call of [`Nearest::find`], compiled for several processors.
struct Comparison<'a> {
    query: &'a [f32],
    candidate: &'a [f32],
    channels: usize,
    found: &'a mut Nearest,
}

impl WithSimd for Comparison<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if S::F32_LANES >= WIDE {
            self.run::<MANY_ROWS, S>(simd);
        } else {
            self.run::<FEW_ROWS, S>(simd);
        }
    }
}

impl Comparison<'_> {
    // Everything is inlined into the function that is compiled for the processor.
    #[inline(always)]
    fn run<const ROWS: usize, S: Simd>(self, simd: S) {
        let Self { query, candidate, channels, found } = self;
        let width = S::F32_LANES * PANEL;
        let panels = pack(candidate, channels, width, &mut found.panels);
        found.of_candidate.resize(panels.len() / channels, f32::NEG_INFINITY);
        let panels = S::as_simd_f32s(panels).0.as_chunks::<PANEL>().0;
        let columns = S::as_mut_simd_f32s(&mut found.of_candidate).0.as_chunks_mut::<PANEL>().0;

        let mut tile = vec![[f32::NAN; ROWS]; channels];
        for cells in query.chunks(ROWS * channels) {
            for (row, cell) in cells.chunks_exact(channels).enumerate() {
                for (numbers, number) in tile.iter_mut().zip(cell) {
                    numbers[row] = *number;
                }
            }
            let mut best = [[simd.splat_f32s(f32::NEG_INFINITY); PANEL]; ROWS];
            let mut panel_of_best = [[simd.splat_u32s(0); PANEL]; ROWS];
            // Rows past the end change nothing: they are NaN, or repeat rows of the previous tile.
            for (index, panel) in panels.chunks_exact(channels).enumerate() {
                let mut sums = [[simd.splat_f32s(0.0); PANEL]; ROWS];
                for (numbers, vectors) in tile.iter().zip(panel) {
                    for row in 0..ROWS {
                        let number = simd.splat_f32s(numbers[row]);
                        for vector in 0..PANEL {
                            sums[row][vector] =
                                simd.mul_add_f32s(number, vectors[vector], sums[row][vector]);
                        }
                    }
                }
                let here = simd.splat_u32s(index as u32);
                let mut column = columns[index];
                for row in 0..ROWS {
                    for vector in 0..PANEL {
                        // A comparison with NaN is false.
                        let (sum, highest) = (sums[row][vector], &mut best[row][vector]);
                        let higher = simd.greater_than_f32s(sum, *highest);
                        *highest = simd.select_f32s(higher, sum, *highest);
                        panel_of_best[row][vector] =
                            simd.select_u32s(higher, here, panel_of_best[row][vector]);
                        let higher = simd.greater_than_f32s(sum, column[vector]);
                        column[vector] = simd.select_f32s(higher, sum, column[vector]);
                    }
                }
                columns[index] = column;
            }
            for row in 0..cells.len() / channels {
                let highest: &[f32] = bytemuck::cast_slice(&best[row]);
                let panel: &[u32] = bytemuck::cast_slice(&panel_of_best[row]);
                found.of_query.push(first_highest(highest, panel));
            }
        }
    }
}

/// Copies cells into panels of `width`, aligned to cache lines. The last panel is padded with NaN, which is
/// never the nearest.
#[inline(always)]
fn pack<'a>(cells: &[f32], channels: usize, width: usize, memory: &'a mut Vec<f32>) -> &'a [f32] {
    let count = cells.len() / channels;
    let padded = count.div_ceil(width) * width;
    memory.resize(padded * channels + LINE / size_of::<f32>(), f32::NAN);
    // At most a line; `align_offset` may return `usize::MAX` if it cannot tell.
    let start = memory.as_ptr().align_offset(LINE).min(LINE / size_of::<f32>());
    let panels = &mut memory[start..][..padded * channels];
    for panel in 0..padded / width {
        let first = panel * width;
        for channel in 0..channels {
            let column = &mut panels[(first * channels + channel * width)..][..width];
            for offset in 0..width.min(count - first) {
                column[offset] = cells[(first + offset) * channels + channel];
            }
        }
    }
    panels
}

/// Returns the first cell with the highest similarity and that similarity, from the highest of each lane and
/// the panel in which that lane had it.
fn first_highest(highest: &[f32], panel: &[u32]) -> (usize, f32) {
    let mut first = (0, f32::NEG_INFINITY);
    for (offset, (similarity, panel)) in highest.iter().zip(panel).enumerate() {
        let cell = *panel as usize * highest.len() + offset;
        if *similarity > first.1 || (*similarity == first.1 && cell < first.0) {
            first = (cell, *similarity);
        }
    }
    first
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Reproducible cells with numbers of a realistic size, some of them equal.
    pub fn cells(count: usize, channels: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            ((state >> 24) as f32 - 128.0) / 256.0
        };
        (0..count * channels).map(|_| next()).collect()
    }

    /// The reference implementation.
    fn reference(
        query: &[f32],
        candidate: &[f32],
        channels: usize,
    ) -> (Vec<(usize, f32)>, Vec<f32>) {
        let mut of_candidate = vec![f32::NEG_INFINITY; candidate.len() / channels];
        let of_query = query.chunks(channels).map(|cell| {
            let mut best = (0, f32::NEG_INFINITY);
            for (index, other) in candidate.chunks(channels).enumerate() {
                let similarity: f32 = cell.iter().zip(other).map(|(a, b)| a * b).sum();
                if similarity > best.1 {
                    best = (index, similarity);
                }
                of_candidate[index] = of_candidate[index].max(similarity);
            }
            best
        });
        (of_query.collect(), of_candidate)
    }

    #[test]
    fn the_nearest_cells_equal_those_of_the_reference_implementation() {
        let mut found = Nearest::default();
        // The numbers are multiples of 1/256, so that sums are exact in any order.
        for (ours, theirs, channels) in [
            (1, 1, 1),
            (1, 40, 3),
            (13, 1, 64),
            (12, 32, 64),
            (25, 97, 24),
            (31, 33, 7),
            (200, 150, 64),
        ] {
            let query = cells(ours, channels, 7);
            let candidate = cells(theirs, channels, 8);
            found.find(&query, &candidate, channels);
            let (of_query, of_candidate) = reference(&query, &candidate, channels);
            assert_eq!(found.of_query, of_query, "{ours} × {theirs} × {channels}");
            assert_eq!(found.of_candidate[..theirs], of_candidate, "{ours} × {theirs}");
            assert!(found.of_candidate[theirs..].iter().all(|x| *x == f32::NEG_INFINITY));
        }
    }

    #[test]
    fn nan_is_never_the_nearest() {
        let mut found = Nearest::default();
        found.find(&[1.0, f32::NAN], &[f32::NAN, 0.5, 0.25], 1);
        assert_eq!(found.of_query, [(1, 0.5), (0, f32::NEG_INFINITY)]);
        assert_eq!(found.of_candidate[..3], [f32::NEG_INFINITY, 0.5, 0.25]);
    }

    #[test]
    fn of_equal_cells_the_first_is_the_nearest() {
        let mut found = Nearest::default();
        let mut candidate = vec![0.25; 70];
        candidate[33] = 0.5;
        candidate[34] = 0.5;
        candidate[66] = 0.5;
        found.find(&[1.0], &candidate, 1);
        assert_eq!(found.of_query, [(33, 0.5)]);
    }
}
