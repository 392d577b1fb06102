//! Street furniture, trees and people: small things that stand on the ground.

use super::dice::{Dice, drift};
use super::geometry::{Panel, Rgb, Vec3, vec3};
use super::layout::{Fixture, Frontage, PAVEMENT_HEIGHT, Tree};
use super::light::{LAMP_HEIGHT, lamp_head};
use super::styles::Wall;
use super::surface::{Glance, Material, Outline, Paint, Surface, overlap};

type Surfaces<'a> = Vec<Surface<'a>>;

const IRON: Rgb = Rgb::hex(0x343a3d);

/// A rectangle facing the camera, `rightwards` being the camera's horizontal.
fn billboard(foot: Vec3, rightwards: Vec3, width: f32, height: f32) -> Panel {
    Panel::spanning(foot - rightwards * (width / 2.0), rightwards * width, Vec3::UP * height)
}

pub(super) fn tree(tree: &Tree, rightwards: Vec3, into: &mut Surfaces<'_>) {
    let trunk = tree.height * 0.62;
    into.push(Surface {
        panel: billboard(tree.foot, rightwards, 0.22, trunk),
        outline: Outline::Full,
        paint: Paint::Plain(Rgb::hex(0x5b4a3a)),
    });
    let mut dice = Dice::new(u64::from(tree.seed));
    let spread = tree.height * 0.2;
    for _ in 0..9 {
        let size = tree.height * dice.between(0.24, 0.36);
        let centre = tree.foot
            + vec3(
                dice.around(spread),
                dice.around(spread),
                tree.height * dice.between(0.55, 0.92),
            );
        let seed = dice.bits() as u32;
        into.push(Surface {
            panel: billboard(centre - Vec3::UP * (size / 2.0), rightwards, size, size),
            outline: Outline::Leaves(seed),
            paint: Paint::Leaves(seed),
        });
    }
}

pub(super) fn fixture(kind: Fixture, foot: Vec3, rightwards: Vec3, into: &mut Surfaces<'_>) {
    let mut post = |width: f32, base: f32, height: f32, colour: Rgb| {
        into.push(Surface {
            panel: billboard(foot + Vec3::UP * base, rightwards, width, height),
            outline: Outline::Full,
            paint: Paint::Plain(colour),
        });
    };
    match kind {
        Fixture::Lamp => lamp(foot, rightwards, into),
        Fixture::RoadSign => {
            post(0.07, 0.0, 2.9, Rgb::hex(0x9a9da0));
            road_sign(foot, into);
        }
        Fixture::PostBox => {
            let red = Rgb::hex(0xb1221c);
            post(0.46, 0.0, 0.12, IRON);
            post(0.42, 0.12, 1.25, red);
            post(0.5, 1.37, 0.12, red * 0.8);
        }
        Fixture::Bin => {
            post(0.5, 0.05, 0.8, Rgb::hex(0x3d5245));
            post(0.56, 0.85, 0.08, IRON);
        }
        Fixture::Bollard => post(0.16, 0.0, 0.95, IRON),
        Fixture::Bench => bench(foot, into),
    }
}

fn lamp(foot: Vec3, rightwards: Vec3, into: &mut Surfaces<'_>) {
    let head = lamp_head(foot);
    for (base, width, height) in [(0.0, 0.2, 0.9), (0.9, 0.1, LAMP_HEIGHT - 0.9)] {
        into.push(Surface {
            panel: billboard(foot + Vec3::UP * base, rightwards, width, height),
            outline: Outline::Full,
            paint: Paint::Plain(IRON),
        });
    }
    let top = foot + Vec3::UP * (LAMP_HEIGHT - 0.06);
    let reach = vec3(0.0, head.y - foot.y, 0.0);
    into.push(Surface {
        panel: Panel::spanning(top, reach, Vec3::UP * 0.08),
        outline: Outline::Full,
        paint: Paint::Plain(IRON),
    });
    into.push(Surface {
        panel: billboard(head - Vec3::UP * 0.16, rightwards, 0.5, 0.16),
        outline: Outline::Full,
        paint: Paint::Lantern,
    });
}

/// A round plate facing along the street.
fn road_sign(foot: Vec3, into: &mut Surfaces<'_>) {
    let rim = if (foot.x * 7.0) as i32 % 2 == 0 { Rgb::hex(0xb3201c) } else { Rgb::hex(0x1d4f9c) };
    let diagonal = vec3(-0.6, foot.y.signum() * 0.8, 0.0);
    let centre = foot + Vec3::UP * 2.3 - diagonal.cross(Vec3::UP) * 0.05;
    into.push(Surface {
        panel: Panel::spanning(centre - diagonal * 0.33, diagonal * 0.66, Vec3::UP * 0.66),
        outline: Outline::Disc,
        paint: Paint::RoadSign(rim),
    });
}

fn bench(foot: Vec3, into: &mut Surfaces<'_>) {
    let side = foot.y.signum();
    let wood = Paint::Plain(Rgb::hex(0x8a6540));
    let corner = foot - Vec3::EAST * 0.8;
    let mut plank = |lift: f32, shift: f32, rise: Vec3| {
        into.push(Surface {
            panel: Panel::spanning(corner + vec3(0.0, side * shift, lift), Vec3::EAST * 1.6, rise),
            outline: Outline::Full,
            paint: wood,
        });
    };
    plank(0.44, 0.0, vec3(0.0, side * 0.4, 0.0));
    plank(0.38, 0.0, Vec3::UP * 0.07);
    plank(0.55, 0.42, Vec3::UP * 0.15);
    plank(0.76, 0.42, Vec3::UP * 0.12);
    for x in [0.1, 1.45] {
        into.push(Surface {
            panel: Panel::spanning(corner + vec3(x, 0.0, 0.0), Vec3::EAST * 0.07, Vec3::UP * 0.4),
            outline: Outline::Full,
            paint: Paint::Plain(IRON),
        });
    }
}

/// A low wall with a hedge behind it, closing a garden.
pub(super) fn garden(at: Frontage, seed: u32, into: &mut Surfaces<'_>) {
    let upright = |depth: f32, base: f32, height: f32| {
        Panel::upright(at.point(0.0, depth, base), at.point(at.width, depth, base), height)
    };
    into.push(Surface {
        panel: upright(0.1, PAVEMENT_HEIGHT, 1.0),
        outline: Outline::Full,
        paint: Paint::Wall(Wall::Brick, Rgb::hex(0x96604c), seed),
    });
    into.push(Surface {
        panel: upright(0.05, PAVEMENT_HEIGHT + 1.0, 0.1),
        outline: Outline::Full,
        paint: Paint::Plain(Rgb::hex(0xbdb6a8)),
    });
    into.push(Surface {
        panel: upright(1.2, PAVEMENT_HEIGHT, 1.9),
        outline: Outline::Full,
        paint: Paint::Leaves(seed),
    });
}

/// Someone on foot, facing the camera's plane.
pub(super) fn walker(foot: Vec3, rightwards: Vec3, dice: &mut Dice, into: &mut Surfaces<'_>) {
    const CLOTHES: [Rgb; 8] = [
        Rgb::hex(0x2b3038),
        Rgb::hex(0x8c2f2b),
        Rgb::hex(0x3d5a80),
        Rgb::hex(0xd8cdb8),
        Rgb::hex(0x5c6b3c),
        Rgb::hex(0xd79a2b),
        Rgb::hex(0x6d4a6b),
        Rgb::hex(0x7a6a58),
    ];
    const HAIR: [Rgb; 3] = [Rgb::hex(0x2a211c), Rgb::hex(0x6b4a2e), Rgb::hex(0xb0a59a)];
    let height = dice.between(1.55, 1.88);
    into.push(Surface {
        panel: billboard(foot, rightwards, height * 0.5, height),
        outline: Outline::Walker(dice.between(0.05, 0.28)),
        paint: Paint::Walker {
            coat: dice.pick(&CLOTHES),
            trousers: dice.pick(&CLOTHES) * 0.5,
            hair: dice.pick(&HAIR),
        },
    });
}

/// Whether a walker covers a point; `x` from the middle and `y` from the ground, both as shares
/// of the height.
pub(super) fn walker_covers(x: f32, y: f32, stride: f32) -> bool {
    let ellipse = |cx: f32, cy: f32, rx: f32, ry: f32| {
        let (dx, dy) = ((x - cx) / rx, (y - cy) / ry);
        dx * dx + dy * dy < 1.0
    };
    let leg = |direction: f32| {
        let hip_to_foot = (0.5 - y) / 0.5;
        y < 0.52 && (x - direction * stride * 0.5 * hip_to_foot).abs() < 0.052 - 0.014 * hip_to_foot
    };
    let arm = |direction: f32| {
        let reach = (0.8 - y) / 0.36;
        (0.0..1.0).contains(&reach) && (x - direction * (0.1 + stride * 0.25 * reach)).abs() < 0.034
    };
    ellipse(0.0, 0.93, 0.052, 0.068)
        || ellipse(0.0, 0.66, 0.118, 0.2)
        || leg(1.0)
        || leg(-1.0)
        || arm(1.0)
        || arm(-1.0)
}

pub(super) fn walker_paint(coat: Rgb, trousers: Rgb, hair: Rgb, at: &Glance) -> Material {
    const SKIN: Rgb = Rgb::hex(0xc99a7c);
    let y = at.v / at.height;
    let rise = at.rise / at.height;
    let band = |low: f32, high: f32| overlap(y, rise, low, high);
    let round = 0.8 + 0.35 * (at.u / at.width - 0.4);
    Material::matt(coat * round)
        .paint(trousers * round, band(-1.0, 0.48))
        .paint(Rgb::hex(0x1f1c1b), band(-1.0, 0.03))
        .paint(SKIN, band(0.855, 0.955))
        .paint(hair, band(0.955, 2.0))
}

/// Whether a cluster of leaves covers a point given from the panel's centre, as shares of its
/// half width.
pub(super) fn leaves_cover(x: f32, y: f32, seed: u32) -> bool {
    let ragged = drift(x * 4.0, y * 4.0, seed);
    x * x + y * y < 0.35 + 0.75 * ragged && x * x + y * y < 1.0
}

pub(super) fn leaves_paint(seed: u32, at: &Glance) -> Material {
    const DEEP: Rgb = Rgb::hex(0x35522b);
    const BRIGHT: Rgb = Rgb::hex(0x7f9a4c);
    let fade = (1.0 - at.across / 0.15).clamp(0.0, 1.0);
    let tuft = drift(at.u * 3.0, at.v * 3.0, seed);
    let leaf = (drift(at.u * 11.0, at.v * 11.0, seed ^ 9) - 0.5) * fade;
    let height = (at.v / at.height).clamp(0.0, 1.0);
    let share = (0.15 + 0.35 * height + 0.35 * tuft + 0.7 * leaf).clamp(0.0, 1.0);
    Material::matt(DEEP.mix(BRIGHT, share))
}
