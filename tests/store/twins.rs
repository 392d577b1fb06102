//! Equal images in the index of PostgreSQL, which has one of them.

use std::sync::Arc;

use futures_util::future::join_all;
use whereabouts_core::Map;
use whereabouts_index::SearchMode;
use whereabouts_store::MapStore;

use crate::processes::{database, long_lived};
use crate::support::{Tuning, add, descriptor, image, map, until};

/// Codes of a map's first table of descriptors whose images no index would find.
fn codes_without_a_first(map: &Map) -> String {
    let table = format!("descriptors_{}_0", map.uid.simple());
    format!(
        "SELECT count(*) FROM (SELECT FROM {table} GROUP BY descriptor_code(descriptor)
             HAVING bool_and(twin)) hidden"
    )
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn equal_images_that_come_and_go_at_once_leave_one_that_is_indexed() {
    const TASKS: usize = 8;
    let database = database().await;
    let store = Arc::new(database.open(Tuning { exact_up_to: 20, ..long_lived() }).await);
    let (map, _) = store.put_map(map("m", 32)).await.unwrap();
    for number in 0..30_u32 {
        add(&*store, &map, &number.to_string(), &number.to_le_bytes()).await;
    }
    until(async || store.index_state(&map).await.unwrap().graph).await;
    // Each task adds an image with one of two pictures and removes the one that it added before.
    let churn = (0..TASKS).map(|task| {
        let (store, map) = (store.clone(), map.clone());
        tokio::spawn(async move {
            for round in 0..25 {
                let picture = [b"one", b"two"][(task + round) % 2];
                add(&*store, &map, &format!("{task}-{round}"), picture).await;
                if round > 0 {
                    let id = format!("{task}-{}", round - 1).parse().unwrap();
                    assert!(store.delete_image(&map, &id).await.unwrap());
                }
            }
        })
    });
    for done in join_all(churn).await {
        done.unwrap();
    }
    assert_eq!(database.number(&codes_without_a_first(&map)).await, 0.0);
    let query = descriptor(&image("x", b"one"), 32);
    let found = store.search(&map, query, 3, SearchMode::Fast).await.unwrap();
    assert!(found.iter().all(|found| found.image_id.as_str().contains('-')), "{found:?}");
}

#[tokio::test]
async fn an_index_of_the_previous_version_is_replaced() {
    let database = database().await;
    let old = database.open(long_lived()).await;
    let (map, _) = old.put_map(map("m", 32)).await.unwrap();
    for number in 0..60_u32 {
        // Half of them are equal.
        let own = number.to_le_bytes();
        let picture = if number % 2 == 0 { b"same".as_slice() } else { &own };
        add(&old, &map, &number.to_string(), picture).await;
    }
    drop(old);
    let [table, graph] =
        ["descriptors", "graph"].map(|name| format!("{name}_{}_0", map.uid.simple()));
    let index = format!(
        "CREATE INDEX {graph} ON {table} USING hnsw ((descriptor::halfvec(32)) halfvec_cosine_ops)"
    );
    database.run(&index).await;
    database.run("UPDATE maps SET graph = true").await;
    let store = database.open(Tuning { exact_up_to: 20, ..long_lived() }).await;
    until(async || store.index_state(&map).await.unwrap().graph).await;
    let left = format!("SELECT count(*) FROM pg_class WHERE relname = '{graph}'");
    until(async || database.number(&left).await == 0.0).await;
    assert_eq!(
        database.number(&format!("SELECT count(*) FROM {table} WHERE NOT twin")).await,
        31.0
    );
    // Not even the removal of the first by a server of the previous version hides the others.
    database.run(&format!("DELETE FROM {table} WHERE NOT twin AND slot IN (SELECT slot FROM images WHERE id = '0')")).await;
    assert_eq!(database.number(&codes_without_a_first(&map)).await, 0.0);
    let query = descriptor(&image("x", b"same"), 32);
    let found = store.search(&map, query, 20, SearchMode::Fast).await.unwrap();
    assert_eq!(found.iter().filter(|found| found.similarity > 0.999).count(), 20);
}
