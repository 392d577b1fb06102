//! The queue before inference, and the threads that empty it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use parking_lot::{Condvar, Mutex, MutexGuard};
use serde::{Deserialize, Serialize};
use tokio::sync::oneshot;

use super::preprocess::Tensor;
use super::provider::Execution;
use super::session::{InferenceError, Model, RawOutput, Runner};

/// How inference shares its threads among pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    /// Threads of all inference.
    pub threads: usize,
    /// Pictures that are run side by side while several wait, each by its share of the threads; 1:
    /// one after another, by all threads.
    pub sessions: usize,
    /// The most pictures in one run.
    pub max_batch: usize,
}

/// The sessions of one model.
///
/// A picture that comes alone is run at once by the *wide* session, which has all threads. While
/// pictures overlap, *narrow* sessions run side by side instead, each with its share of the threads:
/// threads that work on pictures of their own need not wait for each other after every layer, so that
/// more pictures are done in the same time. No timer holds a picture back: a free session takes what
/// waits as one batch.
///
/// Dropping it waits until its threads have ended: ONNX Runtime goes when the process ends, and a session
/// that is loaded or runs meanwhile would crash.
#[derive(Debug)]
pub(super) struct Batcher {
    queue: Arc<Queue>,
    threads: Vec<JoinHandle<()>>,
}

/// An answer that is to come. Dropping it takes the picture out of the queue.
#[derive(Debug)]
pub(super) struct PendingInference(oneshot::Receiver<Result<RawOutput, InferenceError>>);

impl PendingInference {
    /// Blocks until the answer is there.
    pub fn wait(self) -> Result<RawOutput, InferenceError> {
        self.0.blocking_recv().map_err(|_| InferenceError::Stopped)?
    }

    /// Waits for the answer.
    pub async fn answer(self) -> Result<RawOutput, InferenceError> {
        self.0.await.map_err(|_| InferenceError::Stopped)?
    }
}

impl Batcher {
    /// Loads the wide session, which is enough to begin with. Its first run takes longer than others.
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
            work: Condvar::new(),
            room: Condvar::new(),
            layout,
        });
        let wide = model.load(execution, threads, layout.max_batch)?;
        let serving = Arc::clone(&queue);
        let threads = vec![spawn("inference", move || serving.serve(wide, Kind::Wide))?];
        Ok(Self { queue, threads })
    }

    /// Loads the narrow sessions in the background, one after another, so that a core is left for
    /// those who come meanwhile.
    pub fn add_narrow(&mut self, model: Model, execution: Execution) -> Result<(), InferenceError> {
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
                match add_narrow(&queue, &model, execution, threads / sessions, index) {
                    Ok(thread) => serving.push(thread),
                    Err(error) => tracing::error!(%error, "there is one session less"),
                }
                queue.lock().loading -= 1;
                queue.room.notify_all();
            }
            join(serving);
        })?);
        Ok(())
    }

    /// Blocks until every session is loaded, or cannot be.
    pub fn wait_until_complete(&self) {
        let mut state = self.queue.lock();
        while state.loading > 0 && !state.closed {
            self.queue.room.wait(&mut state);
        }
    }

    /// Hands in one picture; blocks while the queue is full.
    pub fn submit(&self, tensor: Tensor) -> Result<PendingInference, InferenceError> {
        let (answer, inferring) = oneshot::channel();
        let mut state = self.queue.lock();
        while state.waiting.len() >= self.queue.layout.capacity() && !state.closed {
            self.queue.room.wait(&mut state);
        }
        if state.closed {
            return Err(InferenceError::Stopped);
        }
        state.overlapped |= state.in_progress();
        state.waiting.push_back(Request { tensor, answer });
        drop(state);
        self.queue.work.notify_all();
        Ok(PendingInference(inferring))
    }
}

impl Drop for Batcher {
    fn drop(&mut self) {
        self.queue.close();
        join(std::mem::take(&mut self.threads));
    }
}

impl Layout {
    /// Pictures that wait at the most: twice what the sessions take at once.
    pub(super) fn capacity(self) -> usize {
        2 * self.sessions * self.max_batch
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Wide,
    Narrow,
}

#[derive(Debug)]
struct Request {
    tensor: Tensor,
    answer: Answer,
}

type Answer = oneshot::Sender<Result<RawOutput, InferenceError>>;

#[derive(Debug)]
struct Queue {
    state: Mutex<State>,
    /// Told when there may be something to do.
    work: Condvar,
    /// Told when there is room for another picture, and when a session is loaded.
    room: Condvar,
    layout: Layout,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<Request>,
    /// Narrow sessions that are not loaded yet, and that are.
    loading: usize,
    narrow_sessions: usize,
    wide_runs: bool,
    narrow_runs: usize,
    /// Whether narrow sessions take what comes.
    crowded: bool,
    /// Whether a picture came while another was in progress, since none was.
    overlapped: bool,
    closed: bool,
}

impl State {
    fn in_progress(&self) -> bool {
        self.wide_runs || self.narrow_runs > 0 || !self.waiting.is_empty()
    }

    fn may_take(&self, kind: Kind) -> bool {
        let crowded = self.crowded && self.narrow_sessions > 0;
        !self.waiting.is_empty()
            && !self.wide_runs
            && match kind {
                Kind::Wide => !crowded && self.narrow_runs == 0,
                Kind::Narrow => crowded,
            }
    }
}

impl Queue {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock()
    }

    fn close(&self) {
        self.lock().closed = true;
        self.work.notify_all();
        self.room.notify_all();
    }

    /// Runs one batch after another until the queue is closed.
    fn serve(&self, mut runner: Runner, kind: Kind) {
        while let Some(batch) = self.take(kind) {
            let run = Run { queue: self, kind };
            let mut answered: Vec<(Answer, Result<RawOutput, InferenceError>)> = Vec::new();
            for (tensors, answers) in by_shape(batch) {
                match runner.run(&tensors) {
                    Ok(outputs) => {
                        answered.extend(answers.into_iter().zip(outputs.into_iter().map(Ok)))
                    }
                    Err(error) => {
                        answered
                            .extend(answers.into_iter().map(|answer| (answer, Err(error.clone()))));
                    }
                }
            }
            // Before the answers: whoever sends one picture after another is alone each time.
            drop(run);
            for (answer, result) in answered {
                let _ = answer.send(result);
            }
        }
    }

    /// Waits for something to do, less what nobody waits for any more; `None` when closed.
    fn take(&self, kind: Kind) -> Option<Vec<Request>> {
        let mut state = self.lock();
        loop {
            if state.closed {
                return None;
            }
            let waiting = state.waiting.len();
            state.waiting.retain(|request| !request.answer.is_closed());
            if state.waiting.len() < waiting {
                self.room.notify_all();
            }
            if state.may_take(kind) {
                break;
            }
            self.work.wait(&mut state);
        }
        let fair = match kind {
            Kind::Wide => state.waiting.len(),
            Kind::Narrow => state.waiting.len().div_ceil(state.narrow_sessions),
        };
        let batch = state.waiting.drain(..fair.min(self.layout.max_batch)).collect();
        match kind {
            Kind::Wide => state.wide_runs = true,
            Kind::Narrow => state.narrow_runs += 1,
        }
        drop(state);
        self.room.notify_all();
        Some(batch)
    }
}

/// A run in progress; its end is noted whatever becomes of it.
struct Run<'a> {
    queue: &'a Queue,
    kind: Kind,
}

impl Drop for Run<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            // Whoever waits should hear of it rather than wait for ever.
            return self.queue.close();
        }
        let mut state = self.queue.lock();
        match self.kind {
            Kind::Wide => state.wide_runs = false,
            Kind::Narrow => state.narrow_runs -= 1,
        }
        state.crowded |= state.overlapped;
        if !state.in_progress() {
            state.crowded = state.overlapped;
            state.overlapped = false;
        }
        drop(state);
        self.queue.work.notify_all();
    }
}

fn add_narrow(
    queue: &Arc<Queue>,
    model: &Model,
    execution: Execution,
    threads: usize,
    index: usize,
) -> Result<JoinHandle<()>, InferenceError> {
    let mut runner = model.load(execution, threads, queue.layout.max_batch)?;
    runner.warm_up()?;
    let serving = Arc::clone(queue);
    let thread = spawn(&format!("inference-{index}"), move || serving.serve(runner, Kind::Narrow))?;
    queue.lock().narrow_sessions += 1;
    Ok(thread)
}

fn spawn(
    name: &str,
    body: impl FnOnce() + Send + 'static,
) -> Result<JoinHandle<()>, InferenceError> {
    let spawned = thread::Builder::new().name(name.to_owned()).spawn(body);
    spawned.map_err(|error| InferenceError::Load(error.to_string()))
}

/// Waits until these threads have ended; what one panicked about has been told where it did.
fn join(threads: Vec<JoinHandle<()>>) {
    for thread in threads {
        let _ = thread.join();
    }
}

/// Groups a batch by the shape of its tensors: only like shapes run together.
fn by_shape(batch: Vec<Request>) -> Vec<(Vec<Tensor>, Vec<Answer>)> {
    let mut groups: Vec<(Vec<Tensor>, Vec<Answer>)> = Vec::new();
    for Request { tensor, answer } in batch {
        let like = |group: &&mut (Vec<Tensor>, Vec<Answer>)| {
            group.0[0].height == tensor.height && group.0[0].width == tensor.width
        };
        match groups.iter_mut().find(like) {
            Some(group) => {
                group.0.push(tensor);
                group.1.push(answer);
            }
            None => groups.push((vec![tensor], vec![answer])),
        }
    }
    groups
}

#[cfg(test)]
mod tests;
