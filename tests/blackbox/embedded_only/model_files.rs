//! `whereabouts model`, against a hub that misbehaves on demand.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use serde_json::Value;
use tempfile::TempDir;

use crate::mock_hub::{Fault, Hub};
use crate::support::{BINARY, Server};
use crate::wait::until;

const FIXTURE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/fixtures/models/tiny-tokens");

pub fn fixture(file: &str) -> PathBuf {
    Path::new(FIXTURE).join(file)
}

/// An assets folder, and a catalogue with one model, `tiny`.
pub struct Bench {
    dir: TempDir,
}

impl Bench {
    pub fn new() -> Self {
        Self::with(|manifest| manifest)
    }

    /// A catalogue with the manifest of the fixture, changed by `change`.
    pub fn with(change: impl FnOnce(String) -> String) -> Self {
        let dir = TempDir::new().unwrap();
        let manifest = std::fs::read_to_string(fixture("manifest.toml")).unwrap();
        let manifest = change(manifest.replace("name = \"tiny-tokens\"", "name = \"tiny\""));
        let sections = ["input", "output", "pooling"].iter().fold(manifest, |text, section| {
            text.replace(&format!("[{section}]"), &format!("[model.manifest.{section}]"))
        });
        let entry = "[[model]]\nrepository = \"lab/tiny\"\nrevision = \"v1\"\npath = \"model.onnx\"\n\
                     licence_note = \"Nobody's.\"\n[model.manifest]\n";
        std::fs::write(dir.path().join("catalogue.toml"), format!("{entry}{sections}")).unwrap();
        Self { dir }
    }

    pub fn catalogue(&self) -> PathBuf {
        self.dir.path().join("catalogue.toml")
    }

    /// A catalogue without a pinned digest: the first download is trusted.
    pub fn unpinned() -> Self {
        Self::with(|manifest| {
            let lines: Vec<_> = manifest.lines().filter(|l| !l.starts_with("sha256")).collect();
            lines.join("\n")
        })
    }

    pub fn assets(&self) -> PathBuf {
        self.dir.path().join("assets")
    }

    pub fn models(&self) -> PathBuf {
        self.assets().join("models")
    }

    pub fn command(&self, hub: &str, args: &[&str]) -> Command {
        let mut command = Command::new(&*BINARY);
        command
            .arg("model")
            .args(args)
            .arg("--assets")
            .arg(self.assets())
            .env("WHEREABOUTS_CATALOGUE", self.catalogue())
            .env("WHEREABOUTS_MODEL__HUB", hub)
            .env("WHEREABOUTS_MODEL__DOWNLOAD_BACKOFF_MS", "1")
            .env("WHEREABOUTS_MODEL__DOWNLOAD_STALL_S", "1");
        command
    }

    pub fn run(&self, hub: &str, args: &[&str]) -> Outcome {
        Outcome::of(&self.command(hub, args).output().unwrap())
    }

    /// Asserts that nothing is installed, not even partially.
    #[track_caller]
    pub fn nothing_is_installed(&self) {
        assert!(!self.models().join("tiny").exists());
        let list = self.run("http://127.0.0.1:9", &["list", "--json"]).good();
        let list: Value = serde_json::from_str(&list).unwrap();
        let tiny = list["models"].as_array().unwrap().iter().find(|line| line["name"] == "tiny");
        assert_eq!(tiny.unwrap()["state"], "available");
    }

    #[track_caller]
    fn tiny_is_installed(&self) {
        let installed = std::fs::read(self.models().join("tiny/model.onnx")).unwrap();
        assert!(installed == std::fs::read(fixture("model.onnx")).unwrap());
        self.run("http://127.0.0.1:9", &["verify", "tiny"]).good();
    }
}

pub struct Outcome {
    code: Option<i32>,
    pub out: String,
    err: String,
}

impl Outcome {
    pub fn of(output: &Output) -> Self {
        let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        Self { code: output.status.code(), out: text(&output.stdout), err: text(&output.stderr) }
    }

    #[track_caller]
    pub fn good(self) -> String {
        assert_eq!(self.code, Some(0), "{}{}", self.out, self.err);
        self.out
    }

    /// Asserts that the command failed and that its error contains all of these words.
    #[track_caller]
    pub fn bad(self, words: &[&str]) {
        assert_eq!(self.code, Some(1), "{}{}", self.out, self.err);
        for word in words {
            assert!(self.err.contains(word), "{word:?} is not in: {}", self.err);
        }
    }
}

async fn hub(faults: &[Fault]) -> Hub {
    Hub::start(std::fs::read(fixture("model.onnx")).unwrap(), faults).await
}

/// Runs `model pull` off the async threads, which the hub needs.
async fn pull(bench: &Bench, hub: &Hub) -> Outcome {
    let mut command = bench.command(&hub.url, &["pull", "tiny"]);
    let run = tokio::task::spawn_blocking(move || command.output().unwrap());
    Outcome::of(&run.await.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_model_is_pulled_once_and_then_served() {
    let (bench, hub) = (Bench::new(), hub(&[]).await);
    let said = pull(&bench, &hub).await.good();
    assert!(said.contains("as pinned by the catalogue") && said.contains("Apache-2.0"), "{said}");
    bench.tiny_is_installed();
    let licence = std::fs::read_to_string(bench.models().join("tiny/LICENCE")).unwrap();
    assert!(licence.contains("Apache-2.0") && licence.contains("Nobody's."), "{licence}");
    assert_eq!(hub.requested_paths(), ["/lab/tiny/resolve/v1/model.onnx"]);
    let again = pull(&bench, &hub).await.good();
    assert!(again.contains("already installed"), "{again}");
    assert_eq!(hub.requested_paths().len(), 1);

    bench.run(&hub.url, &["use", "tiny"]).good();
    let assets = bench.assets();
    let settings = [
        ("WHEREABOUTS_MODEL__ASSETS", assets.to_str().unwrap()),
        ("WHEREABOUTS_MODEL__NAME", "auto"),
    ];
    let data = TempDir::new().unwrap();
    let server = Server::start(data.path(), &settings);
    server.town("m", 2).await;
    assert_eq!(server.get("/maps/m").await.expect(200)["model"], "tiny");
    assert!(server.log().contains("chosen in"), "{}", server.log());
}

#[tokio::test(flavor = "multi_thread")]
async fn an_external_weights_file_is_pulled_with_the_model() {
    let data = "[model.manifest.data]\nfile = \"weights.bin\"\n[input]";
    let bench = Bench::with(|manifest| manifest.replace("[input]", data));
    let cut = Fault::CutAfter(1000);
    let hub = hub(&[Fault::None, cut]).await;
    pull(&bench, &hub).await.good();
    let paths = hub.requested_paths();
    assert_eq!(paths[..2], ["/lab/tiny/resolve/v1/model.onnx", "/lab/tiny/resolve/v1/weights.bin"]);
    bench.tiny_is_installed();
    let weights = bench.models().join("tiny/weights.bin");
    std::fs::write(&weights, "others").unwrap();
    bench.run(&hub.url, &["verify", "tiny"]).bad(&["model pull tiny"]);
    assert!(pull(&bench, &hub).await.good().contains("replaced"));
    bench.tiny_is_installed();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_broken_download_is_resumed_and_no_byte_is_sent_twice() {
    let bench = Bench::new();
    let hub = hub(&[Fault::CutAfter(6_000), Fault::CutAfter(6_000), Fault::CutAfter(6_000)]).await;
    pull(&bench, &hub).await.good();
    bench.tiny_is_installed();
    assert_eq!(hub.requested_paths().len(), 4);
    let whole = std::fs::metadata(fixture("model.onnx")).unwrap().len();
    // Bytes in flight at a cut may be lost, but the rest is not requested again.
    assert!(hub.sent() >= whole && hub.sent() <= whole + 3 * 6_000, "{} bytes", hub.sent());
    assert!(hub.ranges()[1..].iter().any(Option::is_some), "{:?}", hub.ranges());
}

#[tokio::test(flavor = "multi_thread")]
async fn transient_errors_of_the_hub_are_retried() {
    for fault in [Fault::Status(500), Fault::Status(429), Fault::Hang, Fault::StallAfter(5_000)] {
        let (bench, hub) = (Bench::new(), hub(&[fault]).await);
        pull(&bench, &hub).await.good();
        bench.tiny_is_installed();
    }
    // A server without range support sends everything again.
    let bench = Bench::new();
    let hub = hub(&[Fault::CutAfter(9_000), Fault::IgnoreRange]).await;
    pull(&bench, &hub).await.good();
    bench.tiny_is_installed();
    // 416: the partial file cannot be resumed.
    let bench = Bench::new();
    let hub = self::hub(&[Fault::CutAfter(9_000), Fault::Status(416)]).await;
    pull(&bench, &hub).await.good();
    bench.tiny_is_installed();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_that_changes_during_a_download_is_downloaded_again() {
    let bench = Bench::unpinned();
    let hub = hub(&[Fault::CutAfter(9_000), Fault::Change]).await;
    pull(&bench, &hub).await.good();
    let installed = std::fs::read(bench.models().join("tiny/model.onnx")).unwrap();
    assert!(installed == hub.file(), "parts of two files were mixed");
}

#[tokio::test(flavor = "multi_thread")]
async fn corrupt_bytes_are_rejected_and_removed() {
    let (bench, hub) = (Bench::new(), hub(&[Fault::Corrupt]).await);
    pull(&bench, &hub).await.bad(&["is pinned", "removed", "again", "model.hub"]);
    bench.nothing_is_installed();
    pull(&bench, &hub).await.good();
    bench.tiny_is_installed();
    assert_eq!(hub.ranges(), [None, None]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_failing_hub_is_named_with_a_hint() {
    let (bench, hub) = (Bench::new(), hub(&[Fault::Status(404)]).await);
    pull(&bench, &hub).await.bad(&["404", "/lab/tiny/resolve/v1/model.onnx", "model add"]);
    assert_eq!(hub.requested_paths().len(), 1, "a 404 is not asked again");
    let hub = self::hub(&[Fault::Status(503); 6]).await;
    pull(&bench, &hub).await.bad(&["gave up", "6 attempts", "503", "model.hub"]);
    bench.run("http://127.0.0.1:9", &["pull", "tiny"]).bad(&["gave up", "model.hub"]);
    bench.run(&hub.url, &["pull", "other"]).bad(&["only tiny", "model add"]);
    bench.run(&hub.url, &["pull", "xfeat"]).bad(&["make build"]);
    bench.nothing_is_installed();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_file_above_the_size_limit_is_rejected_and_removed() {
    for fault in [Fault::None, Fault::NoLength] {
        let (bench, hub) = (Bench::new(), hub(&[fault]).await);
        let mut command = bench.command(&hub.url, &["pull", "tiny"]);
        command.env("WHEREABOUTS_MODEL__MAX_DOWNLOAD_BYTES", "10000");
        let run = tokio::task::spawn_blocking(move || command.output().unwrap());
        Outcome::of(&run.await.unwrap()).bad(&["more than 10000", "max_download_bytes"]);
        bench.nothing_is_installed();
        assert!(!bench.models().join(".partial/tiny-model.onnx").exists());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_pull_installs_nothing_and_is_resumed() {
    let bench = Bench::new();
    let hub = hub(&[Fault::StallAfter(12_000)]).await;
    let mut killed = Killed(
        bench
            .command(&hub.url, &["pull", "tiny"])
            .env("WHEREABOUTS_MODEL__DOWNLOAD_STALL_S", "60")
            .stderr(Stdio::null())
            .spawn()
            .unwrap(),
    );
    let partial = bench.models().join(".partial/tiny-model.onnx");
    until(async || std::fs::metadata(&partial).map_or(0, |file| file.len()) >= 12_000).await;
    // A second pull does not interfere with it.
    pull(&bench, &hub).await.bad(&["another process is installing tiny"]);
    killed.0.kill().unwrap();
    killed.0.wait().unwrap();
    bench.nothing_is_installed();
    pull(&bench, &hub).await.good();
    bench.tiny_is_installed();
    assert_eq!(hub.ranges(), [None, Some("bytes=12000-".to_owned())]);
    let whole = std::fs::metadata(fixture("model.onnx")).unwrap().len();
    assert_eq!(hub.sent(), whole);
}

/// Kills the process when dropped.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn without_a_pin_the_first_digest_is_recorded_and_enforced() {
    let (bench, hub) = (Bench::unpinned(), hub(&[]).await);
    let said = pull(&bench, &hub).await.good();
    assert!(said.contains("recorded in its manifest"), "{said}");
    let shown: Value =
        serde_json::from_str(&bench.run(&hub.url, &["show", "tiny", "--json"]).good()).unwrap();
    let digest = shown["manifest"]["sha256"].as_str().unwrap().to_owned();
    assert!(said.contains(&digest) && shown["installed"] == true, "{shown}");

    let file = bench.models().join("tiny/model.onnx");
    let mut bytes = std::fs::read(&file).unwrap();
    bytes[10_000] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let verified = bench.run(&hub.url, &["verify", "tiny", "--json"]);
    let verdict: Value = serde_json::from_str(&verified.out).unwrap();
    assert_eq!(verdict["models"][0]["ok"], false);
    verified.bad(&["model pull tiny"]);
    let said = pull(&bench, &hub).await.good();
    assert!(said.contains("replaced"), "{said}");
    bench.tiny_is_installed();
}

#[test]
fn a_local_file_is_added_and_selected_without_a_hub() {
    let bench = Bench::new();
    let run = |args: &[&str]| bench.run("http://127.0.0.1:9", args);
    let (file, manifest) = (fixture("model.onnx"), fixture("manifest.toml"));
    let (file, manifest) = (file.to_str().unwrap(), manifest.to_str().unwrap());
    let said = run(&["add", file, "--manifest", manifest, "--name", "mine"]).good();
    assert!(said.contains("model use mine"), "{said}");
    run(&["add", file, "--manifest", manifest, "--name", "../mine"])
        .bad(&["is not a valid model name"]);
    run(&["add", manifest, "--manifest", manifest]).bad(&["text file", "--manifest"]);
    run(&["add", file, "--manifest", file]).bad(&["manifest"]);

    let in_use = || -> String {
        let list: Value = serde_json::from_str(&run(&["list", "--json"]).good()).unwrap();
        list["in_use"]["name"].as_str().unwrap().to_owned()
    };
    run(&["use", "mine"]).good();
    assert_eq!(in_use(), "mine");
    run(&["use", "no-such-model"]).bad(&["not installed", "model list"]);
    assert_eq!(in_use(), "mine");
    let said = run(&["use", "auto"]).good();
    assert!(said.contains("in use:") && in_use() != "mine", "{said}");
    let text = run(&["list"]).good();
    assert!(text.contains("mine") && text.contains("available"), "{text}");
    assert!(run(&["show", "mine"]).good().contains("[pooling]"));
    run(&["show", "no-such-model"]).bad(&["model list"]);
}
