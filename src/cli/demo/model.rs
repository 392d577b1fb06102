//! Which model the demo uses: DINOv2 if it is installed or can be had at once, else the built-in one.

use std::time::Duration;

use anyhow::Context;
use tokio::task::JoinHandle;

use super::super::model::{Screen, models_folder};
use super::Args;
use whereabouts_models::{Catalogue, DownloadSettings, Entry};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_vision::{Assets, BUILT_IN_MODEL, PREFERRED_MODELS, WhyModel};

/// A model and why it is the one.
pub struct Choice {
    pub model: String,
    pub why: String,
}

/// A choice that may depend on whether the hub answers.
pub enum Choosing {
    Settled(Choice),
    Asking { hub: Box<Hub>, answer: JoinHandle<Result<(), String>> },
}

/// Where the model that the demo would like can be had.
pub struct Hub {
    config: Config,
    assets: Assets,
    entry: Entry,
}

impl Choosing {
    /// Looks at what is installed; if that is not DINOv2, begins to ask the hub.
    pub fn begin(args: &Args) -> anyhow::Result<Self> {
        let config = Config::load(None, &Overrides::default().model(args.model.clone()))?;
        let assets = Assets::locate(config.model.assets());
        let (model, why) = assets.resolve(&config.model.name)?;
        let patience = Duration::from_secs(config.model.hub_patience_s);
        let why = match why {
            WhyModel::BuiltIn if args.offline => "built in; no DINOv2 is installed, and --offline",
            WhyModel::BuiltIn if patience.is_zero() => {
                "built in; no DINOv2 is installed, and model.hub_patience_s is 0"
            }
            WhyModel::BuiltIn => {
                let catalogue = Catalogue::of(args.catalogue.as_deref())?;
                let [smallest, ..] = PREFERRED_MODELS;
                let entry = catalogue.find(smallest).cloned();
                let entry = entry.with_context(|| format!("the catalogue lacks {smallest}"))?;
                let answer =
                    tokio::spawn(ask(entry.url(&config.model.hub, &entry.manifest.file), patience));
                let hub = Box::new(Hub { config, assets, entry });
                return Ok(Self::Asking { hub, answer });
            }
            why => &why.to_string(),
        };
        // Before anything is drawn.
        assets.model(&model)?;
        Ok(Self::Settled(Choice { model, why: why.to_owned() }))
    }

    /// Installs DINOv2 if the hub answered, and says which model it is.
    pub async fn end(self) -> anyhow::Result<Choice> {
        let (hub, answer) = match self {
            Self::Settled(choice) => return Ok(choice),
            Self::Asking { hub, answer } => (hub, answer.await?),
        };
        let name = hub.entry.name();
        let from = &hub.config.model.hub;
        let built_in = |why: String| Choice { model: BUILT_IN_MODEL.to_owned(), why };
        if let Err(why) = answer {
            return Ok(built_in(format!(
                "built in; no DINOv2 is installed, and none can be had from {from} ({why})"
            )));
        }
        Ok(match hub.pull().await {
            Ok(()) => Choice { model: name.to_owned(), why: format!("installed from {from}") },
            Err(error) => built_in(format!("built in; {name} could not be installed: {error:#}")),
        })
    }
}

impl Hub {
    async fn pull(&self) -> anyhow::Result<()> {
        let folder = models_folder(self.config.model.assets(), &self.assets)?;
        let settings = self.config.model.download();
        // A demo goes on without it rather than wait for a bad line; what came is kept.
        let settings = DownloadSettings {
            attempts: settings.attempts.min(2),
            stall: settings.stall.min(Duration::from_secs(5)),
            ..settings
        };
        let mut screen = Screen::new(self.entry.name());
        let hub = &self.config.model.hub;
        let pulled = folder.pull(&self.entry, hub, settings, |p| screen.show(&p)).await;
        screen.end();
        pulled.map(drop).map_err(anyhow::Error::new)
    }
}

/// Whether a file can be had.
async fn ask(url: String, patience: Duration) -> Result<(), String> {
    let short = |error: reqwest::Error| match error {
        error if error.is_timeout() => format!("no answer within {} s", patience.as_secs()),
        error if error.is_connect() => "no connection".to_owned(),
        error => error.without_url().to_string(),
    };
    let client = reqwest::Client::builder().timeout(patience).build().map_err(short)?;
    let answer = client.head(url).send().await.map_err(short)?;
    match answer.status() {
        status if status.is_success() => Ok(()),
        status => Err(format!("it answered {status}")),
    }
}
