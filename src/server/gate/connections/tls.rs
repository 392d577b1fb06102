//! TLS with a certificate and key from two files, which are reloaded when they change.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::RwLock;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// How often the files are checked for changes.
const CHECK_INTERVAL: Duration = Duration::from_secs(5);

/// Why TLS could not be configured.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or does not hold what it should.
    #[error("cannot read {what} in {file}: {detail}; it must be PEM")]
    File {
        /// What the file should hold.
        what: &'static str,
        /// The file.
        file: PathBuf,
        /// Why it cannot be used.
        detail: String,
    },
    /// The key does not belong to the certificate, or its algorithm is not supported.
    #[error("the key in {key} does not go with the certificate in {certificate}: {detail}")]
    Pair {
        /// File of the certificates.
        certificate: PathBuf,
        /// File of the key.
        key: PathBuf,
        /// What rustls says.
        detail: rustls::Error,
    },
}

/// A certificate and its key, kept as the files are now.
#[derive(Debug)]
pub struct Tls {
    certificate: PathBuf,
    key: PathBuf,
    /// State of the files before they were first read.
    loaded: Stamp,
    current: RwLock<Arc<ServerConfig>>,
}

/// State of the two files: time of the last change, and size.
type Stamp = [Option<(SystemTime, u64)>; 2];

impl Tls {
    /// Reads a certificate chain, the server's certificate first, and its key; both in PEM.
    pub fn load(certificate: &Path, key: &Path) -> Result<Self, TlsError> {
        let loaded = stamp(certificate, key);
        let current = RwLock::new(read(certificate, key)?);
        Ok(Self { certificate: certificate.to_owned(), key: key.to_owned(), loaded, current })
    }

    /// Accepts connections with the current certificate.
    pub(super) fn acceptor(&self) -> TlsAcceptor {
        Arc::clone(&self.current.read()).into()
    }

    /// Reloads the files when they have changed, until `shutdown`. While they cannot be used, for example
    /// because only one of them was replaced so far, the previous certificate stays in use.
    pub(super) async fn reload_until(&self, shutdown: CancellationToken) {
        let (mut loaded, mut warned) = (self.loaded, None);
        while shutdown.run_until_cancelled(tokio::time::sleep(CHECK_INTERVAL)).await.is_some() {
            let now = stamp(&self.certificate, &self.key);
            if now == loaded {
                continue;
            }
            match read(&self.certificate, &self.key) {
                Ok(config) => {
                    *self.current.write() = config;
                    tracing::info!(certificate = %self.certificate.display(), "reloaded the certificate");
                    loaded = now;
                }
                Err(error) => {
                    if warned.replace(now) != Some(now) {
                        tracing::warn!(%error, "the certificate has changed and cannot be used; the previous one stays in use");
                    }
                }
            }
        }
    }
}

fn stamp(certificate: &Path, key: &Path) -> Stamp {
    [certificate, key].map(|file| {
        let metadata = std::fs::metadata(file).ok()?;
        Some((metadata.modified().ok()?, metadata.len()))
    })
}

fn read(certificate: &Path, key: &Path) -> Result<Arc<ServerConfig>, TlsError> {
    let unreadable = |what: &'static str, file: &Path| {
        let file = file.to_owned();
        move |error: rustls::pki_types::pem::Error| TlsError::File {
            what,
            file,
            detail: error.to_string(),
        }
    };
    let chain: Vec<CertificateDer<'static>> = CertificateDer::pem_file_iter(certificate)
        .and_then(Iterator::collect)
        .map_err(unreadable("a certificate", certificate))?;
    if chain.is_empty() {
        let (file, detail) = (certificate.to_owned(), "it has none".to_owned());
        return Err(TlsError::File { what: "a certificate", file, detail });
    }
    let private = PrivateKeyDer::from_pem_file(key).map_err(unreadable("a private key", key))?;
    let mut config = ServerConfig::builder()
        .with_no_client_auth()
        .with_single_cert(chain, private)
        .map_err(|detail| TlsError::Pair {
            certificate: certificate.to_owned(),
            key: key.to_owned(),
            detail,
        })?;
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(Arc::new(config))
}
