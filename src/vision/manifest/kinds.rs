//! The kinds of descriptors that a manifest declares.

use serde::{Deserialize, Serialize};

use super::{Input, Manifest, Output, Pooling};
use whereabouts_core::{DescriptorKind, Digest};

/// How local features are aggregated to a kind of descriptor that the manifest declares by name.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "method", rename_all = "lowercase")]
pub enum Method {
    /// Signed generalised mean over each part of a grid.
    Gem(Pooling),
}

impl Method {
    /// Dimension of the descriptor.
    pub fn dimension(&self) -> usize {
        match self {
            Self::Gem(pooling) => pooling.dimension,
        }
    }

    fn fault(&self, name: &str, output: &Output) -> Option<String> {
        match self {
            Self::Gem(pooling) => pooling.fault(name, output),
        }
    }
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

    /// Digest of everything that determines a descriptor of the given kind: the digests of the model's files in the
    /// order of [`files`](Self::files), the input, the output, and how it is pooled. Descriptive fields and other kinds
    /// are not included, so a manifest that declares another kind leaves existing maps as they are.
    pub fn digest(&self, files: &[Digest], kind: DescriptorKind) -> Digest {
        let Self { input, output, pooling, .. } = self;
        // Serialization cannot fail: the structs contain only numbers, strings and lists of these.
        let text = match self.descriptors.get(&kind) {
            None => toml::to_string(&PooledInputs { input, output, pooling }),
            Some(descriptor) => toml::to_string(&DeclaredInputs { input, output, descriptor }),
        };
        let files = files.iter().map(Digest::to_string).collect::<Vec<_>>().join("\n");
        Digest::of(format!("{files}\n{}", text.unwrap_or_default()).as_bytes())
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
