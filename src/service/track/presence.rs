//! Whether a robot is on the map at all.
//!
//! [`Belief`](super::belief::Belief) says where a robot is if it is on the map. This is the probability that it is:
//! a two-state filter, *on the map* and *off the map*. A robot leaves where a path ends, in a long gap between two
//! images, and, with a small probability, anywhere; off the map, it may come back anywhere.
//!
//! What a frame says about it is a likelihood ratio. Off the map, the standardised similarity z of the image where the
//! robot is expected is that of any image, a standard normal variable. On the map, it is higher, by how much depends on
//! light, camera and descriptor: with a *clarity* κ, it is normal with mean κ and standard deviation [`SPREAD`].
//! κ is the same for all frames of a drive and unknown, so the filter keeps the probability of each of a few values.
//! For the image j with the probability p(j) before the frame, the ratio is
//!
//! > L(κ) = Σ p(j) (ω + (1 − ω) f(z(j); κ) / f₀(z(j)))
//!
//! ω is the share of frames without information; f₀ has wider tails than a normal variable, because some places look
//! alike. The most that one frame may count is what the calibration of the map
//! allows: of frames off the map, a share of at most 1 − c reaches the confidence c of the frame alone, so that evidence
//! for the map is worth at most 1 / (1 − c); without a calibration, [`MOST_EVIDENCE`].
//!
//! Off the map, frames resemble each other, in light and in kind of place, and so all of them resemble the same image.
//! Only what sets a frame apart from the one before is therefore evidence of the map.

/// The values of clarity that are told apart.
pub(super) const CLARITIES: [f64; 4] = [1.5, 2.5, 3.5, 4.5];

/// Number of values of clarity.
pub(super) const LEVELS: usize = CLARITIES.len();

/// Standard deviation of the similarity of the right image, in units of that of all images.
const SPREAD: f64 = 1.5;

/// The share of images that look like another place, and the standard deviation of the similarity of those.
const ALIKE: f64 = 0.02;
const ALIKE_SPREAD: f64 = 2.5;

/// The most that one frame may count as evidence of the map, in maps without a calibration.
const MOST_EVIDENCE: f64 = 20.0;

/// Probability that a robot is not on the map at its first frame.
pub(super) const OFF_AT_FIRST: f64 = 0.2;

/// Probability that the clarity has changed since the last frame, for example at the end of a tunnel.
const CLARITY_CHANGE: f64 = 0.02;

/// Neither state becomes less likely than this: no filter is that certain.
const LEAST: f64 = 1e-9;

/// Ratios of the likelihood of a frame on the map, for each clarity, to that off the map.
pub(super) type Ratios = [f64; LEVELS];

/// How much more likely a similarity is at the right image than at any, for each clarity. `z` is the similarity in
/// standard deviations above the mean of all images.
pub(super) fn ratios(z: f64) -> Ratios {
    // An image that is less similar than most is not the right one, however much less.
    let z = z.max(0.0);
    let normal = |deviation: f64| (-0.5 * (z / deviation).powi(2)).exp() / deviation;
    let any = (1.0 - ALIKE) * normal(1.0) + ALIKE * normal(ALIKE_SPREAD);
    CLARITIES.map(|clarity| {
        // Nor is one that is more similar than expected the wrong one.
        let deviation = if z > clarity { 2.0 * SPREAD } else { SPREAD };
        let off = (z - clarity) / deviation;
        (-0.5 * off * off).exp() / SPREAD / any
    })
}

/// The most that a frame may count as evidence of the map. `confidence` is that of the frame alone, calibrated on the
/// map; `None` if the map has no calibration.
pub(super) fn most_evidence(confidence: Option<f32>) -> f64 {
    confidence.map_or(MOST_EVIDENCE, |confidence| 1.0 / (1.0 - f64::from(confidence)).max(1e-3))
}

/// The probabilities that a robot is on and off the map, with each clarity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Presence {
    pub on: [f64; LEVELS],
    pub off: [f64; LEVELS],
}

impl Presence {
    /// Before the first frame.
    pub fn new() -> Self {
        let level = 1.0 / LEVELS as f64;
        Self { on: [(1.0 - OFF_AT_FIRST) * level; LEVELS], off: [OFF_AT_FIRST * level; LEVELS] }
    }

    /// The probability that the robot is on the map.
    pub fn on_map(&self) -> f64 {
        self.on.iter().sum::<f64>().clamp(0.0, 1.0)
    }

    /// The prediction step. `leaves` and `enters` are the probabilities that the robot has left the map and has come
    /// back since the last frame. Returns the presence then, and the share of robots on the map that have just come
    /// back.
    pub fn predicted(&self, leaves: f64, enters: f64) -> (Self, f64) {
        let (mut next, mut back) = (*self, 0.0);
        for (on, off) in next.on.iter_mut().zip(&mut next.off) {
            let (left, entered) = (leaves * *on, enters * *off);
            back += entered;
            (*on, *off) = (*on - left + entered, *off - entered + left);
        }
        for state in [&mut next.on, &mut next.off] {
            let mean = state.iter().sum::<f64>() / LEVELS as f64;
            state.iter_mut().for_each(|level| *level += CLARITY_CHANGE * (mean - *level));
        }
        let next = next.normalised();
        (next, (back / next.on_map().max(LEAST)).min(1.0))
    }

    /// The update step, with the likelihood ratios of a frame. As evidence of the map it counts at most `most`, and only
    /// the share `unlike` of it, by which it differs from the frame before.
    pub fn updated(&self, ratios: &Ratios, most: f64, unlike: f64) -> Self {
        let mut next = *self;
        next.on.iter_mut().zip(ratios).for_each(|(on, ratio)| *on *= ratio);
        let ratio = next.on.iter().sum::<f64>() / self.on.iter().sum::<f64>().max(LEAST);
        if ratio > 1.0 {
            let counted = ratio.min(most).powf(unlike);
            next.on.iter_mut().for_each(|on| *on *= counted / ratio);
        }
        next.normalised()
    }

    /// Half of this and half of another.
    pub fn mixed(mut self, other: &Self) -> Self {
        for (state, other) in [(&mut self.on, &other.on), (&mut self.off, &other.off)] {
            state.iter_mut().zip(other).for_each(|(one, other)| *one = 0.5 * (*one + other));
        }
        self
    }

    /// The same with the sum 1.
    pub fn normalised(mut self) -> Self {
        let levels = || 0..LEVELS;
        let total: f64 = levels().map(|at| self.on[at] + self.off[at]).sum();
        if !total.is_normal() {
            return Self::new();
        }
        for at in levels() {
            self.on[at] = (self.on[at] / total).max(LEAST);
            self.off[at] = (self.off[at] / total).max(LEAST);
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OUTLIERS: f64 = 0.2;

    /// The presence after frames whose expected image has these similarities.
    fn after(presence: Presence, similarities: &[f64]) -> Presence {
        similarities.iter().fold(presence, |presence, z| {
            let ratios = ratios(*z).map(|ratio| OUTLIERS + (1.0 - OUTLIERS) * ratio);
            presence.predicted(0.005, 0.02).0.updated(&ratios, 50.0, 1.0)
        })
    }

    #[test]
    fn a_robot_that_sees_what_it_expects_is_on_the_map() {
        for clarity in CLARITIES {
            let on = after(Presence::new(), &[clarity; 10]).on_map();
            assert!(on > 0.95, "{clarity}: {on}");
        }
    }

    #[test]
    fn a_robot_that_no_longer_sees_what_it_expects_is_off_the_map_after_a_few_frames() {
        let clear = after(Presence::new(), &[4.0; 10]);
        assert!(after(clear, &[0.0]).on_map() > 0.9);
        assert!(after(clear, &[0.0; 3]).on_map() < 0.8);
        assert!(after(clear, &[0.0; 8]).on_map() < 0.05);
    }

    #[test]
    fn a_robot_that_comes_back_is_on_the_map_again() {
        let away = after(after(Presence::new(), &[4.0; 10]), &[0.0; 100]);
        assert!(after(away, &[4.0; 3]).on_map() > 0.9);
    }

    #[test]
    fn a_frame_that_says_nothing_changes_nothing_but_what_motion_does() {
        let presence = after(Presence::new(), &[3.0; 4]);
        let next = presence.updated(&[1.0; LEVELS], 20.0, 1.0);
        assert!((next.on_map() - presence.on_map()).abs() < 1e-9);
        let (left, _) = presence.predicted(0.7, 0.0);
        assert!((left.on_map() - 0.3 * presence.on_map()).abs() < 1e-6);
        let (same, back) = presence.predicted(0.0, 0.0);
        assert_eq!(back, 0.0);
        assert!((same.on_map() - presence.on_map()).abs() < 1e-6);
    }

    #[test]
    fn a_frame_counts_at_most_as_much_as_its_confidence_allows() {
        assert!((most_evidence(Some(0.0)) - 1.0).abs() < 1e-9);
        assert!((most_evidence(Some(0.9)) - 10.0).abs() < 1e-4);
        assert_eq!(most_evidence(None), MOST_EVIDENCE);
        let odds = |presence: Presence| presence.on_map() / (1.0 - presence.on_map());
        let before = Presence::new();
        assert!((odds(before.updated(&ratios(30.0), 7.0, 1.0)) / odds(before) - 7.0).abs() < 1e-3);
        assert!(ratios(-30.0).into_iter().all(|ratio| ratio < 1.0));
    }
}
