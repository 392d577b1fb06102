//! How a robot has moved since its last frame, as it says itself.

use std::f64::consts::PI;

use super::super::ServiceError;

/// Maximum distance between two frames, in metres.
const MAX_MOVED_M: f64 = 1e6;

/// Maximum turn between two frames, in radians.
const MAX_TURN: f64 = 1e3;

/// How far a covariance may be off by rounding, as a share of what the variances allow.
const ASYMMETRY: f64 = 1e-3;

/// Maximum variance of a coordinate: beyond it, odometry says nothing.
const MAX_VARIANCE: f64 = 1e12;

/// A turn is forgotten within this many times the usual distance of neighbours, so that a bend is no turn.
const BEND: f64 = 2.0;

/// A robot that turns by more than this, in radians, goes back.
const ROUND: f64 = 2.0 * PI / 3.0;

/// How a robot has moved since its last frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Odometry {
    /// Metres travelled.
    metres: f64,
    /// Standard deviation of that, if the robot states it.
    error: Option<f64>,
    /// Whether it moved backwards; `None` if that is not known.
    backwards: Option<bool>,
    /// How far it turned to the left, in radians.
    turned: f64,
}

impl Odometry {
    /// The distance travelled.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`](whereabouts_api::ErrorKind) for a number out of range.
    pub fn distance(metres: f64) -> Result<Self, ServiceError> {
        if !(0.0..=MAX_MOVED_M).contains(&metres) {
            return Err(ServiceError::unprocessable(format!(
                "moved_m is {metres:?}; it must be the metres moved since the previous frame, 0 to {MAX_MOVED_M}"
            )));
        }
        Ok(Self { metres, error: None, backwards: None, turned: 0.0 })
    }

    /// The pose relative to that at the last frame, in the robot's own axes there: metres ahead and to the left, and
    /// radians to the left. `covariance` has 9 numbers, row by row, or the 3 of its diagonal.
    ///
    /// # Errors
    /// [`ErrorKind::Unprocessable`](whereabouts_api::ErrorKind) for a number out of range.
    pub fn relative_pose(
        [dx, dy, dyaw]: [f64; 3],
        covariance: &[f64],
    ) -> Result<Self, ServiceError> {
        let metres = dx.hypot(dy);
        for (name, number, most) in
            [("dx", dx, MAX_MOVED_M), ("dy", dy, MAX_MOVED_M), ("dyaw", dyaw, MAX_TURN)]
        {
            if !(-most..=most).contains(&number) {
                return Err(ServiceError::unprocessable(format!(
                    "{name} is {number}; dx and dy must be the metres moved ahead and to the left since the previous \
                     frame, and dyaw the radians turned to the left, within ±{most}"
                )));
            }
        }
        let variances = match covariance {
            [] => None,
            [x, y, yaw] | [x, _, _, _, y, _, _, _, yaw] => Some([*x, *y, *yaw]),
            _ => {
                return Err(ServiceError::unprocessable(format!(
                    "the covariance of dx, dy and dyaw has {} numbers; it must have 9, row by row, or the 3 of its \
                     diagonal",
                    covariance.len()
                )));
            }
        };
        if covariance.len() == 9 {
            let is_pair = |row: usize, column: usize| {
                let (one, other) = (covariance[3 * row + column], covariance[3 * column + row]);
                let most = (covariance[4 * row] * covariance[4 * column]).sqrt();
                (one - other).abs() <= ASYMMETRY * most && one.abs() <= most * (1.0 + ASYMMETRY)
            };
            let diagonal = variances.into_iter().flatten();
            let is_sound =
                diagonal.clone().all(|variance| (0.0..=MAX_VARIANCE).contains(&variance));
            if is_sound && !(is_pair(0, 1) && is_pair(0, 2) && is_pair(1, 2)) {
                return Err(ServiceError::unprocessable(
                    "the covariance of dx, dy and dyaw must be symmetric, and no covariance may exceed what the \
                     variances allow; send the 3 numbers of its diagonal if the others are not known",
                ));
            }
        }
        if let Some(wrong) =
            variances.and_then(|all| all.into_iter().find(|v| !(0.0..=MAX_VARIANCE).contains(v)))
        {
            return Err(ServiceError::unprocessable(format!(
                "{wrong} on the diagonal of the covariance must be a variance, 0 to {MAX_VARIANCE}"
            )));
        }
        let error = variances.map(|[x, y, _]| x.max(y).sqrt());
        Ok(Self {
            metres,
            error,
            backwards: (metres > 0.0).then_some(dx < -dy.abs()),
            turned: dyaw,
        })
    }
}

/// What the odometry of a track adds up to since its belief was moved last.
#[derive(Debug, Clone, Default)]
pub(super) struct Odometer {
    /// Metres that the belief has not been moved yet.
    pub pending: f64,
    /// Standard deviation of those.
    pub error: f64,
    /// The turn to the left, in radians, that may be the beginning of going back.
    pub turn: f64,
    /// Whether the robot moved backwards last.
    pub backwards: bool,
}

/// A move that is large enough to change the belief.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Moved {
    pub metres: f64,
    pub error: f64,
    /// Whether the robot has turned round.
    pub turned: bool,
}

impl Odometer {
    /// Adds a reading. Returns the move since the last one, once it is `least` metres; `usual_error` is the error per
    /// metre if the robot does not state any.
    pub fn add(&mut self, odometry: Odometry, usual_error: f64, spacing: f64) -> Moved {
        let Odometry { metres, error, backwards, turned } = odometry;
        self.error += error.unwrap_or(usual_error * metres);
        self.pending += metres;
        self.turn = self.turn * (-metres / (BEND * spacing)).exp() + turned;
        let mut is_back = false;
        if self.turn.abs() > ROUND {
            is_back = true;
            self.turn -= self.turn.signum() * PI;
        }
        if let Some(backwards) = backwards
            && backwards != self.backwards
        {
            is_back = !is_back;
            self.backwards = backwards;
        }
        let (metres, error) = match self.pending >= LEAST * spacing {
            true => (std::mem::take(&mut self.pending), std::mem::take(&mut self.error)),
            false => (0.0, 0.0),
        };
        Moved { metres, error, turned: is_back }
    }
}

/// Share of the usual distance of neighbours from which on a move changes the belief: many small moves would blur it.
const LEAST: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_moves_add_up_before_they_count() {
        let mut odometer = Odometer::default();
        let step = Odometry::distance(0.2).unwrap();
        let metres: Vec<f64> = (0..6).map(|_| odometer.add(step, 0.1, 1.0).metres).collect();
        assert_eq!(metres.iter().filter(|metres| **metres > 0.0).count(), 2);
        assert!((metres.iter().sum::<f64>() - 1.2).abs() < 1e-9, "{metres:?}");
    }

    #[test]
    fn turning_on_the_spot_is_going_back_and_a_bend_is_not() {
        let mut odometer = Odometer::default();
        let turn = |metres, angle| Odometry::relative_pose([metres, 0.0, angle], &[]).unwrap();
        let turns = |odometer: &mut Odometer, metres, angle: f64, steps| {
            (0..steps).filter(|_| odometer.add(turn(metres, angle), 0.1, 1.0).turned).count()
        };
        assert_eq!(turns(&mut odometer, 0.0, 0.5, 7), 1);
        assert_eq!(turns(&mut odometer, 1.0, 0.0, 20), 0);
        assert_eq!(turns(&mut odometer, 1.0, 0.3, 10), 0);
    }

    #[test]
    fn driving_backwards_is_going_back_and_driving_ahead_again_is_so_too() {
        let mut odometer = Odometer::default();
        let moves = [1.0, -1.0, -1.0, 0.0, 1.0];
        let turned: Vec<bool> = moves
            .iter()
            .map(|dx| {
                let pose = Odometry::relative_pose([*dx, 0.0, 0.0], &[]).unwrap();
                odometer.add(pose, 0.1, 1.0).turned
            })
            .collect();
        assert_eq!(turned, [false, true, false, false, true]);
    }

    #[test]
    fn odometry_out_of_range_is_unprocessable_and_says_what_is_meant() {
        for (pose, covariance, named) in [
            ([f64::NAN, 0.0, 0.0], vec![], "dx"),
            ([0.0, 1e7, 0.0], vec![], "dy"),
            ([0.0, 0.0, f64::INFINITY], vec![], "dyaw"),
            ([0.0; 3], vec![1.0], "9"),
            ([0.0; 3], vec![1.0, -1.0, 1.0], "variance"),
        ] {
            let refused = Odometry::relative_pose(pose, &covariance).unwrap_err();
            assert!(refused.detail.contains(named), "{refused}");
        }
        assert!(Odometry::distance(-1.0).is_err());
    }
}
