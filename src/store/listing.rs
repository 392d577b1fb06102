//! Filtered lists of jobs.

use uuid::Uuid;

use super::JobRecord;
use whereabouts_core::{Job, JobState, MapName};

/// Jobs that one text search examines at most, because it reads and decodes every record.
pub(super) const MAX_EXAMINED: usize = 5_000;

/// Which jobs to list.
#[derive(Debug, Clone, Default)]
pub struct JobFilter {
    /// Only jobs of this map.
    pub map: Option<MapName>,
    /// Only jobs in this state.
    pub state: Option<JobState>,
    /// Only jobs that contain this text, ignoring case, in their id, query id, map, state, refiner,
    /// error, reasoning or descriptions, or in the ids of their candidates.
    pub text: Option<String>,
}

/// A page of jobs, newest first.
#[derive(Debug, Clone, Default)]
pub struct JobList {
    /// The jobs.
    pub jobs: Vec<Job>,
    /// The last job examined, if a text search stopped there before it had examined all older jobs.
    pub searched_to: Option<Uuid>,
}

impl JobFilter {
    /// Whether a job matches the filter.
    pub fn matches(&self, record: &JobRecord) -> bool {
        let job = &record.job;
        self.map.as_ref().is_none_or(|map| *map == job.map)
            && self.state.is_none_or(|state| state == job.state)
            && self.text.as_deref().is_none_or(|text| contains(record, &folded(text)))
    }
}

fn contains(record: &JobRecord, text: &str) -> bool {
    let job = &record.job;
    let has = |field: &str| folded(field).contains(text);
    // Short and commonly searched fields first.
    has(&job.id.to_string())
        || has(&job.query_id.to_string())
        || has(job.map.as_str())
        || has(&job.state.to_string())
        || has(&job.refiner.to_string())
        || record.candidates.iter().any(|candidate| has(candidate.image_id.as_str()))
        || job.error.as_deref().is_some_and(has)
        || job.reasoning.as_deref().is_some_and(has)
        || job.descriptions.iter().any(|description| has(&description.text))
}

/// Folds case letter by letter, so that a substring of a text stays a substring of its folded form.
fn folded(text: &str) -> String {
    match text.is_ascii() {
        true => text.to_ascii_lowercase(),
        false => text.chars().flat_map(char::to_lowercase).collect(),
    }
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;

    use super::*;
    use crate::Query;
    use whereabouts_core::{
        Candidate, Description, Digest, MediaType, Priority, RefinerKind, Usage,
    };

    fn record() -> JobRecord {
        let now = Timestamp::now();
        let query = Query {
            id: Uuid::from_u128(0xABC),
            digest: Digest::of(b"frame"),
            media_type: MediaType::Jpeg,
            created_at: now,
            descriptor: None,
            uninformative: None,
        };
        let image_id: whereabouts_core::ImageId = "Gate.jpg".parse().unwrap();
        let description = Description {
            image_id: image_id.clone(),
            text: "A red door, ΟΔΟΣ on its sign".into(),
            cached: false,
            stands_in: None,
            took_ms: None,
            usage: Usage::default(),
        };
        let job = Job {
            id: Uuid::from_u128(0xDEF),
            priority: Priority::High,
            state: JobState::Degraded,
            descriptions: vec![description],
            reasoning: Some("The awning decides.".into()),
            error: Some("1 of 2 pairs failed".into()),
            ..Job::queued("yard".parse().unwrap(), query.id, RefinerKind::Mllm, now)
        };
        let candidates =
            vec![Candidate { rank: 1, image_id, similarity: 0.5, pose: None, order: None }];
        JobRecord {
            job,
            map_uid: Uuid::nil(),
            revision: 0,
            query,
            candidates,
            claims: 0,
            traceparent: None,
        }
    }

    #[test]
    fn a_text_search_covers_the_visible_fields_and_no_others() {
        let record = record();
        let found = |text: &str| {
            JobFilter { text: Some(text.into()), ..JobFilter::default() }.matches(&record)
        };
        for text in [
            "000000000def",
            "0ABC",
            "YARD",
            "degraded",
            "mllm",
            "gate.j",
            "1 of 2 PAIRS",
            "awning",
            "red door",
            "οδοσ on",
            "ΟΔΟΣ",
        ] {
            assert!(found(text), "{text}");
        }
        for text in ["local", "high", "door red", "awning red", "frame", "0.5"] {
            assert!(!found(text), "{text}");
        }
    }

    #[test]
    fn a_job_must_match_every_condition_of_the_filter() {
        let record = record();
        let filter = |map: &str, state, text: &str| JobFilter {
            map: Some(map.parse().unwrap()),
            state: Some(state),
            text: Some(text.into()),
        };
        assert!(filter("yard", JobState::Degraded, "door").matches(&record));
        assert!(!filter("town", JobState::Degraded, "door").matches(&record));
        assert!(!filter("yard", JobState::Failed, "door").matches(&record));
        assert!(!filter("yard", JobState::Degraded, "window").matches(&record));
        assert!(JobFilter::default().matches(&record));
    }
}
