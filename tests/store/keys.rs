//! API keys: kept, and replaced by others of the same id.

use jiff::Timestamp;
use whereabouts_core::{ApiKey, Digest, KeyLimits, Role, StoredKey};
use whereabouts_store::Store;

use crate::support::{Fixture, odd_texts};

contract!(a_key_is_kept_as_it_is_until_another_has_its_id);

fn key(id: &str, name: &str) -> StoredKey {
    let limits = KeyLimits { requests_per_minute: Some(u32::MAX), bytes_per_minute: Some(1 << 40) };
    let key = ApiKey {
        id: id.into(),
        name: name.into(),
        role: Role::Robot,
        maps: vec!["yard".parse().unwrap()],
        limits,
        created_at: Timestamp::now(),
        expires_at: Some(Timestamp::now()),
        revoked_at: None,
    };
    StoredKey { key, digest: Digest::of(id.as_bytes()) }
}

async fn a_key_is_kept_as_it_is_until_another_has_its_id(fixture: &Fixture) {
    let store = fixture.open().await;
    assert!(store.keys().await.unwrap().is_empty());
    let mut keys: Vec<_> =
        odd_texts().iter().zip(1..).map(|(name, id)| key(&format!("key {id}"), name)).collect();
    for key in &keys {
        store.put_key(key.clone()).await.unwrap();
    }
    keys[1].key.revoked_at = Some(Timestamp::now());
    store.put_key(keys[1].clone()).await.unwrap();
    let sorted = async |store: &dyn Store| {
        let mut keys = store.keys().await.unwrap();
        keys.sort_by(|a, b| a.key.id.cmp(&b.key.id));
        keys
    };
    assert_eq!(sorted(&*store).await, keys);
    drop(store);
    let store = fixture.open().await;
    assert_eq!(sorted(&*store).await, keys);
}
