//! `whereabouts model`.

mod bench;
mod download;
mod inspect;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

pub use self::download::DownloadMeter;
use whereabouts_models::{Added, Catalogue, Difference, Entry, ModelsFolder, Pulled, Updated};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_vision::{AUTO, Assets, BUILT_IN_MODEL};

/// List, install, verify and select models
///
/// A map that names no model uses the default model of the server. If model.name is "auto", which it is by
/// default, that is the model selected with `use`, otherwise the first installed one of dinov2-small,
/// dinov2-base and dinov2-large, otherwise the built-in xfeat.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
    /// Configuration file; its section [model] sets the hub and the limits of downloads
    #[arg(long, global = true, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Assets folder to install into and to search first
    #[arg(long, global = true, value_name = "DIR")]
    assets: Option<PathBuf>,
    /// Catalogue to use instead of the built-in one
    #[arg(long, global = true, value_name = "FILE", hide = true, env = "WHEREABOUTS_CATALOGUE")]
    catalogue: Option<PathBuf>,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// List installed models and those that can be pulled
    List {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Show the details of a model
    Show {
        /// Name of the model
        name: String,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Download and install a model; run it again to resume an interrupted download
    Pull {
        /// Name of a model that `list` shows
        name: String,
        /// If it is installed, replace its manifest by that of this release; its maps must be reindexed then
        #[arg(long)]
        update: bool,
    },
    /// Install a model from a file, after trying it on two pictures
    ///
    /// Files of external weights that the ONNX file refers to are installed with it.
    Add {
        /// ONNX file
        file: PathBuf,
        /// Manifest with the preprocessing and pooling of the model; see deploy/models/xfeat.toml for an example
        #[arg(long, value_name = "TOML")]
        manifest: PathBuf,
        /// Name to install it under [default: the name in the manifest]
        #[arg(long)]
        name: Option<String>,
    },
    /// Verify the SHA-256 of installed models and try them on two pictures; the exit code is 1 if one is damaged
    Verify {
        /// Verify only this model
        name: Option<String>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Benchmark a model on this machine with every provider, precision, thread count and batch size
    Bench(bench::BenchArgs),
    /// Select the default model of the server
    Use {
        /// Name of an installed model, or auto to undo the selection
        name: String,
    },
}

/// What the actions work on.
struct ModelContext {
    config: Config,
    catalogue: Catalogue,
    assets: Assets,
    /// The folder to install into, if a flag or a setting names one.
    assets_dir: Option<PathBuf>,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let context = ModelContext::new(&args)?;
    match args.action {
        Action::List { json } => inspect::list(&context, json),
        Action::Show { name, json } => inspect::show(&context, &name, json),
        Action::Pull { name, update } => pull(&context, &name, update).await,
        Action::Add { file, manifest, name } => {
            let add = || {
                context
                    .folder()?
                    .add(&context.assets, &file, &manifest, name.as_deref())
                    .with_context(|| format!("{} was not installed", file.display()))
            };
            match tokio::task::block_in_place(add)? {
                Added::Present(folder) => {
                    println!("{}: this file is already installed", folder.display());
                }
                Added::Installed { folder, name, digests, notes } => {
                    println!("{name}: tried on two pictures and installed in {}", folder.display());
                    notes.iter().for_each(|note| println!("  note: {note}"));
                    println!("  {}, recorded in its manifest", inspect::join(&digests));
                    println!("  run it with `whereabouts serve --model {name}`");
                    println!("  or make it the default with `whereabouts model use {name}`");
                }
            }
            Ok(())
        }
        Action::Verify { name, json } => {
            tokio::task::block_in_place(|| inspect::verify(&context, name.as_deref(), json))
        }
        Action::Bench(args) => tokio::task::block_in_place(|| bench::run(&context, args)),
        Action::Use { name } => select(&context, &name),
    }
}

impl ModelContext {
    fn new(args: &Args) -> anyhow::Result<Self> {
        let config = Config::load(args.config.as_deref(), &Overrides::default())?;
        let catalogue = Catalogue::of(args.catalogue.as_deref())?;
        let assets_dir = args.assets.as_deref().or(config.model.assets()).map(PathBuf::from);
        let assets = config.model.installed_in(assets_dir.as_deref());
        Ok(Self { config, catalogue, assets, assets_dir })
    }

    fn folder(&self) -> anyhow::Result<ModelsFolder> {
        models_folder(self.assets_dir.as_deref(), &self.assets)
    }

    /// Prints the setting with which a server finds the folder, if it does not search it by default.
    fn print_assets_setting(&self) {
        if let Some(dir) = &self.assets_dir
            && !Assets::locate(self.config.model.assets()).candidates().contains(dir)
        {
            println!("  start the server with WHEREABOUTS_MODEL__ASSETS={}", dir.display());
        }
    }
}

/// Returns the folder to install into: `dir` if given, otherwise the first default folder that exists and is
/// writable.
pub fn models_folder(dir: Option<&Path>, assets: &Assets) -> anyhow::Result<ModelsFolder> {
    if let Some(dir) = dir {
        return Ok(ModelsFolder::open(dir)?);
    }
    let existing = assets.candidates().iter().filter(|folder| folder.is_dir());
    existing.flat_map(|folder| ModelsFolder::open(folder)).next().with_context(|| {
        let candidates: Vec<_> =
            assets.candidates().iter().map(|path| path.display().to_string()).collect();
        format!(
            "found no writable assets folder (searched {}); run `make build` in the checkout, or name a \
             folder with --assets DIR",
            candidates.join(", ")
        )
    })
}

async fn pull(context: &ModelContext, name: &str, update: bool) -> anyhow::Result<()> {
    let Some(entry) = context.catalogue.find(name) else {
        if name == BUILT_IN_MODEL {
            bail!("{name} is built in: `make build` installs it");
        }
        let names: Vec<_> = context.catalogue.entries().iter().map(|entry| entry.name()).collect();
        bail!(
            "the catalogue has no model {name:?}, only {}; `whereabouts model add FILE --manifest TOML` \
             installs any other",
            names.join(", ")
        );
    };
    if update && tokio::task::block_in_place(|| updated(context, entry))? {
        inspect::print_default_model(context);
        return Ok(());
    }
    let (hub, settings) = (&context.config.model.hub, context.config.model.download());
    let mut meter = DownloadMeter::new(name);
    let pulled = context
        .folder()?
        .pull(&context.assets, entry, hub, settings, |progress| meter.show(&progress))
        .await
        .inspect_err(|_| meter.finish())
        .with_context(|| format!("{name} was not installed"));
    meter.finish();
    match pulled? {
        Pulled::Present { folder, difference } => {
            println!("{name}: already installed and intact, in {}", folder.display());
            if let Some(Difference { installed, catalogue }) = difference {
                println!(
                    "  its manifest takes {installed}; that of this release takes {catalogue}"
                );
                println!(
                    "  adopt that with `whereabouts model pull {name} --update`, and then reindex its maps"
                );
            }
        }
        Pulled::Installed { folder, digests, pinned, replaced, notes } => {
            if let Some(fault) = replaced {
                println!("{name}: replaced the installed files: {fault}");
            }
            println!("{name}: tried on two pictures and installed in {}", folder.display());
            notes.iter().for_each(|note| println!("  note: {note}"));
            let digests = inspect::join(&digests);
            match pinned {
                true => println!("  {digests}, as pinned by the catalogue"),
                false => println!(
                    "  {digests}, recorded in its manifest: the catalogue pins no digest, so this first \
                     download could not be verified"
                ),
            }
            println!("  licence {}, see the file LICENCE there", entry.manifest.licence);
        }
    }
    inspect::print_default_model(context);
    context.print_assets_setting();
    Ok(())
}

/// Replaces the manifest of an installed model by the catalogue's. Returns whether the model is installed.
fn updated(context: &ModelContext, entry: &Entry) -> anyhow::Result<bool> {
    let name = entry.name();
    let update = context.folder()?.update(&context.assets, entry);
    match update.with_context(|| format!("the manifest of {name} was not replaced"))? {
        Updated::NotInstalled => return Ok(false),
        Updated::Current(folder) => {
            println!("{name}: the manifest in {} is up to date", folder.display());
        }
        Updated::Replaced { folder, difference, notes } => {
            let Difference { installed, catalogue } = difference;
            println!(
                "{name}: tried on two pictures; the manifest in {} was replaced",
                folder.display()
            );
            notes.iter().for_each(|note| println!("  note: {note}"));
            println!("  it took {installed}, and takes {catalogue} from now on");
            println!("  a map of the model is not searched until it is reindexed:");
            println!("  `whereabouts index --reindex --map MAP --model {name}`");
        }
    }
    Ok(true)
}

fn select(context: &ModelContext, name: &str) -> anyhow::Result<()> {
    let selection = Some(name).filter(|name| *name != AUTO);
    if let Some(name) = selection {
        context.assets.model(name)?;
    }
    context.folder()?.choose(selection)?;
    if let Some((file, other)) = context.assets.chosen()
        && selection != Some(other.as_str())
    {
        bail!("{} selects {other:?} and takes precedence; remove that file", file.display());
    }
    inspect::print_default_model(context);
    context.print_assets_setting();
    Ok(())
}
