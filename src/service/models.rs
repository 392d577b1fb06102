//! The model that a map needs, and errors that tell the caller what to do if it cannot be used.

use std::sync::Arc;

use whereabouts_api::ErrorKind;
use whereabouts_core::{DescriptorKind, Digest, Map, MapName};
use whereabouts_vision::{DescriptorSpec, Extractor, Manifest, ModelError};

use super::{Maps, ServiceError};

impl Maps {
    /// Returns a map with the model that made its descriptors, and how it made them; a conflict if that model is not
    /// installed, or only another version or precision of it.
    pub(crate) async fn usable(
        &self,
        name: &MapName,
    ) -> Result<(Map, Arc<Extractor>, DescriptorSpec), ServiceError> {
        loop {
            let (map, extractor) = self.with_model(name).await?;
            match self.imaging.vocabularies.spec_of(&map, &extractor).await {
                Ok(spec) => return Ok((map, extractor, spec)),
                // Perhaps it was replaced since the map was read.
                Err(error) if self.find(name).await?.model_digest == map.model_digest => {
                    return Err(error);
                }
                Err(_) => {}
            }
        }
    }

    async fn with_model(&self, name: &MapName) -> Result<(Map, Arc<Extractor>), ServiceError> {
        let map = self.find(name).await?;
        let extractor = self.imaging.models.of(&map).await.map_err(|error| match error {
            ModelError::NotInstalled(_) => ServiceError::new(
                ErrorKind::Conflict,
                format!(
                    "the map {name} needs the model {:?}, which is not installed on the server; \
                     install it there ({}), or reindex the map with another model ({})",
                    map.model,
                    how_to_install(&map.model),
                    how_to_reindex(name, "NAME"),
                ),
            ),
            error => unusable(&map.model, error),
        })?;
        match mismatch(&map, &extractor) {
            Some(detail) => Err(ServiceError::new(ErrorKind::Conflict, detail)),
            None => Ok((map, extractor)),
        }
    }
}

/// The kind of a map's descriptors: the requested one, otherwise the one that the map has, otherwise the model's
/// default. An error if the model does not have the requested kind.
pub(super) fn kind_of(
    manifest: &Manifest,
    requested: Option<DescriptorKind>,
    current: Option<DescriptorKind>,
) -> Result<DescriptorKind, ServiceError> {
    let declared = manifest.kinds();
    match requested {
        Some(kind) if !declared.contains(&kind) => {
            let (name, declared) = (&manifest.name, names(&declared));
            Err(ServiceError::unprocessable(format!(
                "the model {name:?} has no descriptor {:?}; it has {declared}",
                kind.as_str()
            )))
        }
        Some(kind) => Ok(kind),
        None => {
            let current = current.filter(|kind| declared.contains(kind));
            Ok(current.unwrap_or(manifest.default_kind()))
        }
    }
}

/// The digest and the dimension of a kind of descriptor that the model has.
pub(super) fn descriptor_of(
    extractor: &Extractor,
    kind: DescriptorKind,
) -> Result<(Digest, usize), ServiceError> {
    let manifest = extractor.manifest();
    match (extractor.digest(kind), manifest.dimension(kind)) {
        (Some(digest), Some(dimension)) => Ok((digest, dimension)),
        _ => Err(ServiceError::new(
            ErrorKind::Conflict,
            format!(
                "the model {:?} was replaced by one without the descriptor {:?}; try again",
                manifest.name,
                kind.as_str()
            ),
        )),
    }
}

fn names(kinds: &[DescriptorKind]) -> String {
    kinds.iter().map(DescriptorKind::as_str).collect::<Vec<_>>().join(", ")
}

/// Explains why the loaded model cannot serve the map; `None` if it can.
fn mismatch(map: &Map, extractor: &Extractor) -> Option<String> {
    if extractor.is_of(map) {
        return None;
    }
    let (name, model, reindex) = (&map.name, &map.model, how_to_reindex(&map.name, &map.model));
    let precision = extractor.execution().precision;
    let Some(digest) = extractor.digest_of(map) else {
        return Some(format!(
            "the map {name} was indexed with the descriptor {:?}, which the model {model:?} that is installed does \
             not have; install the former again, or reindex the map with one of {}: {reindex} --descriptor KIND",
            map.descriptor.as_str(),
            names(&extractor.manifest().kinds())
        ));
    };
    Some(if digest != map.model_digest {
        format!(
            "the map {name} was indexed with the model {model:?} of {}, but the one installed, which takes {}, is \
             {digest}; install the former again (or undo a change of its manifest or of model.sizes), or reindex the \
             map: {reindex}",
            map.model_digest,
            extractor.manifest().input
        )
    } else {
        format!(
            "the map {name} was indexed at {} precision, but the server runs the model at \
             {precision} precision; start it with model.precision = {:?}, or reindex the map: \
             {reindex}",
            map.precision,
            map.precision.as_str()
        )
    })
}

/// The error for a model that a caller named and that cannot be used.
pub(super) fn unusable(name: &str, error: ModelError) -> ServiceError {
    match error {
        ModelError::NotInstalled(_) => ServiceError::unprocessable(format!(
            "the model {name:?} is not installed on the server; install it there ({}), or name one \
             that `whereabouts model list` shows there as installed",
            how_to_install(name)
        )),
        ModelError::Broken { .. } => ServiceError::new(
            ErrorKind::Unavailable,
            format!("{error}; `whereabouts model verify {name}` on the server checks it"),
        ),
        ModelError::AllInUse(_) => ServiceError::new(
            ErrorKind::Overloaded,
            format!("{error}; try again in a moment, or raise model.loaded"),
        ),
    }
}

fn how_to_install(model: &str) -> String {
    format!("`whereabouts model pull {model}`, or `whereabouts model add` from a file")
}

fn how_to_reindex(map: &MapName, model: &str) -> String {
    format!("`whereabouts index --reindex --map {map} --model {model}`")
}
