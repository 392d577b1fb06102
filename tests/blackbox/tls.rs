//! HTTPS: from two files, which may change.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use reqwest::{Certificate, Client};
use tempfile::TempDir;

use super::support::Server;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/tls").join(name)
}

/// A folder with a certificate and its key, and a server that has them.
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
        let pem = std::fs::read(fixture(&format!("{certificate}.pem"))).unwrap();
        let trusted = [Certificate::from_pem(&pem).unwrap()];
        let client = Client::builder().tls_certs_only(trusted).build().unwrap();
        match client.get(format!("{}/readyz", self.url)).send().await {
            Ok(answer) => answer.status() == 200,
            Err(_) => false,
        }
    }
}

/// Puts a file of a certificate in place, in one step.
fn put(folder: &Path, certificate: &str, end: &str) {
    let beside = folder.join("beside");
    std::fs::copy(fixture(&format!("{certificate}.{end}")), &beside).unwrap();
    std::fs::rename(&beside, folder.join(format!("server.{end}"))).unwrap();
}

#[tokio::test]
async fn a_certificate_that_is_replaced_is_taken_up_and_one_that_is_bad_is_not() {
    let encrypted = Encrypted::start();
    assert!(encrypted.is_trusted_by("first").await);
    assert!(!encrypted.is_trusted_by("second").await);

    std::fs::write(encrypted.files.path().join("server.pem"), "nonsense").unwrap();
    let end = Instant::now() + Duration::from_secs(30);
    while !encrypted.server.log().contains("the previous one stays") {
        assert!(Instant::now() < end, "{}", encrypted.server.log());
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    assert!(encrypted.is_trusted_by("first").await);

    for end in ["key", "pem"] {
        put(encrypted.files.path(), "second", end);
    }
    let end = Instant::now() + Duration::from_secs(30);
    while !encrypted.is_trusted_by("second").await {
        assert!(Instant::now() < end, "{}", encrypted.server.log());
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    assert!(!encrypted.is_trusted_by("first").await);
}

#[tokio::test]
async fn who_speaks_without_tls_is_told_so() {
    let encrypted = Encrypted::start();
    let plain = encrypted.server.get("/readyz").await.expect(400);
    assert!(plain["detail"].as_str().unwrap().contains("https://"), "{plain}");
}

#[tokio::test]
async fn a_connection_that_says_nothing_does_not_keep_the_server_from_stopping() {
    let Encrypted { files: _files, _data, server, url } = Encrypted::start();
    let address = url.trim_start_matches("https://").to_owned();
    let silent = tokio::net::TcpStream::connect(&address).await.unwrap();
    tokio::time::sleep(Duration::from_millis(300)).await;
    let start = Instant::now();
    assert!(server.terminate().success());
    assert!(start.elapsed() < Duration::from_secs(8), "{:?}", start.elapsed());
    drop(silent);
}

#[test]
fn files_that_cannot_be_used_are_named_at_the_start() {
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
