//! `whereabouts model add` and `verify` with models that are wrong in one way each, written by
//! `deploy/models/make_odd_models.py`.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use serde_json::Value;
use tempfile::TempDir;

use super::model_files::{Bench, fixture};
use crate::mock_hub::{Fault, Hub};

/// The folder of the odd models.
static ODD: LazyLock<TempDir> = LazyLock::new(|| {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR"));
    let packages = std::fs::read_to_string(repository.join("assets/.python"))
        .expect("run `make assets` first: it gets the Python packages that this needs");
    let (python, packages) = packages.trim().split_once('\n').unwrap();
    let folder = TempDir::new().unwrap();
    let output = Command::new(python)
        .env("PYTHONPATH", packages)
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .arg(repository.join("deploy/models/make_odd_models.py"))
        .arg(folder.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    folder
});

fn odd(name: &str) -> PathBuf {
    ODD.path().join(name).join("model.onnx")
}

/// The manifest of the unchanged model without its pinned digest, with a change.
fn manifest(bench: &Bench, change: impl Fn(&str) -> String) -> PathBuf {
    let text = std::fs::read_to_string(fixture("manifest.toml")).unwrap();
    let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
    let file = bench.catalogue().with_file_name("given.toml");
    std::fs::write(&file, change(&unpinned.join("\n"))).unwrap();
    file
}

const HUB: &str = "http://127.0.0.1:9";

fn add(bench: &Bench, file: &Path, manifest: &Path, name: &str) -> super::model_files::Outcome {
    let (file, manifest) = (file.to_str().unwrap(), manifest.to_str().unwrap());
    bench.run(HUB, &["add", file, "--manifest", manifest, "--name", name])
}

#[test]
fn a_wrong_model_is_refused_with_what_to_do_and_nothing_is_installed() {
    let bench = Bench::new();
    let unchanged = manifest(&bench, str::to_owned);
    for (name, words) in [
        ("input-name", &["no input called \"pixel_values\"", "\"images\"", "input.name"][..]),
        (
            "output-name",
            &["no output called \"last_hidden_state\"", "\"features\"", "output.features"],
        ),
        ("extra-input", &["\"temperature\"", "only input"]),
        ("bytes-in", &["pixel_values", "u8", "f32"]),
        ("double-out", &["last_hidden_state", "f64", "f32"]),
        (
            "other-size",
            &["28×28 pixels only", "is to get 56×42", "input.width = 28", "model.sizes"],
        ),
        ("frozen", &["224×224 pixels only", "declares any size", "is to get 56×42", "export"]),
        ("flat", &["cannot load", "standard operators"]),
        ("fewer-channels", &["last_hidden_state", "× 4 on a picture", "[output]"]),
        ("not-a-number", &["not finite", "damaged"]),
        ("half-overflow", &["not finite", "32 bits"]),
        ("same-for-all", &["same descriptor"]),
        ("all-zero", &["no cls descriptor", "found no features"]),
        ("new-opset", &["cannot load", "999"]),
        ("unknown-operator", &["cannot load", "NoSuchOperator"]),
        ("external-missing", &["model.onnx.data", "is missing", "next to the ONNX file"]),
        ("external-cut", &["model.onnx.data", "has 1000 bytes"]),
        ("external-outside", &["../outside.data", "not a file next to it"]),
        ("external-absolute", &["/etc/hostname", "not a file next to it"]),
    ] {
        let refused = add(&bench, &odd(name), &unchanged, name);
        refused.bad(&[words, &["was not installed"]].concat());
        assert!(!bench.models().join(name).exists(), "{name}");
    }
    let left: Vec<_> = std::fs::read_dir(bench.models()).unwrap().flatten().collect();
    assert!(
        left.iter().all(|entry| entry.file_name().to_string_lossy().starts_with('.')),
        "{left:?}"
    );
}

#[test]
fn a_file_that_is_no_model_is_refused_with_what_to_do() {
    let bench = Bench::new();
    let unchanged = manifest(&bench, str::to_owned);
    let whole = std::fs::read(odd("good")).unwrap();
    for (name, bytes, words) in [
        ("page", &b"<!DOCTYPE html><title>Sign in</title>"[..], ["HTML", "/resolve/"]),
        ("pointer", b"version https://git-lfs.github.com/spec/v1\noid", ["LFS", "git lfs pull"]),
        ("cut", &whole[..whole.len() / 2], ["incomplete", "again"]),
        ("nothing", b"", ["empty", "again"]),
        ("checkpoint", b"PK\x03\x04\x14\0\0\0", ["PyTorch", "torch.onnx.export"]),
        ("error", b"Repository not found", ["text file", ".onnx"]),
        ("noise", b"\x07\x93\xF0\x15\xB2", ["not an ONNX file", "where it comes from"]),
    ] {
        let file = bench.catalogue().with_file_name(format!("{name}.onnx"));
        std::fs::write(&file, bytes).unwrap();
        add(&bench, &file, &unchanged, name).bad(&words);
        assert!(!bench.models().join(name).exists(), "{name}");
    }
}

#[test]
fn external_weights_are_installed_wherever_the_model_says_that_they_are() {
    let bench = Bench::new();
    let unchanged = manifest(&bench, str::to_owned);
    for (name, weights) in [
        ("external-torch", "model.onnx.data"),
        ("external-hub", "model.onnx_data"),
        ("external-below", "weights/all.bin"),
    ] {
        add(&bench, &odd(name), &unchanged, name).good();
        let installed = bench.models().join(name).join(weights);
        let given = odd(name).with_file_name(weights);
        assert_eq!(std::fs::read(&installed).unwrap(), std::fs::read(given).unwrap(), "{name}");
        assert!(add(&bench, &odd(name), &unchanged, name).good().contains("already installed"));
        let said = bench.run(HUB, &["verify", name]).good();
        assert!(said.contains("good") && said.contains(" and "), "{said}");
        let mut bytes = std::fs::read(&installed).unwrap();
        bytes[0] ^= 1;
        std::fs::write(&installed, bytes).unwrap();
        bench.run(HUB, &["verify", name]).bad(&["model add"]);
    }
}

#[test]
fn models_with_16_bit_numbers_are_taken() {
    let bench = Bench::new();
    let unchanged = manifest(&bench, str::to_owned);
    for name in ["half", "half-output", "good"] {
        let said = add(&bench, &odd(name), &unchanged, name).good();
        assert!(said.contains("tried on two pictures"), "{said}");
        bench.run(HUB, &["verify", name]).good();
    }
}

#[test]
fn a_model_that_takes_one_picture_at_a_time_is_installed_with_a_note() {
    let bench = Bench::new();
    let unchanged = manifest(&bench, str::to_owned);
    let said = add(&bench, &odd("one-at-a-time"), &unchanged, "one").good();
    assert!(said.contains("model.max_batch = 1"), "{said}");
    let said = bench.run(HUB, &["verify", "one", "--json"]).good();
    let said: Value = serde_json::from_str(&said).unwrap();
    assert!(said["models"][0]["notes"][0].as_str().unwrap().contains("max_batch"), "{said}");
}

#[test]
fn a_manifest_that_does_not_fit_the_model_is_refused() {
    let bench = Bench::new();
    for (from, to, word) in [
        ("channels = 8", "channels = 16", "numbers"),
        ("registers = 2", "registers = 0", "numbers"),
        ("stride = 14", "stride = 7", "numbers"),
    ] {
        let dimension =
            if from.starts_with("channels") { "dimension = 16" } else { "dimension = 8" };
        let changed = manifest(&bench, |text| {
            assert!(text.contains(from) && text.contains("dimension = 8"), "{text}");
            text.replace(from, to).replace("dimension = 8", dimension)
        });
        add(&bench, &odd("good"), &changed, "m").bad(&[word, "[output]"]);
    }
}

#[test]
fn verify_runs_the_model_and_not_only_its_digest() {
    let bench = Bench::new();
    let unchanged = manifest(&bench, str::to_owned);
    add(&bench, &odd("good"), &unchanged, "m").good();
    // As if it had been installed without a trial.
    let folder = bench.models().join("m");
    std::fs::copy(odd("not-a-number"), folder.join("model.onnx")).unwrap();
    let text = std::fs::read_to_string(folder.join("manifest.toml")).unwrap();
    let unpinned: Vec<_> = text.lines().filter(|line| !line.starts_with("sha256")).collect();
    std::fs::write(folder.join("manifest.toml"), unpinned.join("\n")).unwrap();
    let verified = bench.run(HUB, &["verify", "m"]);
    assert!(
        verified.out.contains("bad") && verified.out.contains("not finite"),
        "{}",
        verified.out
    );
    verified.bad(&["model add"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_download_that_is_no_model_is_refused_and_not_resumed() {
    let bench = Bench::unpinned();
    let page = b"<!DOCTYPE html><title>Sign in</title>".to_vec();
    for (file, words) in [
        (page, ["HTML", "/resolve/"]),
        (std::fs::read(odd("other-size")).unwrap(), ["28×28 pixels only", "model.sizes"]),
    ] {
        let hub = Hub::start(file, &[Fault::None]).await;
        let mut command = bench.command(&hub.url, &["pull", "tiny"]);
        let run = tokio::task::spawn_blocking(move || command.output().unwrap());
        super::model_files::Outcome::of(&run.await.unwrap()).bad(&words);
        bench.nothing_is_installed();
    }
    let hub = Hub::start(std::fs::read(odd("good")).unwrap(), &[]).await;
    let mut command = bench.command(&hub.url, &["pull", "tiny"]);
    let run = tokio::task::spawn_blocking(move || command.output().unwrap());
    super::model_files::Outcome::of(&run.await.unwrap()).good();
}

#[tokio::test(flavor = "multi_thread")]
async fn external_weights_that_only_the_file_names_are_pulled() {
    let bench = Bench::unpinned();
    let files = ["model.onnx", "model.onnx_data"];
    let contents =
        files.map(|file| std::fs::read(odd("external-hub").with_file_name(file)).unwrap());
    let hub = Hub::start_with(contents[0].clone(), "model.onnx_data", contents[1].clone()).await;
    let mut command = bench.command(&hub.url, &["pull", "tiny"]);
    let run = tokio::task::spawn_blocking(move || command.output().unwrap());
    super::model_files::Outcome::of(&run.await.unwrap()).good();
    let paths = hub.requested_paths();
    assert_eq!(paths, files.map(|file| format!("/lab/tiny/resolve/v1/{file}")));
    let installed = std::fs::read(bench.models().join("tiny/model.onnx_data")).unwrap();
    assert!(installed == contents[1]);
    bench.run(&hub.url, &["verify", "tiny"]).good();
}
