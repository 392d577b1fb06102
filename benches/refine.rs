//! The refiner `local` on one thread: the time of a pair. Its peers are the same comparison in floating point, which it
//! was until processors with AVX2 compared in 16-bit integers, and the matrix product of the two feature maps alone, which
//! any comparison of all cells with all cells needs. The time of the description is not included. Models are not timed.
//!
//! `cargo bench --bench refine`

use std::collections::HashSet;
use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use ndarray::ArrayView2;
use whereabouts_core::{DenseFeatures, DescriptorKind};
use whereabouts_refine::local::{LocalMatcher, LocalSettings, Match, PairMatch, rank};
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
    let matchers = [LocalMatcher::default(), LocalMatcher::in_floats(LocalSettings::default())];
    // Measured in turn, because the speed of the machine varies; the minimum of each.
    let (mut pairs, mut product) = ([f64::MAX; 2], f64::MAX);
    for _ in 0..ROUNDS {
        for (matcher, pair) in matchers.iter().zip(&mut pairs) {
            let start = Instant::now();
            black_box(matcher.compare_all(black_box(&query), black_box(&candidates))?);
            *pair = pair.min(start.elapsed().as_secs_f64() * 1e3 / CANDIDATES as f64);
        }
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
    let [pair, in_floats] = pairs;
    println!("a pair                     {pair:.2} ms");
    println!("in floating point          {in_floats:.2} ms");
    println!("its matrix product alone   {product:.2} ms");
    println!(
        "{:.2} × floating point, {:.2} × the matrix product",
        pair / in_floats,
        pair / product
    );
    let [ours, theirs] = matchers.map(|matcher| matcher.compare_all(&query, &candidates));
    let (ours, theirs) = (ours?, theirs?);
    let same = rank(&ours) == rank(&theirs);
    println!("{}", difference(&ours, &theirs));
    println!("the ranking is {}", if same { "the same" } else { "another" });
    Ok(())
}

/// How far the matches and the scores of two ways of comparing are apart.
fn difference(ours: &[PairMatch], theirs: &[PairMatch]) -> String {
    let (mut shared, mut all, mut score) = (0, 0, 0.0_f32);
    for (ours, theirs) in ours.iter().zip(theirs) {
        let cells = |pair: &PairMatch| -> HashSet<[u32; 4]> {
            let bits = |found: &Match| [found.query, found.candidate].concat();
            let bits = pair.matches.iter().map(bits);
            bits.map(|at| [0, 1, 2, 3].map(|index| at[index].to_bits())).collect()
        };
        let (ours_at, theirs_at) = (cells(ours), cells(theirs));
        shared += ours_at.intersection(&theirs_at).count();
        all += ours_at.union(&theirs_at).count();
        score = score.max((ours.score - theirs.score).abs() / theirs.score.max(1e-6));
    }
    format!(
        "{shared} of {all} matches are the same, scores differ by at most {:.3} %",
        score * 100.0
    )
}

fn cells(features: &DenseFeatures) -> anyhow::Result<ArrayView2<'_, f32>> {
    let shape = (features.len(), features.channels());
    Ok(ArrayView2::from_shape(shape, features.cells())?)
}
