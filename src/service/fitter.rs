//! Fits vocabularies in the background, once a map has enough images and they have stopped changing.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use super::fitting::obstacle;
use super::reindex::{Declined, FitPlan};
use super::{Reindexer, ServiceError};
use whereabouts_api::ErrorKind;
use whereabouts_core::{Digest, Map, MapName};
use whereabouts_store::{DescriptionCache, IndexState};

/// Pause between two scans for maps that have changed. A map whose images did not change in between is settled.
const SCAN_PAUSE: Duration = Duration::from_secs(3);

/// A vocabulary is fitted again when one in this many of the images of its map was added or removed.
const CHANGED_SHARE: usize = 5;

/// How long a map is left to the process that began to fit a vocabulary for it: longer than a fit takes. If that process
/// found the model's vocabulary better, others look at the map themselves afterwards.
const CLAIMED: SignedDuration = SignedDuration::from_hours(1);

/// Fits the vocabularies of maps.
pub struct VocabularyFitter {
    /// Replaces the descriptors of a map.
    pub reindexer: Reindexer,
    /// Lets one process at a time fit a map, by the same leases as purchases of descriptions.
    pub leases: Arc<dyn DescriptionCache>,
}

impl VocabularyFitter {
    /// Fits vocabularies after the images of maps have changed, until `shutdown`.
    pub async fn run(&self, shutdown: CancellationToken) {
        let mut seen = BTreeMap::new();
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(SCAN_PAUSE) => {}
            }
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = self.fit_settled(&mut seen) => {}
            }
        }
    }

    /// Fits the vocabularies of the maps whose images have not changed since the last scan.
    async fn fit_settled(&self, seen: &mut BTreeMap<Uuid, (usize, u64)>) {
        let maps = match self.reindexer.maps.store.maps().await {
            Ok(maps) => maps,
            Err(error) => return tracing::debug!(%error, "maps cannot be listed"),
        };
        seen.retain(|uid, _| maps.iter().any(|map| map.uid == *uid));
        for map in maps {
            let Ok(IndexState { images, changes, .. }) =
                self.reindexer.maps.store.index_state(&map).await
            else {
                continue;
            };
            let settled = seen.insert(map.uid, (images, changes)) == Some((images, changes));
            if settled && let Err(error) = self.fit_if_due(&map, images).await {
                // The next scan tries again if the map was deleted, reindexed or changed meanwhile.
                tracing::debug!(map = %map.name, %error, "a vocabulary could not be fitted");
                let passing = [ErrorKind::Conflict, ErrorKind::NotFound, ErrorKind::Overloaded];
                if !passing.contains(&error.kind) {
                    let why = format!("it could not be fitted: {}", error.detail);
                    self.reindexer.maps.reindexes.decline(&map, Declined { images, why });
                }
            }
        }
    }

    /// Fits the vocabulary of a map now, as if all its images were new. Returns whether its descriptors have changed.
    pub async fn fit_again(&self, name: &MapName) -> Result<bool, ServiceError> {
        let map = self.reindexer.maps.find(name).await?;
        let images = self.reindexer.maps.store.index_state(&map).await?.images;
        match self.plan(&map, images) {
            Some((_, plan)) => self.reindexer.fit_in_background(&map, images, plan).await,
            None => Ok(false),
        }
    }

    async fn fit_if_due(&self, map: &Map, images: usize) -> Result<bool, ServiceError> {
        match self.plan(map, images) {
            Some((before, plan)) if before.is_none_or(|before| has_changed(before, images)) => {
                let key = claim_of(map, images);
                if !self.leases.acquire_lease(&key, Timestamp::now() + CLAIMED).await? {
                    return Ok(false);
                }
                let fitted = self.reindexer.fit_in_background(map, images, plan).await;
                if fitted.is_err() {
                    self.leases.release_lease(&key).await?;
                }
                fitted
            }
            _ => Ok(false),
        }
    }

    /// What to do with a map once it has changed, and how many images it had the last time that this was done; `None` to
    /// leave it as it is.
    fn plan(&self, map: &Map, images: usize) -> Option<(Option<usize>, FitPlan)> {
        let Reindexer { maps, settings, .. } = &self.reindexer;
        let has_obstacle = obstacle(map, images, settings).is_some();
        match &map.vocabulary {
            _ if !settings.own || !map.descriptor.may_have_vocabulary() => None,
            Some(own) if own.requested => Some((Some(own.of), FitPlan::Renew)),
            // The map has outgrown its own vocabulary.
            Some(own) if images > settings.max_images => Some((Some(own.of), FitPlan::Drop)),
            _ if has_obstacle => None,
            Some(own) => Some((Some(own.of), FitPlan::Choose)),
            None => {
                let declined = maps.reindexes.declined(map);
                Some((declined.map(|declined| declined.images), FitPlan::Choose))
            }
        }
    }
}

/// Identifies the fit of a map as it is now, on every server of its store.
fn claim_of(map: &Map, images: usize) -> Digest {
    Digest::of(format!("vocabulary of {} {} {images}", map.uid, map.revision).as_bytes())
}

fn has_changed(before: usize, images: usize) -> bool {
    before.abs_diff(images).saturating_mul(CHANGED_SHARE) > before
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_is_claimed_alike_on_every_server_and_again_when_the_map_has_changed() {
        let map = crate::tests::map("m");
        let claim = claim_of(&map, 100);
        assert_eq!(claim_of(&map.clone(), 100), claim);
        let replaced = Map { revision: map.revision + 1, ..map.clone() };
        let others = [claim_of(&map, 120), claim_of(&replaced, 100)];
        assert!(!others.contains(&claim) && claim_of(&crate::tests::map("m"), 100) != claim);
    }

    #[test]
    fn a_vocabulary_is_fitted_again_when_a_fifth_of_the_map_has_changed() {
        for (before, images, changed) in [
            (100, 120, false),
            (100, 121, true),
            (100, 79, true),
            (100, 80, false),
            (0, 0, false),
            (0, 1, true),
        ] {
            assert_eq!(has_changed(before, images), changed, "{before} to {images}");
        }
    }
}
