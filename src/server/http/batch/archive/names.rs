//! Which members of an archive are files to read.

use tar::EntryType;
use whereabouts_core::Leftover;

/// The longest name that is remembered, in bytes, as on Linux. An id is shorter.
const LONGEST_NAME: usize = 4096;

/// What a member of an archive is.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Member {
    /// A file with this name.
    File(String),
    /// A folder or a header, which contains nothing itself.
    Nothing,
    /// Something else, and why it is skipped.
    Skipped { name: String, why: &'static str },
}

/// Returns what a member is, by its type and its name as bytes.
pub(super) fn member(kind: EntryType, path: &[u8]) -> Member {
    let shown = || String::from_utf8_lossy(path).chars().take(200).collect::<String>();
    let skipped = |why| Member::Skipped { name: shown(), why };
    match kind {
        EntryType::Directory | EntryType::XGlobalHeader | EntryType::XHeader => {
            return Member::Nothing;
        }
        EntryType::Regular | EntryType::Continuous => {}
        EntryType::Symlink => {
            return skipped("it is a symbolic link; archive the files themselves (tar ch)");
        }
        EntryType::Link => {
            return skipped(
                "it is a link to another file of the archive; archive the files themselves \
                 (tar c --hard-dereference)",
            );
        }
        EntryType::GNUSparse => {
            return skipped("it is stored as a sparse file; archive it without --sparse");
        }
        _ => return skipped("it is not a file"),
    }
    let Ok(name) = std::str::from_utf8(path) else {
        return skipped("its name is not UTF-8; rename it");
    };
    if name.len() > LONGEST_NAME {
        return skipped("its name is too long; rename it");
    }
    let mut name = name;
    while let Some(rest) = name.strip_prefix("./") {
        name = rest;
    }
    match Leftover::is_in_path(name) {
        true => skipped(
            "the operating system or a photo program wrote it; it is not a picture of the map",
        ),
        false => Member::File(name.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_read_and_everything_else_is_named() {
        let file = |name: &str| Member::File(name.to_owned());
        let of = |path: &[u8]| member(EntryType::Regular, path);
        assert_eq!(of(b"./a.jpg"), file("a.jpg"));
        assert_eq!(of("straße/東京.jpg".as_bytes()), file("straße/東京.jpg"));
        assert_eq!(of(b"cam/.hidden.jpg"), file("cam/.hidden.jpg"));
        assert_eq!(member(EntryType::Directory, b"cam/"), Member::Nothing);
        for path in ["._a.jpg", "cam/._a.jpg.json", "__MACOSX/a.jpg", "x/@eaDir/a.jpg/t.jpg"] {
            assert!(matches!(of(path.as_bytes()), Member::Skipped { .. }), "{path}");
        }
        for path in [".DS_Store", "cam/Thumbs.db", ".thumbnails/a.png", "desktop.ini"] {
            assert!(matches!(of(path.as_bytes()), Member::Skipped { .. }), "{path}");
        }
        assert!(matches!(of(b"\xff.jpg"), Member::Skipped { name, .. } if name == "\u{fffd}.jpg"));
        assert!(matches!(of(&[b'x'; 5000]), Member::Skipped { name, .. } if name.len() == 200));
        for kind in [EntryType::Symlink, EntryType::Link, EntryType::Fifo, EntryType::Block] {
            assert!(matches!(member(kind, b"a.jpg"), Member::Skipped { .. }), "{kind:?}");
        }
    }
}
