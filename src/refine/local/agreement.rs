//! Geometric verification: keeps the matches that moved together with their surroundings.
//!
//! The check is local. As a robot moves, near things shift more than far ones, so no single homography
//! explains a correct pair, and a part of the robot that is fixed in the picture would win over the scene.
//! Neighbouring regions of the same place still move alike, which chance matches do not. This is the idea
//! of grid-based motion statistics (Bian et al., "GMS", CVPR 2017), applied to the cells of the feature map.

use super::mutual::CellPair;
use super::{LocalSettings, Match};
use whereabouts_core::dense::DenseFeatures;

/// Returns the matches with enough neighbours that moved as they did. `located` has the positions of
/// `pairs`; `tolerance` is `[x, y]` in fractions of the picture's edges.
pub(super) fn agreeing<'a>(
    query: &DenseFeatures,
    pairs: &'a [CellPair],
    located: &'a [Match],
    tolerance: [f32; 2],
    settings: &'a LocalSettings,
) -> impl Iterator<Item = (CellPair, Match)> + 'a {
    let field = MotionField::new(query, pairs, located, settings.neighbourhood);
    pairs.iter().zip(located).filter_map(move |(pair, found)| {
        let support = field.support(pair.query, tolerance);
        (support >= settings.min_support).then_some((*pair, *found))
    })
}

/// The motion of each query cell that has a match.
struct MotionField {
    width: usize,
    height: usize,
    /// The neighbourhood of a match: cells to each side, as `[columns, rows]`.
    reach: [usize; 2],
    /// Candidate position minus query position, in fractions of the picture, row by row; x and y apart, so that several
    /// cells are compared at a time. NaN where there is no match, and in a margin of `reach` around the picture.
    motions: [Vec<f32>; 2],
}

impl MotionField {
    fn new(query: &DenseFeatures, pairs: &[CellPair], located: &[Match], radius: f32) -> Self {
        let (width, height) = (query.width(), query.height());
        let reach = |cells: usize| ((radius * cells as f32).round() as usize).clamp(1, cells);
        let reach = [reach(width), reach(height)];
        let none = vec![f32::NAN; (width + 2 * reach[0]) * (height + 2 * reach[1])];
        let mut field = Self { width, height, reach, motions: [none.clone(), none] };
        for (pair, found) in pairs.iter().zip(located) {
            let (row, column) = (pair.query / width, pair.query % width);
            let at = (row + reach[1]) * field.stride() + column + reach[0];
            for axis in [0, 1] {
                field.motions[axis][at] = found.candidate[axis] - found.query[axis];
            }
        }
        field
    }

    /// Cells of a row with its margins.
    fn stride(&self) -> usize {
        self.width + 2 * self.reach[0]
    }

    /// Returns the share of the cells around `cell`, which has a match, that moved as it did, 0 to 1. A single such cell
    /// may be chance and counts as none.
    fn support(&self, cell: usize, tolerance: [f32; 2]) -> f32 {
        let (row, column) = (cell / self.width, cell % self.width);
        let within = |at: usize, reach: usize, cells: usize| {
            (at + reach + 1).min(cells) - at.saturating_sub(reach)
        };
        let around =
            within(row, self.reach[1], self.height) * within(column, self.reach[0], self.width) - 1;
        let at = (row + self.reach[1]) * self.stride() + column + self.reach[0];
        let motion = [self.motions[0][at], self.motions[1][at]];
        let across = 2 * self.reach[0] + 1;
        let mut alike = 0;
        for row in row..row + 2 * self.reach[1] + 1 {
            let first = row * self.stride() + column;
            let [xs, ys] =
                [&self.motions[0][first..][..across], &self.motions[1][first..][..across]];
            for (x, y) in xs.iter().zip(ys) {
                let [x, y] = [(motion[0] - x) / tolerance[0], (motion[1] - y) / tolerance[1]];
                // A comparison with NaN is false.
                alike += u32::from(x * x + y * y <= 1.0);
            }
        }
        // Without the match itself.
        let alike = alike.saturating_sub(1);
        if alike < 2 { 0.0 } else { alike as f32 / around as f32 }
    }
}
