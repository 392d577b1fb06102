//! What reading signs is worth to `local`: recall@1 of its jobs on malls, whose shop fronts differ in their names only, and
//! on streets, over a real server with a reader and one without. The peer ranks the candidates by the words that both
//! pictures have in common, each with its inverse document frequency in the map, and by nothing else.
//!
//! `cargo bench --bench signs [-- SEED...]`. Needs the reader (`make reader`).

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabouts_core::text_search::Folded;
use whereabouts_testkit::server::Server;
use whereabouts_town::{SUCCESS_RADIUS_M, Town, TownScene, TownSpec};
use whereabouts_vision::decode::encode_jpeg;

/// No seed of these was looked at while `local` learned to read.
const SEEDS: [u64; 5] = [31, 32, 33, 34, 35];
const PLACES: usize = 40;

/// Words by image or frame.
type Words = BTreeSet<Vec<char>>;

/// How many frames have an image of their place first.
#[derive(Debug, Default, Clone, Copy)]
struct Found {
    frames: usize,
    at_once: usize,
    without: usize,
    peer: usize,
    with: usize,
    /// Wrong with reading and right without, and the other way round.
    lost: usize,
    won: usize,
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let asked: Vec<u64> = std::env::args().filter_map(|arg| arg.parse().ok()).collect();
    let seeds = if asked.is_empty() { SEEDS.to_vec() } else { asked };
    println!("R@1 in percent, within {SUCCESS_RADIUS_M} m, {PLACES} places and frames a seed");
    println!("scene    seed  at once  local  words by idf  local with signs  won  lost");
    for scene in [TownScene::Mall, TownScene::Streets] {
        let mut all = Found::default();
        for &seed in &seeds {
            let found =
                measure(TownSpec { scene, seed, places: PLACES, ..TownSpec::default() }).await?;
            print_row(scene, &seed.to_string(), found);
            all = Found {
                frames: all.frames + found.frames,
                at_once: all.at_once + found.at_once,
                without: all.without + found.without,
                peer: all.peer + found.peer,
                with: all.with + found.with,
                lost: all.lost + found.lost,
                won: all.won + found.won,
            };
        }
        print_row(scene, "all", all);
    }
    Ok(())
}

fn print_row(scene: TownScene, seed: &str, found: Found) {
    let percent = |count: usize| 100.0 * count as f64 / found.frames as f64;
    println!(
        "{:8} {seed:>4}  {:7.1}  {:5.1}  {:12.1}  {:16.1}  {:3}  {:4}",
        format!("{scene:?}").to_lowercase(),
        percent(found.at_once),
        percent(found.without),
        percent(found.peer),
        percent(found.with),
        found.won,
        found.lost
    );
}

async fn measure(spec: TownSpec) -> anyhow::Result<Found> {
    let town = Town::new(spec);
    let without = refined(&town, false).await?;
    let with = refined(&town, true).await?;
    let mut found = Found { frames: town.places(), ..Found::default() };
    for place in 0..town.places() {
        let is_right = |image: Option<&str>| image == Some(&format!("place-{place}"));
        let (before, after) = (is_right(without[place].first()), is_right(with[place].first()));
        found.at_once += usize::from(is_right(with[place].at_once.as_deref()));
        found.without += usize::from(before);
        found.with += usize::from(after);
        found.peer += usize::from(is_right(with[place].by_words.as_deref()));
        found.won += usize::from(after && !before);
        found.lost += usize::from(before && !after);
    }
    Ok(found)
}

/// What came of a frame.
struct Outcome {
    at_once: Option<String>,
    ranking: Vec<String>,
    by_words: Option<String>,
}

impl Outcome {
    fn first(&self) -> Option<&str> {
        self.ranking.first().map(String::as_str)
    }
}

/// Refines one frame of each place on a server of its own.
async fn refined(town: &Town, reads: bool) -> anyhow::Result<Vec<Outcome>> {
    let data = TempDir::new()?;
    let reader = if reads { "ppocrv5" } else { "" };
    let server = Server::start_for_benchmark(
        "xfeat",
        data.path(),
        &[("WHEREABOUTS_READING__READER", reader)],
    );
    server.put("/maps/m", json!({"frame": "metric"})).await.expect(201);
    for place in 0..town.places() {
        let shot = town.reference(place);
        let path = format!("/maps/m/images?id=place-{place}&x={}&y={}", shot.x, shot.y);
        server.post_jpeg(&path, encode_jpeg(&shot.image)?).await.expect(201);
    }
    if reads {
        wait_until_read(&server).await?;
    }
    let mut words = BTreeMap::new();
    for place in 0..town.places() {
        let id = format!("place-{place}");
        let image = server.get(&format!("/maps/m/images/{id}")).await.expect(200);
        words.insert(id, words_of(&image["texts"]["lines"]));
    }
    let mut outcomes = Vec::new();
    for place in 0..town.places() {
        let frame = encode_jpeg(&town.query(place, 0).image)?;
        let answer = server.post_jpeg("/localize?map=m&refine=wait", frame).await.expect(200);
        let href = answer["job"]["href"].as_str().context("no job")?;
        let job = server.get(href).await.expect(200);
        let ranking = answer["ranking"].as_array().context("the job did not end")?;
        let id = |candidate: &Value| candidate["image_id"].as_str().map(str::to_owned);
        let ranking: Vec<String> = ranking.iter().filter_map(id).collect();
        let by_words = by_words(&words, &words_of(&job["texts"]), &ranking);
        let at_once = id(&answer["candidates"][0]);
        outcomes.push(Outcome { at_once, ranking, by_words });
    }
    Ok(outcomes)
}

async fn wait_until_read(server: &Server) -> anyhow::Result<()> {
    loop {
        let map = server.get("/maps/m").await.expect(200);
        ensure!(map["texts"].is_object(), "there is no reader; install it with `make reader`");
        if map["texts"]["waiting"] == 0 {
            return Ok(());
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

fn words_of(lines: &Value) -> Words {
    let texts = lines.as_array().into_iter().flatten().filter_map(|line| line["text"].as_str());
    texts
        .flat_map(|text| Folded::new(text).words().map(<[char]>::to_vec).collect::<Vec<_>>())
        .collect()
}

/// The peer: the candidate with the most words of the frame, rare words counting more.
fn by_words(map: &BTreeMap<String, Words>, frame: &Words, candidates: &[String]) -> Option<String> {
    let idf = |word: &Vec<char>| {
        let images = map.values().filter(|words| words.contains(word)).count();
        (map.len() as f64 / images.max(1) as f64).ln()
    };
    let score = |id: &String| map[id].intersection(frame).map(idf).sum::<f64>();
    // The first of equals by id, since the ranking has seen the signs.
    let mut candidates: Vec<&String> = candidates.iter().collect();
    candidates.sort();
    candidates.into_iter().rev().max_by(|a, b| score(a).total_cmp(&score(b))).cloned()
}
