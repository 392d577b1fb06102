//! A reader made of two ONNX models.

use whereabouts_core::{Digest, TextLine};
use whereabouts_vision::{Assets, Picture};

use super::crop::straightened;
use super::detector::Detector;
use super::geometry::Quad;
use super::manifest::{Manifest, READER_MANIFEST};
use super::model::Model;
use super::recogniser::Recogniser;
use super::{ReadError, Reader};

/// Raised when the processing here changes what is read with the same models, so that images are read again.
const PROCESSING: u32 = 1;

/// How a reader is loaded.
#[derive(Debug, Clone)]
pub struct ReaderSettings {
    /// The name of its folder in `models/`.
    pub name: String,
    /// Threads of each of the two models.
    pub threads: usize,
    /// Most lines that are read in a picture.
    pub max_lines: usize,
}

/// A reader made of two ONNX models. One picture is read at a time; other callers wait.
#[derive(Debug)]
pub struct OnnxReader {
    digest: Digest,
    detector: Detector,
    recogniser: Recogniser,
}

impl OnnxReader {
    /// Loads a reader, whose files must have the digests of its manifest.
    pub fn load(assets: &Assets, settings: &ReaderSettings) -> Result<Self, ReadError> {
        let ReaderSettings { name, threads, max_lines } = settings;
        let folder = assets.folder(name, READER_MANIFEST).ok_or_else(|| {
            ReadError::NotInstalled { name: name.clone(), searched: assets.searched() }
        })?;
        let (Manifest { detector, recogniser, .. }, digest) = Manifest::open(&folder)?;
        let environment = assets.load_onnxruntime(None)?;
        let model = |file: &str| Model::load(&environment, &folder.join(file), *threads);
        let keys = folder.join(&recogniser.keys);
        let keys = std::fs::read_to_string(&keys)
            .map_err(|error| ReadError::File(format!("cannot read {}: {error}", keys.display())))?;
        let digest =
            Digest::of(format!("{digest}, processing {PROCESSING}, {max_lines} lines").as_bytes());
        Ok(Self {
            digest,
            detector: Detector {
                model: model(&detector.file)?,
                spec: detector,
                max_lines: *max_lines,
            },
            recogniser: Recogniser {
                model: model(&recogniser.file)?,
                spec: recogniser,
                keys: keys.lines().map(str::to_owned).collect(),
            },
        })
    }
}

impl Reader for OnnxReader {
    fn digest(&self) -> Digest {
        self.digest
    }

    fn read(&self, picture: &Picture) -> Result<Vec<TextLine>, ReadError> {
        let pixels = &picture.pixels;
        if pixels.width() == 0 || pixels.height() == 0 {
            return Ok(Vec::new());
        }
        let quads = self.detector.lines(pixels)?;
        let spec = &self.recogniser.spec;
        let straight = |quad| straightened(pixels, quad, spec.height, spec.widest);
        let (mut owners, mut lines) = (Vec::new(), Vec::new());
        for (owner, quad) in quads.iter().enumerate() {
            for line in straight(quad) {
                owners.push(owner);
                lines.push(line);
            }
        }
        // Of a line in several directions, the one that is read best.
        let mut texts = vec![(String::new(), 0.0); quads.len()];
        for (owner, text) in owners.into_iter().zip(self.recogniser.read(&lines)?) {
            if text.1 > texts[owner].1 {
                texts[owner] = text;
            }
        }
        let size = [pixels.width() as f32, pixels.height() as f32];
        let lines = quads.into_iter().zip(texts).filter_map(|(quad, (text, confidence))| {
            let text = text.trim().to_owned();
            let is_read = !text.is_empty() && confidence >= spec.least_confidence;
            is_read.then(|| TextLine { text, confidence, corners: shares(quad, size) })
        });
        Ok(lines.collect())
    }
}

/// Corners as shares of the size of the picture.
fn shares(quad: Quad, [width, height]: [f32; 2]) -> [[f32; 2]; 4] {
    quad.map(|[x, y]| [(x / width).clamp(0.0, 1.0), (y / height).clamp(0.0, 1.0)])
}
