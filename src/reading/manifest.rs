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
        let (detector, recogniser) = (&manifest.detector, &manifest.recogniser);
        let longest = (32..=8192).contains(&detector.longest_side);
        let line =
            (8..=256).contains(&recogniser.height) && (32..=8192).contains(&recogniser.widest);
        if !longest || !line {
            return Err(bad(&"longest_side and widest must be 32 to 8192, height 8 to 256"));
        }
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
}
