//! `whereabouts index` on folders as people have them.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};
use tempfile::TempDir;

use super::support::{BINARY, Server, reference, shared_server};

/// A folder of pictures of different places.
fn folder(names: &[&str]) -> TempDir {
    let folder = TempDir::new().unwrap();
    for (place, name) in names.iter().enumerate() {
        write(&folder, name, reference(place));
    }
    folder
}

fn write(folder: &TempDir, name: &str, bytes: impl AsRef<[u8]>) {
    let file = folder.path().join(name);
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    std::fs::write(file, bytes).unwrap();
}

fn run(server: &Server, dir: &Path, map: &str, args: &[&str]) -> Output {
    Command::new(&*BINARY)
        .args(["index", dir.to_str().unwrap(), "--map", map, "--server", &server.url])
        .args(args)
        .output()
        .unwrap()
}

/// The report of a run, and its exit code.
fn indexed(server: &Server, dir: &TempDir, map: &str, args: &[&str]) -> (Value, i32) {
    let output = run(server, dir.path(), map, &[&["--json"], args].concat());
    let error = String::from_utf8_lossy(&output.stderr);
    let report = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{error}"));
    (report, output.status.code().unwrap())
}

fn refused(server: &Server, dir: &Path, map: &str, args: &[&str]) -> String {
    let output = run(server, dir, map, args);
    assert_eq!(output.status.code(), Some(1));
    String::from_utf8(output.stderr).unwrap()
}

fn counts(report: &Value) -> [u64; 4] {
    ["added", "present", "changed", "without_pose"].map(|name| report[name].as_u64().unwrap())
}

async fn pose(server: &Server, map: &str, id: &str) -> Value {
    let id: String = id.bytes().map(|byte| format!("%{byte:02X}")).collect();
    server.get(&format!("/maps/{map}/images/{id}")).await.expect(200)["pose"].clone()
}

async fn frame(server: &Server, map: &str) -> Value {
    server.get(&format!("/maps/{map}")).await.expect(200)["frame"].clone()
}

#[tokio::test]
async fn a_corrected_pose_is_stored_when_the_folder_is_indexed_again() {
    let (server, map) = shared_server();
    let folder = folder(&["a.jpg", "b.jpg"]);
    write(&folder, "poses.csv", "file,lat,lon\na.jpg,45,7\nb.jpg,46,8\n");
    assert_eq!(counts(&indexed(server, &folder, &map, &[]).0), [2, 0, 0, 0]);
    assert_eq!(counts(&indexed(server, &folder, &map, &[]).0), [0, 2, 0, 0]);
    write(&folder, "poses.csv", "file,lat,lon\na.jpg,45.5,7\nb.jpg,46,8\n");
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([0, 1, 1, 0], 0));
    assert_eq!(report["account"][0]["changed"], json!(["pose"]));
    assert_eq!(pose(server, &map, "a.jpg").await, json!({"lat": 45.5, "lon": 7.0}));
    let text = String::from_utf8(run(server, folder.path(), &map, &[]).stdout).unwrap();
    assert!(text.contains("0 added, 2 already present, 0 changed"), "{text}");
}

#[tokio::test]
async fn a_map_without_poses_takes_the_frame_of_the_first_ones() {
    let (server, map) = shared_server();
    let folder = folder(&["a.jpg", "b.jpg"]);
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([2, 0, 0, 2], 0));
    assert_eq!(frame(server, &map).await, "wgs84");
    write(&folder, "poses.csv", "file,x,y\na.jpg,1,2\nb.jpg,3,4\n");
    assert_eq!(counts(&indexed(server, &folder, &map, &[]).0), [0, 0, 2, 0]);
    assert_eq!(frame(server, &map).await, "metric");
    assert_eq!(pose(server, &map, "b.jpg").await, json!({"x": 3.0, "y": 4.0}));
    // Now the frame is fixed.
    write(&folder, "poses.csv", "file,lat,lon\na.jpg,45,7\n");
    let error = refused(server, folder.path(), &map, &[]);
    assert!(error.contains("has poses in metric") && error.contains("a.jpg"), "{error}");
}

#[tokio::test]
async fn every_file_and_every_row_is_in_the_account() {
    let (server, map) = shared_server();
    let folder =
        folder(&["0001.jpg", "cam0/0001.jpg", "cam1/0001.jpg", "._0001.jpg", "@eaDir/x.jpg"]);
    write(&folder, "text.jpg", "no picture");
    write(
        &folder,
        "poses.csv",
        "File;X;Y;yaw\n0001;1;2;0\ncam0\\0001.jpg;100,5;200;0\ngone.jpg;5;6;0\n",
    );
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([3, 0, 0, 1], 1), "{report}");
    assert_eq!(pose(server, &map, "cam0/0001.jpg").await, json!({"x": 100.5, "y": 200.0}));
    assert_eq!(pose(server, &map, "cam1/0001.jpg").await, json!(null));
    let mut outcomes: Vec<String> = report["account"]
        .as_array()
        .unwrap()
        .iter()
        .map(|entry| {
            let file = entry["file"].as_str().unwrap();
            let file = file.strip_prefix(folder.path().to_str().unwrap()).unwrap_or(file);
            format!("{} {}", file.trim_start_matches('/'), entry["outcome"].as_str().unwrap())
        })
        .collect();
    outcomes.sort();
    let expected = [
        "._0001.jpg skipped",
        "0001.jpg added",
        "@eaDir skipped",
        "cam0/0001.jpg added",
        "cam1/0001.jpg added",
        "text.jpg failed",
    ];
    assert_eq!(outcomes, expected);
    let rows = &report["rows"];
    assert_eq!(
        (&rows["rows"], &rows["matched"], &rows["unmatched"][0]["name"]),
        (&json!(3), &json!(2), &json!("gone.jpg"))
    );
    assert_eq!(rows["unused_columns"], json!(["yaw"]));
    let output = run(server, folder.path(), &map, &[]);
    let text = String::from_utf8(output.stdout).unwrap();
    for part in [
        "failed",
        "text.jpg",
        "skipped",
        "._0001.jpg",
        "\"gone.jpg\" (line 4",
        "no pose (1): cam1/0001.jpg",
        "\"yaw\"",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[tokio::test]
async fn a_table_that_matches_nothing_or_contradicts_itself_adds_nothing() {
    let (server, map) = shared_server();
    let folder = folder(&["a.jpg"]);
    for (table, parts) in [
        ("file,x,y\nq.jpg,1,2\n", ["none of the 1 rows", "\"a.jpg\""]),
        ("file,x,y\na.jpg,1,2\na.jpg,3,4\n", ["lines 2 and 3", "\"a.jpg\""]),
        ("file,x,y\na.jpg,1,north\n", ["line 2", "north"]),
    ] {
        write(&folder, "poses.csv", table);
        let error = refused(server, folder.path(), &map, &[]);
        assert!(parts.iter().all(|part| error.contains(part)), "{error}");
    }
    server.get(&format!("/maps/{map}")).await.problem(404);
    let error = refused(server, &folder.path().join("a.jpg"), &map, &[]);
    assert!(error.contains("is a file; name the folder"), "{error}");
}

#[cfg(unix)]
#[tokio::test]
async fn a_dangling_link_is_named_and_costs_only_itself() {
    let (server, map) = shared_server();
    let folder = folder(&["a.jpg", "b.jpg"]);
    std::os::unix::fs::symlink("/nowhere/x.jpg", folder.path().join("z.jpg")).unwrap();
    std::os::unix::fs::symlink(".", folder.path().join("loop")).unwrap();
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([2, 0, 0, 2], 1));
    let skipped = report["skipped"].as_array().unwrap();
    assert_eq!(skipped.len(), 2, "{report}");
    assert!(skipped[1]["file"].as_str().unwrap().ends_with("z.jpg"), "{report}");
    std::fs::remove_file(folder.path().join("z.jpg")).unwrap();
    assert_eq!(indexed(server, &folder, &map, &[]).1, 0, "a loop hides no picture");
}

#[tokio::test]
async fn names_of_two_zones_do_not_pile_up() {
    let (server, map) = shared_server();
    let names =
        ["@500000.0@4000000.0@31@S@a@.jpg", "@500000.0@4000000.0@32@S@b@.jpg", "overview.jpg"];
    let both = folder(&names);
    let (report, code) = indexed(server, &both, &map, &[]);
    assert_eq!((counts(&report), code), ([3, 0, 0, 1], 0));
    assert_eq!(frame(server, &map).await, "wgs84");
    let lon = |pose: Value| pose["lon"].as_f64().unwrap();
    assert!((lon(pose(server, &map, names[0]).await) - 3.0).abs() < 1e-9);
    assert!((lon(pose(server, &map, names[1]).await) - 9.0).abs() < 1e-9);

    let metric = format!("{map}-metric");
    let first = folder(&names[..1]);
    assert_eq!(counts(&indexed(server, &first, &metric, &[]).0), [1, 0, 0, 0]);
    assert_eq!(frame(server, &metric).await, "metric");
    let error = refused(server, folder(&names[1..2]).path(), &metric, &[]);
    assert!(error.contains("zone 31 north") && error.contains("zone 32 north"), "{error}");
    // The same pictures fit a map in degrees.
    assert_eq!(counts(&indexed(server, &first, &map, &[]).0), [0, 1, 0, 0]);
}

/// A JPEG with a position as piexif writes it: big-endian, without an offset behind a directory.
fn tagged(jpeg: &[u8], letters: Option<[&[u8; 2]; 2]>) -> Vec<u8> {
    let degrees = |parts: [u32; 3]| {
        parts
            .iter()
            .flat_map(|n| [n.to_be_bytes(), 1_u32.to_be_bytes()].concat())
            .collect::<Vec<u8>>()
    };
    let fields = if letters.is_some() { 4_u16 } else { 2 };
    let values = 26 + 2 + 12 * u32::from(fields);
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        [&tag.to_be_bytes()[..], &kind.to_be_bytes(), &count.to_be_bytes(), &value].concat()
    };
    let mut tiff = b"MM\0*\0\0\0\x08\0\x01".to_vec();
    tiff.extend(entry(0x8825, 4, 1, 26_u32.to_be_bytes()));
    tiff.extend([0; 4]);
    tiff.extend(fields.to_be_bytes());
    for (index, tag) in [2_u16, 4].into_iter().enumerate() {
        if let Some(letters) = letters {
            tiff.extend(entry(tag - 1, 2, 2, [letters[index][0], letters[index][1], 0, 0]));
        }
        tiff.extend(entry(tag, 5, 3, (values + 24 * index as u32).to_be_bytes()));
    }
    tiff.extend([degrees([45, 30, 0]), degrees([7, 15, 0])].concat());
    let length = (tiff.len() + 8) as u16;
    [&jpeg[..2], &[0xFF, 0xE1], &length.to_be_bytes(), b"Exif\0\0", &tiff, &jpeg[2..]].concat()
}

#[tokio::test]
async fn an_exif_position_is_taken_and_one_without_its_letters_is_a_warning() {
    let (server, map) = shared_server();
    let folder = TempDir::new().unwrap();
    let (good, bad) = (tagged(&reference(0), Some([b"N\0", b"w\0"])), tagged(&reference(1), None));
    write(&folder, "a.jpg", &good);
    write(&folder, "b.jpg", &bad);
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([2, 0, 0, 1], 0));
    assert_eq!(report["account"][0]["pose"], "exif");
    let warnings = report["account"][1]["warnings"].as_array().unwrap();
    assert!(
        warnings.len() == 2 && warnings[0].as_str().unwrap().contains("hemisphere"),
        "{report}"
    );
    assert_eq!(pose(server, &map, "a.jpg").await, json!({"lat": 45.5, "lon": -7.25}));

    // The same without the command.
    let post = async |id: &str, bytes: &[u8], status: u16| {
        let path = format!("/maps/{map}/images?id={id}");
        server.post_jpeg(&path, bytes.to_vec()).await.expect(status)
    };
    let stored = post("c", &good, 201).await;
    assert_eq!(
        (&stored["pose"], &stored["warnings"]),
        (&json!({"lat": 45.5, "lon": -7.25}), &json!([]))
    );
    let stored = post("d", &bad, 201).await;
    assert_eq!((&stored["pose"], stored["warnings"].as_array().unwrap().len()), (&json!(null), 2));
    // A corrected pose is not replaced by that of the picture.
    let corrected = json!({"pose": {"lat": 1.0, "lon": 2.0}});
    server.patch(&format!("/maps/{map}/images/c"), corrected).await.expect(200);
    assert_eq!(post("c", &good, 200).await["pose"], json!({"lat": 1.0, "lon": 2.0}));
}

#[tokio::test]
async fn an_image_that_has_a_pose_in_the_map_is_not_counted_without() {
    let (server, map) = shared_server();
    let folder = folder(&["a.jpg", "b.jpg"]);
    assert_eq!(counts(&indexed(server, &folder, &map, &[]).0), [2, 0, 0, 2]);
    let corrected = json!({"pose": {"lat": 1.0, "lon": 2.0}});
    server.patch(&format!("/maps/{map}/images/a.jpg"), corrected).await.expect(200);
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([0, 2, 0, 1], 0));
    let poses = [&report["account"][0]["pose"], &report["account"][1]["pose"]];
    assert_eq!(poses, [&json!("map"), &json!(null)]);
    let text = String::from_utf8(run(server, folder.path(), &map, &[]).stdout).unwrap();
    let lines = ["no pose (1): b.jpg", "no pose in the folder, the map keeps its own (1): a.jpg"];
    assert!(lines.iter().all(|line| text.contains(line)), "{text}");
}

#[tokio::test]
async fn a_description_that_cannot_be_read_is_named_and_the_exit_code_tells() {
    let (server, map) = shared_server();
    let dir = folder(&["a.jpg", "b.jpg"]);
    write(&dir, "a.jpg.json", r#"{"pose": {"lat": 45.0"#);
    let (report, code) = indexed(server, &dir, &map, &[]);
    assert_eq!((counts(&report)[0], code), (2, 1), "{report}");
    let warnings = report["account"][0]["warnings"].to_string();
    assert!(warnings.contains("description next to it is not used"), "{report}");
}

#[tokio::test]
async fn a_description_without_its_picture_is_named() {
    let (server, map) = shared_server();
    let folder = folder(&["a.jpg"]);
    for name in ["a.jpg.json", "gone.jpg.json"] {
        write(&folder, name, r#"{"pose": {"lat": 1, "lon": 2}}"#);
    }
    let (report, code) = indexed(server, &folder, &map, &[]);
    assert_eq!((counts(&report), code), ([1, 0, 0, 0], 0));
    let skipped = report["skipped"].as_array().unwrap();
    assert_eq!(skipped.len(), 1, "{report}");
    assert!(skipped[0]["file"].as_str().unwrap().ends_with("gone.jpg.json"), "{report}");
}

#[tokio::test]
async fn the_position_and_the_heading_of_a_drone_are_read_from_xmp() {
    let (server, map) = shared_server();
    let folder = TempDir::new().unwrap();
    let xmp = "http://ns.adobe.com/xap/1.0/\0<rdf:Description \
        xmlns:drone-dji='http://www.dji.com/drone-dji/1.0/' drone-dji:GpsLatitude='+45.5' \
        drone-dji:GpsLongitude='-7.25' drone-dji:AbsoluteAltitude='+240.5' \
        drone-dji:RelativeAltitude='+30.0' drone-dji:GimbalYawDegree='-90.0'/>";
    let (jpeg, length) = (reference(0), (xmp.len() + 2) as u16);
    let tagged = [&jpeg[..2], &[0xFF, 0xE1], &length.to_be_bytes(), xmp.as_bytes(), &jpeg[2..]];
    write(&folder, "DJI_0001.JPG", tagged.concat());
    assert_eq!(counts(&indexed(server, &folder, &map, &[]).0), [1, 0, 0, 0]);
    assert_eq!(
        pose(server, &map, "DJI_0001.JPG").await,
        json!({"lat": 45.5, "lon": -7.25, "alt": 240.5, "heading": 270.0})
    );
}
