//! What a refiner works on.

use jiff::Timestamp;
use uuid::Uuid;
use whereabouts_core::{
    Calibration, Candidate, Descriptor, Digest, Evidence, ImageId, Map, Priority, RefinerKind,
    Usage,
};
use whereabouts_store::{HardNegatives, JobRecord, MapStore};

use super::{FrameTexts, RefineError};

/// A camera frame, and the images that the search found for it.
#[derive(Debug, Clone)]
pub struct RefineInput {
    /// Identifies this refinement in logs and prompts: the id of its job.
    pub id: Uuid,
    /// The map that was searched.
    pub map: Map,
    /// The refiner that was asked for; `None` for the first.
    pub refiner: Option<RefinerKind>,
    /// The camera frame.
    pub frame: QueryFrame,
    /// The images to compare with the frame, in coarse order.
    pub candidates: Vec<Candidate>,
    /// The priority of its job.
    pub priority: Priority,
    /// How often the job is attempted again if this attempt fails.
    pub attempts_left: u32,
    /// The cost of earlier attempts at the same job. It counts against the job's budget.
    pub spent: Usage,
    /// Descriptions from before this time are bought again.
    pub fresh_since: Option<Timestamp>,
}

/// The camera frame of a query.
#[derive(Debug, Clone)]
pub struct QueryFrame {
    /// The id of the query.
    pub query_id: Uuid,
    /// The digest of the picture, whose bytes are in the blob store.
    pub digest: Digest,
    /// The frame's descriptor, if it is known and comparable with the map's current descriptors.
    pub descriptor: Option<Descriptor>,
    /// Whether it shows nothing by which a place can be known.
    pub uninformative: bool,
    /// The text in it.
    pub texts: FrameTexts,
}

impl RefineInput {
    /// Returns the confidence that an image shows the place of the frame; `None` while it is not measured yet. What a
    /// frame that shows nothing resembles is chance.
    pub fn confidence(
        &self,
        calibration: &Calibration,
        of: &ImageId,
        evidence: Option<Evidence>,
    ) -> Option<f32> {
        match self.frame.uninformative {
            true => Some(0.0),
            false => calibration.refined_confidence(&self.candidates, of, evidence),
        }
    }

    /// Returns the input of a job. Fails with [`RefineError::Permanent`] if the job's map was removed.
    pub async fn of_job(record: &JobRecord, maps: &dyn MapStore) -> Result<Self, RefineError> {
        let map = record.map(maps).await?;
        let map = map.ok_or_else(|| RefineError::Permanent("the map was removed".into()))?;
        // A reindexed map has other descriptors, which this one cannot be compared with.
        let descriptor = record.query.descriptor.clone();
        let descriptor = descriptor.filter(|_| record.revision == map.revision);
        Ok(Self {
            id: record.job.id,
            map,
            refiner: Some(record.job.refiner),
            frame: QueryFrame {
                query_id: record.query.id,
                digest: record.query.digest,
                descriptor,
                uninformative: record.query.uninformative.is_some(),
                texts: FrameTexts::default(),
            },
            candidates: record.candidates.clone(),
            priority: record.job.priority,
            attempts_left: 0,
            spent: record.job.usage,
            fresh_since: record.job.fresh_since,
        })
    }
    /// Returns the input that has an image of the map compared with images of other places, as if it were a frame;
    /// `None` if the image is no longer in the map.
    pub async fn of_negatives(
        map: &Map,
        negatives: &HardNegatives,
        maps: &dyn MapStore,
    ) -> Result<Option<Self>, RefineError> {
        let image = maps.image(map, &negatives.image_id).await?;
        let id = Uuid::now_v7();
        Ok(image.map(|image| Self {
            id,
            map: map.clone(),
            refiner: None,
            frame: QueryFrame {
                query_id: id,
                digest: image.digest,
                descriptor: None,
                uninformative: false,
                texts: FrameTexts::default(),
            },
            candidates: negatives.others.clone(),
            priority: Priority::Low,
            attempts_left: 0,
            spent: Usage::default(),
            fresh_since: None,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mllm::tests::shelf::Shelf;
    use whereabouts_core::{Job, MediaType};
    use whereabouts_store::Query;

    fn record(map: &Map) -> JobRecord {
        let now = Timestamp::UNIX_EPOCH;
        let query = Query {
            id: Uuid::from_u128(7),
            digest: Digest::of(b"frame"),
            media_type: MediaType::Jpeg,
            created_at: now,
            descriptor: Descriptor::normalised(vec![1.0]).ok(),
            uninformative: None,
        };
        JobRecord {
            job: Job::queued(map.name.clone(), query.id, RefinerKind::Mllm, now),
            map_uid: map.uid,
            revision: map.revision,
            query,
            candidates: Vec::new(),
            claims: 1,
            traceparent: None,
        }
    }

    #[tokio::test]
    async fn a_descriptor_of_another_revision_of_the_map_is_left_out() {
        let shelf = Shelf::new();
        let current = record(&shelf.map);
        let input = RefineInput::of_job(&current, &shelf).await.unwrap();
        assert_eq!((input.id, input.frame.query_id), (current.job.id, current.query.id));
        assert_eq!(input.frame.descriptor, current.query.descriptor);
        let old = JobRecord { revision: current.revision + 1, ..current };
        let input = RefineInput::of_job(&old, &shelf).await.unwrap();
        assert_eq!(input.frame.descriptor, None);
    }

    #[tokio::test]
    async fn a_job_whose_map_was_removed_fails_for_good() {
        let shelf = Shelf::new();
        // A later map of the same name is another map.
        let job = JobRecord { map_uid: Uuid::from_u128(99), ..record(&shelf.map) };
        let error = RefineInput::of_job(&job, &shelf).await.unwrap_err();
        assert!(matches!(error, RefineError::Permanent(_)), "{error}");
    }
}
