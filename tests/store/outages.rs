//! A database and an object store that are unreachable, hanging, or back again.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::future::join_all;
use jiff::{SignedDuration, Timestamp};
use sqlx::ConnectOptions;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio_util::sync::{CancellationToken, DropGuard};
use uuid::Uuid;
use whereabouts_core::Digest;
use whereabouts_store::postgres::{PostgresSettings, PostgresStore, migrate};
use whereabouts_store::{BlobStore, JobStore, MapStore, Store, StoreError};

use crate::support::{Database, Pictures, Tuning, eventually, map, record, s3, submit};

/// A proxy between the store and a server that can hold back bytes and cut connections.
struct Wire {
    address: SocketAddr,
    /// Current and future connections.
    now: Mutex<Connections>,
    _end: DropGuard,
}

#[derive(Clone)]
struct Connections {
    /// Whether bytes are forwarded.
    flow: watch::Sender<bool>,
    /// Ends them.
    cut: CancellationToken,
}

impl Connections {
    fn new() -> Self {
        Self { flow: watch::Sender::new(true), cut: CancellationToken::new() }
    }
}

impl Wire {
    async fn to(host: String, port: u16) -> Arc<Self> {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let end = CancellationToken::new();
        let (now, _end) = (Mutex::new(Connections::new()), end.clone().drop_guard());
        let wire = Arc::new(Self { address, now, _end });
        let weak = Arc::downgrade(&wire);
        tokio::spawn(end.run_until_cancelled_owned(async move {
            loop {
                let (inside, _) = listener.accept().await.unwrap();
                let Some(wire) = weak.upgrade() else { return };
                let Connections { flow, cut } = wire.now.lock().unwrap().clone();
                let host = host.clone();
                tokio::spawn(cut.run_until_cancelled_owned(async move {
                    let outside = TcpStream::connect((host.as_str(), port)).await.unwrap();
                    let (inside, outside) = (inside.into_split(), outside.into_split());
                    tokio::join!(
                        carry(inside.0, outside.1, &flow),
                        carry(outside.0, inside.1, &flow)
                    );
                }));
            }
        }));
        wire
    }

    /// From now on no bytes are forwarded, and no connection is closed.
    fn freeze(&self) {
        self.now.lock().unwrap().flow.send_replace(false);
    }

    fn thaw(&self) {
        self.now.lock().unwrap().flow.send_replace(true);
    }

    /// Later connections are forwarded; current ones stay as they are.
    fn abandon(&self) {
        *self.now.lock().unwrap() = Connections::new();
    }

    /// Cuts the current connections; later ones are forwarded.
    fn cut(&self) {
        std::mem::replace(&mut *self.now.lock().unwrap(), Connections::new()).cut.cancel();
    }
}

async fn carry(mut from: OwnedReadHalf, mut to: OwnedWriteHalf, flow: &watch::Sender<bool>) {
    let (mut flow, mut buffer) = (flow.subscribe(), vec![0; 1 << 16]);
    while let Ok(count) = from.read(&mut buffer).await
        && count > 0
        && flow.wait_for(|flow| *flow).await.is_ok()
        && to.write_all(&buffer[..count]).await.is_ok()
    {}
    let _ = to.shutdown().await;
}

const TIMEOUT: Duration = Duration::from_millis(700);

/// Long enough for a busy machine.
const SOON: Duration = Duration::from_millis(700 + 1500);

fn hasty() -> Tuning {
    Tuning { timeout: TIMEOUT, lifetime: Duration::from_secs(60), ..Tuning::default() }
}

/// A store that reaches its database through the proxy.
async fn wired(database: &Database) -> (Arc<Wire>, PostgresStore) {
    let options = database.options();
    let wire = Wire::to(options.get_host().to_owned(), options.get_port()).await;
    let settings = settings_at(database, wire.address);
    let store = PostgresStore::open(settings, database.objects(), Uuid::now_v7()).await.unwrap();
    (wire, store)
}

fn settings_at(database: &Database, address: SocketAddr) -> PostgresSettings {
    let options = database.options().host(&address.ip().to_string()).port(address.port());
    PostgresSettings { url: options.to_url_lossy().to_string(), ..database.settings(hasty()) }
}

/// Asserts that every kind of call reports within the timeout that the database is unavailable.
async fn is_away(store: &PostgresStore) {
    let (now, began) = (Timestamp::now(), Instant::now());
    let lease = now + SignedDuration::from_secs(60);
    let name = "m".parse().unwrap();
    let frame = Bytes::from_static(b"frame");
    let (maps, map, put, claimed, submitted, queued, pinned) = tokio::join!(
        store.maps(),
        store.map(&name),
        store.put_map(map("other", 3)),
        store.claim(now, lease),
        store.submit(record("m", b"frame"), 1000),
        store.queued(),
        store.put_blob(Digest::of(b"frame"), frame),
    );
    for answer in [
        maps.map(drop),
        map.map(drop),
        put.map(drop),
        claimed.map(drop),
        submitted,
        queued.map(drop),
        pinned.map(drop),
    ] {
        let error = answer.unwrap_err();
        assert!(matches!(error, StoreError::Unavailable(_)), "{error:?}");
    }
    assert!(began.elapsed() < SOON, "{:?}", began.elapsed());
}

/// Waits until calls succeed and notifications arrive again.
async fn is_back(store: &PostgresStore, direct: &dyn Store) {
    eventually(async || store.maps().await.ok()).await;
    // As many concurrent calls as there are connections.
    let asking = || join_all((0..16).map(|_| store.maps()));
    eventually(async || asking().await.into_iter().all(|maps| maps.is_ok()).then_some(())).await;
    let mut changes = store.changes();
    eventually(async || {
        let id = submit(direct, "m", b"frame").await;
        let notified = async { while changes.recv().await.unwrap() != id {} };
        tokio::time::timeout(Duration::from_millis(500), notified).await.ok()
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hanging_database_is_unavailable_within_the_timeout_and_recovers() {
    let database = Database::migrated(Pictures::Folder).await;
    let direct = database.open(Tuning::default()).await;
    let (wire, store) = wired(&database).await;
    submit(&store, "m", b"frame").await;
    for _ in 0..2 {
        wire.freeze();
        is_away(&store).await;
        is_away(&store).await;
        wire.thaw();
        is_back(&store, &direct).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn connections_that_died_silently_are_replaced() {
    let database = Database::migrated(Pictures::Folder).await;
    let direct = database.open(Tuning::default()).await;
    let (wire, store) = wired(&database).await;
    submit(&store, "m", b"frame").await;
    wire.freeze();
    is_away(&store).await;
    wire.abandon();
    is_back(&store, &direct).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_broken_connection_to_the_database_is_opened_again() {
    let database = Database::migrated(Pictures::Folder).await;
    let direct = database.open(Tuning::default()).await;
    let (wire, store) = wired(&database).await;
    let mut changes = store.changes();
    submit(&store, "m", b"frame").await;
    wire.cut();
    // A change that was missed while the listener was away is notified afterwards.
    let id = submit(&direct, "m", b"frame").await;
    let notified = async { while changes.recv().await.unwrap() != id {} };
    tokio::time::timeout(Duration::from_secs(20), notified).await.unwrap();
    is_back(&store, &direct).await;
}

/// An address without a listener.
async fn unused_address() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap()
}

#[tokio::test]
async fn an_absent_database_is_unavailable_within_the_timeout() {
    let database = Database::empty(Pictures::Folder).await;
    let settings = settings_at(&database, unused_address().await);
    let began = Instant::now();
    let opened = PostgresStore::open(settings.clone(), database.objects(), Uuid::now_v7()).await;
    for error in [opened.err().unwrap(), migrate(&settings).await.unwrap_err()] {
        assert!(matches!(error, StoreError::Unavailable(_)), "{error:?}");
    }
    assert!(began.elapsed() < 2 * SOON, "{:?}", began.elapsed());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_absent_object_store_is_unavailable_within_the_timeout() {
    let database = Database::migrated(Pictures::Folder).await;
    // An address without a listener, and one that never answers.
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    for address in [unused_address().await, silent.local_addr().unwrap()] {
        let objects = s3("away", &format!("http://{address}"), TIMEOUT);
        let settings = database.settings(hasty());
        let store = PostgresStore::open(settings, objects, Uuid::now_v7()).await.unwrap();
        let (digest, bytes) = (Digest::of(b"frame"), Bytes::from_static(b"frame"));
        for _ in 0..2 {
            let began = Instant::now();
            let (put, got) =
                tokio::join!(store.put_blob(digest, bytes.clone()), store.blob(&digest));
            for error in [put.err().unwrap(), got.unwrap_err()] {
                assert!(matches!(error, StoreError::Unavailable(_)), "{error:?}");
            }
            assert!(began.elapsed() < SOON, "{:?}", began.elapsed());
        }
        // The rest of the store works.
        store.put_map(map("m", 3)).await.unwrap();
        assert!(store.delete_map(&"m".parse().unwrap()).await.unwrap());
    }
}
