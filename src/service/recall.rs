//! Holds the search for a frame against exact search, now and then, so that an index that has lost its way is
//! noticed: recall depends on the descriptors, and those of a user's maps are not those that the settings were
//! chosen with.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{Mutex, OwnedMutexGuard};

use crate::ServiceMetrics;
use whereabouts_core::{Candidate, Descriptor, Map};
use whereabouts_index::SearchMode;
use whereabouts_store::{MapStore, StoreError};

/// Similarities that differ by less are equal: those of the index may be added up in another order.
const EQUAL: f32 = 1e-5;

/// When a search was last checked. Whoever checks one holds it.
#[derive(Debug)]
pub struct RecallCheck {
    pause: Option<Duration>,
    last: Arc<Mutex<Option<Instant>>>,
}

impl RecallCheck {
    /// Checks one search after each pause; none without.
    pub fn new(pause: Option<Duration>) -> Self {
        Self { pause, last: Arc::default() }
    }

    /// Checks what a search in a map has found, if it is time. The caller does not wait.
    pub(super) fn check(
        &self,
        maps: &Arc<dyn MapStore>,
        metrics: &Arc<ServiceMetrics>,
        map: &Map,
        query: &Descriptor,
        found: &[Candidate],
    ) {
        let Some(mut turn) = self.turn() else { return };
        let (maps, metrics) = (Arc::clone(maps), Arc::clone(metrics));
        let (map, query, found) = (map.clone(), query.clone(), found.to_vec());
        tokio::spawn(async move {
            if let Err(error) = check(maps.as_ref(), &metrics, &map, query, &found).await {
                tracing::debug!(%error, map = %map.name, "a search could not be checked");
            }
            *turn = Some(Instant::now());
        });
    }

    /// The right to check a search, if it is time and no other is being checked.
    fn turn(&self) -> Option<OwnedMutexGuard<Option<Instant>>> {
        let pause = self.pause?;
        let turn = Arc::clone(&self.last).try_lock_owned().ok()?;
        turn.is_none_or(|last| last.elapsed() >= pause).then_some(turn)
    }
}

/// Counts the nearest images that a search has found, if a graph is in use.
async fn check(
    maps: &dyn MapStore,
    metrics: &ServiceMetrics,
    map: &Map,
    query: Descriptor,
    found: &[Candidate],
) -> Result<(), StoreError> {
    if !maps.index_state(map).await?.graph {
        return Ok(());
    }
    let nearest = maps.search(map, query, found.len(), SearchMode::Exact).await?;
    metrics.search_checked(map.name.as_str(), nearest.len(), hits(&nearest, found));
    Ok(())
}

/// How many of those that were found are as near as the furthest of the nearest: images that look the same
/// stand for each other.
fn hits(nearest: &[Candidate], found: &[Candidate]) -> usize {
    let Some(furthest) = nearest.last() else { return 0 };
    let as_near = |found: &&Candidate| found.similarity >= furthest.similarity - EQUAL;
    found.iter().filter(as_near).count().min(nearest.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidates(similarities: &[f32]) -> Vec<Candidate> {
        let candidate = |(rank, similarity): (usize, &f32)| Candidate {
            rank: rank + 1,
            image_id: format!("image-{rank}").parse().unwrap(),
            similarity: *similarity,
            pose: None,
        };
        similarities.iter().enumerate().map(candidate).collect()
    }

    #[test]
    fn what_is_as_near_as_the_furthest_of_the_nearest_was_found() {
        let nearest = candidates(&[0.9, 0.8, 0.7]);
        for (found, hits_of_it) in [
            (&[0.9, 0.8, 0.7][..], 3),
            (&[0.9, 0.7, 0.6], 2),
            (&[0.8, 0.700_001, 0.699_999, 0.699_998], 3),
            (&[0.5], 0),
            (&[], 0),
        ] {
            assert_eq!(hits(&nearest, &candidates(found)), hits_of_it, "{found:?}");
        }
        assert_eq!(hits(&[], &nearest), 0);
    }

    #[test]
    fn one_search_is_checked_at_a_time_and_the_next_after_a_pause() {
        let check = RecallCheck::new(Some(Duration::from_secs(3600)));
        let mut turn = check.turn().unwrap();
        assert!(check.turn().is_none(), "another is being checked");
        *turn = Some(Instant::now());
        drop(turn);
        assert!(check.turn().is_none(), "it is not time yet");
        assert!(RecallCheck::new(None).turn().is_none());
        let at_once = RecallCheck::new(Some(Duration::ZERO));
        *at_once.turn().unwrap() = Some(Instant::now());
        assert!(at_once.turn().is_some());
    }
}
