//! An ONNX model with one input and one output.

use std::path::Path;
use std::sync::Arc;

use ort::environment::Environment;
use ort::logging::LogLevel;
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::TensorRef;
use parking_lot::Mutex;

use super::ReadError;

/// A loaded model. It runs one batch at a time; other callers wait.
#[derive(Debug)]
pub(super) struct Model {
    session: Mutex<Session>,
    /// Name of the input.
    input: String,
    /// Must outlive the session.
    _environment: Arc<Environment>,
}

impl Model {
    pub fn load(
        environment: &Arc<Environment>,
        file: &Path,
        threads: usize,
    ) -> Result<Self, ReadError> {
        let damaged = |error: &dyn std::fmt::Display| {
            ReadError::File(format!("{} cannot be loaded: {error}", file.display()))
        };
        let session = Session::builder(environment)
            .and_then(
                |builder| Ok(builder.with_optimization_level(GraphOptimizationLevel::Level3)?),
            )
            .and_then(|builder| Ok(builder.with_intra_threads(threads.max(1))?))
            // The models declare shapes of outputs that their nodes contradict, which is a warning at each start.
            .and_then(|builder| Ok(builder.with_log_level(LogLevel::Error)?))
            // Spinning threads would take cores from requests.
            .and_then(|builder| Ok(builder.with_intra_op_spinning(false)?))
            .and_then(|mut builder| builder.commit_from_file(file))
            .map_err(|error| damaged(&error))?;
        let input = session.inputs().first().map(|input| input.name().to_owned());
        let input = input.ok_or_else(|| damaged(&"it has no input"))?;
        Ok(Self { session: Mutex::new(session), input, _environment: Arc::clone(environment) })
    }

    /// Runs a batch of this shape, and calls `use_output` with the shape and the numbers of the output.
    pub fn run<T>(
        &self,
        shape: [usize; 4],
        numbers: &[f32],
        use_output: impl FnOnce(&[i64], &[f32]) -> Result<T, ReadError>,
    ) -> Result<T, ReadError> {
        let tensor = TensorRef::from_array_view((shape, numbers))?;
        let mut session = self.session.lock();
        let outputs = session.run(ort::inputs![self.input.as_str() => tensor])?;
        let (_, output) = outputs
            .iter()
            .next()
            .ok_or_else(|| ReadError::Model("the model has no output".into()))?;
        let (shape, numbers) = output.try_extract_tensor::<f32>()?;
        use_output(shape, numbers)
    }
}
