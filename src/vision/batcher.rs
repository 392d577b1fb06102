//! The queue in front of inference, and the session threads that serve it.

mod batch;

use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use serde::{Deserialize, Serialize};
use tokio::sync::oneshot;
use whereabouts_core::{DenseFeatures, Descriptor};

use super::execution::Execution;
use super::pooling::{DescriptorSpec, FeatureSet, Kinds};
use super::preprocess::Tensor;
use super::session::{InferenceError, Model, Runner};
use super::sync::{Condvar, Mutex, MutexGuard};

/// How inference divides its threads among sessions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    /// Total inference threads.
    pub threads: usize,
    /// Sessions that run concurrently under load, each with an equal share of the threads. With 1, a
    /// single session runs one batch after another on all threads.
    pub sessions: usize,
    /// Maximum pictures per batch.
    pub max_batch: usize,
}

/// The sessions of one model and the queue in front of them.
///
/// A picture that arrives alone is run at once by the *latency session*, which has all threads. While
/// pictures overlap, *throughput sessions* run concurrently instead, each with its share of the threads:
/// threads that work on separate pictures need not synchronise after every layer, which raises throughput.
/// No timer delays a picture: a free session takes what is waiting as one batch.
///
/// Dropping the batcher joins its threads, because ONNX Runtime is unloaded at process exit and a session
/// that is loading or running at that time would crash.
#[derive(Debug)]
pub(super) struct Batcher {
    queue: Arc<Queue>,
    threads: Vec<JoinHandle<()>>,
}

/// The result for one picture.
#[derive(Debug)]
pub(super) struct Pooled {
    pub descriptor: Descriptor,
    /// The dense features, if they were requested.
    pub dense: Option<DenseFeatures>,
    /// Size of the batch that the picture was part of.
    pub batch: usize,
}

/// A picture in the queue or in a session. Dropping it removes the picture from the queue.
#[derive(Debug)]
pub(super) struct PendingInference(oneshot::Receiver<Result<Pooled, InferenceError>>);

impl PendingInference {
    /// Blocks until the result is available.
    pub fn wait(self) -> Result<Pooled, InferenceError> {
        self.0.blocking_recv().map_err(|_| InferenceError::Stopped)?
    }

    /// Waits for the result.
    pub async fn result(self) -> Result<Pooled, InferenceError> {
        self.0.await.map_err(|_| InferenceError::Stopped)?
    }
}

impl Batcher {
    /// Loads the latency session, which is enough to start serving. Its first run is slower than others.
    pub fn start(
        model: &Model,
        execution: Execution,
        layout: Layout,
    ) -> Result<Self, InferenceError> {
        let threads = layout.threads.max(1);
        let sessions = layout.sessions.clamp(1, threads);
        let layout = Layout { threads, sessions, max_batch: layout.max_batch.max(1) };
        let queue = Arc::new(Queue {
            state: Mutex::default(),
            work_available: Condvar::new(),
            room_available: Condvar::new(),
            layout,
            kinds: Arc::clone(&model.kinds),
        });
        let latency = model.load(execution, threads, layout.max_batch)?;
        let serving = Arc::clone(&queue);
        let serve = move || serving.serve_with(latency, SessionKind::Latency);
        let threads = vec![spawn("inference", serve)?];
        Ok(Self { queue, threads })
    }

    /// Loads the throughput sessions in the background, one after another, so that a core stays free for
    /// pictures that arrive meanwhile.
    pub fn add_throughput_sessions(
        &mut self,
        model: Model,
        execution: Execution,
    ) -> Result<(), InferenceError> {
        let Layout { threads, sessions, .. } = self.queue.layout;
        if sessions == 1 {
            return Ok(());
        }
        self.queue.lock().loading = sessions;
        let queue = Arc::clone(&self.queue);
        self.threads.push(spawn("inference-load", move || {
            let mut serving = Vec::new();
            for index in 0..sessions {
                if queue.lock().closed {
                    break;
                }
                match start_throughput_session(&queue, &model, execution, threads / sessions, index)
                {
                    Ok(thread) => serving.push(thread),
                    Err(error) => tracing::error!(%error, "cannot load a throughput session"),
                }
                queue.lock().loading -= 1;
                queue.room_available.notify_all();
            }
            join(serving);
        })?);
        Ok(())
    }

    /// Blocks until every session has been loaded or has failed to load.
    pub fn wait_until_complete(&self) {
        let mut state = self.queue.lock();
        while state.loading > 0 && !state.closed {
            self.queue.room_available.wait(&mut state);
        }
    }

    /// Queues one picture. Blocks while the queue is full.
    pub fn submit(
        &self,
        tensor: Tensor,
        spec: DescriptorSpec,
        features: FeatureSet,
    ) -> Result<PendingInference, InferenceError> {
        let (reply, result) = oneshot::channel();
        let mut state = self.queue.lock();
        while state.waiting.len() >= self.queue.layout.capacity() && !state.closed {
            self.queue.room_available.wait(&mut state);
        }
        if state.closed {
            return Err(InferenceError::Stopped);
        }
        state.push(Request { tensor, spec, features, reply });
        drop(state);
        self.queue.work_available.notify_all();
        Ok(PendingInference(result))
    }
}

impl Drop for Batcher {
    fn drop(&mut self) {
        self.queue.close();
        join(std::mem::take(&mut self.threads));
    }
}

impl Layout {
    /// Maximum pictures in the queue: twice what the sessions take at once.
    pub(super) fn capacity(self) -> usize {
        2 * self.sessions * self.max_batch
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum SessionKind {
    /// Has all threads; serves pictures that arrive alone.
    Latency,
    /// Has a share of the threads; serves while pictures overlap.
    Throughput,
}

#[derive(Debug)]
struct Request {
    tensor: Tensor,
    spec: DescriptorSpec,
    features: FeatureSet,
    reply: Reply,
}

type Reply = oneshot::Sender<Result<Pooled, InferenceError>>;

/// Each request of a batch with its result.
type Replies = Vec<(Reply, Result<Pooled, InferenceError>)>;

#[derive(Debug)]
struct Queue {
    state: Mutex<State>,
    /// Notified when a session may be able to take a batch.
    work_available: Condvar,
    /// Notified when the queue has room and when a session has been loaded.
    room_available: Condvar,
    layout: Layout,
    kinds: Arc<Kinds>,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Request>,
    /// Throughput sessions that are still to be loaded.
    loading: usize,
    /// Throughput sessions that have been loaded.
    throughput_sessions: usize,
    latency_running: bool,
    throughput_running: usize,
    /// Whether throughput sessions serve the queue.
    throughput_mode: bool,
    /// Whether a picture arrived while another was in progress, since the queue was last idle.
    overlapped: bool,
    closed: bool,
}

impl State {
    fn in_progress(&self) -> bool {
        self.latency_running || self.throughput_running > 0 || !self.waiting.is_empty()
    }

    fn push(&mut self, request: Request) {
        self.overlapped |= self.in_progress();
        self.waiting.push_back(request);
    }

    fn may_take(&self, kind: SessionKind) -> bool {
        let throughput_mode = self.throughput_mode && self.throughput_sessions > 0;
        !self.waiting.is_empty()
            && !self.latency_running
            && match kind {
                SessionKind::Latency => !throughput_mode && self.throughput_running == 0,
                SessionKind::Throughput => throughput_mode,
            }
    }
}

impl Queue {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock()
    }

    /// Stops serving. Callers that are waiting get no result.
    fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        let abandoned = std::mem::take(&mut state.waiting);
        drop(state);
        drop(abandoned);
        self.work_available.notify_all();
        self.room_available.notify_all();
    }

    /// Registers a throughput session that is about to serve, and wakes it: it may have found, while it was not
    /// counted yet, that the pictures in the queue are for the latency session.
    fn add_throughput_session(&self) {
        self.lock().throughput_sessions += 1;
        self.work_available.notify_all();
    }

    /// Runs one batch after another on `runner` until the queue is closed.
    fn serve_with(&self, mut runner: Runner, kind: SessionKind) {
        self.serve(kind, |batch| batch::run(&mut runner, &self.kinds, batch));
    }

    /// Passes one batch after another to `run` until the queue is closed.
    fn serve(&self, kind: SessionKind, mut run: impl FnMut(Vec<Request>) -> Replies) {
        while let Some(batch) = self.take(kind) {
            let running = Running { queue: self, kind };
            let replies = run(batch);
            // End the run before replying: a caller that sends one picture after another must not find
            // its own previous picture in progress.
            drop(running);
            for (reply, result) in replies {
                let _ = reply.send(result);
            }
        }
    }

    /// Waits for the next batch, discarding pictures whose caller has left. Returns `None` once the queue
    /// is closed.
    fn take(&self, kind: SessionKind) -> Option<Vec<Request>> {
        let mut state = self.lock();
        loop {
            if state.closed {
                return None;
            }
            let waiting = state.waiting.len();
            state.waiting.retain(|request| !request.reply.is_closed());
            if state.waiting.len() < waiting {
                self.room_available.notify_all();
            }
            if state.may_take(kind) {
                break;
            }
            self.work_available.wait(&mut state);
        }
        let share = match kind {
            SessionKind::Latency => state.waiting.len(),
            SessionKind::Throughput => state.waiting.len().div_ceil(state.throughput_sessions),
        };
        let batch = state.waiting.drain(..share.min(self.layout.max_batch)).collect();
        match kind {
            SessionKind::Latency => state.latency_running = true,
            SessionKind::Throughput => state.throughput_running += 1,
        }
        drop(state);
        self.room_available.notify_all();
        Some(batch)
    }
}

/// Marks a session as running until it is dropped, even by a panic.
struct Running<'a> {
    queue: &'a Queue,
    kind: SessionKind,
}

impl Drop for Running<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            // Fail the waiting callers instead of leaving them waiting for a dead session.
            return self.queue.close();
        }
        let mut state = self.queue.lock();
        match self.kind {
            SessionKind::Latency => state.latency_running = false,
            SessionKind::Throughput => state.throughput_running -= 1,
        }
        state.throughput_mode |= state.overlapped;
        if !state.in_progress() {
            state.throughput_mode = state.overlapped;
            state.overlapped = false;
        }
        drop(state);
        self.queue.work_available.notify_all();
    }
}

fn start_throughput_session(
    queue: &Arc<Queue>,
    model: &Model,
    execution: Execution,
    threads: usize,
    index: usize,
) -> Result<JoinHandle<()>, InferenceError> {
    let mut runner = model.load(execution, threads, queue.layout.max_batch)?;
    runner.warm_up()?;
    let serving = Arc::clone(queue);
    let serve = move || serving.serve_with(runner, SessionKind::Throughput);
    let thread = spawn(&format!("inference-{index}"), serve)?;
    queue.add_throughput_session();
    Ok(thread)
}

fn spawn(
    name: &str,
    body: impl FnOnce() + Send + 'static,
) -> Result<JoinHandle<()>, InferenceError> {
    let spawned = thread::Builder::new().name(name.to_owned()).spawn(body);
    spawned.map_err(|error| InferenceError::Load(error.to_string()))
}

/// Joins the threads. A panic of one has already been reported by the panic hook.
fn join(threads: Vec<JoinHandle<()>>) {
    for thread in threads {
        let _ = thread.join();
    }
}

#[cfg(test)]
mod schedules;
#[cfg(test)]
mod tests;
