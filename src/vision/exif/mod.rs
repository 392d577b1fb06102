//! The position that a camera or a tagger wrote into a picture: EXIF GPS in JPEG, PNG, WebP and TIFF.
//!
//! Taggers differ, and a strict reader loses positions that every other program shows. This one reads on past
//! what does not matter (a missing or wrong offset of the next directory, a field that points outside the file),
//! and refuses to guess what does: a coordinate without its hemisphere letter is no position, and a warning.
//! The table of habits in `tests` has one row per tagger and habit.

mod container;
mod gps;
#[cfg(test)]
mod tests;
mod tiff;

use self::tiff::Tiff;
use whereabouts_core::GeographicPose;

/// What the EXIF data of a picture say about its position.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GpsReading {
    /// The position, if there is one that can be trusted.
    pub pose: Option<GeographicPose>,
    /// What was not taken, and why; each completes the sentence "In this picture, …". The texts have no values,
    /// so that equal ones can be counted.
    pub warnings: Vec<String>,
}

/// Reads the position from the EXIF data of a picture. Never fails: a picture without readable EXIF data has no
/// position. Looks only at the metadata and decodes no pixel.
pub fn gps(bytes: &[u8]) -> GpsReading {
    let mut warnings = Vec::new();
    for block in container::exif_blocks(bytes) {
        let Some(tiff) = Tiff::parse(&block) else { continue };
        for directory in tiff.gps_directories() {
            let reading = gps::read(&directory);
            if reading.pose.is_some() {
                return reading;
            }
            let new = reading.warnings.into_iter().filter(|text| !warnings.contains(text));
            warnings.extend(new.collect::<Vec<_>>());
        }
    }
    GpsReading { pose: None, warnings }
}
