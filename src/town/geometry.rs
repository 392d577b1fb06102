//! Points, colours and flat rectangles in a street's own frame: x along the street, y to its
//! left, z up, all in metres.

use std::ops::{Add, Mul, Sub};

/// The float nearest to a whole number `n` of magnitude below 2²², plus this, has `n` in its low
/// bits.
pub(super) const ROUNDER: f32 = 12_582_912.0;

/// A point or direction, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Vec3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

pub(super) const fn vec3(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3 { x, y, z }
}

impl Vec3 {
    pub const EAST: Vec3 = vec3(1.0, 0.0, 0.0);
    pub const NORTH: Vec3 = vec3(0.0, 1.0, 0.0);
    pub const UP: Vec3 = vec3(0.0, 0.0, 1.0);

    #[inline]
    pub fn dot(self, other: Vec3) -> f32 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    #[inline]
    pub fn cross(self, other: Vec3) -> Vec3 {
        vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )
    }

    #[inline]
    pub fn unit(self) -> Vec3 {
        self * (1.0 / self.dot(self).sqrt().max(f32::MIN_POSITIVE))
    }
}

impl Add for Vec3 {
    type Output = Vec3;
    #[inline]
    fn add(self, other: Vec3) -> Vec3 {
        vec3(self.x + other.x, self.y + other.y, self.z + other.z)
    }
}

impl Sub for Vec3 {
    type Output = Vec3;
    #[inline]
    fn sub(self, other: Vec3) -> Vec3 {
        vec3(self.x - other.x, self.y - other.y, self.z - other.z)
    }
}

impl Mul<f32> for Vec3 {
    type Output = Vec3;
    #[inline]
    fn mul(self, by: f32) -> Vec3 {
        vec3(self.x * by, self.y * by, self.z * by)
    }
}

/// A rectangle in space: `corner + u * along + v * up` for `u` in `0..width`, `v` in `0..height`.
/// `along` and `up` are orthogonal unit vectors, so `u` and `v` are metres on the surface.
#[derive(Clone, Copy)]
pub(super) struct Panel {
    pub corner: Vec3,
    pub along: Vec3,
    pub up: Vec3,
    pub width: f32,
    pub height: f32,
}

impl Panel {
    /// Spans from `corner` by two orthogonal edge vectors.
    pub fn spanning(corner: Vec3, across: Vec3, rise: Vec3) -> Panel {
        Panel {
            corner,
            along: across.unit(),
            up: rise.unit(),
            width: across.dot(across).sqrt(),
            height: rise.dot(rise).sqrt(),
        }
    }

    /// A vertical rectangle over the floor line from `from` to `to`.
    pub fn upright(from: Vec3, to: Vec3, height: f32) -> Panel {
        Panel::spanning(from, to - from, Vec3::UP * height)
    }

    #[inline]
    pub fn point(&self, u: f32, v: f32) -> Vec3 {
        self.corner + self.along * u + self.up * v
    }

    #[inline]
    pub fn normal(&self) -> Vec3 {
        self.along.cross(self.up)
    }

    pub fn corners(&self) -> [Vec3; 4] {
        [
            self.point(0.0, 0.0),
            self.point(self.width, 0.0),
            self.point(self.width, self.height),
            self.point(0.0, self.height),
        ]
    }
}

/// A colour in linear light, 1.0 being white paper in full daylight.
///
/// The fourth lane is padding: four aligned lanes compile to single vector instructions, and
/// colour arithmetic is most of the renderer's work.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(16))]
pub(super) struct Rgb([f32; 4]);

impl Rgb {
    pub const BLACK: Rgb = Rgb::new(0.0, 0.0, 0.0);

    pub const fn new(red: f32, green: f32, blue: f32) -> Rgb {
        Rgb([red, green, blue, 0.0])
    }

    /// From a display colour `0xRRGGBB`, with the display gamma taken as 2.
    pub const fn hex(code: u32) -> Rgb {
        const fn channel(byte: u32) -> f32 {
            let level = (byte & 255) as f32 / 255.0;
            level * level
        }
        Rgb::new(channel(code >> 16), channel(code >> 8), channel(code))
    }

    /// The nearest display levels in `0..=255`.
    #[inline]
    pub fn bytes(self) -> [u8; 3] {
        // A float-to-integer cast of Rust is three instructions a lane, which do not pack.
        let [red, green, blue, _] = self.map(|level| level.clamp(0.0, 255.0) + ROUNDER).0;
        [red.to_bits() as u8, green.to_bits() as u8, blue.to_bits() as u8]
    }

    #[inline]
    pub fn map(self, change: impl Fn(f32) -> f32) -> Rgb {
        let Rgb([red, green, blue, spare]) = self;
        Rgb([change(red), change(green), change(blue), change(spare)])
    }

    #[inline]
    pub fn mix(self, other: Rgb, share: f32) -> Rgb {
        self.zip(other, |mine, theirs| mine + (theirs - mine) * share)
    }

    #[inline]
    pub fn tint(self, by: Rgb) -> Rgb {
        self.zip(by, |level, factor| level * factor)
    }

    /// Whether two shades differ too little to see a step between them.
    #[inline]
    pub fn is_close(self, other: Rgb) -> bool {
        const TOLERANCE: f32 = 0.08;
        let excess = self
            .zip(other, |one, another| (one - another).abs() - TOLERANCE * (one + another) - 0.001);
        let [red, green, blue, _] = excess.0;
        (red < 0.0) & (green < 0.0) & (blue < 0.0)
    }

    #[inline]
    fn zip(self, other: Rgb, combine: impl Fn(f32, f32) -> f32) -> Rgb {
        let (Rgb(a), Rgb(b)) = (self, other);
        Rgb([combine(a[0], b[0]), combine(a[1], b[1]), combine(a[2], b[2]), combine(a[3], b[3])])
    }
}

impl Add for Rgb {
    type Output = Rgb;
    #[inline]
    fn add(self, other: Rgb) -> Rgb {
        self.zip(other, |one, another| one + another)
    }
}

impl Mul<f32> for Rgb {
    type Output = Rgb;
    #[inline]
    fn mul(self, by: f32) -> Rgb {
        self.map(|level| level * by)
    }
}
