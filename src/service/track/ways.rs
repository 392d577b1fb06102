//! The ways of the robots in a map, for operators and for the robots themselves.

use std::sync::Arc;

use super::super::{Principal, ServiceError};
use super::estimate::place_radius;
use super::history::{Smoothed, settled, smoothed};
use super::posterior::MIN_IMAGES;
use super::session::habits;
use super::{Tracks, on_blocking_thread};
use whereabouts_api::{TrackList, TrackPlace, TrackSummary, TrackWay};
use whereabouts_core::{Map, Role};
use whereabouts_store::{TrackHead, TrackKey};

/// Maximum number of tracks in a list.
const LISTED: usize = 100;

impl Tracks {
    /// The tracks in a map, of all servers, those with the latest frames first.
    pub async fn list(&self, map: &Map) -> Result<TrackList, ServiceError> {
        let mut tracks: Vec<TrackSummary> =
            self.heads(map, None).await?.into_iter().map(summary).collect();
        tracks.sort_by_key(|track| std::cmp::Reverse(track.last_frame_at));
        tracks.truncate(LISTED);
        Ok(TrackList { tracks })
    }

    /// The tracks in a map, in the store and in memory; with `id`, only those of this name.
    async fn heads(&self, map: &Map, id: Option<&str>) -> Result<Vec<TrackHead>, ServiceError> {
        let mut heads = self.stored.tracks(map.uid, id, LISTED, self.idle()).await?;
        if self.stored.shares_tracks() {
            return Ok(heads);
        }
        let is_wanted = |key: &TrackKey| key.map == map.uid && id.is_none_or(|id| key.id == id);
        for (TrackKey { owner, id, .. }, held) in self.memory.known(&self.settings, is_wanted) {
            let held = held.lock().await;
            heads.retain(|head| head.owner != owner || head.id != id);
            if held.track.frames > 0 {
                let (frames, last_frame_at) = (held.track.frames, held.track.last_frame_at);
                heads.push(TrackHead { owner, id, frames, last_frame_at });
            }
        }
        Ok(heads)
    }

    /// The last places of a track. A robot sees its own tracks; others see those of all keys.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`](whereabouts_api::ErrorKind) if there is no such track.
    pub async fn way(
        &self,
        map: &Map,
        caller: &Principal,
        id: &str,
    ) -> Result<TrackWay, ServiceError> {
        let may_see_all = match caller {
            Principal::Anonymous => true,
            Principal::ApiKey(key) => key.role != Role::Robot,
        };
        let is_own = |owner: &str| owner == caller.scope();
        let mut found = self.heads(map, Some(id)).await?;
        found.retain(|head| may_see_all || is_own(&head.owner));
        found.sort_by_key(|head| (!is_own(&head.owner), std::cmp::Reverse(head.last_frame_at)));
        let Some(TrackHead { owner, id, .. }) = found.into_iter().next() else {
            return Err(ServiceError::not_found(format!(
                "the map {} has no track {id:?}; a track is forgotten {} s after its last frame (track.idle_s)",
                map.name, self.settings.idle_s
            )));
        };
        let key = TrackKey { map: map.uid, owner: owner.clone(), id: id.clone() };
        let ground = self.ground(map).await?;
        let mut track = {
            let held = self.memory.track(&key, &self.settings);
            let mut held = held.lock().await;
            self.refresh(&key, &mut held, &ground).await?;
            held.track.clone()
        };
        track.enter(&ground, map.revision);
        let (settings, place_m) = (Arc::clone(&self.settings), self.place_m);
        let (frames, name) = (track.frames, map.name.clone());
        let places = on_blocking_thread(move || {
            let radius = place_radius(&ground, place_m);
            let habits = habits(settings.max_speed_m_s, &settings);
            let all = smoothed(&track.passed, &ground, radius, habits);
            let place = |(passed, smoothed): (&super::history::Passed, Smoothed)| {
                let known_from = settings.known_probability;
                let (smoothed, known) = settled(passed, smoothed, (&ground, radius), known_from);
                let Smoothed { image, probability, off_map } = smoothed;
                TrackPlace {
                    captured_at: passed.captured_at,
                    received_at: passed.received_at,
                    image_id: image.map(|image| ground.id(image).clone()),
                    pose: image.map(|image| ground.pose(image)),
                    probability,
                    known: known && ground.len() >= MIN_IMAGES,
                    off_map,
                }
            };
            track.passed.iter().zip(all).map(place).collect()
        })
        .await?;
        Ok(TrackWay { id, map: name, key: key_of(owner), frames, places })
    }
}

fn summary(TrackHead { owner, id, frames, last_frame_at }: TrackHead) -> TrackSummary {
    TrackSummary { id, key: key_of(owner), frames, last_frame_at }
}

/// The id of the API key that owns a track.
fn key_of(owner: String) -> Option<String> {
    (owner != Principal::Anonymous.scope()).then_some(owner)
}
