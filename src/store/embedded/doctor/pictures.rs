//! Bytes of images and frames: whatever is needed is there, and whatever is there is needed.

use std::collections::HashSet;
use std::fs;
use std::path::{Path, PathBuf};

use walkdir::WalkDir;

use super::super::trees::failed;
use super::{Doctor, some};
use crate::StoreError;
use whereabouts_core::Digest;

impl Doctor<'_> {
    /// Where the bytes of a digest are.
    pub(super) fn picture(&self, digest: &Digest) -> PathBuf {
        super::super::blobs::path_of(&self.dir.join("images"), digest)
    }

    pub(super) fn pictures(&mut self) -> Result<(), StoreError> {
        self.references()?;
        let missing: Vec<String> = self
            .needed
            .images
            .iter()
            .filter(|(digest, _)| !self.picture(digest).is_file())
            .map(|(_, (map, id))| format!("{map}/{id}"))
            .collect();
        if !missing.is_empty() {
            self.report.problem(
                format!("the pictures of {} images are lost: {}", missing.len(), some(&missing)),
                "they are still found, but cannot be compared or shown: start the server and \
                 `whereabouts restore` a backup after deleting them, or delete them and add them again",
            );
        }
        let (mut orphans, mut damaged) = (Vec::new(), Vec::new());
        let images = self.dir.join("images");
        for entry in WalkDir::new(&images).into_iter().filter_map(Result::ok) {
            if !entry.file_type().is_file() {
                continue;
            }
            match digest_of(&images, entry.path()) {
                Some(digest) if self.is_needed(&digest) => {
                    if self.how.deep && !is_intact(entry.path(), &digest) {
                        damaged.push(self.owner(&digest));
                    }
                }
                _ => orphans.push(entry.into_path()),
            }
        }
        if !damaged.is_empty() {
            self.report.problem(
                format!("{} pictures are not what was sent: {}", damaged.len(), some(&damaged)),
                "start the server, delete these images and `whereabouts restore` a backup, or add \
                 them again; look after the disk",
            );
        }
        self.orphans(&orphans);
        Ok(())
    }

    fn is_needed(&self, digest: &Digest) -> bool {
        self.needed.images.contains_key(digest) || self.needed.frames.contains_key(digest)
    }

    fn owner(&self, digest: &Digest) -> String {
        match (self.needed.images.get(digest), self.needed.frames.get(digest)) {
            (Some((map, id)), _) => format!("{map}/{id}"),
            (None, Some(job)) => format!("the frame of the job {job}"),
            (None, None) => digest.to_string(),
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
            self.how.repair && orphans.iter().all(|orphan| fs::remove_file(orphan).is_ok());
        self.report.found(
            false,
            format!("{} files in images/ ({bytes} bytes) are needed by nothing", orphans.len()),
            "a process that was killed left them; --repair removes them",
            repaired,
        );
    }

    /// Who needs which bytes is written down twice; the records of images and jobs are right.
    fn references(&mut self) -> Result<(), StoreError> {
        let mut there = HashSet::new();
        for key in self.trees.blob_refs.iter().keys() {
            there.insert(key.map_err(failed)?.to_vec());
        }
        let missing: Vec<_> = self.needed.references.difference(&there).collect();
        let stale: Vec<_> = there.difference(&self.needed.references).collect();
        let repair = self.how.repair;
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
                    "{missing} pictures would be removed too soon: references to them are missing"
                ),
                "--repair writes them",
                repair,
            );
        }
        if stale > 0 {
            self.report.found(
                false,
                format!("{stale} references to pictures are of nothing that is there"),
                "--repair removes them; look again afterwards for pictures that nothing needs",
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
