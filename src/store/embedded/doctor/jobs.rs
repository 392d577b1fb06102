//! Jobs: each is where its state says, and has its frame.

use super::super::super::changes::ended_at;
use super::super::trees::{
    BlobOwner, Lease, blob_ref_key, decode, ended_job, ended_key, failed, put, queue_key,
    queued_job,
};
use super::{Doctor, some};
use crate::{JobRecord, StoreError};

impl Doctor<'_> {
    pub(super) fn jobs(&mut self) -> Result<(), StoreError> {
        let (mut unlisted, mut frameless) = (Vec::new(), Vec::new());
        for value in self.trees.jobs.iter().values() {
            let record: JobRecord = match decode(&value.map_err(failed)?) {
                Ok(record) => record,
                Err(error) => {
                    self.report.problem(
                        format!("the record of a job is lost: {error}"),
                        "nothing else depends on it; restore a backup into a new folder to be rid of \
                         it",
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
                if self.how.repair {
                    self.list(&record)?;
                }
            }
            let query = &record.query;
            if !job.state.is_final() && !self.picture(&query.digest).is_file() {
                frameless.push(job.id);
            }
            let reference = blob_ref_key(&query.digest, &BlobOwner::Query(query.id));
            self.needed.references.insert(reference);
            self.needed.frames.insert(query.digest, job.id);
        }
        if !unlisted.is_empty() {
            self.report.found(
                true,
                format!(
                    "{} jobs are not listed where their state says: {}",
                    unlisted.len(),
                    some(&unlisted)
                ),
                "--repair lists them",
                self.how.repair,
            );
        }
        if !frameless.is_empty() {
            self.report.problem(
                format!(
                    "the frames of {} jobs that wait are lost: {}",
                    frameless.len(),
                    some(&frameless)
                ),
                "start the server and cancel them: POST /jobs/{id}/cancel",
            );
        }
        self.places_of_no_job()
    }

    fn list(&self, record: &JobRecord) -> Result<(), StoreError> {
        let (trees, job) = (&self.trees, &record.job);
        match job.state.is_final() {
            true => {
                trees.ended.insert(ended_key(ended_at(job), job.id), &[]).map(drop).map_err(failed)
            }
            false => put(&trees.queue, &queue_key(job), &Lease::None),
        }
    }

    fn places_of_no_job(&mut self) -> Result<(), StoreError> {
        let mut empty = 0;
        for (tree, is_ended) in [(&self.trees.queue, false), (&self.trees.ended, true)] {
            for key in tree.iter().keys() {
                let key = key.map_err(failed)?;
                let id =
                    if is_ended { ended_job(&key).map(|(_, id)| id) } else { queued_job(&key) };
                let there = id.map(|id| self.trees.jobs.contains_key(id.as_bytes()));
                if there.transpose().map_err(failed)? != Some(true) {
                    empty += 1;
                    if self.how.repair {
                        tree.remove(&key).map_err(failed)?;
                    }
                }
            }
        }
        if empty > 0 {
            let what = format!("{empty} places are of jobs that are gone");
            self.report.found(false, what, "harmless; --repair removes them", self.how.repair);
        }
        Ok(())
    }
}
