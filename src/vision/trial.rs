//! The trial of a model before it is installed: it is loaded and run on two pictures, and what it takes and gives is
//! compared with its manifest.

use std::path::Path;
use std::sync::Arc;

use ort::value::{Outlet, TensorElementType, ValueType};

use super::decode::Needed;
use super::execution::Execution;
use super::extractor::{ExtractError, SAMPLES, sample};
use super::manifest::{Input, Manifest, Resize};
use super::one_size::OneSize;
use super::pooling::{Kinds, LocalFeatures, PoolingError};
use super::preprocess::{Tensor, preprocess};
use super::runtime::{Assets, RuntimeError};
use super::session::{InferenceError, Model, Runner};
use super::{ImageLimits, Picture, decode};
use whereabouts_core::{Descriptor, DescriptorKind};

/// Two pictures whose descriptors are more similar than this have the same descriptor.
const SAME: f32 = 0.999_999;

/// Why a model does not do what its manifest says.
#[derive(Debug, thiserror::Error)]
pub enum ModelFault {
    /// ONNX Runtime is missing.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// ONNX Runtime does not load the model.
    #[error(
        "ONNX Runtime cannot load the model: {0}; check that the file is whole, and export it with standard operators \
         and an opset that ONNX Runtime supports"
    )]
    Load(String),
    /// An input or output has another name.
    #[error(
        "the graph has no {role} called {declared:?}, but {}; set {key} in the manifest to the one that {purpose}",
        list(present)
    )]
    Name {
        /// `input` or `output`.
        role: &'static str,
        /// Key of the manifest.
        key: &'static str,
        /// What the key is for.
        purpose: &'static str,
        /// The name in the manifest.
        declared: String,
        /// The names in the graph.
        present: Vec<String>,
    },
    /// The graph needs more inputs than a picture.
    #[error("the graph also needs the inputs {}; export it with the picture as its only input", list(.0))]
    ExtraInputs(Vec<String>),
    /// An input or output has another type.
    #[error(
        "{name:?} has numbers of the type {got}; export the model with inputs and outputs of 32-bit or 16-bit floating \
         point (f32, f16)"
    )]
    Type {
        /// Name of the input or output.
        name: String,
        /// Its type.
        got: String,
    },
    /// The input has another shape.
    #[error(
        "the input {name:?} has the shape {got}, but the manifest declares {declared} (pictures × channels × height × \
         width; -1 is any); change [input] in the manifest, or export the model for that size"
    )]
    InputShape {
        /// Name of the input.
        name: String,
        /// Its shape.
        got: String,
        /// The declared shape.
        declared: String,
    },
    /// The graph takes one size of pictures only, which is another.
    #[error(transparent)]
    OneSize(#[from] OneSize),
    /// The output has another shape.
    #[error(
        "the output {name:?} has the shape {got} on a picture of {width}×{height} pixels, which is not what the manifest \
         declares ({detail}); check layout, channels, stride, cls and registers in [output]"
    )]
    OutputShape {
        /// Name of the output.
        name: String,
        /// Its shape in the graph.
        got: String,
        /// Width of the picture.
        width: usize,
        /// Height of the picture.
        height: usize,
        /// The difference.
        detail: String,
    },
    /// The output has numbers that are not finite.
    #[error(
        "the model gives numbers that are not finite (NaN or infinite) on an ordinary picture; {}",
        if *is_half {
            "it computes with 16 bits, whose range it exceeds: export it with 32 bits"
        } else {
            "its weights are damaged, or input.mean and input.std are not those of its training"
        }
    )]
    NotFinite {
        /// Whether the model computes with 16-bit numbers.
        is_half: bool,
    },
    /// The outputs of different pictures are equal.
    #[error(
        "the model gives the same descriptor for two different pictures; its weights are missing, or the output is not \
         the local features"
    )]
    Constant,
    /// The model fails on a picture.
    #[error(
        "the model fails on a picture of {width}×{height} pixels: {reason}; if it was exported for one size, set that in \
         [input] of the manifest or in model.sizes, or export it for any size"
    )]
    Run {
        /// Width of the picture.
        width: usize,
        /// Height of the picture.
        height: usize,
        /// Message of ONNX Runtime.
        reason: String,
    },
    /// The output cannot be pooled.
    #[error("the output of the model gives no {kind} descriptor: {reason}")]
    Pooling {
        /// The kind of descriptor.
        kind: DescriptorKind,
        /// Cause.
        reason: PoolingError,
    },
    /// The manifest is invalid, or the pictures of the trial cannot be prepared for it.
    #[error(transparent)]
    Manifest(Box<ExtractError>),
}

/// Tries the model in `folder`, which need not be installed. Returns notes about what works with restrictions.
pub fn try_model(assets: &Assets, folder: &Path) -> Result<Vec<String>, ModelFault> {
    let model = open(assets, folder)?;
    run_pictures(&model).map_err(|fault| match fault {
        ModelFault::Load(_) | ModelFault::InputShape { .. } | ModelFault::Run { .. } => {
            OneSize::of(&model).map_or(fault, ModelFault::OneSize)
        }
        fault => fault,
    })
}

fn open(assets: &Assets, folder: &Path) -> Result<Model, ModelFault> {
    let environment = assets.load_onnxruntime(None)?;
    let manifest = assets.manifest(folder).map_err(|error| manifest_fault(error.into()))?;
    let manifest = Arc::new(manifest);
    let file = folder.join(&manifest.file);
    let kinds = Kinds::load(&manifest, folder).map_err(|error| manifest_fault(error.into()))?;
    Ok(Model { environment, file, manifest, kinds: Arc::new(kinds) })
}

fn run_pictures(model: &Model) -> Result<Vec<String>, ModelFault> {
    let Model { manifest, kinds, .. } = model;
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let load = |max_batch| {
        model.load(Execution::REFERENCE, threads, max_batch).map_err(|error| match error {
            // What follows the path of the unfinished installation.
            InferenceError::Load(reason) => {
                let reason = reason.rsplit("failed:").next().unwrap_or_default().trim();
                ModelFault::Load(reason.trim_end_matches('.').to_owned())
            }
            error => ModelFault::Load(error.to_string()),
        })
    };
    let mut runner = load(1)?;
    check_interface(&runner, manifest)?;
    let pictures = sample(&manifest.input).map_err(manifest_fault)?;
    let mut outputs = Vec::new();
    for picture in &pictures {
        outputs.extend(run(&mut runner, &[picture], manifest)?);
    }
    for kind in kinds.names() {
        let descriptors = outputs.iter().map(|output| kinds.descriptor(&kind.into(), output));
        let descriptors: Vec<Descriptor> = descriptors
            .collect::<Result<_, _>>()
            .map_err(|reason| ModelFault::Pooling { kind, reason })?;
        let is_constant = descriptors.windows(2).any(|pair| cosine(&pair[0], &pair[1]) > SAME);
        if is_constant {
            return Err(ModelFault::Constant);
        }
    }
    if manifest.input.resize == Resize::LongestEdge {
        let upright = upright(&manifest.input).map_err(manifest_fault)?;
        run(&mut runner, &[&upright], manifest)?;
    }
    drop(runner);
    let mut runner = load(2)?;
    let together: Vec<&Tensor> = pictures.iter().take(2).collect();
    Ok(match run(&mut runner, &together, manifest) {
        Ok(_) => Vec::new(),
        Err(ModelFault::Run { .. } | ModelFault::OutputShape { .. }) => vec![
            "the graph takes one picture at a time: set model.max_batch = 1, or export it with a dynamic first \
             dimension"
                .to_owned(),
        ],
        Err(fault) => return Err(fault),
    })
}

/// Compares names, types and shapes with the manifest.
fn check_interface(runner: &Runner, manifest: &Manifest) -> Result<(), ModelFault> {
    let (inputs, outputs) = runner.interface();
    let names = |outlets: &[Outlet]| -> Vec<String> {
        outlets.iter().map(|outlet| outlet.name().to_owned()).collect()
    };
    let find =
        |outlets: &'_ [Outlet], name: &str| outlets.iter().position(|outlet| outlet.name() == name);
    let input = &manifest.input;
    let Some(picture) = find(inputs, &input.name) else {
        return Err(ModelFault::Name {
            role: "input",
            key: "input.name",
            purpose: "takes the picture",
            declared: input.name.clone(),
            present: names(inputs),
        });
    };
    let others: Vec<_> = names(inputs).into_iter().filter(|name| *name != input.name).collect();
    if !others.is_empty() {
        return Err(ModelFault::ExtraInputs(others));
    }
    let shape = floating(&inputs[picture])?;
    let declared = match input.resize {
        Resize::LongestEdge => [-1, 3, -1, -1],
        _ => [-1, 3, i64::from(input.height), i64::from(input.width)],
    };
    let fits = |(got, declared): (&i64, &i64)| *got == *declared || *got == -1 || *declared == -1;
    let is_fixed =
        input.resize == Resize::LongestEdge && shape.iter().skip(2).any(|&edge| edge != -1);
    if shape.len() != 4 || is_fixed || !shape.iter().zip(&declared).all(fits) {
        return Err(ModelFault::InputShape {
            name: input.name.clone(),
            got: dimensions(&shape),
            declared: dimensions(&declared),
        });
    }
    let output = &manifest.output;
    let wanted = [
        (Some(&output.features), "output.features", "has the local features"),
        (output.reliability.as_ref(), "output.reliability", "has the reliability map"),
    ];
    for (name, key, purpose) in wanted {
        let Some(name) = name else { continue };
        let Some(position) = find(outputs, name) else {
            return Err(ModelFault::Name {
                role: "output",
                key,
                purpose,
                declared: name.clone(),
                present: names(outputs),
            });
        };
        floating(&outputs[position])?;
    }
    Ok(())
}

/// The shape of an input or output, which must have 32-bit or 16-bit floating-point numbers.
fn floating(outlet: &Outlet) -> Result<Vec<i64>, ModelFault> {
    match outlet.dtype() {
        ValueType::Tensor {
            ty: TensorElementType::Float32 | TensorElementType::Float16,
            shape,
            ..
        } => Ok(shape.to_vec()),
        ValueType::Tensor { ty, .. } => {
            Err(ModelFault::Type { name: outlet.name().to_owned(), got: ty.to_string() })
        }
        other => Err(ModelFault::Type { name: outlet.name().to_owned(), got: other.to_string() }),
    }
}

fn run(
    runner: &mut Runner,
    tensors: &[&Tensor],
    manifest: &Manifest,
) -> Result<Vec<LocalFeatures>, ModelFault> {
    let (width, height) = tensors.first().map_or((0, 0), |tensor| (tensor.width, tensor.height));
    let outputs = runner.run(tensors).map_err(|error| match error {
        InferenceError::Pooling(reason) => ModelFault::OutputShape {
            name: manifest.output.features.clone(),
            got: shape_of(runner, &manifest.output.features),
            width,
            height,
            detail: reason.to_string(),
        },
        InferenceError::Run(reason) => ModelFault::Run { width, height, reason },
        error => ModelFault::Run { width, height, reason: error.to_string() },
    })?;
    let is_finite = |numbers: &[f32]| numbers.iter().all(|number| number.is_finite());
    let all_finite = outputs.iter().all(|output| {
        let more = [&output.cls, &output.reliability];
        is_finite(&output.cells) && more.into_iter().flatten().all(|numbers| is_finite(numbers))
    });
    match all_finite {
        true => Ok(outputs),
        false => Err(ModelFault::NotFinite { is_half: runner.is_half() }),
    }
}

fn shape_of(runner: &Runner, name: &str) -> String {
    let (_, outputs) = runner.interface();
    let output = outputs.iter().find(|output| output.name() == name);
    output
        .and_then(|output| floating(output).ok())
        .map_or_else(String::new, |shape| dimensions(&shape))
}

/// A sample picture in portrait format: a manifest that keeps the aspect ratio needs a graph for any size.
fn upright(input: &Input) -> Result<Tensor, ExtractError> {
    let limits = ImageLimits { max_pixels: 1 << 20 };
    let Picture { pixels, .. } = decode::decode(SAMPLES[0], limits, Needed::All)?;
    let pixels = image::imageops::rotate90(&pixels);
    Ok(preprocess(&pixels, pixels.dimensions(), input)?)
}

fn cosine(a: &Descriptor, b: &Descriptor) -> f32 {
    a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| a * b).sum()
}

fn dimensions(shape: &[i64]) -> String {
    shape.iter().map(i64::to_string).collect::<Vec<_>>().join(" × ")
}

fn list(names: &[String]) -> String {
    match names {
        [] => "none".to_owned(),
        names => names.iter().map(|name| format!("{name:?}")).collect::<Vec<_>>().join(", "),
    }
}

fn manifest_fault(error: ExtractError) -> ModelFault {
    ModelFault::Manifest(Box::new(error))
}
