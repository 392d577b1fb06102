//! `whereabouts eval` as a user types it.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use exif::{Field, In, Rational, Tag};
use serde_json::Value;
use tempfile::TempDir;

use crate::mock_mllm::{MockMllm, Reply, Script};
use crate::support::{BINARY, frame, reference};
use crate::wait::until;

/// Folders with references and queries, and room for the output.
struct Folders {
    dir: TempDir,
}

impl Folders {
    fn new() -> Self {
        let dir = TempDir::new().unwrap();
        std::fs::create_dir(dir.path().join("database")).unwrap();
        std::fs::create_dir(dir.path().join("queries")).unwrap();
        Self { dir }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    /// A town whose `places` are 100 m apart, with positions in the file names, and a query of each.
    fn town(places: usize) -> Self {
        let folders = Self::new();
        for place in 0..places {
            let easting = 1000.0 + 100.0 * place as f64;
            folders.write(&format!("database/@{easting:.1}@5.0@.jpg"), reference(place));
            folders.write(&format!("queries/@{:.1}@9.0@q@.jpg", easting + 3.0), frame(place, 0));
        }
        folders
    }

    fn command(&self, args: &[&str]) -> Command {
        self.command_by("xfeat", args)
    }

    fn command_by(&self, model: &str, args: &[&str]) -> Command {
        let mut command = Command::new(&*BINARY);
        command
            .current_dir(self.dir.path())
            .args(["eval", "--database", "database", "--queries", "queries", "--work", "work"])
            .args(["--json", "--model", model])
            .args(args)
            .env("WHEREABOUTS_MODEL__ASSETS", Path::new(env!("CARGO_MANIFEST_DIR")).join("assets"))
            .env("WHEREABOUTS_MODEL__THREADS", "1");
        command
    }

    fn eval(&self, args: &[&str]) -> Value {
        json(&self.command(args).output().unwrap())
    }

    fn refused(&self, args: &[&str]) -> String {
        let output = self.command(args).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    }
}

pub fn json(output: &Output) -> Value {
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{error}");
    serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{error}"))
}

pub fn recalls(summary: &Value) -> Vec<[f64; 3]> {
    let methods = summary["methods"].as_array().unwrap();
    let of = |method: &Value, k: &str| method["recall"][k].as_f64().unwrap();
    methods.iter().map(|method| ["1", "5", "10"].map(|k| of(method, k))).collect()
}

fn names(summary: &Value) -> Vec<&str> {
    let methods = summary["methods"].as_array().unwrap();
    methods.iter().map(|method| method["name"].as_str().unwrap()).collect()
}

#[test]
fn a_town_is_evaluated_and_reported_as_json_csv_and_html() {
    let folders = Folders::town(12);
    // A query far from every reference, with a name that must be escaped.
    folders.write("queries/@1.0@90000.0@<b>@.jpg", frame(13, 0));
    let summary = folders.eval(&["--out", "out"]);
    assert_eq!((&summary["queries"], &summary["skipped"]), (&12.into(), &1.into()));
    assert_eq!(names(&summary), ["vlad", "vlad+local"]);
    let [before, after] = recalls(&summary)[..] else { panic!("{summary}") };
    assert!(after[0] >= before[0] && after[0] >= 75.0, "{summary}");
    assert!(before[0] <= before[1] && before[1] <= before[2], "{summary}");
    let change = &summary["methods"][1]["change"];
    let sum: u64 =
        ["helped", "harmed", "left_alone"].iter().map(|key| change[key].as_u64().unwrap()).sum();
    assert_eq!(sum, 12);

    let csv = std::fs::read_to_string(folders.path("out/predictions.csv")).unwrap();
    // 13 queries, two methods, a line for each reference, and a header.
    assert_eq!(csv.lines().count(), 1 + 13 * 2 * 12);
    let first =
        csv.lines().filter(|line| line.contains(",vlad+local,1,") && line.contains(",yes,"));
    let share = 100.0 * first.count() as f64 / 12.0;
    assert!((share - after[0]).abs() < 1e-9, "the CSV says {share}");

    let page = std::fs::read_to_string(folders.path("out/report.html")).unwrap();
    assert!(page.contains("data:image/jpeg;base64,") && page.contains("<svg"));
    for outside in ["<script", "http://", "https://", "<link", "<b>@"] {
        assert!(!page.contains(outside), "{outside}");
    }
    let kept: Value =
        serde_json::from_slice(&std::fs::read(folders.path("out/summary.json")).unwrap()).unwrap();
    assert_eq!(kept["methods"], summary["methods"]);
}

#[test]
fn a_sample_has_the_requested_size() {
    let folders = Folders::town(6);
    let summary = folders.eval(&["--sample", "4", "--seed", "3", "--refine", "off"]);
    assert_eq!(summary["queries"], 4);
    assert_eq!(names(&summary), ["vlad"]);
}

#[test]
fn every_dataset_layout_gives_the_same_recall() {
    let folders = Folders::town(6);
    let expected = recalls(&folders.eval(&["--refine", "off"]));
    // Names in the order of the places.
    let other = Folders::new();
    let (mut database, mut queries, mut truth) =
        ("file,lat,lon\n".to_owned(), "file,lat,lon\n".to_owned(), "query,references\n".to_owned());
    for place in 0..6 {
        other.write(&format!("database/r{place}.jpg"), reference(place));
        other.write(&format!("queries/q{place}.jpg"), frame(place, 0));
        database.push_str(&format!("r{place}.jpg,45.00{place},7\n"));
        queries.push_str(&format!("q{place}.jpg,45.00{place}01,7\n"));
        truth.push_str(&format!("q{place}.jpg,r{place}.jpg\n"));
    }
    assert_eq!(recalls(&other.eval(&["--refine", "off", "--frame-tolerance", "0"])), expected);
    let refused = other.refused(&["--refine", "off"]);
    assert!(refused.contains("--ground-truth") && refused.contains("6 of 6"), "{refused}");
    other.write("truth.csv", &truth);
    let named = other.eval(&["--refine", "off", "--ground-truth", "truth.csv"]);
    assert_eq!(recalls(&named), expected);
    other.write("database.csv", &database);
    other.write("queries/poses.csv", &queries);
    let posed = ["--refine", "off", "--database-poses", "database.csv", "--threshold-m", "30"];
    assert_eq!(recalls(&other.eval(&posed)), expected);
    // Next to the folders it is found without being named.
    std::fs::remove_file(other.path("queries/poses.csv")).unwrap();
    other.write("ground_truth.csv", &truth);
    assert_eq!(recalls(&other.eval(&["--refine", "off"])), expected);
}

#[test]
fn a_changed_folder_is_indexed_again() {
    let folders = Folders::town(4);
    assert_eq!(recalls(&folders.eval(&["--refine", "off"]))[0][2], 100.0);
    // One reference is removed, and another is replaced.
    std::fs::remove_file(folders.path("database/@1000.0@5.0@.jpg")).unwrap();
    folders.write("database/@1100.0@5.0@.jpg", reference(40));
    let summary = folders.eval(&["--refine", "off"]);
    assert_eq!((&summary["references"], &summary["skipped"]), (&3.into(), &1.into()));
    std::fs::remove_dir_all(folders.path("work")).unwrap();
    let fresh = folders.eval(&["--refine", "off"]);
    assert_eq!(summary["methods"][0]["recall"], fresh["methods"][0]["recall"]);
}

#[test]
fn a_picture_that_cannot_be_decoded_is_named() {
    let folders = Folders::town(3);
    folders.write("database/@1000.0@5.0@.jpg", "text");
    let refused = folders.refused(&["--refine", "off"]);
    assert!(refused.contains("@1000.0@5.0@.jpg"), "{refused}");
}

async fn kill_when(mut child: Child, enough: impl Fn() -> bool) {
    until(async || {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it was killed");
        enough()
    })
    .await;
    child.kill().unwrap();
    child.wait().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_killed_run_is_resumed_and_pays_for_no_description_twice() {
    let folders = Folders::town(6);
    let script = Script { latency: Duration::from_millis(20), ..Script::default() };
    let mock = MockMllm::start(script).await;
    let url = mock.url();
    let args = ["--refine", "local,mllm", "--mllm-base-url", &url, "-k", "4", "--out", "out"];
    let mut command = folders.command(&args);
    let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    kill_when(child, || mock.reason_calls() >= 2).await;

    let summary = folders.eval(&args);
    assert_eq!(names(&summary), ["vlad", "vlad+local", "vlad+mllm"]);
    assert_eq!(mock.pairs().len(), 6 * 4);
    // Only pairs that were in flight at the kill are described again.
    assert!(mock.asked_again() <= 8, "{}", mock.asked_again());
    let [before, _, after] = recalls(&summary)[..] else { panic!("{summary}") };
    assert_eq!(before[1], after[1], "the same four, in another order");
    let usage = &summary["methods"][2]["usage"];
    assert!(usage["calls"].as_u64().unwrap() >= 6, "{usage}");
    assert_eq!(summary["methods"][2]["degraded"], 0);
    let page = std::fs::read_to_string(folders.path("out/report.html")).unwrap();
    assert!(page.contains("calls,"));

    let (described, reasoned) = (mock.describe_calls(), mock.reason_calls());
    let again = folders.eval(&args);
    assert_eq!(again["methods"], summary["methods"]);
    assert_eq!((mock.describe_calls(), mock.reason_calls()), (described, reasoned));
}

#[tokio::test(flavor = "multi_thread")]
async fn the_work_of_the_fallback_is_not_printed_as_the_models_and_the_exit_code_tells() {
    let folders = Folders::town(4);
    let script = Script {
        describe: Box::new(|_| Reply::Status(401, "no such key".into())),
        ..Script::default()
    };
    let mock = MockMllm::start(script).await;
    let url = mock.url();
    let args = ["--refine", "both", "--mllm-base-url", &url, "-k", "4"];
    let output = folders.command(&args).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("4 of 4 queries were not fully refined by vlad+mllm"), "{error}");
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(names(&summary), ["vlad", "vlad+local", "vlad+mllm"]);
    let methods = &summary["methods"];
    assert_eq!(methods[2]["recall"], methods[0]["recall"]);
    assert_eq!(methods[2]["degraded"], 4);
    assert!(methods[2]["degraded_why"].as_str().unwrap().contains("no such key"));
}

#[test]
fn queries_of_unmapped_places_measure_the_known_flag() {
    let folders = Folders::town(8);
    std::fs::create_dir(folders.path("elsewhere")).unwrap();
    for place in 20..26 {
        folders.write(&format!("elsewhere/{place}.jpg"), frame(place, 1));
    }
    let summary = folders.eval(&["--unknown", "elsewhere", "--refine", "off"]);
    assert_eq!((&summary["queries"], &summary["unknown"]), (&8.into(), &6.into()));
    let known = &summary["methods"][0]["known"];
    let auc = known["auc"].as_f64().unwrap();
    assert!((0.0..=1.0).contains(&auc) && known["at_95"]["recall"].as_f64().unwrap() >= 0.95);
}

/// Inserts a position into the EXIF block of a JPEG.
fn with_gps(jpeg: &[u8], lat: f64, lon: f64) -> Vec<u8> {
    let degrees = |angle: f64| {
        let part =
            |value: f64, denom: u32| Rational { num: (value * f64::from(denom)) as u32, denom };
        let minutes = angle.fract() * 60.0;
        let parts =
            [part(angle.trunc(), 1), part(minutes.trunc(), 1), part(minutes.fract() * 60.0, 1000)];
        exif::Value::Rational(parts.into())
    };
    let text = |letter: &str| exif::Value::Ascii(vec![letter.into()]);
    let fields = [
        (Tag::GPSLatitudeRef, text("N")),
        (Tag::GPSLatitude, degrees(lat)),
        (Tag::GPSLongitudeRef, text("E")),
        (Tag::GPSLongitude, degrees(lon)),
    ]
    .map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let mut writer = exif::experimental::Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut tiff = std::io::Cursor::new(Vec::new());
    writer.write(&mut tiff, false).unwrap();
    let tiff = tiff.into_inner();
    let length = (tiff.len() + 8) as u16;
    let segment = [&[0xFF, 0xE1][..], &length.to_be_bytes(), b"Exif\0\0", &tiff].concat();
    [&jpeg[..2], &segment, &jpeg[2..]].concat()
}

#[test]
fn positions_are_read_from_exif() {
    let folders = Folders::new();
    for place in 0..6 {
        // 0.001° of latitude are 111 m.
        let lat = 45.0 + 0.001 * place as f64;
        let image = with_gps(&reference(place), lat, 7.0);
        folders.write(&format!("database/{place}.jpg"), image);
        // 16 m to the east.
        let query = with_gps(&frame(place, 0), lat, 7.0002);
        folders.write(&format!("queries/{place}.jpg"), query);
    }
    let near = folders.eval(&["--refine", "off", "--threshold-m", "25"]);
    assert_eq!((&near["queries"], &near["skipped"]), (&6.into(), &0.into()));
    assert_eq!(recalls(&near)[0][2], 100.0);
    let refused = folders.refused(&["--refine", "off", "--threshold-m", "10"]);
    assert!(refused.contains("none of the 6 queries has a correct reference"), "{refused}");
}

#[test]
fn both_descriptors_of_a_transformer_are_evaluated() {
    let folders = Folders::town(5);
    let model = folders.path("assets/models/tiny-tokens");
    std::fs::create_dir_all(&model).unwrap();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/models/tiny-tokens");
    for file in ["manifest.toml", "model.onnx"] {
        std::fs::copy(fixture.join(file), model.join(file)).unwrap();
    }
    let args = ["--descriptor", "gem,cls", "--refine", "local"];
    let mut command = folders.command_by("tiny-tokens", &args);
    command.env("WHEREABOUTS_MODEL__ASSETS", folders.path("assets"));
    let summary = json(&command.output().unwrap());
    assert_eq!(names(&summary), ["gem", "gem+local", "cls", "cls+local"]);
    // Random weights describe badly, but with five places R@5 is always 100 %.
    assert!(recalls(&summary).iter().all(|at| at[1] == 100.0), "{summary}");
}

#[test]
fn held_out_references_are_unknown_places() {
    let folders = Folders::town(12);
    let summary = folders.eval(&["--refine", "off", "--hold-out", "0.25"]);
    let counts = ["queries", "unknown", "references"].map(|name| summary[name].clone());
    assert_eq!(counts, [9, 3, 9].map(Value::from));
    let called = &summary["methods"][0]["known"]["called"];
    assert_eq!(called["threshold"], 0.9);
    assert!(called["right"].is_number() && called["unknown"].is_number(), "{called}");
    let refused = folders.command(&["--hold-out", "1"]).output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("from 0 to below 1"));
}

#[test]
fn frames_are_in_natural_order() {
    let folders = Folders::new();
    for place in 0..11 {
        folders.write(&format!("database/{place}.jpg"), reference(place));
        folders.write(&format!("queries/{:02}.jpg", place), frame(place, 0));
    }
    let summary = folders.eval(&["--refine", "off", "--frame-tolerance", "0"]);
    assert!(recalls(&summary)[0][0] >= 70.0, "{summary}");
    assert!(summary["truth"].as_str().unwrap().contains("natural order"), "{summary}");
    // A missing frame would shift all after it.
    std::os::unix::fs::symlink("/nowhere.jpg", folders.path("queries/05a.jpg")).unwrap();
    let refused = folders.refused(&["--refine", "off", "--frame-tolerance", "0"]);
    assert!(refused.contains("05a.jpg") && refused.contains("order"), "{refused}");
}

#[test]
fn an_image_without_a_position_is_left_out_and_named() {
    let folders = Folders::town(4);
    folders.write("database/overview.jpg", reference(30));
    folders.write("database/._@1000.0@5.0@.jpg", "of a Mac");
    folders.write("queries/no-fix.jpg", frame(31, 0));
    let output = folders.command(&["--refine", "off"]).output().unwrap();
    let summary = json(&output);
    let counts = ["queries", "skipped", "references"].map(|name| summary[name].clone());
    assert_eq!(counts, [4, 1, 4].map(Value::from));
    assert_eq!(summary["left_out"]["references"], serde_json::json!(["overview.jpg"]));
    let text = String::from_utf8_lossy(&output.stderr);
    for name in ["overview.jpg", "._@1000.0@5.0@.jpg", "no-fix.jpg"] {
        assert!(text.contains(name), "{name}: {text}");
    }
}
