//! Carriageway and pavement.

use super::dice::{drift, floor, speckle};
use super::geometry::Rgb;
use super::layout::KERB;
use super::surface::{Glance, Material, overlap, stripes};

const ROAD_PAINT: Rgb = Rgb::hex(0xd2d0c8);
const YELLOW: Rgb = Rgb::hex(0xc9a13a);

/// Asphalt with markings. The point's own x and y place the markings.
pub(super) fn road(crossings: &[f32], at: &Glance) -> Material {
    let (x, y) = (at.point.x, at.point.y);
    let grain = (1.0 - at.across.max(at.rise) / 0.12).clamp(0.0, 1.0);
    let gravel = (speckle(floor(x * 25.0), floor(y * 25.0), 1) - 0.5) * 0.18 * grain;
    let wear = 0.85 + 0.3 * drift(x * 0.35, y * 0.9, 2);
    let mut road = Material::matt(Rgb::hex(0x55575a) * (wear + gravel));
    road = road.paint(Rgb::hex(0x3d3f42), patch(x, y));
    if y.abs() > KERB + 0.5 {
        return road;
    }
    let crossing = crossings
        .iter()
        .map(|&centre| overlap(x, at.across, centre - 1.6, centre + 1.6))
        .fold(0.0, f32::max);
    let centre_line = overlap(y, at.rise, -0.07, 0.07) * stripes(x, at.across, 6.0, 2.6);
    let edge = overlap(y.abs(), at.rise, KERB - 0.45, KERB - 0.36)
        + overlap(y.abs(), at.rise, KERB - 0.27, KERB - 0.18);
    let zebra = stripes(y + 0.3, at.rise, 1.2, 0.6);
    let edge = edge * (1.0 - crossing);
    let centre_line = centre_line * (1.0 - crossing);
    let zebra = zebra * crossing;
    if centre_line + edge + zebra <= 0.0 {
        return road;
    }
    let fade = 0.75 + 0.2 * drift(x * 2.0, y * 2.0, 5);
    road.paint(ROAD_PAINT, centre_line * fade)
        .paint(YELLOW, edge * fade)
        .paint(ROAD_PAINT, zebra * fade)
}

/// Darker repairs, about one for every thirty metres of lane.
fn patch(x: f32, y: f32) -> f32 {
    let (column, row) = (floor(x / 9.0), floor(y / 3.0));
    if speckle(column, row, 21) > 0.3 {
        return 0.0;
    }
    let (u, v) = (x - column as f32 * 9.0, y - row as f32 * 3.0);
    let length = 1.5 + 4.0 * speckle(column, row, 22);
    let inside = u > 1.0 && u < 1.0 + length && v > 0.5 && v < 1.9;
    if inside { 0.7 } else { 0.0 }
}

/// Concrete slabs.
pub(super) fn pavement(at: &Glance) -> Material {
    const SLAB: f32 = 0.75;
    let (x, y) = (at.point.x, at.point.y);
    let joint = stripes(x, at.across, SLAB, 0.02).max(stripes(y, at.rise, SLAB, 0.02));
    let fade = (1.0 - at.across.max(at.rise) / SLAB).clamp(0.0, 1.0);
    let tone = (speckle(floor(x / SLAB), floor(y / SLAB), 31) - 0.5) * 0.16 * fade;
    let age = 0.92 + 0.16 * drift(x * 0.4, y * 0.6, 32);
    Material::matt(Rgb::hex(0xa7a39a) * ((1.0 + tone) * age * (1.0 - 0.35 * joint)))
}
