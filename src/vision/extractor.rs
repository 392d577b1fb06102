//! Extraction: from the bytes of a picture to its descriptor and dense features.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use super::batcher::{Batcher, Layout};
use super::decode::{DecodeError, ImageLimits, Needed, Picture, decode, encode_jpeg};
use super::execution::{Execution, ProviderPreference};
use super::extraction::{Extraction, PendingExtraction, SubmittedPicture};
use super::information::Information;
use super::manifest::{Input, Manifest, ManifestError, own_digest};
use super::one_size::OneSize;
use super::pooling::{
    DescriptorSpec, FeatureSet, Kinds, OwnVocabulary, PoolingError, Vocabulary, VocabularyError,
};
use super::preprocess::{self, PreprocessError, Tensor, preprocess};
use super::provider;
use super::runtime::{Assets, RuntimeError};
use super::session::{InferenceError, Model};
use super::verified::VerifiedModel;
use whereabouts_core::{DescriptorKind, Digest};

/// How a model is loaded and its pictures are decoded.
#[derive(Debug, Clone)]
pub struct ExtractorSettings {
    /// Name of the model.
    pub model: String,
    /// How inference divides its threads among sessions.
    pub layout: Layout,
    /// Execution providers and precisions that may be used.
    pub preference: ProviderPreference,
    /// File that caches the chosen execution; without one, the choice is measured at every start.
    pub choice_file: Option<PathBuf>,
    /// Limits on the size of a picture.
    pub limits: ImageLimits,
    /// Whether a large JPEG is decoded at full resolution before it is scaled down.
    pub exact_decode: bool,
}

impl ExtractorSettings {
    /// The reference settings: one session on the CPU at full precision, batches of one picture, exact
    /// decoding.
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

/// A loaded model with its preprocessing and pooling.
#[derive(Debug)]
pub struct Extractor {
    manifest: Arc<Manifest>,
    kinds: Arc<Kinds>,
    /// For each kind that a map's own vocabulary can be fitted for, what the digest of its descriptors depends on besides.
    own_bases: BTreeMap<DescriptorKind, Digest>,
    /// The digest of each kind of descriptor.
    digests: BTreeMap<DescriptorKind, Digest>,
    batcher: Batcher,
    execution: Execution,
    limits: ImageLimits,
    exact_decode: bool,
}

/// Why an extraction failed.
#[derive(Debug, thiserror::Error)]
pub enum ExtractError {
    /// The bytes cannot be decoded as a picture.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// The picture cannot be resized.
    #[error(transparent)]
    Preprocess(#[from] PreprocessError),
    /// Inference failed.
    #[error(transparent)]
    Inference(InferenceError),
    /// The model takes pictures of one size only, which is another.
    #[error(transparent)]
    OneSize(#[from] OneSize),
    /// The output of the model cannot be pooled.
    #[error(transparent)]
    Pooling(#[from] PoolingError),
    /// The manifest of the model is invalid.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// A file of a kind of descriptor cannot be used.
    #[error(transparent)]
    Vocabulary(#[from] VocabularyError),
    /// ONNX Runtime or the model is missing.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
    /// A model file cannot be read or does not match the digest pinned in the manifest.
    #[error("{0}")]
    ModelFile(String),
    /// The caller left before inference started.
    #[error("the caller has left")]
    Abandoned,
}

impl From<InferenceError> for ExtractError {
    fn from(error: InferenceError) -> Self {
        match error {
            InferenceError::Pooling(error) => Self::Pooling(error),
            error => Self::Inference(error),
        }
    }
}

impl Extractor {
    /// Loads a model and validates it by running one picture through it. Throughput sessions are loaded in
    /// the background.
    pub fn load(assets: &Assets, settings: &ExtractorSettings) -> Result<Self, ExtractError> {
        let opened = VerifiedModel::open(assets, &settings.model, settings.preference.provider)?;
        let model = opened.model.clone();
        Self::start(opened, settings).map_err(|error| match error {
            ExtractError::Inference(_) | ExtractError::Pooling(_) => {
                OneSize::of(&model).map_or(error, ExtractError::OneSize)
            }
            error => error,
        })
    }

    fn start(opened: VerifiedModel, settings: &ExtractorSettings) -> Result<Self, ExtractError> {
        let VerifiedModel { model, own_bases, digests } = opened;
        let execution = choose_execution(&model, &digests, settings)?;
        let batcher = Batcher::start(&model, execution, settings.layout)?;
        let mut extractor = Self {
            manifest: Arc::clone(&model.manifest),
            kinds: Arc::clone(&model.kinds),
            own_bases,
            digests,
            batcher,
            execution,
            limits: settings.limits,
            exact_decode: settings.exact_decode,
        };
        extractor.run_test_picture()?;
        extractor.batcher.add_throughput_sessions(model, execution)?;
        Ok(extractor)
    }

    /// The manifest of the model.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Digest of everything that determines a descriptor of the given kind: weights, preprocessing and pooling.
    /// `None` if the model does not have that kind.
    pub fn digest(&self, kind: DescriptorKind) -> Option<Digest> {
        self.digests.get(&kind).copied()
    }

    /// Prepares to fit a map's own vocabulary for a kind of descriptor; `None` if the kind has none, or one that cannot
    /// be fitted.
    pub fn own_vocabulary(&self, kind: DescriptorKind) -> Option<OwnVocabulary> {
        OwnVocabulary::new(self.kinds.vocabulary(kind)?)
    }

    /// Reads a map's own vocabulary. The error says what is wrong with it.
    pub fn read_vocabulary(
        &self,
        kind: DescriptorKind,
        bytes: &[u8],
    ) -> Result<Vocabulary, String> {
        let own = self.own_vocabulary(kind);
        own.ok_or("the model's descriptor has no vocabulary")?.read(bytes)
    }

    /// Like [`digest`](Self::digest), with a map's own vocabulary in place of the model's, of which this is the digest.
    pub fn own_digest(&self, kind: DescriptorKind, vocabulary: Digest) -> Option<Digest> {
        self.own_bases.get(&kind).map(|base| own_digest(*base, vocabulary))
    }

    /// The execution provider and precision in use.
    pub fn execution(&self) -> Execution {
        self.execution
    }

    /// Limits on the size of a picture.
    pub fn limits(&self) -> ImageLimits {
        self.limits
    }

    /// Extracts the descriptor, and the dense features if requested. Blocks; call it on a pool thread.
    pub fn extract(
        &self,
        bytes: &[u8],
        spec: impl Into<DescriptorSpec>,
        features: FeatureSet,
    ) -> Result<Extraction, ExtractError> {
        self.begin(bytes, spec, features, || true)?.wait()
    }

    /// Decodes a picture and queues it for inference. Blocks while decoding and while the queue is full; call
    /// it on a pool thread. Fails with [`ExtractError::Abandoned`] if `is_wanted` returns `false` after
    /// decoding.
    pub fn begin(
        &self,
        bytes: &[u8],
        spec: impl Into<DescriptorSpec>,
        features: FeatureSet,
        is_wanted: impl Fn() -> bool,
    ) -> Result<PendingExtraction, ExtractError> {
        let start = Instant::now();
        let input = &self.manifest.input;
        let needed = if self.exact_decode { Needed::All } else { preprocess::needed(input) };
        let picture = decode(bytes, self.limits, needed)?;
        let Picture { pixels, width, height, media_type, warnings } = picture;
        let tensor = preprocess(&pixels, (width, height), input)?;
        drop(pixels);
        let information = Information::of(&tensor, input);
        if !is_wanted() {
            return Err(ExtractError::Abandoned);
        }
        let submitted = Instant::now();
        let inference = self.batcher.submit(tensor, spec.into(), features)?;
        // Hashed after submitting, so that it overlaps with inference.
        let digest = Digest::of(bytes);
        let decode = submitted - start;
        let picture = SubmittedPicture {
            digest,
            media_type,
            width,
            height,
            warnings,
            information,
            decode,
            submitted,
        };
        Ok(PendingExtraction { inference, picture })
    }

    /// Extracts a generated picture, so that a manifest that does not match its model fails at startup
    /// instead of at the first request, and that request does not pay for the slow first run.
    fn run_test_picture(&self) -> Result<(), ExtractError> {
        let Input { width, height, .. } = self.manifest.input;
        let pixels = image::RgbImage::from_fn(width, height, |x, y| {
            image::Rgb([(x * 7 + y * 13) as u8, (x * y) as u8, (x * 3 + y) as u8])
        });
        let picture = encode_jpeg(&pixels)?;
        self.extract(&picture, DescriptorKind::GEM, FeatureSet::DescriptorAndDense).map(drop)
    }
}

/// Returns the execution cached by an earlier start under the same conditions, or measures the candidates and
/// returns the best.
fn choose_execution(
    model: &Model,
    digests: &BTreeMap<DescriptorKind, Digest>,
    settings: &ExtractorSettings,
) -> Result<Execution, ExtractError> {
    let digests = digests.values().map(Digest::to_string);
    let key = format!(
        "model {}, {} threads, {}, processor {}, {}",
        digests.collect::<Vec<_>>().join(" "),
        settings.layout.threads,
        settings.preference,
        provider::processor(),
        ort::info()
    );
    let choice_file = settings.choice_file.as_deref();
    if let Some(cached) = choice_file.and_then(|file| provider::read_choice(file, &key)) {
        return Ok(cached);
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
                "execution measured"
            ),
            Err(why) => tracing::info!(execution = %trial.execution, why, "execution unusable"),
        }
    }
    if let Some(file) = choice_file.filter(|_| !trials.is_empty()) {
        provider::write_choice(file, &key, execution);
    }
    Ok(execution)
}

/// Two street scenes, by day and by night, on which models are measured.
pub(super) const SAMPLES: [&[u8]; 2] =
    [include_bytes!("samples/street-day.jpg"), include_bytes!("samples/street-night.jpg")];

/// Decodes the bundled sample pictures to input tensors.
pub(super) fn sample(input: &Input) -> Result<Vec<Tensor>, ExtractError> {
    let limits = ImageLimits { max_pixels: 1 << 20 };
    let tensors = SAMPLES.iter().map(|bytes| {
        let Picture { pixels, width, height, .. } = decode(bytes, limits, Needed::All)?;
        Ok(preprocess(&pixels, (width, height), input)?)
    });
    tensors.collect()
}
