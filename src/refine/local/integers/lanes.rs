//! The instructions that the comparison of integers needs, by processor.

use bytemuck::Pod;
use pulp::x86::{V3, V4};

/// The integers that an instruction works on.
pub(super) trait Lanes: Copy {
    type Vector: Pod;

    fn splat(self, number: i32) -> Self::Vector;

    /// Adds to each sum the two products of the 16-bit halves of `a` and `b`.
    fn add_products(self, a: Self::Vector, b: Self::Vector, sums: Self::Vector) -> Self::Vector;

    fn higher(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;

    /// Replaces the lowest bits of each sum, those that are not in `keep`, by those of `tag`.
    fn tagged(self, sums: Self::Vector, keep: Self::Vector, tag: Self::Vector) -> Self::Vector;
}

impl Lanes for V4 {
    type Vector = pulp::i32x16;

    #[inline(always)]
    fn splat(self, number: i32) -> Self::Vector {
        self.splat_i32x16(number)
    }

    #[inline(always)]
    fn add_products(self, a: Self::Vector, b: Self::Vector, sums: Self::Vector) -> Self::Vector {
        let (a, b) = (bytemuck::cast(a), bytemuck::cast(b));
        self.wrapping_add_i32x16(sums, self.multiply_wrapping_add_adjacent_i16x32(a, b))
    }

    #[inline(always)]
    fn higher(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
        self.max_i32x16(a, b)
    }

    #[inline(always)]
    fn tagged(self, sums: Self::Vector, keep: Self::Vector, tag: Self::Vector) -> Self::Vector {
        self.or_i32x16(self.and_i32x16(sums, keep), tag)
    }
}

impl Lanes for V3 {
    type Vector = pulp::i32x8;

    #[inline(always)]
    fn splat(self, number: i32) -> Self::Vector {
        self.splat_i32x8(number)
    }

    #[inline(always)]
    fn add_products(self, a: Self::Vector, b: Self::Vector, sums: Self::Vector) -> Self::Vector {
        let (a, b) = (bytemuck::cast(a), bytemuck::cast(b));
        self.wrapping_add_i32x8(sums, self.multiply_wrapping_add_adjacent_i16x16(a, b))
    }

    #[inline(always)]
    fn higher(self, a: Self::Vector, b: Self::Vector) -> Self::Vector {
        self.max_i32x8(a, b)
    }

    #[inline(always)]
    fn tagged(self, sums: Self::Vector, keep: Self::Vector, tag: Self::Vector) -> Self::Vector {
        self.or_i32x8(self.and_i32x8(sums, keep), tag)
    }
}
