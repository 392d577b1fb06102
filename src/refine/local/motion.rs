//! The motion that explains most of the agreeing matches. It is for the description and not for the
//! ranking, because parallax makes any single motion an approximation.
//!
//! Deterministic: the most distinctive matches each propose a shift at a few scales, the proposal with the
//! most support wins, and iteratively re-weighted least squares with Tukey's biweight (Holland & Welsch,
//! 1977) then fits an affine motion.

use super::Match;
use whereabouts_core::dense::DenseFeatures;

/// The number of matches that propose a shift.
const PROPOSERS: usize = 12;

/// The scales that each proposal is tried at, from half to double.
const SCALES: [f32; 9] = [0.5, 0.6, 0.71, 0.84, 1.0, 1.19, 1.41, 1.68, 2.0];

/// The regularisation of the fit towards the scale of the winning proposal, as a share of the evidence that
/// matches spread over the whole picture would give.
const REGULARISATION: f32 = 0.01;

/// The variance of a coordinate that is spread evenly over the picture.
const EVEN_SPREAD: f32 = 1.0 / 12.0;

/// An affine motion from the query to the candidate, both in fractions of the picture's edges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// `[[a, b, c], [d, e, f]]`: `(x, y)` of the query lies at `(a·x + b·y + c, d·x + e·y + f)` of
    /// the candidate.
    pub matrix: [[f32; 3]; 2],
    /// Width over height of the grid of cells, which tells a rotation from a shear.
    pub aspect: f32,
    /// The number of matches within tolerance of the motion.
    pub support: usize,
}

impl Motion {
    /// The identity.
    fn still(aspect: f32) -> Self {
        Self { matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], aspect, support: 0 }
    }

    /// Scales about the picture's centre, and then shifts by `shift`.
    fn scaled(scale: f32, shift: [f32; 2], aspect: f32) -> Self {
        let [x, y] = shift.map(|s| s + 0.5 * (1.0 - scale));
        Self { matrix: [[scale, 0.0, x], [0.0, scale, y]], aspect, support: 0 }
    }

    /// Maps a point of the query to the candidate.
    pub fn apply(&self, point: [f32; 2]) -> [f32; 2] {
        // Written out, because this runs once for each match and proposal.
        let [[a, b, c], [d, e, f]] = self.matrix;
        let [x, y] = point;
        [a * x + b * y + c, d * x + e * y + f]
    }

    /// Returns how far the picture's centre moved, as `[x, y]` in fractions of the edges; positive is right
    /// and down.
    pub fn shift(&self) -> [f32; 2] {
        self.apply([0.5, 0.5]).map(|x| x - 0.5)
    }

    /// Returns how many times larger things are in the candidate, along an edge: the square root of the
    /// change of area.
    pub fn scale(&self) -> f32 {
        self.determinant().max(0.0).sqrt()
    }

    /// Returns how far things turned, in degrees, clockwise positive: the rotation nearest to the linear
    /// part, with both axes in the same unit.
    pub fn rotation(&self) -> f32 {
        let [[a, b, _], [d, e, _]] = self.matrix;
        (d / self.aspect - b * self.aspect).atan2(a + e).to_degrees()
    }

    fn determinant(&self) -> f32 {
        let [[a, b, _], [d, e, _]] = self.matrix;
        a * e - b * d
    }

    /// Returns whether a moving camera could have caused it: not mirrored, and within a factor of 2.5 in size.
    fn is_plausible(&self) -> bool {
        (0.16..=6.25).contains(&self.determinant()) && self.matrix[0][0] > 0.0
    }

    /// Returns how well it explains a match: 1 for an exact fit, 0 from `tolerance` on.
    fn explains(&self, found: &Match, tolerance: [f32; 2]) -> f32 {
        let at = self.apply(found.query);
        let x = (at[0] - found.candidate[0]) / tolerance[0];
        let y = (at[1] - found.candidate[1]) / tolerance[1];
        let inside = (1.0 - x * x - y * y).max(0.0);
        inside * inside
    }
}

/// Fits a motion to `matches`, most distinctive first, each with its weight.
pub(super) fn fit(
    matches: &[Match],
    weights: &[f32],
    tolerance: [f32; 2],
    query: &DenseFeatures,
    rounds: usize,
) -> Motion {
    let aspect = query.width() as f32 / query.height() as f32;
    let mut motion = propose(matches, weights, tolerance, aspect);
    for _ in 0..rounds {
        match improve(&motion, matches, weights, tolerance) {
            Some(better) if better.is_plausible() => motion = better,
            _ => break,
        }
    }
    motion.support = matches.iter().filter(|m| motion.explains(m, tolerance) > 0.0).count();
    motion
}

fn propose(matches: &[Match], weights: &[f32], tolerance: [f32; 2], aspect: f32) -> Motion {
    let all = Located::new(matches, weights, tolerance);
    let mut best = (0.0, Motion::still(aspect));
    for proposer in matches.iter().take(PROPOSERS) {
        for scale in SCALES {
            let shift = [0, 1]
                .map(|axis| proposer.candidate[axis] - 0.5 - scale * (proposer.query[axis] - 0.5));
            let motion = Motion::scaled(scale, shift, aspect);
            let support = all.support(&motion, tolerance);
            if support > best.0 {
                best = (support, motion);
            }
        }
    }
    best.1
}

/// Matches with each coordinate in a row of its own and in units of the tolerance, so that many are tested at a time.
struct Located {
    /// By axis; padded to whole lanes.
    query: [Vec<f32>; 2],
    candidate: [Vec<f32>; 2],
    /// 0 for those that only pad.
    weights: Vec<f32>,
}

/// Matches that are tested at a time.
const LANES: usize = 8;

impl Located {
    fn new(matches: &[Match], weights: &[f32], tolerance: [f32; 2]) -> Self {
        let padded = matches.len().next_multiple_of(LANES);
        let row = |of: &dyn Fn(&Match) -> [f32; 2], axis: usize| -> Vec<f32> {
            let mut row: Vec<f32> = matches.iter().map(|m| of(m)[axis] / tolerance[axis]).collect();
            row.resize(padded, 0.0);
            row
        };
        let mut weights = weights.to_vec();
        weights.resize(padded, 0.0);
        Self {
            query: [0, 1].map(|axis| row(&|found| found.query, axis)),
            candidate: [0, 1].map(|axis| row(&|found| found.candidate, axis)),
            weights,
        }
    }

    /// The weights of the matches, each as far as a motion explains it, which scales and shifts.
    fn support(&self, motion: &Motion, tolerance: [f32; 2]) -> f32 {
        let [[scale, _, x], [_, _, y]] = motion.matrix;
        let shift = [x / tolerance[0], y / tolerance[1]];
        let [query_x, query_y] = [0, 1].map(|axis| self.query[axis].as_chunks::<LANES>().0);
        let [candidate_x, candidate_y] =
            [0, 1].map(|axis| self.candidate[axis].as_chunks::<LANES>().0);
        let rows = query_x.iter().zip(query_y).zip(candidate_x.iter().zip(candidate_y));
        let mut sums = [0.0; LANES];
        for (((qx, qy), (cx, cy)), weights) in rows.zip(self.weights.as_chunks::<LANES>().0) {
            for lane in 0..LANES {
                let x = scale * qx[lane] + shift[0] - cx[lane];
                let y = scale * qy[lane] + shift[1] - cy[lane];
                let inside = (1.0 - x * x - y * y).max(0.0);
                sums[lane] += weights[lane] * inside * inside;
            }
        }
        sums.iter().sum()
    }
}

/// Corrects `motion` by one round of weighted least squares. Coordinates are relative to the picture's
/// centre, so that scale and shift hardly depend on each other.
fn improve(
    motion: &Motion,
    matches: &[Match],
    weights: &[f32],
    tolerance: [f32; 2],
) -> Option<Motion> {
    let mut normal = [[0.0f32; 3]; 3];
    let mut right = [[0.0f32; 2]; 3];
    for (found, weight) in matches.iter().zip(weights) {
        let weight = weight * motion.explains(found, tolerance);
        let at = motion.apply(found.query);
        let error = [found.candidate[0] - at[0], found.candidate[1] - at[1]];
        let basis = [found.query[0] - 0.5, found.query[1] - 0.5, 1.0];
        for i in 0..3 {
            for j in 0..3 {
                normal[i][j] += weight * basis[i] * basis[j];
            }
            for axis in 0..2 {
                right[i][axis] += weight * basis[i] * error[axis];
            }
        }
    }
    let regularisation = REGULARISATION * EVEN_SPREAD * normal[2][2];
    normal[0][0] += regularisation;
    normal[1][1] += regularisation;
    let inverse = inverse(normal)?;

    let mut better = *motion;
    for (axis, row) in better.matrix.iter_mut().enumerate() {
        let [da, db, dc] =
            inverse.map(|line| line.iter().zip(&right).map(|(i, r)| i * r[axis]).sum::<f32>());
        *row = [row[0] + da, row[1] + db, row[2] + dc - 0.5 * (da + db)];
    }
    Some(better)
}

/// Inverts a symmetric 3×3 matrix by its cofactors; `None` if it is singular.
fn inverse(m: [[f32; 3]; 3]) -> Option<[[f32; 3]; 3]> {
    let cofactor = |i: usize, j: usize| {
        let [r0, r1] = [(i + 1) % 3, (i + 2) % 3];
        let [c0, c1] = [(j + 1) % 3, (j + 2) % 3];
        m[r0][c0] * m[r1][c1] - m[r0][c1] * m[r1][c0]
    };
    let determinant: f32 = (0..3).map(|j| m[0][j] * cofactor(0, j)).sum();
    (determinant > f32::MIN_POSITIVE)
        .then(|| [0, 1, 2].map(|i| [0, 1, 2].map(|j| cofactor(j, i) / determinant)))
}
