//! Files and folders that operating systems, storage boxes and photo programs leave among pictures. None of them is a
//! picture of the user's.

/// Folders, in lower case, in which other programs keep thumbnails, old versions and rubbish.
const FOLDERS: [&str; 29] = [
    // macOS.
    "__macosx",
    ".appledouble",
    ".documentrevisions-v100",
    ".fseventsd",
    ".spotlight-v100",
    ".temporaryitems",
    "network trash folder",
    "temporary items",
    // Windows.
    "$recycle.bin",
    "recycler",
    "system volume information",
    // Linux.
    ".thumbnails",
    ".xvpics",
    "lost+found",
    // Storage boxes: Synology and QNAP.
    "@eadir",
    "@sharebin",
    "@tmp",
    "#recycle",
    "#snapshot",
    ".@__thumb",
    "@recycle",
    "@recently-snapshot",
    // Programs for photographs and for copies.
    ".picasaoriginals",
    ".dtrash",
    ".stversions",
    ".stfolder",
    ".dropbox.cache",
    ".sync",
    ".ipynb_checkpoints",
];

/// Files, in lower case, in which other programs keep thumbnails.
const THUMBNAILS: [&str; 4] = ["thumbs.db", "ehthumbs.db", "ehthumbs_vista.db", "zbthumbnail.info"];

/// Files, in lower case, in which other programs keep settings of a folder.
const SETTINGS: [&str; 8] = [
    ".ds_store",
    ".directory",
    ".localized",
    ".nomedia",
    ".picasa.ini",
    "desktop.ini",
    "icon\r",
    "picasa.ini",
];

/// What another program keeps in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Leftover {
    /// What macOS knows about the file whose name is behind `._`, on disks of other systems.
    Shadow,
    /// Thumbnails of the pictures in the folder.
    Thumbnails,
    /// Settings of the folder.
    Settings,
}

impl Leftover {
    /// Recognises a file by its name without the folders before it.
    pub fn of_file(name: &str) -> Option<Self> {
        let lower = name.to_ascii_lowercase();
        if lower.starts_with("._") {
            Some(Self::Shadow)
        } else if THUMBNAILS.contains(&lower.as_str()) {
            Some(Self::Thumbnails)
        } else {
            SETTINGS.contains(&lower.as_str()).then_some(Self::Settings)
        }
    }

    /// Whether a folder with this name belongs to another program, with all that is in it.
    pub fn is_folder(name: &str) -> bool {
        let lower = name.to_ascii_lowercase();
        FOLDERS.contains(&lower.as_str()) || lower.starts_with(".trash")
    }

    /// Whether a path of a file is that of a leftover, or leads through a folder of another program.
    pub fn is_in_path(path: &str) -> bool {
        let mut parts = path.rsplit(['/', '\\']);
        let name = parts.next().unwrap_or_default();
        Self::of_file(name).is_some() || parts.any(Self::is_folder)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leftovers_are_known_in_any_case_and_anywhere_in_a_path() {
        for path in [
            "._a.jpg",
            "cam/._a.jpg.json",
            "__MACOSX/a.jpg",
            "x/@eaDir/a.jpg/SYNOPHOTO_THUMB_M.jpg",
            ".Trash-1000/files/a.jpg",
            ".Trashes/a.jpg",
            "$RECYCLE.BIN/S-1-5/a.jpg",
            "#recycle/a.jpg",
            ".@__thumb/a.jpg",
            "cam\\Thumbs.db",
            "THUMBS.DB",
            "Desktop.ini",
            ".DS_Store",
        ] {
            assert!(Leftover::is_in_path(path), "{path}");
        }
        for path in
            ["a.jpg", ".hidden.jpg", "cam/_a.jpg", "thumbs/a.jpg", "eaDir/a.jpg", "", "@1@2@.jpg"]
        {
            assert!(!Leftover::is_in_path(path), "{path}");
        }
        assert_eq!(Leftover::of_file("Thumbs.db"), Some(Leftover::Thumbnails));
    }

    #[test]
    fn the_lists_are_in_lower_case() {
        for name in FOLDERS.iter().chain(&THUMBNAILS).chain(&SETTINGS) {
            assert_eq!(*name, name.to_ascii_lowercase());
        }
    }
}
