//! The store of the servers under test: the embedded one, or with `WHEREABOUTS_TEST_DEPLOYMENT=scale-out` a
//! database each in the PostgreSQL of `WHEREABOUTS_TEST_DATABASE_URL` (`tests/postgres.sh` starts one), and
//! a prefix each in the object store of `WHEREABOUTS_TEST_S3` (`tests/s3.sh`) or, without it, the data folder.
//!
//! The database is derived from the data folder, so that a restarted server finds its records.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::Path;
use std::process::Command;
use std::str::FromStr;
use std::sync::OnceLock;

use sqlx::postgres::{PgConnectOptions, PgConnection};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection};

use crate::server::BINARY;

/// Whether the servers share a database and an object store.
pub fn is_scale_out() -> bool {
    match std::env::var("WHEREABOUTS_TEST_DEPLOYMENT").as_deref() {
        Err(_) | Ok("embedded") => false,
        Ok("scale-out") => true,
        Ok(other) => {
            panic!("WHEREABOUTS_TEST_DEPLOYMENT is {other:?}, neither embedded nor scale-out")
        }
    }
}

/// The settings of a server with this data folder.
pub fn settings(data: &Path) -> Vec<(String, String)> {
    if !is_scale_out() {
        return Vec::new();
    }
    let name = database_of(data);
    let mut settings = vec![
        ("WHEREABOUTS_DATABASE__URL".to_owned(), address(&name)),
        ("WHEREABOUTS_DATABASE__MAX_CONNECTIONS".to_owned(), "6".to_owned()),
    ];
    if let Ok(endpoint) = std::env::var("WHEREABOUTS_TEST_S3") {
        for (key, value) in [
            ("URL", format!("s3://whereabouts-test/{name}")),
            ("ENDPOINT", endpoint),
            ("REGION", "us-east-1".to_owned()),
            ("ALLOW_HTTP", "true".to_owned()),
        ] {
            settings.push((format!("WHEREABOUTS_OBJECTS__{key}"), value));
        }
    }
    settings
}

/// The number of descriptor tables of a server with this data folder.
pub fn descriptor_tables(data: &Path) -> usize {
    on_server(&database_of(data), async |connection| {
        let count =
            "SELECT count(*) FROM pg_class WHERE relkind = 'r' AND relname LIKE 'descriptors\\_%'";
        let count: i64 = sqlx::query_scalar(count).fetch_one(connection).await.unwrap();
        count as usize
    })
}

/// The database of a data folder, created at the first call.
fn database_of(data: &Path) -> String {
    static TEMPLATE: OnceLock<String> = OnceLock::new();
    let template = TEMPLATE.get_or_init(|| {
        let name = format!("template_{}", std::process::id());
        make(&name, None);
        let migrated = Command::new(&*BINARY)
            .arg("migrate")
            .env("WHEREABOUTS_DATABASE__URL", address(&name))
            .output()
            .unwrap();
        assert!(migrated.status.success(), "{migrated:?}");
        name
    });
    let mut hasher = DefaultHasher::new();
    (data, std::process::id()).hash(&mut hasher);
    let name = format!("test_{:016x}", hasher.finish());
    make(&name, Some(template));
    name
}

fn server() -> PgConnectOptions {
    let url = std::env::var("WHEREABOUTS_TEST_DATABASE_URL").expect(
        "there is no PostgreSQL to test with: run `make test`, or set WHEREABOUTS_TEST_DATABASE_URL",
    );
    PgConnectOptions::from_str(&url).unwrap()
}

fn address(database: &str) -> String {
    server().database(database).to_url_lossy().to_string()
}

/// Creates a database unless it exists.
fn make(name: &str, template: Option<&str>) {
    let from = template.map(|name| format!(" TEMPLATE {name}")).unwrap_or_default();
    let sql = format!("CREATE DATABASE {name}{from}");
    on_server("postgres", async |connection| {
        let there = sqlx::query("SELECT FROM pg_database WHERE datname = $1").bind(name);
        if there.fetch_optional(&mut *connection).await.unwrap().is_some() {
            return;
        }
        // A template cannot be copied concurrently.
        sqlx::query("SELECT pg_advisory_lock(1)").execute(&mut *connection).await.unwrap();
        sqlx::query(AssertSqlSafe(sql)).execute(connection).await.unwrap();
    });
}

/// Runs queries in a database of the server, on a thread of its own: the runtime of a test must not be blocked.
fn on_server<T: Send>(database: &str, ask: impl AsyncFnOnce(&mut PgConnection) -> T + Send) -> T {
    let asking = || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let options = server().database(database);
            let mut connection = PgConnection::connect_with(&options).await.unwrap();
            ask(&mut connection).await
        })
    };
    std::thread::scope(|scope| scope.spawn(asking).join().unwrap())
}
