//! From the bytes of a picture to its descriptor and dense features.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::batcher::{Batcher, BatcherSettings, InferenceError};
use super::decode::{DecodeError, ImageLimits, Picture, decode};
use super::manifest::{Manifest, ManifestError};
use super::pooling::{LocalFeatures, PoolingError};
use super::preprocess::{PreprocessError, Tensor, preprocess};
use super::runtime::{Assets, RuntimeError};
use crate::domain::{DenseFeatures, Descriptor, DescriptorKind, Digest, MediaType};

/// How pictures are decoded and run through the model.
#[derive(Debug, Clone)]
pub struct ExtractorSettings {
    /// The model's name.
    pub model: String,
    /// Sessions that run side by side.
    pub sessions: usize,
    /// Threads within one session.
    pub threads: usize,
    /// The most pictures in one run.
    pub max_batch: usize,
    /// Bounds on a picture.
    pub limits: ImageLimits,
}

/// One loaded model with everything around it. Its calls block; run them on a pool thread.
#[derive(Debug)]
pub struct Extractor {
    manifest: Arc<Manifest>,
    digest: Digest,
    batcher: Batcher,
    limits: ImageLimits,
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
}

impl Extractor {
    /// Loads a model and checks it by running one picture through it.
    pub fn load(assets: &Assets, settings: &ExtractorSettings) -> Result<Self, ExtractError> {
        let environment = assets.load_onnxruntime()?;
        let folder = assets.model(&settings.model)?;
        let manifest = Arc::new(Manifest::read(&folder.join("manifest.toml"))?);
        let file = folder.join(&manifest.file);
        let digest = checked_digest(&file, &manifest)?;
        let batcher = Batcher::start(
            &environment,
            &file,
            &manifest,
            BatcherSettings {
                sessions: settings.sessions,
                threads: settings.threads,
                max_batch: settings.max_batch,
            },
        )?;
        let extractor = Self { manifest, digest, batcher, limits: settings.limits };
        extractor.warm_up()?;
        Ok(extractor)
    }

    /// What the model says about itself.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// The digest of the ONNX file.
    pub fn digest(&self) -> Digest {
        self.digest
    }

    /// Bounds on the pictures it takes.
    pub fn limits(&self) -> ImageLimits {
        self.limits
    }

    /// Decodes a picture and runs it through the model.
    pub fn extract(&self, bytes: &[u8], kind: DescriptorKind) -> Result<Extraction, ExtractError> {
        let start = Instant::now();
        let Picture { pixels, media_type } = decode(bytes, self.limits)?;
        let (width, height) = pixels.dimensions();
        let tensor = preprocess(&pixels, &self.manifest.input)?;
        drop(pixels);
        let decoded = Instant::now();
        let local = self.local_features(tensor)?;
        let descriptor = local.descriptor(kind, &self.manifest.pooling)?;
        let dense = local.into_dense()?;
        let times = StageTimes { decode: decoded - start, extract: decoded.elapsed() };
        Ok(Extraction { descriptor, dense, media_type, width, height, times })
    }

    fn local_features(&self, tensor: Tensor) -> Result<LocalFeatures, ExtractError> {
        let stride = self.manifest.output.stride as usize;
        let cells = (tensor.height / stride, tensor.width / stride);
        let raw = self.batcher.infer(tensor)?;
        let output = &self.manifest.output;
        Ok(LocalFeatures::from_output(output, cells, &raw.features, raw.reliability.as_deref())?)
    }

    /// The first run of a graph allocates and optimises; a robot should not wait for that, and a
    /// manifest that does not fit its model should stop the start, not the first request.
    fn warm_up(&self) -> Result<(), ExtractError> {
        let input = &self.manifest.input;
        let pixels = image::RgbImage::from_fn(input.width, input.height, |x, y| {
            image::Rgb([(x * 7 + y * 13) as u8, (x * y) as u8, (x * 3 + y) as u8])
        });
        let local = self.local_features(preprocess(&pixels, input)?)?;
        local.descriptor(DescriptorKind::Gem, &self.manifest.pooling)?;
        Ok(())
    }
}

fn checked_digest(file: &Path, manifest: &Manifest) -> Result<Digest, ExtractError> {
    let bytes = std::fs::read(file).map_err(|error| {
        ExtractError::ModelFile(format!(
            "cannot read {}: {error}; `make build` puts the built-in model in place",
            file.display()
        ))
    })?;
    let digest = Digest::of(&bytes);
    match manifest.sha256 {
        Some(pinned) if pinned != digest => Err(ExtractError::ModelFile(format!(
            "{} is {digest}, but its manifest pins {pinned}; remove the folder and run `make \
             build` again",
            file.display()
        ))),
        _ => Ok(digest),
    }
}
