//! The schema of PostgreSQL: migrations, and stores that are older or newer than it.

use futures_util::future::join_all;
use uuid::Uuid;
use whereabouts_store::StoreError;
use whereabouts_store::postgres::{PostgresStore, SchemaState, migrate, schema_of};

use crate::processes::database;
use crate::support::{Database, Pictures, Tuning};

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
