//! What several processes that share a PostgreSQL promise each other.

use std::collections::HashSet;
use std::time::Duration;

use futures_util::future::join_all;
use jiff::civil::date;
use jiff::{SignedDuration, Timestamp};
use sqlx::ConnectOptions;
use tokio::sync::broadcast;
use uuid::Uuid;
use whereabouts_core::{
    ApiKey, DayUsage, Delivery, Digest, Job, JobState, KeyLimits, Role, StoredKey, StoredWebhook,
    Usage, Webhook, WebhookEvent, WebhookSecret,
};
use whereabouts_core::{CachedDescription, Spent};
use whereabouts_index::SearchMode;
use whereabouts_store::DescriptionCache;
use whereabouts_store::postgres::{PostgresStore, SchemaState, migrate, schema_of};
use whereabouts_store::{
    DraftStore, IdempotencyRecord, IdempotencyStore, JobStore, KeyStore, MapStore, Progress,
    Retention, SharedLimits, StoreError, StoredDelivery, TokenRequest, UsageStore, WebhookStore,
};

use crate::support::{
    Database, Pictures, SHORT_LIFE, Tuning, add, claim, descriptor, eventually, fill, map, next,
    record, submit,
};

/// One that is not taken for dead because the machine is busy.
fn long_lived() -> Tuning {
    Tuning { lifetime: Duration::from_secs(60), ..Tuning::default() }
}

async fn database() -> Database {
    Database::migrated(Pictures::Folder).await
}

fn in_a_minute() -> Timestamp {
    Timestamp::now() + SignedDuration::from_secs(60)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_job_is_taken_by_one_worker_of_all_processes() {
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
async fn the_queue_of_all_processes_holds_exactly_so_many() {
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
async fn a_job_of_a_dead_process_is_free_and_one_of_a_live_process_is_not() {
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
async fn a_process_that_goes_on_saying_so_is_alive_longer_than_its_lifetime() {
    let database = database().await;
    // Long enough for a busy machine, short enough to wait for.
    let tuning = Tuning { lifetime: Duration::from_secs(2), ..Tuning::default() };
    let working = database.open(tuning).await;
    submit(&working, "m", b"frame").await;
    claim(&working).await.unwrap();
    let other = database.open(Tuning::default()).await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    assert!(claim(&other).await.is_none());
}

#[tokio::test]
async fn a_draft_of_a_dead_process_is_nothing_to_the_next_one() {
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
async fn a_draft_that_was_taken_from_a_process_replaces_nothing() {
    let database = database().await;
    let (silent, other) =
        (database.open(long_lived()).await, database.open(Tuning::default()).await);
    let (map, _) = silent.put_map(map("m", 3)).await.unwrap();
    let image = add(&silent, &map, "a", b"a").await;
    let mut draft = silent.draft(next(&map, 5)).await.unwrap();
    fill(draft.as_mut(), 5).await;
    // It could not say that it is alive.
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
async fn the_draft_of_a_deleted_map_goes_with_it_though_its_process_is_dead() {
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

/// Tables of descriptors.
async fn tables(database: &Database) -> i64 {
    let mut connection = database.options().connect().await.unwrap();
    sqlx::query_scalar("SELECT count(*) FROM pg_tables WHERE tablename LIKE 'descriptors\\_%'")
        .fetch_one(&mut connection)
        .await
        .unwrap()
}

#[tokio::test]
async fn what_one_process_replaces_the_others_are_told_of_when_they_ask() {
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
async fn a_request_is_done_by_one_process_and_by_another_once_that_is_dead() {
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
async fn a_delivery_is_made_by_one_process_and_by_another_once_that_is_dead() {
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
async fn a_description_is_bought_by_one_process_and_by_another_if_nothing_comes_of_it() {
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
    };
    alive.keep_description(key("kept"), description.clone()).await.unwrap();
    assert_eq!(other.description(&key("kept")).await.unwrap(), Some(description));
    assert!(begins(&other, "kept").await);
    // Its time runs out, or its process dies.
    let soon = Timestamp::now() + SignedDuration::from_millis(100);
    assert!(alive.acquire_lease(&key("late"), soon).await.unwrap());
    assert!(begins(&dying, "dying").await);
    eventually(async || begins(&other, "late").await.then_some(())).await;
    assert!(!begins(&other, "dying").await);
    drop(dying);
    eventually(async || begins(&other, "dying").await.then_some(())).await;
}

/// Waits for the news of a job.
async fn told(changes: &mut broadcast::Receiver<Uuid>, of: Uuid) {
    let waiting = async { while changes.recv().await.unwrap() != of {} };
    tokio::time::timeout(Duration::from_secs(20), waiting).await.unwrap();
}

#[tokio::test]
async fn every_process_hears_what_another_changes_from_the_moment_it_is_open() {
    let database = database().await;
    let one = database.open(long_lived()).await;
    let hook = webhook(&one).await;
    for _ in 0..5 {
        let other = database.open(long_lived()).await;
        let mut changes = other.changes();
        let mut queued = other.queued_deliveries();
        let mut keys = other.changed_keys().unwrap();
        let id = submit(&one, "m", b"frame").await;
        told(&mut changes, id).await;
        one.cancel(id).await.unwrap();
        told(&mut changes, id).await;
        let patience = Duration::from_secs(20);
        tokio::time::timeout(patience, queued.changed()).await.unwrap().unwrap();
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
        tokio::time::timeout(patience, keys.changed()).await.unwrap().unwrap();
        assert_eq!(other.keys().await.unwrap().len(), 1);
        queue_ping(&one, hook).await;
        tokio::time::timeout(patience, queued.changed()).await.unwrap().unwrap();
    }
}

#[tokio::test]
async fn a_map_whose_index_is_being_built_can_be_deleted() {
    let database = database().await;
    let tuning = Tuning { exact_up_to: 50, ..long_lived() };
    let store = database.open(tuning).await;
    for round in 0..3 {
        let (map, _) = store.put_map(map("m", 256)).await.unwrap();
        for number in 0..100_u32 {
            add(&store, &map, &number.to_string(), &number.to_le_bytes()).await;
        }
        // Sometimes before the building begins, sometimes in the middle of it, sometimes after.
        tokio::time::sleep(Duration::from_millis(400 * round)).await;
        assert!(store.delete_map(&map.name).await.unwrap());
    }
}

#[tokio::test]
async fn a_store_is_not_opened_before_its_schema_is_there() {
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
async fn the_schema_is_migrated_once_however_many_do_it() {
    let database = Database::empty(Pictures::Folder).await;
    let settings = database.settings(Tuning::default());
    let migrating = join_all((0..4).map(|_| migrate(&settings))).await;
    migrating.into_iter().for_each(|done| assert!(done.is_ok(), "{done:?}"));
    assert_eq!(migrate(&settings).await.unwrap(), 0);
    assert_eq!(schema_of(&settings).await.unwrap(), SchemaState::UpToDate);
    database.open(Tuning::default()).await;
}

#[tokio::test]
async fn a_schema_that_is_later_by_one_step_is_borne_and_by_more_refused() {
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
    // While servers are replaced one after another, the old ones may have to start again.
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
async fn right_after_the_database_was_started_everybody_counts_as_alive() {
    let database = database().await;
    let dying = database.open(Tuning::default()).await;
    submit(&dying, "m", b"frame").await;
    claim(&dying).await.unwrap();
    drop(dying);
    // To this one, the database was started a moment ago.
    let age = Duration::from_secs(24 * 3600);
    let other = database.open(Tuning { lifetime: age, ..Tuning::default() }).await;
    tokio::time::sleep(3 * SHORT_LIFE).await;
    assert!(claim(&other).await.is_none());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_limit_by_the_minute_is_that_of_all_processes() {
    let database = database().await;
    let processes = [database.open(long_lived()).await, database.open(long_lived()).await];
    // As good as nothing comes back while this runs.
    let draw = TokenRequest { per_minute: 0.01, required: 0.001, amount: 0.001 };
    let mut taken = 0;
    for number in 0..30 {
        let drawn = processes[number % 2]
            .take_tokens("key", [draw, TokenRequest::UNLIMITED])
            .await
            .unwrap();
        taken += usize::from(drawn.granted);
        assert!(drawn.granted || drawn.remaining[0] < 0.002);
    }
    assert!((9..=12).contains(&taken), "{taken}");
    // What is given back is there for others, and no more than a minute's worth.
    let back = TokenRequest { required: f64::MIN, amount: -1.0, ..draw };
    processes[0].take_tokens("key", [back, TokenRequest::UNLIMITED]).await.unwrap();
    let drawn = processes[1].take_tokens("key", [draw, TokenRequest::UNLIMITED]).await.unwrap();
    assert!(drawn.granted && drawn.remaining[0] < 0.01, "{drawn:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_budget_of_a_day_is_that_of_all_processes() {
    let database = database().await;
    let processes = [database.open(long_lived()).await, database.open(long_lived()).await];
    let (day, limit) = (date(2026, 5, 1), Spent { tokens: 1000, money: 0.0 });
    let tokens = |tokens| Spent { tokens, money: 0.0 };
    assert!(processes[0].reserve(day, tokens(600), limit).await.unwrap());
    assert!(!processes[1].reserve(day, tokens(600), limit).await.unwrap());
    // The call took 100 tokens: 500 go back, and the rest is spent when it is written down.
    SharedLimits::release(&processes[0], day, tokens(500)).await.unwrap();
    let usage = Usage { calls: 1, prompt_tokens: 80, completion_tokens: 20, ..Usage::default() };
    let spent = DayUsage { date: day, map: "m".parse().unwrap(), usage, money: 0.0 };
    processes[0].add_usage(spent).await.unwrap();
    assert!(!processes[1].reserve(day, tokens(901), limit).await.unwrap());
    assert!(processes[1].reserve(day, tokens(900), limit).await.unwrap());
    assert!(!processes[0].reserve(day, tokens(1), limit).await.unwrap());
    // Another day, and no limit at all.
    assert!(processes[0].reserve(date(2026, 5, 2), tokens(1000), limit).await.unwrap());
    assert!(processes[0].reserve(day, tokens(5000), tokens(0)).await.unwrap());
}
