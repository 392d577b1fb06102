//! Lists the images in a folder and derives their ids. A file that cannot be one of them is skipped with the
//! reason, and never costs the others.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use walkdir::{DirEntry, WalkDir};

use super::natural;
use super::poses::{POSES_FILE, sidecar};
use whereabouts_core::{ImageId, InvalidName, Leftover, MediaType};

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

/// Extensions of pictures. Whether the service reads a format is decided by its bytes; what it does not read is
/// refused with a way to convert it.
const EXTENSIONS: [&str; 50] = [
    "jpg", "jpeg", "jpe", "jfif", "jif", "jps", "mpo", "png", "apng", "webp", "tif", "tiff", "bmp",
    "dib", "gif", "pnm", "pgm", "ppm", "pbm", "pam", "heic", "heif", "hif", "heics", "avif",
    "avifs", "jxl", "jp2", "jpx", "j2k", "j2c", "jpf", "jxr", "wdp", "hdp", "tga", "psd", "psb",
    "qoi", "exr", "hdr", "pfm", "pcx", "sgi", "dds", "ras", "xcf", "flif", "bpg", "ff",
];

/// Extensions of drawings and icons, which no camera takes.
const DRAWINGS: [&str; 8] = ["ico", "cur", "icns", "svg", "svgz", "xpm", "xbm", "wmf"];

/// Extensions of videos.
const VIDEOS: [&str; 14] = [
    "mp4", "m4v", "mov", "avi", "mkv", "webm", "mts", "m2ts", "mpg", "mpeg", "wmv", "insv", "lrv",
    "3gp",
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
        let mut sidecars = Vec::new();
        let mut entries = WalkDir::new(dir).follow_links(true).into_iter();
        while let Some(entry) = entries.next() {
            match entry {
                Ok(entry) if entry.depth() > 0 && is_foreign_folder(&entry) => {
                    folder.skip(entry.path(), foreign(&entry), false);
                    entries.skip_current_dir();
                }
                Ok(entry) if entry.file_type().is_file() && is_sidecar_name(entry.path()) => {
                    sidecars.push(entry.into_path());
                }
                Ok(entry) => folder.add(&entry),
                Err(error) => folder.unreadable(&error)?,
            }
        }
        folder.name_loose_sidecars(sidecars);
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

    /// Skips the descriptions that belong to no picture.
    fn name_loose_sidecars(&mut self, sidecars: Vec<PathBuf>) {
        let loose: Vec<(PathBuf, &str)> = {
            let pictures: HashSet<&Path> =
                self.pictures.iter().map(|picture| picture.file.as_path()).collect();
            // `a.json` next to `a.jpg`.
            let stems: HashSet<PathBuf> =
                pictures.iter().map(|picture| picture.with_extension("")).collect();
            let why = |sidecar: &Path| {
                let of = sidecar.with_extension("");
                if pictures.contains(of.as_path()) {
                    None
                } else if is_picture_name(&of) {
                    Some("it describes a picture that is not in the folder, or was skipped")
                } else {
                    (stems.contains(&of) && sidecar::has_pose(sidecar)).then_some(
                        "it has a pose, but not the name of a picture before .json (a.jpg.json for a.jpg); rename it",
                    )
                }
            };
            sidecars.into_iter().filter_map(|file| Some((file.clone(), why(&file)?))).collect()
        };
        for (file, why) in loose {
            self.skip(&file, why, false);
        }
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
        let name = name.to_string_lossy();
        match Leftover::of_file(&name) {
            None => {}
            Some(Leftover::Settings) => return,
            Some(Leftover::Thumbnails) => {
                return self.skip(path, "thumbnails of another program", false);
            }
            Some(Leftover::Shadow) => {
                if is_picture_name(path) || is_raw_name(path) {
                    let why = "what macOS keeps about a file on a foreign disk, not a picture";
                    self.skip(path, why, false);
                }
                return;
            }
        }
        if is_raw_name(path) {
            return self.add_raw(path);
        }
        let extension = extension(path);
        if DRAWINGS.contains(&extension.as_str()) {
            return self.skip(path, "an icon or a drawing, not a picture of a camera", false);
        }
        if VIDEOS.contains(&extension.as_str()) {
            return self.add_video(path);
        }
        if name.eq_ignore_ascii_case(POSES_FILE) && entry.depth() > 1 {
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
        match has_twin(path) {
            true => self.skip(path, "a camera's raw file; the picture next to it is taken", false),
            false => self.skip(path, "a camera's raw file; export it as JPEG or PNG", true),
        }
    }

    /// Phones and cameras keep a short video next to a picture.
    fn add_video(&mut self, path: &Path) {
        if !has_twin(path) {
            let why = "a video; take single frames from it: ffmpeg -i IN -vf fps=1 %06d.jpg";
            self.skip(path, why, false);
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
    entry.file_type().is_dir() && Leftover::is_folder(&entry.file_name().to_string_lossy())
}

/// Describes a folder of another program, and counts the pictures in it.
fn foreign(entry: &DirEntry) -> String {
    /// Enough to know what is in the folder.
    const MOST: usize = 10_000;
    let files = WalkDir::new(entry.path()).into_iter().flatten().take(MOST);
    let pictures = files.filter(|file| file.file_type().is_file() && is_picture_name(file.path()));
    format!("a folder of another program, with {} pictures", pictures.count())
}

/// Whether a file may describe a picture; the shadows of macOS do not.
fn is_sidecar_name(path: &Path) -> bool {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    extension(path) == "json" && Leftover::of_file(&name).is_none()
}

fn extension(path: &Path) -> String {
    path.extension().map(OsStr::to_string_lossy).unwrap_or_default().to_ascii_lowercase()
}

/// Whether the name of a file is that of a picture.
pub(super) fn is_picture_name(path: &Path) -> bool {
    EXTENSIONS.contains(&extension(path).as_str())
}

/// Whether there is a picture of the same name.
fn has_twin(path: &Path) -> bool {
    let extensions = ["jpg", "JPG", "jpeg", "JPEG", "heic", "HEIC"];
    extensions.iter().any(|extension| path.with_extension(extension).is_file())
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
mod tests;
