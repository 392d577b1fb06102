//! Inference: sessions that take whatever waits as one batch.

use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;

use ort::environment::Environment;
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::TensorRef;

use super::manifest::Manifest;
use super::preprocess::Tensor;
use super::provider::Execution;

/// One picture's part of the output tensors.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RawOutput {
    /// The local features, in the manifest's layout.
    pub features: Vec<f32>,
    /// The reliability map, if the manifest names one.
    pub reliability: Option<Vec<f32>>,
}

/// Why inference gave no answer.
#[derive(Debug, Clone, thiserror::Error)]
pub enum InferenceError {
    /// The model could not be loaded.
    #[error("the model cannot be loaded: {0}")]
    Load(String),
    /// A run failed.
    #[error("inference failed: {0}")]
    Run(String),
    /// The inference threads have ended.
    #[error("inference has stopped")]
    Stopped,
}

/// How inference runs.
#[derive(Debug, Clone, Copy)]
pub(super) struct BatcherSettings {
    /// Sessions that run side by side.
    pub sessions: usize,
    /// The most pictures in one run.
    pub max_batch: usize,
    /// By whom and how.
    pub execution: Execution,
}

/// A model that can be loaded.
#[derive(Debug, Clone, Copy)]
pub(super) struct Model<'a> {
    pub environment: &'a Arc<Environment>,
    /// The ONNX file.
    pub file: &'a Path,
    pub manifest: &'a Arc<Manifest>,
    /// Threads within one session.
    pub threads: usize,
}

struct Request {
    tensor: Tensor,
    answer: SyncSender<Result<RawOutput, InferenceError>>,
}

/// The sessions of one model. No timer holds a request back: a free session takes what is there.
#[derive(Debug, Clone)]
pub(super) struct Batcher {
    queue: SyncSender<Request>,
}

impl Batcher {
    /// Loads the model once for each session.
    pub fn start(model: &Model<'_>, settings: BatcherSettings) -> Result<Self, InferenceError> {
        let (queue, requests) = sync_channel(settings.max_batch.max(1));
        let requests = Arc::new(Mutex::new(requests));
        for index in 0..settings.sessions.max(1) {
            let worker = Worker {
                runner: model.load(settings.execution)?,
                max_batch: settings.max_batch.max(1),
            };
            let requests = Arc::clone(&requests);
            thread::Builder::new()
                .name(format!("inference-{index}"))
                .spawn(move || worker.serve(&requests))
                .map_err(|error| InferenceError::Load(error.to_string()))?;
        }
        Ok(Self { queue })
    }

    /// Runs one picture through the model; blocks the calling thread until the answer is there.
    pub fn infer(&self, tensor: Tensor) -> Result<RawOutput, InferenceError> {
        let (answer, result) = sync_channel(1);
        self.queue.send(Request { tensor, answer }).map_err(|_| InferenceError::Stopped)?;
        result.recv().map_err(|_| InferenceError::Stopped)?
    }
}

impl Model<'_> {
    /// Makes a session.
    pub fn load(&self, execution: Execution) -> Result<Runner, InferenceError> {
        let session = self.session(execution).map_err(|error| {
            InferenceError::Load(format!("{} by {execution}: {error}", self.file.display()))
        })?;
        Ok(Runner {
            session,
            manifest: Arc::clone(self.manifest),
            _environment: Arc::clone(self.environment),
        })
    }

    fn session(&self, execution: Execution) -> Result<Session, ort::Error> {
        let threads = self.threads.max(1);
        let mut builder = Session::builder(self.environment)?
            .with_optimization_level(GraphOptimizationLevel::Level3)?
            .with_intra_threads(threads)?
            // Threads that spin for work take the cores from decoding.
            .with_intra_op_spinning(false)?;
        if let Some(provider) = execution.registration(threads) {
            builder = builder.with_execution_providers([provider])?;
        }
        builder.commit_from_file(self.file)
    }
}

/// One session.
pub(super) struct Runner {
    session: Session,
    manifest: Arc<Manifest>,
    /// It must outlive the session.
    _environment: Arc<Environment>,
}

struct Worker {
    runner: Runner,
    max_batch: usize,
}

impl Worker {
    fn serve(mut self, requests: &Mutex<Receiver<Request>>) {
        while let Some(batch) = self.next_batch(requests) {
            for (tensors, answers) in by_shape(batch) {
                match self.runner.run(&tensors) {
                    Ok(outputs) => {
                        for (answer, output) in answers.iter().zip(outputs) {
                            let _ = answer.send(Ok(output));
                        }
                    }
                    Err(error) => {
                        for answer in &answers {
                            let _ = answer.send(Err(error.clone()));
                        }
                    }
                }
            }
        }
    }

    fn next_batch(&self, requests: &Mutex<Receiver<Request>>) -> Option<Vec<Request>> {
        let requests = requests.lock().unwrap_or_else(PoisonError::into_inner);
        let mut batch = vec![requests.recv().ok()?];
        while batch.len() < self.max_batch
            && let Ok(request) = requests.try_recv()
        {
            batch.push(request);
        }
        Some(batch)
    }
}

impl Runner {
    /// Runs pictures of one shape together.
    pub fn run(&mut self, tensors: &[Tensor]) -> Result<Vec<RawOutput>, InferenceError> {
        let failed = |error: ort::Error| InferenceError::Run(error.to_string());
        let (Some(first), count) = (tensors.first(), tensors.len()) else {
            return Ok(Vec::new());
        };
        let shape = [count, 3, first.height, first.width];
        let joined: Vec<f32>;
        let data = if count == 1 {
            first.data.as_slice()
        } else {
            joined = tensors.iter().flat_map(|tensor| tensor.data.iter().copied()).collect();
            joined.as_slice()
        };
        let input = TensorRef::from_array_view((shape, data)).map_err(failed)?;
        let outputs = self
            .session
            .run(ort::inputs![self.manifest.input.name.as_str() => input])
            .map_err(failed)?;
        let parts = |name: &str| {
            let value = outputs.get(name).ok_or_else(|| {
                InferenceError::Run(format!("the model has no output called {name:?}"))
            })?;
            let (_, numbers) = value.try_extract_tensor::<f32>().map_err(failed)?;
            let each = numbers.len() / count;
            Ok((0..count).map(|i| numbers[i * each..(i + 1) * each].to_vec()).collect::<Vec<_>>())
        };
        let features = parts(&self.manifest.output.features)?;
        let reliability = match &self.manifest.output.reliability {
            Some(name) => parts(name)?.into_iter().map(Some).collect(),
            None => vec![None; count],
        };
        Ok(features
            .into_iter()
            .zip(reliability)
            .map(|(features, reliability)| RawOutput { features, reliability })
            .collect())
    }
}

type Answer = SyncSender<Result<RawOutput, InferenceError>>;

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
