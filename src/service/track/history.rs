//! The way of a robot: its last places, smoothed with the frames that came after each.
//!
//! A filter knows only the frames so far. The *smoothed* probability of a state x of frame t also depends on those after
//! it (Rauch, Tung and Striebel's recursion for a discrete state; Särkkä, *Bayesian Filtering and Smoothing*, 2013,
//! chapter 8):
//!
//! > s(t, x) = f(t, x) Σ T(x, y) s(t + 1, y) / p(t + 1, y), with p(t + 1, y) = Σ f(t, x) T(x, y)
//!
//! f is what the filter said, of which the most likely images are kept, *elsewhere* on the map, and *off the map*. The
//! transition T follows from how far the robot moved, by odometry or by the speed that the filter believes, as the crow
//! flies: exact paths would need the directions and speeds of all states, a hundred times the memory.

use std::collections::VecDeque;

use jiff::Timestamp;

use super::belief::Habits;
use super::ground::Ground;
use super::posterior::Posterior;

/// Number of images that are kept of each frame.
const KEPT: usize = 24;

/// The error of a move in units of the usual distance of neighbours, in addition to what the robot states.
const MOVE_ERROR: f64 = 1.0;

/// The same as a share of the move, if the speed is a guess.
const SPEED_ERROR: f64 = 0.5;

/// By what share of a move the distance as the crow flies may be shorter.
const BENDS: f64 = 0.3;

/// Standard deviation of the kernel by which an image's neighbours support it, in units of the usual distance.
const SUPPORT: f64 = 0.7;

/// What the filter said after one frame.
#[derive(Debug, Clone)]
pub(super) struct Passed {
    /// When the frame was taken, if the robot said so, and when it arrived.
    pub captured_at: Option<Timestamp>,
    pub received_at: Timestamp,
    /// The most likely images.
    pub images: Vec<(u32, f32)>,
    pub elsewhere: f64,
    pub off_map: f64,
    /// How far the robot had moved since the frame before; `None` if that is not known.
    pub moved: Option<Move>,
}

/// How far a robot has moved, in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Move {
    pub metres: f64,
    /// Standard deviation of that.
    pub error: f64,
}

impl Move {
    /// A move at a speed that is only believed.
    pub fn guessed(metres: f64) -> Self {
        Self { metres, error: SPEED_ERROR * metres }
    }
}

/// Where a robot was at a frame, given those before and after it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Smoothed {
    /// The most likely image; `None` if none is likely.
    pub image: Option<u32>,
    /// The probability that the robot was within the given radius of it.
    pub probability: f64,
    pub off_map: f64,
}

impl Passed {
    /// What is left of a posterior.
    pub fn new(
        (captured_at, received_at): (Option<Timestamp>, Timestamp),
        Posterior { belief, presence }: &Posterior,
        moved: Option<Move>,
    ) -> Self {
        let on_map = presence.on_map();
        let mut masses = belief.masses();
        masses.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        masses.truncate(KEPT);
        let images: Vec<(u32, f32)> =
            masses.into_iter().map(|(image, mass)| (image, (on_map * mass) as f32)).collect();
        let known: f64 = images.iter().map(|(_, mass)| f64::from(*mass)).sum();
        let elsewhere = (on_map - known).max(0.0);
        Self { captured_at, received_at, images, elsewhere, off_map: 1.0 - on_map, moved }
    }

    /// The same in a map whose images have other numbers.
    pub fn renumber(&mut self, number: &dyn Fn(u32) -> Option<u32>) {
        let before: f32 = self.images.iter().map(|(_, mass)| mass).sum();
        self.images.retain_mut(|(image, _)| match number(*image) {
            Some(now) => {
                *image = now;
                true
            }
            None => false,
        });
        let after: f32 = self.images.iter().map(|(_, mass)| mass).sum();
        self.elsewhere += f64::from(before - after);
    }

    fn state(&self) -> State {
        let images = self.images.iter().map(|(_, mass)| f64::from(*mass)).collect();
        State { images, elsewhere: self.elsewhere, off_map: self.off_map }
    }
}

/// Probabilities of the images of a frame, in their order, and of the rest.
struct State {
    images: Vec<f64>,
    elsewhere: f64,
    off_map: f64,
}

/// How a robot moves between two frames.
struct Transition<'a> {
    ground: &'a Ground,
    moved: Option<Move>,
    habits: Habits,
}

impl Transition<'_> {
    fn between(&self, from: u32, to: u32) -> f64 {
        let count = self.ground.len().max(1) as f64;
        let spacing = self.ground.paths.spacing();
        let Some(Move { metres, error }) = self.moved else { return 1.0 / count };
        let distance = self.ground.grid.distance(from, to);
        let error = error.hypot(MOVE_ERROR * spacing);
        let slack = if distance < metres { BENDS * metres } else { 0.0 };
        let off = (distance - metres) / (error + slack);
        // Images at this distance, on both sides.
        let others = (5.0 * error / spacing).max(1.0);
        ((-0.5 * off * off).exp() / others).max(self.habits.jump / count)
    }

    /// The smoothed state of a frame, given that of the next.
    fn smooth(&self, one: &Passed, next: &Passed, after: &State) -> State {
        let count = self.ground.len().max(1) as f64;
        let Habits { leave, enter, jump, .. } = self.habits;
        let filtered = one.state();
        let mut smoothed =
            State { images: vec![0.0; one.images.len()], elsewhere: 0.0, off_map: 0.0 };
        let mut ways = vec![0.0; one.images.len()];
        for ((to, _), goal) in next.images.iter().zip(&after.images) {
            let elsewhere = filtered.elsewhere / count;
            let off_map = filtered.off_map * enter / count;
            for ((way, (from, _)), mass) in ways.iter_mut().zip(&one.images).zip(&filtered.images) {
                *way = mass * self.between(*from, *to);
            }
            let total = ways.iter().sum::<f64>() + elsewhere + off_map;
            let scale = goal / total.max(f64::MIN_POSITIVE);
            smoothed.images.iter_mut().zip(&ways).for_each(|(sum, way)| *sum += scale * way);
            smoothed.elsewhere += scale * elsewhere;
            smoothed.off_map += scale * off_map;
        }
        for (goal, [image, elsewhere, off_map]) in
            [(after.elsewhere, [jump, 1.0, enter]), (after.off_map, [leave, leave, 1.0 - enter])]
        {
            let known: f64 = filtered.images.iter().sum();
            let total = known * image + filtered.elsewhere * elsewhere + filtered.off_map * off_map;
            let scale = goal / total.max(f64::MIN_POSITIVE);
            let images = smoothed.images.iter_mut().zip(&filtered.images);
            images.for_each(|(sum, mass)| *sum += scale * image * mass);
            smoothed.elsewhere += scale * elsewhere * filtered.elsewhere;
            smoothed.off_map += scale * off_map * filtered.off_map;
        }
        smoothed
    }
}

/// The places of the frames of a track, smoothed; `radius` is that of a place, in metres.
pub(super) fn smoothed(
    passed: &VecDeque<Passed>,
    ground: &Ground,
    radius: f64,
    habits: Habits,
) -> Vec<Smoothed> {
    let mut places = Vec::with_capacity(passed.len());
    let mut after: Option<(&Passed, State)> = None;
    for one in passed.iter().rev() {
        let state = match &after {
            None => one.state(),
            Some((next, state)) => {
                Transition { ground, moved: next.moved, habits }.smooth(one, next, state)
            }
        };
        places.push(place(one, &state, ground, radius));
        after = Some((one, state));
    }
    places.reverse();
    places
}

/// The place of a frame that the filter named at the time, if it was known from `known_from`, and the smoothed place
/// otherwise; and whether it is known. What was known stays: a smoother that goes as the crow flies is no better than a
/// filter that follows paths. Where the two differ, nothing is known.
pub(super) fn settled(
    one: &Passed,
    smoothed: Smoothed,
    (ground, radius): (&Ground, f64),
    known_from: f64,
) -> (Smoothed, bool) {
    let filtered = place(one, &one.state(), ground, radius);
    if filtered.probability >= known_from {
        return (filtered, true);
    }
    let agree = filtered.image.zip(smoothed.image);
    let agree = agree.is_some_and(|(one, other)| ground.grid.distance(one, other) <= radius);
    (smoothed, agree && smoothed.probability >= known_from)
}

/// The most likely place of a frame.
fn place(one: &Passed, state: &State, ground: &Ground, radius: f64) -> Smoothed {
    let spacing = ground.paths.spacing();
    let images = || one.images.iter().map(|(image, _)| *image).zip(state.images.iter().copied());
    let support = |image: u32| -> f64 {
        let near = images().map(|(other, mass)| {
            let off = ground.grid.distance(image, other) / (SUPPORT * spacing);
            mass * (-0.5 * off * off).exp()
        });
        near.sum()
    };
    let best = images().map(|(image, _)| (image, support(image)));
    let best = best.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(image, _)| image);
    let probability = |best: u32| -> f64 {
        let near = images().filter(|(image, _)| ground.grid.distance(best, *image) <= radius);
        near.map(|(_, mass)| mass).sum()
    };
    Smoothed {
        image: best,
        probability: best.map_or(0.0, probability).clamp(0.0, 1.0),
        off_map: state.off_map.clamp(0.0, 1.0),
    }
}

#[cfg(test)]
mod tests;
