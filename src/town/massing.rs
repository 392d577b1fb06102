//! Buildings as solids: fronts, flanks, roofs, chimneys, dormers, awnings and hanging signs.

use super::font;
use super::geometry::{Panel, Rgb, Vec3};
use super::layout::{Building, Frontage, GroundFloor, PAVEMENT_HEIGHT};
use super::styles::{Brand, Roof, Wall};
use super::surface::{Glance, Outline, Paint, Surface};

type Surfaces<'a> = Vec<Surface<'a>>;

pub(super) fn building<'a>(building: &'a Building, into: &mut Surfaces<'a>) {
    let at = building.at;
    let foot = |u: f32, depth: f32| at.point(u, depth, PAVEMENT_HEIGHT);
    into.push(full(
        Panel::upright(foot(0.0, 0.0), foot(at.width, 0.0), building.eaves()),
        Paint::Facade(building),
    ));
    for u in [0.0, at.width] {
        into.push(full(
            Panel::upright(foot(u, 0.0), foot(u, building.depth), building.eaves()),
            flank(building),
        ));
    }
    match building.style.roof {
        Roof::Flat => {}
        Roof::Pitched => pitched(building, into),
        Roof::Gabled => gabled(building, into),
        Roof::Mansard => mansard(building, into),
    }
    if let GroundFloor::Shop(brand) = building.ground {
        shop(building, brand, into);
    }
}

fn full(panel: Panel, paint: Paint<'_>) -> Surface<'_> {
    Surface { panel, outline: Outline::Full, paint }
}

fn flank(building: &Building) -> Paint<'_> {
    let wall = match building.style.wall {
        Wall::Ashlar => Wall::Render,
        other => other,
    };
    Paint::Wall(wall, building.colour * 0.85, building.seed)
}

/// Height above the road where the roof starts.
fn plate(building: &Building) -> f32 {
    PAVEMENT_HEIGHT + building.eaves()
}

fn pitched<'a>(building: &'a Building, into: &mut Surfaces<'a>) {
    const OVERHANG: f32 = 0.3;
    let (at, base) = (building.at, plate(building));
    let half = building.depth / 2.0;
    let rise = half * 0.75;
    let slope = |depth: f32, z: f32, to_depth: f32, to_z: f32| {
        let corner = at.point(-0.1, depth, z);
        Panel::spanning(
            corner,
            at.point(at.width + 0.1, depth, z) - corner,
            at.point(-0.1, to_depth, to_z) - corner,
        )
    };
    let drop = OVERHANG * 0.75;
    let tiles = Paint::Tiles(building.style.roof_colour);
    into.push(full(slope(-OVERHANG, base - drop + 0.1, half, base + rise + 0.1), tiles));
    into.push(full(slope(building.depth, base, half, base + rise), tiles));
    for u in [0.0, at.width] {
        let foot = at.point(u, 0.0, base);
        into.push(Surface {
            panel: Panel::upright(foot, at.point(u, building.depth, base), rise),
            outline: Outline::Gable,
            paint: flank(building),
        });
    }
    let stack = if building.mirrored { 0.6 } else { at.width - 1.2 };
    chimney(at, stack, half - 0.3, base + rise - 0.5, into);
}

fn chimney<'a>(at: Frontage, u: f32, depth: f32, base: f32, into: &mut Surfaces<'a>) {
    let brick = Paint::Wall(Wall::Brick, Rgb::hex(0x8a5545), 5);
    boxed(at, (u, u + 0.7), (depth, depth + 0.6), (base, base + 1.5), brick, into);
    let pot = Paint::Plain(Rgb::hex(0xa8623f));
    boxed(
        at,
        (u + 0.22, u + 0.46),
        (depth + 0.2, depth + 0.4),
        (base + 1.5, base + 1.85),
        pot,
        into,
    );
}

/// The front and both flanks of a box standing on a frontage.
fn boxed<'a>(
    at: Frontage,
    (left, right): (f32, f32),
    (front, back): (f32, f32),
    (base, top): (f32, f32),
    paint: Paint<'a>,
    into: &mut Surfaces<'a>,
) {
    let edge = |from: (f32, f32), to: (f32, f32)| {
        full(
            Panel::upright(at.point(from.0, from.1, base), at.point(to.0, to.1, base), top - base),
            paint,
        )
    };
    into.push(edge((left, front), (right, front)));
    into.push(edge((left, front), (left, back)));
    into.push(edge((right, front), (right, back)));
}

fn gabled<'a>(building: &'a Building, into: &mut Surfaces<'a>) {
    let (at, base) = (building.at, plate(building));
    let half = at.width / 2.0;
    let rise = half * 0.95;
    let front = Panel::upright(at.point(0.0, 0.0, base), at.point(at.width, 0.0, base), rise);
    into.push(Surface {
        panel: front,
        outline: Outline::Gable,
        paint: Paint::Wall(building.style.wall, building.colour, building.seed),
    });
    let attic = at.point(half - 0.4, -0.03, base + rise * 0.3);
    into.push(Surface {
        panel: Panel::upright(attic, at.point(half + 0.4, -0.03, attic.z), 0.8),
        outline: Outline::Disc,
        paint: Paint::RoadSign(building.style.trim * 0.8),
    });
    for u in [-0.15, at.width + 0.15] {
        let eave = at.point(u, -0.2, base - 0.1);
        into.push(full(
            Panel::spanning(
                eave,
                at.point(u, building.depth, eave.z) - eave,
                at.point(half, -0.2, base + rise + 0.12) - eave,
            ),
            Paint::Tiles(building.style.roof_colour),
        ));
    }
}

fn mansard<'a>(building: &'a Building, into: &mut Surfaces<'a>) {
    const RISE: f32 = 2.6;
    const LEAN: f32 = 0.8;
    let (at, base) = (building.at, plate(building));
    let corner = at.point(0.0, 0.25, base);
    into.push(full(
        Panel::spanning(
            corner,
            at.point(at.width, 0.25, base) - corner,
            at.point(0.0, 0.25 + LEAN, base + RISE) - corner,
        ),
        Paint::Tiles(building.style.roof_colour),
    ));
    for u in [0.0, at.width] {
        into.push(full(
            Panel::upright(at.point(u, 0.6, base), at.point(u, building.depth, base), RISE),
            flank(building),
        ));
    }
    let pitch = (at.width - 0.5) / building.bays as f32;
    for bay in 0..building.bays {
        let middle = 0.25 + (bay as f32 + 0.5) * pitch;
        dormer(building, middle, base + 0.3, into);
    }
}

fn dormer<'a>(building: &'a Building, middle: f32, base: f32, into: &mut Surfaces<'a>) {
    let span = |half: f32| (middle - half, middle + half);
    let depths = |front: f32| (front, 1.0);
    boxed(
        building.at,
        span(0.7),
        depths(0.22),
        (base, base + 1.75),
        Paint::Plain(building.style.trim * 0.85),
        into,
    );
    boxed(building.at, span(0.46), depths(0.19), (base + 0.15, base + 1.5), Paint::Glass, into);
}

fn shop<'a>(building: &'a Building, brand: &'static Brand, into: &mut Surfaces<'a>) {
    let at = building.at;
    let top = PAVEMENT_HEIGHT + building.ground_height() - 1.0;
    if let Some((one, other)) = brand.awning {
        let corner = at.point(0.25, 0.0, top);
        let edge = at.point(0.25, -1.15, top - 0.5);
        let along = at.point(at.width - 0.25, 0.0, top) - corner;
        into.push(full(Panel::spanning(edge, along, corner - edge), Paint::Stripes(one, other)));
        let hem = edge - Vec3::UP * 0.2;
        into.push(full(Panel::spanning(hem, along, Vec3::UP * 0.2), Paint::Stripes(one, other)));
    }
    hanging_sign(building, brand, into);
}

/// A board at right angles to the wall, readable from along the street; one panel for each side
/// so that neither reads mirrored.
fn hanging_sign<'a>(building: &'a Building, brand: &'static Brand, into: &mut Surfaces<'a>) {
    let at = building.at;
    let u = if building.mirrored { 0.35 } else { at.width - 0.35 };
    let base = PAVEMENT_HEIGHT + building.ground_height() + 0.35;
    let text = if building.is_lettered { brand.name } else { "" };
    let paint = Paint::Sign { text, board: brand.board, ink: brand.ink, size: 0.3 };
    for (thickness, from, to) in [(-0.03, -0.1, -1.25), (0.03, -1.25, -0.1)] {
        let (from, to) = (at.point(u + thickness, from, base), at.point(u + thickness, to, base));
        into.push(full(Panel::upright(from, to, 0.62), paint));
    }
}

/// A framed board with its text centred, shrunk to fit.
pub(super) fn sign(text: &str, board: Rgb, ink: Rgb, size: f32, at: &Glance) -> Rgb {
    let size = size.min((at.width - 0.12) / font::text_width(text).max(0.01));
    let start = (at.width - font::text_width(text) * size) / 2.0;
    let baseline = (at.height - size) / 2.0;
    let blur = at.across.max(at.rise) / size;
    let letters = font::ink(text, (at.u - start) / size, (at.v - baseline) / size, blur);
    let face = at.within((0.03, at.width - 0.03), (0.03, at.height - 0.03));
    (ink * 0.8).mix(board, face).mix(ink, letters)
}
