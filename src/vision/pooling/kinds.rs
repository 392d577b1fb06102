//! The kinds of descriptors of a loaded model.

use std::collections::BTreeMap;

use whereabouts_core::{Descriptor, DescriptorKind};

use super::{LocalFeatures, PoolingError};
use crate::manifest::{Manifest, Method, Pooling};

/// Computes each kind of descriptor that a model has.
#[derive(Debug)]
pub struct Kinds {
    aggregations: BTreeMap<DescriptorKind, Aggregation>,
}

/// How local features become one kind of descriptor.
#[derive(Debug)]
enum Aggregation {
    /// The `[CLS]` token.
    Cls,
    /// Signed generalised mean over each part of a grid.
    Gem(Pooling),
}

impl Kinds {
    /// Prepares the kinds that a manifest declares.
    pub fn of(manifest: &Manifest) -> Self {
        let kinds = manifest.kinds().into_iter();
        let aggregations = kinds.map(|kind| {
            let aggregation = match manifest.descriptors.get(&kind) {
                Some(Method::Gem(pooling)) => Aggregation::Gem(pooling.clone()),
                None if kind == DescriptorKind::CLS => Aggregation::Cls,
                None => Aggregation::Gem(manifest.pooling.clone()),
            };
            (kind, aggregation)
        });
        Self { aggregations: aggregations.collect() }
    }

    /// The kinds, by name.
    pub fn names(&self) -> impl Iterator<Item = DescriptorKind> {
        self.aggregations.keys().copied()
    }

    /// Computes the descriptor of the given kind.
    pub fn descriptor(
        &self,
        kind: DescriptorKind,
        features: &LocalFeatures,
    ) -> Result<Descriptor, PoolingError> {
        let numbers = match self.aggregations.get(&kind) {
            Some(Aggregation::Cls) => features.cls.clone(),
            Some(Aggregation::Gem(pooling)) => Some(features.gem(pooling)),
            None => None,
        };
        let missing = || {
            let declared = self.names().map(|kind| kind.to_string()).collect::<Vec<_>>();
            PoolingError::NoKind { kind, declared: declared.join(", ") }
        };
        Ok(Descriptor::normalised(numbers.ok_or_else(missing)?)?)
    }
}
