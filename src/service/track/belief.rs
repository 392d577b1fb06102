//! A discrete Bayes filter over where a robot is on the paths of a map, in which direction it moves, and how fast
//! (Thrun, Burgard and Fox, *Probabilistic Robotics*, 2005, chapter 4).
//!
//! A state is an image, a direction on its path, and one of [`SPEEDS`] [speeds](super::speeds). Every frame takes two
//! steps. *Predict*: each state moves along the path, and through links to other paths, as far as odometry says, or as
//! its speed and the time say; the speed changes a little; with a small probability the robot turns round, or is carried
//! anywhere. *Update*: each state is weighted by how well its image fits the frame
//! ([`Weights`](super::evidence::Weights)).
//!
//! States of the most likely images are stored; the rest of the probability is spread evenly over the map.

use super::evidence::Weights;
use super::grid::Grid;
use super::moves::{Motion, move_states};
use super::paths::{Paths, Stop};
use super::speeds::{SPEEDS, STATES, change_speeds, pace, state, turn_round};

/// Images less probable than this are not told apart.
const TRACE: f64 = 1e-6;

/// What the filter assumes about a robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Habits {
    /// The highest of the speeds, in metres per unit of time.
    pub max_speed: f64,
    /// Probability that the robot has turned round since the last frame.
    pub turn: f64,
    /// Probability that it was carried anywhere.
    pub jump: f64,
    /// Probability that it has left the map where no path ends.
    pub leave: f64,
    /// Probability that a robot off the map has come back.
    pub enter: f64,
}

/// A map as the filter sees it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Roads<'a> {
    pub grid: &'a Grid,
    pub paths: &'a Paths,
    /// How much each image of the belief differs from its neighbours, in units of the usual difference.
    pub changes: &'a [f32],
}

/// A probability distribution over the states of a map.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Belief {
    /// The images that are told apart.
    images: Vec<u32>,
    /// The probability of each of their states, in addition to its share of `elsewhere`.
    pub states: Vec<[f32; STATES]>,
    /// The probability that is spread evenly over the map.
    pub elsewhere: f64,
}

/// A belief while it is changed, with the place of each image of the map in it.
pub(super) struct Numbered {
    pub belief: Belief,
    /// The probability of having left the map.
    pub left: f64,
    /// One more than the place of each image, 0 for none: memory that is zero costs nothing where it is not touched, and
    /// most of a large map is not.
    at: Vec<u32>,
}

impl Numbered {
    fn new(belief: Belief, count: usize) -> Self {
        let mut at = vec![0; count];
        for (place, image) in (1..).zip(&belief.images) {
            at[*image as usize] = place;
        }
        Self { belief, left: 0.0, at }
    }

    /// Returns the place of an image, which is added if it is new.
    pub fn place(&mut self, image: u32) -> usize {
        let at = &mut self.at[image as usize];
        if *at == 0 {
            self.belief.images.push(image);
            self.belief.states.push([0.0; STATES]);
            *at = self.belief.images.len() as u32;
        }
        *at as usize - 1
    }
}

impl Belief {
    /// The uniform distribution, before the first frame.
    pub fn uniform() -> Self {
        Self { images: Vec::new(), states: Vec::new(), elsewhere: 1.0 }
    }

    /// Some images with the probabilities of their states; the rest is spread evenly over the map.
    pub fn with_rest(images: Vec<u32>, states: Vec<[f32; STATES]>) -> Self {
        let belief = Self { images, states, elsewhere: 0.0 };
        let known = belief.total();
        Self { elsewhere: (1.0 - known).max(0.0), ..belief }.normalised()
    }

    /// The images that are told apart.
    pub fn images(&self) -> &[u32] {
        &self.images
    }

    /// The prediction step: the belief after the robot has moved, if it is still on the map, and the probability that it
    /// has left it.
    pub fn predicted(&self, motion: Motion, habits: Habits, roads: Roads) -> (Self, f64) {
        let empty = Self { images: Vec::new(), states: Vec::new(), elsewhere: self.elsewhere };
        let mut moved = Numbered::new(empty, roads.grid.len());
        let mut ways = (Vec::new(), Vec::new());
        for (at, (image, states)) in self.images.iter().zip(&self.states).enumerate() {
            let change = roads.changes.get(at).copied().unwrap_or(0.0);
            for ahead in [true, false] {
                let speeds = &states[state(ahead, 0)..state(ahead, SPEEDS)];
                let from = (Stop { image: *image, ahead, metres: 0.0 }, change);
                move_states(from, speeds, (motion, habits), roads, &mut ways, &mut moved);
            }
        }
        let Numbered { mut belief, left, .. } = moved;
        for states in &mut belief.states {
            let is_free = matches!(motion, Motion::Elapsed { .. });
            change_speeds(&mut states[..SPEEDS], is_free);
            change_speeds(&mut states[SPEEDS..], is_free);
            turn_round(states, habits);
        }
        belief.elsewhere += habits.jump * (1.0 - belief.elsewhere);
        let left = left / (left + belief.total()).max(f64::MIN_POSITIVE);
        (belief.normalised(), left)
    }

    /// The same belief, but with a probability the robot is anywhere.
    pub fn or_anywhere(mut self, probability: f64) -> Self {
        for states in self.states.iter_mut().flatten() {
            *states = (f64::from(*states) * (1.0 - probability)) as f32;
        }
        self.elsewhere = self.elsewhere * (1.0 - probability) + probability;
        self
    }

    /// Half of this belief and half of another.
    pub fn mixed(self, other: &Self, count: usize) -> Self {
        let elsewhere = 0.5 * (self.elsewhere + other.elsewhere);
        let mut mixed = Numbered::new(self, count);
        mixed.belief.states.iter_mut().flatten().for_each(|probability| *probability *= 0.5);
        for (image, states) in other.images.iter().zip(&other.states) {
            let place = mixed.place(*image);
            let sums = mixed.belief.states[place].iter_mut().zip(states);
            sums.for_each(|(sum, probability)| *sum += 0.5 * probability);
        }
        Self { elsewhere, ..mixed.belief }
    }

    /// The update step: the belief after a frame. At most `max` images are kept.
    pub fn updated(&self, weights: &Weights, count: usize, max: usize) -> Self {
        let share = self.elsewhere / count.max(1) as f64;
        let mut belief = Numbered::new(self.clone(), count);
        let mut weight_of = vec![weights.rest(); belief.belief.images.len()];
        for (image, weight) in weights.known() {
            let place = belief.place(*image);
            weight_of.resize(belief.belief.images.len(), weights.rest());
            weight_of[place] = *weight;
        }
        let mut belief = belief.belief;
        for (weight, states) in weight_of.iter().zip(&mut belief.states) {
            for probability in states {
                *probability = ((f64::from(*probability) + share / STATES as f64) * weight) as f32;
            }
        }
        let rest = count.saturating_sub(belief.images.len()) as f64;
        belief.elsewhere = share * rest * weights.rest();
        belief.pruned(max)
    }

    /// The probability of each image that is told apart.
    pub fn masses(&self) -> Vec<(u32, f64)> {
        let sum = |states: &[f32; STATES]| states.iter().map(|p| f64::from(*p)).sum();
        self.images.iter().copied().zip(self.states.iter().map(sum)).collect()
    }

    /// The probability that is spread evenly over the map.
    pub fn elsewhere(&self) -> f64 {
        self.elsewhere
    }

    /// The probability that the robot is faster than a speed. Speeds are in units of the highest one; `image` is that of
    /// an image a frame.
    pub fn faster_than(&self, speed: f64, image: f64) -> f64 {
        let is_faster: [bool; STATES] = std::array::from_fn(|at| pace(at % SPEEDS, image) > speed);
        let states = self.states.iter().flat_map(|states| states.iter().zip(&is_faster));
        states.filter(|(_, faster)| **faster).map(|(probability, _)| f64::from(*probability)).sum()
    }

    /// The expected speed, in the same units.
    pub fn speed(&self, image: f64) -> f64 {
        let states = self.states.iter().flat_map(|states| states.iter().enumerate());
        states.map(|(at, probability)| f64::from(*probability) * pace(at % SPEEDS, image)).sum()
    }

    /// The same belief in a map whose images have other numbers. The probability of images that were deleted is spread
    /// over the map.
    pub fn renumbered(&self, number: &dyn Fn(u32) -> Option<u32>) -> Self {
        let kept = self.images.iter().zip(&self.states);
        let kept = kept.filter_map(|(image, states)| Some((number(*image)?, *states)));
        let (images, states): (Vec<_>, Vec<_>) = kept.unzip();
        Self::with_rest(images, states)
    }

    /// Keeps the `max` most likely images, moves the rest of the probability elsewhere, and normalises the sum.
    pub fn pruned(mut self, max: usize) -> Self {
        self = self.normalised().without_traces();
        if self.images.len() > max {
            let mut masses: Vec<(usize, f64)> =
                self.masses().into_iter().map(|(_, mass)| mass).enumerate().collect();
            masses.select_nth_unstable_by(max, |a, b| b.1.total_cmp(&a.1));
            self.elsewhere += masses[max..].iter().map(|(_, mass)| mass).sum::<f64>();
            let mut kept: Vec<usize> = masses[..max].iter().map(|(at, _)| *at).collect();
            kept.sort_unstable();
            self.images = kept.iter().map(|at| self.images[*at]).collect();
            self.states = kept.iter().map(|at| self.states[*at]).collect();
        }
        self.normalised()
    }

    /// Moves the probability of images that are hardly possible elsewhere.
    fn without_traces(mut self) -> Self {
        let masses = self.masses();
        let (mut at, mut elsewhere) = (0, 0.0);
        self.states.retain(|_| {
            at += 1;
            masses[at - 1].1 >= TRACE
        });
        self.images.clear();
        for (image, mass) in masses {
            if mass >= TRACE { self.images.push(image) } else { elsewhere += mass }
        }
        self.elsewhere += elsewhere;
        self
    }

    fn total(&self) -> f64 {
        self.elsewhere + self.masses().iter().map(|(_, mass)| mass).sum::<f64>()
    }

    fn normalised(mut self) -> Self {
        let total = self.total();
        if !total.is_normal() {
            return Self::uniform();
        }
        self.elsewhere /= total;
        for probability in self.states.iter_mut().flatten() {
            *probability = (f64::from(*probability) / total) as f32;
        }
        self
    }
}

#[cfg(test)]
mod tests;
