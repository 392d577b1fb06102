//! Search at scale and among many equal pictures, in both stores: the graphs of the embedded store in this process,
//! and pgvector through the store in PostgreSQL.
//!
//! `WHEREABOUTS_TEST_SHARED_BUFFERS=4GB tests/postgres.sh target/postgres-venv cargo bench --bench scale -- \
//! 10000 twins one-picture by-place standing`. A number is as many clustered vectors of 384 dimensions; the names are
//! those of [`sets`]. With `embedded` or `postgres` only that store is measured, and `embedded` needs no database. `ef=200`
//! examines 200 points in a search.
//!
//! *Recall* is of the ten nearest, against brute force; results that are as similar as the tenth best count. *Lost* are
//! images whose own descriptor finds neither them nor an equal one first.

mod embedded;
mod postgres;
mod sets;
#[path = "../vectors/mod.rs"]
mod vectors;

use std::time::Duration;

use anyhow::Context;
use whereabouts_index::IndexSettings;

const K: usize = 10;
/// The defaults, but for maps that are searched through a graph earlier.
const INDEX: IndexSettings = IndexSettings {
    exact_up_to: 1000,
    m: 16,
    ef_construction: 200,
    ef_search: 96,
    threads: 0,
    max_dead_share: 0.3,
    check_s: 0,
};

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> =
        std::env::args().skip(1).filter(|argument| !argument.starts_with("--")).collect();
    let ef = arguments.iter().find_map(|argument| argument.strip_prefix("ef="));
    let ef_search = ef.map_or(Ok(INDEX.ef_search), str::parse)?;
    let index = IndexSettings { ef_search, ..INDEX };
    let only = |store: &str| arguments.iter().any(|argument| argument == store);
    let is_name = |argument: &str| {
        !["embedded", "postgres"].contains(&argument) && !argument.starts_with("ef=")
    };
    let names = arguments.iter().filter(|argument| is_name(argument));
    let mut names: Vec<&str> = names.map(String::as_str).collect();
    if names.is_empty() {
        names = sets::ALL.to_vec();
    }
    for name in names {
        let name = name.to_owned();
        let set = tokio::task::spawn_blocking(move || sets::named(&name)).await??;
        if !only("postgres") {
            embedded::measure(&set, index)?;
        }
        if !only("embedded") {
            let url = std::env::var("WHEREABOUTS_TEST_DATABASE_URL")
                .context("run it through tests/postgres.sh, or with `embedded`")?;
            postgres::measure(&url, &set, index).await?;
        }
    }
    Ok(())
}

fn median(took: Vec<Duration>) -> Duration {
    percentile(took, 0.5)
}

fn percentile(mut took: Vec<Duration>, share: f64) -> Duration {
    took.sort();
    took[((took.len() - 1) as f64 * share) as usize]
}

fn ms(duration: Duration) -> f64 {
    duration.as_secs_f64() * 1e3
}
