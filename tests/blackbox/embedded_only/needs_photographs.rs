//! Real photographs, where they are at hand: `../shared/data`, or the folder `WHEREABOUTS_DATA`.
//!
//! Indexed over HTTP, restarted in between, localized, refined, and scored by R@1.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{BINARY, Server};

pub fn data(set: &str) -> Option<PathBuf> {
    let root = std::env::var_os("WHEREABOUTS_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let folder = root.join(set);
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("SKIPPED: no photographs at {}; set WHEREABOUTS_DATA to test with", root.display());
    None
}

fn ground_truth(folder: &Path) -> HashMap<String, HashSet<String>> {
    let text = std::fs::read_to_string(folder.join("ground_truth.csv")).unwrap();
    let rows = text.lines().skip(1).filter_map(|line| line.split_once(','));
    rows.map(|(query, references)| {
        (query.to_owned(), references.split(' ').map(str::to_owned).collect())
    })
    .collect()
}

/// Percent of queries with a true image among the first 1, 5 and 10.
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

/// Indexes, restarts, localizes and refines a set; the recall before and after.
async fn evaluate(set: &str, references: &str, queries: &str) -> Option<(Recall, Recall)> {
    let folder = data(set)?;
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
    Some(recalls)
}

#[tokio::test]
async fn refinement_in_the_corridor_reaches_90_percent() {
    let Some((before, after)) = evaluate("corridor", "ref", "query").await else { return };
    assert!(before.at[0] >= 60.0 && before.at[2] >= 90.0, "{before:?}");
    assert!(after.at[0] >= 90.0, "{after:?}");
    assert!(after.at[2] >= before.at[2], "{before:?} {after:?}");
}

#[tokio::test]
async fn refinement_in_the_tower_does_no_harm() {
    let Some((before, after)) = evaluate("tower", "database", "queries").await else { return };
    assert!(after.at[0] >= before.at[0], "{before:?} {after:?}");
}
