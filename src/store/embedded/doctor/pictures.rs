//! Checks the bytes of images and frames: all that are required exist, and no others do.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use walkdir::WalkDir;

use super::super::trees::failed;
use super::{Doctor, list};
use crate::StoreError;
use whereabouts_core::Digest;

impl Doctor<'_> {
    /// Returns the path of a picture.
    pub(super) fn picture(&self, digest: &Digest) -> PathBuf {
        super::super::blobs::path_of(&self.dir.join("images"), digest)
    }

    pub(super) fn pictures(&mut self) -> Result<(), StoreError> {
        self.references()?;
        let missing: Vec<String> = self
            .required
            .images
            .iter()
            .filter(|(digest, _)| !self.picture(digest).is_file())
            .map(|(_, (map, id))| format!("{map}/{id}"))
            .collect();
        if !missing.is_empty() {
            self.report.problem(
                format!("the pictures of {} images are lost: {}", missing.len(), list(&missing)),
                "searches still find these images, but they cannot be compared or shown: start the \
                 server, delete them, and `whereabouts restore` a backup or add them again",
            );
        }
        let lost: Vec<&String> = self
            .required
            .vocabularies
            .iter()
            .filter(|(digest, _)| !self.picture(digest).is_file())
            .map(|(_, map)| map)
            .collect();
        if !lost.is_empty() {
            let maps = list(&lost);
            self.report.problem(
                format!("the vocabularies of {} maps are lost: {maps}", lost.len()),
                "frames cannot be localized there: start the server, and reindex these maps",
            );
        }
        let (mut orphans, mut damaged) = (Vec::new(), Vec::new());
        let images = self.dir.join("images");
        for entry in WalkDir::new(&images).into_iter().filter_map(Result::ok) {
            if !entry.file_type().is_file() {
                continue;
            }
            match digest_of(&images, entry.path()) {
                Some(digest) if self.is_required(&digest) => {
                    if self.options.deep && !is_intact(entry.path(), &digest) {
                        damaged.push(self.owner(&digest));
                    }
                }
                _ => orphans.push(entry.into_path()),
            }
        }
        if !damaged.is_empty() {
            self.report.problem(
                format!("{} pictures are damaged: {}", damaged.len(), list(&damaged)),
                "start the server, delete these images, and `whereabouts restore` a backup or add \
                 them again; check the disk as well",
            );
        }
        self.orphans(&orphans);
        Ok(())
    }

    fn is_required(&self, digest: &Digest) -> bool {
        self.required.images.contains_key(digest)
            || self.required.frames.contains_key(digest)
            || self.required.vocabularies.contains_key(digest)
    }

    fn owner(&self, digest: &Digest) -> String {
        match (self.required.images.get(digest), self.required.frames.get(digest)) {
            (Some((map, id)), _) => format!("{map}/{id}"),
            (None, Some(job)) => format!("the frame of the job {job}"),
            (None, None) => match self.required.vocabularies.get(digest) {
                Some(map) => format!("the vocabulary of the map {map}"),
                None => digest.to_string(),
            },
        }
    }

    fn orphans(&mut self, orphans: &[PathBuf]) {
        if orphans.is_empty() {
            return;
        }
        let bytes: u64 = orphans
            .iter()
            .filter_map(|path| fs::metadata(path).ok())
            .map(|found| found.len())
            .sum();
        let repaired =
            self.options.repair && orphans.iter().all(|orphan| fs::remove_file(orphan).is_ok());
        self.report.found(
            false,
            format!("{} files in images/ ({bytes} bytes) are not referenced", orphans.len()),
            "a killed process left them; --repair removes them",
            repaired,
        );
    }

    /// Compares the references with the records of images and jobs, which are authoritative.
    fn references(&mut self) -> Result<(), StoreError> {
        let mut stored = HashSet::new();
        for key in self.trees.blob_refs.iter().keys() {
            stored.insert(key.map_err(failed)?.to_vec());
        }
        let missing: Vec<_> = self.required.references.difference(&stored).collect();
        let stale: Vec<_> = stored.difference(&self.required.references).collect();
        let repair = self.options.repair;
        if repair {
            for key in &missing {
                self.trees.blob_refs.insert(key.as_slice(), &[]).map_err(failed)?;
            }
            for key in &stale {
                self.trees.blob_refs.remove(key.as_slice()).map_err(failed)?;
            }
        }
        let (missing, stale) = (missing.len(), stale.len());
        if missing > 0 {
            self.report.found(
                true,
                format!(
                    "{missing} references to pictures are missing: these may be deleted too early"
                ),
                "--repair writes them",
                repair,
            );
        }
        if stale > 0 {
            self.report.found(
                false,
                format!("{stale} references to pictures are stale: their image or job is gone"),
                "--repair removes them; run this command again afterwards to find unreferenced pictures",
                repair,
            );
        }
        Ok(())
    }
}

fn digest_of(images: &Path, path: &Path) -> Option<Digest> {
    let name: PathBuf = path.strip_prefix(images).ok()?.to_owned();
    name.to_str()?.replacen('/', "", 1).parse().ok()
}

fn is_intact(path: &Path, digest: &Digest) -> bool {
    fs::read(path).is_ok_and(|bytes| Digest::of(&bytes) == *digest)
}
