//! What the actions that only look say.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use indicatif::DecimalBytes;
use serde::Serialize;
use serde_json::json;

use super::Place;
use whereabouts_core::{DescriptorKind, Digest};
use whereabouts_models::InstallError;
use whereabouts_vision::{AUTO, BUILT_IN_MODEL, MANIFEST, Manifest};

/// One model in the list.
#[derive(Serialize)]
struct Line {
    name: String,
    /// `installed`, `available`, or `damaged` where the manifest cannot be read.
    state: &'static str,
    in_use: bool,
    /// Numbers in its GeM descriptor.
    dimension: Option<usize>,
    licence: Option<String>,
    description: String,
    folder: Option<PathBuf>,
}

impl Line {
    fn of(name: &str, state: &'static str, manifest: &Manifest, folder: Option<PathBuf>) -> Self {
        Self {
            name: name.to_owned(),
            state,
            in_use: false,
            dimension: manifest.dimension(DescriptorKind::Gem),
            licence: Some(manifest.licence.clone()),
            description: manifest.description.clone(),
            folder,
        }
    }

    fn installed(name: &str, folder: PathBuf) -> Self {
        match Manifest::read(&folder.join(MANIFEST)) {
            Ok(manifest) => Self::of(name, "installed", &manifest, Some(folder)),
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

/// The models that are installed, then those that can be pulled.
pub fn list(place: &Place, json: bool) -> anyhow::Result<()> {
    let installed = place.assets.installed();
    let in_use = place.assets.resolve(&place.config.model.name);
    let available = place.catalogue.entries().iter();
    let available = available.filter(|entry| !installed.contains_key(entry.name()));
    let mut lines: Vec<_> =
        available.map(|entry| Line::of(entry.name(), "available", &entry.manifest, None)).collect();
    let there = installed.into_iter().map(|(name, folder)| Line::installed(&name, folder));
    lines.splice(..0, there);
    for line in &mut lines {
        line.in_use = in_use.as_ref().is_ok_and(|(name, _)| *name == line.name);
    }
    if json {
        let in_use = in_use.ok().map(|(name, why)| json!({"name": name, "why": why.to_string()}));
        println!("{}", json!({"models": lines, "in_use": in_use}));
        return Ok(());
    }
    println!("  {:16} {:9} {:>5}  {:12} description", "name", "state", "dims", "licence");
    for line in lines {
        println!(
            "{} {:16} {:9} {:>5}  {:12} {}",
            if line.in_use { '*' } else { ' ' },
            line.name,
            line.state,
            line.dimension.map_or("?".into(), |dimension| dimension.to_string()),
            line.licence.as_deref().unwrap_or("?"),
            line.description
        );
    }
    say_in_use(place);
    Ok(())
}

/// Which model a server would run, and why.
pub fn say_in_use(place: &Place) {
    let named = &place.config.model.name;
    match place.assets.resolve(named) {
        Ok((name, why)) => println!("in use: {name} ({why})"),
        Err(error) => println!("in use: none; {error}"),
    }
    if let Some((file, chosen)) = place.assets.chosen()
        && named != AUTO
    {
        println!("  model.name = {named:?} goes over the choice of {chosen} in {}", file.display());
    }
}

/// What is known of one model.
pub fn show(place: &Place, name: &str, json: bool) -> anyhow::Result<()> {
    let entry = place.catalogue.find(name);
    let folder = place.assets.model(name).ok();
    let manifest = match (&folder, entry) {
        (Some(folder), _) => Manifest::read(&folder.join(MANIFEST))?,
        (None, Some(entry)) => entry.manifest.clone(),
        (None, None) => {
            bail!("there is no model {name:?}; `whereabouts model list` shows those there are")
        }
    };
    let bytes = match &folder {
        Some(folder) => {
            let size = |file: &Path| Some(folder.join(file).metadata().ok()?.len());
            manifest.files().map(|(file, _)| size(file)).sum()
        }
        None => entry.and_then(|entry| entry.bytes),
    };
    let address = entry.map(|entry| entry.url(&place.config.model.hub, &manifest.file));
    if json {
        let shown = json!({
            "name": name, "installed": folder.is_some(), "folder": folder, "bytes": bytes,
            "address": address, "manifest": manifest,
        });
        println!("{shown}");
        return Ok(());
    }
    let folder = folder.map_or("not installed".into(), |folder| folder.display().to_string());
    let unknown = || "unknown".to_owned();
    let digest = manifest.sha256.map_or("recorded when it is pulled".into(), |d| d.to_string());
    let cls = manifest.dimension(DescriptorKind::Cls);
    println!("{name}: {}", manifest.description);
    println!("  folder   {folder}");
    println!("  size     {}", bytes.map_or_else(unknown, |bytes| DecimalBytes(bytes).to_string()));
    println!("  digest   {digest}");
    println!("  address  {}", address.unwrap_or_else(|| "not in the catalogue".into()));
    println!("  licence  {}", manifest.licence);
    println!("  source   {}", manifest.source);
    println!("  gem      {} numbers", manifest.pooling.dimension);
    println!(
        "  cls      {}",
        cls.map_or("none".into(), |dimension| format!("{dimension} numbers"))
    );
    println!("\n{}", manifest.to_toml()?.trim_end());
    Ok(())
}

/// One model that was hashed again.
#[derive(Serialize)]
struct Check {
    name: String,
    ok: bool,
    folder: PathBuf,
    /// Whether its manifest pins a digest; without one there is nothing to compare with.
    pinned: bool,
    /// The digest, or what is wrong.
    detail: String,
}

impl Check {
    fn of(name: String, folder: PathBuf) -> Self {
        let (ok, pinned, detail) = match whereabouts_models::verify(&folder) {
            Ok(verdict) => {
                let pinned = verdict.manifest.files().all(|(_, pinned)| pinned.is_some());
                (true, pinned, words(&verdict.digests))
            }
            Err(error) => (false, matches!(error, InstallError::Damaged { .. }), error.to_string()),
        };
        Self { name, ok, folder, pinned, detail }
    }
}

/// The digests of a model's files.
pub fn words(digests: &[Digest]) -> String {
    digests.iter().map(Digest::to_string).collect::<Vec<_>>().join(" and ")
}

/// Hashes one model or all again; a bad one is an error.
pub fn verify(place: &Place, name: Option<&str>, json: bool) -> anyhow::Result<()> {
    let models = match name {
        Some(name) => BTreeMap::from([(name.to_owned(), place.assets.model(name)?)]),
        None => place.assets.installed(),
    };
    let checks: Vec<_> = models.into_iter().map(|(name, folder)| Check::of(name, folder)).collect();
    if json {
        println!("{}", json!({ "models": checks }));
    } else {
        checks.iter().for_each(say_check);
    }
    let bad: Vec<_> = checks.iter().filter(|check| !check.ok).collect();
    match bad.first() {
        None => Ok(()),
        Some(first) => Err(remedy(place, first))
            .with_context(|| format!("{} of {} models are bad", bad.len(), checks.len())),
    }
}

fn say_check(check: &Check) {
    match (check.ok, check.pinned) {
        (true, true) => println!("{}: good, {}", check.name, check.detail),
        (true, false) => println!(
            "{}: {}; its manifest pins no sha256, so there is nothing to compare with",
            check.name, check.detail
        ),
        (false, _) => println!("{}: bad: {}", check.name, check.detail),
    }
}

fn remedy(place: &Place, check: &Check) -> anyhow::Error {
    let Check { name, folder, .. } = check;
    let folder = folder.display();
    if place.catalogue.find(name).is_some() {
        anyhow!("`whereabouts model pull {name}` replaces it")
    } else if name == BUILT_IN_MODEL {
        anyhow!("remove {folder} and run `make build`, which installs it again")
    } else {
        anyhow!("remove {folder} and install it again with `whereabouts model add`")
    }
}
