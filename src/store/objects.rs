//! Image bytes in an object store: any that is S3-compatible, or a local folder.

use std::path::Path as Folder;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use object_store::aws::AmazonS3Builder;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{BackoffConfig, ClientOptions, Error, ObjectStore, ObjectStoreExt, RetryConfig};

use super::StoreError;
use whereabouts_core::Digest;

/// How to reach an object store.
#[derive(Debug, Clone)]
pub struct ObjectSettings {
    /// `s3://bucket/prefix`, or `file:///folder`.
    pub url: String,
    /// The endpoint of an S3-compatible server; empty for Amazon's.
    pub endpoint: String,
    /// The region; empty for the default one.
    pub region: String,
    /// Whether plain HTTP is allowed.
    pub allow_http: bool,
    /// Time limit of a call, including its retries.
    pub timeout: Duration,
}

/// An object store, or a prefix within one.
#[derive(Debug, Clone)]
pub struct Objects {
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    timeout: Duration,
}

/// The initial backoff before a retry.
const INITIAL_BACKOFF: Duration = Duration::from_millis(100);

impl Objects {
    /// Prepares access to the store without contacting it.
    pub fn open(settings: &ObjectSettings) -> Result<Self, StoreError> {
        let unusable = |why: String| {
            StoreError::Failed(format!(
                "objects.url: {why}; write s3://bucket/prefix or file:///folder"
            ))
        };
        let (scheme, rest) = settings
            .url
            .split_once("://")
            .ok_or_else(|| unusable(format!("{:?} is not a valid URL", settings.url)))?;
        match scheme {
            "file" => Self::folder(Folder::new(rest), settings.timeout),
            "s3" => {
                let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
                let prefix = Path::parse(prefix).map_err(|error| unusable(error.to_string()))?;
                let store = Arc::new(s3(settings, bucket)?);
                Ok(Self { store, prefix, timeout: settings.timeout })
            }
            other => Err(unusable(format!("the scheme {other}:// is not supported"))),
        }
    }

    /// Opens a folder as an object store, and creates it if it does not exist.
    pub fn folder(folder: &Folder, timeout: Duration) -> Result<Self, StoreError> {
        let failed = |error: &dyn std::fmt::Display| {
            let folder = folder.display();
            StoreError::Failed(format!("cannot store pictures in {folder}: {error} (objects.url)"))
        };
        std::fs::create_dir_all(folder).map_err(|error| failed(&error))?;
        let store = LocalFileSystem::new_with_prefix(folder)
            .map_err(|error| failed(&error))?
            .with_fsync(true);
        Ok(Self { store: Arc::new(store), prefix: Path::default(), timeout })
    }

    /// Stores bytes, unless they are already stored.
    pub async fn put(&self, digest: &Digest, bytes: Bytes) -> Result<(), StoreError> {
        let path = self.path(digest);
        let length = bytes.len() as u64;
        self.call(async {
            match self.store.head(&path).await {
                // An object appears complete or not at all, so its size is proof enough.
                Ok(found) if found.size == length => return Ok(()),
                Ok(_) | Err(Error::NotFound { .. }) => {}
                Err(error) => return Err(error),
            }
            self.store.put(&path, bytes.into()).await.map(drop)
        })
        .await
    }

    /// Returns the bytes of this digest.
    pub async fn get(&self, digest: &Digest) -> Result<Option<Bytes>, StoreError> {
        let path = self.path(digest);
        self.call(async {
            match self.store.get(&path).await {
                Ok(found) => found.bytes().await.map(Some),
                Err(Error::NotFound { .. }) => Ok(None),
                Err(error) => Err(error),
            }
        })
        .await
    }

    /// Removes the bytes of this digest, if they are stored.
    pub async fn remove(&self, digest: &Digest) -> Result<(), StoreError> {
        let path = self.path(digest);
        self.call(async {
            match self.store.delete(&path).await {
                Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
                Err(error) => Err(error),
            }
        })
        .await
    }

    fn path(&self, digest: &Digest) -> Path {
        let hex = digest.hex();
        self.prefix.clone().join(&hex[..2]).join(&hex[2..])
    }

    async fn call<T>(&self, work: impl Future<Output = Result<T, Error>>) -> Result<T, StoreError> {
        let unavailable = |why: &dyn std::fmt::Display| {
            StoreError::Unavailable(format!(
                "the object store is not available: {why}; try again in a moment"
            ))
        };
        match tokio::time::timeout(self.timeout, work).await {
            Ok(Ok(done)) => Ok(done),
            Err(_) => {
                let limit = self.timeout.as_millis();
                Err(unavailable(&format!(
                    "it did not answer within {limit} ms (objects.timeout_ms)"
                )))
            }
            Ok(Err(error @ (Error::PermissionDenied { .. } | Error::Unauthenticated { .. }))) => {
                Err(StoreError::Failed(format!(
                    "the object store rejects the credentials: {error}; check AWS_ACCESS_KEY_ID, \
                     AWS_SECRET_ACCESS_KEY and their permissions"
                )))
            }
            Ok(Err(error)) => Err(unavailable(&error)),
        }
    }
}

fn s3(settings: &ObjectSettings, bucket: &str) -> Result<object_store::aws::AmazonS3, StoreError> {
    // Fails if a provider is installed already, which serves as well.
    let _ = rustls::crypto::ring::default_provider().install_default();
    // Credentials come from the environment, as with every S3 client.
    let mut builder = AmazonS3Builder::from_env()
        .with_bucket_name(bucket)
        .with_allow_http(settings.allow_http)
        .with_client_options(
            ClientOptions::new()
                .with_timeout(settings.timeout)
                .with_connect_timeout(settings.timeout / 2)
                .with_allow_http(settings.allow_http),
        )
        .with_retry(RetryConfig {
            backoff: BackoffConfig { init_backoff: INITIAL_BACKOFF, ..BackoffConfig::default() },
            // `retry_timeout` is the bound that matters.
            max_retries: 10,
            retry_timeout: settings.timeout,
        });
    if !settings.endpoint.is_empty() {
        builder = builder.with_endpoint(&settings.endpoint);
    }
    if !settings.region.is_empty() {
        builder = builder.with_region(&settings.region);
    }
    builder.build().map_err(|error| StoreError::Failed(format!("objects.url: {error}")))
}
