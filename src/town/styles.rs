//! The limited pool of building styles and shop brands the whole town draws from.
//!
//! The pool is small on purpose: identical terraces and chain shops in different streets are what
//! makes place recognition hard.

use super::geometry::Rgb;

/// What an outer wall is made of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Wall {
    Brick,
    Render,
    Ashlar,
    Boards,
    Concrete,
}

/// The shape over the top floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Roof {
    /// Hidden behind a parapet.
    Flat,
    /// Ridge along the street.
    Pitched,
    /// Ridge away from the street, a triangular gable in front.
    Gabled,
    /// A steep front slope with dormers.
    Mansard,
}

/// A way of building that recurs all over town. Lengths are in metres.
#[derive(Debug, PartialEq)]
pub(super) struct Style {
    pub wall: Wall,
    pub colours: [Rgb; 3],
    pub trim: Rgb,
    pub roof: Roof,
    pub roof_colour: Rgb,
    /// Target width of one window column.
    pub bay: f32,
    pub storey: f32,
    /// Width and height of an upper window.
    pub window: (f32, f32),
    /// Panes across and up.
    pub panes: (u8, u8),
    pub arched: bool,
    pub shutters: Option<Rgb>,
    /// A ledge runs below every row of windows.
    pub ledges: bool,
    pub cornice: f32,
}

pub(super) static STYLES: [Style; 8] = [
    // Brick terrace with white sashes.
    Style {
        wall: Wall::Brick,
        colours: [Rgb::hex(0xa65a45), Rgb::hex(0x8f4b3c), Rgb::hex(0xb06f52)],
        trim: Rgb::hex(0xe9e4d8),
        roof: Roof::Pitched,
        roof_colour: Rgb::hex(0x565a63),
        bay: 2.5,
        storey: 3.0,
        window: (1.15, 1.75),
        panes: (2, 2),
        arched: false,
        shutters: None,
        ledges: false,
        cornice: 0.25,
    },
    // Painted render with a parapet.
    Style {
        wall: Wall::Render,
        colours: [Rgb::hex(0xe6d3a8), Rgb::hex(0xb9cbd0), Rgb::hex(0xd9a69a)],
        trim: Rgb::hex(0xf5f1e8),
        roof: Roof::Flat,
        roof_colour: Rgb::hex(0x6a655f),
        bay: 2.7,
        storey: 3.2,
        window: (1.2, 2.0),
        panes: (2, 3),
        arched: false,
        shutters: None,
        ledges: true,
        cornice: 0.45,
    },
    // Yellow-stock warehouse with arched windows.
    Style {
        wall: Wall::Brick,
        colours: [Rgb::hex(0xbfa271), Rgb::hex(0xa98c62), Rgb::hex(0x94604a)],
        trim: Rgb::hex(0x3d4a4a),
        roof: Roof::Flat,
        roof_colour: Rgb::hex(0x5b5b5b),
        bay: 3.2,
        storey: 3.7,
        window: (2.1, 2.5),
        panes: (4, 3),
        arched: true,
        shutters: None,
        ledges: false,
        cornice: 0.55,
    },
    // Shuttered southern house.
    Style {
        wall: Wall::Render,
        colours: [Rgb::hex(0xd99a5b), Rgb::hex(0xe8c27a), Rgb::hex(0xc9785f)],
        trim: Rgb::hex(0xf0e6d2),
        roof: Roof::Pitched,
        roof_colour: Rgb::hex(0x9c5a43),
        bay: 2.9,
        storey: 3.0,
        window: (1.0, 1.7),
        panes: (2, 2),
        arched: false,
        shutters: Some(Rgb::hex(0x4f6f5d)),
        ledges: false,
        cornice: 0.2,
    },
    // Stone palace front under a mansard.
    Style {
        wall: Wall::Ashlar,
        colours: [Rgb::hex(0xcfc4ad), Rgb::hex(0xbdb3a2), Rgb::hex(0xd8c9a6)],
        trim: Rgb::hex(0xe6dfcf),
        roof: Roof::Mansard,
        roof_colour: Rgb::hex(0x5a6470),
        bay: 2.4,
        storey: 3.4,
        window: (1.2, 2.3),
        panes: (2, 1),
        arched: false,
        shutters: None,
        ledges: true,
        cornice: 0.5,
    },
    // Gabled canal house.
    Style {
        wall: Wall::Brick,
        colours: [Rgb::hex(0x6f4438), Rgb::hex(0x7d5a44), Rgb::hex(0x59423d)],
        trim: Rgb::hex(0xf3efe6),
        roof: Roof::Gabled,
        roof_colour: Rgb::hex(0x8a4b3a),
        bay: 2.1,
        storey: 3.1,
        window: (1.25, 2.0),
        panes: (3, 3),
        arched: false,
        shutters: None,
        ledges: false,
        cornice: 0.2,
    },
    // Painted boards.
    Style {
        wall: Wall::Boards,
        colours: [Rgb::hex(0x9fb3a3), Rgb::hex(0xdcd6c6), Rgb::hex(0x7f94a8)],
        trim: Rgb::hex(0xf2f0ea),
        roof: Roof::Gabled,
        roof_colour: Rgb::hex(0x4c4a4a),
        bay: 2.6,
        storey: 2.8,
        window: (1.1, 1.5),
        panes: (2, 2),
        arched: false,
        shutters: None,
        ledges: false,
        cornice: 0.2,
    },
    // Concrete block of the sixties with ribbon windows.
    Style {
        wall: Wall::Concrete,
        colours: [Rgb::hex(0xb4b1aa), Rgb::hex(0xa29f96), Rgb::hex(0xc4bfb2)],
        trim: Rgb::hex(0x4e565c),
        roof: Roof::Flat,
        roof_colour: Rgb::hex(0x6a6a6a),
        bay: 3.0,
        storey: 3.1,
        window: (2.6, 1.5),
        panes: (3, 1),
        arched: false,
        shutters: None,
        ledges: true,
        cornice: 0.3,
    },
];

/// A shop chain: the same front wherever it opens.
#[derive(Debug, PartialEq)]
pub(super) struct Brand {
    /// Only letters the sign font has.
    pub name: &'static str,
    pub board: Rgb,
    pub ink: Rgb,
    pub awning: Option<(Rgb, Rgb)>,
}

pub(super) const fn brand(
    name: &'static str,
    board: u32,
    ink: u32,
    awning: Option<(u32, u32)>,
) -> Brand {
    let awning = match awning {
        Some((one, other)) => Some((Rgb::hex(one), Rgb::hex(other))),
        None => None,
    };
    Brand { name, board: Rgb::hex(board), ink: Rgb::hex(ink), awning }
}

pub(super) static BRANDS: [Brand; 20] = [
    brand("BAKER & SON", 0x6b3f2a, 0xf6e7c8, Some((0xd8c9a8, 0x8a4b32))),
    brand("PHARMACY", 0x1f7a4d, 0xffffff, None),
    brand("CAFE LUNA", 0x23394f, 0xf2d27a, Some((0x2f5573, 0xe9e4d8))),
    brand("BOOKS", 0x7a1f2b, 0xf4ead6, None),
    brand("MARIO'S", 0xb3261e, 0xffffff, Some((0xc73a2e, 0xf2efe6))),
    brand("NOODLE BAR", 0x1c1c1f, 0xf04a3a, None),
    brand("FLOWERS", 0xd8a0b4, 0x3b2430, Some((0xe7c0cc, 0xf4f0ea))),
    brand("BARBER", 0xf0ede6, 0x1d3f7a, None),
    brand("HARDWARE", 0xe2a21b, 0x1a1a1a, None),
    brand("OPTICIAN", 0xe8eef2, 0x0f6f8f, None),
    brand("TEA HOUSE", 0x39563a, 0xeee3b8, Some((0x4d7350, 0x4d7350))),
    brand("FISH & CHIPS", 0x1f6fb0, 0xffffff, None),
    brand("CYCLES", 0xd9552b, 0xffffff, None),
    brand("TOYS", 0xf2c531, 0xc12a3a, Some((0xf2c531, 0xc94f3d))),
    brand("RECORDS", 0x2b2340, 0x9fd6c8, None),
    brand("PIZZA 21", 0x2c5d34, 0xfbe9c4, Some((0x3f7d46, 0xf1ece0))),
    brand("CITY BANK", 0x16304f, 0xdfe7ee, None),
    brand("GROCER", 0x4d7c2a, 0xfdf6dc, Some((0x5f9436, 0xeef0de))),
    brand("SHOE BOX", 0xe9dcc6, 0x5a3420, None),
    brand("EXPRESS 24", 0xe6e6e6, 0xc0182b, Some((0xb9202e, 0xb9202e))),
];
