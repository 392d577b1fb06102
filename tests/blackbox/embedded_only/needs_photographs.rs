//! Real photographs: sets with their ground truth in `../shared/data`, or in the folder `WHEREABOUTS_DATA`.
//!
//! Indexed over HTTP, restarted in between, localized, refined, and scored by R@1; and evaluated by
//! `whereabouts eval`. `tests/optional.sh` runs these tests where the photographs are.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::eval::{json, recalls};
use crate::support::{BINARY, Server};

fn data(set: &str) -> PathBuf {
    let root = std::env::var_os("WHEREABOUTS_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let folder = root.join(set);
    assert!(
        folder.is_dir(),
        "there are no photographs at {}: set WHEREABOUTS_DATA",
        root.display()
    );
    folder
}

fn ground_truth(folder: &Path) -> HashMap<String, HashSet<String>> {
    let text = std::fs::read_to_string(folder.join("ground_truth.csv")).unwrap();
    let rows = text.lines().skip(1).filter_map(|line| line.split_once(','));
    rows.map(|(query, references)| {
        (query.to_owned(), references.split(' ').map(str::to_owned).collect())
    })
    .collect()
}

/// Percentage of queries with a correct image among the first 1, 5 and 10.
#[derive(Debug, Default)]
struct Recall {
    at: [f64; 3],
}

impl Recall {
    fn of(ranked: &[(String, Vec<String>)], truth: &HashMap<String, HashSet<String>>) -> Self {
        let mut recall = Self::default();
        for (query, ids) in ranked {
            for (sum, k) in recall.at.iter_mut().zip([1, 5, 10]) {
                let found = ids.iter().take(k).any(|id| truth[query].contains(id));
                *sum += f64::from(u8::from(found)) * 100.0 / ranked.len() as f64;
            }
        }
        recall
    }
}

fn ids(list: &Value) -> Vec<String> {
    let of = |item: &Value| item["image_id"].as_str().unwrap().to_owned();
    list.as_array().unwrap().iter().map(of).collect()
}

/// Indexes a set, restarts, localizes and refines; returns the recall before and after refinement.
async fn evaluate(set: &str, references: &str, queries: &str) -> (Recall, Recall) {
    let folder = data(set);
    let truth = ground_truth(&folder);
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    let references = folder.join(references);
    let status = Command::new(&*BINARY)
        .args(["index", references.to_str().unwrap(), "--map", set, "--scene", "indoor"])
        .args(["--server", &server.url])
        .status()
        .unwrap();
    assert!(status.success());
    server.kill();
    let server = Server::start(dir.path(), &[]);

    let (mut coarse, mut refined) = (Vec::new(), Vec::new());
    let mut names: Vec<_> = truth.keys().cloned().collect();
    names.sort();
    for name in names {
        let frame = std::fs::read(folder.join(queries).join(&name)).unwrap();
        let path = format!("/localize?map={set}&k=10&refine=wait");
        let answer = server.post_jpeg(&path, frame).await.expect(200);
        let job = server.get(answer["job"]["href"].as_str().unwrap()).await.expect(200);
        assert_eq!(job["state"], "succeeded", "{job}");
        coarse.push((name.clone(), ids(&answer["candidates"])));
        refined.push((name, ids(&job["ranking"])));
    }
    let recalls = (Recall::of(&coarse, &truth), Recall::of(&refined, &truth));
    eprintln!("{set}: R@1/5/10 {:.1?} before, {:.1?} after", recalls.0.at, recalls.1.at);
    recalls
}

#[tokio::test]
#[ignore = "needs photographs"]
async fn refinement_in_the_corridor_reaches_90_percent() {
    let (before, after) = evaluate("corridor", "ref", "query").await;
    assert!(before.at[0] >= 60.0 && before.at[2] >= 90.0, "{before:?}");
    assert!(after.at[0] >= 90.0, "{after:?}");
    assert!(after.at[2] >= before.at[2], "{before:?} {after:?}");
}

#[tokio::test]
#[ignore = "needs photographs"]
async fn refinement_in_the_tower_does_no_harm() {
    let (before, after) = evaluate("tower", "database", "queries").await;
    assert!(after.at[0] >= before.at[0], "{before:?} {after:?}");
}

/// The summary of `whereabouts eval` on a set, with a graph however small the map is.
fn eval(set: &str, [database, queries]: [&str; 2], args: &[&str]) -> Value {
    let folder = data(set);
    let work = TempDir::new().unwrap();
    let output = Command::new(&*BINARY)
        .args(["eval", "--json", "--scene", "indoor", "--model", "xfeat", "--refine", "off"])
        .args([Path::new("--work"), work.path(), Path::new("--database"), &folder.join(database)])
        .args([Path::new("--queries"), &folder.join(queries)])
        .args(args)
        // Each run has a folder of its own, and would choose a provider for itself.
        .env("WHEREABOUTS_MODEL__PROVIDER", "cpu")
        .env("WHEREABOUTS_MODEL__PRECISION", "full")
        .env("WHEREABOUTS_INDEX__EXACT_UP_TO", "0")
        .env("WHEREABOUTS_MODEL__THREADS", "1")
        .output()
        .unwrap();
    json(&output)
}

#[test]
#[ignore = "needs photographs"]
fn the_graph_and_the_exact_search_have_the_same_recall() {
    for (set, folders) in [("corridor", ["ref", "query"]), ("tower", ["database", "queries"])] {
        let (graph, exact) = (eval(set, folders, &[]), eval(set, folders, &["--exact"]));
        assert_eq!((&graph["search"], &exact["search"]), (&"fast".into(), &"exact".into()));
        assert_eq!(graph["skipped"], 0);
        assert_eq!(recalls(&graph), recalls(&exact), "{set}");
    }
}
