//! Time of day: sun, sky, street lamps, lit windows, cast shadows and the camera's exposure.

use super::camera::Camera;
use super::dice::{Dice, drift, floor, speckle};
use super::geometry::{Rgb, Vec3, vec3};
use super::layout::{FRONT, Fixture, Lot, PAVEMENT_HEIGHT, STREET_END, STREET_START, Street};

/// Lighting conditions of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Light {
    /// Sun with cast shadows.
    Day,
    /// Even grey light.
    Overcast,
    /// A low warm sky, first lamps and windows lit.
    Dusk,
    /// Street lamps, lit windows and signs only.
    Night,
}

impl Light {
    pub(super) const ALL: [Light; 4] = [Light::Day, Light::Overcast, Light::Dusk, Light::Night];
}

/// Lights inside buildings and what their glass reflects.
pub(super) struct Indoors {
    /// Share of windows that are lit.
    share: f32,
    pub lamp: f32,
    shop: f32,
    /// Light given off by sign boards, per unit of reflectance.
    pub signs: f32,
    pub reflection: Rgb,
    seed: u32,
}

impl Indoors {
    pub fn is_lit(&self, column: i32, row: i32, building: u32) -> bool {
        speckle(column, row, building ^ self.seed) < self.share
    }

    /// Brightness behind a shop window; some shops are closed.
    pub fn shop_glow(&self, building: u32) -> f32 {
        let open = speckle(0, 1, building ^ self.seed) < 0.75;
        if open { self.shop } else { self.shop * 0.15 }
    }
}

/// The illumination of a surface that is constant over its points, given its orientation.
pub(super) struct Turned {
    normal: Vec3,
    /// Arriving from the sky under which nothing stands.
    ambient: Rgb,
    /// Arriving from the sun where nothing casts a shadow.
    sun: Rgb,
    is_sunny: bool,
}

/// The illumination of one street at one moment.
pub(super) struct Lighting {
    /// Towards the sun.
    pub sun_direction: Vec3,
    /// Whether the sun casts shadows.
    pub has_sun: bool,
    sun: Rgb,
    ambient: Rgb,
    zenith: Rgb,
    pub horizon: Rgb,
    clouds: f32,
    cloud_shift: (f32, f32),
    lamps: Vec<Vec3>,
    lamp_power: f32,
    pub indoors: Indoors,
    /// Radiance is multiplied by this, per channel, before it is developed.
    pub exposure: Rgb,
    /// Standard deviation of sensor noise, in display levels of 255.
    pub noise: f32,
    roofline: Roofline,
}

impl Lighting {
    pub fn new(light: Light, street: &Street, camera: &Camera, dice: &mut Dice) -> Lighting {
        let mood = Mood::of(light);
        let azimuth = f64::from(dice.between(100.0, 260.0).to_radians());
        let elevation = dice.between(0.6, 0.95);
        let balance = Rgb::new(1.0 + dice.around(0.08), 1.0, 1.0 + dice.around(0.08));
        let sun_direction = street.towards(azimuth, elevation);
        Lighting {
            sun_direction,
            has_sun: mood.sun != Rgb::BLACK,
            sun: mood.sun,
            ambient: mood.ambient,
            zenith: mood.zenith,
            horizon: mood.horizon,
            clouds: mood.clouds,
            cloud_shift: (dice.between(0.0, 500.0), dice.between(0.0, 500.0)),
            lamps: lamp_heads(street, camera),
            lamp_power: mood.lamps,
            indoors: Indoors {
                share: mood.lit,
                lamp: mood.indoors,
                shop: mood.shops,
                signs: mood.signs,
                reflection: mood.zenith.mix(mood.horizon, 0.5),
                seed: dice.bits() as u32,
            },
            exposure: balance * (mood.exposure * (1.0 + dice.around(0.2))),
            noise: mood.noise,
            roofline: Roofline::new(street, sun_direction),
        }
    }

    /// The constant illumination of a surface with the given normal.
    pub fn turned(&self, normal: Vec3) -> Turned {
        let facing = normal.dot(self.sun_direction).max(0.0);
        Turned {
            normal,
            ambient: self.ambient * (0.62 + 0.38 * normal.z),
            sun: self.sun * facing,
            is_sunny: self.has_sun && facing > 0.0,
        }
    }

    /// Light arriving at a point of a surface.
    #[inline]
    pub fn irradiance(&self, point: Vec3, turned: &Turned) -> Rgb {
        let canyon = 0.72 + 0.28 * (point.z * (1.0 / 9.0)).clamp(0.0, 1.0);
        let mut light = turned.ambient * canyon;
        if turned.is_sunny {
            light = light + turned.sun * (1.0 - self.roofline.shade(point));
        }
        if self.lamp_power > 0.0 {
            light = light + self.lamplight(point, turned.normal);
        }
        light
    }

    fn lamplight(&self, point: Vec3, normal: Vec3) -> Rgb {
        const SODIUM: Rgb = Rgb::hex(0xffd9a0);
        let received: f32 = self
            .lamps
            .iter()
            .filter(|lamp| (lamp.x - point.x).abs() < 26.0)
            .map(|&lamp| {
                let towards = lamp - point;
                let squared = towards.dot(towards);
                let distance = squared.sqrt();
                // Half Lambert: bounced light wraps around what the lamp does not reach. Both
                // terms are over the distance, which takes one division instead of two.
                let facing = 0.35 * distance + 0.65 * towards.dot(normal).max(0.0);
                facing / (distance * (squared + 6.0))
            })
            .sum();
        SODIUM * (received * self.lamp_power)
    }

    /// The sky in a direction.
    pub fn sky(&self, ray: Vec3) -> Rgb {
        let ray = ray.unit();
        let height = ray.z.max(0.02);
        let clear = self.horizon.mix(self.zenith, (height * 1.6).min(1.0));
        if self.clouds == 0.0 {
            return clear;
        }
        let (x, y) = (
            ray.x / (height + 0.12) + self.cloud_shift.0,
            ray.y / (height + 0.12) + self.cloud_shift.1,
        );
        let billow = 0.65 * drift(x, y, 3) + 0.35 * drift(x * 2.7, y * 2.7, 4);
        let cover = ((billow - 0.45) * 4.0).clamp(0.0, 1.0) * self.clouds;
        let white = self.horizon * 1.15 + Rgb::new(0.04, 0.04, 0.04);
        clear.mix(white, cover)
    }
}

/// The constants of a time of day.
struct Mood {
    sun: Rgb,
    ambient: Rgb,
    zenith: Rgb,
    horizon: Rgb,
    clouds: f32,
    lamps: f32,
    lit: f32,
    indoors: f32,
    shops: f32,
    signs: f32,
    exposure: f32,
    noise: f32,
}

impl Mood {
    fn of(light: Light) -> Mood {
        match light {
            Light::Day => Mood {
                sun: Rgb::new(1.05, 0.97, 0.84),
                ambient: Rgb::new(0.55, 0.59, 0.66),
                zenith: Rgb::hex(0x6f9fd6),
                horizon: Rgb::hex(0xcfe0ee),
                clouds: 0.8,
                lamps: 0.0,
                lit: 0.0,
                indoors: 0.0,
                shops: 0.22,
                signs: 0.0,
                exposure: 1.0,
                noise: 1.6,
            },
            Light::Overcast => Mood {
                sun: Rgb::BLACK,
                ambient: Rgb::new(0.78, 0.81, 0.84),
                zenith: Rgb::hex(0xc3c8cc),
                horizon: Rgb::hex(0xdfe2e4),
                clouds: 0.5,
                lamps: 0.0,
                lit: 0.04,
                indoors: 0.7,
                shops: 0.3,
                signs: 0.0,
                exposure: 0.92,
                noise: 2.2,
            },
            Light::Dusk => Mood {
                sun: Rgb::BLACK,
                ambient: Rgb::new(0.38, 0.36, 0.46),
                zenith: Rgb::hex(0x4a5a86),
                horizon: Rgb::hex(0xeea882),
                clouds: 0.45,
                lamps: 5.0,
                lit: 0.3,
                indoors: 0.75,
                shops: 0.75,
                signs: 0.3,
                exposure: 1.1,
                noise: 3.2,
            },
            Light::Night => Mood {
                sun: Rgb::BLACK,
                ambient: Rgb::new(0.075, 0.085, 0.12),
                zenith: Rgb::hex(0x141a2b),
                horizon: Rgb::hex(0x3a3542),
                clouds: 0.0,
                lamps: 13.0,
                lit: 0.4,
                indoors: 0.8,
                shops: 0.9,
                signs: 0.55,
                exposure: 1.15,
                noise: 5.5,
            },
        }
    }
}

/// Height of a lamp's head above the pavement, in metres.
pub(super) const LAMP_HEIGHT: f32 = 5.4;

/// Lamp heads hang out over the road.
pub(super) fn lamp_head(foot: Vec3) -> Vec3 {
    vec3(foot.x, foot.y - foot.y.signum() * 1.1, PAVEMENT_HEIGHT + LAMP_HEIGHT)
}

fn lamp_heads(street: &Street, camera: &Camera) -> Vec<Vec3> {
    street
        .fixtures
        .iter()
        .filter(|(kind, _)| *kind == Fixture::Lamp)
        .map(|&(_, foot)| lamp_head(foot))
        .filter(|&head| camera.may_see(head, 20.0))
        .collect()
}

/// Heights of the buildings on the sun's side, for the shadows they cast across the street.
struct Roofline {
    heights: Vec<f32>,
    /// Where the buildings stand: y in metres.
    line: f32,
    sun: Vec3,
    /// Metres along the sun's direction per metre of y.
    per_y: f32,
}

impl Roofline {
    const STEP: f32 = 0.5;

    fn new(street: &Street, sun: Vec3) -> Roofline {
        let samples = ((STREET_END - STREET_START) / Self::STEP) as usize + 1;
        let mut heights = vec![0.0; samples];
        for lot in &street.lots {
            let Lot::Built(building) = lot else { continue };
            if building.at.away.y * sun.y <= 0.0 {
                continue;
            }
            let index = |x: f32| (((x - STREET_START) / Self::STEP).max(0.0) as usize).min(samples);
            let (start, end) = building.at.x_range();
            heights[index(start)..index(end)].fill(building.eaves());
        }
        // A sun straight along the street meets no roof.
        let per_y = if sun.y.abs() < 1e-3 { f32::INFINITY } else { 1.0 / sun.y };
        Roofline { heights, line: FRONT * sun.y.signum(), sun, per_y }
    }

    /// How much of the sun the buildings take from a point, in `0.0..=1.0`.
    #[inline]
    fn shade(&self, point: Vec3) -> f32 {
        let distance = (self.line - point.y) * self.per_y;
        if !(0.0..1e4).contains(&distance) {
            return 0.0;
        }
        let roof = self.height(point.x + self.sun.x * distance);
        ((roof - (point.z + self.sun.z * distance)) * 4.0 + 0.5).clamp(0.0, 1.0)
    }

    #[inline]
    fn height(&self, x: f32) -> f32 {
        let position = (x - STREET_START) * (1.0 / Self::STEP);
        let index = floor(position);
        let at = |index: i32| self.heights.get(index as usize).copied().unwrap_or(0.0);
        let low = at(index);
        low + (at(index.wrapping_add(1)) - low) * (position - index as f32)
    }
}
