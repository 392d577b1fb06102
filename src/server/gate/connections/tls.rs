//! TLS from two files, which are read again when they change.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::RwLock;
use rustls::ServerConfig;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::TlsAcceptor;
use tokio_util::sync::CancellationToken;

/// How often it is looked whether the files have changed.
const LOOK: Duration = Duration::from_secs(5);

/// Why there is no TLS.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file cannot be read, or holds something else.
    #[error("cannot read {what} in {file}: {detail}; it must be PEM")]
    File {
        /// What was looked for.
        what: &'static str,
        /// Where.
        file: PathBuf,
        /// What was found.
        detail: String,
    },
    /// The key is not the certificate's, or is of a kind that is not known.
    #[error("the key in {key} does not go with the certificate in {certificate}: {detail}")]
    Pair {
        /// The certificates.
        certificate: PathBuf,
        /// The key.
        key: PathBuf,
        /// Why.
        detail: rustls::Error,
    },
}

/// A certificate with its key, as the files have it now.
#[derive(Debug)]
pub struct Tls {
    certificate: PathBuf,
    key: PathBuf,
    /// What the files were like before they were first read.
    seen: Stamp,
    current: RwLock<Arc<ServerConfig>>,
}

/// What tells one state of the two files from another.
type Stamp = [Option<(SystemTime, u64)>; 2];

impl Tls {
    /// Reads a chain of certificates, the server's first, and its key; both in PEM.
    pub fn load(certificate: &Path, key: &Path) -> Result<Self, TlsError> {
        let seen = stamp(certificate, key);
        let current = RwLock::new(read(certificate, key)?);
        Ok(Self { certificate: certificate.to_owned(), key: key.to_owned(), seen, current })
    }

    /// Takes connections with the certificate of the moment.
    pub(super) fn acceptor(&self) -> TlsAcceptor {
        Arc::clone(&self.current.read()).into()
    }

    /// Reads the files again when they have changed, until `shutdown`. While they cannot be used, as when
    /// one of them is there and the other is not yet, what was read before stays in use.
    pub(super) async fn follow(&self, shutdown: CancellationToken) {
        let (mut seen, mut warned) = (self.seen, None);
        while shutdown.run_until_cancelled(tokio::time::sleep(LOOK)).await.is_some() {
            let now = stamp(&self.certificate, &self.key);
            if now == seen {
                continue;
            }
            match read(&self.certificate, &self.key) {
                Ok(read) => {
                    *self.current.write() = read;
                    tracing::info!(certificate = %self.certificate.display(), "read the certificate again");
                    seen = now;
                }
                Err(error) => {
                    if warned.replace(now) != Some(now) {
                        tracing::warn!(%error, "the certificate has changed and cannot be used; the one before stays");
                    }
                }
            }
        }
    }
}

fn stamp(certificate: &Path, key: &Path) -> Stamp {
    [certificate, key].map(|file| {
        let about = std::fs::metadata(file).ok()?;
        Some((about.modified().ok()?, about.len()))
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
