//! What the filter believes: whether a robot is on the map, and where it is if so.

use super::belief::{Belief, Habits, Roads};
use super::evidence::Weights;
use super::ground::Ground;
use super::history::Move;
use super::moves::Motion;
use super::presence::{LEVELS, Presence, most_evidence};

/// Fewest located images of a map in which a place can be known: with fewer, nothing says how alike images of different
/// places are. A single frame needs as many.
pub(super) const MIN_IMAGES: usize = 9;

/// Novelty of a frame from which on its robot has moved in full.
const MOVED: f64 = 0.5;

/// Where a robot is, and whether it is on the map.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Posterior {
    /// Where it is if it is on the map.
    pub belief: Belief,
    pub presence: Presence,
}

/// What a frame says.
#[derive(Debug)]
pub(super) struct FrameWeights {
    pub weights: Weights,
    /// The share of it that is new.
    pub fresh: f64,
    /// The share by which it differs from the frame before, both without what they have in common with others.
    pub unlike: f64,
    /// The confidence of the frame alone; `None` if the map has no calibration.
    pub confidence: Option<f32>,
}

impl Posterior {
    /// Before the first frame.
    pub fn new() -> Self {
        Self { belief: Belief::uniform(), presence: Presence::new() }
    }

    /// The prediction step.
    pub fn predicted(&self, motion: Motion, habits: Habits, roads: Roads) -> Self {
        let (belief, left) = self.belief.predicted(motion, habits, roads);
        let moved = share_moved(motion, roads.paths.spacing());
        let leaves = left + (1.0 - left) * habits.leave * moved;
        let (presence, back) = self.presence.predicted(leaves, habits.enter * moved);
        Self { belief: belief.or_anywhere(back), presence }
    }

    /// The update step. At most `max` images are kept.
    pub fn updated(&self, frame: &FrameWeights, count: usize, max: usize) -> Self {
        let belief = self.belief.updated(&frame.weights, count, max);
        let ratios = match count >= MIN_IMAGES {
            true => frame.weights.presence(&self.belief, count),
            false => [1.0; LEVELS],
        };
        let ratios = ratios.map(|ratio| ratio.powf(frame.fresh));
        let most = most_evidence(frame.confidence);
        let presence = self.presence.updated(&ratios, most, frame.unlike);
        Self { belief, presence }
    }

    /// How far the robot has moved.
    pub fn moved(&self, motion: Motion, max_speed: f64, ground: &Ground) -> Move {
        match motion {
            Motion::Measured { metres, error, .. } => Move { metres, error },
            Motion::Elapsed { time, .. } => {
                let image = ground.paths.spacing() / max_speed;
                Move::guessed(self.belief.speed(image) * max_speed * time)
            }
        }
    }

    /// Half of this and half of another.
    pub fn mixed(self, other: &Self, count: usize) -> Self {
        let presence = self.presence.mixed(&other.presence);
        Self { belief: self.belief.mixed(&other.belief, count), presence }
    }

    /// The same in a map whose images have other numbers.
    pub fn renumbered(&self, number: &dyn Fn(u32) -> Option<u32>) -> Self {
        Self { belief: self.belief.renumbered(number), presence: self.presence }
    }
}

/// How far a robot may have moved, in units of the usual distance of neighbours and at most 1: one that stands still
/// neither leaves the map nor comes back, however many frames it sends.
fn share_moved(motion: Motion, spacing: f64) -> f64 {
    match motion {
        Motion::Measured { metres, .. } => (metres / spacing).min(1.0),
        Motion::Elapsed { time, .. } if time <= 0.0 => 0.0,
        Motion::Elapsed { novelty: Some(novelty), .. } => (novelty / MOVED).min(1.0),
        Motion::Elapsed { novelty: None, .. } => 1.0,
    }
}
