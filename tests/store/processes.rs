//! What several processes that share a PostgreSQL can rely on.

use std::collections::HashSet;
use std::time::Duration;

use futures_util::future::join_all;
use jiff::{SignedDuration, Timestamp};
use sqlx::ConnectOptions;
use tokio::sync::broadcast;
use uuid::Uuid;
use whereabouts_core::{
    ApiKey, CachedDescription, Delivery, Digest, Job, JobState, KeyLimits, Role, StoredKey,
    StoredWebhook, Webhook, WebhookEvent, WebhookSecret,
};
use whereabouts_index::SearchMode;
use whereabouts_store::postgres::PostgresStore;
use whereabouts_store::{
    DescriptionCache, DraftStore, IdempotencyRecord, IdempotencyStore, JobStore, KeyStore,
    MapStore, Progress, Retention, StoreError, StoredDelivery, WebhookStore,
};

use crate::support::{
    Database, Pictures, Tuning, add, claim, descriptor, eventually, fill, map, next, record,
    submit, until,
};

/// A lifetime that no process misses because the machine is busy.
pub fn long_lived() -> Tuning {
    Tuning { lifetime: Duration::from_secs(60), ..Tuning::default() }
}

/// The time of the database, and the first and the last moment at which a process counts as dead unless it sends
/// another heartbeat; in seconds.
const NOW: &str = "SELECT extract(epoch FROM now())";
const EARLIEST_END: &str = "SELECT extract(epoch FROM min(alive_until)) FROM processes";
const LATEST_END: &str = "SELECT extract(epoch FROM max(alive_until)) FROM processes";

pub async fn database() -> Database {
    Database::migrated(Pictures::Folder).await
}

fn in_a_minute() -> Timestamp {
    Timestamp::now() + SignedDuration::from_secs(60)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_job_is_claimed_by_one_worker_across_processes() {
    let database = database().await;
    let processes = [database.open(long_lived()).await, database.open(long_lived()).await];
    let mut submitted = HashSet::new();
    for number in 0..40 {
        submitted.insert(submit(&processes[number % 2], "m", b"frame").await);
    }
    let workers = (0..8).map(|worker| {
        let store = processes[worker % 2].clone();
        tokio::spawn(async move {
            let mut taken = Vec::new();
            while let Some(record) = claim(&store).await {
                let (state, finished_at) = (JobState::Succeeded, Some(Timestamp::now()));
                let job = Job { state, finished_at, ..record.job.clone() };
                store.finish(record.claim(), job).await.unwrap();
                taken.push(record.job.id);
            }
            taken
        })
    });
    let taken: Vec<Uuid> = join_all(workers).await.into_iter().flat_map(Result::unwrap).collect();
    assert_eq!(taken.len(), 40);
    assert_eq!(taken.into_iter().collect::<HashSet<_>>(), submitted);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_queue_limit_holds_across_processes() {
    let database = database().await;
    let processes = [database.open(long_lived()).await, database.open(long_lived()).await];
    submit(&processes[0], "m", b"frame").await;
    let submitting = (0..24).map(|number| {
        let store = processes[number % 2].clone();
        tokio::spawn(async move { store.submit(record("m", b"frame"), 10).await.is_ok() })
    });
    let accepted = join_all(submitting).await.into_iter().filter(|ok| *ok.as_ref().unwrap());
    assert_eq!(accepted.count(), 9);
    assert_eq!(processes[1].queued().await.unwrap(), 10);
}

#[tokio::test]
async fn a_job_of_a_dead_process_can_be_claimed_and_one_of_a_live_process_cannot() {
    let database = database().await;
    let (dying, alive) =
        (database.open(Tuning::default()).await, database.open(long_lived()).await);
    let free = submit(&dying, "m", b"frame").await;
    let taken = claim(&dying).await.unwrap();
    let held = submit(&alive, "m", b"frame").await;
    assert_eq!(claim(&alive).await.unwrap().job.id, held);
    let other = database.open(Tuning::default()).await;
    assert!(claim(&other).await.is_none());
    drop(dying);
    let again = eventually(async || claim(&other).await).await;
    assert_eq!((again.job.id, again.claims), (free, 2));
    assert!(!again.is_held_by(taken.claim()));
    assert!(claim(&other).await.is_none());
}

#[tokio::test]
async fn a_process_that_sends_heartbeats_keeps_its_jobs() {
    let database = database().await;
    // Long enough for a busy machine, short enough to wait for.
    let tuning = Tuning { lifetime: Duration::from_secs(2), ..Tuning::default() };
    let working = database.open(tuning).await;
    submit(&working, "m", b"frame").await;
    claim(&working).await.unwrap();
    let first_end = database.number(LATEST_END).await;
    let other = database.open(Tuning::default()).await;
    until(async || database.number(NOW).await > first_end).await;
    assert!(claim(&other).await.is_none());
}

#[tokio::test]
async fn a_draft_of_a_dead_process_does_not_block_the_next_one() {
    let database = database().await;
    let (dying, other) =
        (database.open(Tuning::default()).await, database.open(Tuning::default()).await);
    let (map, _) = dying.put_map(map("m", 3)).await.unwrap();
    let image = add(&dying, &map, "a", b"a").await;
    let draft = dying.draft(next(&map, 5)).await.unwrap();
    let held = other.draft(next(&map, 5)).await.err();
    assert!(matches!(held, Some(StoreError::Conflict(_))));
    drop(draft);
    drop(dying);
    let mut draft = eventually(async || other.draft(next(&map, 5)).await.ok()).await;
    assert_eq!(fill(draft.as_mut(), 5).await, 1);
    assert!(draft.replace().await.unwrap());
    let query = descriptor(&image, 5);
    let found = other.search(&next(&map, 5), query, 1, SearchMode::Fast).await.unwrap();
    assert_eq!(found[0].image_id, image.id);
}

#[tokio::test]
async fn a_draft_taken_over_by_another_process_replaces_nothing() {
    let database = database().await;
    let (silent, other) =
        (database.open(long_lived()).await, database.open(Tuning::default()).await);
    let (map, _) = silent.put_map(map("m", 3)).await.unwrap();
    let image = add(&silent, &map, "a", b"a").await;
    let mut draft = silent.draft(next(&map, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    // It could not send heartbeats.
    database.run("UPDATE processes SET alive_until = now() - interval '1 hour'").await;
    let mut taken = other.draft(next(&map, 5)).await.unwrap();
    draft.write(&image, descriptor(&image, 5)).await.unwrap();
    for refused in [draft.missing(3).await.map(drop), draft.replace().await.map(drop)] {
        let refused = refused.unwrap_err();
        assert!(matches!(refused, StoreError::Conflict(_)), "{refused}");
    }
    draft.discard().await;
    assert_eq!(fill(taken.as_mut(), 5).await, 1);
    assert!(taken.replace().await.unwrap());
}

#[tokio::test]
async fn the_draft_of_a_deleted_map_is_removed_though_its_process_is_dead() {
    let database = database().await;
    let (dying, other) =
        (database.open(Tuning::default()).await, database.open(Tuning::default()).await);
    let (map, _) = dying.put_map(map("m", 3)).await.unwrap();
    let draft = dying.draft(next(&map, 5)).await.unwrap();
    assert!(other.delete_map(&map.name).await.unwrap());
    drop(draft);
    drop(dying);
    assert_eq!(tables(&database).await, 1);
    eventually(async || {
        other.collect_garbage().await.unwrap();
        (tables(&database).await == 0).then_some(())
    })
    .await;
}

/// The number of descriptor tables.
async fn tables(database: &Database) -> i64 {
    let mut connection = database.options().connect().await.unwrap();
    sqlx::query_scalar("SELECT count(*) FROM pg_tables WHERE tablename LIKE 'descriptors\\_%'")
        .fetch_one(&mut connection)
        .await
        .unwrap()
}

#[tokio::test]
async fn a_map_replaced_by_one_process_is_superseded_at_the_others() {
    let database = database().await;
    let tuning = Tuning { exact_up_to: 4, ..long_lived() };
    let (one, other) = (database.open(tuning).await, database.open(tuning).await);
    let (map, _) = one.put_map(map("m", 3)).await.unwrap();
    let mut images = Vec::new();
    for number in 0..20_u8 {
        images.push(add(&one, &map, &number.to_string(), &[number]).await);
    }
    let query = descriptor(&images[7], 3);
    eventually(async || other.index_state(&map).await.unwrap().graph.then_some(())).await;
    other.search(&map, query.clone(), 5, SearchMode::Fast).await.unwrap();
    let mut draft = one.draft(next(&map, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    assert!(draft.replace().await.unwrap());
    let late = other.search(&map, query, 5, SearchMode::Fast).await.unwrap_err();
    assert!(matches!(late, StoreError::Superseded(_)), "{late}");
    let map = other.map(&map.name).await.unwrap().unwrap();
    let query = descriptor(&images[7], 5);
    let found = other.search(&map, query, 5, SearchMode::Fast).await.unwrap();
    assert_eq!((found.len(), &found[0].image_id), (5, &images[7].id));
    assert!(one.delete_map(&map.name).await.unwrap());
    let query = descriptor(&images[7], 5);
    let late = other.search(&map, query, 5, SearchMode::Fast).await.unwrap_err();
    assert!(matches!(late, StoreError::NotFound(_)), "{late}");
}

fn running(process: Uuid) -> IdempotencyRecord {
    let progress = Progress::Running { process, job: None };
    IdempotencyRecord { fingerprint: Digest::of(b"request"), at: Timestamp::now(), progress }
}

#[tokio::test]
async fn a_request_is_reserved_by_one_process_until_that_is_dead() {
    let database = database().await;
    let (dying, alive) =
        (database.open(Tuning::default()).await, database.open(long_lived()).await);
    let other = database.open(Tuning::default()).await;
    let reserve = async |store: &PostgresStore, id: &str| {
        let since = Timestamp::now() + SignedDuration::from_secs(60);
        store.reserve_request(id, running(Uuid::now_v7()), since).await.unwrap()
    };
    assert_eq!(reserve(&dying, "dying").await, None);
    assert_eq!(reserve(&alive, "alive").await, None);
    for id in ["dying", "alive"] {
        assert!(reserve(&other, id).await.is_some());
    }
    drop(dying);
    eventually(async || reserve(&other, "dying").await.is_none().then_some(())).await;
    assert!(reserve(&other, "alive").await.is_some());
}

async fn webhook(store: &PostgresStore) -> Uuid {
    let webhook = Webhook {
        id: Uuid::now_v7(),
        url: "https://a.example/".into(),
        events: WebhookEvent::ENDS.to_vec(),
        map: None,
        created_at: Timestamp::now(),
        disabled_at: None,
        disabled_reason: None,
    };
    let id = webhook.id;
    let secret = WebhookSecret::new(&[1; 32]);
    store.add_webhook(StoredWebhook { webhook, secret }, 10).await.unwrap();
    id
}

async fn queue_ping(store: &PostgresStore, webhook: Uuid) -> Uuid {
    let delivery = Delivery::queued(webhook, WebhookEvent::Ping, None, Timestamp::now());
    let id = delivery.id;
    store.queue_delivery(StoredDelivery { delivery, body: b"{}".to_vec() }).await.unwrap();
    id
}

#[tokio::test]
async fn a_delivery_is_due_to_one_process_until_that_is_dead() {
    let database = database().await;
    let (dying, alive) =
        (database.open(Tuning::default()).await, database.open(long_lived()).await);
    let other = database.open(Tuning::default()).await;
    let id = webhook(&other).await;
    let due = async |store: &PostgresStore, most: usize| -> Vec<Uuid> {
        let due = store.due_deliveries(id, Timestamp::now(), most).await.unwrap();
        due.into_iter().map(|due| due.delivery.id).collect()
    };
    let (first, second) = (queue_ping(&other, id).await, queue_ping(&other, id).await);
    assert_eq!(due(&dying, 1).await, [first]);
    assert_eq!(due(&alive, 9).await, [second]);
    assert!(due(&other, 9).await.is_empty());
    drop(dying);
    let free = eventually(async || {
        let due = due(&other, 9).await;
        (!due.is_empty()).then_some(due)
    })
    .await;
    assert_eq!(free, [first]);
    assert_eq!(due(&alive, 9).await, [second]);
}

#[tokio::test]
async fn a_description_is_computed_by_one_process_until_its_lease_ends() {
    let database = database().await;
    let (dying, alive) =
        (database.open(Tuning::default()).await, database.open(long_lived()).await);
    let other = database.open(Tuning::default()).await;
    let key = |name: &str| Digest::of(name.as_bytes());
    let begins = async |store: &PostgresStore, name: &str| {
        store.acquire_lease(&key(name), in_a_minute()).await.unwrap()
    };
    for name in ["kept", "ended"] {
        assert!(begins(&alive, name).await);
        assert!(!begins(&other, name).await);
    }
    other.release_lease(&key("ended")).await.unwrap();
    assert!(!begins(&other, "ended").await);
    alive.release_lease(&key("ended")).await.unwrap();
    assert!(begins(&other, "ended").await);
    let description = CachedDescription {
        text: "text".into(),
        usage: Default::default(),
        created_at: Timestamp::now(),
        about: None,
    };
    alive.keep_description(key("kept"), description.clone()).await.unwrap();
    assert_eq!(other.description(&key("kept")).await.unwrap(), Some(description));
    assert!(begins(&other, "kept").await);
    // Its lease expires, or its process dies.
    let soon = Timestamp::now() + SignedDuration::from_millis(100);
    assert!(alive.acquire_lease(&key("late"), soon).await.unwrap());
    assert!(begins(&dying, "dying").await);
    eventually(async || begins(&other, "late").await.then_some(())).await;
    assert!(!begins(&other, "dying").await);
    drop(dying);
    eventually(async || begins(&other, "dying").await.then_some(())).await;
}

/// Waits for a notification about a job.
async fn notified(changes: &mut broadcast::Receiver<Uuid>, of: Uuid) {
    let waiting = async { while changes.recv().await.unwrap() != of {} };
    tokio::time::timeout(Duration::from_secs(20), waiting).await.unwrap();
}

#[tokio::test]
async fn an_open_process_is_notified_of_the_changes_of_others() {
    let database = database().await;
    let one = database.open(long_lived()).await;
    let hook = webhook(&one).await;
    for _ in 0..5 {
        let other = database.open(long_lived()).await;
        let mut changes = other.changes();
        let mut queued = other.queued_deliveries();
        let mut keys = other.changed_keys().unwrap();
        let id = submit(&one, "m", b"frame").await;
        notified(&mut changes, id).await;
        one.cancel(id).await.unwrap();
        notified(&mut changes, id).await;
        let timeout = Duration::from_secs(20);
        tokio::time::timeout(timeout, queued.changed()).await.unwrap().unwrap();
        queued.mark_unchanged();
        keys.mark_unchanged();
        let key = ApiKey {
            id: "key".into(),
            name: "name".into(),
            role: Role::Admin,
            maps: vec![],
            limits: KeyLimits::default(),
            created_at: Timestamp::now(),
            expires_at: None,
            revoked_at: None,
        };
        one.put_key(StoredKey { key, digest: Digest::of(b"key") }).await.unwrap();
        tokio::time::timeout(timeout, keys.changed()).await.unwrap().unwrap();
        assert_eq!(other.keys().await.unwrap().len(), 1);
        queue_ping(&one, hook).await;
        tokio::time::timeout(timeout, queued.changed()).await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn a_map_whose_index_is_being_built_can_be_deleted() {
    let database = database().await;
    let tuning = Tuning { exact_up_to: 50, ..long_lived() };
    let store = database.open(tuning).await;
    let being_built =
        "SELECT count(*) FROM pg_stat_progress_create_index WHERE datname = current_database()";
    for moment in ["before the index is built", "while it is built", "once it is built"] {
        let (map, _) = store.put_map(map("m", 256)).await.unwrap();
        for number in 0..100_u32 {
            add(&store, &map, &number.to_string(), &number.to_le_bytes()).await;
        }
        let is_built = async || store.index_state(&map).await.unwrap().graph;
        match moment {
            "before the index is built" => {}
            // It may be over before it is seen.
            "while it is built" => {
                until(async || database.number(being_built).await > 0.0 || is_built().await).await;
            }
            _ => until(is_built).await,
        }
        assert!(store.delete_map(&map.name).await.unwrap(), "{moment}");
    }
}

#[tokio::test]
async fn all_processes_count_as_alive_right_after_a_start_of_the_database() {
    let database = database().await;
    let dying = database.open(Tuning::default()).await;
    submit(&dying, "m", b"frame").await;
    claim(&dying).await.unwrap();
    drop(dying);
    // Compared with its lifetime, the database was started a moment ago.
    let age = Duration::from_secs(24 * 3600);
    let other = database.open(Tuning { lifetime: age, ..Tuning::default() }).await;
    // By its own account it is dead.
    until(async || database.number(NOW).await > database.number(EARLIEST_END).await).await;
    assert!(claim(&other).await.is_none());
}
