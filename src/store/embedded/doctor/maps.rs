//! Maps: every record has its descriptor, and what is derived fits.

use std::collections::HashMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde::Serialize;

use super::super::live_map::folder_of;
use super::super::maps::remove_folder;
use super::super::segments::VectorFiles;
use super::super::trees::{BlobOwner, StoredImage, blob_ref_key, decode, failed};
use super::{Doctor, some};
use crate::StoreError;
use whereabouts_core::{ImageId, Map, Precision};
use whereabouts_index::SealedGraph;

/// A map and the room it takes.
#[derive(Debug, Clone, Serialize)]
pub struct MapReport {
    /// Its name.
    pub name: String,
    /// The model of its descriptors.
    pub model: String,
    /// At which precision.
    pub precision: Precision,
    /// Numbers in a descriptor.
    pub dim: usize,
    /// Its images.
    pub images: usize,
    /// Bytes of its descriptors, of the graph over them, and of its pictures.
    pub descriptor_bytes: u64,
    /// See above.
    pub graph_bytes: u64,
    /// See above. Pictures that several images or maps share count for each.
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
                        format!("the record of a map is lost: {error}"),
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
            if self.how.repair {
                orphans.iter().for_each(|orphan| remove_folder(orphan));
            }
            self.report.found(
                false,
                format!("{} folders in descriptors/ are of no map", orphans.len()),
                "the next start of the server removes them, or --repair",
                self.how.repair,
            );
        }
        let mut lost = 0;
        for key in self.trees.images.iter().keys() {
            let key = key.map_err(failed)?;
            lost += usize::from(!uids.iter().any(|uid| key.starts_with(uid.as_bytes())));
        }
        if lost > 0 {
            self.report.note(
                format!("{lost} images are of maps that were deleted"),
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
        let (mut images, mut end, mut picture_bytes) = (0, 0, 0);
        let (mut damaged, mut twice) = (Vec::new(), Vec::new());
        let mut slots: HashMap<usize, ImageId> = HashMap::new();
        for stored in self.trees.images_of(map.uid) {
            let StoredImage { image, slot } = match stored {
                Ok(stored) => stored,
                Err(error) => {
                    self.report.problem(
                        format!("the record of an image of {name} is lost: {error}"),
                        lost_advice,
                    );
                    continue;
                }
            };
            images += 1;
            end = end.max(slot + 1);
            if let Some(other) = slots.insert(slot, image.id.clone()) {
                twice.push(other);
            }
            if vectors.as_ref().is_none_or(|vectors| !vectors.is_intact(slot)) {
                damaged.push(image.id.clone());
            }
            let owner = BlobOwner::Image { map_uid: map.uid, id: &image.id };
            self.needed.references.insert(blob_ref_key(&image.digest, &owner));
            let picture = self.picture(&image.digest);
            picture_bytes += fs::metadata(picture).map_or(0, |found| found.blocks() * 512);
            self.needed.images.insert(image.digest, (name.to_string(), image.id));
        }
        if !damaged.is_empty() {
            self.report.problem(
                format!(
                    "{} images of {name} have no descriptor as it was written, so that they are not \
                     found: {}",
                    damaged.len(),
                    some(&damaged)
                ),
                format!(
                    "start the server and run `whereabouts index --reindex --map {name}`: it makes \
                     all descriptors anew from the pictures"
                ),
            );
        }
        if !twice.is_empty() {
            self.report.problem(
                format!("images of {name} share a descriptor with others: {}", some(&twice)),
                format!("start the server and run `whereabouts index --reindex --map {name}`"),
            );
        }
        self.graph(map, folder);
        let bytes = |part: &str| {
            let found = fs::read_dir(folder).into_iter().flatten().flatten();
            let found = found.filter(|entry| entry.file_name().to_string_lossy().ends_with(part));
            found.filter_map(|entry| entry.metadata().ok()).map(|found| found.blocks() * 512).sum()
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
        let repaired = self.how.repair && fs::remove_file(&file).is_ok();
        self.report.found(
            false,
            format!("the graph of {} is damaged; it is derived, nothing is lost", map.name),
            "the server builds it again and searches exactly until then; --repair removes it",
            repaired,
        );
    }
}
