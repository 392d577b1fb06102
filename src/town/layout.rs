//! Layout of the town: streets, lots, street furniture, and camera places.
//!
//! Every street is its own small world with a local frame (see [`geometry`](super::geometry)) and
//! a position on the town plan, spaced so that streets never overlap.

use super::TownScene;
use super::camera::Pose;
use super::dice::Dice;
use super::furniture::{furnish, plant};
use super::geometry::{Rgb, Vec3, vec3};
use super::styles::{BRANDS, Brand, STYLES, Style};

pub(super) const PLACES_PER_STREET: usize = 8;
pub(super) const PLACE_SPACING: f32 = 17.0;
const STREET_PITCH: f64 = 320.0;
const STREETS_PER_ROW: usize = 6;

/// Distances from the street's axis, in metres.
pub(super) const KERB: f32 = 5.2;
pub(super) const FRONT: f32 = 8.6;
pub(super) const PAVEMENT_HEIGHT: f32 = 0.12;

/// Buildings reach this far beyond the first and last place.
const OVERHANG: f32 = 46.0;
pub(super) const STREET_START: f32 = -OVERHANG;
pub(super) const STREET_END: f32 = PLACE_SPACING * (PLACES_PER_STREET - 1) as f32 + OVERHANG;

/// A building line with its own coordinates: `u` from left to right as seen from the road,
/// `depth` away from the road, both in metres.
#[derive(Clone, Copy)]
pub(super) struct Frontage {
    origin: Vec3,
    along: Vec3,
    pub away: Vec3,
    pub width: f32,
}

impl Frontage {
    /// Beside the street, `side` being +1 for the left of its axis and -1 for the right; `start`
    /// is the lesser x and `line` the distance from the axis.
    pub fn beside(side: f32, start: f32, width: f32, line: f32) -> Frontage {
        let left = if side > 0.0 { start } else { start + width };
        Frontage {
            origin: vec3(left, side * line, 0.0),
            along: vec3(side, 0.0, 0.0),
            away: vec3(0.0, side, 0.0),
            width,
        }
    }

    /// Across the end of the street: `end` is +1 for the far end and -1 for the near one, `left`
    /// the offset of the left edge from the axis.
    fn across(end: f32, x: f32, left: f32, width: f32) -> Frontage {
        Frontage {
            origin: vec3(x, -end * left, 0.0),
            along: vec3(0.0, -end, 0.0),
            away: vec3(end, 0.0, 0.0),
            width,
        }
    }

    pub fn point(&self, u: f32, depth: f32, z: f32) -> Vec3 {
        self.origin + self.along * u + self.away * depth + Vec3::UP * z
    }

    /// Least and greatest x, in metres along the street.
    pub fn x_range(&self) -> (f32, f32) {
        let (one, other) = (self.origin.x, self.origin.x + self.along.x * self.width);
        (one.min(other), one.max(other))
    }
}

pub(super) enum GroundFloor {
    Shop(&'static Brand),
    Home { door_bay: usize, door: Rgb },
}

pub(super) struct Building {
    pub at: Frontage,
    pub style: &'static Style,
    pub colour: Rgb,
    /// Floors above the ground floor.
    pub floors: usize,
    pub bays: usize,
    pub ground: GroundFloor,
    /// The door is at the right end of a shop front.
    pub mirrored: bool,
    /// Whether its sign has letters.
    pub is_lettered: bool,
    pub depth: f32,
    pub seed: u32,
}

impl Building {
    pub fn ground_height(&self) -> f32 {
        match self.ground {
            GroundFloor::Shop(_) => 3.7,
            GroundFloor::Home { .. } => 3.2,
        }
    }

    /// From the pavement to the top of the front wall, in metres.
    pub fn eaves(&self) -> f32 {
        self.ground_height() + self.floors as f32 * self.style.storey + self.style.cornice + 0.25
    }
}

/// The use of a lot along one side of the street.
pub(super) enum Lot {
    Built(Building),
    /// A side street comes in at road level.
    SideStreet(Frontage),
    /// A garden behind a low wall.
    Garden(Frontage, u32),
}

pub(super) struct Tree {
    pub foot: Vec3,
    pub height: f32,
    pub seed: u32,
}

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Fixture {
    Lamp,
    RoadSign,
    PostBox,
    Bin,
    Bollard,
    Bench,
}

pub(super) struct Street {
    origin: (f64, f64),
    /// Compass bearing of the axis, in radians.
    bearing: f64,
    pub lots: Vec<Lot>,
    /// Buildings seen only through gaps and at the ends of the street.
    pub backdrop: Vec<Building>,
    pub trees: Vec<Tree>,
    pub fixtures: Vec<(Fixture, Vec3)>,
    pub crossings: Vec<f32>,
    dice: Dice,
}

impl Street {
    pub fn new(scene: TownScene, seed: u64, index: usize) -> Street {
        let dice = Dice::new(seed).fork(index as u64);
        let mut plan = dice.fork(1);
        let bearing = f64::from(plan.between(0.0, std::f32::consts::TAU));
        let bare = Street {
            origin: (
                (index % STREETS_PER_ROW) as f64 * STREET_PITCH,
                (index / STREETS_PER_ROW) as f64 * STREET_PITCH,
            ),
            bearing,
            lots: Vec::new(),
            backdrop: Vec::new(),
            trees: Vec::new(),
            fixtures: Vec::new(),
            crossings: Vec::new(),
            dice,
        };
        match scene {
            TownScene::Streets => bare.with_houses(plan),
            TownScene::Mall => bare.with_shops(&Dice::new(seed), plan),
        }
    }

    fn with_houses(self, mut plan: Dice) -> Street {
        let taste = Taste::new(&mut plan);
        let mut lots = Vec::new();
        for side in [1.0, -1.0] {
            fill_side(side, &taste, &mut plan, &mut lots);
        }
        let backdrop = backdrop(&taste, &mut plan);
        Street {
            trees: plant(&mut self.dice.fork(2)),
            fixtures: furnish(&mut self.dice.fork(3)),
            crossings: vec![plan.between(5.0, 55.0), plan.between(70.0, 115.0)],
            lots,
            backdrop,
            ..self
        }
    }

    /// The same street with nothing written on its signs.
    pub fn without_letters(mut self) -> Street {
        let lots = self.lots.iter_mut().filter_map(|lot| match lot {
            Lot::Built(building) => Some(building),
            _ => None,
        });
        lots.chain(&mut self.backdrop).for_each(|building| building.is_lettered = false);
        self
    }

    /// The same street without what may stand before a sign.
    pub fn without_furniture(self) -> Street {
        Street { trees: Vec::new(), fixtures: Vec::new(), ..self }
    }

    /// Draws that belong to this street; `tag` names their purpose.
    pub fn dice(&self, tag: u64) -> Dice {
        self.dice.fork(tag)
    }

    /// Camera pose of the map image of a place.
    pub fn survey_pose(&self, slot: usize) -> Pose {
        let mut dice = self.dice.fork(100 + slot as u64);
        let side = if dice.chance(0.5) { 1.0 } else { -1.0 };
        Pose {
            eye: vec3(slot as f32 * PLACE_SPACING + dice.around(0.5), -side * 2.0, 1.9),
            yaw: side * (52.0 + dice.around(5.0)).to_radians(),
            pitch: 5.5_f32.to_radians(),
            roll: 0.0,
        }
    }

    /// Metres east and north of a point given in the street's frame.
    pub fn on_plan(&self, point: Vec3) -> (f64, f64) {
        let (sin, cos) = self.bearing.sin_cos();
        // The axis is centred on the origin so that streets with different bearings stay apart.
        let middle = f64::from(STREET_START + STREET_END) / 2.0;
        let (along, left) = (f64::from(point.x) - middle, f64::from(point.y));
        (self.origin.0 + along * sin - left * cos, self.origin.1 + along * cos + left * sin)
    }

    /// Compass degrees in `0.0..360.0` of a yaw in the street's frame.
    pub fn compass(&self, yaw: f32) -> f64 {
        (self.bearing - f64::from(yaw)).to_degrees().rem_euclid(360.0)
    }

    /// The direction towards a compass azimuth (radians), in the street's frame.
    pub fn towards(&self, azimuth: f64, elevation: f32) -> Vec3 {
        let yaw = (self.bearing - azimuth) as f32;
        let level = elevation.cos();
        vec3(level * yaw.cos(), level * yaw.sin(), elevation.sin())
    }
}

/// What is seen through gaps and at the ends of a street.
pub(super) fn backdrop(taste: &Taste, dice: &mut Dice) -> Vec<Building> {
    let mut backdrop = Vec::new();
    for side in [1.0, -1.0] {
        back_row(side, taste, dice, &mut backdrop);
        close_end(side, taste, dice, &mut backdrop);
    }
    backdrop
}

/// Distribution of buildings in one street.
pub(super) struct Taste {
    styles: [&'static Style; 3],
    pub shops: f32,
}

impl Taste {
    pub fn new(dice: &mut Dice) -> Taste {
        Taste {
            styles: [(); 3].map(|()| &STYLES[dice.below(STYLES.len())]),
            shops: dice.between(0.45, 0.85),
        }
    }
}

fn fill_side(side: f32, taste: &Taste, dice: &mut Dice, lots: &mut Vec<Lot>) {
    let mut start = STREET_START - dice.between(0.0, 6.0);
    let mut since_gap = dice.between(0.0, 30.0);
    while start < STREET_END {
        if since_gap > 34.0 && dice.chance(0.5) {
            let width = dice.between(4.5, 7.5);
            lots.push(open_lot(Frontage::beside(side, start, width, FRONT), dice));
            since_gap = 0.0;
            start += width;
            continue;
        }
        let plan = Terrace::new(taste, dice);
        for _ in 0..1 + dice.below(3) {
            let at = Frontage::beside(side, start, plan.width, FRONT + plan.setback);
            lots.push(Lot::Built(plan.house(at, taste, dice)));
            since_gap += plan.width;
            start += plan.width;
        }
    }
}

fn open_lot(at: Frontage, dice: &mut Dice) -> Lot {
    if dice.chance(0.55) { Lot::SideStreet(at) } else { Lot::Garden(at, dice.bits() as u32) }
}

/// A second row of houses, one block away from the street.
fn back_row(side: f32, taste: &Taste, dice: &mut Dice, into: &mut Vec<Building>) {
    const DISTANCE: f32 = 27.0;
    let mut start = STREET_START;
    while start < STREET_END {
        let plan = Terrace::new(taste, dice);
        let at = Frontage::beside(side, start, plan.width, FRONT + DISTANCE);
        into.push(plan.house(at, taste, dice));
        start += plan.width;
    }
}

/// Houses across the end of the street, where it meets another.
fn close_end(end: f32, taste: &Taste, dice: &mut Dice, into: &mut Vec<Building>) {
    const REACH: f32 = 26.0;
    let x = if end > 0.0 { STREET_END + 14.0 } else { STREET_START - 14.0 };
    let mut left = -REACH;
    while left < REACH {
        let plan = Terrace::new(taste, dice);
        let at = Frontage::across(end, x, left, plan.width);
        into.push(plan.house(at, taste, dice));
        left += plan.width;
    }
}

/// Properties shared by neighbouring buildings of one development.
pub(super) struct Terrace {
    style: &'static Style,
    pub colour: Rgb,
    pub bays: usize,
    floors: usize,
    pub width: f32,
    pub setback: f32,
    depth: f32,
}

impl Terrace {
    pub fn new(taste: &Taste, dice: &mut Dice) -> Terrace {
        let style = dice.pick(&taste.styles);
        let bays = 2 + dice.below(3);
        Terrace {
            style,
            colour: dice.pick(&style.colours),
            bays,
            floors: 1 + dice.below(3) + usize::from(dice.chance(0.3)),
            width: bays as f32 * style.bay + 0.7,
            setback: if dice.chance(0.3) { dice.between(0.5, 2.6) } else { 0.0 },
            depth: dice.between(7.0, 10.0),
        }
    }

    pub fn house(&self, at: Frontage, taste: &Taste, dice: &mut Dice) -> Building {
        let repainted = dice.chance(0.3);
        let fresh = dice.pick(&self.style.colours);
        Building {
            at,
            style: self.style,
            colour: if repainted { fresh } else { self.colour },
            floors: self.floors,
            bays: self.bays,
            ground: ground_floor(self.bays, taste.shops, dice),
            mirrored: dice.chance(0.5),
            is_lettered: true,
            depth: self.depth,
            seed: dice.bits() as u32,
        }
    }
}

fn ground_floor(bays: usize, shops: f32, dice: &mut Dice) -> GroundFloor {
    const DOORS: [Rgb; 5] = [
        Rgb::hex(0x22303c),
        Rgb::hex(0x8c2b24),
        Rgb::hex(0x2f5d46),
        Rgb::hex(0xd0a23c),
        Rgb::hex(0x4b6a8a),
    ];
    if dice.chance(shops) {
        GroundFloor::Shop(&BRANDS[dice.below(BRANDS.len())])
    } else {
        GroundFloor::Home { door_bay: dice.below(bays), door: dice.pick(&DOORS) }
    }
}
