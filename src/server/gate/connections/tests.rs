//! Draining of connections whose client does not take part in it.

use tokio::io::AsyncReadExt;
use tokio::time::Instant;

use super::preface::PREFACE;
use super::*;

/// The SETTINGS of a client that keeps the defaults.
const SETTINGS: [u8; 9] = [0, 0, 0, 4, 0, 0, 0, 0, 0];

/// A GET of `/` as the first request of a connection: HEADERS with END_STREAM and END_HEADERS, of static fields.
const GET: [u8; 12] = [0, 0, 3, 1, 5, 0, 0, 0, 1, 0x82, 0x84, 0x86];

/// How long a drain takes after the client has sent `bytes` and read a first answer to them.
async fn drain_after(bytes: &[&[u8]], router: Router) -> Duration {
    let connections = Connections {
        settings: crate::config::defaults().server,
        router,
        metrics: Arc::default(),
        tls: None,
    };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let shutdown = CancellationToken::new();
    let serving = tokio::spawn(connections.serve(listener, shutdown.clone()));
    let mut client = TcpStream::connect(address).await.unwrap();
    client.write_all(&bytes.concat()).await.unwrap();
    client.read_exact(&mut [0; 9]).await.unwrap();
    tokio::time::pause();
    let began = Instant::now();
    shutdown.cancel();
    serving.await.unwrap();
    began.elapsed()
}

#[tokio::test]
async fn an_idle_http2_client_that_answers_nothing_does_not_hold_a_drain() {
    let drained = drain_after(&[PREFACE, &SETTINGS], Router::new()).await;
    assert!(drained < 3 * DRAIN_CHECK, "{drained:?}");
}

#[tokio::test]
async fn a_drain_waits_for_a_request_in_progress() {
    let slow = || async { tokio::time::sleep(8 * DRAIN_CHECK).await };
    let router = Router::new().route("/", axum::routing::get(slow));
    let drained = drain_after(&[PREFACE, &SETTINGS, &GET], router).await;
    assert!(drained >= 7 * DRAIN_CHECK && drained < 11 * DRAIN_CHECK, "{drained:?}");
}
