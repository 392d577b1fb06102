//! The fronts of buildings, evaluated point by point with analytic filtering.

use super::dice::{drift, floor, speckle};
use super::font;
use super::geometry::Rgb;
use super::layout::{Building, GroundFloor};
use super::light::Indoors;
use super::styles::Brand;
use super::surface::{Glance, Material, wall};

/// How far window panes lie behind the wall, in metres.
const REVEAL: f32 = 0.16;
/// How far goods stand behind a shop window, in metres.
const DISPLAY: f32 = 0.7;

const DARK_ROOM: Rgb = Rgb::hex(0x23272b);

/// A rectangular hole in a wall, in metres on the façade.
#[derive(Clone, Copy)]
struct Opening {
    left: f32,
    right: f32,
    bottom: f32,
    top: f32,
    /// Names the opening among all of the building's.
    id: (i32, i32),
}

impl Opening {
    fn sides(&self) -> (f32, f32) {
        (self.left, self.right)
    }

    fn levels(&self) -> (f32, f32) {
        (self.bottom, self.top)
    }

    fn width(&self) -> f32 {
        self.right - self.left
    }

    fn inset(&self, by: f32) -> Opening {
        Opening {
            left: self.left + by,
            right: self.right - by,
            bottom: self.bottom + by,
            top: self.top - by,
            ..*self
        }
    }
}

pub(super) fn facade(building: &Building, at: &Glance, indoors: &Indoors) -> Material {
    let material = if at.v < building.ground_height() {
        match building.ground {
            GroundFloor::Shop(brand) => shop_front(building, brand, at, indoors),
            GroundFloor::Home { door_bay, door } => {
                home_front(building, (door_bay, door), bare(building, at), at, indoors)
            }
        }
    } else {
        upper_floors(building, at, indoors)
    };
    weathered(building, trimmed(building, material, at), at)
}

fn bare(building: &Building, at: &Glance) -> Material {
    let style = building.style;
    Material::matt(wall(style.wall, building.colour, building.seed, at))
}

/// String courses, cornice and the drainpipe.
fn trimmed(building: &Building, mut material: Material, at: &Glance) -> Material {
    let style = building.style;
    let ground = building.ground_height();
    let eaves = building.eaves();
    let cornice = eaves - style.cornice;
    if at.band(ground + 0.14, cornice - 0.07) < 1.0 {
        material = material
            .paint(style.trim * 0.9, at.band(cornice, eaves))
            .paint(style.trim * 0.35, at.band(cornice - 0.07, cornice))
            .paint(style.trim * 0.45, at.band(eaves - 0.16, eaves - 0.12))
            .paint(style.trim * 0.85, at.band(ground - 0.02, ground + 0.14));
    }
    let pipe = if building.mirrored { 0.18 } else { building.at.width - 0.18 };
    material.paint(Rgb::hex(0x3b3b3d), at.within((pipe - 0.05, pipe + 0.05), (0.0, cornice)) * 0.9)
}

/// Dirt gathers at the foot of a wall, shade under the eaves.
fn weathered(building: &Building, mut material: Material, at: &Glance) -> Material {
    let foot = (1.0 - at.v / 0.9).max(0.0) * 0.35;
    let crown = (1.0 - (building.eaves() - at.v) / 1.2).max(0.0) * 0.15;
    material.albedo = material.albedo * (1.0 - foot - crown);
    material
}

fn upper_floors(building: &Building, at: &Glance, indoors: &Indoors) -> Material {
    let style = building.style;
    let ground = building.ground_height();
    let floor_index = floor((at.v - ground) / style.storey);
    if floor_index >= building.floors as i32 {
        return bare(building, at);
    }
    let base = ground + floor_index as f32 * style.storey;
    let (width, height) = style.window;
    let (left, bay) = bay_at(building, at.u);
    let middle = left + bay_width(building) / 2.0;
    let sill = base + (style.storey - height) * 0.5;
    let opening = Opening {
        left: middle - width / 2.0,
        right: middle + width / 2.0,
        bottom: sill,
        top: sill + height,
        id: (bay, floor_index + 1),
    };
    if hole(building, &opening, at) >= 1.0 {
        return window(building, &opening, Material::matt(Rgb::BLACK), at, indoors);
    }
    let mut material = bare(building, at);
    if style.ledges {
        material = material.paint(style.trim * 0.8, at.band(sill - 0.16, sill - 0.02));
    }
    if let Some(colour) = style.shutters {
        material = shutters(&opening, colour, material, at);
    }
    material = surround(&opening, style.trim, material, at);
    window(building, &opening, material, at, indoors)
}

fn bay_width(building: &Building) -> f32 {
    (building.at.width - 0.5) / building.bays as f32
}

/// Left edge and number of the window column at `u`.
fn bay_at(building: &Building, u: f32) -> (f32, i32) {
    let bay = bay_width(building);
    let index = floor((u - 0.25) / bay).clamp(0, building.bays as i32 - 1);
    (0.25 + index as f32 * bay, index)
}

fn shutters(opening: &Opening, colour: Rgb, mut material: Material, at: &Glance) -> Material {
    let leaf = opening.width() * 0.48;
    let slats = 1.0 - 0.3 * super::surface::stripes(at.v, at.rise, 0.12, 0.04);
    for left in [opening.left - leaf - 0.04, opening.right + 0.04] {
        let cover = at.within((left, left + leaf), opening.levels());
        material = material.paint(colour * slats, cover);
    }
    material
}

/// Sill and lintel.
fn surround(opening: &Opening, trim: Rgb, material: Material, at: &Glance) -> Material {
    let wide = (opening.left - 0.12, opening.right + 0.12);
    let (bottom, top) = opening.levels();
    if at.within(wide, (bottom - 0.16, top + 0.2)) <= 0.0 {
        return material;
    }
    material
        .paint(trim * 0.82, at.within(wide, (top, top + 0.2)))
        .paint(trim * 0.95, at.within(wide, (bottom - 0.1, bottom)))
        .paint(trim * 0.25, at.within(wide, (bottom - 0.16, bottom - 0.1)))
}

fn window(
    building: &Building,
    opening: &Opening,
    material: Material,
    at: &Glance,
    indoors: &Indoors,
) -> Material {
    let hole = hole(building, opening, at);
    if hole <= 0.0 {
        return material;
    }
    let pane = at.behind(REVEAL);
    let visible = pane.within(opening.sides(), opening.levels());
    let reveal = Material::matt(building.colour * 0.45);
    let trim = building.style.trim;
    let glass = opening.inset(0.07);
    let clear = pane.within(glass.sides(), glass.levels()) * (1.0 - bars(building, &glass, &pane));
    let room = room(building, opening, &pane, indoors);
    let sash = Material::matt(trim * 0.8).mix(room, clear);
    material.mix(reveal.mix(sash, visible), hole)
}

/// Share of the pixel inside a window, under its arch if it has one.
fn hole(building: &Building, opening: &Opening, at: &Glance) -> f32 {
    let mut top = opening.top;
    if building.style.arched {
        let off_centre = (at.u - (opening.left + opening.right) / 2.0) / opening.width() * 2.0;
        top -= 0.22 * opening.width() * (off_centre * off_centre).min(1.0);
    }
    at.within(opening.sides(), (opening.bottom, top))
}

/// Share of the pixel covered by glazing bars.
fn bars(building: &Building, glass: &Opening, pane: &Glance) -> f32 {
    const BAR: f32 = 0.045;
    let (columns, rows) = building.style.panes;
    let across = (glass.right - glass.left) / f32::from(columns);
    let up = (glass.top - glass.bottom) / f32::from(rows);
    let upright =
        super::surface::stripes(pane.u - glass.left + BAR / 2.0, pane.across, across, BAR);
    let level = super::surface::stripes(pane.v - glass.bottom + BAR / 2.0, pane.rise, up, BAR);
    upright.max(level).min(1.0)
}

/// What is seen through an upper window: a dark room, a blind or curtains, and the sky's
/// reflection over them; or the lamp inside after dark.
fn room(building: &Building, opening: &Opening, pane: &Glance, indoors: &Indoors) -> Material {
    let (column, row) = opening.id;
    let draw = |tag: u32| speckle(column, row, building.seed ^ tag.wrapping_mul(0x9e37));
    let height = opening.top - opening.bottom;
    let mut room = Material::matt(DARK_ROOM * (0.6 + draw(1)));
    let drapes = Rgb::hex(0xd8d0c0).mix(Rgb::hex(0x9c6a58), draw(2) * draw(2));
    if draw(3) < 0.45 {
        let hem = opening.bottom + height * (0.25 + 0.6 * draw(4));
        room = room.paint(drapes * 0.6, pane.band(hem, opening.top));
    } else if draw(3) < 0.75 {
        let gather = opening.width() * (0.16 + 0.14 * draw(4));
        let open = (opening.left + gather, opening.right - gather);
        room = room.paint(drapes * 0.55, 1.0 - pane.within(open, opening.levels()));
    }
    if indoors.is_lit(column, row, building.seed) {
        let warmth = Rgb::hex(0xffc46b).mix(Rgb::hex(0xfff0cf), draw(5));
        let fall = 0.65 + 0.5 * (pane.v - opening.bottom) / height;
        room.glow =
            (room.albedo * 1.2 + Rgb::new(0.25, 0.25, 0.25)).tint(warmth) * (fall * indoors.lamp);
    }
    let mirror = 0.12 + 0.03 * pane.point.z.min(12.0);
    let wobble = 0.6 + 0.8 * drift(pane.u * 0.7, pane.v * 0.5, building.seed ^ 0x51);
    room.glow = room.glow + indoors.reflection * (mirror * wobble);
    room
}

fn home_front(
    building: &Building,
    (door_bay, colour): (usize, Rgb),
    material: Material,
    at: &Glance,
    indoors: &Indoors,
) -> Material {
    let style = building.style;
    let (left, bay) = bay_at(building, at.u);
    let middle = left + bay_width(building) / 2.0;
    let plinth = material.paint(style.trim * 0.55, at.band(0.0, 0.35));
    if bay == door_bay as i32 {
        return door(middle, colour, style.trim, plinth, at);
    }
    let half = style.window.0.min(1.5) / 2.0;
    let opening = Opening {
        left: middle - half,
        right: middle + half,
        bottom: 0.85,
        top: 2.65,
        id: (bay, 0),
    };
    let framed = surround(&opening, style.trim, plinth, at);
    window(building, &opening, framed, at, indoors)
}

fn door(middle: f32, colour: Rgb, trim: Rgb, material: Material, at: &Glance) -> Material {
    let span = |half: f32| (middle - half, middle + half);
    let panel = |left: f32, bottom: f32, top: f32| {
        at.within((middle + left, middle + left + 0.32), (bottom, top))
    };
    let panels = panel(-0.38, 0.3, 0.95)
        + panel(0.06, 0.3, 0.95)
        + panel(-0.38, 1.1, 1.95)
        + panel(0.06, 1.1, 1.95);
    material
        .paint(trim * 0.9, at.within(span(0.68), (0.0, 2.85)))
        .paint(DARK_ROOM, at.within(span(0.48), (2.25, 2.65)))
        .paint(colour, at.within(span(0.48), (0.15, 2.15)))
        .paint(colour * 0.6, panels)
        .paint(Rgb::hex(0xb9b4aa), at.within(span(0.6), (0.0, 0.15)))
}

fn shop_front(
    building: &Building,
    brand: &'static Brand,
    at: &Glance,
    indoors: &Indoors,
) -> Material {
    let width = building.at.width;
    // Only narrow piers of the wall show beside the joinery.
    let material = Material::matt(building.colour * 0.9);
    let frame = brand.board * 0.75;
    let board = board_of(building);
    if at.v > board.0 - 0.08 {
        return fascia(building, brand, material, at, indoors);
    }
    let joinery = material.paint(frame, at.within((0.12, width - 0.12), (0.0, board.0)));
    let door = if building.mirrored { (width - 1.45, width - 0.45) } else { (0.45, 1.45) };
    let (left, right) =
        if building.mirrored { (0.4, door.0 - 0.15) } else { (door.1 + 0.15, width - 0.4) };
    let pane = Opening { left, right, bottom: 0.55, top: board.0 - 0.15, id: (0, 0) };
    let entrance = Opening { left: door.0, right: door.1, bottom: 0.12, top: 2.3, id: (1, 0) };
    let with_pane = display(building, &pane, joinery, at, indoors);
    display(building, &entrance, with_pane, at, indoors)
}

/// Bottom and top of the sign board over a shop.
fn board_of(building: &Building) -> (f32, f32) {
    let ground = building.ground_height();
    (ground - 0.95, ground - 0.12)
}

/// Where a text is on the sign board over a shop: left, right, bottom and top, in metres of the facade.
pub(super) fn fascia_text(building: &Building, text: &str) -> (f32, f32, f32, f32) {
    let (bottom, top) = board_of(building);
    let width = building.at.width;
    let size = 0.52_f32.min((width - 0.9) / font::text_width(text));
    let start = (width - font::text_width(text) * size) / 2.0;
    let baseline = (bottom + top - size) / 2.0;
    (start, width - start, baseline, baseline + size)
}

/// The sign board over a shop, with its name.
fn fascia(
    building: &Building,
    brand: &'static Brand,
    material: Material,
    at: &Glance,
    indoors: &Indoors,
) -> Material {
    let (bottom, top) = board_of(building);
    let sides = (0.12, building.at.width - 0.12);
    let (start, _, baseline, above) = fascia_text(building, brand.name);
    let size = above - baseline;
    let blur = at.across.max(at.rise);
    let letters = match building.is_lettered {
        true => font::ink(brand.name, (at.u - start) / size, (at.v - baseline) / size, blur / size),
        false => 0.0,
    };
    let mut face = Material::matt(brand.board).paint(brand.ink, letters);
    face.glow = face.albedo * indoors.signs;
    material
        .paint(brand.board * 0.35, at.within(sides, (bottom - 0.08, top)))
        .mix(face, at.within(sides, (bottom, top)))
}

/// A shop window: goods on shelves some way behind the glass.
fn display(
    building: &Building,
    pane: &Opening,
    material: Material,
    at: &Glance,
    indoors: &Indoors,
) -> Material {
    let hole = at.within(pane.sides(), pane.levels());
    if hole <= 0.0 {
        return material;
    }
    let goods = at.behind(DISPLAY);
    let (column, row) = (floor(goods.u / 0.55), floor(goods.v / 0.6));
    let draw = |tag: u32| speckle(column, row, building.seed ^ tag.wrapping_mul(0x85eb));
    let colour = Rgb::new(draw(1), draw(2), draw(3)) * 0.5;
    let foot = (column as f32 * 0.55, row as f32 * 0.6);
    let item = goods.within(
        (foot.0 + 0.06, foot.0 + 0.28 + 0.24 * draw(4)),
        (foot.1, foot.1 + 0.2 + 0.35 * draw(5)),
    );
    let stocked = f32::from(u8::from(goods.v < 1.7 && draw(6) < 0.75));
    let shelf = goods.within((-9.0, 99.0), (foot.1 - 0.03, foot.1 + 0.02));
    let mut inside = Material::matt(DARK_ROOM * 2.0)
        .paint(Rgb::hex(0x8a8378), shelf * 0.6)
        .paint(colour, item * stocked);
    inside.glow = (inside.albedo + Rgb::new(0.12, 0.11, 0.09)) * indoors.shop_glow(building.seed)
        + indoors.reflection * (0.1 + 0.12 * drift(at.u * 0.4, at.v * 0.8, building.seed));
    let mullions = super::surface::stripes(at.u - pane.left + 0.03, at.across, 1.35, 0.06);
    material.mix(inside, hole * (1.0 - mullions))
}
