//! From the bytes of a picture to its descriptor and dense features.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::batcher::{Batcher, Layout, PendingInference};
use super::decode::{DecodeError, ImageLimits, Needed, Picture, decode, encode_jpeg};
use super::manifest::{Input, MANIFEST, Manifest, ManifestError, file_digest};
use super::pooling::PoolingError;
use super::preprocess::{self, PreprocessError, Tensor, preprocess};
use super::provider::{self, Execution, Provider, ProviderPreference};
use super::runtime::{Assets, RuntimeError};
use super::session::{InferenceError, Model, RawOutput};
use whereabouts_core::{DenseFeatures, Descriptor, DescriptorKind, Digest, MediaType};

/// How pictures are decoded and run through the model.
#[derive(Debug, Clone)]
pub struct ExtractorSettings {
    /// The model's name.
    pub model: String,
    /// How inference shares its threads among pictures.
    pub layout: Layout,
    /// By whom and at which precision it may be run.
    pub preference: ProviderPreference,
    /// Where the choice among these is remembered; measured at each start if nowhere.
    pub choice_file: Option<PathBuf>,
    /// Bounds on a picture.
    pub limits: ImageLimits,
    /// Whether every pixel of a large JPEG is decoded before it is scaled down.
    pub exact_decode: bool,
}

impl ExtractorSettings {
    /// One session of a model on the CPU at full precision, one picture at a time, exactly decoded.
    pub fn plain(model: &str, threads: usize, limits: ImageLimits) -> Self {
        let reference = Execution::REFERENCE;
        Self {
            model: model.into(),
            layout: Layout { threads, sessions: 1, max_batch: 1 },
            preference: ProviderPreference {
                provider: Some(reference.provider),
                precision: Some(reference.precision),
            },
            choice_file: None,
            limits,
            exact_decode: true,
        }
    }
}

/// One loaded model with everything around it. Its calls block; run them on a pool thread.
#[derive(Debug)]
pub struct Extractor {
    manifest: Arc<Manifest>,
    digest: Digest,
    batcher: Batcher,
    execution: Execution,
    limits: ImageLimits,
    exact_decode: bool,
}

/// A picture that was handed to inference. Dropping it gives that up.
#[derive(Debug)]
pub struct PendingExtraction {
    shown: DecodedMeta,
    inferring: PendingInference,
}

/// What inference gave for one picture.
#[derive(Debug)]
pub struct Inference {
    shown: DecodedMeta,
    raw: RawOutput,
}

#[derive(Debug)]
struct DecodedMeta {
    width: u32,
    height: u32,
    media_type: MediaType,
    cells: (usize, usize),
    decode: Duration,
    decoded: Instant,
}

impl PendingExtraction {
    /// Waits for inference.
    pub async fn inferred(self) -> Result<Inference, ExtractError> {
        Ok(Inference { raw: self.inferring.answer().await?, shown: self.shown })
    }
}

/// What was extracted from one picture.
#[derive(Debug)]
pub struct Extraction {
    /// The global descriptor.
    pub descriptor: Descriptor,
    /// The local features.
    pub dense: DenseFeatures,
    /// The picture's format.
    pub media_type: MediaType,
    /// Width in pixels, upright.
    pub width: u32,
    /// Height in pixels, upright.
    pub height: u32,
    /// How long the stages took.
    pub times: StageTimes,
    /// Pictures that the model was run on together, this one included.
    pub batch: usize,
}

/// How long the stages of one extraction took.
#[derive(Debug, Clone, Copy, Default)]
pub struct StageTimes {
    /// Decoding and resizing.
    pub decode: Duration,
    /// Waiting for a session, inference and pooling.
    pub extract: Duration,
}

/// Why nothing could be extracted.
#[derive(Debug, thiserror::Error)]
pub enum ExtractError {
    /// The bytes are no picture.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The picture cannot be resized.
    #[error(transparent)]
    Preprocess(#[from] PreprocessError),
    /// The model failed.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The output cannot be pooled.
    #[error(transparent)]
    Pooling(#[from] PoolingError),
    /// The model's manifest is wrong.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// ONNX Runtime or the model is missing.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// The model file cannot be read or is not the one that the manifest pins.
    #[error("{0}")]
    ModelFile(String),
    /// Nobody wanted the answer any more.
    #[error("the caller has gone")]
    Abandoned,
}

impl Extractor {
    /// Loads a model and checks it by running one picture through it.
    pub fn load(assets: &Assets, settings: &ExtractorSettings) -> Result<Self, ExtractError> {
        let Opened { model, digest } =
            Opened::open(assets, &settings.model, settings.preference.provider)?;
        let execution = chosen(&model, digest, settings)?;
        let batcher = Batcher::start(&model, execution, settings.layout)?;
        let mut extractor = Self {
            manifest: Arc::clone(&model.manifest),
            digest,
            batcher,
            execution,
            limits: settings.limits,
            exact_decode: settings.exact_decode,
        };
        extractor.check()?;
        extractor.batcher.add_narrow(model, execution)?;
        Ok(extractor)
    }

    /// What the model says about itself.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The digest of all that decides a descriptor: weights, and how they are fed and pooled.
    pub fn digest(&self) -> Digest {
        self.digest
    }

    /// Who runs the model, and at which precision.
    pub fn execution(&self) -> Execution {
        self.execution
    }

    /// Bounds on the pictures it takes.
    pub fn limits(&self) -> ImageLimits {
        self.limits
    }

    /// Decodes a picture, runs it through the model and makes its descriptor; blocks.
    pub fn extract(&self, bytes: &[u8], kind: DescriptorKind) -> Result<Extraction, ExtractError> {
        let PendingExtraction { shown, inferring } = self.begin(bytes, || true)?;
        self.finish(Inference { shown, raw: inferring.wait()? }, kind)
    }

    /// Decodes a picture and hands it to inference; blocks for the one, and while the queue before
    /// the other is full. What is no longer `wanted` once it is decoded goes no further.
    pub fn begin(
        &self,
        bytes: &[u8],
        wanted: impl Fn() -> bool,
    ) -> Result<PendingExtraction, ExtractError> {
        let start = Instant::now();
        let input = &self.manifest.input;
        let needed = if self.exact_decode { Needed::All } else { preprocess::needed(input) };
        let Picture { pixels, width, height, media_type } = decode(bytes, self.limits, needed)?;
        let tensor = preprocess(&pixels, (width, height), input)?;
        drop(pixels);
        let cells = self.manifest.output.cells(&tensor);
        if !wanted() {
            return Err(ExtractError::Abandoned);
        }
        let decoded = Instant::now();
        let inferring = self.batcher.submit(tensor)?;
        let decode = decoded - start;
        Ok(PendingExtraction {
            shown: DecodedMeta { width, height, media_type, cells, decode, decoded },
            inferring,
        })
    }

    /// Makes the descriptor of what inference gave; blocks for less than a millisecond.
    pub fn finish(
        &self,
        inferred: Inference,
        kind: DescriptorKind,
    ) -> Result<Extraction, ExtractError> {
        let Inference { shown, raw } = inferred;
        let local = raw.local_features(&self.manifest.output, shown.cells)?;
        let descriptor = local.descriptor(kind, &self.manifest.pooling)?;
        let dense = local.into_dense()?;
        let DecodedMeta { width, height, media_type, decode, decoded, .. } = shown;
        let times = StageTimes { decode, extract: decoded.elapsed() };
        Ok(Extraction { descriptor, dense, media_type, width, height, times, batch: raw.batch })
    }

    /// A manifest that does not fit its model should stop the start, not the first request; and that
    /// request should not wait for the graph's first run.
    fn check(&self) -> Result<(), ExtractError> {
        let Input { width, height, .. } = self.manifest.input;
        let pixels = image::RgbImage::from_fn(width, height, |x, y| {
            image::Rgb([(x * 7 + y * 13) as u8, (x * y) as u8, (x * 3 + y) as u8])
        });
        self.extract(&encode_jpeg(&pixels)?, DescriptorKind::Gem).map(drop)
    }
}

/// A model that was found and is the one that its manifest means.
#[derive(Debug)]
pub(super) struct Opened {
    pub model: Model,
    pub digest: Digest,
}

impl Opened {
    pub fn open(
        assets: &Assets,
        name: &str,
        provider: Option<Provider>,
    ) -> Result<Self, ExtractError> {
        let environment = assets.load_onnxruntime(provider)?;
        let folder = assets.model(name)?;
        let manifest = Arc::new(Manifest::read(&folder.join(MANIFEST))?);
        let file = folder.join(&manifest.file);
        let digest = manifest.digest(&checked_digests(&folder, &manifest)?);
        Ok(Self { model: Model { environment, file, manifest }, digest })
    }
}

/// The execution that was chosen at an earlier start under the same conditions, or the best of
/// those that are tried now.
fn chosen(
    model: &Model,
    digest: Digest,
    settings: &ExtractorSettings,
) -> Result<Execution, ExtractError> {
    let key = format!(
        "model {digest}, {} threads, {}, processor {}, {}",
        settings.layout.threads,
        settings.preference,
        provider::processor(),
        ort::info()
    );
    let remembered = settings.choice_file.as_deref();
    if let Some(known) = remembered.and_then(|file| provider::recall(file, &key)) {
        return Ok(known);
    }
    let sample = sample(&model.manifest.input)?;
    let (execution, trials) =
        provider::choose(model, settings.preference, settings.layout.threads, &sample)?;
    for trial in &trials {
        match &trial.outcome {
            Ok(measured) => tracing::info!(
                execution = %trial.execution,
                ms = measured.latency.as_secs_f64() * 1e3,
                similarity = measured.similarity,
                "tried"
            ),
            Err(why) => tracing::info!(execution = %trial.execution, why, "cannot be used"),
        }
    }
    if let Some(file) = remembered.filter(|_| !trials.is_empty()) {
        provider::remember(file, &key, execution);
    }
    Ok(execution)
}

/// Two pictures of streets, by day and by night, to time a model on.
const SAMPLES: [&[u8]; 2] =
    [include_bytes!("samples/street-day.jpg"), include_bytes!("samples/street-night.jpg")];

/// The bundled sample pictures as input tensors.
pub(super) fn sample(input: &Input) -> Result<Vec<Tensor>, ExtractError> {
    let limits = ImageLimits { max_pixels: 1 << 20 };
    let tensors = SAMPLES.iter().map(|bytes| {
        let Picture { pixels, width, height, .. } = decode(bytes, limits, Needed::All)?;
        Ok(preprocess(&pixels, (width, height), input)?)
    });
    tensors.collect()
}

/// The digests of a model's files, which are those that its manifest pins.
fn checked_digests(folder: &Path, manifest: &Manifest) -> Result<Vec<Digest>, ExtractError> {
    let checked = manifest.files().map(|(file, pinned)| {
        let file = folder.join(file);
        let (digest, _) = file_digest(&file).map_err(|error| {
            ExtractError::ModelFile(format!(
                "cannot read {}: {error}; `make build` puts the built-in model in place",
                file.display()
            ))
        })?;
        match pinned {
            Some(pinned) if pinned != digest => Err(ExtractError::ModelFile(format!(
                "{} is {digest}, but its manifest pins {pinned}; `whereabouts model verify` says \
                 how to put it right",
                file.display()
            ))),
            _ => Ok(digest),
        }
    });
    checked.collect()
}
