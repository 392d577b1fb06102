//! How well signs are read: on towns, whose signs are known, the share of the signs over shops that is read right, by the
//! height of their letters, and the share of what is read where nothing is written.
//!
//! `cargo bench --bench reading [-- SEED...]`. Needs the reader (`make reader`).

use std::path::Path;

use whereabouts_core::text_search::Folded;
use whereabouts_core::{MediaType, TextLine};
use whereabouts_reading::{OnnxReader, Reader, ReaderSettings};
use whereabouts_town::{Town, TownScene, TownSpec, VisibleSign};
use whereabouts_vision::{Assets, Picture};

const SEEDS: [u64; 2] = [41, 42];
const PLACES: usize = 60;

/// Bounds of the heights of letters in pixels.
const HEIGHTS: [f32; 6] = [6.0, 8.0, 10.0, 12.0, 16.0, 24.0];

/// Signs count of which at least this share is not covered.
const UNCOVERED: f32 = 0.95;

#[derive(Default)]
struct Counts {
    /// For each range of heights: signs that are whole, and those of them that were read right.
    signs: [(usize, usize); HEIGHTS.len()],
    lines: usize,
    /// Lines where no letters are.
    invented: usize,
}

fn main() -> anyhow::Result<()> {
    let asked: Vec<u64> = std::env::args().filter_map(|arg| arg.parse().ok()).collect();
    let seeds = if asked.is_empty() { SEEDS.to_vec() } else { asked };
    let settings = ReaderSettings { name: "ppocrv5".into(), threads: 2, max_lines: 200 };
    let reader = OnnxReader::load(&Assets::locate(Some(Path::new("assets"))), &settings)?;
    for scene in [TownScene::Streets, TownScene::Mall] {
        for (name, variant) in [("map images", None), ("frames", Some(0))] {
            let mut counts = Counts::default();
            for &seed in &seeds {
                let town =
                    Town::new(TownSpec { scene, seed, places: PLACES, ..TownSpec::default() });
                for place in 0..PLACES {
                    count(&mut counts, &reader, &town, (place, variant))?;
                }
            }
            report(&format!("{scene:?}").to_lowercase(), name, &counts);
        }
    }
    Ok(())
}

fn count(
    counts: &mut Counts,
    reader: &OnnxReader,
    town: &Town,
    (place, variant): (usize, Option<u32>),
) -> anyhow::Result<()> {
    let (shot, signs, letters) = town.with_signs(place, variant);
    let (width, height) = shot.image.dimensions();
    let (pixels, media_type) = (shot.image, MediaType::Jpeg);
    let lines =
        reader.read(&Picture { pixels, width, height, media_type, warnings: Vec::new() })?;
    let scaled = |line: &TextLine| line.corners.map(|[x, y]| [x * width as f32, y * height as f32]);
    counts.lines += lines.len();
    counts.invented += lines.iter().filter(|line| letters.within(&scaled(line)) == 0).count();
    for sign in signs {
        let range = HEIGHTS.iter().rposition(|least| sign.letter_height >= *least);
        let Some(range) = range else { continue };
        if sign.uncovered < UNCOVERED || !sign.is_within(width, height) {
            continue;
        }
        counts.signs[range].0 += 1;
        let is_read = lines.iter().any(|line| is_right(&sign, &line.text, &scaled(line)));
        counts.signs[range].1 += usize::from(is_read);
    }
    Ok(())
}

/// Whether a line is the text of a sign, and begins and ends near it.
fn is_right(sign: &VisibleSign, text: &str, corners: &[[f32; 2]; 4]) -> bool {
    let middle = |corners: &[[f32; 2]; 4]| {
        [0, 1].map(|axis| corners.iter().map(|corner| corner[axis]).sum::<f32>() / 4.0)
    };
    let (one, other) = (middle(&sign.corners), middle(corners));
    let apart = (one[0] - other[0]).hypot(one[1] - other[1]);
    Folded::new(text).chars == Folded::new(sign.text).chars && apart < 2.0 * sign.letter_height
}

fn report(scene: &str, pictures: &str, counts: &Counts) {
    println!(
        "{scene}, {pictures}: {} lines, {} of them where nothing is written",
        counts.lines, counts.invented
    );
    for (range, (signs, right)) in counts.signs.into_iter().enumerate() {
        let most = HEIGHTS.get(range + 1).map_or("more".to_owned(), |most| format!("{most:.0}"));
        let percent = 100.0 * right as f64 / signs.max(1) as f64;
        println!(
            "  letters of {:2.0} to {most:>4} pixels: {signs:4} signs, {percent:5.1} % read right",
            HEIGHTS[range]
        );
    }
    let large = counts.signs.iter().zip(HEIGHTS).filter(|(_, least)| *least >= 12.0);
    let (signs, right) = large.fold((0, 0), |all, (one, _)| (all.0 + one.0, all.1 + one.1));
    println!(
        "  12 pixels and more: {:.1} % of {signs}",
        100.0 * right as f64 / signs.max(1) as f64
    );
}
