//! `whereabouts demo`: which model it uses, and why.

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::mock_hub::{Hub, Trouble};
use super::model_files::{Bench, fixture};
use super::support::BINARY;

/// A catalogue whose `dinov2-small` is a tiny model, so that the demo has it at once; and the binary
/// away from the checkout, whatever is installed there.
fn bench() -> Bench {
    let bench =
        Bench::with(|manifest| manifest.replace("name = \"tiny\"", "name = \"dinov2-small\""));
    let checkout = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets");
    std::fs::create_dir_all(bench.assets().join("models")).unwrap();
    for folder in ["onnxruntime", "models/xfeat"] {
        symlink(checkout.join(folder), bench.assets().join(folder)).unwrap();
    }
    std::fs::copy(&*BINARY, binary(&bench)).unwrap();
    bench
}

fn binary(bench: &Bench) -> PathBuf {
    bench.assets().with_file_name("whereabouts")
}

async fn hub(troubles: &[Trouble]) -> Hub {
    Hub::start(std::fs::read(fixture("model.onnx")).unwrap(), troubles).await
}

/// The outcome of a demo, and what it wrote to the standard error.
async fn demo(bench: &Bench, hub: &str, more: &[&str]) -> (Value, String) {
    let out = TempDir::new().unwrap();
    let mut command = Command::new(binary(bench));
    command
        .args(["demo", "--places", "3", "--json", "--out"])
        .arg(out.path().join("out"))
        .args(more)
        .env("WHEREABOUTS_CATALOGUE", bench.catalogue())
        .env("WHEREABOUTS_MODEL__ASSETS", bench.assets())
        .env("WHEREABOUTS_MODEL__HUB", hub)
        .env("WHEREABOUTS_MODEL__HUB_PATIENCE_S", "1")
        .env("WHEREABOUTS_MODEL__DOWNLOAD_BACKOFF_MS", "1")
        .env("WHEREABOUTS_MODEL__DOWNLOAD_STALL_S", "1");
    let output = tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    (serde_json::from_slice(&output.stdout).unwrap(), said)
}

#[track_caller]
fn uses(outcome: &Value, model: &str, why: &str) {
    assert_eq!(outcome["model"], model, "{outcome}");
    assert!(outcome["why"].as_str().unwrap().contains(why), "{outcome}");
}

#[tokio::test(flavor = "multi_thread")]
async fn it_installs_dinov2_where_the_hub_answers_and_finds_it_the_next_time() {
    let (bench, hub) = (bench(), hub(&[]).await);
    let (outcome, said) = demo(&bench, &hub.url, &[]).await;
    uses(&outcome, "dinov2-small", "installed from");
    assert!(said.contains("downloading"), "{said}");
    assert_eq!(hub.asked().len(), 2, "one look, one download");
    let (outcome, _) = demo(&bench, &hub.url, &[]).await;
    uses(&outcome, "dinov2-small", "the first installed DINOv2 model");
    assert_eq!(hub.asked().len(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flag_decides_and_asks_nobody() {
    let (bench, hub) = (bench(), hub(&[]).await);
    let (outcome, _) = demo(&bench, &hub.url, &["--offline"]).await;
    uses(&outcome, "xfeat", "--offline");
    let (outcome, _) = demo(&bench, &hub.url, &["--model", "xfeat"]).await;
    uses(&outcome, "xfeat", "set by model.name");
    assert_eq!(hub.asked().len(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hub_that_cannot_be_reached_or_breaks_off_is_not_waited_for() {
    let (outcome, _) = demo(&bench(), "http://127.0.0.1:9", &[]).await;
    uses(&outcome, "xfeat", "no connection");
    for (trouble, why) in [
        (vec![Trouble::Hang], "no answer within 1 s"),
        (vec![Trouble::Status(503)], "503"),
        (vec![Trouble::None, Trouble::Corrupt], "could not be installed"),
        (vec![Trouble::None, Trouble::StallAfter(100), Trouble::StallAfter(100)], "gave up"),
    ] {
        let (outcome, _) = demo(&bench(), &hub(&trouble).await.url, &[]).await;
        uses(&outcome, "xfeat", why);
    }
}
