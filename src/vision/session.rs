//! One model on disk, and the ONNX Runtime sessions that run it.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;

use half::f16;
use ort::environment::Environment;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::session::{Session, SessionInputValue};
use ort::value::{Outlet, TensorElementType, TensorRef, ValueType};

use super::execution::Execution;
use super::manifest::{Input, Manifest, Output, Resize};
use super::pooling::{Kinds, LocalFeatures, PoolingError};
use super::preprocess::Tensor;

impl Output {
    /// Rows and columns of cells in the feature map of a tensor.
    pub(super) fn cells(&self, tensor: &Tensor) -> (usize, usize) {
        let stride = self.stride as usize;
        (tensor.height / stride, tensor.width / stride)
    }
}

/// Why inference failed.
#[derive(Debug, Clone, thiserror::Error)]
pub enum InferenceError {
    /// The model cannot be loaded.
    #[error("the model cannot be loaded: {0}")]
    Load(String),
    /// A run of the session failed.
    #[error("inference failed: {0}")]
    Run(String),
    /// The output of the session cannot be pooled.
    #[error(transparent)]
    Pooling(#[from] PoolingError),
    /// The inference threads have ended.
    #[error("inference has stopped")]
    Stopped,
}

/// A model on disk. Each call to [`Model::load`] creates another session.
#[derive(Debug, Clone)]
pub(super) struct Model {
    pub environment: Arc<Environment>,
    /// Path of the ONNX file.
    pub file: PathBuf,
    pub manifest: Arc<Manifest>,
    pub kinds: Arc<Kinds>,
}

impl Model {
    /// Creates a session with `threads` threads that runs batches of up to `max_batch` pictures.
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
        let is_half = |outlet: &Outlet| {
            matches!(outlet.dtype(), ValueType::Tensor { ty: TensorElementType::Float16, .. })
        };
        let takes_half = session
            .inputs()
            .iter()
            .any(|input| input.name() == self.manifest.input.name && is_half(input));
        Ok(Runner {
            takes_half,
            session,
            manifest: Arc::clone(&self.manifest),
            _environment: Arc::clone(&self.environment),
        })
    }

    /// Configures a session without loading a graph into it.
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
            // Spinning threads would take cores from decoding.
            .with_intra_op_spinning(false)?;
        // ONNX Runtime plans a graph with known shapes better. The dimension names are those used by our
        // exports and by the hub's; ONNX Runtime ignores names that a graph does not have.
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

/// One ONNX Runtime session.
#[derive(Debug)]
pub(super) struct Runner {
    session: Session,
    /// Whether the input has 16-bit numbers.
    takes_half: bool,
    manifest: Arc<Manifest>,
    /// Must outlive the session.
    _environment: Arc<Environment>,
}

impl Runner {
    /// The inputs and outputs of the graph.
    pub fn interface(&self) -> (&[Outlet], &[Outlet]) {
        (self.session.inputs(), self.session.outputs())
    }

    /// Whether the graph takes or gives 16-bit numbers.
    pub fn is_half(&self) -> bool {
        let (inputs, outputs) = self.interface();
        inputs.iter().chain(outputs).any(|outlet| {
            matches!(outlet.dtype(), ValueType::Tensor { ty: TensorElementType::Float16, .. })
        })
    }

    /// Runs a blank picture, because the first run of a session allocates and is slower than others.
    pub fn warm_up(&mut self) -> Result<(), InferenceError> {
        let Input { width, height, .. } = self.manifest.input;
        self.run(&[&Tensor::grey(width as usize, height as usize)]).map(drop)
    }

    /// Runs pictures of the same shape as one batch. Returns the local features of each.
    pub fn run(&mut self, tensors: &[&Tensor]) -> Result<Vec<LocalFeatures>, InferenceError> {
        let failed = |error: ort::Error| InferenceError::Run(error.to_string());
        let (Some(first), count) = (tensors.first(), tensors.len()) else {
            return Ok(Vec::new());
        };
        let Manifest { input, output, .. } = &*self.manifest;
        let shape = [count, 3, first.height, first.width];
        let joined: Vec<f32>;
        let data = if count == 1 {
            first.data.as_slice()
        } else {
            let parts: Vec<&[f32]> = tensors.iter().map(|tensor| tensor.data.as_slice()).collect();
            joined = parts.concat();
            joined.as_slice()
        };
        let half: Vec<f16>;
        let inputs: SessionInputValue = if self.takes_half {
            half = data.iter().map(|&number| f16::from_f32(number)).collect();
            TensorRef::from_array_view((shape, half.as_slice())).map_err(failed)?.into()
        } else {
            TensorRef::from_array_view((shape, data)).map_err(failed)?.into()
        };
        let outputs =
            self.session.run(ort::inputs![input.name.as_str() => inputs]).map_err(failed)?;
        let numbers = |name: &str| -> Result<Cow<[f32]>, InferenceError> {
            let value = outputs.get(name).ok_or_else(|| {
                InferenceError::Run(format!("the model has no output called {name:?}"))
            })?;
            match value.dtype() {
                ValueType::Tensor { ty: TensorElementType::Float16, .. } => {
                    let (_, numbers) = value.try_extract_tensor::<f16>().map_err(failed)?;
                    Ok(numbers.iter().map(|number| number.to_f32()).collect())
                }
                _ => {
                    let numbers = value.try_extract_tensor::<f32>().map_err(failed)?;
                    Ok(Cow::Borrowed(numbers.1))
                }
            }
        };
        let features = numbers(&output.features)?;
        let reliability = output.reliability.as_deref().map(numbers).transpose()?;
        let part = |numbers: &[f32], index: usize| {
            let length = numbers.len() / count;
            index * length..(index + 1) * length
        };
        let cells = output.cells(first);
        let local = (0..count).map(|index| {
            let features = &features[part(&features, index)];
            let reliability = reliability.as_ref().map(|numbers| &numbers[part(numbers, index)]);
            Ok(LocalFeatures::from_output(output, cells, features, reliability)?)
        });
        local.collect()
    }
}
