//! The kinds of descriptors that a manifest declares.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Input, Manifest, Output, Pooling};
use crate::pooling::OWN_BLOCK;
use whereabouts_core::{DescriptorKind, Digest};

/// How local features are aggregated to a kind of descriptor that the manifest declares by name.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "method", rename_all = "lowercase")]
pub enum Method {
    /// Signed generalised mean over each part of a grid.
    Gem(Pooling),
    /// Sums of residuals to the centres of a vocabulary, within horizontal bands.
    Vlad(Vlad),
}

/// How local features are aggregated to VLAD.
///
/// Each cell is L2-normalised. A centre's sum is that of (cell − centre), weighted by the cell's weight and by the
/// share of the cell that is assigned to the centre. Each sum is L2-normalised, shortened by a matrix of its own if
/// `block` is set, and all of them together are projected if `dimension` is smaller.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vlad {
    /// File of the vocabulary, next to the manifest: 16-bit floats in little-endian order; first the centres
    /// (`centres × channels`), then for each band and centre `channels × block` numbers, then the projection
    /// (`rows · centres · block × dimension`).
    pub file: PathBuf,
    /// Pinned digest of the file, if any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<Digest>,
    /// Number of centres.
    pub centres: usize,
    /// Horizontal bands of equal height that are aggregated separately; 1 for the whole picture.
    pub rows: usize,
    /// Sharpness of the soft assignment: centres share a cell in proportion to exp(sharpness × cosine). If omitted, a
    /// cell is assigned to the nearest centre.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sharpness: Option<f32>,
    /// Centres whose share would be smaller than this, relative to that of the nearest, get none.
    #[serde(default = "default_least_share")]
    pub least_share: f32,
    /// How much each cell counts.
    pub weighting: Weighting,
    /// Numbers to which each residual sum is shortened; if omitted, it keeps all channels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub block: Option<usize>,
    /// Dimension of the descriptor.
    pub dimension: usize,
}

fn default_least_share() -> f32 {
    0.05
}

/// How much each cell counts in VLAD.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Weighting {
    /// All alike.
    None,
    /// In proportion to the model's reliability map.
    Reliability,
}

impl Vlad {
    /// Numbers before the projection.
    pub(crate) fn expanded(&self, channels: usize) -> usize {
        self.rows * self.centres * self.block.unwrap_or(channels)
    }

    /// The settings of a map's own vocabulary: the model's, with residual sums shortened to `block` numbers. `None` if
    /// these would be fewer than the descriptor has.
    pub(crate) fn own(&self, block: usize, channels: usize) -> Option<Self> {
        let block = Some(block.min(channels));
        let own = Self { file: PathBuf::new(), sha256: None, block, ..self.clone() };
        (own.expanded(channels) > own.dimension).then_some(own)
    }

    fn fault(&self, name: &str, output: &Output) -> Option<String> {
        const MAX_CENTRES: usize = 4096;
        const MAX_ROWS: usize = 64;
        // 256 MiB in memory.
        const MAX_NUMBERS: usize = 1 << 26;
        let Self { centres, rows, block, dimension, sharpness, least_share, .. } = *self;
        if !(1..=MAX_CENTRES).contains(&centres) || !(1..=MAX_ROWS).contains(&rows) {
            return Some(format!(
                "{name} must have 1 to {MAX_CENTRES} centres and 1 to {MAX_ROWS} rows"
            ));
        }
        if block.is_some_and(|block| !(1..=output.channels).contains(&block)) {
            return Some(format!(
                "{name}.block must be 1 to output.channels = {}",
                output.channels
            ));
        }
        let expanded = self.expanded(output.channels);
        if !(1..=expanded).contains(&dimension) {
            return Some(format!(
                "{name}.dimension is {dimension}, but must be 1 to rows × centres × block (or channels) = {expanded}"
            ));
        }
        let blocks = rows * centres * output.channels * block.unwrap_or(0);
        if blocks.max(expanded.saturating_mul(dimension)) > MAX_NUMBERS && dimension != expanded {
            return Some(format!("{name} needs matrices of more than {MAX_NUMBERS} numbers"));
        }
        if sharpness.is_some_and(|sharpness| !(sharpness > 0.0 && sharpness.is_finite())) {
            return Some(format!("{name}.sharpness must be above 0; omit it for hard assignment"));
        }
        if !(least_share > 0.0 && least_share <= 1.0) {
            return Some(format!("{name}.least_share must be above 0 and at most 1"));
        }
        if self.weighting == Weighting::Reliability && output.reliability.is_none() {
            return Some(format!("{name}.weighting = \"reliability\" needs output.reliability"));
        }
        None
    }
}

impl Method {
    /// Dimension of the descriptor.
    pub fn dimension(&self) -> usize {
        match self {
            Self::Gem(pooling) => pooling.dimension,
            Self::Vlad(vlad) => vlad.dimension,
        }
    }

    fn fault(&self, name: &str, output: &Output) -> Option<String> {
        match self {
            Self::Gem(pooling) => pooling.fault(name, output),
            Self::Vlad(vlad) => vlad.fault(name, output),
        }
    }

    /// The file that it needs besides those of the model, and its pinned digest.
    pub(super) fn file(&self) -> Option<(&Path, Option<Digest>)> {
        match self {
            Self::Gem(_) => None,
            Self::Vlad(vlad) => Some((&vlad.file, vlad.sha256)),
        }
    }

    pub(super) fn pin(&mut self, digest: Digest) {
        match self {
            Self::Gem(_) => {}
            Self::Vlad(vlad) => vlad.sha256 = Some(digest),
        }
    }

    /// The method without what a digest of it must not depend on.
    fn unpinned(&self) -> Self {
        match self {
            Self::Gem(pooling) => Self::Gem(pooling.clone()),
            Self::Vlad(vlad) => {
                Self::Vlad(Vlad { sha256: None, file: PathBuf::new(), ..vlad.clone() })
            }
        }
    }
}

/// Digest of everything that determines a descriptor with a map's own vocabulary, of which `vocabulary` is the digest.
pub(crate) fn own_digest(base: Digest, vocabulary: Digest) -> Digest {
    Digest::of(format!("own vocabulary\n{base}\n{vocabulary}").as_bytes())
}

/// The parts of a manifest that determine the descriptors `gem` and `cls`.
#[derive(Serialize)]
struct PooledInputs<'a> {
    input: &'a Input,
    output: &'a Output,
    pooling: &'a Pooling,
}

/// The parts of a manifest that determine a descriptor declared by name.
#[derive(Serialize)]
struct DeclaredInputs<'a> {
    input: &'a Input,
    output: &'a Output,
    descriptor: &'a Method,
}

impl Manifest {
    /// The kinds of descriptors that the model has.
    pub fn kinds(&self) -> Vec<DescriptorKind> {
        let cls = self.output.cls.then_some(DescriptorKind::CLS);
        let declared = self.descriptors.keys().copied();
        [DescriptorKind::GEM].into_iter().chain(cls).chain(declared).collect()
    }

    /// The kind of descriptor of a new map, if none is requested.
    pub fn default_kind(&self) -> DescriptorKind {
        self.default_descriptor.unwrap_or(DescriptorKind::GEM)
    }

    /// Dimension of a descriptor of the given kind; `None` if the model does not have that kind.
    pub fn dimension(&self, kind: DescriptorKind) -> Option<usize> {
        match kind {
            DescriptorKind::GEM => Some(self.pooling.dimension),
            DescriptorKind::CLS => self.output.cls.then_some(self.output.channels),
            declared => self.descriptors.get(&declared).map(Method::dimension),
        }
    }

    /// Digest of everything that determines a descriptor of the given kind: the weights, the input, the output, and how
    /// it is pooled. `files` are the digests of the model's files in the order of [`files`](Self::files). Descriptive
    /// fields and other kinds are not included, so a manifest that declares another kind leaves existing maps as they
    /// are.
    pub fn digest(&self, files: &[Digest], kind: DescriptorKind) -> Digest {
        let Self { input, output, pooling, .. } = self;
        let weights = files.iter().take(1 + self.data.len());
        // Serialization cannot fail: the structs contain only numbers, strings and lists of these.
        let (vocabulary, text) = match self.descriptors.get(&kind) {
            None => (None, toml::to_string(&PooledInputs { input, output, pooling })),
            Some(method) => {
                let own = method.file().map(|(file, _)| file);
                let mut named = self.files().zip(files);
                let vocabulary = own.and_then(|own| named.find(|((file, _), _)| *file == own));
                let descriptor = &method.unpinned();
                let text = toml::to_string(&DeclaredInputs { input, output, descriptor });
                (vocabulary.map(|(_, digest)| digest), text)
            }
        };
        let files = weights.chain(vocabulary).map(Digest::to_string).collect::<Vec<_>>().join("\n");
        Digest::of(format!("{files}\n{}", text.unwrap_or_default()).as_bytes())
    }

    /// The pinned digest of the vocabulary of a kind, if it is pinned; `None` if the kind has no vocabulary.
    pub fn vocabulary(&self, kind: DescriptorKind) -> Option<Option<Digest>> {
        self.descriptors.get(&kind)?.file().map(|(_, pinned)| pinned)
    }

    /// Whether a map can have a vocabulary of its own for this kind of descriptor.
    pub fn may_have_own(&self, kind: DescriptorKind) -> bool {
        match self.descriptors.get(&kind) {
            Some(Method::Vlad(vlad)) => vlad.own(OWN_BLOCK, self.output.channels).is_some(),
            _ => false,
        }
    }

    /// What [`own_digest`] needs of a model: the digest of the weights, the input, the output, and how a map's own
    /// vocabulary is used. `None` if the kind cannot have one.
    pub(crate) fn own_base(&self, files: &[Digest], kind: DescriptorKind) -> Option<Digest> {
        let Self { input, output, .. } = self;
        let Some(Method::Vlad(vlad)) = self.descriptors.get(&kind) else { return None };
        let descriptor = &Method::Vlad(vlad.own(OWN_BLOCK, output.channels)?);
        let text = toml::to_string(&DeclaredInputs { input, output, descriptor }).ok()?;
        let weights = files.iter().take(1 + self.data.len());
        let files = weights.map(Digest::to_string).collect::<Vec<_>>().join("\n");
        Some(Digest::of(format!("{files}\n{text}").as_bytes()))
    }

    /// Which kinds contradict the rest, and how.
    pub(super) fn kinds_fault(&self) -> Option<String> {
        if let Some(detail) = self.pooling.fault("pooling", &self.output) {
            return Some(detail);
        }
        for built_in in [DescriptorKind::GEM, DescriptorKind::CLS] {
            if self.descriptors.contains_key(&built_in) {
                return Some(format!(
                    "descriptors.{built_in} is declared by [pooling] and output.cls; give it another name"
                ));
            }
        }
        let default = self.default_kind();
        if !self.kinds().contains(&default) {
            return Some(format!("default_descriptor = {default:?} is not declared"));
        }
        let mut declared = self.descriptors.iter();
        declared
            .find_map(|(kind, method)| method.fault(&format!("descriptors.{kind}"), &self.output))
    }
}

impl Pooling {
    fn fault(&self, name: &str, output: &Output) -> Option<String> {
        let [rows, columns] = self.grid;
        if rows == 0 || columns == 0 || rows.saturating_mul(columns) > 1024 {
            return Some(format!("{name}.grid must have 1 to 1024 parts"));
        }
        let expected = output.channels * rows * columns;
        if self.dimension != expected {
            return Some(format!(
                "{name}.dimension is {}, but channels × rows × columns is {expected}",
                self.dimension
            ));
        }
        let is_usable = self.gem_p > 0.0 && self.gem_p.is_finite();
        (!is_usable).then(|| format!("{name}.gem_p must be above 0"))
    }
}
