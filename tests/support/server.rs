//! Starts the real server on a free port and speaks HTTP with it.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex};
use std::thread;

use image::codecs::jpeg::JpegEncoder;
use reqwest::{Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use tempfile::TempDir;
use whereabouts_town::{Town, TownSpec};

use crate::deployment;

/// The binary under test: the one that Cargo built next to the tests.
pub static BINARY: LazyLock<PathBuf> = LazyLock::new(|| {
    let tests = std::env::current_exe().unwrap();
    let binary = tests.parent().unwrap().parent().unwrap().join("whereabouts");
    assert!(binary.is_file(), "{} is missing: run `cargo build --release`", binary.display());
    binary
});

/// A running server and its log.
pub struct Server {
    child: Child,
    pub url: String,
    log: Arc<Mutex<Vec<String>>>,
    pub http: reqwest::Client,
}

/// A server with a data folder of its own.
pub fn server() -> (TempDir, Server) {
    let dir = TempDir::new().unwrap();
    let server = Server::start(dir.path(), &[]);
    (dir, server)
}

/// The server that all tests of this process share, and the name of a map of the caller's own, which is yet to be
/// created. For tests that look at nothing but their map: not at the list of maps, nor at all jobs, metrics, the log,
/// or the files.
pub fn shared_server() -> (&'static Server, String) {
    static SHARED: LazyLock<Server> = LazyLock::new(Server::start_shared);
    static MAPS: AtomicUsize = AtomicUsize::new(0);
    (&SHARED, format!("map-{}", MAPS.fetch_add(1, Ordering::Relaxed)))
}

/// Runs the command in its arguments until its standard input is closed, and then removes the folder `$DATA`: a static
/// is never dropped, but the pipe is closed when the test process ends.
const UNTIL_THE_TESTS_END: &str =
    r#""$0" "$@" </dev/null & server=$!; exec 2>&-; cat; kill -9 "$server"; wait; rm -rf "$DATA""#;

impl Server {
    /// Starts a server and waits until it says that it is ready. `settings` are environment
    /// variables, such as `("WHEREABOUTS_JOBS__QUEUE", "1")`.
    pub fn start(data: &Path, settings: &[(&str, &str)]) -> Self {
        Self::try_start(data, settings)
            .unwrap_or_else(|log| panic!("the server did not start: {log}"))
    }

    /// Like [`Server::start`], but returns the log of a server that does not start.
    pub fn try_start(data: &Path, settings: &[(&str, &str)]) -> Result<Self, String> {
        Self::try_start_as("serve", data, settings)
    }

    /// Starts a worker for the servers of that data folder.
    pub fn start_worker(data: &Path, settings: &[(&str, &str)]) -> Self {
        Self::try_start_as("worker", data, settings)
            .unwrap_or_else(|log| panic!("the worker did not start: {log}"))
    }

    fn try_start_as(role: &str, data: &Path, settings: &[(&str, &str)]) -> Result<Self, String> {
        let mut command = Command::new(&*BINARY);
        command.arg(role).args(arguments(data)).envs(test_settings(data)).envs(settings.to_vec());
        Self::spawn(command, unpooled())
    }

    fn start_shared() -> Self {
        let data = TempDir::new().unwrap().keep();
        let mut command = Command::new("sh");
        command
            .args([
                OsStr::new("-c"),
                UNTIL_THE_TESTS_END.as_ref(),
                BINARY.as_ref(),
                "serve".as_ref(),
            ])
            .args(arguments(&data))
            .envs(test_settings(&data))
            .env("DATA", &data)
            .stdin(Stdio::piped());
        Self::spawn(command, unpooled())
            .unwrap_or_else(|log| panic!("the shared server did not start: {log}"))
    }

    /// Starts a server as it is deployed, for a benchmark: with the default number of threads, and a client that
    /// keeps its connections. `settings` are environment variables.
    pub fn start_for_benchmark(model: &str, data: &Path, settings: &[(&str, &str)]) -> Self {
        install_cryptography();
        let mut command = Command::new(&*BINARY);
        command.args(["serve", "--model", model]).args(arguments(data)).envs(settings.to_vec());
        Self::spawn(command, reqwest::Client::new())
            .unwrap_or_else(|log| panic!("the server did not start: {log}"))
    }

    /// Runs the command until it says that it is ready; returns the log of one that ends instead.
    fn spawn(mut command: Command, http: reqwest::Client) -> Result<Self, String> {
        let address_file =
            std::env::temp_dir().join(format!("whereabouts-{}.address", uuid::Uuid::now_v7()));
        let mut child = command
            .arg("--address-file")
            .arg(&address_file)
            .env("WHEREABOUTS_LOG__FORMAT", "json")
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let log = Arc::new(Mutex::new(Vec::<String>::new()));
        loop {
            let Some(Ok(line)) = lines.next() else {
                child.wait().unwrap();
                return Err(log.lock().unwrap().join("\n"));
            };
            let ready = line.contains(r#""message":"ready""#);
            log.lock().unwrap().push(line);
            if ready {
                break;
            }
        }
        let rest_of_log = Arc::clone(&log);
        thread::spawn(move || {
            lines.map_while(Result::ok).for_each(|line| rest_of_log.lock().unwrap().push(line));
        });
        let address = std::fs::read_to_string(&address_file).unwrap();
        std::fs::remove_file(&address_file).unwrap();
        Ok(Self { child, url: format!("http://{}", address.trim()), log, http })
    }

    /// The id of the process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.http.request(method, format!("{}{path}", self.url))
    }

    pub async fn get(&self, path: &str) -> Answer {
        Answer::of(self.request(Method::GET, path)).await
    }

    /// All metrics as text.
    pub async fn metrics(&self) -> String {
        String::from_utf8(self.get("/metrics").await.bytes).unwrap()
    }

    pub async fn delete(&self, path: &str) -> Answer {
        Answer::of(self.request(Method::DELETE, path)).await
    }

    pub async fn put(&self, path: &str, body: Value) -> Answer {
        Answer::of(self.request(Method::PUT, path).json(&body)).await
    }

    pub async fn patch(&self, path: &str, body: Value) -> Answer {
        Answer::of(self.request(Method::PATCH, path).json(&body)).await
    }

    /// Posts a body of a media type.
    pub async fn post(&self, path: &str, media_type: &str, body: Vec<u8>) -> Answer {
        let request = self.request(Method::POST, path).header("content-type", media_type);
        Answer::of(request.body(body)).await
    }

    pub async fn post_jpeg(&self, path: &str, body: Vec<u8>) -> Answer {
        self.post(path, "image/jpeg", body).await
    }

    /// Creates a map of the first `places` places of the town.
    pub async fn town(&self, map: &str, places: usize) {
        self.put(&format!("/maps/{map}"), json!({"scene": "outdoor"})).await.expect(201);
        self.town_more(map, 0..places).await;
    }

    /// Adds places of the town to a map.
    pub async fn town_more(&self, map: &str, places: std::ops::Range<usize>) {
        for place in places {
            let path =
                format!("/maps/{map}/images?id=place-{place}&lat=45.{place:03}&lon=7&heading=90");
            self.post_jpeg(&path, reference(place)).await.expect(201);
        }
    }

    /// Sends SIGTERM and waits until the server has ended.
    pub fn terminate(mut self) -> std::process::ExitStatus {
        signal(&self.child, "TERM");
        self.child.wait().unwrap()
    }

    /// Kills the server.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    pub fn log(&self) -> String {
        self.log.lock().unwrap().join("\n")
    }

    /// Resident memory in bytes.
    pub fn resident_bytes(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 1024
    }
}

fn arguments(data: &Path) -> [&OsStr; 4] {
    ["--listen".as_ref(), "127.0.0.1:0".as_ref(), "--data".as_ref(), data.as_ref()]
}

/// One thread, because tests run side by side; and the same model whatever else is installed in the checkout.
fn test_settings(data: &Path) -> Vec<(String, String)> {
    let model = [("WHEREABOUTS_MODEL__THREADS", "1"), ("WHEREABOUTS_MODEL__NAME", "xfeat")];
    let model = model.map(|(name, value)| (name.to_owned(), value.to_owned()));
    model.into_iter().chain(deployment::settings(data)).collect()
}

/// A client that keeps no connections, so that a drain never waits for an idle one, and that may be used from
/// several runtimes.
fn unpooled() -> reqwest::Client {
    install_cryptography();
    reqwest::Client::builder().pool_max_idle_per_host(0).build().unwrap()
}

/// reqwest has no cryptography of its own; this is the one that the binary has.
pub fn install_cryptography() {
    let _ = rustls::crypto::ring::default_provider().install_default();
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn signal(child: &Child, name: &str) {
    let status = Command::new("kill").args(["-s", name, &child.id().to_string()]).status();
    assert!(status.unwrap().success());
}

/// A response, read to its end.
#[derive(Debug)]
pub struct Answer {
    pub status: StatusCode,
    pub headers: reqwest::header::HeaderMap,
    pub bytes: Vec<u8>,
}

impl Answer {
    pub async fn of(request: RequestBuilder) -> Self {
        let response: Response = request.send().await.unwrap();
        let (status, headers) = (response.status(), response.headers().clone());
        Self { status, headers, bytes: response.bytes().await.unwrap().to_vec() }
    }

    /// Asserts the status; returns the JSON body.
    #[track_caller]
    pub fn expect(&self, status: u16) -> Value {
        assert_eq!(self.status.as_u16(), status, "{}", String::from_utf8_lossy(&self.bytes));
        serde_json::from_slice(&self.bytes).unwrap_or(Value::Null)
    }

    /// Asserts that the response is a complete problem with this status; returns its detail.
    #[track_caller]
    pub fn problem(&self, status: u16) -> String {
        let problem = self.expect(status);
        assert_eq!(self.headers["content-type"], "application/problem+json");
        assert_eq!(problem["status"], status);
        assert_eq!(problem["request_id"], self.headers["x-request-id"].to_str().unwrap());
        for field in ["type", "title", "detail", "request_id"] {
            let text = problem[field].as_str().unwrap();
            assert!(!text.is_empty(), "{field} of {problem}");
        }
        problem["detail"].as_str().unwrap().to_owned()
    }
}

fn town() -> Town {
    Town::new(TownSpec { seed: 11, places: 1000, width: 320, height: 240, ..TownSpec::default() })
}

/// The value of a metric, named with its labels, in what [`Server::metrics`] gives.
pub fn value_of(metrics: &str, name: &str) -> Option<f64> {
    let value = metrics.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
    value.map(|value| value.parse().unwrap())
}

/// The map image of a place, as a JPEG.
pub fn reference(place: usize) -> Vec<u8> {
    jpeg(&town().reference(place).image)
}

/// A frame near a place, as a JPEG.
pub fn frame(place: usize, variant: u32) -> Vec<u8> {
    jpeg(&town().query(place, variant).image)
}

pub fn jpeg(pixels: &image::RgbImage) -> Vec<u8> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 85).encode_image(pixels).unwrap();
    bytes
}
