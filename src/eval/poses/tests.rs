//! The poses of whole folders.

use super::*;
use crate::PictureFile;

/// A folder of files with these contents.
struct Files(tempfile::TempDir);

impl Files {
    fn new(files: &[(&str, &str)]) -> Self {
        let files_of = Self(tempfile::tempdir().unwrap());
        for (name, text) in files {
            let path = files_of.0.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        files_of
    }

    fn folder(&self) -> Folder {
        Folder::read(self.0.path()).unwrap()
    }

    fn poses(&self) -> FolderPoses {
        FolderPoses::read(&self.folder(), None).unwrap()
    }

    fn error(&self) -> String {
        format!("{:#}", FolderPoses::read(&self.folder(), None).unwrap_err())
    }

    /// The pose of each image as text, in their order.
    fn found(&self, poses: &FolderPoses) -> Vec<(Option<String>, Option<PoseSource>)> {
        let text = |pose: Pose| match pose {
            Pose::Geographic(pose) => format!("{:.4} {:.4}", pose.lat, pose.lon),
            Pose::Metric(pose) => format!("{:.1} {:.1} m", pose.x, pose.y),
        };
        let found = poses.find_all(&self.folder()).unwrap();
        found.into_iter().map(|found| (found.pose.map(text), found.source)).collect()
    }
}

fn posed(text: &str, source: PoseSource) -> (Option<String>, Option<PoseSource>) {
    (Some(text.to_owned()), Some(source))
}

#[test]
fn an_odd_file_does_not_take_the_poses_of_the_others() {
    let files = Files::new(&[
        ("@1.0@2.0@.jpg", ""),
        ("@3.0@4.0@.jpg", ""),
        ("overview.jpg", ""),
        ("._@1.0@2.0@.jpg", ""),
    ]);
    let poses = files.poses();
    assert_eq!(poses.frame(), Some(CoordinateFrame::Metric));
    let name = PoseSource::Name;
    assert_eq!(
        files.found(&poses),
        [posed("1.0 2.0 m", name), posed("3.0 4.0 m", name), (None, None)]
    );
}

#[test]
fn empty_utm_fields_are_filled_from_latitude_and_longitude() {
    let files = Files::new(&[
        ("@584522.5@4477231.2@17@T@40.44@-79.99@p2@.jpg", ""),
        ("@@@17@T@40.44@-79.99@p1@.jpg", ""),
    ]);
    let mut poses = files.poses();
    let name = PoseSource::Name;
    assert_eq!(
        files.found(&poses),
        [posed("584522.5 4477231.2 m", name), posed("585658.1 4477084.5 m", name)]
    );
    poses.convert_to(CoordinateFrame::Wgs84).unwrap();
    assert_eq!(
        files.found(&poses),
        [posed("40.4414 -80.0034", name), posed("40.4400 -79.9900", name)]
    );
}

#[test]
fn names_that_span_zones_or_hemispheres_are_converted_to_degrees() {
    for (there, expected) in [
        ("@500000.0@4000000.0@32@S@.jpg", "36.1447 9.0000"),
        ("@500000.0@4000000.0@31@F@.jpg", "-54.1481 3.0000"),
    ] {
        let files = Files::new(&[("@500000.0@4000000.0@31@S@.jpg", ""), (there, "")]);
        let poses = files.poses();
        assert_eq!(poses.frame(), Some(CoordinateFrame::Wgs84));
        let mut found = files.found(&poses);
        found.sort();
        let mut expected =
            [posed("36.1447 3.0000", PoseSource::Name), posed(expected, PoseSource::Name)];
        expected.sort();
        assert_eq!(found, expected);
    }
    // Bands of one hemisphere share their metres.
    let files =
        Files::new(&[("@500000.0@4400000.0@31@S@.jpg", ""), ("@500000.0@4500000.0@31@T@.jpg", "")]);
    assert_eq!(files.poses().frame(), Some(CoordinateFrame::Metric));
}

#[test]
fn a_table_comes_before_a_sidecar_a_name_and_exif() {
    let sidecar = r#"{"pose": {"lat": 3, "lon": 4}, "tags": ["north"]}"#;
    let files = Files::new(&[
        ("poses.csv", "file,lat,lon\na.jpg,1,2\n"),
        ("a.jpg", ""),
        ("a.jpg.json", sidecar),
        ("b.jpg", ""),
        ("b.jpg.json", sidecar),
        ("@500000.0@4000000.0@31@S@.jpg", ""),
        ("@1.0@2.0@.jpg", ""),
        ("z.jpg", ""),
        ("z.jpg.json", "{\"title\": \"z.jpg\"}"),
    ]);
    let poses = files.poses();
    let expected = [
        (None, None),
        posed("36.1447 3.0000", PoseSource::Name),
        posed("1.0000 2.0000", PoseSource::Table),
        posed("3.0000 4.0000", PoseSource::Sidecar),
        (None, None),
    ];
    assert_eq!(files.found(&poses), expected);
    let found = |id: &str| poses.find(&id.parse().unwrap(), b"");
    assert_eq!(found("a.jpg").tags, ["north"]);
    assert!(found("@1.0@2.0@.jpg").warnings[0].contains("without a UTM zone"));
    assert!(
        found("z.jpg").warnings[0].contains("unknown field `title`"),
        "{:?}",
        found("z.jpg").warnings
    );
    let account = poses.account().unwrap();
    assert_eq!((account.rows, account.matched, account.images_without_row.len()), (1, 1, 4));
}

#[test]
fn the_metres_of_a_table_and_those_of_names_are_not_mixed() {
    let files =
        Files::new(&[("poses.csv", "file,x,y\na.jpg,1,2\n"), ("a.jpg", ""), ("@5.0@6.0@.jpg", "")]);
    let poses = files.poses();
    assert_eq!(files.found(&poses), [(None, None), posed("1.0 2.0 m", PoseSource::Table)]);
    let odd = poses.find(&"@5.0@6.0@.jpg".parse().unwrap(), b"");
    assert!(odd.warnings[0].contains("an origin of their own"), "{:?}", odd.warnings);
}

#[test]
fn every_row_and_every_image_is_in_the_account() {
    let files = Files::new(&[
        (
            "poses.csv",
            "file,x,y,yaw\na.jpg,1,2,0\na.jpg,1,2,0\nB.JPG,3,4,0\nc.jpg,,,0\ngone.jpg,5,6,0\n1.jpg,7,8,0\nd.jpg,9,9,0\n",
        ),
        ("a.jpg", ""),
        ("b.jpg", ""),
        ("c.jpg", ""),
        ("s/1.jpg", ""),
        ("t/1.jpg", ""),
        ("t/d.jpg", ""),
    ]);
    let poses = files.poses();
    let account = poses.account().unwrap();
    assert_eq!(
        (account.rows, account.matched, account.repeated, account.without_position),
        (7, 3, 1, 1)
    );
    assert_eq!(
        account.matched + account.repeated + account.without_position + account.unmatched.len(),
        account.rows
    );
    let unmatched: Vec<_> =
        account.unmatched.iter().map(|row| (row.line, row.name.as_str())).collect();
    assert_eq!(unmatched, [(6, "gone.jpg"), (7, "1.jpg")]);
    let loose: Vec<_> = account.loose.iter().map(|row| (row.image.as_str(), row.by)).collect();
    assert_eq!(loose, [("b.jpg", MatchKind::OtherCase), ("t/d.jpg", MatchKind::BaseName)]);
    assert_eq!(account.images_without_row.len(), 2);
    let text = account.lines(1).join("\n");
    for part in [
        "7 in all, 3 matched, 2 without an image",
        "\"gone.jpg\" (line 6: no picture has this name) and 1 more",
        "images without a row (2): s/1.jpg and 1 more",
        "\"yaw\"",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn a_table_that_matches_nothing_is_an_error_that_shows_both_sides() {
    let error =
        Files::new(&[("poses.csv", "file,x,y\nq1.jpg,1,2\nq2.jpg,1,2\n"), ("a.jpg", "")]).error();
    assert!(
        error.contains("none of the 2 rows")
            && error.contains("\"q1.jpg\"")
            && error.contains("\"a.jpg\""),
        "{error}"
    );
}

#[test]
fn a_pose_of_the_table_that_does_not_fit_the_map_is_an_error() {
    let mut poses = Files::new(&[("poses.csv", "file,x,y\na.jpg,1,2\n"), ("a.jpg", "")]).poses();
    let error = poses.convert_to(CoordinateFrame::Wgs84).unwrap_err().to_string();
    assert!(error.contains("a.jpg") && error.contains("without a UTM zone"), "{error}");
    assert!(poses.convert_to(CoordinateFrame::Metric).is_ok());
    let mut named = Files::new(&[("@1.0@2.0@.jpg", ""), ("overview.jpg", "")]).poses();
    assert!(named.convert_to(CoordinateFrame::Wgs84).is_err());
    let zoned = "file,easting,northing,zone\na.jpg,500000,4000000,31S\nb.jpg,500000,4000000,32S\n";
    let files = Files::new(&[("poses.csv", zoned), ("a.jpg", ""), ("b.jpg", "")]);
    assert_eq!(files.poses().frame(), Some(CoordinateFrame::Wgs84));
    let mut poses = files.poses();
    // In the grid of one zone, a place of the next one has its true distance.
    poses.convert_to(CoordinateFrame::Metric).unwrap();
    let found = files.found(&poses);
    assert_eq!(found[0].0.as_deref(), Some("500000.0 4000000.0 m"));
    assert!(found[1].0.as_deref().is_some_and(|pose| pose.starts_with("1040")), "{found:?}");
}

#[test]
fn an_image_that_the_folder_does_not_have_has_no_pose() {
    let files = Files::new(&[("a.jpg", "")]);
    let poses = files.poses();
    assert_eq!(poses.frame(), None);
    let other = PictureFile { file: "b.jpg".into(), id: "b.jpg".parse().unwrap() };
    assert_eq!(poses.find(&other.id, b""), FoundPose::default());
}

#[test]
fn columns_of_the_other_frame_are_named() {
    let files =
        Files::new(&[("poses.csv", "file,lat,lon,x,y,yaw\na.jpg,1,2,3,4,5\n"), ("a.jpg", "")]);
    let mut poses = files.poses();
    let named = |poses: &FolderPoses| poses.account().unwrap().other_frame_columns.join(" ");
    assert_eq!((poses.frame(), named(&poses)), (Some(CoordinateFrame::Wgs84), "x y".to_owned()));
    let lines = poses.account().unwrap().lines(20).join("\n");
    assert!(
        lines.contains("columns of the other coordinate frame") && lines.contains("\"x\", \"y\""),
        "{lines}"
    );
    poses.convert_to(CoordinateFrame::Metric).unwrap();
    assert_eq!(named(&poses), "lat lon");
    assert_eq!(files.found(&poses), [posed("3.0 4.0 m", PoseSource::Table)]);
}

#[test]
fn a_name_whose_zone_contradicts_its_northing_has_no_pose_and_a_warning() {
    let files = Files::new(&[("@391000@5820000@33@K@.jpg", ""), ("@391000@5820000@33@U@.jpg", "")]);
    let poses = files.poses();
    assert_eq!(
        files.found(&poses),
        [(None, None), posed("391000.0 5820000.0 m", PoseSource::Name)]
    );
    let warnings = &poses.find(&"@391000@5820000@33@K@.jpg".parse().unwrap(), b"").warnings;
    assert!(warnings[0].contains("contradicts"), "{warnings:?}");
}
