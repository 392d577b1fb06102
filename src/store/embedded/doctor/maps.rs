//! Checks maps: every image has its descriptor, and derived files are valid.

use std::collections::HashMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use serde::Serialize;

use super::super::images::{Entry, StoredImage};
use super::super::live_map::folder_of;
use super::super::orphans::remove_folder;
use super::super::segments::VectorFiles;
use super::super::trees::{BlobOwner, blob_ref_key, decode, failed};
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
        let wrong = self.trees.check_texts(&uids, self.options.repair)?;
        if wrong > 0 {
            self.report.found(
                true,
                format!(
                    "{wrong} records of the texts that were read in images do not fit together, so searches for text \
                     miss images"
                ),
                "--repair corrects them; the server reads again what is missing then",
                self.options.repair,
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
        let (mut images, mut picture_bytes) = (0, 0);
        let (mut damaged, mut sharing, mut unlisted) = (Vec::new(), Vec::new(), Vec::new());
        let mut slots: HashMap<usize, ImageId> = HashMap::new();
        for stored in self.trees.images_of(map.uid) {
            let stored = match stored {
                Ok(stored) => stored,
                Err(error) => {
                    self.report.problem(
                        format!("the record of an image of {name} cannot be read: {error}"),
                        lost_advice,
                    );
                    continue;
                }
            };
            let listed = self.trees.entry(map.uid, stored.slot).ok().flatten();
            if listed != Some(Entry::from(&stored)) {
                unlisted.push(stored.image.id.clone());
                if self.options.repair {
                    self.trees.put_entry(map.uid, &stored)?;
                }
            }
            let StoredImage { image, slot, .. } = stored;
            images += 1;
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
        if !unlisted.is_empty() {
            self.report.found(
                true,
                format!(
                    "{} images of {name} are not listed by slot, so searches do not find them: {}",
                    unlisted.len(),
                    list(&unlisted)
                ),
                "--repair lists them",
                self.options.repair,
            );
        }
        if !sharing.is_empty() {
            self.report.problem(
                format!("images of {name} share a descriptor with others: {}", list(&sharing)),
                format!("start the server and run `whereabouts index --reindex --map {name}`"),
            );
        }
        self.stale_slots(map, &slots)?;
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

    /// Finds images that are listed by slot only.
    fn stale_slots(
        &mut self,
        map: &Map,
        images: &HashMap<usize, ImageId>,
    ) -> Result<(), StoreError> {
        let listed = self.trees.slots_of(map.uid).collect::<Result<Vec<_>, _>>()?;
        let stale = listed.into_iter().filter(|slot| !images.contains_key(slot));
        let stale: Vec<usize> = stale.collect();
        if stale.is_empty() {
            return Ok(());
        }
        if self.options.repair {
            stale.iter().try_for_each(|&slot| self.trees.forget_slot(map.uid, slot))?;
        }
        self.report.found(
            true,
            format!(
                "{} slots of {} list images that are not there, so searches find them: {}",
                stale.len(),
                map.name,
                list(&stale)
            ),
            "--repair removes them",
            self.options.repair,
        );
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

#[cfg(test)]
mod tests {
    use super::super::super::test_records::{image, map, settings};
    use super::super::super::trees::Trees;
    use crate::embedded::{EmbeddedStore, Examination, examine};
    use crate::{MapStore, StoreError};
    use whereabouts_core::{Descriptor, GeographicPose, Image, Pose};

    #[tokio::test]
    async fn a_wrong_list_of_slots_is_a_problem_that_repair_solves() -> Result<(), StoreError> {
        let dir = tempfile::tempdir().unwrap();
        let pose = GeographicPose { lat: 1.0, lon: 2.0, alt: None, heading: None };
        let store = EmbeddedStore::open(&settings(dir.path()))?;
        let (map, _) = store.put_map(map()).await?;
        for (slot, id) in ["a", "b", "c"].into_iter().enumerate() {
            let image = Image { pose: Some(Pose::Geographic(pose)), ..image(id, id.as_bytes()) };
            let mut numbers = vec![0.0; 3];
            numbers[slot] = 1.0;
            store.add_image(&map, image, Descriptor::normalised(numbers).unwrap()).await?;
        }
        drop(store);
        let trees = Trees::open(&dir.path().join("db"), 1 << 20)?;
        // a is not listed, b is listed with another pose, and slot 9 lists an image that is not there.
        trees.forget_slot(map.uid, 0)?;
        let mut moved = trees.image(map.uid, &"b".parse().unwrap())?.unwrap();
        moved.image.pose = None;
        trees.put_entry(map.uid, &moved)?;
        moved.slot = 9;
        trees.put_entry(map.uid, &moved)?;
        trees.flush()?;
        drop(trees);

        let problems = |repair| {
            let report = examine(dir.path(), Examination { deep: false, repair }).unwrap();
            let problems = report.findings.into_iter().filter(|finding| finding.is_problem);
            problems.map(|finding| finding.what).collect::<Vec<_>>()
        };
        let found = [
            "2 images of m are not listed by slot, so searches do not find them: a, b",
            "1 slots of m list images that are not there, so searches find them: 9",
        ];
        assert_eq!(problems(false).iter().filter(|what| what.contains("slot")).count(), 2);
        for expected in found {
            assert!(problems(false).iter().any(|what| what == expected), "{:?}", problems(false));
        }
        problems(true);
        assert!(problems(false).iter().all(|what| !what.contains("slot")), "{:?}", problems(false));
        let store = EmbeddedStore::open(&settings(dir.path()))?;
        assert_eq!(store.positions(&map).await?.len(), 3);
        Ok(())
    }
}
