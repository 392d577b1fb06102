//! Benchmark of a model on this machine, over executions and layouts.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use ort::value::TensorRef;

use super::batcher::{Batcher, Layout};
use super::execution::{Execution, ProviderPreference};
use super::extractor::{ExtractError, sample};
use super::manifest;
use super::pooling::FeatureSet;
use super::preprocess::Tensor;
use super::provider::{self, MIN_SIMILARITY};
use super::runtime::Assets;
use super::session::{InferenceError, Model};
use super::verified::VerifiedModel;
use whereabouts_core::DescriptorKind;

/// A graph of 8 products of 1024 × 1024 matrices, made by deploy/models/make_gemm.py.
const GEMM: &[u8] = include_bytes!("gemm.onnx");
const GEMM_SIZE: usize = 1024;
const GEMM_FLOP: f64 = 8.0 * 2.0 * 1024.0 * 1024.0 * 1024.0;

/// What to measure.
#[derive(Debug, Clone)]
pub struct BenchSettings {
    /// Execution providers and precisions to measure.
    pub preference: ProviderPreference,
    /// Layouts to measure.
    pub layouts: Vec<Layout>,
    /// Duration of each measurement.
    pub duration: Duration,
}

/// The measurements of one execution and layout.
#[derive(Debug, Clone, PartialEq)]
pub struct BenchRow {
    /// Execution provider and precision.
    pub execution: Execution,
    /// How threads are divided among sessions.
    pub layout: Layout,
    /// The figures, or why they could not be measured.
    pub outcome: Result<BenchFigures, String>,
}

/// Figures of inference and pooling, without decoding or search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BenchFigures {
    /// Median latency of a picture that arrives alone.
    pub alone: Duration,
    /// Pictures per second with a full queue.
    pub per_second: f64,
    /// Lowest cosine similarity of a descriptor to that of the CPU at full precision.
    pub similarity: f32,
    /// Floating-point operations per second of plain matrix products on this execution and number of
    /// threads.
    pub peak: f64,
}

impl BenchRow {
    /// The figures, if the descriptors are similar enough to those of the reference.
    pub fn accepted(&self) -> Option<&BenchFigures> {
        self.outcome.as_ref().ok().filter(|figures| figures.similarity >= MIN_SIMILARITY)
    }
}

/// A model to be measured.
#[derive(Debug)]
pub struct Bench {
    opened: VerifiedModel,
    sample: Vec<Tensor>,
}

impl Bench {
    /// Opens a model. Only executions allowed by `preference` can be measured.
    pub fn open(
        assets: &Assets,
        model: &str,
        preference: ProviderPreference,
    ) -> Result<Self, ExtractError> {
        let opened = VerifiedModel::open(assets, model, preference.provider)?;
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

    /// Measures every combination of execution and layout, and passes each row to `on_row` as it is done.
    pub fn run(
        &self,
        settings: &BenchSettings,
        mut on_row: impl FnMut(&BenchRow),
    ) -> Result<Vec<BenchRow>, InferenceError> {
        let model = &self.opened.model;
        let reference = provider::descriptors(model, Execution::REFERENCE, 1, &self.sample)?;
        let mut rows = Vec::new();
        for execution in Execution::candidates(settings.preference) {
            let similarity = provider::descriptors(model, execution, 1, &self.sample)
                .map(|descriptors| provider::min_similarity(&descriptors, &reference));
            let mut peaks = BTreeMap::new();
            for &layout in &settings.layouts {
                let outcome = similarity.clone().and_then(|similarity| {
                    let (alone, per_second) =
                        self.latency_and_throughput(execution, layout, settings.duration)?;
                    let peak = match peaks.get(&layout.threads) {
                        Some(&peak) => peak,
                        None => gemm_peak(model, execution, layout.threads, settings.duration)?,
                    };
                    peaks.insert(layout.threads, peak);
                    Ok(BenchFigures { alone, per_second, similarity, peak })
                });
                let outcome = outcome.map_err(|error| error.to_string());
                let row = BenchRow { execution, layout, outcome };
                on_row(&row);
                rows.push(row);
            }
        }
        Ok(rows)
    }

    /// Measures the median latency of a single picture, and pictures per second with a full queue.
    fn latency_and_throughput(
        &self,
        execution: Execution,
        layout: Layout,
        duration: Duration,
    ) -> Result<(Duration, f64), InferenceError> {
        let mut batcher = Batcher::start(&self.opened.model, execution, layout)?;
        batcher.add_throughput_sessions(self.opened.model.clone(), execution)?;
        batcher.wait_until_complete();
        let mut pictures = self.sample.iter().cycle();
        let mut next = || pictures.next().cloned().unwrap_or_else(|| Tensor::grey(1, 1));
        let submit = |picture| {
            batcher.submit(picture, DescriptorKind::GEM.into(), FeatureSet::DescriptorOnly)
        };
        let mut times = Vec::new();
        let start = Instant::now();
        while times.len() < 3 || start.elapsed() < duration {
            let picture = next();
            let start = Instant::now();
            submit(picture)?.wait()?;
            times.push(start.elapsed());
        }
        times.sort_unstable();
        let mut in_progress = VecDeque::new();
        let ahead = layout.capacity();
        for _ in 0..ahead {
            in_progress.push_back(submit(next())?);
        }
        let (mut finished, start) = (0, Instant::now());
        while finished < ahead || start.elapsed() < duration {
            if let Some(first) = in_progress.pop_front() {
                first.wait()?;
                finished += 1;
            }
            in_progress.push_back(submit(next())?);
        }
        Ok((times[times.len() / 2], finished as f64 / start.elapsed().as_secs_f64()))
    }
}

/// Measures the peak rate of large matrix products in one session, in floating-point operations per second.
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
