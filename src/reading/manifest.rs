//! What a reader consists of and how its models are fed.

use std::path::Path;

use serde::Deserialize;
use whereabouts_core::Digest;
use whereabouts_vision::file_digest;

use super::ReadError;

/// The file that describes a reader, in its folder. Models of descriptors have another one.
pub const READER_MANIFEST: &str = "reader.toml";

/// A reader of scene text.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The name of the reader, which is that of its folder.
    pub name: String,
    /// What it is, for people.
    pub description: String,
    /// SPDX identifier of its licence.
    pub licence: String,
    /// Where its files are from.
    pub source: String,
    /// The model that finds lines of text.
    pub detector: DetectorSpec,
    /// The model that reads a line.
    pub recogniser: RecogniserSpec,
}

/// The model that finds lines of text: 1×3×H×W of blue, green and red to 1×1×H×W of probabilities.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorSpec {
    /// The ONNX file.
    pub file: String,
    /// Its digest.
    pub sha256: String,
    /// Pictures whose longer side exceeds this many pixels are scaled down to it.
    pub longest_side: u32,
    /// Subtracted from samples of 0 to 1.
    pub mean: [f32; 3],
    /// What the rest is divided by.
    pub std: [f32; 3],
    /// Probability from which on a pixel is text.
    pub pixel_threshold: f32,
    /// Mean probability from which on a region is a line.
    pub line_threshold: f32,
    /// How far regions are enlarged, as a share of area / perimeter.
    pub unclip: f32,
}

/// The model that reads a line: N×3×height×W of blue, green and red to N×T×classes of probabilities.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecogniserSpec {
    /// The ONNX file.
    pub file: String,
    /// Its digest.
    pub sha256: String,
    /// The file with the text of each class, a line each. The first class is the blank of CTC.
    pub keys: String,
    /// Its digest.
    pub keys_sha256: String,
    /// Height of a line in pixels.
    pub height: u32,
    /// Subtracted from samples of 0 to 1.
    pub mean: [f32; 3],
    /// What the rest is divided by.
    pub std: [f32; 3],
    /// Greatest width of a line in pixels.
    pub widest: u32,
    /// Least mean probability of the characters of a line.
    pub least_confidence: f32,
}

impl Manifest {
    /// Reads the manifest in a folder and checks the digests of its files. Returns the digest of all of them as well.
    pub fn open(folder: &Path) -> Result<(Self, Digest), ReadError> {
        let path = folder.join(READER_MANIFEST);
        let bad =
            |error: &dyn std::fmt::Display| ReadError::File(format!("{}: {error}", path.display()));
        let text = std::fs::read_to_string(&path).map_err(|error| bad(&error))?;
        let manifest: Self = toml::from_str(&text).map_err(|error| bad(&error))?;
        if let Some(why) = manifest.invalid() {
            return Err(bad(&why));
        }
        let (detector, recogniser) = (&manifest.detector, &manifest.recogniser);
        let mut described = text.into_bytes();
        for (file, pinned) in [
            (&detector.file, &detector.sha256),
            (&recogniser.file, &recogniser.sha256),
            (&recogniser.keys, &recogniser.keys_sha256),
        ] {
            let path = folder.join(file);
            let (digest, _) = file_digest(&path).map_err(|error| {
                ReadError::File(format!("cannot read {}: {error}", path.display()))
            })?;
            if digest.hex() != pinned.as_str() {
                let why = format!("{} is damaged: its SHA-256 is not {pinned}", path.display());
                return Err(ReadError::File(why));
            }
            described.extend(digest.to_string().as_bytes());
        }
        Ok((manifest, Digest::of(&described)))
    }

    /// Returns what is invalid; `None` if the manifest can be used.
    fn invalid(&self) -> Option<String> {
        let Self { detector, recogniser, .. } = self;
        for (field, number, least, most) in [
            ("detector.longest_side", detector.longest_side, 32, 8192),
            ("recogniser.height", recogniser.height, 8, 256),
            ("recogniser.widest", recogniser.widest, 32, 8192),
        ] {
            if !(least..=most).contains(&number) {
                return Some(format!("{field} is {number}; it must be {least} to {most}"));
            }
        }
        // NaN is in no range.
        for (field, number, most) in [
            ("detector.pixel_threshold", detector.pixel_threshold, 1.0),
            ("detector.line_threshold", detector.line_threshold, 1.0),
            ("detector.unclip", detector.unclip, 10.0),
            ("recogniser.least_confidence", recogniser.least_confidence, 1.0),
        ] {
            if !(0.0..=most).contains(&number) {
                return Some(format!("{field} is {number}; it must be 0 to {most}"));
            }
        }
        for (model, mean, std) in [
            ("detector", detector.mean, detector.std),
            ("recogniser", recogniser.mean, recogniser.std),
        ] {
            if !mean.iter().all(|mean| mean.is_finite()) {
                return Some(format!("{model}.mean must be three finite numbers"));
            }
            if !std.iter().all(|std| std.is_finite() && *std > 0.0) {
                return Some(format!("{model}.std must be three numbers above 0"));
            }
        }
        let is_name = |file: &&String| Path::new(file.as_str()).file_name() == Some(file.as_ref());
        let files = [&detector.file, &recogniser.file, &recogniser.keys];
        let outside = files.into_iter().find(|file| !is_name(file))?;
        Some(format!("{outside:?} is not the name of a file in the folder of the reader"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The manifest of the reader that `make reader` installs.
    const SHIPPED: &str = include_str!("../../deploy/models/ppocrv5.toml");

    fn invalid(change: (&str, &str)) -> Option<String> {
        let changed = SHIPPED.replacen(change.0, change.1, 1);
        assert!(change.0 == change.1 || changed != SHIPPED, "{change:?} changes nothing");
        toml::from_str::<Manifest>(&changed).unwrap().invalid()
    }

    #[test]
    fn the_shipped_manifest_is_valid() {
        assert_eq!(invalid(("", "")), None);
    }

    #[test]
    fn a_manifest_that_cannot_be_used_is_refused_with_the_field() {
        for (line, field) in [
            ("longest_side = 0", "detector.longest_side"),
            ("pixel_threshold = nan", "detector.pixel_threshold"),
            ("line_threshold = 1.5", "detector.line_threshold"),
            ("unclip = -1.0", "detector.unclip"),
            ("unclip = inf", "detector.unclip"),
            ("mean = [nan, 0.5, 0.5]", "detector.mean"),
            ("std = [0.2, 0.0, 0.2]", "detector.std"),
            ("height = 4", "recogniser.height"),
            ("widest = 100000", "recogniser.widest"),
            ("least_confidence = -0.1", "recogniser.least_confidence"),
            ("file = \"../other.onnx\"", "../other.onnx"),
            ("file = \"/etc/passwd\"", "/etc/passwd"),
            ("file = \"\"", "\"\""),
            ("file = \"..\"", "\"..\""),
            ("keys = \"a/b.txt\"", "a/b.txt"),
        ] {
            let name = line.split(" =").next().unwrap();
            let shipped = SHIPPED.lines().find(|of| of.starts_with(&format!("{name} ="))).unwrap();
            let why = invalid((shipped, line)).unwrap();
            assert!(why.contains(field), "{line}: {why}");
        }
    }
}
