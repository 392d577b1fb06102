//! The flags of `whereabouts eval`, and the settings that follow from them.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use whereabouts_core::{DescriptorKind, Digest, RefinerKind, Scene};
use whereabouts_eval::{RunSettings, TruthSource};
use whereabouts_index::SearchMode;
use whereabouts_refine::{REFINERS, RefinerSettings};
use whereabouts_server::config::{Config, Overrides, RefinerChoice};

/// Measure Recall@K on a folder of references and a folder of queries, without a server
///
/// Indexes the references, localizes every query, and prints Recall@1, 5 and 10 before and after refinement.
/// The correct references of a query are taken from the first of these that exists: --ground-truth,
/// --frame-tolerance, a ground_truth.csv or .json in or next to the folder of queries, and positions. The position
/// of each image is read from the first source that has one: --database-poses and --queries-poses or a poses.csv
/// in each folder, a file NAME.json next to the image NAME, a file name @easting@northing@..., or EXIF GPS. Images
/// without one are left out. The exit code is 1 if a file could not be taken. To resume an interrupted run, run the same command again.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder of references; subfolders are included
    #[arg(long, value_name = "DIR")]
    pub database: PathBuf,
    /// Folder of queries; subfolders are included
    #[arg(long, value_name = "DIR")]
    pub queries: PathBuf,
    /// Folder of images of other places, to measure how well `known` tells them apart
    #[arg(long, value_name = "DIR")]
    pub unknown: Option<PathBuf>,
    /// Leave out this fraction of the references, the last by name; queries that show only these count as
    /// unknown places
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, value_parser = fraction)]
    pub hold_out: f64,
    /// CSV file with the columns query,references, the references separated by spaces; or JSON:
    /// {"query.jpg": ["reference.jpg"]}
    #[arg(long, value_name = "FILE", conflicts_with = "frame_tolerance")]
    ground_truth: Option<PathBuf>,
    /// Treat both folders as recordings of the same route, in the natural order of their names (2.jpg before
    /// 10.jpg), where correct references are at most N frames away
    #[arg(long, value_name = "N")]
    frame_tolerance: Option<usize>,
    /// Table (CSV) with the positions of the references: file, and lat,lon or x,y
    #[arg(long, value_name = "FILE")]
    database_poses: Option<PathBuf>,
    /// Table (CSV) with the positions of the queries
    #[arg(long, value_name = "FILE")]
    queries_poses: Option<PathBuf>,
    /// Largest distance of a correct reference, in metres
    #[arg(long, value_name = "METRES", default_value_t = 25.0)]
    threshold_m: f64,
    /// Descriptors of coarse retrieval to evaluate, such as gem,vlad: kinds that the model has [default: the
    /// model's default]
    #[arg(long, value_delimiter = ',', value_name = "KIND")]
    pub descriptor: Vec<DescriptorKind>,
    /// Refiners to evaluate: local, mllm, cascade, both (local and mllm), all, or off
    #[arg(long, value_delimiter = ',', default_value = "local", value_parser = refiners)]
    refine: Vec<Refiners>,
    /// Number of candidates to refine [default: as configured, which is 10 with mllm, otherwise 50]
    #[arg(short, value_parser = clap::value_parser!(u8).range(1..=100))]
    k: Option<u8>,
    /// Evaluate a random sample of N queries
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub sample: Option<u32>,
    /// Seed of the random sample
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Kind of place that the images show; selects the wording of the prompts
    #[arg(long, default_value_t = Scene::Outdoor)]
    scene: Scene,
    /// Confidence threshold for known places to evaluate: auto suggests one, a number is evaluated as well
    #[arg(long, value_name = "auto|NUMBER", default_value = "auto", value_parser = known_threshold)]
    pub known_threshold: KnownThreshold,
    /// Search exactly, by comparing with every descriptor, instead of in a graph
    #[arg(long)]
    pub exact: bool,
    /// Write report.html, summary.json and predictions.csv to this folder
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Work folder for descriptors, descriptions and outcomes [default: eval-work/ and a name derived from the
    /// database]
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Number of images to process concurrently [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    concurrency: Option<u16>,
    /// Configuration file, as for `serve`
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Model to evaluate
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// URL of a server with the OpenAI chat-completions API, for --refine mllm; its key is read from
    /// WHEREABOUTS_MLLM__API_KEY
    #[arg(long, value_name = "URL")]
    mllm_base_url: Option<String>,
    /// Print the results as JSON
    #[arg(long)]
    pub json: bool,
}

/// The refiners of one value of --refine.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Refiners(Vec<RefinerChoice>);

fn refiners(text: &str) -> Result<Refiners, String> {
    let of = |kinds: &[RefinerKind]| Refiners(kinds.iter().copied().map(Into::into).collect());
    match text {
        "both" => Ok(of(&[RefinerKind::Local, RefinerKind::Mllm])),
        "all" => Ok(of(&[RefinerKind::Local, RefinerKind::Cascade, RefinerKind::Mllm])),
        name => {
            let choice = RefinerChoice::try_from(name.to_owned());
            let choice = choice.map_err(|error| format!("{error}, both, all"))?;
            Ok(Refiners(vec![choice]))
        }
    }
}

/// A threshold to evaluate in addition to the suggested one.
#[derive(Debug, Clone, Copy)]
pub struct KnownThreshold(pub Option<f64>);

fn known_threshold(text: &str) -> Result<KnownThreshold, String> {
    if text == "auto" {
        return Ok(KnownThreshold(None));
    }
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite());
    number.map(|number| KnownThreshold(Some(number))).ok_or("expected `auto` or a number".into())
}

fn fraction(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|fraction| (0.0..1.0).contains(fraction));
    number.ok_or("expected a number from 0 to below 1".into())
}

impl Args {
    pub fn truth(&self) -> anyhow::Result<TruthSource> {
        if !self.threshold_m.is_finite() || self.threshold_m < 0.0 {
            bail!("--threshold-m must be 0 or more metres");
        }
        let has_poses = self.database_poses.is_some() || self.queries_poses.is_some();
        let found =
            || TruthSource::find_listed(&self.database, &self.queries).filter(|_| !has_poses);
        Ok(match (&self.ground_truth, self.frame_tolerance) {
            (Some(file), _) => TruthSource::Listed(file.clone()),
            (None, Some(tolerance)) => TruthSource::Frames { tolerance },
            (None, None) => found().unwrap_or_else(|| TruthSource::Positions {
                database: self.database_poses.clone(),
                queries: self.queries_poses.clone(),
                threshold_m: self.threshold_m,
            }),
        })
    }

    /// Returns the refiners to evaluate, each once.
    pub fn refiners(&self) -> Vec<RefinerChoice> {
        let mut choices = Vec::new();
        for choice in self.refine.iter().flat_map(|refiners| &refiners.0) {
            if !choices.contains(choice) {
                choices.push(*choice);
            }
        }
        choices
    }

    /// Returns the configuration of a server on the work folder.
    pub fn config(&self) -> anyhow::Result<Config> {
        // The number of candidates follows from the configured refiner and applies to all of them, so the last
        // one in the table takes precedence.
        let configured = REFINERS.iter().rev().find_map(|entry| {
            self.refiners().into_iter().find(|choice| choice.kind() == Some(entry.kind))
        });
        let refiner = configured.unwrap_or(RefinerChoice::OFF);
        let flags = Overrides::default()
            .data(Some(self.work_folder()?))
            .model(self.model.clone())
            .refiner(Some(refiner))
            .mllm_base_url(self.mllm_base_url.clone());
        let mut config = Config::load(self.config.as_deref(), &flags)?;
        if std::env::var_os("WHEREABOUTS_LOG__FILTER").is_none() {
            "warn".clone_into(&mut config.log.filter);
        }
        if let Some(k) = self.k.map(usize::from) {
            (config.refine.candidates, config.refine.local_candidates) = (k, k);
        }
        config.jobs.workers = self.concurrency();
        config.image.queue = config.image.queue.max(self.concurrency());
        Ok(config)
    }

    /// Returns the work folder. Its default name is derived from the folder of references, so that evaluations
    /// of different data sets do not lock each other out.
    fn work_folder(&self) -> anyhow::Result<PathBuf> {
        if let Some(work) = &self.work {
            return Ok(work.clone());
        }
        let database = self.database.canonicalize().with_context(|| {
            format!("cannot read the folder {} (--database)", self.database.display())
        })?;
        let name = database.file_name().unwrap_or_default().to_string_lossy();
        let digest = Digest::of(database.as_os_str().as_encoded_bytes()).hex();
        Ok(Path::new("eval-work").join(format!("{name}-{}", &digest[..8])))
    }

    fn concurrency(&self) -> usize {
        let cores = || std::thread::available_parallelism().map_or(1, usize::from);
        self.concurrency.map_or_else(cores, usize::from)
    }

    pub fn settings(&self, config: &Config) -> anyhow::Result<RunSettings> {
        Ok(RunSettings {
            k: config.compared_candidates(),
            search: if self.exact { SearchMode::Exact } else { SearchMode::Fast },
            scene: self.scene,
            concurrency: self.concurrency(),
            work_dir: config.data.dir.clone(),
            attempts: config.jobs.attempt_policy(),
            refiner_settings: fingerprint(&config.refiner_settings())?,
        })
    }
}

/// Returns a text that changes with everything that determines what the refiners return.
fn fingerprint(settings: &RefinerSettings) -> anyhow::Result<String> {
    let fingerprints = REFINERS.iter().map(|entry| Ok((entry.fingerprint)(settings)?));
    Ok(fingerprints.collect::<anyhow::Result<Vec<String>>>()?.join(" "))
}
