//! Searches and leases in the queue of the embedded store.

use super::super::test_records::settings;
use super::*;
use crate::Query;
use whereabouts_core::{Digest, MapName, MediaType, RefinerKind};

/// Submits a job and returns its id.
async fn submitted(store: &EmbeddedStore, map: &str) -> Uuid {
    let (now, id) = (Timestamp::now(), Uuid::now_v7());
    let digest = Digest::of(id.as_bytes());
    let query = Query {
        id,
        digest,
        media_type: MediaType::Jpeg,
        created_at: now,
        descriptor: None,
        uninformative: None,
    };
    let map: MapName = map.parse().unwrap();
    let job = Job::queued(map, id, RefinerKind::Local, now);
    let id = job.id;
    let (map_uid, candidates) = (Uuid::nil(), vec![]);
    let record =
        JobRecord { job, map_uid, revision: 0, query, candidates, claims: 0, traceparent: None };
    store.submit(record, 100).await.unwrap();
    id
}

#[tokio::test]
async fn a_text_search_stops_at_its_bound_and_resumes_from_there() {
    let dir = tempfile::tempdir().unwrap();
    let store = EmbeddedStore::open(&settings(dir.path())).unwrap();
    let mut jobs = Vec::new();
    for map in ["town", "yard", "town", "yard", "yard"] {
        jobs.push(submitted(&store, map).await);
    }
    let filter = JobFilter { text: Some("TOW".into()), ..JobFilter::default() };
    let search = |before: Uuid, limit: usize| {
        let found = list(&store.inner.trees, &filter, before, limit, 2).unwrap();
        (found.jobs.iter().map(|job| job.id).collect::<Vec<_>>(), found.searched_to)
    };
    assert_eq!(search(Uuid::max(), 10), (vec![], Some(jobs[3])));
    assert_eq!(search(jobs[3], 10), (vec![jobs[2]], Some(jobs[1])));
    assert_eq!(search(jobs[1], 10), (vec![jobs[0]], None));
    // A full page does not say where the search stopped.
    assert_eq!(search(jobs[3], 1), (vec![jobs[2]], None));
    let whole = store.jobs(&filter, None, 10).await.unwrap();
    assert_eq!((whole.jobs.len(), whole.searched_to), (2, None));
}

#[test]
fn a_lease_from_before_the_clock_was_set_back_does_not_count() {
    let now: Timestamp = "2026-05-04T12:00:00Z".parse().unwrap();
    let held = |until: Option<&str>| {
        let lease: Lease = until.map(|until| until.parse().unwrap());
        is_held(&encode(&lease).unwrap(), now).unwrap()
    };
    assert!(held(Some("2026-05-04T12:00:01Z")) && held(Some("2026-05-05T00:00:00Z")));
    assert!(!held(None) && !held(Some("2026-05-04T11:59:59Z")));
    assert!(!held(Some("2027-05-04T12:00:00Z")));
}
