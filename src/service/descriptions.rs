//! The cache of descriptions: list, look at and remove what should not be there.

use std::sync::Arc;

use whereabouts_api::{DescriptionPage, KeyedDescription, PurgedDescriptions};
use whereabouts_core::Digest;
use whereabouts_store::{DescriptionCache, DescriptionFilter};

use super::ServiceError;
use super::images::page_size;

/// Descriptions that are removed at a time.
const BATCH: usize = 500;

/// The cache of descriptions.
pub struct Descriptions {
    /// The cache.
    pub cache: Arc<dyn DescriptionCache>,
}

impl Descriptions {
    /// Returns a page of the descriptions that match, in the order of their keys.
    pub async fn list(
        &self,
        filter: &DescriptionFilter,
        cursor: Option<Digest>,
        limit: Option<usize>,
    ) -> Result<DescriptionPage, ServiceError> {
        let limit = page_size(limit)?;
        let mut found = self.cache.descriptions(filter, cursor.as_ref(), limit + 1).await?;
        let more = found.len() > limit;
        found.truncate(limit);
        let next_cursor = found.last().filter(|_| more).map(|(key, _)| *key);
        let keyed = |(key, description)| KeyedDescription { key, description };
        Ok(DescriptionPage { descriptions: found.into_iter().map(keyed).collect(), next_cursor })
    }

    /// Returns one description.
    pub async fn get(&self, key: Digest) -> Result<KeyedDescription, ServiceError> {
        match self.cache.description(&key).await? {
            Some(description) => Ok(KeyedDescription { key, description }),
            None => Err(no_description(key)),
        }
    }

    /// Removes one description. The pair is described again when a job needs it.
    pub async fn remove(&self, key: Digest) -> Result<PurgedDescriptions, ServiceError> {
        match self.cache.remove_descriptions(&[key]).await? {
            0 => Err(no_description(key)),
            removed => Ok(PurgedDescriptions { removed }),
        }
    }

    /// Removes the descriptions that match.
    pub async fn purge(
        &self,
        filter: &DescriptionFilter,
    ) -> Result<PurgedDescriptions, ServiceError> {
        let (mut removed, mut after) = (0, None);
        loop {
            // From where the last batch ended: those before it do not match, and need not be read again.
            let found = self.cache.descriptions(filter, after.as_ref(), BATCH).await?;
            let keys: Vec<Digest> = found.into_iter().map(|(key, _)| key).collect();
            let Some(&last) = keys.last() else { return Ok(PurgedDescriptions { removed }) };
            removed += self.cache.remove_descriptions(&keys).await?;
            after = Some(last);
        }
    }
}

fn no_description(key: Digest) -> ServiceError {
    ServiceError::not_found(format!(
        "there is no description {key}; `whereabouts descriptions list` shows those that are cached"
    ))
}
