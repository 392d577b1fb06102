//! The messages of a gRPC call as they come in: bounded one by one in size and time, and all together by
//! memory.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout};

use super::guard::too_large;
use super::incoming::no_memory;
use super::problem::Problem;
use super::state::{AppState, HttpSettings};
use crate::Metrics;
use crate::grpc::{BodyBudget, Call};
use whereabouts_api::ErrorKind;
use whereabouts_service::Rejection;

/// The bytes before a message: whether it is compressed, and its length.
const PREFIX: usize = 5;

/// The largest message of a call that carries no picture, in bytes.
const LARGEST_PLAIN: usize = 64 << 10;

/// Reads along.
struct Messages {
    body: BodyDataStream,
    call: Call,
    settings: Arc<HttpSettings>,
    metrics: Arc<Metrics>,
    /// Of all bodies, or of those of bulk uploads.
    memory: Arc<Semaphore>,
    held: BodyBudget,
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that have come.
    prefix_bytes: usize,
    /// Bytes of the message that are still to come.
    left: usize,
    failed: bool,
}

/// Bounds the messages of a call. Its reader hears of what is wrong as a status. What they take of the memory
/// is in `held`, until the reader takes it from there or the call has been answered.
pub(super) fn bounded(body: Body, call: Call, state: &AppState, held: BodyBudget) -> Body {
    let memory = if call.many { &state.bulk_memory } else { &state.bodies_memory };
    let messages = Messages {
        body: body.into_data_stream(),
        call,
        settings: Arc::clone(&state.settings),
        metrics: Arc::clone(&state.metrics),
        memory: Arc::clone(memory),
        held,
        prefix: [0; PREFIX],
        prefix_bytes: 0,
        left: 0,
        failed: false,
    };
    Body::from_stream(stream::unfold(messages, |mut messages| async {
        let next = messages.next().await?;
        Some((next, messages))
    }))
}

impl Messages {
    async fn next(&mut self) -> Option<Result<Bytes, axum::Error>> {
        if self.failed {
            return None;
        }
        let within = self.left > 0 || self.prefix_bytes > 0;
        let pause = match self.call.streams && !within {
            true => self.settings.stream_idle,
            false => self.settings.body_pause,
        };
        let begun = Instant::now();
        let chunk = match timeout(pause, self.body.next()).await {
            Ok(next) => next?,
            Err(_) => return Some(Err(self.fail(slow(begun.elapsed(), within)))),
        };
        let Ok(chunk) = chunk else { return Some(chunk) };
        Some(match self.count(&chunk).await {
            Ok(()) => Ok(chunk),
            Err(problem) => Err(self.fail(problem)),
        })
    }

    /// Follows the prefixes and messages of a chunk, and takes memory: of many messages for the whole of each
    /// before it has come, or uploads would wait for one another; else for what has come.
    async fn count(&mut self, chunk: &[u8]) -> Result<(), Problem> {
        let mut rest = chunk;
        while !rest.is_empty() {
            if self.left > 0 {
                let of_message = self.left.min(rest.len());
                self.left -= of_message;
                rest = &rest[of_message..];
                continue;
            }
            let of_prefix = (PREFIX - self.prefix_bytes).min(rest.len());
            self.prefix[self.prefix_bytes..][..of_prefix].copy_from_slice(&rest[..of_prefix]);
            self.prefix_bytes += of_prefix;
            rest = &rest[of_prefix..];
            if self.prefix_bytes == PREFIX {
                self.begin().await?;
            }
        }
        if self.call.many || self.held.try_add(&self.memory, chunk.len()) {
            return Ok(());
        }
        let detail = no_memory(self.settings.bodies_limit_bytes);
        Err(Problem::new(ErrorKind::Overloaded, detail))
    }

    /// A message begins.
    async fn begin(&mut self) -> Result<(), Problem> {
        let [_, length @ ..] = self.prefix;
        let length = u32::from_be_bytes(length);
        (self.prefix_bytes, self.left) = (0, length as usize);
        let limit = match self.call.pictures {
            true => self.settings.body_limit_bytes,
            false => LARGEST_PLAIN,
        };
        if self.left > limit {
            return Err(Problem::new(ErrorKind::TooLarge, too_large(limit)));
        }
        if !self.call.many || self.held.is_answered() {
            return Ok(());
        }
        let taking = Arc::clone(&self.memory).acquire_many_owned(length);
        match timeout(self.settings.request_timeout, taking).await {
            Ok(Ok(taken)) => self.held.add(taken),
            _ => return Err(no_bulk_memory()),
        }
        Ok(())
    }

    fn fail(&mut self, problem: Problem) -> axum::Error {
        self.failed = true;
        match problem.kind() {
            ErrorKind::TooSlow => self.metrics.refused(Rejection::Slow),
            ErrorKind::Overloaded => self.metrics.refused(Rejection::Bodies),
            _ => {}
        }
        // Who reads the body passes a status on as it is.
        axum::Error::new(tonic::Status::from(problem))
    }
}

/// The images of bulk uploads have filled the memory that there is for them, for too long.
pub(super) fn no_bulk_memory() -> Problem {
    let detail = "the images of uploads in progress fill the memory that there is for them \
                  (bulk.memory_bytes); try again in a moment";
    Problem::new(ErrorKind::Overloaded, detail)
}

fn slow(pause: Duration, within: bool) -> Problem {
    let seconds = pause.as_secs_f64().round();
    let detail = match within {
        true => format!(
            "nothing of the message came for {seconds} s (server.body_pause_s); send it in one go"
        ),
        false => format!(
            "no message came for {seconds} s (server.stream_idle_s, of a single message \
             server.body_pause_s); call again when there is one"
        ),
    };
    Problem::new(ErrorKind::TooSlow, detail)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grpc;

    const STREAM: &str = "/whereabouts.v1.LocalizationService/LocalizeStream";
    const IMAGES: &str = "/whereabouts.v1.MapService/AddImages";

    fn state() -> AppState {
        AppState::for_tests(HttpSettings {
            body_limit_bytes: 100,
            bodies_limit_bytes: 250,
            bulk_memory_bytes: 150,
            body_timeout: Duration::from_secs(1),
            body_pause: Duration::from_millis(60),
            request_timeout: Duration::from_millis(200),
            max_wait: Duration::from_secs(1),
            max_requests: 1,
            max_streams: 1,
            stream_idle: Duration::from_millis(60),
            keys_required: false,
        })
    }

    fn message(length: u32) -> Vec<u8> {
        let mut message = vec![0];
        message.extend(length.to_be_bytes());
        message.resize(PREFIX + length as usize, 7);
        message
    }

    /// Reads until nothing more comes, and takes what each chunk holds if it is told to.
    async fn read(
        path: &str,
        chunks: Vec<Vec<u8>>,
        state: &AppState,
        takes: bool,
    ) -> Result<usize, String> {
        let chunks = stream::iter(chunks).map(|chunk| Ok::<_, axum::Error>(Bytes::from(chunk)));
        let body = Body::from_stream(chunks.chain(stream::pending()));
        let held = BodyBudget::default();
        let call = grpc::call(path).unwrap();
        let mut body = bounded(body, call, state, held.clone()).into_data_stream();
        let mut bytes = 0;
        while let Some(chunk) = body.next().await {
            if takes {
                drop(held.take());
            }
            match chunk {
                Ok(chunk) => bytes += chunk.len(),
                Err(error) if error.to_string().contains("no message came") => return Ok(bytes),
                Err(error) => return Err(error.to_string()),
            }
        }
        Ok(bytes)
    }

    #[tokio::test]
    async fn messages_are_followed_however_they_are_cut() {
        let all = [message(100), message(0), message(3)].concat();
        for cut in [1, 4, 7, 200] {
            let state = state();
            let chunks = || all.chunks(cut).map(<[u8]>::to_vec).collect();
            assert_eq!(read(STREAM, chunks(), &state, false).await, Ok(all.len()));
            assert_eq!(read(IMAGES, chunks(), &state, false).await, Ok(all.len()));
            assert_eq!(state.bodies_memory.available_permits(), 250, "all is given back");
            assert_eq!(state.bulk_memory.available_permits(), 150);
        }
        let many = || (0..20).map(|_| message(80)).collect();
        assert_eq!(read(STREAM, many(), &state(), true).await, Ok(20 * 85));
        assert_eq!(read(IMAGES, many(), &state(), true).await, Ok(20 * 85));
    }

    #[tokio::test]
    async fn what_is_too_large_or_too_slow_or_too_much_is_refused() {
        let state = state();
        let refused = read(STREAM, vec![message(101)], &state, true).await.unwrap_err();
        assert!(refused.contains("server.body_limit_bytes"), "{refused}");
        let cut = message(50)[..20].to_vec();
        let refused = read(STREAM, vec![cut], &state, true).await.unwrap_err();
        assert!(refused.contains("nothing of the message"), "{refused}");
        let many = || (0..4).map(|_| message(80)).collect();
        let refused = read(STREAM, many(), &state, false).await.unwrap_err();
        assert!(refused.contains("server.bodies_limit_bytes"), "{refused}");
        let refused = read(IMAGES, many(), &state, false).await.unwrap_err();
        assert!(refused.contains("bulk.memory_bytes"), "{refused}");
        // A prefix alone takes nothing.
        let prefix = message(100)[..PREFIX].to_vec();
        let taken = Arc::clone(&state.bodies_memory).try_acquire_many_owned(240).unwrap();
        let refused = read(STREAM, vec![prefix], &state, false).await.unwrap_err();
        assert!(refused.contains("nothing of the message"), "{refused}");
        drop(taken);
        assert_eq!(state.bodies_memory.available_permits(), 250);
        assert_eq!(state.bulk_memory.available_permits(), 150);
    }
}
