//! The manifest: a TOML file next to an ONNX file that describes it.

mod check;
mod kinds;

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::iter;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize};
use sha2::{Digest as _, Sha256};

pub(crate) use self::kinds::own_digest;
pub use self::kinds::{Method, Vlad, Weighting};
use whereabouts_core::{DescriptorKind, Digest};

/// The manifest's file name in a model's folder.
pub const MANIFEST: &str = "manifest.toml";

/// Describes a model: its input, its output and how the output is pooled.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Name by which maps refer to the model.
    pub name: String,
    /// One sentence for people.
    #[serde(default)]
    pub description: String,
    /// The ONNX file, next to the manifest.
    pub file: PathBuf,
    /// Pinned digest of the ONNX file, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<Digest>,
    /// Licence of the weights.
    pub licence: String,
    /// Origin of the weights.
    pub source: String,
    /// The kind of descriptor of a new map, if none is requested; `gem` if omitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub default_descriptor: Option<DescriptorKind>,
    /// Files of external weights, which exporters write for large models, and some for all models.
    #[serde(default, deserialize_with = "one_or_many", skip_serializing_if = "Vec::is_empty")]
    pub data: Vec<DataFile>,
    /// The input tensor.
    pub input: Input,
    /// The output tensors.
    pub output: Output,
    /// How the output is pooled to the descriptor `gem`.
    pub pooling: Pooling,
    /// Further kinds of descriptors by name, besides `gem` and, if the model outputs a `[CLS]` token, `cls`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub descriptors: BTreeMap<DescriptorKind, Method>,
}

/// A file of external weights, referenced by the ONNX file.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataFile {
    /// Path relative to the ONNX file, as referenced there.
    pub file: PathBuf,
    /// Pinned digest, if any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<Digest>,
}

/// Reads one table or a list of them.
fn one_or_many<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<DataFile>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum OneOrMany {
        One(DataFile),
        Many(Vec<DataFile>),
    }
    Ok(match OneOrMany::deserialize(deserializer)? {
        OneOrMany::One(file) => vec![file],
        OneOrMany::Many(files) => files,
    })
}

impl Manifest {
    /// The files of the model and their pinned digests: the ONNX file, those of external weights, and those of the
    /// kinds of descriptors.
    pub fn files(&self) -> impl Iterator<Item = (&Path, Option<Digest>)> {
        let data = self.data.iter().map(|data| (data.file.as_path(), data.sha256));
        iter::once((self.file.as_path(), self.sha256)).chain(data).chain(self.vocabularies())
    }

    /// The files that kinds of descriptors need, and their pinned digests.
    pub fn vocabularies(&self) -> impl Iterator<Item = (&Path, Option<Digest>)> {
        self.descriptors.values().filter_map(Method::file)
    }

    /// Pins the digests of the files, in the order of [`files`](Self::files).
    pub fn pin(&mut self, digests: &[Digest]) {
        let mut digests = digests.iter().copied();
        self.sha256 = digests.next().or(self.sha256);
        for (data, digest) in self.data.iter_mut().zip(digests.by_ref()) {
            data.sha256 = Some(digest);
        }
        let with_file = self.descriptors.values_mut().filter(|method| method.file().is_some());
        with_file.zip(digests).for_each(|(method, digest)| method.pin(digest));
    }
}

/// Computes the digest and the size of a file without reading it into memory as a whole.
pub fn file_digest(path: &Path) -> io::Result<(Digest, u64)> {
    let (mut file, mut hasher, mut bytes) = (File::open(path)?, Sha256::new(), 0);
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok((Digest::from(<[u8; 32]>::from(hasher.finalize())), bytes)),
            read => {
                hasher.update(&buffer[..read]);
                bytes += read as u64;
            }
        }
    }
}

/// The input tensor: N × 3 × height × width, RGB.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// Name in the graph.
    pub name: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// How a picture is fitted to width × height.
    pub resize: Resize,
    /// Resampling filter, with antialiasing.
    pub interpolation: Interpolation,
    /// Width and height are multiples of this.
    pub multiple: u32,
    /// Subtracted from each channel, after scaling to 0..1.
    pub mean: [f32; 3],
    /// Divides each channel, after subtracting the mean.
    pub std: [f32; 3],
}

impl fmt::Display for Input {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { width, height, .. } = self;
        match self.resize {
            Resize::Squash => write!(f, "the whole picture, stretched to {width}×{height}"),
            Resize::CentreCrop => write!(f, "a centre crop of {width}×{height}"),
            Resize::LongestEdge => {
                write!(f, "the whole picture, its longer edge scaled to {}", width.max(height))
            }
        }
    }
}

/// How a picture is fitted to the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Resize {
    /// Stretch to width × height.
    Squash,
    /// Crop the largest centred region with the aspect ratio of the input, then scale it.
    CentreCrop,
    /// Keep the aspect ratio: scale the longer edge to the longer of width and height, and round both edges
    /// to multiples.
    LongestEdge,
}

/// The resampling filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Keys' cubic convolution with a = −0.5, as Pillow and torchvision use when antialiasing.
    Bicubic,
    /// Triangle filter.
    Bilinear,
}

/// The output tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// Name of the local features in the graph.
    pub features: String,
    /// Layout of the local features.
    pub layout: Layout,
    /// Name of the N × 1 × h × w reliability map, if the model outputs one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reliability: Option<String>,
    /// Numbers in each local feature.
    pub channels: usize,
    /// Input pixels per cell in both directions (the patch size of a transformer).
    pub stride: u32,
    /// Number of register tokens between the `[CLS]` token and the patches.
    #[serde(default)]
    pub registers: usize,
    /// Whether the first token is a `[CLS]` token.
    #[serde(default)]
    pub cls: bool,
}

/// Layout of the local features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// N × channels × h × w.
    Map,
    /// N × (cls + registers + h·w) × channels, patches row by row.
    Tokens,
}

/// How local features are pooled to a generalised mean.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pooling {
    /// Exponent of the generalised mean.
    pub gem_p: f32,
    /// Rows and columns of the spatial grid; `[1, 1]` pools the whole picture.
    pub grid: [usize; 2],
    /// Dimension of the GeM descriptor: channels × rows × columns.
    pub dimension: usize,
}

/// Why a manifest is invalid.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The file cannot be read.
    #[error(
        "cannot read the manifest {path}: {source}; `whereabouts model list` shows what is installed"
    )]
    Read {
        /// Path of the manifest.
        path: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// The file is not a manifest.
    #[error("{path} is not a model manifest: {detail}")]
    Malformed {
        /// Path of the manifest.
        path: PathBuf,
        /// Message of the parser.
        detail: String,
    },
    /// A setting asks for a size that the model cannot take.
    #[error("model.sizes has {setting:?}, but {detail}")]
    Size {
        /// The entry of the setting.
        setting: String,
        /// Why it cannot be.
        detail: String,
    },
    /// The values contradict each other.
    #[error("{path}: {detail}")]
    Inconsistent {
        /// Path of the manifest.
        path: PathBuf,
        /// Which values, and how.
        detail: String,
    },
}

impl Manifest {
    /// Reads and validates a `manifest.toml`.
    pub fn read(path: &Path) -> Result<Self, ManifestError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ManifestError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// Parses and validates a manifest; `path` is used in error messages.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ManifestError> {
        let manifest: Self = toml::from_str(text).map_err(|error| ManifestError::Malformed {
            path: path.to_owned(),
            detail: error.to_string(),
        })?;
        manifest.check(path)?;
        Ok(manifest)
    }

    /// Validates the manifest; `path` is used in error messages.
    pub fn check(&self, path: &Path) -> Result<(), ManifestError> {
        match self.fault() {
            Some(detail) => Err(ManifestError::Inconsistent { path: path.to_owned(), detail }),
            None => Ok(()),
        }
    }

    /// Serializes the manifest to the format that [`Self::parse`] reads.
    pub fn to_toml(&self) -> Result<String, ManifestError> {
        toml::to_string(self).map_err(|error| ManifestError::Malformed {
            path: self.name.clone().into(),
            detail: error.to_string(),
        })
    }
}

#[cfg(test)]
mod tests;
