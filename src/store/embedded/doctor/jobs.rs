//! Checks jobs: each is listed as its state requires, and has its frame.

use super::super::super::changes::ended_at;
use super::super::trees::{
    BlobOwner, Lease, blob_ref_key, decode, ended_job, ended_key, failed, put, queue_key,
    queued_job,
};
use super::{Doctor, list};
use crate::{JobRecord, StoreError};

impl Doctor<'_> {
    pub(super) fn jobs(&mut self) -> Result<(), StoreError> {
        let (mut unlisted, mut frameless) = (Vec::new(), Vec::new());
        for value in self.trees.jobs.iter().values() {
            let record: JobRecord = match decode(&value.map_err(failed)?) {
                Ok(record) => record,
                Err(error) => {
                    self.report.problem(
                        format!("the record of a job cannot be read: {error}"),
                        "nothing else depends on it; to get rid of it, restore a backup into a new \
                         folder",
                    );
                    continue;
                }
            };
            let job = &record.job;
            *self.report.jobs.entry(job.state.to_string()).or_insert(0) += 1;
            let listed = match job.state.is_final() {
                true => self.trees.ended.contains_key(ended_key(ended_at(job), job.id)),
                false => self.trees.queue.contains_key(queue_key(job)),
            };
            if !listed.map_err(failed)? {
                unlisted.push(job.id);
                if self.options.repair {
                    self.relist(&record)?;
                }
            }
            let query = &record.query;
            if !job.state.is_final() && !self.picture(&query.digest).is_file() {
                frameless.push(job.id);
            }
            let reference = blob_ref_key(&query.digest, &BlobOwner::Query(query.id));
            self.required.references.insert(reference);
            self.required.frames.insert(query.digest, job.id);
        }
        if !unlisted.is_empty() {
            self.report.found(
                true,
                format!(
                    "{} jobs are not listed as their state requires: {}",
                    unlisted.len(),
                    list(&unlisted)
                ),
                "--repair lists them",
                self.options.repair,
            );
        }
        if !frameless.is_empty() {
            self.report.problem(
                format!(
                    "the frames of {} unfinished jobs are lost: {}",
                    frameless.len(),
                    list(&frameless)
                ),
                "start the server and cancel them: POST /jobs/{id}/cancel",
            );
        }
        self.dangling_listings()
    }

    fn relist(&self, record: &JobRecord) -> Result<(), StoreError> {
        let (trees, job) = (&self.trees, &record.job);
        match job.state.is_final() {
            true => {
                trees.ended.insert(ended_key(ended_at(job), job.id), &[]).map(drop).map_err(failed)
            }
            false => put(&trees.queue, &queue_key(job), &Lease::None),
        }
    }

    fn dangling_listings(&mut self) -> Result<(), StoreError> {
        let mut dangling = 0;
        for (tree, is_ended) in [(&self.trees.queue, false), (&self.trees.ended, true)] {
            for key in tree.iter().keys() {
                let key = key.map_err(failed)?;
                let id =
                    if is_ended { ended_job(&key).map(|(_, id)| id) } else { queued_job(&key) };
                let exists = id.map(|id| self.trees.jobs.contains_key(id.as_bytes()));
                if exists.transpose().map_err(failed)? != Some(true) {
                    dangling += 1;
                    if self.options.repair {
                        tree.remove(&key).map_err(failed)?;
                    }
                }
            }
        }
        if dangling > 0 {
            let what =
                format!("{dangling} queue or history entries belong to jobs that no longer exist");
            self.report.found(false, what, "harmless; --repair removes them", self.options.repair);
        }
        Ok(())
    }
}
