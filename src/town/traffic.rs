//! Traffic, which differs between visits to the same place: parked and passing vehicles, and people.

use super::dice::Dice;
use super::geometry::{Vec3, vec3};
use super::layout::{FRONT, KERB, Lot, PAVEMENT_HEIGHT, Street};
use super::vehicles::Vehicle;

/// How busy a street is.
#[derive(Clone, Copy)]
pub(super) struct Bustle {
    /// Share of kerbside parking that is taken.
    pub parked: f32,
    /// People in view, at most.
    pub walkers: usize,
    /// Probability of a vehicle passing close in front of the camera.
    pub passing: f32,
}

impl Bustle {
    /// A quiet morning, when the map was surveyed.
    pub const SURVEY: Bustle = Bustle { parked: 0.25, walkers: 4, passing: 0.0 };
    /// An ordinary hour.
    pub const EVERYDAY: Bustle = Bustle { parked: 0.4, walkers: 9, passing: 0.35 };
    /// No people and no vehicles.
    pub const NONE: Bustle = Bustle { parked: 0.0, walkers: 0, passing: 0.0 };
    /// A mall when its map was surveyed. No vehicle drives there.
    pub const BEFORE_OPENING: Bustle = Bustle { parked: 0.0, walkers: 2, passing: 0.0 };
    /// A mall at an ordinary hour.
    pub const SHOPPERS: Bustle = Bustle { parked: 0.0, walkers: 16, passing: 0.0 };
}

pub(super) struct Traffic {
    pub vehicles: Vec<Vehicle>,
    /// Feet of the people, each with the draws that dress them.
    pub walkers: Vec<(Vec3, Dice)>,
}

impl Traffic {
    /// The traffic around a camera at `eye` that looks towards `yaw`.
    pub fn new(street: &Street, eye: Vec3, yaw: f32, bustle: Bustle, dice: &mut Dice) -> Traffic {
        let ahead = yaw.cos().signum();
        let facing = yaw.sin().signum();
        let mut vehicles = parked(street, eye, bustle, dice);
        if dice.chance(bustle.passing) {
            let x = eye.x + ahead * dice.between(-1.0, 16.0);
            let lane = vec3(x, facing * 1.55, 0.0);
            vehicles.push(Vehicle::new(lane, facing, false, dice));
        }
        if dice.chance(bustle.passing) {
            let lane = vec3(eye.x + ahead * dice.between(11.0, 30.0), -facing * 1.6, 0.0);
            vehicles.push(Vehicle::new(lane, -facing, false, dice));
        }
        let walkers = (0..dice.below(bustle.walkers + 1))
            .map(|number| {
                let side = if dice.chance(0.75) { facing } else { -facing };
                let x = eye.x + ahead * dice.between(-3.0, 30.0);
                let y = side * dice.between(KERB + 1.0, FRONT - 0.6);
                (vec3(x, y, PAVEMENT_HEIGHT), dice.fork(number as u64))
            })
            .collect();
        Traffic { vehicles, walkers }
    }
}

fn parked(street: &Street, eye: Vec3, bustle: Bustle, dice: &mut Dice) -> Vec<Vehicle> {
    const SLOT: f32 = 6.2;
    let mut vehicles = Vec::new();
    for side in [1.0, -1.0] {
        for slot in -7..8 {
            let x = (eye.x / SLOT).round() * SLOT + slot as f32 * SLOT + dice.around(0.3);
            let centre = vec3(x, side * (KERB - 1.15), 0.0);
            let close = (centre - eye).dot(centre - eye) < 16.0;
            if dice.chance(bustle.parked) && !close && may_park(street, centre) {
                vehicles.push(Vehicle::new(centre, side, true, dice));
            }
        }
    }
    vehicles
}

/// No vehicle parks on a crossing or in the mouth of a side street.
fn may_park(street: &Street, centre: Vec3) -> bool {
    let at_crossing = street.crossings.iter().any(|crossing| (crossing - centre.x).abs() < 4.5);
    let at_mouth = street.lots.iter().any(|lot| match lot {
        Lot::SideStreet(at) => {
            let (start, end) = at.x_range();
            at.away.y * centre.y > 0.0 && centre.x > start - 2.5 && centre.x < end + 2.5
        }
        _ => false,
    });
    !at_crossing && !at_mouth
}
