//! Bodies as they come in: bounded by time, and all together by memory.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use axum::body::{Body, BodyDataStream, HttpBody};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout_at};

use super::problem::Problem;
use super::state::HttpSettings;
use crate::grpc::BodyBudget;
use whereabouts_api::ErrorKind;
use whereabouts_service::Rejection;

/// Watches one body. What it takes of the common memory is given back when the request is answered.
#[derive(Debug, Clone, Default)]
pub(super) struct Watch {
    fault: Arc<OnceLock<Fault>>,
    /// What it holds of the memory of all.
    pub held: BodyBudget,
}

/// Why a body was not read to its end.
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
                "nothing of the body came for {} s (server.body_pause_s); send it again in one go",
                longest.as_secs()
            ),
            Self::NoMemory(most) => f.write_str(&no_memory(*most)),
        }
    }
}

/// All bodies together hold as much as they may.
pub(super) fn no_memory(most: usize) -> String {
    format!(
        "the bodies of all requests in progress hold {most} bytes, the bound (server.bodies_limit_bytes); try \
         again in a moment"
    )
}

impl std::error::Error for Fault {}

/// The chunks of a body, and what bounds them.
struct Chunks {
    body: BodyDataStream,
    watch: Watch,
    settings: Arc<HttpSettings>,
    memory: Arc<Semaphore>,
    end: Instant,
    counted: usize,
}

impl Watch {
    /// Bounds a body. A reader hears of a fault as an error of the body; [`Self::problem`] tells
    /// what it was, whoever read it.
    pub fn over(&self, body: Body, settings: &Arc<HttpSettings>, memory: &Arc<Semaphore>) -> Body {
        if body.is_end_stream() {
            return body;
        }
        let chunks = Chunks {
            body: body.into_data_stream(),
            watch: self.clone(),
            end: Instant::now() + settings.body_timeout,
            settings: Arc::clone(settings),
            memory: Arc::clone(memory),
            counted: 0,
        };
        Body::from_stream(stream::unfold(chunks, |mut chunks| async {
            let next = chunks.next().await?;
            Some((next, chunks))
        }))
    }

    /// What is to be answered in the place of any other answer, and what it counts as.
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
        let HttpSettings { body_timeout, body_pause, body_limit_bytes, .. } = *self.settings;
        let pause = Instant::now() + body_pause;
        let chunk = match timeout_at(pause.min(self.end), self.body.next()).await {
            Ok(next) => next?,
            Err(_) if pause < self.end => {
                return Some(Err(self.watch.fail(Fault::Paused(body_pause))));
            }
            Err(_) => return Some(Err(self.watch.fail(Fault::TookTooLong(body_timeout)))),
        };
        let Ok(chunk) = chunk else { return Some(chunk) };
        // Of a body that is too large no more than that is kept.
        if self.counted <= body_limit_bytes {
            self.counted += chunk.len();
            if !self.watch.held.try_add(&self.memory, chunk.len()) {
                let most = self.settings.bodies_limit_bytes;
                return Some(Err(self.watch.fail(Fault::NoMemory(most))));
            }
        }
        Some(Ok(chunk))
    }
}
