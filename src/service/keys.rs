//! API keys: create, list, revoke and authenticate. How often a key may be used is for `limits`, what its role
//! may do for the server.

use std::collections::HashMap;
use std::sync::{Arc, Weak};
use std::time::Duration;

use jiff::{SignedDuration, Timestamp};
use parking_lot::{RwLock, RwLockReadGuard};
use ring::rand::{SecureRandom, SystemRandom};
use tokio::sync::watch;

use super::ServiceError;
use super::limits::Limits;
use whereabouts_api::{ErrorKind, MadeKey, NewKey};
use whereabouts_core::{ApiKey, Digest, MapName, StoredKey, Token};
use whereabouts_store::{KeyStore, StoreError};

/// Maximum number of keys, revoked ones included: all are held in memory.
const MAX_KEYS: usize = 10_000;

/// Maximum limit in bytes: the largest integer of a structured header field (RFC 9651).
const MAX_BYTES_PER_MINUTE: u64 = 999_999_999_999_999;

/// Longest sleep until a key's expiry is checked again: timers cannot sleep for years.
const MAX_EXPIRY_SLEEP: Duration = Duration::from_secs(3600);

/// Pause before changed keys that could not be read are read again.
const RELOAD_PAUSE: Duration = Duration::from_secs(1);

/// Maximum length of the name of a key, in bytes.
const MAX_NAME_BYTES: usize = 100;

/// The caller of a request.
#[derive(Debug, Clone)]
pub enum Principal {
    /// Keys are off: every caller has full access.
    Anonymous,
    /// A caller that was authenticated by this key.
    ApiKey(Arc<ApiKey>),
}

impl Principal {
    /// Namespace of what is kept for the caller (tracks, idempotency keys): the id of its key.
    pub fn scope(&self) -> &str {
        match self {
            Self::Anonymous => "-",
            Self::ApiKey(key) => &key.id,
        }
    }

    /// Whether the caller may use the map.
    pub fn may_use(&self, map: &MapName) -> bool {
        match self {
            Self::Anonymous => true,
            Self::ApiKey(key) => key.may_use(map),
        }
    }

    /// Whether the caller may use all maps.
    pub fn may_use_all(&self) -> bool {
        match self {
            Self::Anonymous => true,
            Self::ApiKey(key) => key.maps.is_empty(),
        }
    }

    /// A `Forbidden` error if the caller may not use the map.
    pub fn check_map(&self, map: &MapName) -> Result<(), ServiceError> {
        match self.may_use(map) {
            true => Ok(()),
            false => Err(ServiceError::new(
                ErrorKind::Forbidden,
                format!("this key has no access to the map {map}; ask an admin for another key"),
            )),
        }
    }
}

/// All API keys, in memory and in the store.
pub struct Keys {
    store: Arc<dyn KeyStore>,
    known: Arc<KeysById>,
    /// Notified when a key was revoked.
    revoked: Arc<watch::Sender<()>>,
    /// The rate limits of the keys.
    pub limits: Limits,
}

impl Keys {
    /// Loads the keys of a store, and keeps up with changes by other processes.
    pub async fn load(store: Arc<dyn KeyStore>) -> Result<Self, ServiceError> {
        // Subscribed before the keys are read, so that no change is missed.
        let changed = store.changed_keys();
        let known = Arc::new(RwLock::new(read_all(store.as_ref()).await?));
        let revoked = Arc::new(watch::Sender::new(()));
        if let Some(changed) = changed {
            let (known, revoked) = (Arc::downgrade(&known), Arc::clone(&revoked));
            tokio::spawn(reload_on_change(Arc::clone(&store), known, revoked, changed));
        }
        Ok(Self { store, known, revoked, limits: Limits::default() })
    }

    /// Creates a key. Only the returned value contains its token; the store has a digest.
    pub async fn create(&self, new: NewKey) -> Result<MadeKey, ServiceError> {
        let NewKey { name, role, mut maps, limits, expires_days } = new;
        let printable = !name.chars().any(char::is_control);
        if !(1..=MAX_NAME_BYTES).contains(&name.trim().len()) || !printable {
            let detail = format!("a key's name must have 1 to {MAX_NAME_BYTES} printable bytes");
            return Err(ServiceError::unprocessable(detail));
        }
        if limits.requests_per_minute == Some(0) || limits.bytes_per_minute == Some(0) {
            let detail =
                "a limit of 0 allows nothing; revoke the key instead, or leave the limit out";
            return Err(ServiceError::unprocessable(detail));
        }
        if limits.bytes_per_minute.is_some_and(|bytes| bytes > MAX_BYTES_PER_MINUTE) {
            let detail = format!(
                "bytes_per_minute must be at most {MAX_BYTES_PER_MINUTE}; leave it out for no limit"
            );
            return Err(ServiceError::unprocessable(detail));
        }
        if expires_days.is_some_and(|days| !(1..=36_500).contains(&days)) {
            return Err(ServiceError::unprocessable("expires_days must be 1 to 36500"));
        }
        if self.read().len() >= MAX_KEYS {
            let detail =
                format!("there are {MAX_KEYS} keys, revoked ones included, which is the maximum");
            return Err(ServiceError::new(ErrorKind::Conflict, detail));
        }
        maps.sort();
        maps.dedup();
        let token = random_token()?;
        let created_at = Timestamp::now();
        let expires_at = expires_days
            .map(|days| created_at.checked_add(SignedDuration::from_hours(i64::from(days) * 24)))
            .transpose()
            .map_err(|error| ServiceError::unprocessable(format!("expires_days: {error}")))?;
        let key = ApiKey {
            id: token.id().to_owned(),
            name: name.trim().to_owned(),
            role,
            maps,
            limits,
            created_at,
            expires_at,
            revoked_at: None,
        };
        self.persist(StoredKey { key: key.clone(), digest: token.digest() }).await?;
        tracing::info!(target: "audit", made = %key.id, name = %key.name, role = %key.role, "a key was made");
        Ok(MadeKey { token: token.reveal().to_owned(), key })
    }

    /// Returns all keys, newest first.
    pub fn list(&self) -> Vec<ApiKey> {
        let mut keys: Vec<_> = self.read().values().map(|stored| stored.key.clone()).collect();
        keys.sort_by(|a, b| b.created_at.cmp(&a.created_at).then_with(|| a.id.cmp(&b.id)));
        keys
    }

    /// Revokes a key for good; it is not accepted once this returns. `id` may be the id or the whole token.
    pub async fn revoke(&self, id: &str) -> Result<ApiKey, ServiceError> {
        let known = Token::id_of(id).and_then(|id| self.read().get(id).cloned());
        let Some(mut stored) = known else {
            let detail = "there is no such key; `whereabouts keys list` lists all keys";
            return Err(ServiceError::new(ErrorKind::NotFound, detail));
        };
        if stored.key.revoked_at.is_none() {
            stored.key.revoked_at = Some(Timestamp::now());
            self.persist(stored.clone()).await?;
            self.revoked.send_replace(());
            tracing::info!(target: "audit", revoked = %stored.key.id, "a key was revoked");
        }
        Ok(stored.key)
    }

    /// Whether any key is valid now.
    pub fn any_valid(&self) -> bool {
        let now = Timestamp::now();
        self.read().values().any(|stored| stored.key.is_valid(now))
    }

    /// Waits until the key of a caller is revoked or expires; never returns for an anonymous caller.
    pub async fn ended(&self, caller: Principal) {
        let Principal::ApiKey(key) = caller else { return std::future::pending().await };
        let mut revoked = self.revoked.subscribe();
        loop {
            let now = Timestamp::now();
            if self.read().get(&key.id).is_none_or(|stored| !stored.key.is_valid(now)) {
                return;
            }
            let left = key.expires_at.map(|end| end.duration_since(now).unsigned_abs());
            tokio::select! {
                _ = revoked.changed() => {}
                () = tokio::time::sleep(left.unwrap_or(Duration::MAX).min(MAX_EXPIRY_SLEEP)) => {}
            }
        }
    }

    /// Authenticates a token.
    pub fn authenticate(&self, token: &Token) -> Result<Arc<ApiKey>, ServiceError> {
        let known = self.read().get(token.id()).cloned();
        // An unknown id takes as long as a known one, so that the time does not tell them apart.
        let is_match = match &known {
            Some(stored) => stored.matches(token),
            None => token.digest() == Digest::of(b""),
        };
        match known.filter(|_| is_match) {
            None => Err(ServiceError::new(ErrorKind::Unauthorized, "the key is unknown")),
            Some(StoredKey { key, .. }) if key.is_valid(Timestamp::now()) => Ok(Arc::new(key)),
            Some(StoredKey { key, .. }) => {
                let why = if key.revoked_at.is_some() { "was revoked" } else { "has expired" };
                let detail = format!("the key {} {why}; ask an admin for another", key.id);
                Err(ServiceError::new(ErrorKind::Unauthorized, detail))
            }
        }
    }

    /// Writes a key to the store and then to memory, even if the future is dropped in between.
    async fn persist(&self, stored: StoredKey) -> Result<(), ServiceError> {
        let (store, known) = (Arc::clone(&self.store), Arc::clone(&self.known));
        let keeping = tokio::spawn(async move {
            store.put_key(stored.clone()).await?;
            let mut known = known.write();
            known.insert(stored.key.id.clone(), stored);
            Ok(())
        });
        keeping.await.unwrap_or_else(|_| {
            Err(ServiceError::new(ErrorKind::Internal, "the key could not be stored"))
        })
    }

    fn read(&self) -> RwLockReadGuard<'_, HashMap<String, StoredKey>> {
        self.known.read()
    }
}

type KeysById = RwLock<HashMap<String, StoredKey>>;

async fn read_all(store: &dyn KeyStore) -> Result<HashMap<String, StoredKey>, StoreError> {
    let known = store.keys().await?;
    Ok(known.into_iter().map(|stored| (stored.key.id.clone(), stored)).collect())
}

/// Reloads the keys whenever another process has changed some, until the [`Keys`] are dropped.
async fn reload_on_change(
    store: Arc<dyn KeyStore>,
    known: Weak<KeysById>,
    revoked: Arc<watch::Sender<()>>,
    mut changed: watch::Receiver<()>,
) {
    while changed.changed().await.is_ok() {
        loop {
            let Some(known) = known.upgrade() else { return };
            match read_all(store.as_ref()).await {
                Ok(now) => {
                    *known.write() = now;
                    revoked.send_replace(());
                    break;
                }
                Err(error) => {
                    tracing::warn!(%error, "changed keys could not be read; trying again");
                    tokio::time::sleep(RELOAD_PAUSE).await;
                }
            }
        }
    }
}

fn random_token() -> Result<Token, ServiceError> {
    Ok(Token::new(&random("key")?))
}

/// Random bytes for a new key or webhook, which is named in the error.
pub(super) fn random<const N: usize>(of: &str) -> Result<[u8; N], ServiceError> {
    let mut random = [0; N];
    SystemRandom::new().fill(&mut random).map_err(|_| {
        let detail = format!("the system has no random numbers; the {of} was not created");
        ServiceError::new(ErrorKind::Internal, detail)
    })?;
    Ok(random)
}

#[cfg(test)]
mod tests {
    use super::*;
    use async_trait::async_trait;
    use parking_lot::Mutex;
    use whereabouts_core::{KeyLimits, Role};

    #[derive(Default)]
    struct InMemoryKeys(Mutex<Vec<StoredKey>>);

    #[async_trait]
    impl KeyStore for InMemoryKeys {
        async fn put_key(&self, key: StoredKey) -> Result<(), StoreError> {
            let mut kept = self.0.lock();
            kept.retain(|other| other.key.id != key.key.id);
            kept.push(key);
            Ok(())
        }

        async fn keys(&self) -> Result<Vec<StoredKey>, StoreError> {
            Ok(self.0.lock().clone())
        }
    }

    fn new_key(role: Role, limits: KeyLimits) -> NewKey {
        NewKey { name: "n".into(), role, maps: Vec::new(), limits, expires_days: Some(1) }
    }

    #[tokio::test]
    async fn a_token_authenticates_until_its_key_is_revoked_and_across_restarts() {
        let store = Arc::new(InMemoryKeys::default());
        let keys = Keys::load(store.clone()).await.unwrap();
        assert!(!keys.any_valid());
        let made = keys.create(new_key(Role::Robot, KeyLimits::default())).await.unwrap();
        let token: Token = made.token.parse().unwrap();
        assert_eq!(keys.authenticate(&token).unwrap().id, made.key.id);
        let kept = serde_json::to_string(&*store.0.lock()).unwrap();
        assert!(!kept.contains(&made.token[17..]), "the secret is stored");

        let mut other = made.token.clone();
        other.replace_range(80..81, if made.token.ends_with('0') { "1" } else { "0" });
        assert!(keys.authenticate(&other.parse().unwrap()).is_err());
        let again = Keys::load(store).await.unwrap();
        assert!(again.any_valid() && again.authenticate(&token).is_ok());
        again.revoke(&made.key.id).await.unwrap();
        assert!(again.authenticate(&token).unwrap_err().detail.contains("revoked"));
        assert!(!again.any_valid());
        assert_eq!(again.revoke("000000000000").await.unwrap_err().kind, ErrorKind::NotFound);
    }

    #[tokio::test]
    async fn a_used_up_limit_rejects_with_the_time_until_a_retry_succeeds() {
        let keys = Keys::load(Arc::new(InMemoryKeys::default())).await.unwrap();
        let limits = KeyLimits { requests_per_minute: Some(3), bytes_per_minute: Some(1000) };
        let key = keys.create(new_key(Role::Robot, limits)).await.unwrap().key;
        for remaining in [2, 1, 0] {
            let (allowances, result) = keys.limits.take_request(&key).await;
            result.unwrap();
            assert_eq!(allowances.requests.unwrap().remaining, remaining);
        }
        let refused = keys.limits.take_request(&key).await.1.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Overloaded);
        let pause = refused.retry_after.unwrap().as_secs_f64();
        assert!((15.0..=20.0).contains(&pause), "{pause}");

        let limits = KeyLimits { requests_per_minute: None, ..limits };
        let key = keys.create(new_key(Role::Robot, limits)).await.unwrap().key;
        keys.limits.take_request(&key).await.1.unwrap();
        keys.limits.take_bytes(&key, 3000).await;
        let (allowances, refused) = keys.limits.take_request(&key).await;
        assert_eq!(allowances.bytes.unwrap().remaining, 0);
        let pause = refused.unwrap_err().retry_after.unwrap().as_secs_f64();
        assert!((115.0..=121.0).contains(&pause), "{pause}");
    }

    #[tokio::test]
    async fn a_key_with_invalid_attributes_is_unprocessable() {
        let keys = Keys::load(Arc::new(InMemoryKeys::default())).await.unwrap();
        let valid = new_key(Role::Admin, KeyLimits::default());
        for bad in [
            NewKey { name: " ".into(), ..valid.clone() },
            NewKey { name: "a\nb".into(), ..valid.clone() },
            NewKey { name: "n".repeat(101), ..valid.clone() },
            NewKey { expires_days: Some(0), ..valid.clone() },
            NewKey {
                limits: KeyLimits { requests_per_minute: Some(0), bytes_per_minute: None },
                ..valid.clone()
            },
        ] {
            assert_eq!(keys.create(bad).await.unwrap_err().kind, ErrorKind::Unprocessable);
        }
    }
}
