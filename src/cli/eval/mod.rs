//! `whereabouts eval`: runs the service in this process on a work folder, and measures its recall.

mod args;

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, bail};
use parking_lot::Mutex;

pub use self::args::Args;
use super::progress::ProgressMeter;
use whereabouts_eval::{
    Dataset, Evaluator, Folders, Observer, RunConditions, Sampling, Summary, predictions, report,
    table,
};
use whereabouts_refine::{Refiner, RefinerContext};
use whereabouts_server::Metrics;
use whereabouts_server::config::Config;
use whereabouts_server::startup;
use whereabouts_server::startup::Parts;
use whereabouts_service::Service;

/// Most names in one line of what is left out, and lines of one kind.
const MOST_NAMES: usize = 20;

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
    data.left_out.lines(MOST_NAMES).iter().for_each(|line| eprintln!("{line}"));
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out)
            .with_context(|| format!("cannot create the folder {}", out.display()))?;
    }

    let config = args.config()?;
    let _logs =
        whereabouts_telemetry::init(&config.log, &config.traces).map_err(anyhow::Error::msg)?;
    let Parts { service, refiners: context, .. } = open(config.clone()).await?;
    let service = Arc::new(service);
    let model = service.maps.imaging.models.default_model().to_owned();
    let extractor = service.maps.imaging.installed_model(&model).await?;
    let execution = extractor.execution().to_string();
    let descriptors = match args.descriptor.as_slice() {
        [] => vec![extractor.manifest().default_kind()],
        requested => requested.to_vec(),
    };
    drop(extractor);
    let limits = service.maps.imaging.models.limits();
    let observer = PhaseMeter::default();
    let evaluator = Evaluator {
        refiners: refiners(&args, &service, &context).await?,
        service,
        settings: args.settings(&config)?,
        observer: &observer,
    };
    let mut outcomes = Vec::new();
    for descriptor in descriptors {
        outcomes.extend(evaluator.run(&data, descriptor).await?);
    }

    let conditions = RunConditions {
        database: args.database.display().to_string(),
        query_folder: args.queries.display().to_string(),
        truth: truth.criterion(),
        model,
        execution,
        k: config.compared_candidates(),
        known_threshold: args.known_threshold.0,
        known_confidence: config.localize.known_confidence,
        search: if args.exact { "exact" } else { "fast" }.into(),
    };
    let summary = Summary::new(conditions, &data, &outcomes);
    if let Some(out) = &args.out {
        write(&out.join("summary.json"), &serde_json::to_vec_pretty(&summary)?)?;
        predictions::write(&out.join("predictions.csv"), &data, &outcomes)?;
        let page = report::html(&summary, &data, &outcomes, limits)?;
        write(&out.join("report.html"), page.as_bytes())?;
    }
    if args.json {
        println!("{}", serde_json::to_string(&summary)?);
    } else {
        print!("{}", table(&summary));
    }
    let lost = data.left_out.skipped.iter().filter(|skipped| skipped.is_lost).count();
    if lost > 0 {
        bail!(
            "{lost} files were not evaluated; repair or remove them, then run the same command again"
        );
    }
    // The figures of such a method are not its own.
    match summary.methods.iter().find(|method| method.degraded > 0) {
        Some(method) => bail!(
            "{} of {} queries were not fully refined by {}; run the same command again to try them again",
            method.degraded,
            summary.queries,
            method.name
        ),
        None => Ok(()),
    }
}

/// Opens the service on the work folder. Its workers are not started: there is no job queue.
async fn open(config: Config) -> anyhow::Result<Parts> {
    let work = config.data.dir.clone();
    let building =
        tokio::task::spawn_blocking(move || startup::build(&config, Arc::new(Metrics::new())));
    building
        .await?
        .with_context(|| format!("cannot open the work folder {} (--work)", work.display()))
}

/// Returns the refiners that --refine names, in its order. The service's own refiner is reused.
async fn refiners(
    args: &Args,
    service: &Service,
    context: &RefinerContext,
) -> anyhow::Result<Vec<Arc<dyn Refiner>>> {
    let mut refiners: Vec<Arc<dyn Refiner>> = Vec::new();
    for entry in args.refiners().into_iter().filter_map(|choice| choice.entry()) {
        let running = service.jobs.refiner.as_ref().filter(|refiner| refiner.kind() == entry.kind);
        refiners.push(match running {
            Some(refiner) => Arc::clone(refiner),
            None => (entry.build)(context).await?,
        });
    }
    Ok(refiners)
}

fn write(file: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    std::fs::write(file, bytes).with_context(|| format!("cannot write {}", file.display()))
}

/// Shows one progress bar per phase of the evaluation.
#[derive(Default)]
struct PhaseMeter(Mutex<Option<ProgressMeter>>);

impl Observer for PhaseMeter {
    fn begin(&self, what: &str, total: usize) {
        *self.0.lock() = Some(ProgressMeter::new(what, total));
    }

    fn step(&self) {
        self.0.lock().iter().for_each(ProgressMeter::step);
    }

    fn finish(&self) {
        self.0.lock().take().iter().for_each(ProgressMeter::finish);
    }
}
