//! An installed model whose files are what its manifest says.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use super::execution::Provider;
use super::extractor::ExtractError;
use super::manifest::{Manifest, file_digest};
use super::pooling::Kinds;
use super::runtime::Assets;
use super::session::Model;
use whereabouts_core::{DescriptorKind, Digest};

/// A model whose files match the digests pinned in its manifest.
#[derive(Debug)]
pub(super) struct VerifiedModel {
    pub model: Model,
    /// For each kind that can have an own vocabulary, what the digest of its descriptors depends on besides.
    pub own_bases: BTreeMap<DescriptorKind, Digest>,
    /// The digest of each kind of descriptor.
    pub digests: BTreeMap<DescriptorKind, Digest>,
}

impl VerifiedModel {
    pub fn open(
        assets: &Assets,
        name: &str,
        provider: Option<Provider>,
    ) -> Result<Self, ExtractError> {
        let environment = assets.load_onnxruntime(provider)?;
        let folder = assets.model(name)?;
        let manifest = Arc::new(assets.manifest(&folder)?);
        let file = folder.join(&manifest.file);
        let files = verified_digests(&folder, &manifest)?;
        let kinds = Arc::new(Kinds::load(&manifest, &folder)?);
        let own_bases = manifest.kinds().into_iter();
        let own_bases =
            own_bases.filter_map(|kind| Some((kind, manifest.own_base(&files, kind)?))).collect();
        let digests =
            manifest.kinds().into_iter().map(|kind| (kind, manifest.digest(&files, kind)));
        let digests = digests.collect();
        Ok(Self { model: Model { environment, file, manifest, kinds }, own_bases, digests })
    }
}

/// Hashes a model's files and checks the digests against those pinned in the manifest.
fn verified_digests(folder: &Path, manifest: &Manifest) -> Result<Vec<Digest>, ExtractError> {
    let digests = manifest.files().map(|(file, pinned)| {
        let file = folder.join(file);
        let (digest, _) = file_digest(&file).map_err(|error| {
            ExtractError::ModelFile(format!(
                "cannot read {}: {error}; `make build` puts the built-in model in place",
                file.display()
            ))
        })?;
        match pinned {
            Some(pinned) if pinned != digest => Err(ExtractError::ModelFile(format!(
                "{} has the digest {digest}, but its manifest pins {pinned}; `whereabouts model verify` \
                 explains how to repair it",
                file.display()
            ))),
            _ => Ok(digest),
        }
    });
    digests.collect()
}
