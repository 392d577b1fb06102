//! Idempotency records, by caller and idempotency key.

use std::sync::Arc;

use async_trait::async_trait;
use jiff::Timestamp;

use super::super::{IdempotencyRecord, IdempotencyStore, Progress, StoreError};
use super::trees::{Trees, decode, failed, get, put};
use super::{EmbeddedStore, blocking};

/// The key in `answers_by_age`, which sorts by age.
fn age_key(at: Timestamp, id: &[u8]) -> Vec<u8> {
    // A time before 1970 would sort last, but none occurs.
    [&at.as_millisecond().to_be_bytes(), id].concat()
}

pub(super) fn write(
    trees: &Trees,
    id: &[u8],
    record: &IdempotencyRecord,
) -> Result<(), StoreError> {
    remove(trees, id)?;
    put(&trees.answers, id, record)?;
    put(&trees.answers_by_age, &age_key(record.at, id), &())
}

fn remove(trees: &Trees, id: &[u8]) -> Result<(), StoreError> {
    if let Some(old) = trees.answers.remove(id).map_err(failed)? {
        let old: IdempotencyRecord = decode(&old)?;
        trees.answers_by_age.remove(age_key(old.at, id)).map_err(failed)?;
    }
    Ok(())
}

#[async_trait]
impl IdempotencyStore for EmbeddedStore {
    async fn reserve_request(
        &self,
        id: &str,
        reserved: IdempotencyRecord,
        since: Timestamp,
    ) -> Result<Option<IdempotencyRecord>, StoreError> {
        let id = id.to_owned();
        let reserve = move |trees: &Trees, _: &mut _| {
            let known: Option<IdempotencyRecord> = get(&trees.answers, id.as_bytes())?;
            let counts = |known: &IdempotencyRecord| match (&known.progress, &reserved.progress) {
                // A process that has ended will not answer any more.
                (Progress::Running { process, .. }, Progress::Running { process: own, .. }) => {
                    process == own
                }
                _ => known.at >= since,
            };
            match known {
                Some(known) if counts(&known) => Ok(Some(known)),
                Some(known) => {
                    write(trees, id.as_bytes(), &reserved.replacing(&known)).map(|()| None)
                }
                None => write(trees, id.as_bytes(), &reserved).map(|()| None),
            }
        };
        self.inner.writer.commit(reserve, |_| {}).await
    }

    async fn store_response(&self, id: &str, answer: IdempotencyRecord) -> Result<(), StoreError> {
        let id = id.to_owned();
        let keep = move |trees: &Trees, _: &mut _| write(trees, id.as_bytes(), &answer);
        self.inner.writer.commit(keep, |()| {}).await
    }

    async fn forget_request(&self, id: &str) -> Result<(), StoreError> {
        let id = id.to_owned();
        let forget = move |trees: &Trees, _: &mut _| remove(trees, id.as_bytes());
        self.inner.writer.commit(forget, |()| {}).await
    }

    async fn prune_responses(&self, before: Timestamp, most: usize) -> Result<usize, StoreError> {
        let inner = Arc::clone(&self.inner);
        let old = blocking(move || {
            let ages = &inner.trees.answers_by_age;
            let surplus = ages.len().saturating_sub(most);
            let end = before.as_millisecond().to_be_bytes();
            let mut old = Vec::new();
            for key in ages.iter().keys() {
                let key = key.map_err(failed)?;
                if old.len() >= surplus && key[..] >= end[..] {
                    break;
                }
                old.extend(key.get(end.len()..).map(<[u8]>::to_vec));
            }
            Ok(old)
        })
        .await?;
        let count = old.len();
        if count > 0 {
            let forget =
                move |trees: &Trees, _: &mut _| old.iter().try_for_each(|id| remove(trees, id));
            self.inner.writer.commit(forget, |()| {}).await?;
        }
        Ok(count)
    }
}
