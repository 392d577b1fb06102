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
    /// Row-major; candidate position minus query position, in fractions of the picture.
    motions: Vec<Option<[f32; 2]>>,
}

impl MotionField {
    fn new(query: &DenseFeatures, pairs: &[CellPair], located: &[Match], radius: f32) -> Self {
        let mut motions = vec![None; query.len()];
        for (pair, found) in pairs.iter().zip(located) {
            motions[pair.query] = Some(displacement(found));
        }
        let reach = |cells: usize| ((radius * cells as f32).round() as usize).clamp(1, cells);
        Self {
            width: query.width(),
            height: query.height(),
            reach: [reach(query.width()), reach(query.height())],
            motions,
        }
    }

    /// Returns the share of the cells around `cell` that moved as it did, 0 to 1. A single such cell may be
    /// chance and counts as none.
    fn support(&self, cell: usize, tolerance: [f32; 2]) -> f32 {
        let Some(motion) = self.motions[cell] else { return 0.0 };
        let (row, column) = (cell / self.width, cell % self.width);
        let rows = row.saturating_sub(self.reach[1])..(row + self.reach[1] + 1).min(self.height);
        let columns =
            column.saturating_sub(self.reach[0])..(column + self.reach[0] + 1).min(self.width);
        let around = rows.len() * columns.len() - 1;
        let alike = rows
            .flat_map(|row| &self.motions[row * self.width..][columns.clone()])
            .flatten()
            .filter(|other| within(motion, **other, tolerance))
            .count()
            - 1;
        if alike < 2 { 0.0 } else { alike as f32 / around as f32 }
    }
}

fn displacement(found: &Match) -> [f32; 2] {
    [found.candidate[0] - found.query[0], found.candidate[1] - found.query[1]]
}

fn within(a: [f32; 2], b: [f32; 2], tolerance: [f32; 2]) -> bool {
    let [x, y] = [(a[0] - b[0]) / tolerance[0], (a[1] - b[1]) / tolerance[1]];
    x * x + y * y <= 1.0
}
