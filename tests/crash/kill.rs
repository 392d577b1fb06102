//! The driver: several clients make changes, the server is killed, and what it acknowledged is compared with
//! what the next server returns.

use std::collections::BTreeMap;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;
use whereabouts_core::Digest;

use super::clients::{Client, Pictures, Random, pose_of};
use super::ledger::{Key, Stored};
use super::support::{BINARY, Server};
use super::wait::until;

/// Default number of rounds; `make crash` runs more.
const ROUNDS: usize = 20;
const CLIENTS: usize = 4;
const PICTURES: usize = 240;
/// Maximum time from the start of the process until it is ready, on a busy machine.
const QUICK: Duration = Duration::from_secs(10);
/// Every map has a graph, which has to catch up after a kill.
const GRAPH: (&str, &str) = ("WHEREABOUTS_INDEX__EXACT_UP_TO", "0");
/// Descriptors stay those of the vocabulary that the map has.
const NO_FITTING: (&str, &str) = ("WHEREABOUTS_VOCABULARY__OWN", "false");
const EXACT: (&str, &str) = ("WHEREABOUTS_INDEX__EXACT_UP_TO", "1000000");

fn number(name: &str, default: usize) -> usize {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

#[tokio::test(flavor = "multi_thread")]
async fn acknowledged_changes_survive_kill_9_at_any_moment() {
    let rounds = number("WHEREABOUTS_CRASH_ROUNDS", ROUNDS);
    let seed = number("WHEREABOUTS_CRASH_SEED", 1) as u64;
    let mut driver = Driver::new(seed);
    for round in 0..rounds {
        driver.round(round).await;
    }
    driver.end().await;
    println!(
        "{rounds} rounds (seed {seed}): {} changes acknowledged, {} images at the end, {} jobs; \
         slowest start {:?}",
        driver.clients.iter().map(|client| client.ledger.acknowledged).sum::<usize>(),
        driver.images(),
        driver.clients.iter().map(|client| client.ledger.jobs.len()).sum::<usize>(),
        driver.slowest
    );
}

struct Driver {
    dir: TempDir,
    random: Random,
    pictures: Arc<Pictures>,
    numbers: BTreeMap<String, usize>,
    clients: Vec<Client>,
    slowest: Duration,
}

impl Driver {
    fn new(seed: u64) -> Self {
        let pictures = Pictures::draw(PICTURES);
        let numbers =
            pictures.images.iter().map(|bytes| Digest::of(bytes).to_string()).zip(0..).collect();
        let clients = (0..CLIENTS).map(|number| Client::new(number, seed, &pictures)).collect();
        Self {
            dir: TempDir::new().unwrap(),
            random: Random(seed),
            pictures,
            numbers,
            clients,
            slowest: Duration::ZERO,
        }
    }

    fn images(&self) -> usize {
        self.clients.iter().map(|client| client.ledger.images.len()).sum()
    }

    fn start(&mut self, settings: &[(&str, &str)]) -> Server {
        let start = Instant::now();
        // Graphs are rebuilt often, and segments are compacted often.
        let settings = [settings, &[("WHEREABOUTS_INDEX__MAX_DEAD_SHARE", "0.1")]].concat();
        let server = Server::start(self.dir.path(), &settings);
        self.slowest = self.slowest.max(start.elapsed());
        assert!(start.elapsed() < QUICK, "the start took {:?}", start.elapsed());
        server
    }

    async fn round(&mut self, round: usize) {
        if self.random.below(4) == 0 {
            self.kill_while_starting();
        }
        let server = self.start(&[GRAPH]);
        self.check(&server, 8).await;
        let url = server.url.clone();
        let mut working = Vec::new();
        for mut client in self.clients.drain(..) {
            let url = url.clone();
            working.push(tokio::spawn(async move {
                client.work(&url).await;
                client
            }));
        }
        // The moment is what is tested: now and then just after the start, mostly in the middle of things.
        let moment = if round.is_multiple_of(5) { 50 } else { 900 };
        let moment = Duration::from_millis(self.random.below(moment) as u64);
        tokio::time::sleep(moment).await;
        server.kill();
        for client in working {
            self.clients.push(client.await.unwrap());
        }
    }

    fn kill_while_starting(&mut self) {
        let mut child = Command::new(&*BINARY)
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(self.dir.path())
            .env("WHEREABOUTS_MODEL__NAME", "xfeat")
            .env(GRAPH.0, GRAPH.1)
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // Any moment of the start is what is tested.
        std::thread::sleep(Duration::from_millis(self.random.below(300) as u64));
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Compares what the server has with what it acknowledged; checks the bytes of `closely` images.
    async fn check(&mut self, server: &Server, closely: usize) {
        let found = self.found(server).await;
        for client in &mut self.clients {
            client.ledger.settle(&found);
        }
        assert_eq!(self.images(), found.len(), "there is an image that no client has sent");
        let keys: Vec<&Key> = found.keys().collect();
        for _ in 0..closely.min(keys.len()) {
            let key = keys[self.random.below(keys.len())];
            self.look_closely(server, key, found[key].picture).await;
        }
        for client in &self.clients {
            for id in client.ledger.jobs.iter().rev().take(closely) {
                server.get(&format!("/jobs/{id}")).await.expect(200);
            }
        }
    }

    /// All images that the server lists.
    async fn found(&self, server: &Server) -> BTreeMap<Key, Stored> {
        let mut found = BTreeMap::new();
        for map in server.get("/maps").await.expect(200)["maps"].as_array().unwrap() {
            let map = map["name"].as_str().unwrap();
            let mut path = format!("/maps/{map}/images?limit=1000");
            loop {
                let page = server.get(&path).await.expect(200);
                for image in page["images"].as_array().unwrap() {
                    let id = image["id"].as_str().unwrap().to_owned();
                    let digest = image["digest"].as_str().unwrap();
                    let stored = Stored { picture: self.numbers[digest], pose: pose_of(image) };
                    found.insert((map.to_owned(), id), stored);
                }
                let Some(cursor) = page["next_cursor"].as_str() else { break };
                path = format!("/maps/{map}/images?limit=1000&cursor={cursor}");
            }
        }
        found
    }

    /// Asserts that the bytes of an image are there and that it is found by them.
    async fn look_closely(&self, server: &Server, key: &Key, picture: usize) {
        let (map, id) = key;
        let bytes = &self.pictures.images[picture];
        let content = server.get(&format!("/maps/{map}/images/{id}/content")).await;
        assert_eq!(&content.bytes, bytes, "{key:?}");
        let path = format!("/localize?map={map}&refine=off&k=100");
        let answer = server.post_jpeg(&path, bytes.clone()).await.expect(200);
        let candidates = answer["candidates"].as_array().unwrap();
        let itself = candidates.iter().find(|candidate| candidate["image_id"] == id.as_str());
        let similarity = itself.and_then(|candidate| candidate["similarity"].as_f64());
        assert!(similarity.is_some_and(|s| s > 0.999), "{key:?} is not found: {similarity:?}");
    }

    /// Asserts that everything is there, that every job ends, and that the graph finds what exact search finds.
    async fn end(&mut self) {
        let server = self.start(&[GRAPH, NO_FITTING]);
        self.check(&server, usize::MAX).await;
        let jobs: Vec<String> =
            self.clients.iter().flat_map(|client| client.ledger.jobs.clone()).collect();
        for id in jobs {
            let job = server.get(&format!("/jobs/{id}?wait=60")).await.expect(200);
            // Its candidates may have been removed since.
            assert!(["succeeded", "degraded"].contains(&job["state"].as_str().unwrap()), "{job}");
        }
        until(async || server.get("/maps/shared").await.expect(200)["index"] == "hnsw").await;
        let graph = self.answers(&server).await;
        server.kill();
        let server = self.start(&[EXACT, NO_FITTING]);
        let exact = self.answers(&server).await;
        let all: usize = exact.iter().map(Vec::len).sum();
        let same: usize = exact
            .iter()
            .zip(&graph)
            .map(|(exact, graph)| exact.iter().filter(|id| graph.contains(id)).count())
            .sum();
        let recall = same as f64 / all as f64;
        assert!(all > 0 && recall >= 0.99, "recall@10 is {recall}");
    }

    async fn answers(&self, server: &Server) -> Vec<Vec<Value>> {
        let mut answers = Vec::new();
        for frame in &self.pictures.frames {
            let path = "/localize?map=shared&refine=off&k=10";
            let answer = server.post_jpeg(path, frame.clone()).await.expect(200);
            let candidates = answer["candidates"].as_array().unwrap();
            answers.push(candidates.iter().map(|c| c["image_id"].clone()).collect());
        }
        answers
    }
}
