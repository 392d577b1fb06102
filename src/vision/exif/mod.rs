//! The position that a camera or a tagger wrote into a picture: EXIF GPS and XMP
//! in JPEG, PNG, WebP, TIFF and GIF.
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
mod xmp;

use std::borrow::Cow;

use self::container::Metadata;
use self::tiff::Tiff;
use self::xmp::Packet;
use whereabouts_core::GeographicPose;

/// What the metadata of a picture say about its position.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct GpsReading {
    /// The position, if there is one that can be trusted.
    pub pose: Option<GeographicPose>,
    /// What was not taken, and why; each completes the sentence "In this picture, …". The texts have no values,
    /// so that equal ones can be counted.
    pub warnings: Vec<String>,
}

/// Reads the position from the EXIF data of a picture, or else from its XMP packets, which may also have the heading
/// that EXIF lacks. Never fails: a picture without readable metadata has no position. Looks only at the metadata and
/// decodes no pixel.
pub fn gps(bytes: &[u8]) -> GpsReading {
    let Metadata { exif, xmp } = Metadata::find(bytes);
    let structures: Vec<_> =
        exif.iter().filter_map(|block| Some(Tiff::parse(block)?.contents())).collect();
    let texts: Vec<Cow<'_, str>> = xmp
        .iter()
        .map(AsRef::as_ref)
        .chain(structures.iter().flat_map(|found| found.xmp.iter().copied()))
        .take(container::MAX_BLOCKS)
        .map(|packet| String::from_utf8_lossy(container::bounded(packet)))
        .collect();
    let packets: Vec<Packet<'_>> = texts.iter().map(|text| Packet::parse(text)).collect();
    let of_exif = structures.iter().flat_map(|found| &found.gps).map(|fields| gps::read(fields));
    let mut warnings = Vec::new();
    for reading in of_exif.chain(packets.iter().map(Packet::position)) {
        if let Some(pose) = reading.pose {
            let heading = pose.heading.or_else(|| packets.iter().find_map(Packet::heading));
            let pose = Some(GeographicPose { heading, ..pose });
            return GpsReading { pose, ..reading };
        }
        let new = reading.warnings.into_iter().filter(|text| !warnings.contains(text));
        warnings.extend(new.collect::<Vec<_>>());
    }
    GpsReading { pose: None, warnings }
}
