//! Localization from words alone: two towns, of which one is the map. Descriptions are what is read in frames of other
//! visits: all of it or one or two lines, as names or in small letters. Frames of the other town describe places that are
//! not in the map, with signs of the same names. The peer is a search for the image with the most words in common.
//!
//! `cargo bench --bench words [-- PLACES]`. Needs the reader (`make reader`).

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::json;
use whereabouts_core::text_search::Folded;
use whereabouts_core::words::{Described, Fit, WordsModel, find_signs, runs};
use whereabouts_core::{CalibrationSettings, MediaType, Pose, SamePlace, TextLine};
use whereabouts_reading::{OnnxReader, Reader, ReaderSettings};
use whereabouts_town::{Shot, Town, TownSpec};
use whereabouts_vision::{Assets, Picture};

/// Seeds of the map and of another town. The demo has seed 7.
const SEEDS: [(u64, u64); 3] = [(8, 9), (21, 22), (33, 34)];

/// From this probability, a place counts as known: `localize.known_confidence`.
const KNOWN: f64 = 0.9;

/// How a frame is described.
const KINDS: [(&str, usize, bool); 6] = [
    ("all lines, as names", usize::MAX, true),
    ("two lines, as names", 2, true),
    ("one line, as a name", 1, true),
    ("all lines, in small letters", usize::MAX, false),
    ("two lines, in small letters", 2, false),
    ("one line, in small letters", 1, false),
];

struct Read {
    lines: Vec<TextLine>,
    pose: Pose,
}

fn main() -> anyhow::Result<()> {
    let places = std::env::args().skip(1).find_map(|arg| arg.parse().ok()).unwrap_or(160);
    let assets = Assets::locate(Some(Path::new("assets")));
    let settings = ReaderSettings { name: "ppocrv5".into(), threads: 2, max_lines: 200 };
    let reader = OnnxReader::load(&assets, &settings)?;
    let mut towns = Vec::new();
    for (seed, other) in SEEDS {
        let town = |seed| Town::new(TownSpec { seed, places, ..TownSpec::default() });
        let (town, other) = (town(seed), town(other));
        let read = |shot: Shot| read(&reader, shot);
        let map: Vec<Read> =
            (0..places).map(|at| read(town.reference(at))).collect::<Result<_, _>>()?;
        let seen: Vec<Read> =
            (0..places).map(|at| read(town.query(at, 0))).collect::<Result<_, _>>()?;
        let off: Vec<Read> =
            (0..places).map(|at| read(other.query(at, 0))).collect::<Result<_, _>>()?;
        towns.push((map, seen, off));
    }
    println!("{} maps of {places} images; right: within 25 m", SEEDS.len());
    println!(
        "{:28} {:>6} {:>7} {:>7} {:>7} {:>8} {:>9}",
        "described by", "asked", "peer", "first", "known", "of them", "off map"
    );
    println!(
        "{:28} {:>6} {:>7} {:>7} {:>7} {:>8} {:>9}",
        "", "", "R@1 %", "R@1 %", "%", "right %", "known %"
    );
    let mut bins = [(0.0, 0, 0); 10];
    for (name, most, as_names) in KINDS {
        let [mut asked, mut peer, mut first, mut known, mut right, mut off_asked, mut off_known] =
            [0; 7];
        for (map, seen, off) in &towns {
            for frame in seen {
                let Some(text) = described(frame, most, as_names) else { continue };
                asked += 1;
                peer += usize::from(by_words(map, &text).is_some_and(|at| near(&map[at], frame)));
                let Some(fit) = best(map, &text) else { continue };
                let is_right = near(&map[fit.image], frame);
                first += usize::from(is_right);
                known += usize::from(fit.place >= KNOWN);
                right += usize::from(fit.place >= KNOWN && is_right);
                let bin = &mut bins[((fit.place * 10.0) as usize).min(9)];
                *bin = (bin.0 + fit.place, bin.1 + usize::from(is_right), bin.2 + 1);
            }
            for text in off.iter().filter_map(|frame| described(frame, most, as_names)) {
                off_asked += 1;
                off_known += usize::from(best(map, &text).is_some_and(|fit| fit.place >= KNOWN));
            }
        }
        let percent = |part: usize, of: usize| 100.0 * part as f64 / of.max(1) as f64;
        println!(
            "{name:28} {asked:6} {:7.1} {:7.1} {:7.1} {:8.1} {:9.1}",
            percent(peer, asked),
            percent(first, asked),
            percent(known, asked),
            percent(right, known),
            percent(off_known, off_asked)
        );
    }
    println!("probability  mean  right %  answers");
    for (at, (sum, right, count)) in bins.into_iter().enumerate().filter(|(_, bin)| bin.2 > 0) {
        let (low, count) = (at as f64 / 10.0, count as f64);
        println!(
            "from {low:.1}     {:.2}   {:6.1}  {count:7}",
            sum / count,
            100.0 * f64::from(right as u32) / count
        );
    }
    Ok(())
}

fn read(reader: &OnnxReader, shot: Shot) -> anyhow::Result<Read> {
    let (width, height) = shot.image.dimensions();
    let picture = Picture {
        pixels: shot.image,
        width,
        height,
        media_type: MediaType::Jpeg,
        warnings: Vec::new(),
    };
    let pose: Pose = serde_json::from_value(json!({"x": shot.x, "y": shot.y}))?;
    Ok(Read { lines: reader.read(&picture)?, pose })
}

fn near(one: &Read, other: &Read) -> bool {
    one.pose.distance_m(&other.pose).is_some_and(|distance| distance <= 25.0)
}

/// What someone says who sees the frame; `None` if nothing was read in it.
fn described(frame: &Read, most: usize, as_names: bool) -> Option<String> {
    let mut lines: Vec<&TextLine> = frame.lines.iter().collect();
    lines.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
    let said: Vec<String> = lines
        .iter()
        .take(most)
        .map(|line| match as_names {
            true => format!("\u{201c}{}\u{201d}", line.text),
            false => format!("there is a {}", line.text.to_lowercase()),
        })
        .collect();
    (!said.is_empty()).then(|| said.join(", and "))
}

/// The image that fits best, as the service finds it.
fn best(map: &[Read], text: &str) -> Option<Fit> {
    let lines: Vec<&[TextLine]> = map.iter().map(|image| image.lines.as_slice()).collect();
    let signs = find_signs(&runs(text), &lines);
    let places: Vec<_> =
        map.iter().enumerate().map(|(at, image)| (Some(at), Some(image.pose))).collect();
    let settings = CalibrationSettings { place_m: 25.0, ..CalibrationSettings::default() };
    let places = SamePlace::of(&places, map.len(), &settings);
    let described =
        Described { signs: &signs, with_signs: map.len(), images: map.len(), unread: 0 };
    described.fits(&WordsModel::default(), &places).into_iter().next()
}

/// The peer: the image with the most words of the text.
fn by_words(map: &[Read], text: &str) -> Option<usize> {
    let words = |text: &str| -> BTreeSet<Vec<char>> {
        Folded::new(text).words().map(<[char]>::to_vec).collect()
    };
    let asked = words(text);
    let common = |image: &Read| {
        image
            .lines
            .iter()
            .flat_map(|line| words(&line.text))
            .collect::<BTreeSet<_>>()
            .intersection(&asked)
            .count()
    };
    let counts: Vec<usize> = map.iter().map(common).collect();
    let most = counts.iter().copied().max().filter(|most| *most > 0)?;
    counts.iter().position(|count| *count == most)
}
