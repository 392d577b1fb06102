//! The vocabularies of maps: which descriptor a frame needs, and the cache of those that are maps' own.

use std::sync::Arc;

use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use whereabouts_api::ErrorKind;
use whereabouts_core::{Digest, Map};
use whereabouts_store::BlobStore;
use whereabouts_vision::{DescriptorSpec, Extractor, Vocabulary};

use super::ServiceError;

/// `[vocabulary]`
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VocabularySettings {
    /// Whether maps get a vocabulary of their own without being asked.
    pub own: bool,
    /// Fewest images of a map that gets one.
    pub min_images: usize,
    /// Most images of a map that gets one, and most images that one is fitted on.
    pub max_images: usize,
    /// Maximum number of maps' own vocabularies in memory.
    pub loaded: usize,
}

impl VocabularySettings {
    /// Returns what is invalid; `None` if the settings are valid.
    pub fn validate(&self) -> Option<String> {
        const MOST: usize = 4000;
        if !(2..=MOST).contains(&self.min_images)
            || !(self.min_images..=MOST).contains(&self.max_images)
        {
            return Some(format!(
                "2 <= vocabulary.min_images <= vocabulary.max_images <= {MOST} must hold"
            ));
        }
        (self.loaded == 0).then(|| "vocabulary.loaded must be at least 1".into())
    }
}

/// A cache of maps' own vocabularies. The least recently used is evicted.
pub struct Vocabularies {
    blobs: Arc<dyn BlobStore>,
    most: usize,
    /// By the digest of the descriptors; least recently used first.
    loaded: Mutex<Vec<(Digest, Arc<Vocabulary>)>>,
    /// Held while one is loaded, so that none is loaded twice.
    loading: tokio::sync::Mutex<()>,
}

impl Vocabularies {
    /// Creates an empty cache.
    pub fn new(blobs: Arc<dyn BlobStore>, most: usize) -> Self {
        let (loaded, loading) = (Mutex::default(), tokio::sync::Mutex::default());
        Self { blobs, most: most.max(1), loaded, loading }
    }

    /// The descriptor that the pictures of a map and its frames need. `extractor` is the map's.
    pub async fn spec_of(
        &self,
        map: &Map,
        extractor: &Arc<Extractor>,
    ) -> Result<DescriptorSpec, ServiceError> {
        let kind = map.descriptor;
        let Some(own) = &map.vocabulary else { return Ok(kind.into()) };
        let cached = match self.cached(&map.model_digest) {
            Some(cached) => Some(cached),
            None => {
                let _guard = self.loading.lock().await;
                match self.cached(&map.model_digest) {
                    Some(cached) => Some(cached),
                    None => self.load(map, &own.digest, extractor).await?,
                }
            }
        };
        let lost = || {
            ServiceError::new(
                ErrorKind::Conflict,
                format!(
                    "the vocabulary {} of the map {} is missing from the store; reindex the map \
                     (`whereabouts index --reindex --map {}`)",
                    own.digest, map.name, map.name
                ),
            )
        };
        Ok(DescriptorSpec { kind, vocabulary: Some(cached.ok_or_else(lost)?) })
    }

    /// Keeps a vocabulary that was just fitted.
    pub fn keep(&self, descriptors: Digest, vocabulary: Arc<Vocabulary>) {
        let mut loaded = self.loaded.lock();
        loaded.retain(|(digest, _)| *digest != descriptors);
        loaded.push((descriptors, vocabulary));
        let excess = loaded.len().saturating_sub(self.most);
        loaded.drain(..excess);
    }

    fn cached(&self, descriptors: &Digest) -> Option<Arc<Vocabulary>> {
        let mut loaded = self.loaded.lock();
        let position = loaded.iter().position(|(digest, _)| digest == descriptors)?;
        let used = loaded.remove(position);
        let vocabulary = Arc::clone(&used.1);
        loaded.push(used);
        Some(vocabulary)
    }

    async fn load(
        &self,
        map: &Map,
        digest: &Digest,
        extractor: &Arc<Extractor>,
    ) -> Result<Option<Arc<Vocabulary>>, ServiceError> {
        let Some(bytes) = self.blobs.blob(digest).await? else { return Ok(None) };
        let (extractor, kind) = (Arc::clone(extractor), map.descriptor);
        let reading = tokio::task::spawn_blocking(move || extractor.read_vocabulary(kind, &bytes));
        let read = reading.await.unwrap_or_else(|error| Err(error.to_string()));
        let vocabulary = Arc::new(read.map_err(|why| {
            let detail = format!("the vocabulary of the map {} cannot be used: {why}", map.name);
            ServiceError::new(ErrorKind::Internal, detail)
        })?);
        self.keep(map.model_digest, Arc::clone(&vocabulary));
        Ok(Some(vocabulary))
    }
}
