//! The map of the references, in the work folder: made to hold exactly the pictures of the folder.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use anyhow::Context;
use bytes::Bytes;
use futures_util::{StreamExt, TryStreamExt};

use super::{Evaluator, PictureFile};
use whereabouts_api::{ImageMeta, IndexKind, MapChange};
use whereabouts_core::{DescriptorKind, Digest, ImageId, Map, MapName};
use whereabouts_service::{NewImage, Service};
use whereabouts_vision::AdmissionRequest;

/// The map of the references.
pub(super) struct ReferenceMap {
    pub map: Map,
    /// Covers every reference, by name and bytes.
    pub digest: Digest,
}

impl Evaluator<'_> {
    /// Adds what is missing, replaces what has changed, removes what is gone, and waits until the
    /// index has caught up.
    pub(super) async fn reference_map(
        &self,
        references: &[PictureFile],
        descriptor: DescriptorKind,
    ) -> anyhow::Result<ReferenceMap> {
        let service = self.service.as_ref();
        // A model of its own for each map: descriptors of different models do not mix.
        let extractor = service
            .maps
            .imaging
            .installed_model(service.maps.imaging.models.default_model())
            .await?;
        let of = format!("{}\n{}", extractor.digest(), extractor.execution());
        let name = format!("{descriptor}-{}", &Digest::of(of.as_bytes()).hex()[..12]);
        let name: MapName = name.parse()?;
        let change = MapChange {
            scene: Some(self.settings.scene),
            descriptor: Some(descriptor),
            ..MapChange::default()
        };
        service.maps.put(name.clone(), change).await?;

        let known = known_images(service, &name).await?;
        self.watch.begin("references", references.len());
        let mut added = futures_util::stream::iter(references)
            .map(|picture| {
                let (name, before) = (&name, known.get(&picture.id).copied());
                async move {
                    let digest = self.add(name, picture, before).await?;
                    Ok::<_, anyhow::Error>((picture, digest))
                }
            })
            .buffered(self.settings.side_by_side);
        let mut listing = String::new();
        let mut present = HashSet::with_capacity(references.len());
        while let Some((picture, digest)) = added.try_next().await? {
            listing.push_str(&format!("{} {digest}\n", picture.id));
            present.insert(&picture.id);
            self.watch.step();
        }
        drop(added);
        for gone in known.keys().filter(|id| !present.contains(id)) {
            service.images.delete(&name, gone).await?;
        }
        wait_for_index(service, &name).await?;
        self.watch.end();
        let map =
            service.maps.store.map(&name).await?.context("the map of the references is gone")?;
        Ok(ReferenceMap { map, digest: Digest::of(listing.as_bytes()) })
    }

    async fn add(
        &self,
        map: &MapName,
        picture: &PictureFile,
        before: Option<Digest>,
    ) -> anyhow::Result<Digest> {
        let named = || picture.file.display().to_string();
        let bytes: Bytes = tokio::fs::read(&picture.file).await.with_context(named)?.into();
        let digest = Digest::of(&bytes);
        match before {
            Some(before) if before == digest => return Ok(digest),
            Some(_) => self.service.images.delete(map, &picture.id).await?,
            None => {}
        }
        let meta = ImageMeta { id: Some(picture.id.to_string()), ..ImageMeta::default() };
        self.service
            .images
            .add(map, NewImage { bytes, meta, demand: AdmissionRequest::BACKGROUND })
            .await
            .with_context(|| {
                format!("{} cannot be a reference; repair it or take it out of the folder", named())
            })?;
        Ok(digest)
    }
}

async fn known_images(
    service: &Service,
    map: &MapName,
) -> anyhow::Result<HashMap<ImageId, Digest>> {
    const PAGE: usize = 1000;
    let mut known = HashMap::new();
    let mut cursor: Option<ImageId> = None;
    loop {
        let page = service.images.list(map, cursor.as_ref(), Some(PAGE)).await?;
        known.extend(page.images.into_iter().map(|image| (image.id, image.digest)));
        match page.next_cursor {
            Some(next) => cursor = Some(next.parse()?),
            None => return Ok(known),
        }
    }
}

async fn wait_for_index(service: &Service, map: &MapName) -> anyhow::Result<()> {
    while service.maps.get(map).await?.index == IndexKind::Building {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    Ok(())
}
