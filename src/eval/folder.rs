//! Lists the images in a folder and derives their ids.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use walkdir::WalkDir;

use whereabouts_core::{ImageId, MediaType};

/// An image file in a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PictureFile {
    /// Path of the file.
    pub file: PathBuf,
    /// Path relative to the folder.
    pub id: ImageId,
}

/// Lists the images in a folder and its subfolders, sorted by name.
///
/// # Errors
/// The folder cannot be read or has no images, or the path of an image cannot be an id.
pub fn pictures(dir: &Path) -> anyhow::Result<Vec<PictureFile>> {
    let mut pictures = Vec::new();
    for entry in WalkDir::new(dir).follow_links(true).sort_by_file_name() {
        let entry = entry.with_context(|| format!("cannot read the folder {}", dir.display()))?;
        if entry.file_type().is_file() && has_image_extension(entry.path()) {
            let file = entry.into_path();
            let id = image_id(dir, &file).with_context(|| file.display().to_string())?;
            pictures.push(PictureFile { file, id });
        }
    }
    if pictures.is_empty() {
        bail!(
            "found no picture in {} (a file named .{}); name a folder of images",
            dir.display(),
            MediaType::EXTENSIONS.join(", .")
        );
    }
    Ok(pictures)
}

fn has_image_extension(path: &Path) -> bool {
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or("");
    MediaType::EXTENSIONS.contains(&extension.to_ascii_lowercase().as_str())
}

fn image_id(dir: &Path, file: &Path) -> anyhow::Result<ImageId> {
    let relative = file.strip_prefix(dir).unwrap_or(file);
    let text = relative.to_str().context("the name is not valid UTF-8; rename the file")?;
    Ok(text.parse::<ImageId>()?)
}
