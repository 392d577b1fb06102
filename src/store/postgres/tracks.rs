//! Tracks of robots. A write names the version that it replaces, so that of two servers that work on one frame each, the
//! second notices the first and takes its frame after it.

use std::time::Duration;

use async_trait::async_trait;
use uuid::Uuid;

use super::super::tracks::first_version;
use super::super::{
    StoreError, StoredTrack, TrackHead, TrackKey, TrackRead, TrackState, TrackStore,
};
use super::{PostgresStore, count};

#[async_trait]
impl TrackStore for PostgresStore {
    fn shares_tracks(&self) -> bool {
        true
    }

    async fn track(
        &self,
        key: &TrackKey,
        known: Option<u64>,
        idle: Duration,
    ) -> Result<TrackRead, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query_as(
            "SELECT version, extract(epoch FROM now() - written_at)::float8,
                 CASE WHEN version = $4 THEN NULL ELSE state END
             FROM tracks WHERE map_uid = $1 AND owner = $2 AND id = $3
                 AND written_at >= now() - make_interval(secs => $5)",
        )
        .bind(key.map)
        .bind(&key.owner)
        .bind(&key.id)
        .bind(known.map(number))
        .bind(idle.as_secs_f64());
        let found: Option<(i64, f64, Option<Vec<u8>>)> =
            inner.call(async { Ok(query.fetch_optional(&inner.pool).await?) }).await?;
        Ok(match found {
            None => TrackRead::Missing,
            Some((_, _, None)) => TrackRead::Unchanged,
            Some((version, age, Some(state))) => TrackRead::Found(StoredTrack {
                version: version.unsigned_abs(),
                age: Duration::try_from_secs_f64(age.max(0.0)).unwrap_or_default(),
                state: state.into(),
            }),
        })
    }

    async fn put_track(
        &self,
        key: &TrackKey,
        before: Option<u64>,
        // Written as soon as its last frame was answered.
        TrackState { frames, state, .. }: TrackState,
        idle: Duration,
    ) -> Result<Option<u64>, StoreError> {
        let next = before.map_or_else(first_version, |before| before + 1);
        let query = match before {
            Some(_) => sqlx::query(
                "UPDATE tracks SET version = $4, frames = $5, written_at = now(), state = $6
                 WHERE map_uid = $1 AND owner = $2 AND id = $3 AND version = $7",
            ),
            None => sqlx::query(
                "INSERT INTO tracks (map_uid, owner, id, version, frames, written_at, state)
                 VALUES ($1, $2, $3, $4, $5, now(), $6)
                 ON CONFLICT (map_uid, owner, id) DO UPDATE
                 SET version = EXCLUDED.version, frames = EXCLUDED.frames,
                     written_at = EXCLUDED.written_at, state = EXCLUDED.state
                 WHERE tracks.written_at < now() - make_interval(secs => $7)",
            ),
        };
        let query = query
            .bind(key.map)
            .bind(&key.owner)
            .bind(&key.id)
            .bind(number(next))
            .bind(number(frames))
            .bind(&state[..]);
        let query = match before {
            Some(before) => query.bind(number(before)),
            None => query.bind(idle.as_secs_f64()),
        };
        Ok((self.inner.run(query).await? > 0).then_some(next))
    }

    async fn tracks(
        &self,
        map: Uuid,
        id: Option<&str>,
        limit: usize,
        idle: Duration,
    ) -> Result<Vec<TrackHead>, StoreError> {
        let inner = &self.inner;
        let query = sqlx::query_as(
            "SELECT owner, id, frames, written_at FROM tracks
             WHERE map_uid = $1 AND ($2::text IS NULL OR id = $2)
                 AND written_at >= now() - make_interval(secs => $4)
             ORDER BY written_at DESC, owner, id LIMIT $3",
        )
        .bind(map)
        .bind(id)
        .bind(count(limit))
        .bind(idle.as_secs_f64());
        let found: Vec<(String, String, i64, jiff_sqlx::Timestamp)> =
            inner.call(async { Ok(query.fetch_all(&inner.pool).await?) }).await?;
        let head =
            |(owner, id, frames, written_at): (String, String, i64, jiff_sqlx::Timestamp)| {
                let (frames, written_at) = (frames.unsigned_abs(), written_at.to_jiff());
                TrackHead { owner, id, frames, last_frame_at: written_at }
            };
        Ok(found.into_iter().map(head).collect())
    }

    async fn prune_tracks(&self, idle: Duration, most: usize) -> Result<usize, StoreError> {
        let query = sqlx::query(
            "DELETE FROM tracks WHERE written_at < now() - make_interval(secs => $1)
                 OR (map_uid, owner, id) IN (
                     SELECT map_uid, owner, id FROM tracks ORDER BY written_at DESC OFFSET $2)",
        )
        .bind(idle.as_secs_f64())
        .bind(count(most));
        Ok(usize::try_from(self.inner.run(query).await?).unwrap_or(usize::MAX))
    }
}

/// Converts a number to a `bigint`.
fn number(number: u64) -> i64 {
    i64::try_from(number).unwrap_or(i64::MAX)
}
