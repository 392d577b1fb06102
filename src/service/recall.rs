//! Compares a sample of the searches with exact search, to detect an index with low recall: recall depends on the
//! descriptors, and those of a user's maps are not those that the defaults were tuned with.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{Mutex, OwnedMutexGuard};

use crate::ServiceMetrics;
use whereabouts_core::{Candidate, Descriptor, Map};
use whereabouts_index::SearchMode;
use whereabouts_store::{MapStore, StoreError};

/// Similarities that differ by less are equal: the index may sum up in another order.
const TOLERANCE: f32 = 1e-5;

/// Samples searches: at most one check is in progress, and the next starts after a pause.
#[derive(Debug)]
pub struct RecallCheck {
    pause: Option<Duration>,
    /// End of the last check; locked during a check.
    last: Arc<Mutex<Option<Instant>>>,
}

impl RecallCheck {
    /// Checks a search after each pause; none if there is no pause.
    pub fn new(pause: Option<Duration>) -> Self {
        Self { pause, last: Arc::default() }
    }

    /// Compares the result of a search with exact search in the background, if a check is due.
    pub(super) fn check(
        &self,
        maps: &Arc<dyn MapStore>,
        metrics: &Arc<ServiceMetrics>,
        map: &Map,
        query: &Descriptor,
        found: &[Candidate],
    ) {
        let Some(mut last) = self.due() else { return };
        let (maps, metrics) = (Arc::clone(maps), Arc::clone(metrics));
        let (map, query, found) = (map.clone(), query.clone(), found.to_vec());
        tokio::spawn(async move {
            if let Err(error) = check(maps.as_ref(), &metrics, &map, query, &found).await {
                tracing::debug!(%error, map = %map.name, "a search could not be compared with exact search");
            }
            *last = Some(Instant::now());
        });
    }

    /// Locks the check, if one is due and none is in progress.
    fn due(&self) -> Option<OwnedMutexGuard<Option<Instant>>> {
        let pause = self.pause?;
        let last = Arc::clone(&self.last).try_lock_owned().ok()?;
        last.is_none_or(|last| last.elapsed() >= pause).then_some(last)
    }
}

/// Counts how many of the nearest images a search has found, if the map has a graph.
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
    metrics.search_checked(map.name.as_str(), nearest.len(), count_found(&nearest, found));
    Ok(())
}

/// Counts the found images that are at least as similar as the last of the nearest: images with equal similarity
/// are interchangeable.
fn count_found(nearest: &[Candidate], found: &[Candidate]) -> usize {
    let Some(furthest) = nearest.last() else { return 0 };
    let as_near = |found: &&Candidate| found.similarity >= furthest.similarity - TOLERANCE;
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
            order: None,
        };
        similarities.iter().enumerate().map(candidate).collect()
    }

    #[test]
    fn a_found_image_counts_if_it_is_as_similar_as_the_last_of_the_nearest() {
        let nearest = candidates(&[0.9, 0.8, 0.7]);
        for (found, count) in [
            (&[0.9, 0.8, 0.7][..], 3),
            (&[0.9, 0.7, 0.6], 2),
            (&[0.8, 0.700_001, 0.699_999, 0.699_998], 3),
            (&[0.5], 0),
            (&[], 0),
        ] {
            assert_eq!(count_found(&nearest, &candidates(found)), count, "{found:?}");
        }
        assert_eq!(count_found(&[], &nearest), 0);
    }

    #[test]
    fn one_search_is_checked_at_a_time_and_the_next_after_a_pause() {
        let check = RecallCheck::new(Some(Duration::from_secs(3600)));
        let mut last = check.due().unwrap();
        assert!(check.due().is_none(), "a check is in progress");
        *last = Some(Instant::now());
        drop(last);
        assert!(check.due().is_none(), "the pause is not over");
        assert!(RecallCheck::new(None).due().is_none());
        let at_once = RecallCheck::new(Some(Duration::ZERO));
        *at_once.due().unwrap() = Some(Instant::now());
        assert!(at_once.due().is_some());
    }
}
