//! Cars, vans and buses: a side profile extruded to the vehicle's width.

use super::dice::Dice;
use super::geometry::{Panel, Rgb, Vec3, vec3};
use super::surface::{Glance, Material, Outline, Paint, Surface, overlap};

/// A vehicle's shape, in metres; `roofline` runs from the tail to the nose as (length, height).
#[derive(Debug, PartialEq)]
pub(super) struct Profile {
    roofline: &'static [(f32, f32)],
    pub width: f32,
    /// Underside above the road.
    clearance: f32,
    wheels: (f32, f32),
    wheel_radius: f32,
    /// Side windows: from, to along the length, and their lower edge.
    windows: (f32, f32, f32),
    /// Number of side windows.
    lights: u8,
}

static CAR: Profile = Profile {
    roofline: &[
        (0.0, 0.24),
        (0.02, 0.92),
        (0.5, 1.4),
        (2.15, 1.45),
        (2.95, 0.98),
        (4.0, 0.8),
        (4.15, 0.24),
    ],
    width: 1.75,
    clearance: 0.24,
    wheels: (0.78, 3.3),
    wheel_radius: 0.32,
    windows: (0.35, 2.75, 0.94),
    lights: 2,
};

static SALOON: Profile = Profile {
    roofline: &[
        (0.0, 0.22),
        (0.05, 0.95),
        (0.75, 1.0),
        (1.35, 1.4),
        (2.5, 1.43),
        (3.3, 0.98),
        (4.45, 0.82),
        (4.6, 0.22),
    ],
    width: 1.8,
    clearance: 0.22,
    wheels: (0.95, 3.7),
    wheel_radius: 0.33,
    windows: (1.0, 3.1, 0.96),
    lights: 2,
};

static VAN: Profile = Profile {
    roofline: &[(0.0, 0.28), (0.03, 2.25), (3.7, 2.3), (4.5, 1.35), (5.15, 1.1), (5.2, 0.28)],
    width: 2.0,
    clearance: 0.28,
    wheels: (1.0, 4.3),
    wheel_radius: 0.36,
    windows: (3.25, 4.35, 1.35),
    lights: 1,
};

static BUS: Profile = Profile {
    roofline: &[(0.0, 0.3), (0.05, 2.95), (9.6, 3.0), (9.85, 1.1), (9.9, 0.3)],
    width: 2.5,
    clearance: 0.3,
    wheels: (2.3, 7.6),
    wheel_radius: 0.48,
    windows: (0.4, 9.4, 1.35),
    lights: 6,
};

impl Profile {
    pub fn length(&self) -> f32 {
        self.roofline.last().map_or(0.0, |&(x, _)| x)
    }

    fn peak(&self) -> f32 {
        self.roofline.iter().map(|&(_, z)| z).fold(0.0, f32::max)
    }

    /// Height of the body over a point along its length.
    fn top(&self, x: f32) -> f32 {
        self.roofline.windows(2).find(|pair| x <= pair[1].0).map_or(0.0, |pair| {
            let ((from, low), (to, high)) = (pair[0], pair[1]);
            low + (high - low) * ((x - from) / (to - from)).clamp(0.0, 1.0)
        })
    }

    fn wheel_distance(&self, x: f32, z: f32) -> f32 {
        let reach = (x - self.wheels.0).abs().min((x - self.wheels.1).abs());
        (reach * reach + (z - self.wheel_radius) * (z - self.wheel_radius)).sqrt()
    }

    /// Whether the side view covers a point.
    pub fn contains(&self, x: f32, z: f32) -> bool {
        (z > self.clearance && z < self.top(x)) || self.wheel_distance(x, z) < self.wheel_radius
    }
}

/// A vehicle standing on the road.
pub(super) struct Vehicle {
    profile: &'static Profile,
    colour: Rgb,
    /// Middle of the underside, at road level.
    pub centre: Vec3,
    /// +1 when it faces along the street's axis, -1 when against.
    facing: f32,
}

impl Vehicle {
    /// A parked or passing vehicle; buses do not park.
    pub fn new(centre: Vec3, facing: f32, parked: bool, dice: &mut Dice) -> Vehicle {
        const COLOURS: [Rgb; 8] = [
            Rgb::hex(0xd9dadb),
            Rgb::hex(0x2a2c30),
            Rgb::hex(0x8d9298),
            Rgb::hex(0x9c2622),
            Rgb::hex(0x2c4f86),
            Rgb::hex(0xf0efec),
            Rgb::hex(0x35564a),
            Rgb::hex(0xc08a3a),
        ];
        let kind = dice.unit();
        let profile = match kind {
            _ if !parked && kind < 0.12 => &BUS,
            _ if kind < 0.28 => &VAN,
            _ if kind < 0.6 => &SALOON,
            _ => &CAR,
        };
        Vehicle { profile, colour: dice.pick(&COLOURS), centre, facing }
    }

    /// Half the length and half the width, in metres.
    pub fn reach(&self) -> (f32, f32) {
        (self.profile.length() / 2.0, self.profile.width / 2.0)
    }

    pub fn surfaces<'a>(&self, into: &mut Vec<Surface<'a>>) {
        let profile = self.profile;
        let half_width = vec3(0.0, profile.width / 2.0, 0.0);
        let ahead = Vec3::EAST * self.facing;
        let tail = self.centre - ahead * (profile.length() / 2.0);
        for flank in [half_width, half_width * -1.0] {
            into.push(Surface {
                panel: Panel::spanning(
                    tail + flank,
                    ahead * profile.length(),
                    Vec3::UP * profile.peak(),
                ),
                outline: Outline::Vehicle(profile),
                paint: Paint::VehicleSide(profile, self.colour),
            });
        }
        let at = |(x, z): (f32, f32)| tail + ahead * x + Vec3::UP * z - half_width;
        let last = profile.roofline.len().saturating_sub(2);
        for (index, pair) in profile.roofline.windows(2).enumerate() {
            let (from, to) = (at(pair[0]), at(pair[1]));
            let steep = (pair[1].1 - pair[0].1).abs() > 0.3;
            let paint = if index == 0 {
                Paint::VehicleEnd(self.colour, Rgb::hex(0xa81e1a))
            } else if index == last {
                Paint::VehicleEnd(self.colour, Rgb::hex(0xf2f0e2))
            } else if steep {
                Paint::Glass
            } else {
                Paint::Plain(self.colour)
            };
            into.push(Surface {
                panel: Panel::spanning(from, half_width * 2.0, to - from),
                outline: Outline::Full,
                paint,
            });
        }
    }
}

pub(super) fn side_paint(profile: &Profile, colour: Rgb, at: &Glance) -> Material {
    const GLASS: Rgb = Rgb::hex(0x2b3238);
    let blur = at.across.max(at.rise);
    let (from, to, sill) = profile.windows;
    let roof = profile.top(at.u) - 0.1;
    let mut cover =
        overlap(at.u, at.across, from, to) * overlap(at.v, at.rise, sill, roof.max(sill));
    let light = (to - from) / f32::from(profile.lights);
    cover *= 1.0 - super::surface::stripes(at.u - from + 0.04, at.across, light, 0.08);
    let wheel = profile.wheel_distance(at.u, at.v);
    let disc = |radius: f32| ((radius - wheel) / blur + 0.5).clamp(0.0, 1.0);
    let shade = 0.75 + 0.25 * (at.v / 0.9).min(1.0);
    Material::matt(colour * shade)
        .paint(colour * 0.6, at.band(0.5, 0.56))
        .paint(GLASS, cover)
        .paint(Rgb::hex(0x1b1b1c), disc(profile.wheel_radius + 0.06))
        .paint(Rgb::hex(0x8d8f92), disc(profile.wheel_radius * 0.6))
        .paint(Rgb::hex(0x4a4b4d), disc(profile.wheel_radius * 0.2))
}

pub(super) fn end_paint(colour: Rgb, lamp: Rgb, at: &Glance) -> Material {
    let middle = at.width / 2.0;
    let low = at.height * 0.55;
    Material::matt(colour)
        .paint(lamp, at.within((0.1, 0.4), (low, low + 0.16)))
        .paint(lamp, at.within((at.width - 0.4, at.width - 0.1), (low, low + 0.16)))
        .paint(
            Rgb::hex(0xe9e6d0),
            at.within((middle - 0.26, middle + 0.26), (low - 0.2, low - 0.08)),
        )
        .paint(Rgb::hex(0x2a2b2d), at.band(0.0, 0.12))
}
