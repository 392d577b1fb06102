//! What a model does on this machine, by each way of running it.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use ort::value::TensorRef;

use super::batcher::{Batcher, Layout};
use super::extractor::{ExtractError, Opened, sample};
use super::manifest;
use super::preprocess::Tensor;
use super::provider::{self, Execution, MIN_SIMILARITY, ProviderPreference};
use super::runtime::Assets;
use super::session::{InferenceError, Model};

/// 8 products of 1024 × 1024 matrices, see deploy/models/make_gemm.py.
const GEMM: &[u8] = include_bytes!("gemm.onnx");
const GEMM_SIZE: usize = 1024;
const GEMM_FLOP: f64 = 8.0 * 2.0 * 1024.0 * 1024.0 * 1024.0;

/// What to try.
#[derive(Debug, Clone)]
pub struct BenchSettings {
    /// By whom and at which precision.
    pub preference: ProviderPreference,
    /// How threads are shared.
    pub layouts: Vec<Layout>,
    /// How long each figure is measured.
    pub duration: Duration,
}

/// One way of running a model, and what it does.
#[derive(Debug, Clone, PartialEq)]
pub struct BenchRow {
    /// By whom, and at which precision.
    pub execution: Execution,
    /// How threads are shared.
    pub layout: Layout,
    /// The figures, or why there are none.
    pub outcome: Result<BenchFigures, String>,
}

/// Figures of inference alone, without decoding or search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BenchFigures {
    /// The median time of a picture that comes alone.
    pub alone: Duration,
    /// Pictures a second while enough of them wait.
    pub per_second: f64,
    /// The least cosine similarity of a descriptor to that of the CPU at full precision.
    pub similarity: f32,
    /// What this provider reaches with plain matrix products at this precision and so many threads,
    /// in floating-point operations a second.
    pub peak: f64,
}

impl BenchRow {
    /// The figures of a way whose descriptors are right.
    pub fn accepted(&self) -> Option<&BenchFigures> {
        self.outcome.as_ref().ok().filter(|figures| figures.similarity >= MIN_SIMILARITY)
    }
}

/// A model on the bench.
#[derive(Debug)]
pub struct Bench {
    opened: Opened,
    sample: Vec<Tensor>,
}

impl Bench {
    /// Finds and reads a model. Only the executions that `wanted` allows can be tried.
    pub fn open(
        assets: &Assets,
        model: &str,
        wanted: ProviderPreference,
    ) -> Result<Self, ExtractError> {
        let opened = Opened::open(assets, model, wanted.provider)?;
        let sample = sample(&opened.model.manifest.input)?;
        Ok(Self { opened, sample })
    }

    /// Floating-point operations for one picture, if the model is a plain transformer.
    ///
    /// Every weight is multiplied and added once for each token: 2PN for P weights and N tokens,
    /// where P is the size of the file over 4 bytes. Attention adds 4N²C for each layer (QKᵀ and its
    /// product with V), of which there are P / 12C² at the usual shape of a layer (C channels; four C
    /// in the hidden layer).
    pub fn flop(&self) -> Option<f64> {
        let Model { manifest, file, .. } = &self.opened.model;
        if manifest.output.layout != manifest::Layout::Tokens {
            return None;
        }
        let weights = std::fs::metadata(file).ok()?.len() as f64 / 4.0;
        let stride = manifest.output.stride;
        let patches = (manifest.input.width / stride) * (manifest.input.height / stride);
        let tokens = f64::from(patches) + 1.0 + manifest.output.registers as f64;
        let channels = manifest.output.channels as f64;
        let layers = (weights / (12.0 * channels * channels)).round();
        Some(2.0 * weights * tokens + 4.0 * tokens * tokens * channels * layers)
    }

    /// Tries one way after another, and tells each as it is done.
    pub fn run(
        &self,
        settings: &BenchSettings,
        mut done: impl FnMut(&BenchRow),
    ) -> Result<Vec<BenchRow>, InferenceError> {
        let model = &self.opened.model;
        let reference = provider::descriptors(model, Execution::REFERENCE, 1, &self.sample)?;
        let mut rows = Vec::new();
        for execution in Execution::candidates(settings.preference) {
            let similarity = provider::descriptors(model, execution, 1, &self.sample)
                .map(|tried| provider::least_similarity(&tried, &reference));
            let mut peaks = BTreeMap::new();
            for &layout in &settings.layouts {
                let outcome = similarity.clone().and_then(|similarity| {
                    let (alone, per_second) = self.pace(execution, layout, settings.duration)?;
                    let peak = match peaks.get(&layout.threads) {
                        Some(&peak) => peak,
                        None => gemm_peak(model, execution, layout.threads, settings.duration)?,
                    };
                    peaks.insert(layout.threads, peak);
                    Ok(BenchFigures { alone, per_second, similarity, peak })
                });
                let outcome = outcome.map_err(|error| error.to_string());
                let row = BenchRow { execution, layout, outcome };
                done(&row);
                rows.push(row);
            }
        }
        Ok(rows)
    }

    /// The median time of one picture alone, and pictures a second while the queue is kept full.
    fn pace(
        &self,
        execution: Execution,
        layout: Layout,
        duration: Duration,
    ) -> Result<(Duration, f64), InferenceError> {
        let mut batcher = Batcher::start(&self.opened.model, execution, layout)?;
        batcher.add_narrow(self.opened.model.clone(), execution)?;
        batcher.wait_until_complete();
        let mut pictures = self.sample.iter().cycle();
        let mut next = || pictures.next().cloned().unwrap_or_else(|| Tensor::grey(1, 1));
        let mut times = Vec::new();
        let start = Instant::now();
        while times.len() < 3 || start.elapsed() < duration {
            let picture = next();
            let start = Instant::now();
            batcher.submit(picture)?.wait()?;
            times.push(start.elapsed());
        }
        times.sort_unstable();
        let mut in_progress = VecDeque::new();
        let ahead = layout.capacity();
        for _ in 0..ahead {
            in_progress.push_back(batcher.submit(next())?);
        }
        let (mut finished, start) = (0, Instant::now());
        while finished < ahead || start.elapsed() < duration {
            if let Some(first) = in_progress.pop_front() {
                first.wait()?;
                finished += 1;
            }
            in_progress.push_back(batcher.submit(next())?);
        }
        Ok((times[times.len() / 2], finished as f64 / start.elapsed().as_secs_f64()))
    }
}

/// The best of what one session reaches with products of large matrices.
fn gemm_peak(
    model: &Model,
    execution: Execution,
    threads: usize,
    duration: Duration,
) -> Result<f64, InferenceError> {
    let failed = |error: ort::Error| InferenceError::Run(error.to_string());
    let builder = model.builder(execution, threads, 1).map_err(failed)?;
    let mut session = { builder }.commit_from_memory(GEMM).map_err(failed)?;
    let ones = vec![1.0_f32; GEMM_SIZE * GEMM_SIZE];
    let (mut best, start) = (Duration::MAX, Instant::now());
    while best == Duration::MAX || start.elapsed() < duration / 2 {
        let x = TensorRef::from_array_view(([GEMM_SIZE, GEMM_SIZE], ones.as_slice()));
        let input = ort::inputs!["x" => x.map_err(failed)?];
        let start = Instant::now();
        session.run(input).map_err(failed)?;
        best = best.min(start.elapsed());
    }
    Ok(GEMM_FLOP / best.as_secs_f64())
}
