//! The maps that are searched.

use std::path::Path;

use anyhow::Context;
use rayon::prelude::*;
use whereabouts_core::DescriptorKind;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;
use whereabouts_vision::{Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits};

use super::vectors::{Rows, Set, clustered};

pub const ALL: [&str; 7] =
    ["10000", "100000", "twins", "one-picture", "by-place", "by-value", "standing"];

const QUERIES: usize = 500;
const SIZE: usize = 20_000;
const PLACES: usize = 100;
const FRAMES: usize = 100;
const QUERIES_AT_A_PLACE: usize = 5;
const LIMITS: ImageLimits = ImageLimits { max_pixels: 10_000_000 };

/// The set of a name, or as many clustered vectors as the name says.
pub fn named(name: &str) -> anyhow::Result<Set> {
    let queries = clustered(QUERIES, 11);
    let drawn = |rows: Rows| Set { name: name.to_owned(), rows, queries: queries.clone() };
    let rows = clustered(SIZE, 7);
    Ok(match name {
        // One in ten is a copy of another.
        "twins" => {
            drawn(rows.reordered((0..SIZE).map(|i| if i % 10 == 9 { i * 7 % SIZE } else { i })))
        }
        // One picture 10,000 times, among as many others.
        "one-picture" => drawn(rows.reordered((0..SIZE).map(|i| if i % 2 == 0 { 0 } else { i }))),
        // All images of a place, then all of the next.
        "by-place" => {
            let mut order: Vec<usize> = (0..SIZE).collect();
            order.sort_by_key(|i| (i % 2000, *i));
            drawn(rows.reordered(order))
        }
        // From one end of the space to the other.
        "by-value" => {
            let mut order: Vec<usize> = (0..SIZE).collect();
            order.sort_by(|&a, &b| rows.row(a)[0].total_cmp(&rows.row(b)[0]));
            drawn(rows.reordered(order))
        }
        "standing" => standing()?,
        size => {
            let size = size.parse().with_context(|| format!("no set is called {size}"))?;
            drawn(clustered(size, 7))
        }
    })
}

/// What a robot sees that stands still at 100 places of the town for 100 frames each: the same view with the noise of a
/// camera, its varying exposure, and a pixel or two of vibration. Described by XFeat.
fn standing() -> anyhow::Result<Set> {
    let town = Town::new(TownSpec { places: PLACES, ..TownSpec::default() });
    let assets = Assets::locate(Some(&Path::new(env!("CARGO_MANIFEST_DIR")).join("assets")));
    let extractor = Extractor::load(&assets, &ExtractorSettings::plain("xfeat", 1, LIMITS))?;
    let at_a_place = |place: usize| -> anyhow::Result<Vec<Vec<f32>>> {
        let view = town.reference(place).image;
        let frame = |index: usize| {
            let picture = encode_jpeg(&frame_of(&view, (place * 1000 + index) as u64))?;
            let kind = DescriptorKind::GEM;
            let extraction = extractor.extract(&picture, kind, FeatureSet::DescriptorOnly)?;
            Ok(extraction.descriptor.as_slice().to_vec())
        };
        (0..FRAMES + QUERIES_AT_A_PLACE).map(frame).collect()
    };
    let frames: Vec<Vec<Vec<f32>>> =
        (0..PLACES).into_par_iter().map(at_a_place).collect::<anyhow::Result<_>>()?;
    let rows = |range: std::ops::Range<usize>| {
        let numbers: Vec<f32> = frames.iter().flat_map(|of| of[range.clone()].concat()).collect();
        Rows { dim: frames[0][0].len(), numbers }
    };
    let queries = rows(FRAMES..FRAMES + QUERIES_AT_A_PLACE);
    Ok(Set { name: "standing".into(), rows: rows(0..FRAMES), queries })
}

/// One frame of a view.
fn frame_of(view: &image::RgbImage, seed: u64) -> image::RgbImage {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut random = move |below: u32| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as u32 % below
    };
    let (dx, dy, gain) = (random(3), random(3), 0.97 + random(61) as f32 / 1000.0);
    image::RgbImage::from_fn(view.width(), view.height(), |x, y| {
        let from = view.get_pixel((x + dx).min(view.width() - 1), (y + dy).min(view.height() - 1));
        let noise = random(9) as f32 - 4.0;
        image::Rgb(from.0.map(|level| (f32::from(level) * gain + noise).clamp(0.0, 255.0) as u8))
    })
}
