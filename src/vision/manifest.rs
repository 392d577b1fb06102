//! The manifest: what a TOML file beside an ONNX file says about it.

use std::fs::File;
use std::io::{self, Read};
use std::iter;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use whereabouts_core::{DescriptorKind, Digest};

/// The manifest's file name in a model's folder.
pub const MANIFEST: &str = "manifest.toml";

/// All that is needed to feed a model and to pool what comes out.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The name by which maps refer to the model.
    pub name: String,
    /// One sentence for people.
    #[serde(default)]
    pub description: String,
    /// The ONNX file, beside the manifest.
    pub file: PathBuf,
    /// The digest that the file must have, if pinned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<Digest>,
    /// The licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub source: String,
    /// The weights, where they are not in the ONNX file, which holds two gigabytes at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub data: Option<DataFile>,
    /// What goes in.
    pub input: Input,
    /// What comes out.
    pub output: Output,
    /// How the output becomes a descriptor.
    pub pooling: Pooling,
}

/// A file of weights beside the ONNX file, which names it.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataFile {
    /// Its name; the one that the ONNX file has for it.
    pub file: PathBuf,
    /// The digest that it must have, if pinned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<Digest>,
}

/// All in a manifest that decides a descriptor.
#[derive(Serialize)]
struct Deciding<'a> {
    input: &'a Input,
    output: &'a Output,
    pooling: &'a Pooling,
}

impl Manifest {
    /// The files of the model and the digests that are pinned, the ONNX file first.
    pub fn files(&self) -> impl Iterator<Item = (&Path, Option<Digest>)> {
        let data = self.data.as_ref().map(|data| (data.file.as_path(), data.sha256));
        iter::once((self.file.as_path(), self.sha256)).chain(data)
    }

    /// Pins the digests of [`files`](Self::files), in their order.
    pub fn pin(&mut self, digests: &[Digest]) {
        self.sha256 = digests.first().copied().or(self.sha256);
        if let (Some(data), Some(digest)) = (&mut self.data, digests.get(1)) {
            data.sha256 = Some(*digest);
        }
    }

    /// The digest of all that decides a descriptor: the files of weights, whose digests are `files`, and
    /// how they are fed and pooled. What a manifest says to people does not count.
    pub fn digest(&self, files: &[Digest]) -> Digest {
        let file = files.iter().map(Digest::to_string).collect::<Vec<_>>().join("\n");
        let Self { input, output, pooling, .. } = self;
        // Structs of numbers, words and lists of these can always be written as TOML.
        let text = toml::to_string(&Deciding { input, output, pooling }).unwrap_or_default();
        Digest::of(format!("{file}\n{text}").as_bytes())
    }
}

/// The digest and the size of a file that may not fit into memory.
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
    /// Its name in the graph.
    pub name: String,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// How a picture of another shape is fitted.
    pub resize: Resize,
    /// The filter; both are antialiased.
    pub interpolation: Interpolation,
    /// Both edges are multiples of this many pixels.
    pub multiple: u32,
    /// Subtracted from each channel after scaling to 0..1.
    pub mean: [f32; 3],
    /// Divides each channel after that.
    pub std: [f32; 3],
}

/// How a picture is fitted to the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Resize {
    /// Stretch to width × height.
    Squash,
    /// Cut the largest centred part of the right shape, then scale it.
    CentreCrop,
    /// Keep the shape; the longer edge becomes the longer of width and height at the most, and
    /// both edges are rounded to multiples.
    LongestEdge,
}

/// The resampling filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Keys' cubic convolution with a = −0.5, as Pillow and torchvision use when antialiasing.
    Bicubic,
    /// The triangle filter.
    Bilinear,
}

/// The output tensors.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// The name of the local features in the graph.
    pub features: String,
    /// How they are laid out.
    pub layout: Layout,
    /// The name of the N × 1 × h × w reliability map, if the model has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reliability: Option<String>,
    /// Numbers for each local feature.
    pub channels: usize,
    /// Input pixels for each cell, in both directions (the patch size of a transformer).
    pub stride: u32,
    /// Register tokens between the `[CLS]` token and the patches.
    #[serde(default)]
    pub registers: usize,
    /// Whether a `[CLS]` token leads.
    #[serde(default)]
    pub cls: bool,
}

/// How local features are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// N × channels × h × w.
    Map,
    /// N × (cls + registers + h·w) × channels, patches row by row.
    Tokens,
}

/// How local features become a descriptor.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pooling {
    /// The exponent of the generalised mean.
    pub gem_p: f32,
    /// Rows and columns of the spatial grid; `[1, 1]` pools the whole picture at once.
    pub grid: [usize; 2],
    /// Numbers in the GeM descriptor: channels × rows × columns.
    pub dimension: usize,
}

/// Why a manifest cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The file cannot be read.
    #[error(
        "cannot read the manifest {path}: {source}; `whereabouts model list` shows what is installed"
    )]
    Read {
        /// The manifest.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not a manifest.
    #[error("{path} is not a model manifest: {detail}")]
    Malformed {
        /// The manifest.
        path: PathBuf,
        /// What the reader said.
        detail: String,
    },
    /// The numbers contradict each other.
    #[error("{path}: {detail}")]
    Inconsistent {
        /// The manifest.
        path: PathBuf,
        /// Which ones, and how.
        detail: String,
    },
}

impl Manifest {
    /// Reads and checks `manifest.toml` in a model's folder.
    pub fn read(path: &Path) -> Result<Self, ManifestError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ManifestError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// Reads a manifest from its text; `path` is for messages.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ManifestError> {
        let manifest: Self = toml::from_str(text).map_err(|error| ManifestError::Malformed {
            path: path.to_owned(),
            detail: error.to_string(),
        })?;
        manifest.check(path)?;
        Ok(manifest)
    }

    /// Checks that the numbers fit each other; `path` is for messages.
    pub fn check(&self, path: &Path) -> Result<(), ManifestError> {
        match self.validate() {
            Some(detail) => Err(ManifestError::Inconsistent { path: path.to_owned(), detail }),
            None => Ok(()),
        }
    }

    /// The text that [`Self::parse`] reads.
    pub fn to_toml(&self) -> Result<String, ManifestError> {
        toml::to_string(self).map_err(|error| ManifestError::Malformed {
            path: self.name.clone().into(),
            detail: error.to_string(),
        })
    }

    /// Numbers in a descriptor of the given kind; `None` if the model cannot make one.
    pub fn dimension(&self, kind: DescriptorKind) -> Option<usize> {
        match kind {
            DescriptorKind::Gem => Some(self.pooling.dimension),
            DescriptorKind::Cls => self.output.cls.then_some(self.output.channels),
        }
    }

    fn validate(&self) -> Option<String> {
        const LARGEST_EDGE: u32 = 4096;
        const MOST_CHANNELS: usize = 1 << 14;
        let (input, output, pooling) = (&self.input, &self.output, &self.pooling);
        let [rows, columns] = pooling.grid;
        let plain = |file: &Path| file.components().count() == 1 && file.file_name().is_some();
        if !self.files().all(|(file, _)| plain(file) && file != Path::new(MANIFEST)) {
            return Some("file must be a plain file name beside the manifest".into());
        }
        if self.data.as_ref().is_some_and(|data| data.file == self.file) {
            return Some("data.file must be another file than file".into());
        }
        if input.multiple == 0 || output.stride == 0 {
            return Some("input.multiple and output.stride must be at least 1".into());
        }
        if !(1..=MOST_CHANNELS).contains(&output.channels) {
            return Some(format!("output.channels must be 1 to {MOST_CHANNELS}"));
        }
        for (edge, pixels) in [("width", input.width), ("height", input.height)] {
            if pixels == 0 || pixels > LARGEST_EDGE || pixels % input.multiple != 0 {
                return Some(format!(
                    "input.{edge} = {pixels} must be a multiple of {} up to {LARGEST_EDGE}",
                    input.multiple
                ));
            }
        }
        if input.multiple % output.stride != 0 {
            return Some("input.multiple must be a multiple of output.stride".into());
        }
        if rows == 0 || columns == 0 || rows * columns > 1024 {
            return Some("pooling.grid must have 1 to 1024 parts".into());
        }
        if pooling.dimension != output.channels * rows * columns {
            return Some(format!(
                "pooling.dimension is {}, but channels × rows × columns is {}",
                pooling.dimension,
                output.channels * rows * columns
            ));
        }
        let usable = pooling.gem_p > 0.0 && pooling.gem_p.is_finite();
        if !usable {
            return Some("pooling.gem_p must be above 0".into());
        }
        let positive = input.std.iter().all(|&s| s > 0.0);
        if !positive {
            return Some("input.std must be above 0".into());
        }
        if output.layout == Layout::Map && (output.cls || output.registers > 0) {
            return Some("a map layout has neither a [CLS] token nor registers".into());
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const XFEAT: &str = include_str!("../../deploy/models/xfeat.toml");

    fn parse(text: &str) -> Result<Manifest, ManifestError> {
        Manifest::parse(text, Path::new("manifest.toml"))
    }

    #[test]
    fn the_built_in_manifest_is_consistent() {
        let manifest = parse(XFEAT).unwrap();
        assert_eq!(manifest.dimension(DescriptorKind::Gem), Some(576));
        assert_eq!(manifest.dimension(DescriptorKind::Cls), None);
    }

    #[test]
    fn contradictions_are_named() {
        for (from, to, named) in [
            ("dimension = 576", "dimension = 64", "dimension"),
            ("width = 320", "width = 321", "width"),
            ("file = \"model.onnx\"", "file = \"../model.onnx\"", "file"),
            ("[input]", "[data]\nfile = \"../weights\"\n[input]", "file"),
            ("[input]", "[data]\nfile = \"model.onnx\"\n[input]", "data.file"),
            ("gem_p = 3.0", "gem_p = 0.0", "gem_p"),
            ("cls = false", "cls = true", "CLS"),
        ] {
            let error = parse(&XFEAT.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains(named), "{to}: {error}");
        }
    }

    #[test]
    fn the_digest_covers_what_decides_a_descriptor_and_nothing_else() {
        let file = Digest::of(b"weights");
        let digest = |from: &str, to: &str| {
            let text = XFEAT.replace(from, to);
            assert!(from.is_empty() || text != XFEAT, "{from}");
            parse(&text).unwrap().digest(&[file])
        };
        let plain = digest("", "");
        assert_eq!(digest("licence = \"Apache-2.0\"", "licence = \"other\""), plain);
        assert_ne!(digest("gem_p = 3.0", "gem_p = 4.0"), plain);
        assert_ne!(digest("width = 320", "width = 640"), plain);
        assert_ne!(parse(XFEAT).unwrap().digest(&[Digest::of(b"others")]), plain);
    }

    #[test]
    fn an_unknown_key_is_refused() {
        assert!(parse(&format!("colour = 1\n{XFEAT}")).is_err());
    }
}
