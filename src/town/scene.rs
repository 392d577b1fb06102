//! The scene of one street at one moment: all visible surfaces, and the colour of any point on them.

use super::camera::{Camera, Footprint};
use super::facade::facade;
use super::geometry::{Panel, Rgb, Vec3, vec3};
use super::ground;
use super::layout::{KERB, Lot, PAVEMENT_HEIGHT, STREET_END, STREET_START, Street};
use super::light::{Lighting, Turned};
use super::massing;
use super::props;
use super::surface::{Glance, Material, Outline, Paint, Surface, stripes, wall};
use super::traffic::Traffic;
use super::vehicles;

/// How far the pavement panels reach beyond the kerb; buildings stand on them.
const PAVEMENT_DEPTH: f32 = 18.0;
/// Half the width of the open ground around a street.
const GROUND: f32 = 70.0;

pub(super) struct Scene<'a> {
    pub surfaces: Vec<Surface<'a>>,
    pub lighting: Lighting,
    street: &'a Street,
    shadows: Shadows,
}

/// A soft dark patch on the ground.
#[derive(Clone, Copy)]
struct Shadow {
    centre: Vec3,
    /// One over its half length and half width, per metre.
    sharpness: (f32, f32),
    strength: f32,
}

impl Shadow {
    fn new(centre: Vec3, half: (f32, f32), strength: f32) -> Shadow {
        Shadow { centre, sharpness: (1.0 / half.0, 1.0 / half.1), strength }
    }
}

/// The shadows on a street, by where along it they lie.
struct Shadows(Vec<Vec<Shadow>>);

impl Shadows {
    /// Length of street that is looked up together, in metres.
    const CELL: f32 = 2.0;

    fn new(shadows: &[Shadow]) -> Shadows {
        let mut cells = vec![Vec::new(); Self::cell(STREET_END) + 1];
        for &shadow in shadows {
            let half = 1.0 / shadow.sharpness.0;
            let (first, last) =
                (Self::cell(shadow.centre.x - half), Self::cell(shadow.centre.x + half));
            for cell in cells.iter_mut().take(last + 1).skip(first) {
                cell.push(shadow);
            }
        }
        Shadows(cells)
    }

    #[inline]
    fn cell(x: f32) -> usize {
        ((x - STREET_START) * (1.0 / Self::CELL)) as usize
    }

    /// Share of the light that patches of shadow leave to a point on the ground.
    #[inline]
    fn unshaded(&self, point: Vec3) -> f32 {
        let mut share = 1.0;
        for shadow in self.0.get(Self::cell(point.x)).into_iter().flatten() {
            let x = (point.x - shadow.centre.x) * shadow.sharpness.0;
            let y = (point.y - shadow.centre.y) * shadow.sharpness.1;
            if x.abs() < 1.0 && y.abs() < 1.0 {
                let (x, y) = (x * x, y * y);
                share *= 1.0 - shadow.strength * (1.5 - 1.5 * (x * x + y * y)).clamp(0.0, 1.0);
            }
        }
        share
    }
}

impl<'a> Scene<'a> {
    pub fn new(
        street: &'a Street,
        camera: &Camera,
        traffic: &Traffic,
        lighting: Lighting,
    ) -> Scene<'a> {
        let mut surfaces = Vec::with_capacity(1500);
        lay_ground(street, &mut surfaces);
        build(street, &mut surfaces);
        furnish(street, camera, &mut surfaces);
        for vehicle in &traffic.vehicles {
            vehicle.surfaces(&mut surfaces);
        }
        for (foot, dice) in &traffic.walkers {
            props::walker(*foot, camera.rightwards(), &mut dice.fork(0), &mut surfaces);
        }
        let shadows = cast_shadows(street, traffic, &lighting);
        Scene { surfaces, shadows: Shadows::new(&shadows), lighting, street }
    }

    /// Whether a surface covers a point of its panel.
    #[inline]
    pub fn covers(surface: &Surface<'_>, u: f32, v: f32) -> bool {
        let panel = &surface.panel;
        let (x, y) = (2.0 * u / panel.width - 1.0, 2.0 * v / panel.height - 1.0);
        match surface.outline {
            Outline::Full => true,
            Outline::Gable => v / panel.height < 1.0 - x.abs(),
            Outline::Disc => x * x + y * y < 1.0,
            Outline::Leaves(seed) => props::leaves_cover(x, y, seed),
            Outline::Walker(stride) => {
                let half = panel.width / panel.height / 2.0;
                props::walker_covers(x * half, v / panel.height, stride)
            }
            Outline::Vehicle(profile) => profile.contains(u, v),
        }
    }

    /// Radiance of the point of `surface` seen by a pixel; `turned` is how the surface lies to the
    /// light on that side.
    #[inline]
    pub fn shade(&self, surface: &Surface<'a>, seen: &Footprint, turned: &Turned) -> Rgb {
        let panel = &surface.panel;
        let glance = Glance {
            u: seen.u,
            v: seen.v,
            width: panel.width,
            height: panel.height,
            across: seen.across,
            rise: seen.rise,
            slant: seen.slant,
            point: panel.point(seen.u, seen.v),
        };
        let material = self.material(surface, &glance);
        let mut light = self.lighting.irradiance(glance.point, turned);
        if matches!(surface.paint, Paint::Road | Paint::Pavement) {
            light = light * self.shadows.unshaded(glance.point);
        }
        let haze = seen.depth / (seen.depth + 700.0);
        (material.albedo.tint(light) + material.glow).mix(self.lighting.horizon, haze)
    }

    fn material(&self, surface: &Surface<'a>, at: &Glance) -> Material {
        let indoors = &self.lighting.indoors;
        match surface.paint {
            Paint::Facade(building) => facade(building, at, indoors),
            Paint::Wall(kind, colour, seed) => Material::matt(wall(kind, colour, seed, at)),
            Paint::Tiles(colour) => Material::matt(tiles(colour, at)),
            Paint::Plain(colour) => Material::matt(colour),
            Paint::Stripes(one, other) => {
                Material::matt(one).paint(other, stripes(at.u, at.across, 0.7, 0.35))
            }
            Paint::Sign { text, board, ink, size } => {
                let mut face = Material::matt(massing::sign(text, board, ink, size, at));
                face.glow = face.albedo * indoors.signs;
                face
            }
            Paint::RoadSign(rim) => road_sign(rim, at),
            Paint::Leaves(seed) => props::leaves_paint(seed, at),
            Paint::Walker { coat, trousers, hair } => props::walker_paint(coat, trousers, hair, at),
            Paint::VehicleSide(profile, colour) => vehicles::side_paint(profile, colour, at),
            Paint::VehicleEnd(colour, lamp) => vehicles::end_paint(colour, lamp, at),
            Paint::Glass => Material { albedo: Rgb::hex(0x2b3238), glow: indoors.reflection * 0.3 },
            Paint::Lantern => Material {
                albedo: Rgb::hex(0x9a9a94),
                glow: Rgb::hex(0xffe2b0) * (indoors.signs * 4.0),
            },
            Paint::Road => ground::road(&self.street.crossings, at),
            Paint::Pavement => ground::pavement(at),
        }
    }
}

fn tiles(colour: Rgb, at: &Glance) -> Rgb {
    let rows = stripes(at.v, at.rise, 0.28, 0.05);
    let uneven = 0.85 + 0.3 * super::dice::drift(at.u * 0.9, at.v * 1.3, 77);
    colour * ((1.0 - 0.35 * rows) * uneven)
}

fn road_sign(rim: Rgb, at: &Glance) -> Material {
    let (x, y) = (2.0 * at.u / at.width - 1.0, 2.0 * at.v / at.height - 1.0);
    let blur = at.across / at.width * 2.0;
    let centre = ((0.7 - (x * x + y * y).sqrt()) / blur + 0.5).clamp(0.0, 1.0);
    Material::matt(rim).paint(Rgb::hex(0xe8e8e4), centre)
}

fn full(panel: Panel, paint: Paint<'_>) -> Surface<'_> {
    Surface { panel, outline: Outline::Full, paint }
}

fn lay_ground<'a>(street: &'a Street, into: &mut Vec<Surface<'a>>) {
    let (start, end) = (STREET_START - 40.0, STREET_END + 40.0);
    into.push(full(
        Panel::spanning(
            vec3(start, -GROUND, 0.0),
            Vec3::EAST * (end - start),
            Vec3::NORTH * (2.0 * GROUND),
        ),
        Paint::Road,
    ));
    for side in [1.0, -1.0] {
        let mut from = STREET_START - 8.0;
        let mouths = street.lots.iter().filter_map(|lot| match lot {
            Lot::SideStreet(at) if at.away.y * side > 0.0 => Some(at.x_range()),
            _ => None,
        });
        for (mouth, resume) in mouths.chain([(STREET_END + 8.0, 0.0)]) {
            pave(side, from, mouth, into);
            from = resume;
        }
    }
}

/// A raised pavement between two side streets, with its kerb on three sides.
fn pave(side: f32, from: f32, to: f32, into: &mut Vec<Surface<'_>>) {
    let stone = Paint::Plain(Rgb::hex(0x8f8b83));
    let (kerb, back) = (side * KERB, side * (KERB + PAVEMENT_DEPTH));
    let rise = Vec3::UP * PAVEMENT_HEIGHT;
    let length = Vec3::EAST * (to - from);
    let inward = vec3(0.0, back - kerb, 0.0);
    into.push(full(
        Panel::spanning(
            vec3(from, kerb.min(back), PAVEMENT_HEIGHT),
            length,
            Vec3::NORTH * PAVEMENT_DEPTH,
        ),
        Paint::Pavement,
    ));
    into.push(full(Panel::spanning(vec3(from, kerb, 0.0), length, rise), stone));
    for x in [from, to] {
        into.push(full(Panel::spanning(vec3(x, kerb, 0.0), inward, rise), stone));
    }
    // The kerbstone's upper edge, a shade lighter than the slabs.
    let edge = vec3(from, kerb.min(kerb + side * 0.14), PAVEMENT_HEIGHT + 0.004);
    into.push(full(
        Panel::spanning(edge, length, Vec3::NORTH * 0.14),
        Paint::Plain(Rgb::hex(0xb9b5ab)),
    ));
}

fn build<'a>(street: &'a Street, into: &mut Vec<Surface<'a>>) {
    for lot in &street.lots {
        match lot {
            Lot::Built(building) => massing::building(building, into),
            Lot::SideStreet(_) => {}
            Lot::Garden(at, seed) => props::garden(*at, *seed, into),
        }
    }
    for building in &street.backdrop {
        massing::building(building, into);
    }
}

fn furnish<'a>(street: &'a Street, camera: &Camera, into: &mut Vec<Surface<'a>>) {
    let rightwards = camera.rightwards();
    for &(kind, foot) in &street.fixtures {
        props::fixture(kind, foot, rightwards, into);
    }
    for tree in &street.trees {
        props::tree(tree, rightwards, into);
    }
}

fn cast_shadows(street: &Street, traffic: &Traffic, lighting: &Lighting) -> Vec<Shadow> {
    let under_vehicles = traffic.vehicles.iter().map(|vehicle| {
        let (length, width) = vehicle.reach();
        Shadow::new(vehicle.centre, (length + 0.25, width + 0.3), 0.7)
    });
    let under_people = traffic.walkers.iter().map(|&(foot, _)| Shadow::new(foot, (0.35, 0.3), 0.5));
    let mut shadows: Vec<Shadow> = under_vehicles.chain(under_people).collect();
    if lighting.has_sun {
        let drop = lighting.sun_direction * (1.0 / lighting.sun_direction.z);
        shadows.extend(street.trees.iter().map(|tree| {
            let spread = tree.height * 0.3;
            Shadow::new(tree.foot - drop * (tree.height * 0.72), (spread, spread), 0.45)
        }));
    }
    shadows
}
