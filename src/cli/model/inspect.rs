//! The actions that change nothing: list, show and verify.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use indicatif::DecimalBytes;
use serde::Serialize;
use serde_json::json;

use super::ModelContext;
use whereabouts_core::Digest;
use whereabouts_models::InstallError;
use whereabouts_vision::{AUTO, Assets, BUILT_IN_MODEL, MANIFEST, Manifest};
use whereabouts_vision::{ModelFault, try_model};

/// One row of the list of models.
#[derive(Serialize)]
struct ListedModel {
    name: String,
    /// `installed`, `available`, or `damaged` if the manifest cannot be read.
    state: &'static str,
    in_use: bool,
    /// Dimensions of its default descriptor.
    dimension: Option<usize>,
    licence: Option<String>,
    description: String,
    folder: Option<PathBuf>,
}

impl ListedModel {
    fn new(name: &str, state: &'static str, manifest: &Manifest, folder: Option<PathBuf>) -> Self {
        Self {
            name: name.to_owned(),
            state,
            in_use: false,
            dimension: manifest.dimension(manifest.default_kind()),
            licence: Some(manifest.licence.clone()),
            description: manifest.description.clone(),
            folder,
        }
    }

    fn installed(name: &str, folder: PathBuf) -> Self {
        match Manifest::read(&folder.join(MANIFEST)) {
            Ok(manifest) => Self::new(name, "installed", &manifest, Some(folder)),
            Err(error) => Self {
                name: name.to_owned(),
                state: "damaged",
                in_use: false,
                dimension: None,
                licence: None,
                description: error.to_string(),
                folder: Some(folder),
            },
        }
    }
}

/// Prints the installed models, then those that can be pulled.
pub fn list(context: &ModelContext, json: bool) -> anyhow::Result<()> {
    let installed = context.assets.installed();
    let in_use = context.assets.resolve(&context.config.model.name);
    let available = context.catalogue.entries().iter();
    let available: Vec<_> = available
        .filter(|entry| !installed.contains_key(entry.name()))
        .map(|entry| ListedModel::new(entry.name(), "available", &entry.manifest, None))
        .collect();
    let mut models: Vec<_> =
        installed.into_iter().map(|(name, folder)| ListedModel::installed(&name, folder)).collect();
    models.extend(available);
    for model in &mut models {
        model.in_use = in_use.as_ref().is_ok_and(|(name, _)| *name == model.name);
    }
    if json {
        let in_use = in_use.ok().map(|(name, why)| json!({"name": name, "why": why.to_string()}));
        println!("{}", json!({"models": models, "in_use": in_use}));
        return Ok(());
    }
    println!("  {:16} {:9} {:>5}  {:12} description", "name", "state", "dims", "licence");
    for model in models {
        println!(
            "{} {:16} {:9} {:>5}  {:12} {}",
            if model.in_use { '*' } else { ' ' },
            model.name,
            model.state,
            model.dimension.map_or("?".into(), |dimension| dimension.to_string()),
            model.licence.as_deref().unwrap_or("?"),
            model.description
        );
    }
    print_default_model(context);
    Ok(())
}

/// Prints the default model of a server, and why it is the default.
pub fn print_default_model(context: &ModelContext) {
    let setting = &context.config.model.name;
    match context.assets.resolve(setting) {
        Ok((name, why)) => println!("in use: {name} ({why})"),
        Err(error) => println!("in use: none; {error}"),
    }
    if let Some((file, selected)) = context.assets.chosen()
        && setting != AUTO
    {
        println!(
            "  model.name = {setting:?} takes precedence over the selection of {selected} in {}",
            file.display()
        );
    }
}

/// Prints the details of one model.
pub fn show(context: &ModelContext, name: &str, json: bool) -> anyhow::Result<()> {
    let entry = context.catalogue.find(name);
    let folder = context.assets.model(name).ok();
    let manifest = match (&folder, entry) {
        (Some(folder), _) => context.assets.manifest(folder)?,
        (None, Some(entry)) => entry.manifest.clone(),
        (None, None) => {
            bail!("there is no model {name:?}; `whereabouts model list` shows all models")
        }
    };
    let bytes = match &folder {
        Some(folder) => {
            let size = |file: &Path| Some(folder.join(file).metadata().ok()?.len());
            manifest.files().map(|(file, _)| size(file)).sum()
        }
        None => entry.and_then(|entry| entry.bytes),
    };
    let address = entry.map(|entry| entry.url(&context.config.model.hub, &manifest.file));
    if json {
        let details = json!({
            "name": name, "installed": folder.is_some(), "folder": folder, "bytes": bytes,
            "address": address, "manifest": manifest,
        });
        println!("{details}");
        return Ok(());
    }
    let folder = folder.map_or("not installed".into(), |folder| folder.display().to_string());
    let size = bytes.map_or("unknown".into(), |bytes| DecimalBytes(bytes).to_string());
    let digest = manifest.sha256.map_or("recorded when it is pulled".into(), |d| d.to_string());
    println!("{name}: {}", manifest.description);
    println!("  folder   {folder}");
    println!("  size     {size}");
    println!("  digest   {digest}");
    println!("  address  {}", address.unwrap_or_else(|| "not in the catalogue".into()));
    println!("  licence  {}", manifest.licence);
    println!("  source   {}", manifest.source);
    println!("  input    {}", manifest.input);
    for kind in manifest.kinds() {
        let dimension = manifest.dimension(kind).unwrap_or_default();
        let default = if kind == manifest.default_kind() { " (default)" } else { "" };
        println!("  {kind:8} {dimension} dimensions{default}");
    }
    println!("\n{}", manifest.to_toml()?.trim_end());
    Ok(())
}

/// The result of verifying one model.
#[derive(Serialize)]
struct Check {
    name: String,
    ok: bool,
    folder: PathBuf,
    /// Whether its manifest pins every digest; otherwise there is nothing to compare with.
    pinned: bool,
    /// The digests, or the error.
    detail: String,
    /// What works with restrictions.
    notes: Vec<String>,
}

impl Check {
    fn run(assets: &Assets, name: String, folder: PathBuf) -> Self {
        let (ok, pinned, detail, notes) = match whereabouts_models::verify(&folder) {
            Ok(verdict) => {
                let pinned = verdict.manifest.files().all(|(_, pinned)| pinned.is_some());
                let digests = join(&verdict.digests);
                match try_model(assets, &folder) {
                    Ok(notes) => (true, pinned, digests, notes),
                    Err(ModelFault::Runtime(why)) => {
                        (true, pinned, digests, vec![format!("it was not run: {why}")])
                    }
                    Err(fault) => (false, pinned, fault.to_string(), Vec::new()),
                }
            }
            Err(error) => {
                let pinned = matches!(error, InstallError::Damaged { .. });
                (false, pinned, error.to_string(), Vec::new())
            }
        };
        Self { name, ok, folder, pinned, detail, notes }
    }
}

/// Joins the digests of a model's files for printing.
pub fn join(digests: &[Digest]) -> String {
    digests.iter().map(Digest::to_string).collect::<Vec<_>>().join(" and ")
}

/// Verifies one model or all. A damaged model is an error.
pub fn verify(context: &ModelContext, name: Option<&str>, json: bool) -> anyhow::Result<()> {
    let models = match name {
        Some(name) => BTreeMap::from([(name.to_owned(), context.assets.model(name)?)]),
        None => context.assets.installed(),
    };
    let checks: Vec<_> = models
        .into_iter()
        .map(|(name, folder)| Check::run(&context.assets, name, folder))
        .collect();
    if json {
        println!("{}", json!({ "models": checks }));
    } else {
        checks.iter().for_each(print_check);
    }
    let failed: Vec<_> = checks.iter().filter(|check| !check.ok).collect();
    match failed.first() {
        None => Ok(()),
        Some(first) => Err(remedy(context, first)).with_context(|| {
            format!("models that failed verification: {} of {}", failed.len(), checks.len())
        }),
    }
}

fn print_check(check: &Check) {
    match (check.ok, check.pinned) {
        (true, true) => println!("{}: good, {}", check.name, check.detail),
        (true, false) => println!(
            "{}: {}; not verified, because its manifest pins no sha256",
            check.name, check.detail
        ),
        (false, _) => println!("{}: bad: {}", check.name, check.detail),
    }
    check.notes.iter().for_each(|note| println!("  note: {note}"));
}

fn remedy(context: &ModelContext, check: &Check) -> anyhow::Error {
    let Check { name, folder, .. } = check;
    let folder = folder.display();
    if context.catalogue.find(name).is_some() {
        anyhow!("replace it with `whereabouts model pull {name}`")
    } else if name == BUILT_IN_MODEL {
        anyhow!("remove {folder} and run `make build`, which installs it again")
    } else {
        anyhow!("remove {folder} and install it again with `whereabouts model add`")
    }
}
