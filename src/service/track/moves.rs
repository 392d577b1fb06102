//! Where the states of an image move to: along its path and through links, in metres or in images.

use super::belief::{Habits, Numbered, Roads};
use super::paths::Stop;
use super::presence::OFF_AT_FIRST;
use super::speeds::{METRIC, nearest_speed, speed_of, state};

/// The position after a move is off by this share of the usual distance of neighbours: no path is as straight as its
/// images, and no robot is exactly at an image.
const SPREAD: f64 = 0.15;

/// Probabilities below this are not worth moving.
pub(super) const NEGLIGIBLE: f32 = 1e-6;

/// Distance, in units of the usual one, beyond which the filter does not follow a robot.
const LOST: f64 = 200.0;

/// Probability that a robot that is where paths meet takes another one than its own.
const BRANCH: f64 = 0.2;

/// How a robot has moved since its last frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Motion {
    /// By its odometry.
    Measured {
        /// Metres along its way.
        metres: f64,
        /// Standard deviation of that.
        error: f64,
        /// Metres per unit of time, if known.
        speed: f64,
    },
    /// As its speed and the time since then tell.
    Elapsed {
        /// The time, in the unit of the speeds.
        time: f64,
        /// How much the frame differs from the ones before it, in units of the usual difference of neighbours in the
        /// map ([`novelty`](super::evidence::Frames::novelty)); `None` if there is none before it.
        novelty: Option<f64>,
    },
}

/// Moves the states of one image and direction.
pub(super) fn move_states(
    (start, change): (Stop, f32),
    speeds: &[f32],
    (motion, habits): (Motion, Habits),
    roads: Roads,
    (way, branches): &mut (Vec<Stop>, Vec<Vec<Stop>>),
    moved: &mut Numbered,
) {
    // Each speed with its distance and the error of that.
    let total: f32 = speeds.iter().sum();
    if total <= NEGLIGIBLE {
        return;
    }
    let lost = LOST * roads.paths.spacing();
    let (spacing, change) = (roads.paths.spacing(), f64::from(change));
    let floor = SPREAD * spacing;
    let fits = |moved: f64| match motion {
        Motion::Elapsed { novelty: Some(seen), .. } => fit(moved, seen, change),
        _ => 1.0,
    };
    let (metric, steps) = speeds.split_at(METRIC);
    let mut moves: [(f32, f64, f64, usize); METRIC] = [(0.0, 0.0, 0.0, 0); METRIC];
    let mut count = 0;
    match motion {
        Motion::Measured { metres, error, speed } => {
            let number = nearest_speed(speed / habits.max_speed);
            let floor = floor.min(0.5 * metres);
            moves[0] = (metric.iter().sum(), metres, floor.hypot(error), number);
            count = 1;
        }
        Motion::Elapsed { time, .. } => {
            for (number, mass) in metric.iter().enumerate().filter(|(_, mass)| **mass > NEGLIGIBLE)
            {
                let metres = speed_of(number) * habits.max_speed * time;
                let mass = fits(metres / spacing) as f32 * *mass;
                moves[count] = (mass, metres, floor.min(0.5 * metres), number);
                count += 1;
            }
        }
    }
    // Who may have passed that many images is anywhere, on the map or not.
    let (moves, gone): (Vec<_>, Vec<_>) =
        moves[..count].iter().copied().partition(|(_, metres, ..)| *metres <= lost);
    let gone: f64 = gone.iter().map(|(mass, ..)| f64::from(*mass)).sum();
    moved.belief.elsewhere += (1.0 - OFF_AT_FIRST) * gone;
    moved.left += OFF_AT_FIRST * gone;
    let reach = moves.iter().map(|(_, metres, error, _)| metres + FAR * error).fold(0.0, f64::max);
    let kept = 1.0 - habits.jump;
    for (number, mass) in (METRIC..).zip(steps).filter(|(_, mass)| **mass > NEGLIGIBLE) {
        let mass = f64::from(*mass) * kept * fits((number - METRIC + 1) as f64);
        step_on(start, (number, mass), motion, roads, moved);
    }
    roads.paths.walk(roads.grid, start, reach, (way, branches));
    let own = if branches.is_empty() { 1.0 } else { 1.0 - BRANCH };
    let ways = std::iter::once((own, &*way))
        .chain(branches.iter().map(|branch| (BRANCH / branches.len() as f64, branch)));
    let spot = roads.paths.same_spot();
    for (share, way) in ways {
        let places = Landing::all(way, spot, moved);
        let is_end = way.last().is_some_and(|last| roads.paths.is_end(*last));
        let way = Way { stops: way, places: &places, is_end, spacing };
        for (mass, metres, error, speed) in &moves {
            let mass = f64::from(*mass) * share * kept;
            for (at, weight) in [(-FAR, OFF), (0.0, 1.0 - 2.0 * OFF), (FAR, OFF)] {
                let metres = (metres + at * error).max(0.0);
                way.deposit(metres, (mass * weight, *speed), moved);
            }
        }
    }
}

/// Moves a state by a number of images on its path, one more or one less.
fn step_on(
    start: Stop,
    (number, mass): (usize, f64),
    motion: Motion,
    roads: Roads,
    moved: &mut Numbered,
) {
    let measured = match motion {
        Motion::Measured { metres, .. } => Some(metres),
        Motion::Elapsed { time, .. } if time > 0.0 => None,
        Motion::Elapsed { .. } => Some(0.0),
    };
    if measured == Some(0.0) {
        let at = moved.place(start.image);
        moved.belief.states[at][state(start.ahead, number)] += mass as f32;
        return;
    }
    let steps = number - METRIC + 1;
    let spacing = roads.paths.spacing();
    let mut at = Some(start);
    let mut metres = start.metres;
    for passed in 0..=steps + 1 {
        let weight = if passed == steps {
            1.0 - 2.0 * STEP_ERROR
        } else if passed.abs_diff(steps) == 1 {
            STEP_ERROR
        } else {
            0.0
        };
        // Odometry may contradict.
        let fit = measured.map_or(1.0, |measured| {
            let off = (metres - measured) / (STEP_SLACK * (measured + spacing));
            (-0.5 * off * off).exp()
        });
        let mass = mass * weight * fit;
        match at {
            Some(at) if mass > 0.0 => {
                let place = moved.place(at.image);
                moved.belief.states[place][state(at.ahead, number)] += mass as f32;
            }
            Some(_) => {}
            // The path has ended.
            None => moved.left += mass,
        }
        let Some(before) = at else { continue };
        at = roads.paths.next(roads.grid, before);
        metres = at.map_or(metres + spacing, |at| at.metres);
        if at.is_none() && !roads.paths.is_end(before) {
            return;
        }
    }
}

/// Probability that a robot moves one image less than its speed in images, and that it moves one more.
const STEP_ERROR: f64 = 0.1;

/// By how much odometry may contradict the distance of images, as a share of it.
const STEP_SLACK: f64 = 0.5;

/// How well a move, in units of the usual distance of neighbours, fits the novelty of a frame: who sees something else
/// than before has moved, and who sees the same where neighbours differ by `change` has not.
pub(super) fn fit(moved: f64, novelty: f64, change: f64) -> f64 {
    let least = LEAST * novelty.min(1.0);
    let lack = if novelty > SAME { (1.0 - moved / least).max(0.0) } else { 0.0 };
    let expected = SURE * change * moved.min(1.0);
    let excess = if novelty < expected { 1.0 - novelty / expected } else { 0.0 };
    1.0 - (1.0 - MISFIT) * excess.max(lack).min(1.0)
}

/// Share of the novelty that a robot moves at least.
const LEAST: f64 = 0.5;
/// A frame of less novelty may show the same place.
const SAME: f64 = 0.3;
/// Share of the difference of neighbours that a robot sees at least when it moves to the next.
const SURE: f64 = 0.4;
/// The lowest fit: something else may also pass by, or block the camera.
const MISFIT: f64 = 0.3;

/// A Gaussian as three points: two at this many standard deviations, with this weight each (Gauss–Hermite).
const FAR: f64 = 1.732_050_8;
const OFF: f64 = 1.0 / 6.0;

/// Where a move to a stop of a way ends.
struct Landing {
    /// The place of its image in the belief.
    place: usize,
    /// All views of the spot, which are equally likely, are from this stop of the way to before the next.
    first: usize,
    end: usize,
}

impl Landing {
    /// The landings of all stops of a way, of which those within `spot` metres are the same spot.
    fn all(way: &[Stop], spot: f64, moved: &mut Numbered) -> Vec<Self> {
        let mut first = 0;
        let mut all: Vec<Self> = Vec::with_capacity(way.len());
        for (at, stop) in way.iter().enumerate() {
            if stop.metres - way[first].metres > spot {
                first = at;
            }
            all.push(Self { place: moved.place(stop.image), first, end: at + 1 });
        }
        for at in (1..all.len()).rev() {
            if all[at].first == all[at - 1].first {
                all[at - 1].end = all[at].end;
            }
        }
        all
    }
}

/// A way from an image, and where a move on it ends.
struct Way<'a> {
    stops: &'a [Stop],
    places: &'a [Landing],
    /// Whether the map ends with the way.
    is_end: bool,
    /// The usual distance of neighbours in metres.
    spacing: f64,
}

impl Way<'_> {
    /// Puts a probability on the images before and after a distance, the nearer one the more.
    fn deposit(&self, metres: f64, (mass, speed): (f64, usize), moved: &mut Numbered) {
        let after = self.stops.partition_point(|stop| stop.metres < metres);
        let mut put = |at: usize, mass: f64| {
            let Landing { first, end, .. } = self.places[at];
            let share = (mass / (end - first) as f64) as f32;
            for at in first..end {
                let place = self.places[at].place;
                moved.belief.states[place][state(self.stops[at].ahead, speed)] += share;
            }
        };
        match after.checked_sub(1) {
            None => put(0, mass),
            // The way ends here. A robot that stays on the map has stopped, or is not so fast.
            Some(last) if after == self.stops.len() => {
                put(last, mass * BEYOND);
                if self.is_end {
                    let beyond = (metres - self.stops[last].metres) / self.spacing;
                    moved.left += mass * (1.0 - BEYOND) * beyond.min(1.0);
                }
            }
            Some(before) => {
                let [low, high] = [self.stops[before].metres, self.stops[after].metres];
                let share = (metres - low) / (high - low);
                let is_off = high - low > GAP * self.spacing
                    && (metres - low).min(high - metres) > self.spacing;
                put(before, mass * (1.0 - share));
                put(after, mass * share);
                if is_off {
                    moved.left += mass * (1.0 - BEYOND) / BEYOND;
                }
            }
        }
    }
}

/// Weight of staying on the map where a path ends; in a gap between two images, the probability of being at one of them.
const BEYOND: f64 = 0.3;

/// Images this many times further apart than usual have a gap between them: who is there is off the map.
const GAP: f64 = 5.0;
