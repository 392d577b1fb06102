//! The messages of a gRPC call as they come in: bounded one by one in size and time, and all together by
//! memory.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::{Instant, timeout};

use super::guard::too_large;
use super::problem::Problem;
use super::state::HttpSettings;
use crate::grpc::Call;
use crate::service::ErrorKind;

/// Messages of one call that are counted as in memory, beside those that are worked on: the newest behind
/// them, and the one that is coming.
const BEHIND: usize = 2;

/// The bytes before a message: whether it is compressed, and its length.
const PREFIX: usize = 5;

/// Reads along.
struct Messages {
    body: BodyDataStream,
    settings: Arc<HttpSettings>,
    memory: Arc<Semaphore>,
    /// The longest pause between two messages.
    idle: Duration,
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that have come.
    prefix_bytes: usize,
    /// Bytes of the message that are still to come.
    left: usize,
    /// The memory of the last messages, of so many at the most.
    held: VecDeque<OwnedSemaphorePermit>,
    most_held: usize,
    failed: bool,
}

/// Bounds the messages of a call. Its reader hears of what is wrong as a status.
pub(super) fn bounded(
    body: Body,
    call: Call,
    settings: &Arc<HttpSettings>,
    memory: &Arc<Semaphore>,
) -> Body {
    let messages = Messages {
        body: body.into_data_stream(),
        settings: Arc::clone(settings),
        memory: Arc::clone(memory),
        idle: if call.streams { settings.stream_idle } else { settings.body_pause },
        prefix: [0; PREFIX],
        prefix_bytes: 0,
        left: 0,
        held: VecDeque::new(),
        most_held: BEHIND + if call.many { settings.bulk_in_flight } else { 1 },
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
        let pause = if within { self.settings.body_pause } else { self.idle };
        let begun = Instant::now();
        let chunk = match timeout(pause, self.body.next()).await {
            Ok(next) => next?,
            Err(_) => return Some(Err(self.fail(slow(begun.elapsed(), within)))),
        };
        let Ok(chunk) = chunk else { return Some(chunk) };
        Some(match self.count(&chunk) {
            Ok(()) => Ok(chunk),
            Err(problem) => Err(self.fail(problem)),
        })
    }

    /// Follows the prefixes and messages of a chunk; takes memory for each message that begins.
    fn count(&mut self, mut chunk: &[u8]) -> Result<(), Problem> {
        while !chunk.is_empty() {
            if self.left > 0 {
                let of_message = self.left.min(chunk.len());
                self.left -= of_message;
                chunk = &chunk[of_message..];
                continue;
            }
            let of_prefix = (PREFIX - self.prefix_bytes).min(chunk.len());
            self.prefix[self.prefix_bytes..][..of_prefix].copy_from_slice(&chunk[..of_prefix]);
            self.prefix_bytes += of_prefix;
            chunk = &chunk[of_prefix..];
            if self.prefix_bytes == PREFIX {
                let [_, length @ ..] = self.prefix;
                self.begin(u32::from_be_bytes(length))?;
            }
        }
        Ok(())
    }

    fn begin(&mut self, length: u32) -> Result<(), Problem> {
        (self.prefix_bytes, self.left) = (0, length as usize);
        let limit = self.settings.body_limit_bytes;
        if self.left > limit {
            return Err(Problem::new(ErrorKind::TooLarge, too_large(limit)));
        }
        if self.held.len() == self.most_held {
            self.held.pop_front();
        }
        match Arc::clone(&self.memory).try_acquire_many_owned(length) {
            Ok(more) => self.held.push_back(more),
            Err(_) => {
                let detail = format!(
                    "the bodies of all requests in progress hold {} bytes, the bound \
                     (server.bodies_limit_bytes); try again in a moment",
                    self.settings.bodies_limit_bytes
                );
                return Err(Problem::new(ErrorKind::Overloaded, detail));
            }
        }
        Ok(())
    }

    fn fail(&mut self, problem: Problem) -> axum::Error {
        self.failed = true;
        // Who reads the body passes a status on as it is.
        axum::Error::new(tonic::Status::from(problem))
    }
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

    fn settings() -> Arc<HttpSettings> {
        Arc::new(HttpSettings {
            body_limit_bytes: 100,
            bodies_limit_bytes: 250,
            body_timeout: Duration::from_secs(1),
            body_pause: Duration::from_millis(40),
            request_timeout: Duration::from_secs(1),
            max_wait: Duration::from_secs(1),
            max_requests: 1,
            max_streams: 1,
            stream_idle: Duration::from_millis(40),
            bulk_in_flight: 1,
            keys_required: false,
        })
    }

    fn message(length: u32) -> Vec<u8> {
        let mut message = vec![0];
        message.extend(length.to_be_bytes());
        message.resize(PREFIX + length as usize, 7);
        message
    }

    async fn read(chunks: Vec<Vec<u8>>, memory: &Arc<Semaphore>) -> Result<usize, String> {
        let chunks = stream::iter(chunks).map(|chunk| Ok::<_, axum::Error>(Bytes::from(chunk)));
        let body = Body::from_stream(chunks.chain(stream::pending()));
        let call = grpc::call("/whereabouts.v1.LocalizationService/LocalizeStream").unwrap();
        let mut body = bounded(body, call, &settings(), memory).into_data_stream();
        let mut bytes = 0;
        while let Some(chunk) = body.next().await {
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
            let memory = Arc::new(Semaphore::new(250));
            let chunks = all.chunks(cut).map(<[u8]>::to_vec).collect();
            assert_eq!(read(chunks, &memory).await, Ok(all.len()));
            assert_eq!(memory.available_permits(), 250, "all is given back");
        }
        let memory = Arc::new(Semaphore::new(250));
        let many = (0..20).map(|_| message(80)).collect();
        assert_eq!(read(many, &memory).await, Ok(20 * 85), "old ones are not counted for ever");
    }

    #[tokio::test]
    async fn what_is_too_large_or_too_slow_or_too_much_is_refused() {
        let memory = Arc::new(Semaphore::new(250));
        let refused = read(vec![message(101)], &memory).await.unwrap_err();
        assert!(refused.contains("server.body_limit_bytes"), "{refused}");
        let refused = read(vec![message(50)[..20].to_vec()], &memory).await.unwrap_err();
        assert!(refused.contains("nothing of the message"), "{refused}");
        let taken = Arc::clone(&memory).try_acquire_many_owned(200).unwrap();
        let refused = read(vec![message(51)], &memory).await.unwrap_err();
        assert!(refused.contains("server.bodies_limit_bytes"), "{refused}");
        drop(taken);
        assert_eq!(memory.available_permits(), 250);
    }
}
