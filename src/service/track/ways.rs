//! The ways of the robots in a map, for operators and for the robots themselves.

use std::sync::Arc;

use super::super::{Principal, ServiceError};
use super::estimate::place_radius;
use super::history::{Smoothed, settled, smoothed};
use super::posterior::MIN_IMAGES;
use super::session::{Track, habits};
use super::{Key, Tracks, on_blocking_thread};
use whereabouts_api::{TrackList, TrackPlace, TrackSummary, TrackWay};
use whereabouts_core::{Map, Role};

/// Maximum number of tracks in a list.
const LISTED: usize = 100;

impl Tracks {
    /// The tracks in a map, those with the latest frames first.
    pub async fn list(&self, map: &Map) -> Result<TrackList, ServiceError> {
        let mut tracks = self.known(|key| key.0 == map.uid);
        tracks.truncate(LISTED);
        let mut list = Vec::new();
        for ((_, owner, id), track) in tracks {
            let track = track.lock().await;
            list.push(TrackSummary {
                id,
                key: key_of(owner),
                frames: track.frames,
                last_frame_at: track.last_frame_at,
            });
        }
        list.retain(|track| track.frames > 0);
        Ok(TrackList { tracks: list })
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
        let mut found = self.known(|(uid, owner, known)| {
            *uid == map.uid && known == id && (may_see_all || is_own(owner))
        });
        found.sort_by_key(|((_, owner, _), _)| !is_own(owner));
        let Some(((_, owner, id), track)) = found.into_iter().next() else {
            return Err(ServiceError::not_found(format!(
                "the map {} has no track {id:?}; a track is forgotten {} s after its last frame (track.idle_s)",
                map.name, self.settings.idle_s
            )));
        };
        let ground = self.ground(map).await?;
        let mut track = Track::clone(&*track.lock().await);
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

    /// The tracks that a condition holds for and that have not expired, the last used first.
    fn known(&self, is_wanted: impl Fn(&Key) -> bool) -> Vec<(Key, SharedTrack)> {
        let tracks = self.tracks.lock();
        let mut found: Vec<_> = tracks
            .iter()
            .filter(|(key, entry)| is_wanted(key) && !entry.is_idle(&self.settings))
            .collect();
        found.sort_by_key(|(_, entry)| std::cmp::Reverse(entry.last_used));
        found.into_iter().map(|(key, entry)| (key.clone(), Arc::clone(&entry.track))).collect()
    }
}

type SharedTrack = Arc<tokio::sync::Mutex<Track>>;

/// The id of the API key that owns a track.
fn key_of(owner: String) -> Option<String> {
    (owner != Principal::Anonymous.scope()).then_some(owner)
}
