//! Checks maps: every image has its descriptor, and derived files are valid.

use std::collections::HashMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde::Serialize;

use super::super::live_map::folder_of;
use super::super::orphans::remove_folder;
use super::super::segments::VectorFiles;
use super::super::trees::{BlobOwner, StoredImage, blob_ref_key, decode, failed};
use super::{Doctor, list};
use crate::StoreError;
use whereabouts_core::{ImageId, Map, Precision};
use whereabouts_index::SealedGraph;

/// A map and its size on disk.
#[derive(Debug, Clone, Serialize)]
pub struct MapReport {
    /// The name of the map.
    pub name: String,
    /// The model of its descriptors.
    pub model: String,
    /// The precision of the model.
    pub precision: Precision,
    /// Dimensions of a descriptor.
    pub dim: usize,
    /// Number of images.
    pub images: usize,
    /// Bytes of the descriptors.
    pub descriptor_bytes: u64,
    /// Bytes of the graph.
    pub graph_bytes: u64,
    /// Bytes of the pictures. A picture that several images or maps share counts for each.
    pub picture_bytes: u64,
}

impl Doctor<'_> {
    pub(super) fn maps(&mut self) -> Result<(), StoreError> {
        let descriptors = self.dir.join("descriptors");
        let (mut folders, mut uids) = (Vec::new(), Vec::new());
        for value in self.trees.maps.iter().values() {
            let map: Map = match decode(&value.map_err(failed)?) {
                Ok(map) => map,
                Err(error) => {
                    self.report.problem(
                        format!("the record of a map cannot be read: {error}"),
                        "restore a backup into a new folder",
                    );
                    continue;
                }
            };
            uids.push(map.uid);
            folders.push(folder_of(&map, &descriptors));
            self.map(&map, &folder_of(&map, &descriptors))?;
        }
        let found = fs::read_dir(&descriptors).into_iter().flatten().flatten();
        let orphans: Vec<_> =
            found.map(|entry| entry.path()).filter(|path| !folders.contains(path)).collect();
        if !orphans.is_empty() {
            if self.options.repair {
                orphans.iter().for_each(|orphan| remove_folder(orphan));
            }
            self.report.found(
                false,
                format!("{} folders in descriptors/ belong to no map", orphans.len()),
                "--repair or the next start of the server removes them",
                self.options.repair,
            );
        }
        let mut orphaned_images = 0;
        for key in self.trees.images.iter().keys() {
            let key = key.map_err(failed)?;
            orphaned_images += usize::from(!uids.iter().any(|uid| key.starts_with(uid.as_bytes())));
        }
        if orphaned_images > 0 {
            self.report.note(
                format!("{orphaned_images} images belong to deleted maps"),
                "the next start of the server removes them",
            );
        }
        Ok(())
    }

    fn map(&mut self, map: &Map, folder: &Path) -> Result<(), StoreError> {
        let (name, lost_advice) = (&map.name, "restore a backup into a new folder");
        let vectors = match folder.is_dir().then(|| VectorFiles::open(folder.to_owned(), map.dim)) {
            Some(Ok(vectors)) => Some(vectors),
            Some(Err(error)) => {
                self.report.problem(
                    format!("the descriptors of {name} cannot be read: {error}"),
                    lost_advice,
                );
                None
            }
            None => None,
        };
        if let Some(own) = map.vocabulary {
            let owner = BlobOwner::Vocabulary(map.uid);
            self.required.references.insert(blob_ref_key(&own.digest, &owner));
            self.required.vocabularies.insert(own.digest, name.to_string());
        }
        let (mut images, mut end, mut picture_bytes) = (0, 0, 0);
        let (mut damaged, mut sharing) = (Vec::new(), Vec::new());
        let mut slots: HashMap<usize, ImageId> = HashMap::new();
        for stored in self.trees.images_of(map.uid) {
            let StoredImage { image, slot, .. } = match stored {
                Ok(stored) => stored,
                Err(error) => {
                    self.report.problem(
                        format!("the record of an image of {name} cannot be read: {error}"),
                        lost_advice,
                    );
                    continue;
                }
            };
            images += 1;
            end = end.max(slot + 1);
            if let Some(other) = slots.insert(slot, image.id.clone()) {
                sharing.push(other);
            }
            if vectors.as_ref().is_none_or(|vectors| !vectors.is_intact(slot)) {
                damaged.push(image.id.clone());
            }
            let owner = BlobOwner::Image { map_uid: map.uid, id: &image.id };
            self.required.references.insert(blob_ref_key(&image.digest, &owner));
            let picture = self.picture(&image.digest);
            picture_bytes += fs::metadata(picture).map_or(0, |found| found.blocks() * 512);
            self.required.images.insert(image.digest, (name.to_string(), image.id));
        }
        if !damaged.is_empty() {
            self.report.problem(
                format!(
                    "the descriptors of {} images of {name} are missing or damaged, so searches do not \
                     find them: {}",
                    damaged.len(),
                    list(&damaged)
                ),
                format!(
                    "start the server and run `whereabouts index --reindex --map {name}`: it computes \
                     all descriptors again from the pictures"
                ),
            );
        }
        if !sharing.is_empty() {
            self.report.problem(
                format!("images of {name} share a descriptor with others: {}", list(&sharing)),
                format!("start the server and run `whereabouts index --reindex --map {name}`"),
            );
        }
        self.graph(map, folder);
        let bytes = |suffix: &str| {
            let files = fs::read_dir(folder).into_iter().flatten().flatten();
            let files = files.filter(|entry| entry.file_name().to_string_lossy().ends_with(suffix));
            files.filter_map(|entry| entry.metadata().ok()).map(|found| found.blocks() * 512).sum()
        };
        self.report.maps.push(MapReport {
            name: name.to_string(),
            model: map.model.clone(),
            precision: map.precision,
            dim: map.dim,
            images,
            descriptor_bytes: bytes(".seg"),
            graph_bytes: bytes("graph"),
            picture_bytes,
        });
        Ok(())
    }

    fn graph(&mut self, map: &Map, folder: &Path) {
        let file = folder.join("graph");
        let Ok(bytes) = fs::read(&file) else { return };
        let sound = |graph: SealedGraph| graph.dim() == map.dim && graph.unreachable() == 0;
        if SealedGraph::from_bytes(&bytes).is_ok_and(sound) {
            return;
        }
        let repaired = self.options.repair && fs::remove_file(&file).is_ok();
        self.report.found(
            false,
            format!("the graph of {} is damaged; it is derived data, so nothing is lost", map.name),
            "the server rebuilds it and searches exactly until then; --repair removes it",
            repaired,
        );
    }
}
