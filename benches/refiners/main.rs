//! How much refiners find, what they call known, and what they cost: `whereabouts eval` with the refiners `local`,
//! `mllm` and `cascade` on sets of which half serves as the map and half as places outside it.
//!
//! The model is a *mock* that is told the truth, with habits: always right, wrong in a fifth of the frames, always
//! certain, always wrong. The peers of the calibrated confidence are in the table: `local` alone, the similarity of the
//! image that the model put first, and the model's certainty taken at its word.
//!
//! ```text
//! cargo bench --bench refiners                       # a town of 160 places
//! cargo bench --bench refiners -- 800                # a larger one
//! cargo bench --bench refiners -- FOLDER DB QUERIES  # a folder with ground_truth.csv and these two folders
//! REFINERS_MODEL_CALLS=220 cargo bench --bench refiners   # confidence.model_calls
//! REFINERS_HOLD_OUT=0 cargo bench --bench refiners        # all of the set is the map
//! WHEREABOUTS_CASCADE__CANDIDATES=3 cargo bench --bench refiners   # any setting of the service
//! ```

#![allow(
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "it uses what the black-box tests use"
)]

mod oracle;
mod sets;

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use anyhow::{Context, bail};
use serde_json::Value;
use tempfile::TempDir;
use whereabouts_testkit::mock_mllm::MockMllm;
use whereabouts_testkit::server::BINARY;

use oracle::{Habit, Truth, script};
use sets::TestSet;

/// The refiners, in the order of the table.
const REFINERS: &str = "local,mllm,cascade";

fn main() -> anyhow::Result<()> {
    let folder = TempDir::new()?;
    let args: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with("--")).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let set = match args.as_slice() {
        [] => TestSet::town(160, 7, folder.path())?,
        [places] => TestSet::town(places.parse()?, 7, folder.path())?,
        [set, database, queries] => TestSet::folder(Path::new(set), database, queries)?,
        _ => bail!("expected nothing, a number of places, or FOLDER DATABASE QUERIES"),
    };
    let truth = Arc::new(Truth::of(&set)?);
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        for habit in Habit::ALL {
            let mock = MockMllm::start(script(Arc::clone(&truth), habit)).await;
            let work = folder.path().join(format!("work-{habit:?}"));
            let (url, set) = (mock.url(), &set);
            let summary = tokio::task::block_in_place(|| evaluate(set, &url, &work))?;
            print(set, habit, &summary);
            let violations = mock.violations();
            if !violations.is_empty() {
                bail!("{} calls were malformed: {}", violations.len(), violations[0]);
            }
        }
        Ok(())
    })
}

fn evaluate(set: &TestSet, url: &str, work: &Path) -> anyhow::Result<Value> {
    let given = |name: &str, default: &str| std::env::var(name).unwrap_or_else(|_| default.into());
    let calls = given("REFINERS_MODEL_CALLS", "0");
    let hold_out = given("REFINERS_HOLD_OUT", "0.5");
    let output = Command::new(&*BINARY)
        .args(["eval", "--json", "--model", "xfeat", "-k", "10", "--hold-out", &hold_out])
        .args(["--refine", REFINERS, "--mllm-base-url", url])
        .arg("--database")
        .arg(&set.database)
        .arg("--queries")
        .arg(&set.queries)
        .arg("--ground-truth")
        .arg(&set.truth)
        .arg("--work")
        .arg(work)
        .env("WHEREABOUTS_MODEL__ASSETS", Path::new(env!("CARGO_MANIFEST_DIR")).join("assets"))
        .env("WHEREABOUTS_CONFIDENCE__MODEL_CALLS", calls)
        .env("WHEREABOUTS_MLLM__CHECK_AT_START", "false")
        .env("WHEREABOUTS_MLLM__REQUESTS_PER_MINUTE", "0")
        .env("WHEREABOUTS_MLLM__TOKENS_PER_MINUTE", "0")
        .env("WHEREABOUTS_MLLM__TOKENS_PER_JOB", "0")
        .env("WHEREABOUTS_MLLM__TOKENS_PER_DAY", "0")
        .output()?;
    serde_json::from_slice(&output.stdout)
        .with_context(|| String::from_utf8_lossy(&output.stderr).into_owned())
}

fn print(set: &TestSet, habit: Habit, summary: &Value) {
    println!(
        "\n{}: {} references, {} frames in the map, {} outside it; the model: {}",
        set.name,
        summary["references"],
        summary["queries"],
        summary["unknown"],
        habit.name()
    );
    println!(
        "{:<22} {:>6} {:>12} {:>12} {:>14} {:>12}",
        "", "R@1", "known: right", "wrong", "outside", "calls/frame"
    );
    let frames = summary["queries"].as_f64().unwrap() + summary["unknown"].as_f64().unwrap();
    let percent = |rate: &Value| match rate.as_f64() {
        Some(rate) => format!("{:.1}", 100.0 * rate),
        None => "-".into(),
    };
    let row = |name: &str, recall: &str, rates: &Value, calls: &str| {
        let [right, wrong, outside] =
            ["right", "wrong", "unknown"].map(|kind| percent(&rates[kind]));
        println!("{name:<22} {recall:>6} {right:>12} {wrong:>12} {outside:>14} {calls:>12}");
    };
    for method in summary["methods"].as_array().unwrap() {
        // `cascade` finds descriptions that `mllm` has bought: they count as calls.
        let count = |kind: &str| method["usage"][kind].as_f64().unwrap();
        let calls = (count("calls") + count("cached")) / frames;
        let recall = format!("{:.1}", method["recall"]["1"].as_f64().unwrap());
        let name = method["name"].as_str().unwrap();
        row(name, &recall, &method["known"]["called"], &format!("{calls:.2}"));
        if method["alternatives"].is_object() {
            row("  by similarity", "", &method["alternatives"]["similarity"], "");
            row("  by its word", "", &method["alternatives"]["stated"], "");
        }
        if method["degraded"] != 0 {
            println!("  {} degraded: {}", method["degraded"], method["degraded_why"]);
        }
    }
}
