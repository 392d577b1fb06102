//! Which model `whereabouts demo` uses, and why.

use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::model_files::{Bench, fixture};
use crate::mock_hub::{Fault, Hub};
use crate::support::BINARY;

/// A catalogue whose `dinov2-small` is a tiny model, so that it is downloaded at once; and a copy of the binary
/// outside the checkout, so that the models installed there do not matter.
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

async fn hub(faults: &[Fault]) -> Hub {
    Hub::start(std::fs::read(fixture("model.onnx")).unwrap(), faults).await
}

/// Runs the demo; returns its summary and its standard error.
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
async fn dinov2_is_installed_if_the_hub_answers_and_found_the_next_time() {
    let (bench, hub) = (bench(), hub(&[]).await);
    let (outcome, said) = demo(&bench, &hub.url, &[]).await;
    uses(&outcome, "dinov2-small", "installed from");
    assert!(said.contains("downloading"), "{said}");
    assert_eq!(hub.requested_paths().len(), 2, "one look, one download");
    let (outcome, _) = demo(&bench, &hub.url, &[]).await;
    uses(&outcome, "dinov2-small", "the first installed DINOv2 model");
    assert_eq!(hub.requested_paths().len(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flag_overrides_the_choice_and_the_hub_is_not_contacted() {
    let (bench, hub) = (bench(), hub(&[]).await);
    let (outcome, _) = demo(&bench, &hub.url, &["--offline"]).await;
    uses(&outcome, "xfeat", "--offline");
    let (outcome, _) = demo(&bench, &hub.url, &["--model", "xfeat"]).await;
    uses(&outcome, "xfeat", "set by model.name");
    assert_eq!(hub.requested_paths().len(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unreachable_or_failing_hub_falls_back_to_the_built_in_model() {
    let (outcome, _) = demo(&bench(), "http://127.0.0.1:9", &[]).await;
    uses(&outcome, "xfeat", "no connection");
    for (fault, why) in [
        (vec![Fault::Hang], "no answer within 1 s"),
        (vec![Fault::Status(503)], "503"),
        (vec![Fault::None, Fault::Corrupt], "could not be installed"),
        (vec![Fault::None, Fault::StallAfter(100), Fault::StallAfter(100)], "gave up"),
    ] {
        let (outcome, _) = demo(&bench(), &hub(&fault).await.url, &[]).await;
        uses(&outcome, "xfeat", why);
    }
}
