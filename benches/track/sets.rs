//! The drives.

use std::path::{Path, PathBuf};

use anyhow::Context;
use bytes::Bytes;
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

/// A map and the frames of one robot, in it or not.
#[derive(Clone)]
pub struct Drive {
    pub name: String,
    /// Descriptors and positions in metres, in the order of recording.
    pub map: Vec<(Descriptor, [f64; 2])>,
    /// The pictures of the map.
    pub pictures: Vec<Bytes>,
    /// The number of the place of each image of the map.
    pub places: Vec<usize>,
    pub frames: Vec<Frame>,
    /// An answer is right if its place is at most this much off.
    pub tolerance: usize,
}

/// A frame, with what the robot says of its way.
#[derive(Clone)]
pub struct Frame {
    pub descriptor: Descriptor,
    pub picture: Bytes,
    pub seconds: f64,
    pub moved_m: f64,
    /// The number of the place; `None` for a place that has no number.
    pub truth: Option<usize>,
}

impl Drive {
    /// Whether an answer, the number of an image of the map, is right.
    pub fn is_right(&self, frame: usize, answer: Option<usize>) -> bool {
        let place = answer.map(|image| self.places[image]);
        let truth = self.frames[frame].truth;
        place.zip(truth).is_some_and(|(place, truth)| place.abs_diff(truth) <= self.tolerance)
    }

    /// Whether the map has an image of the place of a frame.
    pub fn is_on_map(&self, frame: usize) -> bool {
        (0..self.places.len()).any(|image| self.is_right(frame, Some(image)))
    }

    /// The share of right answers to the frames on the map, in percent.
    pub fn right(&self, answers: impl Iterator<Item = Option<usize>>) -> f64 {
        let right = answers.enumerate().filter(|(frame, answer)| self.is_right(*frame, *answer));
        let on_map = (0..self.frames.len()).filter(|frame| self.is_on_map(*frame)).count();
        100.0 * right.count() as f64 / on_map.max(1) as f64
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

/// The recorded and rendered sets that drives are made of.
pub struct Sets {
    pub towns: Vec<TownSet>,
    pub traverses: Vec<Traverse>,
    /// The kind of the descriptors.
    pub kind: String,
}

/// A town: what the map sees, and what a robot sees that drives by later.
pub struct TownSet {
    pub seed: u64,
    pub map: Vec<(Descriptor, [f64; 2])>,
    pub frames: Vec<(Descriptor, [f64; 2])>,
    pub pictures: Pictures,
}

/// The pictures of the places of a set.
pub struct Pictures {
    map: Vec<Bytes>,
    frames: Vec<Bytes>,
}

/// A real traverse, recorded twice.
pub struct Traverse {
    pub name: &'static str,
    pub map: Vec<Descriptor>,
    pub frames: Vec<Descriptor>,
    pub pictures: Pictures,
}

impl Sets {
    /// Describes all sets by `kind` or the model's default.
    pub fn new(kind: Option<DescriptorKind>) -> anyhow::Result<Self> {
        let assets = Assets::locate(Some(&Path::new(env!("CARGO_MANIFEST_DIR")).join("assets")));
        let extractor = Extractor::load(&assets, &ExtractorSettings::plain("xfeat", 1, LIMITS))?;
        let kind = kind.unwrap_or(extractor.manifest().default_kind());
        println!("descriptors: {}", kind.as_str());
        let describer = Describer { extractor, kind };
        let towns = [(11, 96), (5, 160), (23, 48)];
        let towns = towns.into_iter().map(|(seed, places)| town(&describer, seed, places));
        let data = std::env::var_os("WHEREABOUTS_DATA")
            .map_or_else(|| "../shared/data".into(), PathBuf::from);
        let mut traverses = Vec::new();
        for (name, map, queries) in [
            ("corridor", "corridor/ref", "corridor/query"),
            ("nordland", "nordland/summer", "nordland/winter"),
        ] {
            let [map, queries] = [map, queries].map(|folder| data.join(folder));
            if !map.is_dir() {
                println!("{name} is left out: there is no {}", map.display());
                continue;
            }
            let [(map, map_pictures), (frames, frame_pictures)] =
                [described(&describer, &map)?, described(&describer, &queries)?];
            let pictures = Pictures { map: map_pictures, frames: frame_pictures };
            traverses.push(Traverse { name, map, frames, pictures });
        }
        let kind = describer.kind.as_str().to_owned();
        Ok(Self { towns: towns.collect::<anyhow::Result<_>>()?, traverses, kind })
    }

    /// The drives on the map: two towns, and real traverses that are driven forwards, backwards, at twice the speed, and
    /// there and back.
    pub fn all(&self) -> anyhow::Result<Vec<Drive>> {
        let town = |town: &TownSet| town.drive("", &|_| true, 0..town.map.len());
        let mut drives: Vec<Drive> = self.towns[..2].iter().map(town).collect();
        for set in &self.traverses {
            let count = set.frames.len();
            let drive = |kind: &str, order: Vec<usize>| set.drive(kind, &|_| true, &order);
            drives.push(drive("", (0..count).collect()));
            drives.push(drive(", backwards", (0..count).rev().collect()));
            drives.push(drive(", two images a frame", (0..count).step_by(2).collect()));
            let back = (0..count / 2).chain((0..count / 2).rev());
            drives.push(drive(", there and back", back.collect()));
        }
        Ok(drives)
    }
}

impl Traverse {
    /// A drive past some places, in a map with an image every metre of the places that `is_mapped`, and frames each
    /// second.
    pub fn drive(&self, kind: &str, is_mapped: &dyn Fn(usize) -> bool, order: &[usize]) -> Drive {
        let places: Vec<usize> = (0..self.map.len()).filter(|place| is_mapped(*place)).collect();
        let map = places.iter().map(|place| (self.map[*place].clone(), [*place as f64, 0.0]));
        let mut before = order[0];
        let frames = order.iter().enumerate().map(|(number, truth)| {
            let moved_m = truth.abs_diff(before) as f64;
            before = *truth;
            let descriptor = self.frames[*truth].clone();
            let picture = self.pictures.frames[*truth].clone();
            Frame { descriptor, picture, seconds: number as f64, moved_m, truth: Some(*truth) }
        });
        Drive {
            name: format!("{}{kind}", self.name),
            map: map.collect(),
            frames: frames.collect(),
            pictures: places.iter().map(|place| self.pictures.map[*place].clone()).collect(),
            places,
            tolerance: 2,
        }
    }
}

impl TownSet {
    /// A drive past some places, in a map of those that `is_mapped`, with odometry that is five metres off.
    pub fn drive(
        &self,
        kind: &str,
        is_mapped: &dyn Fn(usize) -> bool,
        order: impl Iterator<Item = usize>,
    ) -> Drive {
        let places: Vec<usize> = (0..self.map.len()).filter(|place| is_mapped(*place)).collect();
        let mut before: Option<[f64; 2]> = None;
        let mut seconds = 0.0;
        let frames = order.map(|place| {
            let (descriptor, here) = &self.frames[place];
            let way = before.map_or(0.0, |[x, y]| (here[0] - x).hypot(here[1] - y));
            before = Some(*here);
            seconds += way / SPEED;
            let descriptor = descriptor.clone();
            let picture = self.pictures.frames[place].clone();
            Frame { descriptor, picture, seconds, moved_m: way + 5.0, truth: Some(place) }
        });
        Drive {
            name: format!("town {}{kind}", self.seed),
            frames: frames.collect(),
            map: places.iter().map(|place| self.map[*place].clone()).collect(),
            pictures: places.iter().map(|place| self.pictures.map[*place].clone()).collect(),
            places,
            tolerance: 0,
        }
    }
}

/// The places of a town in four lights, three in ten behind a van.
fn town(describer: &Describer, seed: u64, places: usize) -> anyhow::Result<TownSet> {
    let town = Town::new(TownSpec { seed, places, width: 320, height: 240, ..TownSpec::default() });
    let described = |picture: &RgbImage| -> anyhow::Result<(Descriptor, Bytes)> {
        let bytes = encode_jpeg(picture)?;
        Ok((describer.describe(&bytes)?, bytes.into()))
    };
    let drawn: Vec<_> = (0..places)
        .into_par_iter()
        .map(|place| {
            let (reference, visit) = (town.reference(place), town.query(place, (place / 8) as u32));
            let image =
                if is_blocked(place) { behind_a_van(visit.image, place) } else { visit.image };
            let (map, map_picture) = described(&reference.image)?;
            let (frame, frame_picture) = described(&image)?;
            let places = ((map, [reference.x, reference.y]), (frame, [visit.x, visit.y]));
            Ok((places, (map_picture, frame_picture)))
        })
        .collect::<anyhow::Result<_>>()?;
    let (places, pictures): (Vec<_>, Vec<_>) = drawn.into_iter().unzip();
    let (map, frames) = places.into_iter().unzip();
    let (map_pictures, frame_pictures) = pictures.into_iter().unzip();
    let pictures = Pictures { map: map_pictures, frames: frame_pictures };
    Ok(TownSet { seed, map, frames, pictures })
}

/// The descriptors of the pictures of a folder, and the pictures, in the order of their names.
fn described(
    describer: &Describer,
    folder: &Path,
) -> anyhow::Result<(Vec<Descriptor>, Vec<Bytes>)> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?
        .map(|entry| Ok(entry?.path()))
        .collect::<std::io::Result<_>>()?;
    files.sort();
    let described = |file: &PathBuf| {
        let bytes = std::fs::read(file)?;
        let descriptor = describer.describe(&bytes).with_context(|| file.display().to_string())?;
        Ok((descriptor, bytes.into()))
    };
    let described: anyhow::Result<Vec<_>> = files.par_iter().map(described).collect();
    Ok(described?.into_iter().unzip())
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
