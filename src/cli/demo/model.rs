//! Chooses the model of the demo: DINOv2 if it is installed or the hub answers at once, otherwise the built-in
//! one.

use std::time::Duration;

use anyhow::Context;
use tokio::task::JoinHandle;

use super::super::model::{DownloadMeter, models_folder};
use super::Args;
use whereabouts_models::{Catalogue, DownloadSettings, Entry};
use whereabouts_server::config::{Config, Overrides};
use whereabouts_vision::{Assets, BUILT_IN_MODEL, PREFERRED_MODELS, WhyModel};

/// A model and the reason for choosing it.
pub struct ModelChoice {
    pub model: String,
    pub reason: String,
}

/// A choice that may depend on whether the hub answers.
pub enum PendingChoice {
    Resolved(ModelChoice),
    Probing { offer: Box<HubModel>, probe: JoinHandle<Result<(), String>> },
}

/// The preferred model, to be pulled from the hub.
pub struct HubModel {
    config: Config,
    assets: Assets,
    entry: Entry,
}

impl PendingChoice {
    /// Resolves the model from what is installed. If that is only the built-in one, begins to probe the hub.
    pub fn begin(args: &Args) -> anyhow::Result<Self> {
        let config = Config::load(None, &Overrides::default().model(args.model.clone()))?;
        let assets = config.model.installed_in(None);
        let (model, why) = assets.resolve(&config.model.name)?;
        let timeout = Duration::from_secs(config.model.hub_patience_s);
        let reason = match why {
            WhyModel::BuiltIn if args.offline => {
                "built in; no DINOv2 is installed, and --offline was given"
            }
            WhyModel::BuiltIn if timeout.is_zero() => {
                "built in; no DINOv2 is installed, and model.hub_patience_s is 0"
            }
            WhyModel::BuiltIn => {
                let catalogue = Catalogue::of(args.catalogue.as_deref())?;
                let [smallest, ..] = PREFERRED_MODELS;
                let entry = catalogue.find(smallest).cloned();
                let entry =
                    entry.with_context(|| format!("the catalogue has no model {smallest}"))?;
                let address = entry.url(&config.model.hub, &entry.manifest.file);
                let probe = tokio::spawn(probe(address, timeout));
                let offer = Box::new(HubModel { config, assets, entry });
                return Ok(Self::Probing { offer, probe });
            }
            why => &why.to_string(),
        };
        // Fails before anything is rendered.
        assets.model(&model)?;
        Ok(Self::Resolved(ModelChoice { model, reason: reason.to_owned() }))
    }

    /// Pulls DINOv2 if the hub answered, and returns the choice.
    pub async fn resolve(self) -> anyhow::Result<ModelChoice> {
        let (offer, probe) = match self {
            Self::Resolved(choice) => return Ok(choice),
            Self::Probing { offer, probe } => (offer, probe.await?),
        };
        let name = offer.entry.name();
        let hub = &offer.config.model.hub;
        let built_in = |reason: String| ModelChoice { model: BUILT_IN_MODEL.to_owned(), reason };
        if let Err(error) = probe {
            return Ok(built_in(format!(
                "built in; no DINOv2 is installed, and {hub} does not offer one ({error})"
            )));
        }
        Ok(match offer.pull().await {
            Ok(()) => {
                ModelChoice { model: name.to_owned(), reason: format!("installed from {hub}") }
            }
            Err(error) => built_in(format!(
                "built in; {name} could not be installed: {}",
                crate::message(&error)
            )),
        })
    }
}

impl HubModel {
    async fn pull(&self) -> anyhow::Result<()> {
        let folder = models_folder(self.config.model.assets(), &self.assets)?;
        let settings = self.config.model.download();
        // The demo uses the built-in model rather than wait for a bad connection. A partial download is kept.
        let settings = DownloadSettings {
            attempts: settings.attempts.min(2),
            stall: settings.stall.min(Duration::from_secs(5)),
            ..settings
        };
        let mut meter = DownloadMeter::new(self.entry.name());
        let hub = &self.config.model.hub;
        let pulled =
            folder.pull(&self.assets, &self.entry, hub, settings, |p| meter.show(&p)).await;
        meter.finish();
        pulled.map(drop).map_err(anyhow::Error::new)
    }
}

/// Checks within `timeout` whether the URL exists.
async fn probe(url: String, timeout: Duration) -> Result<(), String> {
    let explain = |error: reqwest::Error| match error {
        error if error.is_timeout() => format!("no answer within {} s", timeout.as_secs()),
        error if error.is_connect() => "no connection".to_owned(),
        error => error.without_url().to_string(),
    };
    let client = reqwest::Client::builder().timeout(timeout).build().map_err(explain)?;
    let response = client.head(url).send().await.map_err(explain)?;
    match response.status() {
        status if status.is_success() => Ok(()),
        status => Err(format!("it answered {status}")),
    }
}
