//! Repeatable randomness: everything in the town is a pure function of a seed.
//!
//! [`Dice`] draws the discrete choices of a layout; [`speckle`] and [`drift`] are the noise that
//! textures are made of. Neither keeps state outside the value, so a place can be built without
//! building the places before it.

use super::geometry::{ROUNDER, Rgb};

/// A stream of draws. Copies continue independently from the same point.
#[derive(Clone, Copy)]
pub(super) struct Dice(u64);

impl Dice {
    pub fn new(seed: u64) -> Self {
        Dice(scramble(seed))
    }

    /// An independent stream named by `tag`, unaffected by how many draws were made elsewhere
    /// after the same point.
    pub fn fork(self, tag: u64) -> Self {
        Dice(scramble(self.0 ^ scramble(tag.wrapping_add(0x51ed_270b_9f5c_0e37))))
    }

    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        scramble(self.0)
    }

    /// Uniform in `0.0..1.0`.
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u32 << 24) as f32
    }

    pub fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.unit()
    }

    /// Triangular in `-reach..reach`: small deviations are likelier than large ones.
    pub fn around(&mut self, reach: f32) -> f32 {
        (self.unit() - self.unit()) * reach
    }

    /// Uniform in `0..count`; 0 when `count` is 0.
    pub fn below(&mut self, count: usize) -> usize {
        ((self.unit() * count as f32) as usize).min(count.saturating_sub(1))
    }

    pub fn chance(&mut self, probability: f32) -> bool {
        self.unit() < probability
    }

    pub fn pick<T: Copy, const N: usize>(&mut self, from: &[T; N]) -> T {
        const { assert!(N > 0) };
        from[self.below(N)]
    }
}

/// The finaliser of splitmix64 (Steele, Lea and Flood, 2014).
const fn scramble(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// White noise in `0.0..1.0` on the integer lattice.
#[inline]
pub(super) fn speckle(x: i32, y: i32, seed: u32) -> f32 {
    (hash(x, y, seed) >> 8) as f32 * (1.0 / (1u32 << 24) as f32)
}

/// Three draws, uniform in `-0.5..0.5`.
#[inline]
pub(super) fn grain(x: i32, y: i32, seed: u32) -> Rgb {
    let bits = hash(x, y, seed);
    let draw = |shift: u32| (bits >> shift & 1023) as f32 * (1.0 / 1023.0) - 0.5;
    Rgb::new(draw(0), draw(10), draw(20))
}

#[inline]
fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9e37_79b1)
        ^ (y as u32).wrapping_mul(0x85eb_ca77)
        ^ seed.wrapping_mul(0xc2b2_ae3d);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 13)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 16)
}

/// Smooth noise in `0.0..1.0` with features about one unit across, repeating every 64 units.
#[inline]
pub(super) fn drift(x: f32, y: f32, seed: u32) -> f32 {
    let (left, bottom) = (floor(x), floor(y));
    let ease = |t: f32| t * t * (3.0 - 2.0 * t);
    let (fx, fy) = (ease(x - whole(x)), ease(y - whole(y)));
    let start = (left as u32).wrapping_add(seed);
    let row = |y: u32| {
        let line = &LATTICE[(y.wrapping_add(seed >> 6) % SIDE) as usize];
        let low = line[(start % SIDE) as usize];
        low + (line[(start.wrapping_add(1) % SIDE) as usize] - low) * fx
    };
    let low = row(bottom as u32);
    low + (row((bottom as u32).wrapping_add(1)) - low) * fy
}

const SIDE: u32 = 64;

/// White noise for [`drift`] to interpolate: looking it up costs a third of hashing it.
static LATTICE: [[f32; SIDE as usize]; SIDE as usize] = {
    let mut lattice = [[0.0; SIDE as usize]; SIDE as usize];
    let mut index = 0;
    while index < (SIDE * SIDE) as usize {
        let bits = scramble(index as u64 + 1) >> 40;
        lattice[index / SIDE as usize][index % SIDE as usize] = bits as f32 / (1u32 << 24) as f32;
        index += 1;
    }
    lattice
};

/// `f32::floor` as an integer, for magnitudes below 2²²; an odd whole number may count as the end
/// of the cell below it.
///
/// The innermost arithmetic of every texture: adding 1.5 × 2²³ leaves the rounded value in the
/// low bits, where the intrinsic is a library call on baseline x86-64.
#[inline]
pub(super) fn floor(x: f32) -> i32 {
    (x - 0.5 + ROUNDER).to_bits().wrapping_sub(ROUNDER.to_bits()) as i32
}

/// [`floor`] as a float.
#[inline]
pub(super) fn whole(x: f32) -> f32 {
    (x - 0.5 + ROUNDER) - ROUNDER
}
