//! The surfaces that are drawn: flat panels with an outline and a paint. A paint maps a pixel's view of the panel
//! ([`Glance`]) to a [`Material`].

use super::dice::{drift, floor, speckle, whole};
use super::geometry::{Panel, Rgb, Vec3};
use super::layout::Building;
use super::styles::Wall;
use super::vehicles::Profile;

pub(super) struct Surface<'a> {
    pub panel: Panel,
    pub outline: Outline,
    pub paint: Paint<'a>,
}

impl Surface<'_> {
    /// The normal that light meets, `facing` being the panel's own on the side that is seen: leaves
    /// and people are round, and catch light from above.
    pub fn lit_normal(&self, facing: Vec3) -> Vec3 {
        match self.paint {
            Paint::Leaves(_) | Paint::Walker { .. } => (facing + Vec3::UP).unit(),
            _ => facing,
        }
    }
}

/// The part of a panel that exists.
#[derive(Clone, Copy)]
pub(super) enum Outline {
    Full,
    /// An isosceles triangle on the panel's lower edge.
    Gable,
    Disc,
    /// A ragged disc of leaves.
    Leaves(u32),
    /// A walker; the number is the stride in metres.
    Walker(f32),
    Vehicle(&'static Profile),
}

#[derive(Clone, Copy)]
pub(super) enum Paint<'a> {
    Facade(&'a Building),
    Wall(Wall, Rgb, u32),
    Tiles(Rgb),
    Plain(Rgb),
    Stripes(Rgb, Rgb),
    /// A board with one line of text, `size` metres tall.
    Sign {
        text: &'static str,
        board: Rgb,
        ink: Rgb,
        size: f32,
    },
    /// Pale centre, coloured rim.
    RoadSign(Rgb),
    Leaves(u32),
    Walker {
        coat: Rgb,
        trousers: Rgb,
        hair: Rgb,
    },
    VehicleSide(&'static Profile, Rgb),
    /// Front or back of a vehicle: plate and lights.
    VehicleEnd(Rgb, Rgb),
    Glass,
    Lantern,
    Road,
    Pavement,
}

impl Paint<'_> {
    /// Thickness of the thinnest upright and level lines that must stay visible, in metres.
    pub fn finest(&self) -> (f32, f32) {
        match self {
            // Strokes of the name over a shop.
            Paint::Facade(_) => (0.09, 0.09),
            Paint::Sign { size, .. } => (0.17 * size, 0.17 * size),
            Paint::VehicleSide(..) => (0.08, 0.06),
            // The lines along the kerb.
            Paint::Road => (f32::INFINITY, 0.09),
            _ => (f32::INFINITY, f32::INFINITY),
        }
    }
}

/// One pixel's look at a panel. Lengths are in metres.
#[derive(Clone, Copy)]
pub(super) struct Glance {
    pub u: f32,
    pub v: f32,
    pub width: f32,
    pub height: f32,
    /// Extent of the pixel along `u` and `v`.
    pub across: f32,
    pub rise: f32,
    /// How far the line of sight moves along `u` and `v` per metre *behind* the panel: what makes
    /// recesses and interiors show parallax.
    pub slant: (f32, f32),
    pub point: Vec3,
}

impl Glance {
    /// Share of the pixel inside `left..right` × `bottom..top`.
    #[inline]
    pub fn within(&self, (left, right): (f32, f32), (bottom, top): (f32, f32)) -> f32 {
        let columns = overlap(self.u, self.across, left, right);
        if columns <= 0.0 {
            return 0.0;
        }
        columns * overlap(self.v, self.rise, bottom, top)
    }

    /// Share of the pixel in the band `bottom..top`.
    #[inline]
    pub fn band(&self, bottom: f32, top: f32) -> f32 {
        overlap(self.v, self.rise, bottom, top)
    }

    /// The same line of sight where it meets a parallel plane `depth` metres behind.
    #[inline]
    pub fn behind(&self, depth: f32) -> Glance {
        Glance { u: self.u + self.slant.0 * depth, v: self.v + self.slant.1 * depth, ..*self }
    }
}

/// Reflectance, and light given off regardless of the illumination.
#[derive(Clone, Copy)]
pub(super) struct Material {
    pub albedo: Rgb,
    pub glow: Rgb,
}

impl Material {
    #[inline]
    pub fn matt(albedo: Rgb) -> Material {
        Material { albedo, glow: Rgb::BLACK }
    }

    #[inline]
    pub fn mix(self, other: Material, share: f32) -> Material {
        Material {
            albedo: self.albedo.mix(other.albedo, share),
            glow: self.glow.mix(other.glow, share),
        }
    }

    #[inline]
    pub fn paint(self, colour: Rgb, share: f32) -> Material {
        if share <= 0.0 {
            return self;
        }
        self.mix(Material::matt(colour), share)
    }
}

/// Share of an interval of length `extent` around `x` that lies in `low..high`.
#[inline]
pub(super) fn overlap(x: f32, extent: f32, low: f32, high: f32) -> f32 {
    let half = extent / 2.0;
    let (from, to) = (x - half, x + half);
    // Nearly every question is answered without the division.
    if to <= low || from >= high {
        0.0
    } else if from >= low && to <= high {
        1.0
    } else {
        (to.min(high) - from.max(low)).max(0.0) / extent
    }
}

/// Share of an interval of length `extent` around `x` on the first `duty` metres of a pattern
/// repeating every `period`: an exactly box-filtered stripe, which cannot alias.
#[inline]
pub(super) fn stripes(x: f32, extent: f32, period: f32, duty: f32) -> f32 {
    let frequency = 1.0 / period;
    // No branches: joints start and end every few pixels, where a wrong guess costs more than
    // the arithmetic.
    let filled = |x: f32| {
        let whole = whole(x * frequency);
        whole * duty + (x - whole * period).min(duty)
    };
    (filled(x + extent / 2.0) - filled(x - extent / 2.0)) / extent
}

/// The colour of a wall, `relief` being its joints and `drift` the unevenness of age.
pub(super) fn wall(kind: Wall, colour: Rgb, seed: u32, at: &Glance) -> Rgb {
    let age = 0.86 + 0.28 * drift(at.u * 0.55, at.v * 0.35, seed);
    let relief = match kind {
        Wall::Brick => brickwork(at, 0.09, 0.3, 0.014, 0.22),
        Wall::Ashlar => brickwork(at, 0.55, 1.1, 0.03, 0.1),
        Wall::Boards => 1.0 - 0.35 * stripes(at.v, at.rise, 0.2, 0.03),
        Wall::Concrete => {
            1.0 - 0.25 * stripes(at.v, at.rise, 1.55, 0.03).max(stripes(at.u, at.across, 1.5, 0.03))
        }
        Wall::Render => 0.97 + 0.06 * drift(at.u * 3.0, at.v * 3.0, seed ^ 7),
    };
    colour * (age * relief)
}

fn brickwork(at: &Glance, course: f32, length: f32, joint: f32, variety: f32) -> f32 {
    let row = floor(at.v * (1.0 / course));
    let offset = if row & 1 == 0 { 0.0 } else { length / 2.0 };
    if at.rise > 1.3 * course {
        return 1.0 - 0.3 * joint / course;
    }
    let bed = stripes(at.v, at.rise, course, joint);
    // Where several courses share a pixel the vertical joints average out over both offsets.
    let resolved = (1.0 - at.rise / course).max(0.0);
    let head = stripes(at.u + offset, at.across, length, joint) * resolved;
    let fade = (1.0 - at.across / length).max(0.0) * (1.3 - at.rise / course).clamp(0.0, 1.0);
    let tone = if fade > 0.0 {
        (speckle(floor((at.u + offset) / length), row, 11) - 0.5) * variety * fade
    } else {
        0.0
    };
    1.0 + tone - 0.3 * bed.max(head)
}
