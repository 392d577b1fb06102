//! Lists the images in a folder and derives their ids. A file that cannot be one of them is skipped with the
//! reason, and never costs the others.

use std::ffi::OsStr;
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use walkdir::{DirEntry, WalkDir};

use super::natural;
use super::poses::POSES_FILE;
use whereabouts_core::{ImageId, InvalidName, MediaType};

/// An image file in a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PictureFile {
    /// Path of the file.
    pub file: PathBuf,
    /// Path relative to the folder.
    pub id: ImageId,
}

/// A file or a folder that looks like it has pictures, and is left out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedFile {
    /// Its path; bytes that are not UTF-8 are replaced.
    pub file: String,
    /// Why it is left out, and what to do about it.
    pub why: String,
    /// Whether a picture of the user's may be missing because of it; thumbnails and the like are no loss.
    pub is_lost: bool,
}

/// The images in a folder and its subfolders.
#[derive(Debug, Clone)]
pub struct Folder {
    /// The folder.
    pub dir: PathBuf,
    /// Its images, in the natural order of their names (`2.jpg` before `10.jpg`).
    pub pictures: Vec<PictureFile>,
    /// What was left out, by path.
    pub skipped: Vec<SkippedFile>,
}

/// Folders in which other programs keep copies and leftovers.
const FOREIGN_FOLDERS: [&str; 10] = [
    ".thumbnails",
    "@eadir",
    "__macosx",
    ".appledouble",
    ".spotlight-v100",
    ".fseventsd",
    "$recycle.bin",
    "#recycle",
    "#snapshot",
    "system volume information",
];

/// Files in which other programs keep thumbnails.
const FOREIGN_FILES: [&str; 4] = ["thumbs.db", "ehthumbs.db", "ehthumbs_vista.db", ".ds_store"];

/// Extensions of pictures. Whether the service reads a format is decided by its bytes.
const EXTENSIONS: [&str; 24] = [
    "jpg", "jpeg", "jpe", "jfif", "png", "webp", "tif", "tiff", "bmp", "dib", "gif", "pnm", "pgm",
    "ppm", "pbm", "pam", "heic", "heif", "hif", "avif", "jxl", "jp2", "jpx", "tga",
];

/// Extensions of the raw formats of cameras.
const RAW_EXTENSIONS: [&str; 12] =
    ["dng", "cr2", "cr3", "nef", "nrw", "arw", "orf", "rw2", "raf", "pef", "srw", "x3f"];

impl Folder {
    /// Lists the images in a folder and its subfolders.
    ///
    /// # Errors
    /// The folder cannot be read, or has no images.
    pub fn read(dir: &Path) -> anyhow::Result<Self> {
        let metadata = std::fs::metadata(dir)
            .with_context(|| format!("cannot read the folder {}", dir.display()))?;
        if !metadata.is_dir() {
            bail!("{} is a file; name the folder that it is in", dir.display());
        }
        let mut folder = Self { dir: dir.to_owned(), pictures: Vec::new(), skipped: Vec::new() };
        let mut entries = WalkDir::new(dir).follow_links(true).into_iter();
        while let Some(entry) = entries.next() {
            match entry {
                Ok(entry) if entry.depth() > 0 && is_foreign_folder(&entry) => {
                    folder.skip(entry.path(), foreign(&entry), false);
                    entries.skip_current_dir();
                }
                Ok(entry) => folder.add(&entry),
                Err(error) => folder.unreadable(&error)?,
            }
        }
        folder.pictures.sort_by(|a, b| natural::compare(a.id.as_str(), b.id.as_str()));
        folder.skipped.sort_by(|a, b| natural::compare(&a.file, &b.file));
        if folder.pictures.is_empty() {
            let skipped = folder.skipped.first().map_or_else(String::new, |first| {
                let count = folder.skipped.len();
                format!(
                    "; {count} of its entries were skipped, such as {}: {}",
                    first.file, first.why
                )
            });
            bail!(
                "found no picture (.jpg, .png, .webp and others) in {}{skipped}; name a folder of images",
                dir.display()
            );
        }
        Ok(folder)
    }

    /// The number of skipped files that may be pictures of the user's.
    pub fn lost(&self) -> usize {
        self.skipped.iter().filter(|skipped| skipped.is_lost).count()
    }

    fn skip(&mut self, path: &Path, why: impl Into<String>, is_lost: bool) {
        let file = path.to_string_lossy().into_owned();
        self.skipped.push(SkippedFile { file, why: why.into(), is_lost });
    }

    fn add(&mut self, entry: &DirEntry) {
        let (path, name) = (entry.path(), entry.file_name());
        if entry.file_type().is_dir() {
            return;
        }
        let lower = name.to_string_lossy().to_ascii_lowercase();
        if FOREIGN_FILES.contains(&lower.as_str()) {
            // Only of those with pictures in them.
            if lower != ".ds_store" {
                self.skip(path, "thumbnails of another program", false);
            }
            return;
        }
        if lower.starts_with("._") {
            if is_picture_name(path) || is_raw_name(path) {
                self.skip(
                    path,
                    "what macOS keeps about a file on a foreign disk, not a picture",
                    false,
                );
            }
            return;
        }
        if is_raw_name(path) {
            return self.add_raw(path);
        }
        if lower == POSES_FILE && entry.depth() > 1 {
            let why = "only the poses.csv of the folder itself is read; name this one with --poses, or index its folder";
            self.skip(path, why, false);
            return;
        }
        if !entry.file_type().is_file() {
            if is_picture_name(path) {
                self.skip(path, "neither a file nor a folder", true);
            }
            return;
        }
        let has_picture = || path.extension().is_none() && has_picture_bytes(path);
        if !is_picture_name(path) && !has_picture() {
            return;
        }
        if let Some(target) = link_as_text(path) {
            let why =
                format!("a link to {target:?} that was copied as text; put the picture there");
            return self.skip(path, why, true);
        }
        match image_id(&self.dir, path) {
            Ok(id) => self.pictures.push(PictureFile { file: path.to_owned(), id }),
            Err(why) => self.skip(path, why, true),
        }
    }

    /// Cameras often write a JPEG next to each raw file.
    fn add_raw(&mut self, path: &Path) {
        let has_twin = ["jpg", "JPG", "jpeg", "JPEG", "heic", "HEIC"]
            .iter()
            .any(|extension| path.with_extension(extension).is_file());
        match has_twin {
            true => self.skip(path, "a camera's raw file; the picture next to it is taken", false),
            false => self.skip(path, "a camera's raw file; export it as JPEG or PNG", true),
        }
    }

    /// A dangling link, a link to a folder above it, or a folder that may not be read.
    fn unreadable(&mut self, error: &walkdir::Error) -> anyhow::Result<()> {
        let path = error.path().unwrap_or(&self.dir).to_owned();
        if error.depth() == 0 {
            bail!("cannot read the folder {}: {error}", self.dir.display());
        }
        if error.loop_ancestor().is_some() {
            self.skip(&path, "a link to a folder that it is in", false);
            return Ok(());
        }
        let is_link = path.symlink_metadata().is_ok_and(|metadata| metadata.is_symlink());
        let may_be_pictures = path.extension().is_none() || is_picture_name(&path) || !is_link;
        let is_foreign =
            path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"._"));
        if may_be_pictures && !is_foreign {
            let why = match is_link {
                true => "a link whose target cannot be read; repair or remove it".to_owned(),
                false => match error.io_error() {
                    Some(error) => format!("cannot be read: {error}"),
                    None => "cannot be read".to_owned(),
                },
            };
            self.skip(&path, why, true);
        }
        Ok(())
    }
}

fn is_foreign_folder(entry: &DirEntry) -> bool {
    let name = entry.file_name().to_string_lossy().to_ascii_lowercase();
    let is_foreign = FOREIGN_FOLDERS.contains(&name.as_str()) || name.starts_with(".trash");
    entry.file_type().is_dir() && is_foreign
}

/// Describes a folder of another program, and counts the pictures in it.
fn foreign(entry: &DirEntry) -> String {
    /// Enough to know what is in the folder.
    const MOST: usize = 10_000;
    let files = WalkDir::new(entry.path()).into_iter().flatten().take(MOST);
    let pictures = files.filter(|file| file.file_type().is_file() && is_picture_name(file.path()));
    format!("a folder of another program, with {} pictures", pictures.count())
}

fn extension(path: &Path) -> String {
    path.extension().map(OsStr::to_string_lossy).unwrap_or_default().to_ascii_lowercase()
}

/// Whether the name of a file is that of a picture.
pub(super) fn is_picture_name(path: &Path) -> bool {
    EXTENSIONS.contains(&extension(path).as_str())
}

fn is_raw_name(path: &Path) -> bool {
    RAW_EXTENSIONS.contains(&extension(path).as_str())
}

/// Whether a file without an extension begins like a picture.
fn has_picture_bytes(path: &Path) -> bool {
    let mut head = Vec::with_capacity(32);
    let read = std::fs::File::open(path).and_then(|file| file.take(32).read_to_end(&mut head));
    read.is_ok() && MediaType::sniff(&head).is_some()
}

/// The target of a link that a version control system or an archive stored as a file with its path.
fn link_as_text(path: &Path) -> Option<String> {
    /// Longest path of common systems.
    const MOST: u64 = 4096;
    let length = path.metadata().ok()?.len();
    if !(1..=MOST).contains(&length) {
        return None;
    }
    let text = std::fs::read_to_string(path).ok()?;
    let target = text.trim_end();
    let is_path = is_picture_name(Path::new(target)) && !target.contains(char::is_control);
    is_path.then(|| target.to_owned())
}

fn image_id(dir: &Path, file: &Path) -> Result<ImageId, String> {
    let relative = file.strip_prefix(dir).unwrap_or(file);
    let text = relative.to_str().ok_or("the name is not valid UTF-8; rename the file")?;
    let id = text.parse::<ImageId>();
    id.map_err(|InvalidName(why)| format!("the name cannot be an id: {why}; rename the file"))
}

#[cfg(test)]
mod tests {
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
            "s/poses.csv",
        ]);
        let folder = Folder::read(dir.path()).unwrap();
        assert_eq!(ids(&folder), ["a.jpg"]);
        let expected =
            ["._a.jpg", ".thumbnails", "Thumbs.db", "__MACOSX", "a.dng", "s/@eaDir", "s/poses.csv"];
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
        let lost =
            [" b.jpg", "caf\u{FFFD}.jpg", &long, "only.nef", "tab\there.jpg", "y.jpg", "z.jpg"];
        for name in lost {
            assert!(skipped.contains(&(name, true)), "{name}: {skipped:?}");
        }
        assert!(
            skipped.contains(&("sub/up", false)) && skipped.len() == lost.len() + 1,
            "{skipped:?}"
        );
        assert_eq!(folder.lost(), lost.len());
    }

    #[test]
    fn a_folder_that_is_none_is_refused_in_words() {
        let dir = folder(&["a.jpg", "empty/readme.txt"]);
        let refused =
            |name: &str| format!("{:#}", Folder::read(&dir.path().join(name)).unwrap_err());
        assert!(refused("a.jpg").contains("is a file; name the folder"), "{}", refused("a.jpg"));
        assert!(refused("nowhere").contains("cannot read the folder"));
        assert!(refused("empty").contains("found no picture"));
    }
}
