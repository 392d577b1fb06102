//! A reader made of two ONNX models.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ort::environment::Environment;
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use parking_lot::Mutex;
use whereabouts_core::{Digest, TextLine};
use whereabouts_vision::{Assets, Picture};

use super::crop::straightened;
use super::detector::Detector;
use super::geometry::Quad;
use super::manifest::{Manifest, READER_MANIFEST};
use super::recogniser::Recogniser;
use super::{ReadError, Reader};

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
    manifest: Manifest,
    digest: Digest,
    detector: Detector,
    recogniser: Recogniser,
    /// Must outlive the sessions.
    _environment: Arc<Environment>,
}

impl OnnxReader {
    /// Loads a reader, whose files must have the digests of its manifest.
    pub fn load(assets: &Assets, settings: &ReaderSettings) -> Result<Self, ReadError> {
        let folder = folder(assets, &settings.name)?;
        let (manifest, digest) = Manifest::open(&folder)?;
        let environment = assets.load_onnxruntime(None)?;
        let load = |file: &str| session(&environment, &folder.join(file), settings.threads);
        let (detector, input) = load(&manifest.detector.file)?;
        let detector = Detector {
            session: Mutex::new(detector),
            input,
            spec: manifest.detector.clone(),
            max_lines: settings.max_lines,
        };
        let keys = folder.join(&manifest.recogniser.keys);
        let keys = std::fs::read_to_string(&keys)
            .map_err(|error| ReadError::File(format!("cannot read {}: {error}", keys.display())))?;
        let (recogniser, input) = load(&manifest.recogniser.file)?;
        let recogniser = Recogniser {
            session: Mutex::new(recogniser),
            input,
            spec: manifest.recogniser.clone(),
            keys: keys.lines().map(str::to_owned).collect(),
        };
        Ok(Self { manifest, digest, detector, recogniser, _environment: environment })
    }

    /// What the reader consists of.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
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

fn folder(assets: &Assets, name: &str) -> Result<PathBuf, ReadError> {
    let is_plain = !name.is_empty() && !name.contains(['/', '\\']) && name != "..";
    let folders = assets.candidates().iter().map(|folder| folder.join("models").join(name));
    let mut installed = folders.filter(|folder| is_plain && folder.join(READER_MANIFEST).is_file());
    installed.next().ok_or_else(|| {
        let searched: Vec<_> =
            assets.candidates().iter().map(|path| path.display().to_string()).collect();
        ReadError::NotInstalled { name: name.to_owned(), searched: searched.join(", ") }
    })
}

/// A session and the name of its input.
fn session(
    environment: &Arc<Environment>,
    file: &Path,
    threads: usize,
) -> Result<(Session, String), ReadError> {
    let damaged = |error: &dyn std::fmt::Display| {
        ReadError::File(format!("{} cannot be loaded: {error}", file.display()))
    };
    let session = Session::builder(environment)
        .and_then(|builder| Ok(builder.with_optimization_level(GraphOptimizationLevel::Level3)?))
        .and_then(|builder| Ok(builder.with_intra_threads(threads.max(1))?))
        // Spinning threads would take cores from requests.
        .and_then(|builder| Ok(builder.with_intra_op_spinning(false)?))
        .and_then(|mut builder| builder.commit_from_file(file))
        .map_err(|error| damaged(&error))?;
    let input = session.inputs().first().map(|input| input.name().to_owned());
    let input = input.ok_or_else(|| damaged(&"it has no input"))?;
    Ok((session, input))
}
