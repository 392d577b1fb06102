//! A procedural town for demos, load tests and accuracy checks without a data set.
//!
//! A [`Town`] renders street views: façades, shop signs, trees, traffic and people, in correct perspective and with
//! exact ground-truth poses. [`Town::reference`] renders the map image of a place. [`Town::query`] renders a later
//! visit, displaced by a couple of metres, rotated by up to 13°, and in different light and traffic. Building styles
//! and shop chains come from a small pool and recur in every street, so places look alike and recognising them is
//! hard.
//!
//! Every picture is a pure function of the seed and its arguments. Nothing is cached, and places can be rendered in any
//! order and from any thread. Writing files, building a map and scoring results are left to the callers.

mod camera;
mod dice;
mod facade;
mod font;
mod furniture;
mod geometry;
mod ground;
mod layout;
mod light;
mod mall;
mod massing;
mod props;
mod raster;
mod scene;
mod signs;
mod styles;
mod surface;
mod traffic;
mod vehicles;

#[cfg(test)]
mod tests;

use image::RgbImage;

use camera::{Camera, Pose};
use dice::Dice;
use geometry::vec3;
use layout::{PLACES_PER_STREET, Street};
use light::Lighting;
use traffic::{Bustle, Traffic};

pub use light::Light;
pub use signs::{Letters, VisibleSign};

/// Maximum distance in metres between a query and a correct reference.
///
/// Places are at least 16 m apart and a query is at most 2.6 m from its place, so the true place is
/// always inside the radius and every other one outside. Each place has a single heading, so
/// distance alone is a fair criterion.
pub const SUCCESS_RADIUS_M: f64 = 10.0;

/// What is built along the streets of a town.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum TownScene {
    /// Houses and shops in the styles of each street.
    #[default]
    Streets,
    /// Shop fronts of one style, which differ in the names on their signs only.
    Mall,
}

/// Parameters of a town and its pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TownSpec {
    /// What is built.
    pub scene: TownScene,
    /// Seed of the town. Towns with the same seed are identical to the last pixel.
    pub seed: u64,
    /// Number of places; 0 is treated as 1.
    pub places: usize,
    /// Image width in pixels; 0 is treated as 1.
    pub width: u32,
    /// Image height in pixels; 0 is treated as 1.
    pub height: u32,
}

impl Default for TownSpec {
    fn default() -> Self {
        TownSpec { scene: TownScene::Streets, seed: 7, places: 60, width: 640, height: 480 }
    }
}

/// A town from whose places pictures can be rendered.
#[derive(Clone, Debug)]
pub struct Town {
    spec: TownSpec,
}

/// A rendered picture with its ground truth.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Index of the place, in `0..Town::places()`.
    pub place: usize,
    /// The picture, in display (sRGB-like) colours.
    pub image: RgbImage,
    /// Camera position, in metres east of the town's origin.
    pub x: f64,
    /// Camera position, in metres north of the town's origin.
    pub y: f64,
    /// Compass heading of the optical axis, in degrees `0.0..360.0`, clockwise from north.
    pub heading: f64,
    /// Light in which the picture was taken.
    pub light: Light,
}

impl Town {
    /// Lays out a town without rendering anything.
    pub fn new(spec: TownSpec) -> Town {
        Town {
            spec: TownSpec {
                places: spec.places.max(1),
                width: spec.width.max(1),
                height: spec.height.max(1),
                ..spec
            },
        }
    }

    /// Number of places, at least 1.
    pub fn places(&self) -> usize {
        self.spec.places
    }

    /// Renders the map image of a place, taken by day in light traffic. `place` wraps around at
    /// [`Town::places`].
    pub fn reference(&self, place: usize) -> Shot {
        self.photograph(self.visit(place, None))
    }

    /// Renders a later visit to a place. Each `variant` is a different visit, and any four consecutive
    /// variants cover the four lights. `place` wraps around at [`Town::places`].
    pub fn query(&self, place: usize, variant: u32) -> Shot {
        self.photograph(self.visit(place, Some(variant)))
    }

    /// Renders a map image, or a visit, with the signs over shops that are in it, and the pixels of all letters.
    pub fn with_signs(
        &self,
        place: usize,
        variant: Option<u32>,
    ) -> (Shot, Vec<VisibleSign>, Letters) {
        let visit = || self.visit(place, variant);
        let bare = || visit().unobstructed();
        let shot = self.photograph(visit());
        let letters =
            Letters::between(&shot.image, &self.photograph(visit().without_letters()).image);
        let uncovered = Letters::between(
            &self.photograph(bare()).image,
            &self.photograph(bare().without_letters()).image,
        );
        let Visit { street, pose, .. } = visit();
        let camera = Camera::new(&pose, self.spec.width, self.spec.height);
        let signs = signs::signs(&street, &camera, &letters, &uncovered);
        (shot, signs, letters)
    }

    /// The camera and the circumstances of a map image, or of a later visit.
    fn visit(&self, place: usize, variant: Option<u32>) -> Visit {
        let place = place % self.places();
        let (street, survey) = self.survey(place);
        let (before, later) = self.bustle();
        let Some(variant) = variant else {
            let dice = street.dice(1_000 + place as u64);
            return Visit { place, street, pose: survey, light: Light::Day, bustle: before, dice };
        };
        let mut dice = street.dice(2_000 + place as u64).fork(u64::from(variant) + 1);
        let first = street.dice(3_000 + place as u64).below(Light::ALL.len());
        let light = Light::ALL[(first + variant as usize) % Light::ALL.len()];
        let pose = match self.spec.scene {
            TownScene::Streets => revisit(survey, (2.2, 1.2, 13.0), &mut dice),
            TownScene::Mall => revisit(survey, (4.0, 2.5, 18.0), &mut dice),
        };
        Visit { place, street, pose, light, bustle: later, dice }
    }

    /// The traffic when the map was surveyed, and at later visits.
    fn bustle(&self) -> (Bustle, Bustle) {
        match self.spec.scene {
            TownScene::Streets => (Bustle::SURVEY, Bustle::EVERYDAY),
            TownScene::Mall => (Bustle::BEFORE_OPENING, Bustle::SHOPPERS),
        }
    }

    fn survey(&self, place: usize) -> (Street, Pose) {
        let street = Street::new(self.spec.scene, self.spec.seed, place / PLACES_PER_STREET);
        let pose = street.survey_pose(place % PLACES_PER_STREET);
        (street, pose)
    }

    fn photograph(&self, visit: Visit) -> Shot {
        let Visit { place, street, pose, light, bustle, mut dice } = visit;
        let (street, dice) = (&street, &mut dice);
        let TownSpec { width, height, .. } = self.spec;
        let camera = Camera::new(&pose, width, height);
        let lighting = Lighting::new(light, street, &camera, dice);
        let traffic = Traffic::new(street, pose.eye, pose.yaw, bustle, dice);
        let scene = scene::Scene::new(street, &camera, &traffic, lighting);
        let (x, y) = street.on_plan(pose.eye);
        Shot {
            place,
            image: raster::render(&scene, &camera, (width, height), dice),
            x,
            y,
            heading: street.compass(pose.yaw),
            light,
        }
    }
}

/// A picture before it is taken.
struct Visit {
    place: usize,
    street: Street,
    pose: Pose,
    light: Light,
    bustle: Bustle,
    dice: Dice,
}

impl Visit {
    /// The same with nothing written on the signs.
    fn without_letters(self) -> Self {
        Self { street: self.street.without_letters(), ..self }
    }

    /// The same without people, vehicles, trees and what stands on the pavement.
    fn unobstructed(self) -> Self {
        Self { street: self.street.without_furniture(), bustle: Bustle::NONE, ..self }
    }
}

/// The camera pose of a later visit to a place. The bounds are metres along and across the street, and degrees of turning.
fn revisit(survey: Pose, (along, across, turned): (f32, f32, f32), dice: &mut Dice) -> Pose {
    let turn = dice.between(-turned, turned).to_radians();
    Pose {
        eye: survey.eye
            + vec3(dice.between(-along, along), dice.between(-across, across), dice.around(0.25)),
        yaw: survey.yaw + turn,
        pitch: survey.pitch + dice.around(3.0).to_radians(),
        roll: dice.around(1.5).to_radians(),
    }
}
