//! `whereabouts eval`: how often the service is right on two folders, without a server.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use parking_lot::Mutex;

use super::progress::Progress;
use whereabouts_core::{DescriptorKind, Digest, Scene};
use whereabouts_eval::{
    Dataset, Evaluator, Folders, RunConditions, RunSettings, Sampling, Summary, TruthSource, Watch,
    predictions, report, table,
};
use whereabouts_index::SearchMode;
use whereabouts_refine::{REFINERS, Refiner, RefinerContext, RefinerSettings};
use whereabouts_server::Metrics;
use whereabouts_server::config::{Config, Overrides, RefinerChoice};
use whereabouts_server::startup;
use whereabouts_server::startup::Parts;
use whereabouts_service::Service;

/// Indexes a folder of references, asks every picture of a folder of queries, and prints Recall@1,
/// 5 and 10 before and after refinement. Which references are true for which query is taken from, in
/// this order: --ground-truth, --frame-tolerance, a ground_truth.csv in or beside the folder of
/// queries, and positions: --database-poses and --queries-poses or a poses.csv in each folder, file
/// names @easting@northing@..., or EXIF GPS. A run that was stopped goes on where it was.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder of references; folders in it are searched too
    #[arg(long, value_name = "DIR")]
    database: PathBuf,
    /// The folder of queries
    #[arg(long, value_name = "DIR")]
    queries: PathBuf,
    /// A folder of pictures of other places, to measure how well `known` tells them apart
    #[arg(long, value_name = "DIR")]
    unknown: Option<PathBuf>,
    /// Leave out this share of the references, the last by name, to see what `known` is worth: their
    /// queries should not be called known
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    hold_out: f64,
    /// A CSV file with the columns query,references; the references separated by spaces
    #[arg(long, value_name = "FILE", conflicts_with = "frame_tolerance")]
    ground_truth: Option<PathBuf>,
    /// Both folders are in the order of the same way; true references are so many frames off
    #[arg(long, value_name = "N")]
    frame_tolerance: Option<usize>,
    /// Positions of the references: a CSV file with file, and lat,lon or x,y
    #[arg(long, value_name = "FILE")]
    database_poses: Option<PathBuf>,
    /// Positions of the queries
    #[arg(long, value_name = "FILE")]
    queries_poses: Option<PathBuf>,
    /// How far off a true reference may be, in metres
    #[arg(long, value_name = "METRES", default_value_t = 25.0)]
    threshold_m: f64,
    /// What the coarse retriever compares: gem, cls, or both
    #[arg(long, value_delimiter = ',', default_value = "gem")]
    descriptor: Vec<DescriptorKind>,
    /// Who refines its candidates: local, mllm, both, or off
    #[arg(long, value_delimiter = ',', default_value = "local")]
    refine: Vec<RefinerChoice>,
    /// Candidates that are refined [default: as configured, which is 10 with mllm, else 20]
    #[arg(short, value_parser = clap::value_parser!(u8).range(1..=100))]
    k: Option<u8>,
    /// So many of the queries, chosen by chance
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    sample: Option<u32>,
    /// Decides which queries are chosen
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// What the pictures show; it chooses the words of the prompts
    #[arg(long, default_value_t = Scene::Outdoor)]
    scene: Scene,
    /// The least confidence of a known place: `auto` suggests one, a number is looked at besides
    #[arg(long, value_name = "auto|NUMBER", default_value = "auto", value_parser = known_threshold)]
    known_threshold: KnownThreshold,
    /// Compare every descriptor instead of searching a graph
    #[arg(long)]
    exact: bool,
    /// Write report.html, summary.json and predictions.csv here
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Where descriptors, descriptions and outcomes are kept [default: eval-work/ and a name for
    /// the database]
    #[arg(long, value_name = "DIR")]
    work: Option<PathBuf>,
    /// Pictures in work at a time [default: one for each core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64))]
    concurrency: Option<u16>,
    /// A configuration file, as of `serve`
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The model
    #[arg(long, value_name = "NAME")]
    model: Option<String>,
    /// A server that speaks the OpenAI chat-completions format, for --refine mllm; its key comes
    /// from WHEREABOUTS_MLLM__API_KEY
    #[arg(long, value_name = "URL")]
    mllm_base_url: Option<String>,
    /// Print the outcome as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let folders = Folders {
        database: args.database.clone(),
        queries: args.queries.clone(),
        unknown: args.unknown.clone(),
        hold_out: args.hold_out,
    };
    let truth = args.truth()?;
    let sampling = Sampling { size: args.sample.map(|size| size as usize), seed: args.seed };
    let data = Dataset::read(&folders, &truth, sampling)?;
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out)
            .with_context(|| format!("cannot make the folder {}", out.display()))?;
    }

    let config = args.config()?;
    let _logs =
        whereabouts_telemetry::init(&config.log, &config.traces).map_err(anyhow::Error::msg)?;
    let Parts { service, refiners, .. } = open(config.clone()).await?;
    let service = Arc::new(service);
    let model = service.maps.imaging.models.default_model().to_owned();
    let execution = service.maps.imaging.installed_model(&model).await?.execution().to_string();
    let limits = service.maps.imaging.models.limits();
    let watch = Bars::default();
    let evaluator = Evaluator {
        refiners: args.refiners(&service, &refiners).await?,
        service,
        settings: args.settings(&config)?,
        watch: &watch,
    };
    let mut found = Vec::new();
    for descriptor in &args.descriptor {
        found.extend(evaluator.run(&data, *descriptor).await?);
    }

    let told = RunConditions {
        database: args.database.display().to_string(),
        query_folder: args.queries.display().to_string(),
        truth: truth.said(),
        model,
        execution,
        k: config.compared_candidates(),
        known_threshold: args.known_threshold.0,
        known_confidence: config.localize.known_confidence,
        search: if args.exact { "exact" } else { "fast" }.into(),
    };
    let summary = Summary::new(told, &data, &found);
    if let Some(out) = &args.out {
        write(&out.join("summary.json"), &serde_json::to_vec_pretty(&summary)?)?;
        predictions::write(&out.join("predictions.csv"), &data, &found)?;
        let page = report::html(&summary, &data, &found, limits)?;
        write(&out.join("report.html"), page.as_bytes())?;
    }
    if args.json {
        println!("{}", serde_json::to_string(&summary)?);
    } else {
        print!("{}", table(&summary));
    }
    Ok(())
}

/// The service on the work folder. Its workers are not needed: there is no queue of jobs.
async fn open(config: Config) -> anyhow::Result<Parts> {
    let work = config.data.dir.clone();
    let building =
        tokio::task::spawn_blocking(move || startup::build(&config, Arc::new(Metrics::new())));
    building.await?.with_context(|| format!("the work folder is {} (--work)", work.display()))
}

fn write(file: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(file, bytes).with_context(|| format!("cannot write {}", file.display()))
}

/// A threshold to look at besides the suggested one.
#[derive(Debug, Clone, Copy)]
struct KnownThreshold(Option<f64>);

fn known_threshold(text: &str) -> Result<KnownThreshold, String> {
    if text == "auto" {
        return Ok(KnownThreshold(None));
    }
    let number = text.parse::<f64>().ok().filter(|number| number.is_finite());
    number.map(|number| KnownThreshold(Some(number))).ok_or("it is `auto` or a number".into())
}

fn share(text: &str) -> Result<f64, String> {
    let number = text.parse::<f64>().ok().filter(|share| (0.0..1.0).contains(share));
    number.ok_or("it is a number from 0 to below 1".into())
}

impl Args {
    fn truth(&self) -> anyhow::Result<TruthSource> {
        if !self.threshold_m.is_finite() || self.threshold_m < 0.0 {
            bail!("--threshold-m must be 0 metres or more");
        }
        let posed = self.database_poses.is_some() || self.queries_poses.is_some();
        let beside = || TruthSource::beside(&self.database, &self.queries).filter(|_| !posed);
        Ok(match (&self.ground_truth, self.frame_tolerance) {
            (Some(file), _) => TruthSource::Csv(file.clone()),
            (None, Some(tolerance)) => TruthSource::Frames { tolerance },
            (None, None) => beside().unwrap_or_else(|| TruthSource::Positions {
                database: self.database_poses.clone(),
                queries: self.queries_poses.clone(),
                threshold_m: self.threshold_m,
            }),
        })
    }

    /// The configuration of a server on the work folder.
    fn config(&self) -> anyhow::Result<Config> {
        // The last of the table is the one whose settings matter most: it decides how many candidates all
        // of them compare.
        let chosen = REFINERS.iter().rev().find_map(|entry| {
            self.refine.iter().copied().find(|choice| choice.kind() == Some(entry.kind))
        });
        let refiner = chosen.unwrap_or(RefinerChoice::OFF);
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
        config.jobs.workers = self.side_by_side();
        config.image.queue = config.image.queue.max(self.side_by_side());
        Ok(config)
    }

    /// Its name tells the folder of references, so that evaluations of others do not wait for it.
    fn work_folder(&self) -> anyhow::Result<PathBuf> {
        if let Some(work) = &self.work {
            return Ok(work.clone());
        }
        let database = self
            .database
            .canonicalize()
            .with_context(|| format!("there is no folder {}", self.database.display()))?;
        let name = database.file_name().unwrap_or_default().to_string_lossy();
        let digest = Digest::of(database.as_os_str().as_encoded_bytes()).hex();
        Ok(Path::new("eval-work").join(format!("{name}-{}", &digest[..8])))
    }

    fn side_by_side(&self) -> usize {
        let cores = || std::thread::available_parallelism().map_or(1, usize::from);
        self.concurrency.map_or_else(cores, usize::from)
    }

    fn settings(&self, config: &Config) -> anyhow::Result<RunSettings> {
        Ok(RunSettings {
            k: config.compared_candidates(),
            search: if self.exact { SearchMode::Exact } else { SearchMode::Fast },
            scene: self.scene,
            side_by_side: self.side_by_side(),
            work: config.data.dir.clone(),
            attempts: startup::attempts(config),
            refiner_settings: fingerprint(&config.refiner_settings())?,
        })
    }

    /// Those that were asked for, in the order of the flag.
    async fn refiners(
        &self,
        service: &Service,
        context: &RefinerContext,
    ) -> anyhow::Result<Vec<Arc<dyn Refiner>>> {
        let mut refiners: Vec<Arc<dyn Refiner>> = Vec::new();
        for entry in self.refine.iter().filter_map(|choice| choice.entry()) {
            let running = service.jobs.refiner.as_ref().filter(|known| known.kind() == entry.kind);
            refiners.push(match running {
                Some(refiner) => Arc::clone(refiner),
                None => (entry.build)(context).await?,
            });
        }
        Ok(refiners)
    }
}

/// Returns a text that changes with everything that decides what refiners find.
fn fingerprint(settings: &RefinerSettings) -> anyhow::Result<String> {
    let fingerprints = REFINERS.iter().map(|entry| Ok((entry.fingerprint)(settings)?));
    Ok(fingerprints.collect::<anyhow::Result<Vec<String>>>()?.join(" "))
}

/// One bar after another.
#[derive(Default)]
struct Bars(Mutex<Option<Progress>>);

impl Bars {
    fn bar(&self) -> parking_lot::MutexGuard<'_, Option<Progress>> {
        self.0.lock()
    }
}

impl Watch for Bars {
    fn begin(&self, what: &str, total: usize) {
        *self.bar() = Some(Progress::new(what, total));
    }

    fn step(&self) {
        self.bar().iter().for_each(Progress::step);
    }

    fn end(&self) {
        self.bar().take().iter().for_each(Progress::end);
    }
}
