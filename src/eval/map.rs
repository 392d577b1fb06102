//! Keeps the map of the references in the work folder identical to the folder of references.

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
    /// Digest over the names and bytes of all references.
    pub digest: Digest,
}

impl Evaluator<'_> {
    /// Creates or updates the map: adds missing images, replaces changed ones, deletes those that are gone from the
    /// folder, and waits until the index is up to date.
    pub(super) async fn reference_map(
        &self,
        references: &[PictureFile],
        descriptor: DescriptorKind,
    ) -> anyhow::Result<ReferenceMap> {
        let service = self.service.as_ref();
        // One map per model and execution: descriptors of different models are not comparable.
        let extractor = service
            .maps
            .imaging
            .installed_model(service.maps.imaging.models.default_model())
            .await?;
        let digest = extractor.digest(descriptor).with_context(|| {
            let kinds = extractor.manifest().kinds();
            format!("the model has no descriptor {descriptor:?}; it has {kinds:?}")
        })?;
        let settings = service.maps.vocabulary;
        let own = match settings.own && extractor.manifest().may_have_own(descriptor) {
            true => format!("\n{} to {}", settings.min_images, settings.max_images),
            false => String::new(),
        };
        let identity = format!("{digest}\n{}{own}", extractor.execution());
        let name = format!("{descriptor}-{}", &Digest::of(identity.as_bytes()).hex()[..12]);
        let name: MapName = name.parse()?;
        let change = MapChange {
            scene: Some(self.settings.scene),
            descriptor: Some(descriptor),
            ..MapChange::default()
        };
        service.maps.put(name.clone(), change).await?;

        let stored = stored_images(service, &name).await?;
        self.observer.begin("references", references.len());
        let mut added = futures_util::stream::iter(references)
            .map(|picture| {
                let (name, previous) = (&name, stored.get(&picture.id).copied());
                async move {
                    let digest = self.add(name, picture, previous).await?;
                    Ok::<_, anyhow::Error>((picture, digest))
                }
            })
            .buffered(self.settings.concurrency);
        let mut listing = String::new();
        let mut present = HashSet::with_capacity(references.len());
        while let Some((picture, digest)) = added.try_next().await? {
            listing.push_str(&format!("{} {digest}\n", picture.id));
            present.insert(&picture.id);
            self.observer.step();
        }
        drop(added);
        for gone in stored.keys().filter(|id| !present.contains(id)) {
            service.images.delete(&name, gone).await?;
        }
        wait_for_index(service, &name).await?;
        self.observer.finish();
        let listed = Digest::of(listing.as_bytes());
        if !own.is_empty() {
            self.fit_vocabulary(&name, listed).await?;
        }
        let map = service
            .maps
            .store
            .map(&name)
            .await?
            .context("the map of the references was deleted; run the same command again")?;
        Ok(ReferenceMap { map, digest: listed })
    }

    /// Gives the map the vocabulary that a server would, unless an earlier run has done so for these references.
    async fn fit_vocabulary(&self, map: &MapName, references: Digest) -> anyhow::Result<()> {
        let mark = self.settings.work_dir.join(format!("vocabulary-{map}"));
        let listed = references.to_string();
        if std::fs::read_to_string(&mark).is_ok_and(|fitted| fitted == listed) {
            return Ok(());
        }
        self.observer.begin("vocabulary", 1);
        self.service.fitter.fit_again(map).await?;
        wait_for_index(&self.service, map).await?;
        self.observer.step();
        self.observer.finish();
        std::fs::write(&mark, listed).with_context(|| format!("cannot write {}", mark.display()))
    }

    async fn add(
        &self,
        map: &MapName,
        picture: &PictureFile,
        previous: Option<Digest>,
    ) -> anyhow::Result<Digest> {
        let file = || picture.file.display().to_string();
        let bytes: Bytes = tokio::fs::read(&picture.file).await.with_context(file)?.into();
        let digest = Digest::of(&bytes);
        match previous {
            Some(previous) if previous == digest => return Ok(digest),
            Some(_) => self.service.images.delete(map, &picture.id).await?,
            None => {}
        }
        let meta = ImageMeta { id: Some(picture.id.to_string()), ..ImageMeta::default() };
        self.service
            .images
            .add(map, NewImage { bytes, meta, demand: AdmissionRequest::BACKGROUND })
            .await
            .with_context(|| {
                format!(
                    "cannot add the reference {}; repair it or remove it from the folder",
                    file()
                )
            })?;
        Ok(digest)
    }
}

async fn stored_images(
    service: &Service,
    map: &MapName,
) -> anyhow::Result<HashMap<ImageId, Digest>> {
    const PAGE: usize = 1000;
    let mut stored = HashMap::new();
    let mut cursor: Option<ImageId> = None;
    loop {
        let page = service.images.list(map, cursor.as_ref(), Some(PAGE)).await?;
        stored.extend(page.images.into_iter().map(|image| (image.id, image.digest)));
        match page.next_cursor {
            Some(next) => cursor = Some(next.parse()?),
            None => return Ok(stored),
        }
    }
}

async fn wait_for_index(service: &Service, map: &MapName) -> anyhow::Result<()> {
    while service.maps.get(map).await?.index == IndexKind::Building {
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    Ok(())
}
