//! API keys: making, listing and revoking them, and who a token belongs to.

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

/// The most keys, revoked ones included: they are all held in memory.
const MOST_KEYS: usize = 10_000;

/// The largest limit in bytes: the largest whole number of a structured header field (RFC 9651).
const MOST_BYTES: u64 = 999_999_999_999_999;

/// How long it is waited at a time for a key to expire.
const LONGEST_SLEEP: Duration = Duration::from_secs(3600);

/// The pause before keys that changed and cannot be read are read again.
const READ_AGAIN: Duration = Duration::from_secs(1);

/// The longest name of a key, in bytes.
const MOST_NAME_BYTES: usize = 100;

/// Who asks.
#[derive(Debug, Clone)]
pub enum Principal {
    /// Keys are off: everybody may do everything.
    Anonymous,
    /// The holder of a key.
    ApiKey(Arc<ApiKey>),
}

impl Principal {
    /// A name for the caller, under which what is kept for one is not seen by another.
    pub fn scope(&self) -> &str {
        match self {
            Self::Anonymous => "-",
            Self::ApiKey(key) => &key.id,
        }
    }

    /// Whether the caller may use that map.
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

    /// Refuses a map that the caller may not use.
    pub fn check_map(&self, map: &MapName) -> Result<(), ServiceError> {
        match self.may_use(map) {
            true => Ok(()),
            false => Err(ServiceError::new(
                ErrorKind::Forbidden,
                format!("this key is not for the map {map}; ask an admin for another key"),
            )),
        }
    }
}

/// All keys, and what each may still ask for.
pub struct Keys {
    store: Arc<dyn KeyStore>,
    known: Arc<Known>,
    /// Told when a key was revoked.
    revoked: Arc<watch::Sender<()>>,
    /// How much each may ask for.
    pub limits: Limits,
}

impl Keys {
    /// The keys of a store.
    pub async fn load(store: Arc<dyn KeyStore>) -> Result<Self, ServiceError> {
        // Before they are read, so that no change is missed.
        let changed = store.changed_keys();
        let known = Arc::new(RwLock::new(read_all(store.as_ref()).await?));
        let revoked = Arc::new(watch::Sender::new(()));
        if let Some(changed) = changed {
            let (known, revoked) = (Arc::downgrade(&known), Arc::clone(&revoked));
            tokio::spawn(keep_up(Arc::clone(&store), known, revoked, changed));
        }
        Ok(Self { store, known, revoked, limits: Limits::default() })
    }

    /// Makes a key. What comes back is the only place where its token is.
    pub async fn create(&self, wanted: NewKey) -> Result<MadeKey, ServiceError> {
        let NewKey { name, role, mut maps, limits, expires_days } = wanted;
        let printable = !name.chars().any(char::is_control);
        if !(1..=MOST_NAME_BYTES).contains(&name.trim().len()) || !printable {
            let detail = format!("a key's name must have 1 to {MOST_NAME_BYTES} printable bytes");
            return Err(ServiceError::unprocessable(detail));
        }
        if limits.requests_per_minute == Some(0) || limits.bytes_per_minute == Some(0) {
            let detail =
                "a limit of 0 allows nothing; revoke the key instead, or leave the limit out";
            return Err(ServiceError::unprocessable(detail));
        }
        if limits.bytes_per_minute.is_some_and(|bytes| bytes > MOST_BYTES) {
            let detail =
                format!("bytes_per_minute must be at most {MOST_BYTES}; leave it out for no bound");
            return Err(ServiceError::unprocessable(detail));
        }
        if expires_days.is_some_and(|days| !(1..=36_500).contains(&days)) {
            return Err(ServiceError::unprocessable("expires_days must be 1 to 36500"));
        }
        if self.read().len() >= MOST_KEYS {
            let detail = format!("there are {MOST_KEYS} keys, revoked ones included: the most");
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
        self.keep(StoredKey { key: key.clone(), digest: token.digest() }).await?;
        tracing::info!(target: "audit", made = %key.id, name = %key.name, role = %key.role, "a key was made");
        Ok(MadeKey { token: token.reveal().to_owned(), key })
    }

    /// All keys, the newest first.
    pub fn list(&self) -> Vec<ApiKey> {
        let mut keys: Vec<_> = self.read().values().map(|stored| stored.key.clone()).collect();
        keys.sort_by(|a, b| b.created_at.cmp(&a.created_at).then_with(|| a.id.cmp(&b.id)));
        keys
    }

    /// Ends a key for good; from the moment this returns nobody gets in with it. `id` may be the whole key.
    pub async fn revoke(&self, id: &str) -> Result<ApiKey, ServiceError> {
        let known = Token::id_of(id).and_then(|id| self.read().get(id).cloned());
        let Some(mut stored) = known else {
            let detail = "there is no such key; `whereabouts keys list` shows those there are";
            return Err(ServiceError::new(ErrorKind::NotFound, detail));
        };
        if stored.key.revoked_at.is_none() {
            stored.key.revoked_at = Some(Timestamp::now());
            self.keep(stored.clone()).await?;
            self.revoked.send_replace(());
            tracing::info!(target: "audit", revoked = %stored.key.id, "a key was revoked");
        }
        Ok(stored.key)
    }

    /// Whether there is a key that lets somebody in.
    pub fn any_valid(&self) -> bool {
        let now = Timestamp::now();
        self.read().values().any(|stored| stored.key.is_valid(now))
    }

    /// Returns when a caller may ask no more: the key was revoked, or has expired.
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
                () = tokio::time::sleep(left.unwrap_or(Duration::MAX).min(LONGEST_SLEEP)) => {}
            }
        }
    }

    /// Whose token this is.
    pub fn holder(&self, token: &Token) -> Result<Arc<ApiKey>, ServiceError> {
        let known = self.read().get(token.id()).cloned();
        // An id that is unknown takes as long as one that is known.
        let is_right = match &known {
            Some(stored) => stored.matches(token),
            None => token.digest() == Digest::of(b""),
        };
        match known.filter(|_| is_right) {
            None => Err(ServiceError::new(ErrorKind::Unauthorized, "the key is unknown")),
            Some(StoredKey { key, .. }) if key.is_valid(Timestamp::now()) => Ok(Arc::new(key)),
            Some(StoredKey { key, .. }) => {
                let why = if key.revoked_at.is_some() { "was revoked" } else { "has expired" };
                let detail = format!("the key {} {why}; ask an admin for another", key.id);
                Err(ServiceError::new(ErrorKind::Unauthorized, detail))
            }
        }
    }

    /// Stores a key, and knows it; both, though the caller has gone meanwhile.
    async fn keep(&self, stored: StoredKey) -> Result<(), ServiceError> {
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

type Known = RwLock<HashMap<String, StoredKey>>;

async fn read_all(store: &dyn KeyStore) -> Result<HashMap<String, StoredKey>, StoreError> {
    let known = store.keys().await?;
    Ok(known.into_iter().map(|stored| (stored.key.id.clone(), stored)).collect())
}

/// Reads the keys again whenever another process has changed some, as long as somebody needs them.
async fn keep_up(
    store: Arc<dyn KeyStore>,
    known: Weak<Known>,
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
                    tracing::warn!(%error, "changed keys cannot be read; trying again");
                    tokio::time::sleep(READ_AGAIN).await;
                }
            }
        }
    }
}

fn random_token() -> Result<Token, ServiceError> {
    Ok(Token::new(&random("key")?))
}

/// Random bytes for a thing that is being made.
pub(super) fn random<const N: usize>(of: &str) -> Result<[u8; N], ServiceError> {
    let mut random = [0; N];
    SystemRandom::new().fill(&mut random).map_err(|_| {
        let detail = format!("the system gives no random numbers; the {of} was not made");
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
    struct Drawer(Mutex<Vec<StoredKey>>);

    #[async_trait]
    impl KeyStore for Drawer {
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

    fn wanted(role: Role, limits: KeyLimits) -> NewKey {
        NewKey { name: "n".into(), role, maps: Vec::new(), limits, expires_days: Some(1) }
    }

    #[tokio::test]
    async fn a_key_is_known_by_its_token_alone_until_it_is_revoked_and_after_a_restart() {
        let store = Arc::new(Drawer::default());
        let keys = Keys::load(store.clone()).await.unwrap();
        assert!(!keys.any_valid());
        let made = keys.create(wanted(Role::Robot, KeyLimits::default())).await.unwrap();
        let token: Token = made.token.parse().unwrap();
        assert_eq!(keys.holder(&token).unwrap().id, made.key.id);
        let kept = serde_json::to_string(&*store.0.lock()).unwrap();
        assert!(!kept.contains(&made.token[17..]), "the secret is stored");

        let mut other = made.token.clone();
        other.replace_range(80..81, if made.token.ends_with('0') { "1" } else { "0" });
        assert!(keys.holder(&other.parse().unwrap()).is_err());
        let again = Keys::load(store).await.unwrap();
        assert!(again.any_valid() && again.holder(&token).is_ok());
        again.revoke(&made.key.id).await.unwrap();
        assert!(again.holder(&token).unwrap_err().detail.contains("revoked"));
        assert!(!again.any_valid());
        assert_eq!(again.revoke("000000000000").await.unwrap_err().kind, ErrorKind::NotFound);
    }

    #[tokio::test]
    async fn a_limit_is_kept_and_says_when_to_come_again() {
        let keys = Keys::load(Arc::new(Drawer::default())).await.unwrap();
        let limits = KeyLimits { requests_per_minute: Some(3), bytes_per_minute: Some(1000) };
        let key = keys.create(wanted(Role::Robot, limits)).await.unwrap().key;
        for left in [2, 1, 0] {
            let (allowances, taken) = keys.limits.take_request(&key).await;
            taken.unwrap();
            assert_eq!(allowances.requests.unwrap().remaining, left);
        }
        let refused = keys.limits.take_request(&key).await.1.unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Overloaded);
        let pause = refused.retry_after.unwrap().as_secs_f64();
        assert!((15.0..=20.0).contains(&pause), "{pause}");

        let limits = KeyLimits { requests_per_minute: None, ..limits };
        let key = keys.create(wanted(Role::Robot, limits)).await.unwrap().key;
        keys.limits.take_request(&key).await.1.unwrap();
        keys.limits.take_bytes(&key, 3000).await;
        let (allowances, refused) = keys.limits.take_request(&key).await;
        assert_eq!(allowances.bytes.unwrap().remaining, 0);
        let pause = refused.unwrap_err().retry_after.unwrap().as_secs_f64();
        assert!((115.0..=121.0).contains(&pause), "{pause}");
    }

    #[tokio::test]
    async fn a_key_that_cannot_be_is_refused() {
        let keys = Keys::load(Arc::new(Drawer::default())).await.unwrap();
        let plain = wanted(Role::Admin, KeyLimits::default());
        for bad in [
            NewKey { name: " ".into(), ..plain.clone() },
            NewKey { name: "a\nb".into(), ..plain.clone() },
            NewKey { name: "n".repeat(101), ..plain.clone() },
            NewKey { expires_days: Some(0), ..plain.clone() },
            NewKey {
                limits: KeyLimits { requests_per_minute: Some(0), bytes_per_minute: None },
                ..plain.clone()
            },
        ] {
            assert_eq!(keys.create(bad).await.unwrap_err().kind, ErrorKind::Unprocessable);
        }
    }
}
