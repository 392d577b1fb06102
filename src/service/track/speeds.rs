//! The states of one image: a direction and a speed.

use super::belief::Habits;
use super::moves::NEGLIGIBLE;

/// Number of speeds in metres per second that are told apart, the first of which is standing still.
pub(super) const METRIC: usize = 18;

/// Number of speeds in images per frame: 1, 2, … Frames are often taken just as the images of the map were, at every
/// so many metres or at the same stops, and then the number of images is more exact than clocks and wheels.
pub(super) const STEPS: usize = 3;

/// Number of speeds.
pub(super) const SPEEDS: usize = METRIC + STEPS;

/// Ratio of each speed to the next lower one.
const RATIO: f64 = 1.25;

/// States of one image: two directions, ahead first, with each speed.
pub(super) const STATES: usize = 2 * SPEEDS;

/// Probability that a robot without odometry accelerates, and that it brakes, to the next speed, at a frame.
const SPEED_STEP: f64 = 0.05;

/// Probability that the speed of a robot without odometry changes to any other, at a frame.
const SPEED_JUMP: f64 = 0.02;

/// The place of a state among those of its image.
pub(super) fn state(ahead: bool, speed: usize) -> usize {
    (if ahead { 0 } else { SPEEDS }) + speed
}

/// A metric speed in units of the highest one; 0 for the others.
pub(super) fn speed_of(number: usize) -> f64 {
    let is_moving = (1..METRIC).contains(&number);
    if is_moving { RATIO.powi(number as i32 + 1 - METRIC as i32) } else { 0.0 }
}

/// A speed in units of the highest one, of which that of an image a frame is `image`.
pub(super) fn pace(number: usize, image: f64) -> f64 {
    if number < METRIC { speed_of(number) } else { (number - METRIC + 1) as f64 * image }
}

/// The speed nearest to one that is given in units of the highest one.
pub(super) fn nearest_speed(share: f64) -> usize {
    let off = |number: &usize| (speed_of(*number) - share).abs();
    (0..METRIC).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(0)
}

/// Lets the speed change a little; a metric speed only if it `is_free`, and not measured.
pub(super) fn change_speeds(speeds: &mut [f32], is_free: bool) {
    let total: f32 = speeds.iter().sum();
    if total <= NEGLIGIBLE {
        return;
    }
    let before: [f32; SPEEDS] = std::array::from_fn(|number| speeds[number]);
    let (step, any) = (SPEED_STEP as f32, SPEED_JUMP as f32);
    if !is_free {
        let metric: f32 = before[..METRIC].iter().sum();
        let steps = total - metric;
        for (number, speed) in speeds.iter_mut().enumerate() {
            *speed = match number {
                0..METRIC if metric > 0.0 => {
                    before[number] * (1.0 + any * (steps - metric) / metric)
                }
                0..METRIC => any * steps / METRIC as f32,
                _ => (1.0 - any) * before[number] + any * metric / STEPS as f32,
            };
        }
        return;
    }
    for (number, speed) in speeds.iter_mut().enumerate() {
        let range = if number < METRIC { 0..METRIC } else { METRIC..SPEEDS };
        let lower = before[number.saturating_sub(1).max(range.start)];
        let higher = before[(number + 1).min(range.end - 1)];
        *speed = (1.0 - 2.0 * step - any) * before[number]
            + step * (lower + higher)
            + any * total / SPEEDS as f32;
    }
}

/// Lets the robot turn round.
pub(super) fn turn_round(states: &mut [f32; STATES], habits: Habits) {
    let turn = habits.turn as f32;
    let (ahead, back) = states.split_at_mut(SPEEDS);
    for (ahead, back) in ahead.iter_mut().zip(back) {
        (*ahead, *back) =
            ((1.0 - turn) * *ahead + turn * *back, (1.0 - turn) * *back + turn * *ahead);
    }
}
