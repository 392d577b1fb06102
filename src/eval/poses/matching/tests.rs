//! Rows and the pictures that they mean.

use super::*;

/// The picture of each row, and how it was found.
fn matched(rows: &[&str], pictures: &[&str]) -> Vec<Option<(String, MatchKind)>> {
    let matches = match_rows(rows, pictures, Path::new("/data/set"));
    let found = |one: Result<(usize, MatchKind), String>| {
        one.ok().map(|(index, kind)| (pictures[index].to_owned(), kind))
    };
    matches.into_iter().map(found).collect()
}

fn assert_matched(rows: &[&str], pictures: &[&str], expected: &[&str], kind: MatchKind) {
    let expected: Vec<_> = expected
        .iter()
        .map(|name| (!name.is_empty()).then(|| ((*name).to_owned(), kind)))
        .collect();
    assert_eq!(matched(rows, pictures), expected, "{rows:?} {pictures:?}");
}

#[test]
fn every_way_to_name_a_picture_is_understood() {
    let pictures = ["cam0/1.jpg", "cam0/2.JPG", "cam1/1.jpg"];
    for (rows, kind) in [
        (["cam0/1.jpg", "cam0/2.JPG", "cam1/1.jpg"], MatchKind::Path),
        (["cam0\\1.jpg", "cam0\\2.JPG", "cam1\\1.jpg"], MatchKind::Path),
        (["./cam0/1.jpg", "cam0//2.JPG", "cam0/../cam1/1.jpg"], MatchKind::Path),
        (["/data/set/cam0/1.jpg", "/data/set/cam0/2.JPG", "/data/set/cam1/1.jpg"], MatchKind::Path),
        (
            ["file:///data/set/cam0/1.jpg", "file:///data/set/cam0/2.JPG", "/data/set/cam1/1.jpg"],
            MatchKind::Path,
        ),
        (
            ["C:\\data\\cam0\\1.jpg", "C:\\data\\cam0\\2.JPG", "C:\\data\\cam1\\1.jpg"],
            MatchKind::Folder,
        ),
        (["/home/me/cam0/1.jpg", "/home/me/cam0/2.JPG", "/home/me/cam1/1.jpg"], MatchKind::Folder),
        (["a/cam0/1.jpg", "b/cam0/2.JPG", "c/d/cam1/1.jpg"], MatchKind::Folder),
        (["CAM0/1.JPG", "Cam0/2.jpg", "CAM1/1.JPG"], MatchKind::OtherCase),
        (["cam0/1", "cam0/2", "cam1/1"], MatchKind::NoExtension),
        (["CAM0/1", "Cam0/2", "CAM1/1"], MatchKind::NoExtension),
    ] {
        assert_matched(&rows, &pictures, &pictures, kind);
    }
    // The folder above that of the table.
    let below = ["set/cam0/1.jpg", "set/cam0/2.jpg", "set/cam1/1.jpg"];
    let rows = ["cam0/1.jpg", "cam0/2.jpg", "cam1/1.jpg"];
    assert_matched(&rows, &below, &below, MatchKind::Folder);
    // Accents of one character or of two.
    assert_matched(&["caf\u{e9}.jpg"], &["cafe\u{301}.jpg"], &["cafe\u{301}.jpg"], MatchKind::Path);
    // A backslash that is part of a name.
    assert_matched(&["a\\b.jpg"], &["a\\b.jpg", "a/b.jpg"], &["a\\b.jpg"], MatchKind::Path);
    // A dot that is no extension.
    assert_matched(
        &["scan.v2"],
        &["scan.v2.jpg", "scan.v3.jpg"],
        &["scan.v2.jpg"],
        MatchKind::NoExtension,
    );
}

#[test]
fn a_base_name_counts_only_if_it_is_unique_on_both_sides() {
    let kind = MatchKind::BaseName;
    assert_matched(&["a.jpg"], &["cam0/a.jpg", "b.jpg"], &["cam0/a.jpg"], kind);
    assert_matched(&["x/a.jpg", "b.jpg"], &["a.jpg", "y/b.jpg"], &["a.jpg", "y/b.jpg"], kind);
    assert_matched(&["1.jpg"], &["cam0/1.jpg", "cam1/1.jpg"], &[""], kind);
    assert_matched(&["cam0/1.jpg", "cam1/1.jpg"], &["1.jpg"], &["", ""], kind);
    // A row of another folder is not meant.
    assert_matched(&["cam0/1.jpg"], &["cam1/1.jpg"], &[""], kind);
}

#[test]
fn an_exact_path_comes_before_a_similar_one() {
    let of = |name: &str, kind| Some((name.to_owned(), kind));
    let pictures = ["0001.jpg", "cam0/0001.jpg", "cam1/0001.jpg"];
    assert_eq!(
        matched(&["0001.jpg", "cam0/0001.jpg"], &pictures),
        [of("0001.jpg", MatchKind::Path), of("cam0/0001.jpg", MatchKind::Path)]
    );
    assert_eq!(matched(&["0001.jpg"], &pictures[1..]), [None]);
    assert_eq!(
        matched(&["a.jpg", "A.jpg"], &["A.jpg", "a.jpg"]),
        [of("a.jpg", MatchKind::Path), of("A.jpg", MatchKind::Path)]
    );
    assert_eq!(matched(&["A.JPG"], &["A.jpg", "a.jpg"]), [None]);
    assert_eq!(matched(&["a"], &["a.jpg", "a.png"]), [None]);
    assert_eq!(matched(&["a.png"], &["a.jpg"]), [None]);
    // All rows have the same leading folder, so that base names need not be unique.
    assert_eq!(
        matched(&["set/1.jpg", "set/b/1.jpg"], &["1.jpg", "b/1.jpg", "c/1.jpg"]),
        [of("1.jpg", MatchKind::Folder), of("b/1.jpg", MatchKind::Folder)]
    );
}

#[test]
fn a_row_without_a_picture_says_why() {
    let why = |rows: &[&str], pictures: &[&str]| {
        match_rows(rows, pictures, Path::new("/d")).pop().unwrap().unwrap_err()
    };
    assert_eq!(why(&["x.jpg"], &["a.jpg"]), "no picture has this name");
    assert_eq!(
        why(&["1.jpg"], &["a/1.jpg", "b/1.jpg"]),
        "it fits 2 pictures, such as a/1.jpg, b/1.jpg"
    );
    assert_eq!(why(&["1.jpg", "1"], &["1.jpg"]), "the picture 1.jpg is that of another row");
    assert_eq!(
        why(&["a/1.jpg", "b/1.jpg"], &["1.jpg"]),
        "more than one row fits the picture 1.jpg"
    );
}
