//! `whereabouts model`.

mod account;
mod bench;
mod screen;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

pub use self::screen::Screen;
use whereabouts_models::{Added, Catalogue, ModelsFolder, Pulled};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_vision::{AUTO, Assets, BUILT_IN_MODEL};

/// A map that names no model has the one that the server was started with. Where model.name is
/// "auto", as it is by default, that is the model that `use` chose; else the first that is installed
/// of dinov2-small, dinov2-base and dinov2-large; else the built-in xfeat.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
    /// A configuration file; [model] has the hub and the bounds on downloads
    #[arg(long, global = true, value_name = "FILE")]
    config: Option<PathBuf>,
    /// The assets folder to install into and to look in first
    #[arg(long, global = true, value_name = "DIR")]
    assets: Option<PathBuf>,
    /// A catalogue to use instead of the built-in one
    #[arg(long, global = true, value_name = "FILE", hide = true, env = "WHEREABOUTS_CATALOGUE")]
    catalogue: Option<PathBuf>,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// List the models that are installed and those that can be pulled
    List {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Show what is known of a model
    Show {
        /// The model
        name: String,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Download a model; run it again to continue one that broke off
    Pull {
        /// A model that `list` shows
        name: String,
    },
    /// Install a model from a file
    Add {
        /// The ONNX file
        file: PathBuf,
        /// How to feed and pool it; deploy/models/xfeat.toml is an example
        #[arg(long, value_name = "TOML")]
        manifest: PathBuf,
        /// Another name than the manifest's
        #[arg(long)]
        name: Option<String>,
    },
    /// Hash installed models again; exit code 1 if a file is not the one that was installed
    Verify {
        /// Only this model
        name: Option<String>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Measure each way of running a model on this machine: provider, precision, threads, batch
    Bench(bench::BenchArgs),
    /// Choose the model that a server starts with
    Use {
        /// An installed model; or auto, to take a choice back
        name: String,
    },
}

/// What the actions work on.
struct Place {
    config: Config,
    catalogue: Catalogue,
    assets: Assets,
    /// The folder to install into, if a flag or the settings name one.
    named: Option<PathBuf>,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let place = Place::of(&args)?;
    match args.action {
        Action::List { json } => account::list(&place, json),
        Action::Show { name, json } => account::show(&place, &name, json),
        Action::Pull { name } => pull(&place, &name).await,
        Action::Add { file, manifest, name } => {
            let added = place.folder()?.add(&file, &manifest, name.as_deref())?;
            match added {
                Added::Present(folder) => {
                    println!("{}: this file is installed already", folder.display());
                }
                Added::Installed { folder, name, digests } => {
                    println!("{name}: installed in {}", folder.display());
                    println!("  {}, recorded in its manifest", account::words(&digests));
                    println!("  run it with `whereabouts serve --model {name}`");
                    println!("  or make it the default with `whereabouts model use {name}`");
                }
            }
            Ok(())
        }
        Action::Verify { name, json } => account::verify(&place, name.as_deref(), json),
        Action::Bench(args) => tokio::task::block_in_place(|| bench::run(&place, args)),
        Action::Use { name } => choose(&place, &name),
    }
}

impl Place {
    fn of(args: &Args) -> anyhow::Result<Self> {
        let config = Config::load(args.config.as_deref(), &Overrides::default())?;
        let catalogue = Catalogue::of(args.catalogue.as_deref())?;
        let named = args.assets.as_deref().or(config.model.assets()).map(PathBuf::from);
        let assets = Assets::locate(named.as_deref());
        Ok(Self { config, catalogue, assets, named })
    }

    fn folder(&self) -> anyhow::Result<ModelsFolder> {
        models_folder(self.named.as_deref(), &self.assets)
    }

    /// A folder that a server does not look in by itself has to be named to it.
    fn say_how_it_is_found(&self) {
        if let Some(named) = &self.named
            && !Assets::locate(self.config.model.assets()).candidates().contains(named)
        {
            println!("  start the server with WHEREABOUTS_MODEL__ASSETS={}", named.display());
        }
    }
}

/// Where to install: the folder named, or the first of the usual ones that is there and can be
/// written.
pub fn models_folder(named: Option<&Path>, assets: &Assets) -> anyhow::Result<ModelsFolder> {
    if let Some(named) = named {
        return Ok(ModelsFolder::open(named)?);
    }
    let there = assets.candidates().iter().filter(|folder| folder.is_dir());
    there.flat_map(|folder| ModelsFolder::open(folder)).next().with_context(|| {
        let looked: Vec<_> =
            assets.candidates().iter().map(|path| path.display().to_string()).collect();
        format!(
            "no assets folder is there that can be written (looked in {}); run `make build` in \
             the checkout, or name a folder with --assets DIR",
            looked.join(", ")
        )
    })
}

async fn pull(place: &Place, name: &str) -> anyhow::Result<()> {
    let Some(entry) = place.catalogue.find(name) else {
        if name == BUILT_IN_MODEL {
            bail!("{name} is built in: `make build` installs it");
        }
        let names: Vec<_> = place.catalogue.entries().iter().map(|entry| entry.name()).collect();
        bail!(
            "the catalogue has no model {name:?}, only {}; `whereabouts model add FILE --manifest \
             TOML` installs any other",
            names.join(", ")
        );
    };
    let (hub, settings) = (&place.config.model.hub, place.config.model.download());
    let mut screen = Screen::new(name);
    let pulled = place
        .folder()?
        .pull(entry, hub, settings, |progress| screen.show(&progress))
        .await
        .inspect_err(|_| screen.end())
        .with_context(|| format!("{name} was not installed"));
    screen.end();
    match pulled? {
        Pulled::Present(folder) => {
            println!("{name}: installed already and whole, in {}", folder.display());
        }
        Pulled::Installed { folder, digests, pinned, replaced } => {
            if let Some(fault) = replaced {
                println!("{name}: replaced the model that was there: {fault}");
            }
            println!("{name}: installed in {}", folder.display());
            let digests = account::words(&digests);
            match pinned {
                true => println!("  {digests}, as the catalogue pins it"),
                false => println!(
                    "  {digests}, recorded in its manifest: the catalogue pins none, so this first \
                     download was taken as it came"
                ),
            }
            println!("  licence {}, see the file LICENCE there", entry.manifest.licence);
        }
    }
    account::say_in_use(place);
    place.say_how_it_is_found();
    Ok(())
}

fn choose(place: &Place, name: &str) -> anyhow::Result<()> {
    let choice = Some(name).filter(|name| *name != AUTO);
    if let Some(name) = choice {
        place.assets.model(name)?;
    }
    place.folder()?.choose(choice)?;
    let chosen = place.assets.chosen();
    if let Some((file, other)) = chosen
        && choice != Some(other.as_str())
    {
        bail!("{} chooses {other:?} and goes first; remove it", file.display());
    }
    account::say_in_use(place);
    place.say_how_it_is_found();
    Ok(())
}
