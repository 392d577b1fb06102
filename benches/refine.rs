//! The refiner `local` on one thread: the time of a pair, against the matrix product of the two feature
//! maps alone, which any comparison of all cells with all cells needs. Models are not timed.
//!
//! `cargo bench --bench refine`

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use ndarray::ArrayView2;
use whereabouts_core::{DenseFeatures, DescriptorKind};
use whereabouts_refine::local::LocalMatcher;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;
use whereabouts_vision::{Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits};

const CANDIDATES: usize = 20;
const ROUNDS: usize = 30;
const LIMITS: ImageLimits = ImageLimits { max_pixels: 10_000_000 };

fn main() -> anyhow::Result<()> {
    let town = Town::new(TownSpec { places: CANDIDATES, ..TownSpec::default() });
    let assets = Assets::locate(Some(&Path::new(env!("CARGO_MANIFEST_DIR")).join("assets")));
    let extractor = Extractor::load(&assets, &ExtractorSettings::plain("xfeat", 1, LIMITS))?;
    let features = |pixels: &image::RgbImage| -> anyhow::Result<DenseFeatures> {
        let (picture, features) = (encode_jpeg(pixels)?, FeatureSet::DescriptorAndDense);
        let extraction = extractor.extract(&picture, DescriptorKind::GEM, features)?;
        extraction.dense.context("dense features were requested")
    };
    let query = features(&town.query(0, 0).image)?;
    let candidates = (0..CANDIDATES)
        .map(|place| features(&town.reference(place).image))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let candidates: Vec<&DenseFeatures> = candidates.iter().collect();
    let matcher = LocalMatcher::default();
    // Measured in turn, because the speed of the machine varies; the minimum of each.
    let (mut pair, mut product) = (f64::MAX, f64::MAX);
    for _ in 0..ROUNDS {
        let start = Instant::now();
        black_box(matcher.compare_all(black_box(&query), black_box(&candidates))?);
        pair = pair.min(start.elapsed().as_secs_f64() * 1e3 / CANDIDATES as f64);
        let start = Instant::now();
        for candidate in &candidates {
            black_box(cells(&query)?.dot(&cells(candidate)?.t()));
        }
        product = product.min(start.elapsed().as_secs_f64() * 1e3 / CANDIDATES as f64);
    }
    println!(
        "{}×{} cells of {} numbers against as many, {CANDIDATES} candidates, one thread",
        query.height(),
        query.width(),
        query.channels()
    );
    println!("a pair                     {pair:.2} ms");
    println!("its matrix product alone   {product:.2} ms");
    println!("{:.2} × the matrix product", pair / product);
    Ok(())
}

fn cells(features: &DenseFeatures) -> anyhow::Result<ArrayView2<'_, f32>> {
    let shape = (features.len(), features.channels());
    Ok(ArrayView2::from_shape(shape, features.cells())?)
}
