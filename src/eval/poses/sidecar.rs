//! The file next to an image that describes it: `a.jpg.json`, as in an archive for a bulk upload.

use std::path::{Path, PathBuf};

use super::place::Place;
use super::{KnownImage, PoseSource};
use whereabouts_api::ImageMeta;

/// Largest description in bytes, as in a bulk upload.
const MAX_BYTES: u64 = 64 << 10;

/// How the warning begins that the file next to an image cannot be used: whatever pose it has is lost.
pub const UNUSED_DESCRIPTION: &str = "the description next to it is not used";

/// Reads what the file next to an image says. One that cannot be used is a warning.
pub(super) fn read(picture: &Path) -> KnownImage {
    let mut name = picture.as_os_str().to_owned();
    name.push(".json");
    let file = PathBuf::from(name);
    let Ok(metadata) = file.metadata() else { return KnownImage::default() };
    if !metadata.is_file() {
        return KnownImage::default();
    }
    match described(&file, metadata.len()) {
        Ok(image) => image,
        Err(why) => KnownImage {
            warnings: vec![format!("{UNUSED_DESCRIPTION}: {why}")],
            ..KnownImage::default()
        },
    }
}

/// Whether a file is the description of a picture with a pose.
pub(crate) fn has_pose(file: &Path) -> bool {
    let bytes = file.metadata().map_or(u64::MAX, |metadata| metadata.len());
    described(file, bytes).is_ok_and(|image| image.place.is_some())
}

fn described(file: &Path, bytes: u64) -> Result<KnownImage, String> {
    if bytes > MAX_BYTES {
        return Err(format!("it has more than {MAX_BYTES} bytes"));
    }
    let text = std::fs::read(file).map_err(|error| error.to_string())?;
    let text = text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(&text);
    let meta: ImageMeta = serde_json::from_slice(text).map_err(|error| error.to_string())?;
    let ImageMeta { id, pose, captured_at, tags, .. } = meta;
    let mut image = KnownImage { captured_at, tags, ..KnownImage::default() };
    if let Some(pose) = pose.filter(|pose| !pose.is_empty()) {
        let frame = pose.frame().ok_or("a pose needs either lat and lon, or x and y")?;
        let pose = pose.check(frame).map_err(|error| error.to_string())?;
        image.place = Some((PoseSource::Sidecar, Place::of(pose)));
    }
    if id.is_some() {
        image.warnings.push("the id in the description next to it is not used".to_owned());
    }
    Ok(image)
}
