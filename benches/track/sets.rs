//! The drives.

use std::path::{Path, PathBuf};

use anyhow::Context;
use image::RgbImage;
use rayon::prelude::*;
use whereabouts_core::{Descriptor, DescriptorKind};
use whereabouts_testkit::drives::{behind_a_van, is_blocked};
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;
use whereabouts_vision::{Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits};

const LIMITS: ImageLimits = ImageLimits { max_pixels: 10_000_000 };

/// Speed of the robot in the town, in metres per second.
const SPEED: f64 = 8.0;

/// A map and the frames of one robot in it.
pub struct Drive {
    pub name: String,
    /// Descriptors and positions in metres, in the order of recording.
    pub map: Vec<(Descriptor, [f64; 2])>,
    pub frames: Vec<Frame>,
    /// An answer is right if its number is at most this much off.
    tolerance: usize,
}

/// A frame, with what the robot says of its way.
#[derive(Clone)]
pub struct Frame {
    pub descriptor: Descriptor,
    pub seconds: f64,
    pub moved_m: f64,
    /// The number of the image of the place.
    truth: usize,
}

impl Drive {
    pub fn is_right(&self, frame: usize, answer: Option<usize>) -> bool {
        answer.is_some_and(|answer| answer.abs_diff(self.frames[frame].truth) <= self.tolerance)
    }

    /// The share of right answers in percent.
    pub fn right(&self, answers: impl Iterator<Item = Option<usize>>) -> f64 {
        let right = answers.enumerate().filter(|(frame, answer)| self.is_right(*frame, *answer));
        100.0 * right.count() as f64 / self.frames.len() as f64
    }
}

/// The built-in model with one of its kinds of descriptors.
struct Describer {
    extractor: Extractor,
    kind: DescriptorKind,
}

impl Describer {
    fn describe(&self, picture: &[u8]) -> anyhow::Result<Descriptor> {
        Ok(self.extractor.extract(picture, self.kind, FeatureSet::DescriptorOnly)?.descriptor)
    }
}

/// All drives, described by `kind` or the model's default: two towns, and real traverses that are driven forwards, backwards, at twice the speed, and there and back.
pub fn all(kind: Option<DescriptorKind>) -> anyhow::Result<Vec<Drive>> {
    let assets = Assets::locate(Some(&Path::new(env!("CARGO_MANIFEST_DIR")).join("assets")));
    let extractor = Extractor::load(&assets, &ExtractorSettings::plain("xfeat", 1, LIMITS))?;
    let kind = kind.unwrap_or(extractor.manifest().default_kind());
    println!("descriptors: {}", kind.as_str());
    let describer = Describer { extractor, kind };
    let mut drives = vec![town(&describer, 11, 96)?, town(&describer, 5, 160)?];
    let data =
        std::env::var_os("WHEREABOUTS_DATA").map_or_else(|| "../shared/data".into(), PathBuf::from);
    for (name, map, queries) in [
        ("corridor", "corridor/ref", "corridor/query"),
        ("nordland", "nordland/summer", "nordland/winter"),
    ] {
        let [map, queries] = [map, queries].map(|folder| data.join(folder));
        if !map.is_dir() {
            println!("{name} is left out: there is no {}", map.display());
            continue;
        }
        let [map, queries] = [described(&describer, &map)?, described(&describer, &queries)?];
        let count = queries.len();
        let drive = |kind: &str, order: Vec<usize>| {
            traverse(&format!("{name}{kind}"), &map, &queries, &order)
        };
        drives.push(drive("", (0..count).collect()));
        drives.push(drive(", backwards", (0..count).rev().collect()));
        drives.push(drive(", two images a frame", (0..count).step_by(2).collect()));
        drives
            .push(drive(", there and back", (0..count / 2).chain((0..count / 2).rev()).collect()));
    }
    Ok(drives)
}

/// A map with an image every metre, and frames each second.
fn traverse(name: &str, map: &[Descriptor], queries: &[Descriptor], order: &[usize]) -> Drive {
    let map = map.iter().cloned().zip(0..).map(|(image, x)| (image, [f64::from(x), 0.0])).collect();
    let mut before = order[0];
    let frames = order.iter().enumerate().map(|(number, truth)| {
        let moved_m = truth.abs_diff(before) as f64;
        before = *truth;
        Frame {
            descriptor: queries[*truth].clone(),
            seconds: number as f64,
            moved_m,
            truth: *truth,
        }
    });
    Drive { name: name.into(), map, frames: frames.collect(), tolerance: 2 }
}

/// The places of a town in four lights, three in ten behind a van, with odometry that is five metres off.
fn town(describer: &Describer, seed: u64, places: usize) -> anyhow::Result<Drive> {
    let town = Town::new(TownSpec { seed, places, width: 320, height: 240 });
    let described = |picture: &RgbImage| describer.describe(&encode_jpeg(picture)?);
    let drawn: Vec<_> = (0..places)
        .into_par_iter()
        .map(|place| {
            let (reference, visit) = (town.reference(place), town.query(place, (place / 8) as u32));
            let image =
                if is_blocked(place) { behind_a_van(visit.image, place) } else { visit.image };
            let map = (described(&reference.image)?, [reference.x, reference.y]);
            Ok((map, described(&image)?, [visit.x, visit.y]))
        })
        .collect::<anyhow::Result<_>>()?;
    let mut before: Option<[f64; 2]> = None;
    let mut metres = 0.0;
    let (mut map, mut frames) = (Vec::new(), Vec::new());
    for (truth, (image, descriptor, here)) in drawn.into_iter().enumerate() {
        let way = before.map_or(0.0, |[x, y]| (here[0] - x).hypot(here[1] - y));
        before = Some(here);
        metres += way;
        map.push(image);
        frames.push(Frame { descriptor, seconds: metres / SPEED, moved_m: way + 5.0, truth });
    }
    Ok(Drive { name: format!("town {seed}"), map, frames, tolerance: 0 })
}

/// The descriptors of the pictures of a folder, in the order of their names.
fn described(describer: &Describer, folder: &Path) -> anyhow::Result<Vec<Descriptor>> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?
        .map(|entry| Ok(entry?.path()))
        .collect::<std::io::Result<_>>()?;
    files.sort();
    let described = |file: &PathBuf| {
        let bytes = std::fs::read(file)?;
        describer.describe(&bytes).with_context(|| file.display().to_string())
    };
    files.par_iter().map(described).collect()
}

/// Images every metre along a spiral, each a little like the one before.
pub fn drawn(count: usize, dim: usize) -> anyhow::Result<Vec<(Descriptor, [f64; 2])>> {
    let mut state = 7_u64;
    let mut random = move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1_u64 << 23) as f32 - 1.0
    };
    let mut row: Vec<f32> = (0..dim).map(|_| random()).collect();
    let mut turn = 0.0_f64;
    let mut all = Vec::new();
    for _ in 0..count {
        row.iter_mut().for_each(|number| *number = 0.6 * *number + random());
        // Rings ten metres apart.
        let radius = 50.0 + 10.0 * turn / std::f64::consts::TAU;
        all.push((
            Descriptor::normalised(row.clone())?,
            [radius * turn.cos(), radius * turn.sin()],
        ));
        turn += 1.0 / radius;
    }
    Ok(all)
}
