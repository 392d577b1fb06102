//! A folder of pictures: which files it holds, and under which ids they are known.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use walkdir::WalkDir;

use whereabouts_core::ImageId;

/// A picture of a folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PictureFile {
    /// Where it is.
    pub file: PathBuf,
    /// Its path below the folder.
    pub id: ImageId,
}

/// The pictures of a folder and of the folders in it, by name.
pub fn pictures(dir: &Path) -> anyhow::Result<Vec<PictureFile>> {
    let mut pictures = Vec::new();
    for entry in WalkDir::new(dir).follow_links(true).sort_by_file_name() {
        let entry = entry.with_context(|| format!("cannot read the folder {}", dir.display()))?;
        if entry.file_type().is_file() && is_picture(entry.path()) {
            let file = entry.into_path();
            let id = image_id(dir, &file).with_context(|| file.display().to_string())?;
            pictures.push(PictureFile { file, id });
        }
    }
    if pictures.is_empty() {
        bail!("there is no .jpg, .jpeg, .png or .webp file in {}", dir.display());
    }
    Ok(pictures)
}

fn is_picture(path: &Path) -> bool {
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or("");
    matches!(extension.to_ascii_lowercase().as_str(), "jpg" | "jpeg" | "png" | "webp")
}

fn image_id(dir: &Path, file: &Path) -> anyhow::Result<ImageId> {
    let below = file.strip_prefix(dir).unwrap_or(file);
    let text = below.to_str().context("its name is not UTF-8; rename it")?;
    Ok(text.parse::<ImageId>()?)
}
