//! HTTPS with a certificate and a key from files, which are reloaded.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use reqwest::{Certificate, Client};
use tempfile::TempDir;

use super::support::{Server, value_of};
use super::wait::until;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/tls").join(name)
}

/// A folder with a certificate and its key, and a server that uses them.
struct Encrypted {
    files: TempDir,
    _data: TempDir,
    server: Server,
    url: String,
}

impl Encrypted {
    fn start() -> Self {
        let (files, data) = (TempDir::new().unwrap(), TempDir::new().unwrap());
        let encrypted = |file: &str| files.path().join(file).to_str().unwrap().to_owned();
        for end in ["pem", "key"] {
            put(files.path(), "first", end);
        }
        let settings = [
            ("WHEREABOUTS_SERVER__TLS_CERTIFICATE", &*encrypted("server.pem")),
            ("WHEREABOUTS_SERVER__TLS_KEY", &*encrypted("server.key")),
        ];
        let server = Server::start(data.path(), &settings);
        let url = server.url.replace("http://", "https://");
        Self { files, _data: data, server, url }
    }

    /// Whether a client that trusts only this certificate gets an answer.
    async fn is_trusted_by(&self, certificate: &str) -> bool {
        match trusting(certificate).get(format!("{}/readyz", self.url)).send().await {
            Ok(answer) => answer.status() == 200,
            Err(_) => false,
        }
    }
}

/// A client that trusts only this certificate.
fn trusting(certificate: &str) -> Client {
    let pem = std::fs::read(fixture(&format!("{certificate}.pem"))).unwrap();
    let trusted = [Certificate::from_pem(&pem).unwrap()];
    Client::builder().tls_certs_only(trusted).build().unwrap()
}

/// Puts a certificate or key in place atomically.
fn put(folder: &Path, certificate: &str, end: &str) {
    let staged = folder.join("staged");
    std::fs::copy(fixture(&format!("{certificate}.{end}")), &staged).unwrap();
    std::fs::rename(&staged, folder.join(format!("server.{end}"))).unwrap();
}

#[tokio::test]
async fn a_replaced_certificate_is_reloaded_and_an_invalid_one_is_not() {
    let encrypted = Encrypted::start();
    assert!(encrypted.is_trusted_by("first").await);
    assert!(!encrypted.is_trusted_by("second").await);

    std::fs::write(encrypted.files.path().join("server.pem"), "nonsense").unwrap();
    until(async || encrypted.server.log().contains("the previous one stays")).await;
    assert!(encrypted.is_trusted_by("first").await);

    for end in ["key", "pem"] {
        put(encrypted.files.path(), "second", end);
    }
    until(async || encrypted.is_trusted_by("second").await).await;
    assert!(!encrypted.is_trusted_by("first").await);
}

#[tokio::test]
async fn a_plain_http_request_to_the_https_port_is_explained() {
    let encrypted = Encrypted::start();
    let plain = encrypted.server.get("/readyz").await.expect(400);
    assert!(plain["detail"].as_str().unwrap().contains("https://"), "{plain}");
}

#[tokio::test]
async fn a_silent_connection_does_not_delay_shutdown() {
    let Encrypted { files: _files, _data, server, url } = Encrypted::start();
    let address = url.trim_start_matches("https://").to_owned();
    let silent = tokio::net::TcpStream::connect(&address).await.unwrap();
    // The server has accepted it once it counts two connections: this client keeps one.
    let client = trusting("first");
    until(async || {
        let metrics = client.get(format!("{url}/metrics")).send().await.unwrap();
        value_of(&metrics.text().await.unwrap(), "whereabouts_connections") == Some(2.0)
    })
    .await;
    drop(client);
    let start = Instant::now();
    // On another thread, so that this one can close the connection of the client.
    let ended = tokio::task::spawn_blocking(move || server.terminate()).await;
    assert!(ended.unwrap().success());
    assert!(start.elapsed() < Duration::from_secs(8), "{:?}", start.elapsed());
    drop(silent);
}

#[test]
fn unusable_certificate_files_are_named_at_startup() {
    let data = TempDir::new().unwrap();
    let start = |certificate: &Path, key: &Path| {
        let settings = [
            ("WHEREABOUTS_SERVER__TLS_CERTIFICATE", certificate.to_str().unwrap()),
            ("WHEREABOUTS_SERVER__TLS_KEY", key.to_str().unwrap()),
        ];
        Server::try_start(data.path(), &settings).err().unwrap()
    };
    let (pem, key) = (fixture("first.pem"), fixture("first.key"));
    let absent = data.path().join("absent.pem");
    assert!(start(&absent, &key).contains("absent.pem"));
    assert!(start(&pem, &pem).contains("private key"));
    assert!(start(&key, &key).contains("a certificate"));
    assert!(start(&pem, &fixture("second.key")).contains("does not go with"));
    assert!(start(&pem, Path::new("")).contains("go together"));
}
