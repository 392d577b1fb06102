//! One model, loaded once: tensors in, numbers out.

use std::path::PathBuf;
use std::sync::Arc;

use ort::environment::Environment;
use ort::session::Session;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::value::TensorRef;

use super::manifest::{Input, Manifest, Output, Resize};
use super::pooling::{LocalFeatures, PoolingError};
use super::preprocess::Tensor;
use super::provider::Execution;

/// One picture's part of the output tensors.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct RawOutput {
    /// The local features, in the manifest's layout.
    pub features: Vec<f32>,
    /// The reliability map, if the manifest names one.
    pub reliability: Option<Vec<f32>>,
    /// Pictures that were run together, this one included.
    pub batch: usize,
}

impl RawOutput {
    /// The local features of a picture of so many cells (rows, columns).
    pub fn local_features(
        &self,
        output: &Output,
        cells: (usize, usize),
    ) -> Result<LocalFeatures, PoolingError> {
        LocalFeatures::from_output(output, cells, &self.features, self.reliability.as_deref())
    }
}

impl Output {
    /// Rows and columns of cells in a tensor.
    pub(super) fn cells(&self, tensor: &Tensor) -> (usize, usize) {
        let stride = self.stride as usize;
        (tensor.height / stride, tensor.width / stride)
    }
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

/// A model that can be loaded, as often as sessions are wanted.
#[derive(Debug, Clone)]
pub(super) struct Model {
    pub environment: Arc<Environment>,
    /// The ONNX file.
    pub file: PathBuf,
    pub manifest: Arc<Manifest>,
}

impl Model {
    /// Makes a session of so many threads, whose runs are of at most `max_batch` pictures.
    pub fn load(
        &self,
        execution: Execution,
        threads: usize,
        max_batch: usize,
    ) -> Result<Runner, InferenceError> {
        let session = self
            .builder(execution, threads, max_batch)
            .and_then(|mut builder| builder.commit_from_file(&self.file))
            .map_err(|error| {
                InferenceError::Load(format!("{} by {execution}: {error}", self.file.display()))
            })?;
        Ok(Runner {
            session,
            manifest: Arc::clone(&self.manifest),
            _environment: Arc::clone(&self.environment),
        })
    }

    /// A session of so many threads that has no graph yet.
    pub fn builder(
        &self,
        execution: Execution,
        threads: usize,
        max_batch: usize,
    ) -> Result<SessionBuilder, ort::Error> {
        let threads = threads.max(1);
        let builder = Session::builder(&self.environment)?
            .with_optimization_level(GraphOptimizationLevel::Level3)?
            .with_intra_threads(threads)?
            // Threads that spin for work take the cores from decoding.
            .with_intra_op_spinning(false)?;
        // A graph whose shapes are known is planned better. The names are those of our exports and of
        // the hub's; one that a graph does not have is passed over.
        let Input { resize, width, height, .. } = self.manifest.input;
        let builder = match resize {
            Resize::LongestEdge => builder,
            Resize::Squash | Resize::CentreCrop => builder
                .with_dimension_override("height", i64::from(height))?
                .with_dimension_override("width", i64::from(width))?,
        };
        let builder = match max_batch {
            1 => {
                let one = builder.with_dimension_override("batch", 1)?;
                one.with_dimension_override("batch_size", 1)?
            }
            _ => builder,
        };
        match execution.registration(threads) {
            Some(provider) => Ok(builder.with_execution_providers([provider])?),
            None => Ok(builder),
        }
    }
}

/// One session.
#[derive(Debug)]
pub(super) struct Runner {
    session: Session,
    manifest: Arc<Manifest>,
    /// It must outlive the session.
    _environment: Arc<Environment>,
}

impl Runner {
    /// Runs once on nothing in particular: the first run of a graph allocates and optimises.
    pub fn warm_up(&mut self) -> Result<(), InferenceError> {
        let Input { width, height, .. } = self.manifest.input;
        self.run(&[Tensor::grey(width as usize, height as usize)]).map(drop)
    }

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
            let parts: Vec<&[f32]> = tensors.iter().map(|tensor| tensor.data.as_slice()).collect();
            joined = parts.concat();
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
            .map(|(features, reliability)| RawOutput { features, reliability, batch: count })
            .collect())
    }
}
