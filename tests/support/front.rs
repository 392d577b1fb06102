//! A proxy in front of a mock that treats connections as an overloaded host does.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt, copy, copy_bidirectional};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;

/// What becomes of a connection.
#[derive(Clone, Copy)]
pub enum Treatment {
    /// It is passed on.
    Pass,
    /// It is reset at once, as by a host whose listen queue is full.
    Reset,
    /// It is reset once a request has begun to arrive.
    ResetAfterRequest,
    /// It is passed on, and what comes back first, the head of the response, trickles with that pause between bytes.
    SlowHead(Duration),
}

/// How many bytes trickle.
const TRICKLE: usize = 20;

/// The running proxy; it ends when dropped.
pub struct Front {
    url: String,
    resets: Arc<AtomicUsize>,
    server: JoinHandle<()>,
}

impl Drop for Front {
    fn drop(&mut self) {
        self.server.abort();
    }
}

impl Front {
    /// Starts a proxy to the server of that URL. `treat` gets the number of open connections, the new one included.
    pub async fn start(
        target: &str,
        treat: impl Fn(usize) -> Treatment + Send + Sync + 'static,
    ) -> Self {
        let (host, path) = target.strip_prefix("http://").unwrap().split_once('/').unwrap();
        let host = host.to_owned();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/{path}", listener.local_addr().unwrap());
        let (open, resets) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
        let counted = Arc::clone(&resets);
        let server = tokio::spawn(async move {
            loop {
                let (client, _) = listener.accept().await.unwrap();
                let treatment = treat(open.fetch_add(1, Ordering::SeqCst) + 1);
                let (host, open, resets) = (host.clone(), Arc::clone(&open), Arc::clone(&counted));
                tokio::spawn(async move {
                    // An error is that the other side has left.
                    let _ = serve(client, &host, treatment, &resets).await;
                    open.fetch_sub(1, Ordering::SeqCst);
                });
            }
        });
        Self { url, resets, server }
    }

    /// The URL of the server through the proxy.
    pub fn url(&self) -> String {
        self.url.clone()
    }

    /// Connections that were reset.
    pub fn resets(&self) -> usize {
        self.resets.load(Ordering::SeqCst)
    }
}

async fn serve(
    mut client: TcpStream,
    host: &str,
    treatment: Treatment,
    resets: &AtomicUsize,
) -> std::io::Result<()> {
    match treatment {
        Treatment::Reset => reset(client, resets),
        Treatment::ResetAfterRequest => {
            client.read_u8().await?;
            reset(client, resets)
        }
        Treatment::Pass => {
            let mut server = TcpStream::connect(host).await?;
            copy_bidirectional(&mut client, &mut server).await.map(drop)
        }
        Treatment::SlowHead(pause) => {
            let server = TcpStream::connect(host).await?;
            let (mut from_client, mut to_client) = client.into_split();
            let (mut from_server, mut to_server) = server.into_split();
            let back = async {
                for _ in 0..TRICKLE {
                    let byte = from_server.read_u8().await?;
                    to_client.write_u8(byte).await?;
                    // A slow server is part of the test.
                    tokio::time::sleep(pause).await;
                }
                copy(&mut from_server, &mut to_client).await
            };
            tokio::try_join!(copy(&mut from_client, &mut to_server), back).map(drop)
        }
    }
}

fn reset(client: TcpStream, resets: &AtomicUsize) -> std::io::Result<()> {
    resets.fetch_add(1, Ordering::SeqCst);
    // Closed with a reset instead of an orderly end.
    client.set_zero_linger()
}
