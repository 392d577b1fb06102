//! A JPEG of 1280×720 to a 224×224 tensor on one core, by this crate and by OpenCV and torchvision on
//! the same files: `PYTHON=$(benches/peers/setup.sh) cargo bench --bench preprocess`. Without that
//! Python, the peers are skipped with a message.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::Context;
use whereabouts_core::DescriptorKind;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::{decode, encode_jpeg};
use whereabouts_vision::manifest::{Input, Interpolation, Resize};
use whereabouts_vision::preprocess::{needed, preprocess};
use whereabouts_vision::{Assets, Extractor, ExtractorSettings, FeatureSet, ImageLimits, Needed};

const PICTURES: usize = 12;
const ROUNDS: usize = 15;
const LIMITS: ImageLimits = ImageLimits { max_pixels: 10_000_000 };

fn main() -> anyhow::Result<()> {
    let spec = TownSpec { places: PICTURES, width: 1280, height: 720, ..TownSpec::default() };
    let town = Town::new(spec);
    let files = (0..PICTURES).map(|place| encode_jpeg(&town.reference(place).image));
    let files = files.collect::<Result<Vec<_>, _>>()?;
    let bytes = files.iter().map(Vec::len).sum::<usize>() / files.len();
    println!("{PICTURES} pictures of the town, 1280×720, {} kB each", bytes / 1000);
    let input = Input {
        name: String::new(),
        width: 224,
        height: 224,
        resize: Resize::CentreCrop,
        interpolation: Interpolation::Bicubic,
        multiple: 14,
        mean: [0.485, 0.456, 0.406],
        std: [0.229, 0.224, 0.225],
    };
    let exact = measure(&files, &input, Needed::All)?;
    let fast = measure(&files, &input, needed(&input))?;
    println!("whereabouts, image.exact = true    {exact:.2} ms");
    println!("whereabouts                        {fast:.2} ms");
    say_similarity(&files)?;
    match peers(&files) {
        Ok(peers) => {
            for (name, ms) in &peers {
                println!("{name:<33}  {ms:.2} ms");
            }
            for (name, ms) in &peers {
                println!("{:.2} × the time of {name}, {:.2} × if exact", fast / ms, exact / ms);
            }
        }
        Err(error) => println!("the peers were not run: {error:#}"),
    }
    Ok(())
}

/// The median over the files of the minimum over some rounds, in milliseconds.
fn measure(files: &[Vec<u8>], input: &Input, needed: Needed) -> anyhow::Result<f64> {
    let mut times = Vec::new();
    for file in files {
        let mut least = Duration::MAX;
        for _ in 0..ROUNDS {
            let start = Instant::now();
            let picture = decode(file, LIMITS, needed)?;
            preprocess(&picture.pixels, (picture.width, picture.height), input)?;
            least = least.min(start.elapsed());
        }
        times.push(least);
    }
    times.sort();
    Ok(times[times.len() / 2].as_secs_f64() * 1e3)
}

/// How similar the descriptors of both ways are.
fn say_similarity(files: &[Vec<u8>]) -> anyhow::Result<()> {
    let load = |exact_decode| {
        let settings =
            ExtractorSettings { exact_decode, ..ExtractorSettings::plain("xfeat", 1, LIMITS) };
        Extractor::load(&Assets::locate(None), &settings)
    };
    let (exact, fast) = (load(true)?, load(false)?);
    let mut similarities = Vec::new();
    for file in files {
        let descriptor = |extractor: &Extractor| {
            extractor
                .extract(file, DescriptorKind::GEM, FeatureSet::DescriptorOnly)
                .map(|extraction| extraction.descriptor)
        };
        similarities.push(descriptor(&exact)?.similarity(&descriptor(&fast)?));
    }
    let least = similarities.iter().copied().fold(1.0, f32::min);
    println!("cosine of xfeat's descriptors, fast against exact: {least:.5} at the least");
    Ok(())
}

/// The time of each peer, in milliseconds.
fn peers(files: &[Vec<u8>]) -> anyhow::Result<Vec<(String, f64)>> {
    let dir = tempfile::tempdir()?;
    for (index, file) in files.iter().enumerate() {
        std::fs::write(dir.path().join(format!("{index:02}.jpg")), file)?;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/peers/preprocess.py");
    let python = std::env::var("PYTHON").unwrap_or_else(|_| "python3".into());
    let output = Command::new(python).arg(script).arg(dir.path()).arg(ROUNDS.to_string()).output();
    let output = output.context("cannot start Python")?;
    let said = String::from_utf8_lossy(&output.stderr);
    anyhow::ensure!(output.status.success(), "{}", said.lines().last().unwrap_or_default());
    let text = String::from_utf8(output.stdout)?;
    let lines = text.lines().filter_map(|line| line.split_once(' '));
    lines.map(|(name, ms)| Ok((name.to_owned(), ms.parse()?))).collect()
}
