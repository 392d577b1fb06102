//! Lists of jobs, and the search in them.

use uuid::Uuid;
use whereabouts_core::JobState;
use whereabouts_store::JobFilter;

use crate::support::{Fixture, claim, submit};

contract!(
    jobs_are_listed_newest_first_by_map_and_state_a_page_at_a_time,
    jobs_are_searched_for_a_text,
);

async fn jobs_are_listed_newest_first_by_map_and_state_a_page_at_a_time(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut ids = Vec::new();
    for map in ["yard", "vault", "yard", "yard", "vault"] {
        ids.push(submit(&*store, map, b"frame").await);
    }
    for id in &ids[..2] {
        store.cancel(*id).await.unwrap();
    }
    let listed = async |map: Option<&str>, state, before, limit| -> Vec<usize> {
        let map = map.map(|map| map.parse().unwrap());
        let filter = JobFilter { map, state, text: None };
        let jobs = store.jobs(&filter, before, limit).await.unwrap().jobs;
        jobs.iter().map(|job| ids.iter().position(|id| *id == job.id).unwrap()).collect()
    };
    let (queued, cancelled) = (Some(JobState::Queued), Some(JobState::Cancelled));
    assert_eq!(listed(None, None, None, 9).await, [4, 3, 2, 1, 0]);
    assert_eq!(listed(None, None, None, 2).await, [4, 3]);
    assert_eq!(listed(None, None, Some(ids[3]), 2).await, [2, 1]);
    assert_eq!(listed(Some("yard"), None, None, 9).await, [3, 2, 0]);
    assert_eq!(listed(Some("yard"), queued, None, 9).await, [3, 2]);
    assert_eq!(listed(Some("yard"), queued, Some(ids[3]), 9).await, [2]);
    assert_eq!(listed(None, cancelled, None, 1).await, [1]);
    assert_eq!(listed(None, Some(JobState::Running), None, 9).await, [0; 0]);
    assert_eq!(listed(Some("elsewhere"), None, None, 9).await, [0; 0]);
    claim(&*store).await.unwrap();
    assert_eq!(listed(None, Some(JobState::Running), None, 9).await, [2]);
}

async fn jobs_are_searched_for_a_text(fixture: &Fixture) {
    let store = fixture.open().await;
    let mut ids = Vec::new();
    for map in ["town", "yard", "town"] {
        ids.push(submit(&*store, map, b"frame").await);
    }
    let search = async |text: &str, limit| -> Vec<Uuid> {
        let filter = JobFilter { text: Some(text.into()), ..JobFilter::default() };
        let list = store.jobs(&filter, None, limit).await.unwrap();
        assert_eq!(list.searched_to, None);
        list.jobs.iter().map(|job| job.id).collect()
    };
    assert_eq!(search("TOW", 10).await, [ids[2], ids[0]]);
    assert_eq!(search("TOW", 1).await, [ids[2]]);
    assert_eq!(search(&ids[1].to_string(), 10).await, [ids[1]]);
    for text in ["nowhere", "%", "\0", "'"] {
        assert!(search(text, 10).await.is_empty(), "{text:?}");
    }
}
