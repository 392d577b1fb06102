//! Tracks in the store. With a database, any server continues a track: it reads the latest version before a frame, unless
//! it knows it, and writes the next one before it answers. If another server has written meanwhile, the frame is taken
//! again, after the other one, so that neither is lost. Without a database, a track is in memory, and is written every few
//! seconds and when the server stops, so that it survives a restart.

use std::sync::Arc;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::super::ServiceError;
use super::Tracks;
use super::ground::Ground;
use super::memory::Held;
use super::session::Track;
use whereabouts_store::{TrackKey, TrackRead, TrackState};

/// Pause between two writes of the tracks in memory.
const SAVE_PAUSE: Duration = Duration::from_secs(5);

/// Number of these pauses between two removals of expired tracks.
const PRUNE_PAUSES: u32 = 12;

/// How often a change of a track is made again because another server was faster. Each time, that server has changed it.
pub(super) const MAX_ATTEMPTS: usize = 16;

impl Tracks {
    /// Brings a track to the version in the store.
    pub(super) async fn refresh(
        &self,
        key: &TrackKey,
        held: &mut Held,
        ground: &Arc<Ground>,
    ) -> Result<(), ServiceError> {
        if held.is_read && !self.stored.shares_tracks() {
            return Ok(());
        }
        match self.stored.track(key, held.version, self.idle()).await? {
            TrackRead::Unchanged => {}
            // It was evicted there, or the database has crashed: it continues from what is known here.
            TrackRead::Missing => held.version = None,
            TrackRead::Found(found) => {
                let track = Track::from_bytes(&found.state, found.age, ground);
                held.track = track.unwrap_or_else(Track::new);
                held.version = Some(found.version);
                held.is_saved = true;
            }
        }
        held.is_read = true;
        Ok(())
    }

    /// Replaces a track by what it is after a frame. Returns `false`, having changed nothing, if another server has
    /// changed it since it was read.
    pub(super) async fn keep(
        &self,
        key: &TrackKey,
        held: &mut Held,
        next: Track,
        ground: &Arc<Ground>,
    ) -> Result<bool, ServiceError> {
        if self.stored.shares_tracks() {
            let Some(version) = self.put(key, held.version, &next, ground).await? else {
                return Ok(false);
            };
            held.version = version;
        }
        held.is_saved = self.stored.shares_tracks();
        held.track = next;
        Ok(true)
    }

    /// Stores a track. Returns its version, which is unknown if the track is too large; `None` if another one is stored.
    async fn put(
        &self,
        key: &TrackKey,
        before: Option<u64>,
        track: &Track,
        ground: &Ground,
    ) -> Result<Option<Option<u64>>, ServiceError> {
        let Some(state) = track.to_bytes(ground, self.settings.state_bytes) else {
            tracing::warn!(
                track = key.id,
                "a track is larger than track.state_bytes, so it is not stored; raise it, or lower track.states"
            );
            return Ok(Some(before));
        };
        let state = TrackState { frames: track.frames, last_frame_at: track.last_frame_at, state };
        let version = self.stored.put_track(key, before, state, self.idle()).await?;
        Ok(version.map(Some))
    }

    /// Writes the tracks that the store does not have as they are.
    pub async fn save(&self) {
        if self.stored.shares_tracks() {
            return;
        }
        for (key, track) in self.memory.known(&self.settings, |_| true) {
            let mut held = track.lock().await;
            let Some(ground) = held.track.ground.clone().filter(|_| !held.is_saved) else {
                continue;
            };
            match self.put(&key, held.version, &held.track, &ground).await {
                Ok(version) => {
                    // What is in the file of a track that was evicted meanwhile does not matter.
                    held.version = version.unwrap_or_default();
                    held.is_saved = version.is_some();
                }
                Err(error) => {
                    tracing::warn!(%error, "a track was not stored; after a restart it starts again");
                    return;
                }
            }
        }
    }

    /// Writes tracks and removes expired ones until `shutdown`.
    pub async fn run(&self, shutdown: CancellationToken) {
        let mut pauses = 0_u32;
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(SAVE_PAUSE) => {}
            }
            self.save().await;
            pauses = pauses.wrapping_add(1);
            if pauses.is_multiple_of(PRUNE_PAUSES)
                && let Err(error) =
                    self.stored.prune_tracks(self.idle(), self.settings.stored).await
            {
                tracing::warn!(%error, "expired tracks could not be removed");
            }
        }
    }

    /// How long a track is kept after its last frame.
    pub(super) fn idle(&self) -> Duration {
        Duration::from_secs(self.settings.idle_s)
    }
}
