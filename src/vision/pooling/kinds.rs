//! The kinds of descriptors of a loaded model.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use whereabouts_core::{Descriptor, DescriptorKind};

use super::vlad::Vocabulary;
use super::{LocalFeatures, PoolingError};
use crate::manifest::{Manifest, Method, Pooling};

/// Computes each kind of descriptor that a model has.
#[derive(Debug)]
pub struct Kinds {
    aggregations: BTreeMap<DescriptorKind, Aggregation>,
}

/// Which descriptor to compute.
#[derive(Debug, Clone)]
pub struct DescriptorSpec {
    /// Its kind.
    pub kind: DescriptorKind,
    /// A map's own vocabulary, in place of the model's.
    pub vocabulary: Option<Arc<Vocabulary>>,
}

impl From<DescriptorKind> for DescriptorSpec {
    fn from(kind: DescriptorKind) -> Self {
        Self { kind, vocabulary: None }
    }
}

/// How local features become one kind of descriptor.
#[derive(Debug)]
enum Aggregation {
    /// The `[CLS]` token.
    Cls,
    /// Signed generalised mean over each part of a grid.
    Gem(Pooling),
    /// Sums of residuals to the centres of a vocabulary.
    Vlad(Arc<Vocabulary>),
}

/// A file that a kind of descriptor needs cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("the vocabulary {path} cannot be used: {reason}; install the model again")]
pub struct VocabularyError {
    path: String,
    reason: String,
}

impl Kinds {
    /// Prepares the kinds that a manifest declares, with the files in its folder.
    pub fn load(manifest: &Manifest, folder: &Path) -> Result<Self, VocabularyError> {
        let kinds = manifest.kinds().into_iter();
        let aggregations = kinds.map(|kind| {
            let aggregation = match manifest.descriptors.get(&kind) {
                Some(Method::Gem(pooling)) => Aggregation::Gem(pooling.clone()),
                Some(Method::Vlad(vlad)) => {
                    let path = folder.join(&vlad.file);
                    let read = Vocabulary::read(&path, vlad, manifest.output.channels);
                    let path = path.display().to_string();
                    let read = read.map_err(|reason| VocabularyError { path, reason })?;
                    Aggregation::Vlad(Arc::new(read))
                }
                None if kind == DescriptorKind::CLS => Aggregation::Cls,
                None => Aggregation::Gem(manifest.pooling.clone()),
            };
            Ok((kind, aggregation))
        });
        Ok(Self { aggregations: aggregations.collect::<Result<_, _>>()? })
    }

    /// The kinds, by name.
    pub fn names(&self) -> impl Iterator<Item = DescriptorKind> {
        self.aggregations.keys().copied()
    }

    /// The vocabulary of a kind, if it has one.
    pub fn vocabulary(&self, kind: DescriptorKind) -> Option<&Arc<Vocabulary>> {
        match self.aggregations.get(&kind) {
            Some(Aggregation::Vlad(vocabulary)) => Some(vocabulary),
            _ => None,
        }
    }

    /// Computes the descriptor that is asked for.
    pub fn descriptor(
        &self,
        spec: &DescriptorSpec,
        features: &LocalFeatures,
    ) -> Result<Descriptor, PoolingError> {
        let kind = spec.kind;
        if let Some(own) = &spec.vocabulary {
            return Ok(Descriptor::normalised(own.aggregate(features))?);
        }
        let numbers = match self.aggregations.get(&kind) {
            Some(Aggregation::Cls) => features.cls.clone(),
            Some(Aggregation::Gem(pooling)) => Some(features.gem(pooling)),
            Some(Aggregation::Vlad(vocabulary)) => Some(vocabulary.aggregate(features)),
            None => None,
        };
        let missing = || {
            let declared = self.names().map(|kind| kind.to_string()).collect::<Vec<_>>();
            PoolingError::NoKind { kind, declared: declared.join(", ") }
        };
        Ok(Descriptor::normalised(numbers.ok_or_else(missing)?)?)
    }
}
