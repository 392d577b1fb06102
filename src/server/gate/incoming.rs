//! Bounds a body as it arrives: its time, and the memory of all bodies together.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use axum::body::{Body, BodyDataStream, HttpBody};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout_at};

use super::body_budget::BodyBudget;
use super::problem::Problem;
use super::settings::ServerSettings;
use super::state::GateSettings;
use whereabouts_api::ErrorKind;
use whereabouts_service::Rejection;

/// Watches one body. Its memory is released when the request is answered. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct BodyWatch {
    fault: Arc<OnceLock<Fault>>,
    /// Memory held by the part that has arrived.
    pub budget: BodyBudget,
}

/// Why a body was cut off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    TookTooLong(Duration),
    Paused(Duration),
    NoMemory(usize),
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::TookTooLong(longest) => write!(
                f,
                "the body took longer than {} s (server.body_timeout_s); send a smaller picture",
                longest.as_secs()
            ),
            Self::Paused(longest) => write!(
                f,
                "no data of the body arrived for {} s (server.body_pause_s); send it again in one go",
                longest.as_secs()
            ),
            Self::NoMemory(most) => f.write_str(&no_memory(*most)),
        }
    }
}

/// Says that all bodies together fill the memory for them.
pub(super) fn no_memory(most: usize) -> String {
    format!(
        "the bodies of all requests in progress hold {most} bytes, the limit (server.bodies_limit_bytes); try \
         again in a moment"
    )
}

impl std::error::Error for Fault {}

/// The chunks of a body, with its bounds.
struct Chunks {
    body: BodyDataStream,
    watch: BodyWatch,
    settings: Arc<GateSettings>,
    memory: Arc<Semaphore>,
    end: Instant,
    counted: usize,
}

impl BodyWatch {
    /// Bounds a body. A fault ends it with an error; [`Self::problem`] says which fault it was, whatever the
    /// reader made of the error.
    pub fn over(&self, body: Body, settings: &Arc<GateSettings>, memory: &Arc<Semaphore>) -> Body {
        if body.is_end_stream() {
            return body;
        }
        let chunks = Chunks {
            body: body.into_data_stream(),
            watch: self.clone(),
            end: Instant::now() + settings.server.body_timeout,
            settings: Arc::clone(settings),
            memory: Arc::clone(memory),
            counted: 0,
        };
        Body::from_stream(stream::unfold(chunks, |mut chunks| async {
            let next = chunks.next().await?;
            Some((next, chunks))
        }))
    }

    /// The problem to answer instead of the handler's response, and the reason to count it under.
    pub fn problem(&self) -> Option<(Problem, Rejection)> {
        let fault = self.fault.get()?;
        let (kind, reason) = match fault {
            Fault::TookTooLong(_) | Fault::Paused(_) => (ErrorKind::TooSlow, Rejection::Slow),
            Fault::NoMemory(_) => (ErrorKind::Overloaded, Rejection::Bodies),
        };
        Some((Problem::new(kind, fault.to_string()), reason))
    }

    fn fail(&self, fault: Fault) -> axum::Error {
        let _ = self.fault.set(fault);
        axum::Error::new(fault)
    }
}

impl Chunks {
    async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        if self.watch.fault.get().is_some() {
            return None;
        }
        let ServerSettings { body_timeout, body_pause, body_limit_bytes, .. } =
            self.settings.server;
        let pause = Instant::now() + body_pause;
        let chunk = match timeout_at(pause.min(self.end), self.body.next()).await {
            Ok(next) => next?,
            Err(_) if pause < self.end => {
                return Some(Err(self.watch.fail(Fault::Paused(body_pause))));
            }
            Err(_) => return Some(Err(self.watch.fail(Fault::TookTooLong(body_timeout)))),
        };
        let Ok(chunk) = chunk else { return Some(chunk) };
        // The reader stops at the limit; what exceeds it is not kept.
        if self.counted <= body_limit_bytes {
            self.counted += chunk.len();
            if !self.watch.budget.try_add(&self.memory, chunk.len()) {
                let most = self.settings.server.bodies_limit_bytes;
                return Some(Err(self.watch.fail(Fault::NoMemory(most))));
            }
        }
        Some(Ok(chunk))
    }
}
