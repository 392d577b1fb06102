//! The schema of PostgreSQL: migrations, and stores that are older or newer than it.

use std::time::Duration;

use bytes::Bytes;
use futures_util::future::join_all;
use jiff::Timestamp;
use uuid::Uuid;
use whereabouts_store::postgres::{PostgresStore, SchemaState, migrate, schema_of};
use whereabouts_store::{MapStore, StoreError, TrackKey, TrackState, TrackStore};

use crate::processes::database;
use crate::support::{Database, Pictures, Tuning, add, map};

#[tokio::test]
async fn a_store_is_not_opened_without_its_schema() {
    let database = Database::empty(Pictures::Folder).await;
    let settings = database.settings(Tuning::default());
    let open =
        async || PostgresStore::open(settings.clone(), database.objects(), Uuid::now_v7()).await;
    let refused = open().await.err().unwrap();
    assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    assert!(refused.to_string().contains("whereabouts migrate"), "{refused}");
    assert!(migrate(&settings).await.unwrap() > 0);
    open().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn concurrent_migrations_apply_each_step_once() {
    let database = Database::empty(Pictures::Folder).await;
    let settings = database.settings(Tuning::default());
    let migrating = join_all((0..4).map(|_| migrate(&settings))).await;
    migrating.into_iter().for_each(|done| assert!(done.is_ok(), "{done:?}"));
    assert_eq!(migrate(&settings).await.unwrap(), 0);
    assert_eq!(schema_of(&settings).await.unwrap(), SchemaState::UpToDate);
    database.open(Tuning::default()).await;
}

#[tokio::test]
async fn a_schema_one_step_ahead_is_tolerated_and_two_steps_are_rejected() {
    let database = database().await;
    let step = async |version: u32| {
        let step = format!(
            "INSERT INTO _sqlx_migrations (version, description, success, checksum, execution_time)
             VALUES ({version}, 'later', true, '', 0)"
        );
        database.run(&step).await;
    };
    let settings = database.settings(Tuning::default());
    let open =
        async || PostgresStore::open(settings.clone(), database.objects(), Uuid::now_v7()).await;
    // During a rolling upgrade an old server may have to restart.
    step(9000).await;
    open().await.unwrap();
    assert_eq!(migrate(&settings).await.unwrap(), 0);
    step(9001).await;
    for refused in [open().await.err().unwrap(), migrate(&settings).await.unwrap_err()] {
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
        assert!(refused.to_string().contains("version 9001"), "{refused}");
    }
}

#[tokio::test]
async fn what_a_server_of_the_previous_release_adds_and_deletes_is_followed() {
    let database = database().await;
    let store = database.open(Tuning::default()).await;
    let (map, _) = store.put_map(map("m", 4)).await.unwrap();
    add(&store, &map, "new", b"new").await;
    let before = store.index_state(&map).await.unwrap();
    // It knows neither places in recordings nor which changes concern poses.
    let pose = r#"{"lat": 1.0, "lon": 2.0}"#;
    database
        .run(&format!(
            "INSERT INTO images (map_uid, id, digest, record, pose)
             SELECT map_uid, 'old', digest, record, '{pose}' FROM images;
             UPDATE image_counts SET images = images + 1, changes = changes + 1"
        ))
        .await;
    let after = store.index_state(&map).await.unwrap();
    assert_eq!((after.changes, after.located), (before.changes + 1, before.located));
    let positions = store.positions(&map).await.unwrap();
    assert_eq!(positions.iter().map(|image| image.id.as_str()).collect::<Vec<_>>(), ["old"]);
    // It deletes a map without its tracks, which expire.
    let key = TrackKey { map: map.uid, owner: "-".into(), id: "a".into() };
    let long = Duration::from_secs(60);
    let (frames, state) = (1, Bytes::from_static(b"state"));
    let state = TrackState { frames, last_frame_at: Timestamp::now(), state };
    store.put_track(&key, None, state, long).await.unwrap().unwrap();
    database.run("DELETE FROM maps").await;
    assert_eq!(store.prune_tracks(Duration::ZERO, 9).await.unwrap(), 1);
}
