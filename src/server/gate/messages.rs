//! Bounds the messages of a gRPC call as they arrive: the size and time of each, and the memory of all
//! together.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use bytes::Bytes;
use futures_util::{StreamExt, stream};
use tokio::sync::Semaphore;
use tokio::time::{Instant, timeout};

use super::body::too_large;
use super::body_budget::BodyBudget;
use super::incoming::no_memory;
use super::policy::RoutePolicy;
use super::problem::Problem;
use super::state::{Gate, GateSettings, no_bulk_memory};
use crate::Metrics;
use whereabouts_api::ErrorKind;
use whereabouts_service::Rejection;

/// Bytes before each message: whether it is compressed, and its length.
const PREFIX: usize = 5;

/// Largest message of a call without pictures, in bytes.
const LARGEST_PLAIN: usize = 64 << 10;

/// Follows the framing of a body while its reader reads it.
struct Messages {
    body: BodyDataStream,
    policy: RoutePolicy,
    settings: Arc<GateSettings>,
    metrics: Arc<Metrics>,
    /// The memory of all bodies, or of those of bulk uploads.
    memory: Arc<Semaphore>,
    budget: BodyBudget,
    prefix: [u8; PREFIX],
    /// Bytes of the prefix that have arrived.
    prefix_bytes: usize,
    /// Bytes of the message that have not arrived yet.
    missing: usize,
    failed: bool,
}

/// Bounds the messages of a call; its reader gets a fault as a status. The memory of the messages is held in
/// `budget` until the reader takes it over or the call is answered.
pub(super) fn bounded(body: Body, policy: RoutePolicy, gate: &Gate, budget: BodyBudget) -> Body {
    let memory = if policy.bulk { &gate.bulk_memory } else { &gate.bodies_memory };
    let messages = Messages {
        body: body.into_data_stream(),
        policy,
        settings: Arc::clone(&gate.settings),
        metrics: Arc::clone(&gate.metrics),
        memory: Arc::clone(memory),
        budget,
        prefix: [0; PREFIX],
        prefix_bytes: 0,
        missing: 0,
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
        let within = self.missing > 0 || self.prefix_bytes > 0;
        let pause = match self.policy.streams && !within {
            true => self.settings.server.stream_idle,
            false => self.settings.server.body_pause,
        };
        let start = Instant::now();
        let chunk = match timeout(pause, self.body.next()).await {
            Ok(next) => next?,
            Err(_) => return Some(Err(self.fail(slow(start.elapsed(), within)))),
        };
        let Ok(chunk) = chunk else { return Some(chunk) };
        Some(match self.count(&chunk).await {
            Ok(()) => Ok(chunk),
            Err(problem) => Err(self.fail(problem)),
        })
    }

    /// Follows the framing of a chunk, and reserves memory for it. A bulk upload reserves the whole of each
    /// message in advance: two uploads that each hold half a message would wait for each other.
    async fn count(&mut self, chunk: &[u8]) -> Result<(), Problem> {
        let mut rest = chunk;
        while !rest.is_empty() {
            if self.missing > 0 {
                let of_message = self.missing.min(rest.len());
                self.missing -= of_message;
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
        if self.policy.bulk || self.budget.try_add(&self.memory, chunk.len()) {
            return Ok(());
        }
        let detail = no_memory(self.settings.server.bodies_limit_bytes);
        Err(Problem::new(ErrorKind::Overloaded, detail))
    }

    /// Reads the prefix of a message.
    async fn begin(&mut self) -> Result<(), Problem> {
        let [_, length @ ..] = self.prefix;
        let length = u32::from_be_bytes(length);
        (self.prefix_bytes, self.missing) = (0, length as usize);
        let limit = match self.policy.pictures {
            true => self.settings.server.body_limit_bytes,
            false => LARGEST_PLAIN,
        };
        if self.missing > limit {
            return Err(Problem::new(ErrorKind::TooLarge, too_large(limit)));
        }
        if !self.policy.bulk || self.budget.is_closed() {
            return Ok(());
        }
        let permit = Arc::clone(&self.memory).acquire_many_owned(length);
        match timeout(self.settings.server.request_timeout, permit).await {
            Ok(Ok(permit)) => self.budget.add(permit),
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
        // tonic passes a status within the error on to the client.
        axum::Error::new(tonic::Status::from(problem))
    }
}

fn slow(pause: Duration, within: bool) -> Problem {
    let seconds = pause.as_secs_f64().round();
    let detail = match within {
        true => format!(
            "no data of the message arrived for {seconds} s (server.body_pause_s); send it in one go"
        ),
        false => format!(
            "no message arrived for {seconds} s (server.stream_idle_s, of a single message \
             server.body_pause_s); call again when there is one"
        ),
    };
    Problem::new(ErrorKind::TooSlow, detail)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gate::policy::RoutePolicy;

    const STREAM: RoutePolicy = RoutePolicy::robot().grpc().streams().pictures();
    const IMAGES: RoutePolicy = RoutePolicy::operator().grpc().bulk().pictures();

    fn gate() -> Gate {
        Gate::new(GateSettings::small(), Arc::default())
    }

    fn message(length: u32) -> Vec<u8> {
        let mut message = vec![0];
        message.extend(length.to_be_bytes());
        message.resize(PREFIX + length as usize, 7);
        message
    }

    /// Reads until nothing more arrives; `takes` over the memory of each chunk, as a handler does.
    async fn read(
        policy: RoutePolicy,
        chunks: Vec<Vec<u8>>,
        gate: &Gate,
        takes: bool,
    ) -> Result<usize, String> {
        let chunks = stream::iter(chunks).map(|chunk| Ok::<_, axum::Error>(Bytes::from(chunk)));
        let body = Body::from_stream(chunks.chain(stream::pending()));
        let budget = BodyBudget::default();
        let mut body = bounded(body, policy, gate, budget.clone()).into_data_stream();
        let mut bytes = 0;
        while let Some(chunk) = body.next().await {
            if takes {
                drop(budget.take());
            }
            match chunk {
                Ok(chunk) => bytes += chunk.len(),
                Err(error) if error.to_string().contains("no message arrived") => return Ok(bytes),
                Err(error) => return Err(error.to_string()),
            }
        }
        Ok(bytes)
    }

    #[tokio::test]
    async fn message_framing_is_followed_across_chunk_boundaries() {
        let all = [message(100), message(0), message(3)].concat();
        for cut in [1, 4, 7, 200] {
            let gate = gate();
            let chunks = || all.chunks(cut).map(<[u8]>::to_vec).collect();
            assert_eq!(read(STREAM, chunks(), &gate, false).await, Ok(all.len()));
            assert_eq!(read(IMAGES, chunks(), &gate, false).await, Ok(all.len()));
            assert_eq!(gate.bodies_memory.available_permits(), 250, "everything is released");
            assert_eq!(gate.bulk_memory.available_permits(), 150);
        }
        let many = || (0..20).map(|_| message(80)).collect();
        assert_eq!(read(STREAM, many(), &gate(), true).await, Ok(20 * 85));
        assert_eq!(read(IMAGES, many(), &gate(), true).await, Ok(20 * 85));
    }

    #[tokio::test]
    async fn messages_beyond_the_size_time_or_memory_bound_are_refused() {
        let gate = gate();
        let refused = read(STREAM, vec![message(101)], &gate, true).await.unwrap_err();
        assert!(refused.contains("server.body_limit_bytes"), "{refused}");
        let cut = message(50)[..20].to_vec();
        let refused = read(STREAM, vec![cut], &gate, true).await.unwrap_err();
        assert!(refused.contains("no data of the message"), "{refused}");
        let many = || (0..4).map(|_| message(80)).collect();
        let refused = read(STREAM, many(), &gate, false).await.unwrap_err();
        assert!(refused.contains("server.bodies_limit_bytes"), "{refused}");
        let refused = read(IMAGES, many(), &gate, false).await.unwrap_err();
        assert!(refused.contains("bulk.memory_bytes"), "{refused}");
        // A prefix alone reserves nothing.
        let prefix = message(100)[..PREFIX].to_vec();
        let reserved = Arc::clone(&gate.bodies_memory).try_acquire_many_owned(240).unwrap();
        let refused = read(STREAM, vec![prefix], &gate, false).await.unwrap_err();
        assert!(refused.contains("no data of the message"), "{refused}");
        drop(reserved);
        assert_eq!(gate.bodies_memory.available_permits(), 250);
        assert_eq!(gate.bulk_memory.available_permits(), 150);
    }
}
