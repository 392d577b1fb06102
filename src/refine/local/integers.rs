//! Nearest neighbours in 16-bit integers, on processors with AVX2 or AVX-512.
//!
//! The numbers of a cell of length 1 are at most 1, so that 16-bit integers keep them to within 0.000015, and a cosine
//! to within some 0.00005. One instruction multiplies pairs of them and adds the products, which makes a comparison
//! half the work that it is in floating point. Sums of integers do not depend on their order: every processor finds the
//! same.
//!
//! The query is laid out once, for all candidates; see [`nearest`](super::nearest) for the scheme. Where the highest
//! similarity of a candidate cell was found is kept in its lowest bits: the query cells are numbered in groups of
//! [`GROUP`], and the number of the group, counted backwards so that the first wins, replaces as many bits as it needs. For
//! 1,200 cells these are 7 of the 31, and the similarity keeps 24, as many as in floating point.

mod lanes;

use pulp::NullaryFnOnce;
use pulp::x86::{V3, V4};

use self::lanes::Lanes;
use super::mutual::{CellPair, Mutual, mutual};
use whereabouts_core::dense::DenseFeatures;

/// The integer of 1.
const ONE: f32 = 32_767.0;
/// Vectors of query cells in a panel.
const PANEL: usize = 2;
/// Candidate cells that are compared with a panel at a time, on processors with 32 registers and with 16. Times
/// [`PANEL`], this is the number of sums, which fit into the registers with a few to spare.
const MANY_ROWS: usize = 12;
const FEW_ROWS: usize = 6;
/// Query cells that have the same tag: a vector of AVX-512, and a panel of AVX2, so that all processors find the same.
const GROUP: usize = 16;
/// Integers in a cache line.
const LINE: usize = 16;

/// A query that is compared with one candidate after another.
#[derive(Debug)]
pub(super) struct Integers {
    processor: Processor,
    query: Query,
    found: Found,
}

/// The cells of a query as the comparison reads them.
#[derive(Debug)]
struct Query {
    cells: usize,
    channels: usize,
    /// Which cells are zero.
    empty: Vec<bool>,
    /// The cells by panel, then pair of channels, then cell; two 16-bit integers in each. Begins anywhere in the first
    /// cache line, so that a vector lies within one.
    panels: Vec<i32>,
    /// For each cell, what its sums begin with: 0, or for those that only fill the last panel, the least integer.
    starts: Vec<i32>,
    /// The bits of a similarity that tell the group of the query cell.
    tag: i32,
}

/// The outcome of a comparison, and its working memory.
#[derive(Debug, Default)]
struct Found {
    /// For each candidate cell, the first of its most similar query cells, and their similarity with their tag.
    of_candidate: Vec<(usize, i32)>,
    /// For each query cell, its highest similarity with its tag; padded to a whole panel.
    of_query: Vec<i32>,
    /// The candidate's cells, two 16-bit integers in each number.
    candidate: Vec<i32>,
}

#[derive(Debug, Clone, Copy)]
enum Processor {
    Avx512(V4),
    Avx2(V3),
}

impl Processor {
    /// The processors whose instructions this one has, the best first.
    fn available() -> impl Iterator<Item = Self> {
        let (avx512, avx2) = (V4::try_new().map(Self::Avx512), V3::try_new().map(Self::Avx2));
        avx512.into_iter().chain(avx2)
    }

    /// Cells in a panel.
    fn width(self) -> usize {
        match self {
            Self::Avx512(_) => PANEL * size_of::<<V4 as Lanes>::Vector>() / size_of::<i32>(),
            Self::Avx2(_) => PANEL * size_of::<<V3 as Lanes>::Vector>() / size_of::<i32>(),
        }
    }
}

impl Integers {
    /// Lays out a query; `None` on processors that have neither AVX2 nor AVX-512.
    pub fn of(query: &DenseFeatures) -> Option<Self> {
        Processor::available().next().map(|processor| Self::on(processor, query))
    }

    fn on(processor: Processor, query: &DenseFeatures) -> Self {
        let query = Query::of(query, processor.width());
        Self { processor, query, found: Found::default() }
    }

    /// Finds the mutual nearest neighbours that are more similar than `min_similarity`. Both pictures have the same
    /// number of channels.
    pub fn find(&mut self, candidate: &DenseFeatures, min_similarity: f32) -> Mutual {
        let Self { processor, query, found } = self;
        found.of_candidate.clear();
        found.of_query.clear();
        found.of_query.resize(query.starts.len(), i32::MIN);
        let cells = candidate.cells();
        match *processor {
            Processor::Avx512(lanes) => {
                lanes.vectorize(Comparison::<MANY_ROWS, _> { lanes, query, cells, found });
            }
            Processor::Avx2(lanes) => {
                lanes.vectorize(Comparison::<FEW_ROWS, _> { lanes, query, cells, found });
            }
        }
        self.mutual(min_similarity)
    }

    fn mutual(&self, min_similarity: f32) -> Mutual {
        let Self { query, found, .. } = self;
        let mut partners: Vec<Option<CellPair>> = vec![None; query.cells];
        for (candidate, query, similarity) in mutual(&found.of_candidate, &found.of_query) {
            let similarity = self.query.cosine(similarity);
            if similarity > min_similarity {
                partners[query] = Some(CellPair { query, candidate, similarity });
            }
        }
        let best = found.of_query.iter().zip(&query.empty).map(|(similarity, empty)| match empty {
            true => f32::NEG_INFINITY,
            false => query.cosine(*similarity),
        });
        let matched = |pair: &CellPair| !query.empty[pair.query];
        Mutual {
            best: best.collect(),
            pairs: partners.into_iter().flatten().filter(matched).collect(),
        }
    }
}

/// Numbers of this size hold the channels of a cell.
fn pairs_of(channels: usize) -> usize {
    channels.div_ceil(2)
}

/// Rounds cells to integers, row by row as they are. An odd channel at the end is paired with 0.
#[inline(always)]
fn round(cells: &[f32], channels: usize, memory: &mut Vec<i32>) {
    let count = cells.len() / channels;
    // All are overwritten but the 0 beside an odd channel.
    memory.resize(count * pairs_of(channels), 0);
    let shorts: &mut [i16] = bytemuck::cast_slice_mut(memory);
    let rows = shorts.chunks_exact_mut(2 * pairs_of(channels));
    for (cell, row) in cells.chunks_exact(channels).zip(rows) {
        for (number, short) in cell.iter().zip(row) {
            *short = (number * ONE).round_ties_even() as i32 as i16;
        }
    }
}

/// The first number of a cache line; `align_offset` may return `usize::MAX` if it cannot tell.
fn aligned(memory: &[i32]) -> usize {
    memory.as_ptr().align_offset(LINE * size_of::<i32>()).min(LINE)
}

impl Query {
    fn cosine(&self, tagged: i32) -> f32 {
        (tagged & !self.tag) as f32 / (ONE * ONE)
    }

    fn of(query: &DenseFeatures, width: usize) -> Self {
        let (cells, channels) = (query.len(), query.channels());
        let pairs = pairs_of(channels);
        let padded = cells.next_multiple_of(width);
        let mut rows = Vec::new();
        round(query.cells(), channels, &mut rows);
        let mut panels = vec![0; padded * pairs + LINE];
        let begin = aligned(&panels);
        for (cell, row) in rows.chunks_exact(pairs).enumerate() {
            let first = begin + cell / width * width * pairs + cell % width;
            for (pair, numbers) in row.iter().enumerate() {
                panels[first + pair * width] = *numbers;
            }
        }
        let mut starts = vec![0; cells];
        starts.resize(padded, i32::MIN);
        let empty = query.cells().chunks_exact(channels).map(|cell| cell.iter().all(|x| *x == 0.0));
        // The smallest number of ones that has room for all groups, those of the widest panel.
        let groups = cells.next_multiple_of(PANEL * GROUP) / GROUP;
        let tag = (groups.next_power_of_two() - 1) as i32;
        Self { cells, channels, empty: empty.collect(), panels, starts, tag }
    }
}

/// One call of [`Integers::find`], compiled for one processor.
struct Comparison<'a, const ROWS: usize, L> {
    lanes: L,
    query: &'a Query,
    cells: &'a [f32],
    found: &'a mut Found,
}

impl<const ROWS: usize, L: Lanes> NullaryFnOnce for Comparison<'_, ROWS, L> {
    type Output = ();

    // Everything is inlined into the function that is compiled for the processor.
    #[inline(always)]
    fn call(self) {
        let Self { lanes, query, cells, found } = self;
        let Found { of_candidate, of_query, candidate } = found;
        let pairs = pairs_of(query.channels);
        round(cells, query.channels, candidate);
        let panels = &query.panels[aligned(&query.panels)..][..query.starts.len() * pairs];
        let panels = bytemuck::cast_slice::<i32, L::Vector>(panels).as_chunks::<PANEL>().0;
        let starts = bytemuck::cast_slice::<i32, L::Vector>(&query.starts).as_chunks::<PANEL>().0;
        let columns = bytemuck::cast_slice_mut::<i32, L::Vector>(of_query);
        let columns = columns.as_chunks_mut::<PANEL>().0;

        let keep = lanes.splat(!query.tag);
        let mut tile = vec![[0; ROWS]; pairs];
        for rows in candidate.chunks(ROWS * pairs) {
            let count = rows.len() / pairs;
            for row in 0..ROWS {
                // Repeated rows change nothing.
                let cell = &rows[(row % count) * pairs..][..pairs];
                for (numbers, number) in tile.iter_mut().zip(cell) {
                    numbers[row] = *number;
                }
            }
            let mut best = [[lanes.splat(i32::MIN); PANEL]; ROWS];
            for (index, panel) in panels.chunks_exact(pairs).enumerate() {
                let mut sums = [starts[index]; ROWS];
                for (numbers, vectors) in tile.iter().zip(panel) {
                    for row in 0..ROWS {
                        let number = lanes.splat(numbers[row]);
                        for vector in 0..PANEL {
                            sums[row][vector] =
                                lanes.add_products(number, vectors[vector], sums[row][vector]);
                        }
                    }
                }
                let mut tags = [lanes.splat(0); PANEL];
                for (vector, tag) in tags.iter_mut().enumerate() {
                    let cell = (index * PANEL + vector) * size_of::<L::Vector>() / size_of::<i32>();
                    *tag = lanes.splat(query.tag - (cell / GROUP) as i32);
                }
                let mut column = columns[index];
                for row in 0..ROWS {
                    for vector in 0..PANEL {
                        let sum = lanes.tagged(sums[row][vector], keep, tags[vector]);
                        best[row][vector] = lanes.higher(sum, best[row][vector]);
                        column[vector] = lanes.higher(sum, column[vector]);
                    }
                }
                columns[index] = column;
            }
            for best in best.iter().take(count) {
                of_candidate.push(first_highest(bytemuck::cast_slice(best), query.tag));
            }
        }
    }
}

/// Returns the first cell with the highest similarity, and that with its tag, from the highest of each lane.
#[inline(always)]
fn first_highest(highest: &[i32], tag: i32) -> (usize, i32) {
    let most = highest.iter().copied().fold(i32::MIN, i32::max);
    let lanes = highest.iter().enumerate();
    let first = lanes.fold(u32::MAX, |first, (lane, similarity)| {
        first.min(if *similarity == most { (lane % GROUP) as u32 } else { u32::MAX })
    });
    ((tag - (most & tag)) as usize * GROUP + first as usize, most)
}

#[cfg(test)]
mod tests;
