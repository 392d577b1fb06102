//! Folders as people have them.

use super::*;

const PNG: &[u8] = b"\x89PNG\r\n\x1a\n and the rest";

fn folder(files: &[&str]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for file in files {
        let path = dir.path().join(file);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, PNG).unwrap();
    }
    dir
}

fn ids(folder: &Folder) -> Vec<&str> {
    folder.pictures.iter().map(|picture| picture.id.as_str()).collect()
}

/// The names of the skipped entries, and whether each is a loss.
fn skipped<'a>(dir: &Path, folder: &'a Folder) -> Vec<(&'a str, bool)> {
    let of = |one: &'a SkippedFile| {
        let name = one.file.strip_prefix(dir.to_str().unwrap()).unwrap();
        (name.trim_start_matches('/'), one.is_lost)
    };
    folder.skipped.iter().map(of).collect()
}

#[test]
fn pictures_are_in_natural_order() {
    let dir = folder(&["10.jpg", "2.jpg", "b/1.PNG", "a.txt", "IMG_7"]);
    std::fs::write(dir.path().join("NOTES"), "text").unwrap();
    let folder = Folder::read(dir.path()).unwrap();
    assert_eq!(ids(&folder), ["2.jpg", "10.jpg", "IMG_7", "b/1.PNG"]);
    assert!(folder.skipped.is_empty(), "{:?}", folder.skipped);
}

#[test]
fn what_other_programs_leave_is_skipped_and_no_loss() {
    let dir = folder(&[
        "a.jpg",
        "._a.jpg",
        ".DS_Store",
        "Thumbs.db",
        ".thumbnails/a.png",
        "s/@eaDir/a.jpg/SYNOPHOTO_THUMB_M.jpg",
        "__MACOSX/._a.jpg",
        "a.dng",
        "a.MOV",
        "favicon.ico",
        "s/drive.mp4",
        "s/poses.csv",
    ]);
    let folder = Folder::read(dir.path()).unwrap();
    assert_eq!(ids(&folder), ["a.jpg"]);
    let expected = [
        "._a.jpg",
        ".thumbnails",
        "Thumbs.db",
        "__MACOSX",
        "a.dng",
        "favicon.ico",
        "s/@eaDir",
        "s/drive.mp4",
        "s/poses.csv",
    ];
    assert_eq!(skipped(dir.path(), &folder), expected.map(|name| (name, false)));
    assert!(folder.skipped[1].why.contains("1 pictures"), "{:?}", folder.skipped[1]);
}

#[cfg(unix)]
#[test]
fn a_file_that_cannot_be_taken_is_skipped_and_named() {
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::fs::symlink;
    let long = format!("{}/{}.jpg", "d".repeat(120), "f".repeat(120));
    let dir = folder(&["a.jpg", " b.jpg", &long, "only.nef", "sub/c.jpg"]);
    symlink("/nowhere/x.jpg", dir.path().join("z.jpg")).unwrap();
    symlink("/nowhere/notes.txt", dir.path().join("notes.txt")).unwrap();
    symlink("..", dir.path().join("sub/up")).unwrap();
    symlink("a.jpg", dir.path().join("link.jpg")).unwrap();
    std::fs::write(dir.path().join(OsStr::from_bytes(b"caf\xE9.jpg")), PNG).unwrap();
    std::fs::write(dir.path().join("tab\there.jpg"), PNG).unwrap();
    std::fs::write(dir.path().join("y.jpg"), "../other/y.jpg").unwrap();
    let folder = Folder::read(dir.path()).unwrap();
    assert_eq!(ids(&folder), ["a.jpg", "link.jpg", "sub/c.jpg"]);
    let skipped = skipped(dir.path(), &folder);
    let lost = [" b.jpg", "caf\u{FFFD}.jpg", &long, "only.nef", "tab\there.jpg", "y.jpg", "z.jpg"];
    for name in lost {
        assert!(skipped.contains(&(name, true)), "{name}: {skipped:?}");
    }
    assert!(skipped.contains(&("sub/up", false)) && skipped.len() == lost.len() + 1, "{skipped:?}");
    assert_eq!(folder.lost(), lost.len());
}

#[test]
fn a_folder_that_is_none_is_refused_in_words() {
    let dir = folder(&["a.jpg", "empty/readme.txt"]);
    let refused = |name: &str| format!("{:#}", Folder::read(&dir.path().join(name)).unwrap_err());
    assert!(refused("a.jpg").contains("is a file; name the folder"), "{}", refused("a.jpg"));
    assert!(refused("nowhere").contains("cannot read the folder"));
    assert!(refused("empty").contains("found no picture"));
}

#[test]
fn descriptions_without_a_picture_are_named() {
    let dir = folder(&["a.jpg", "s/b.jpg", "IMG_7"]);
    let pose = r#"{"pose": {"lat": 1, "lon": 2}}"#;
    for (name, text) in [
        ("a.jpg.json", pose),
        ("IMG_7.json", pose),
        ("gone.jpg.json", pose),
        ("s/a.jpg.json", "{}"),
        ("s/b.json", pose),
        ("a.json", r#"{"shapes": []}"#),
        ("metadata.json", pose),
        ("._a.jpg.json", "x"),
    ] {
        std::fs::write(dir.path().join(name), text).unwrap();
    }
    let folder = Folder::read(dir.path()).unwrap();
    let expected = ["gone.jpg.json", "s/a.jpg.json", "s/b.json"].map(|name| (name, false));
    assert_eq!(skipped(dir.path(), &folder), expected);
    assert!(folder.skipped[0].why.contains("not in the folder"), "{:?}", folder.skipped);
    assert!(folder.skipped[2].why.contains("rename it"), "{:?}", folder.skipped);
}
