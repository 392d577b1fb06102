//! Sets to measure on: a rendered town, and folders with a `ground_truth.csv`.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use rayon::prelude::*;
use whereabouts_town::{Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;

/// A set of references and queries.
pub struct TestSet {
    pub name: String,
    pub database: PathBuf,
    pub queries: PathBuf,
    pub truth: PathBuf,
    /// All pictures; places name them by their index.
    pub pictures: Vec<PathBuf>,
    /// The pictures that show one place, for each query.
    pub places: Vec<Vec<usize>>,
}

impl TestSet {
    /// Renders a town of that many places into a folder: a map image and a frame of each.
    pub fn town(places: usize, seed: u64, folder: &Path) -> anyhow::Result<Self> {
        let (database, queries) = (folder.join("database"), folder.join("queries"));
        std::fs::create_dir_all(&database)?;
        std::fs::create_dir_all(&queries)?;
        let town = Town::new(TownSpec { places, seed, ..TownSpec::default() });
        let rows = (0..places).into_par_iter().map(|place| -> anyhow::Result<(String, String)> {
            let reference = town.reference(place);
            let (image, frame) = (format!("place-{place:04}.jpg"), format!("frame-{place:04}.jpg"));
            std::fs::write(database.join(&image), encode_jpeg(&reference.image)?)?;
            std::fs::write(queries.join(&frame), encode_jpeg(&town.query(place, 0).image)?)?;
            let pose = format!("{image},{:.2},{:.2}\n", reference.x, reference.y);
            Ok((format!("{frame},{image}\n"), pose))
        });
        let rows = rows.collect::<anyhow::Result<Vec<_>>>()?;
        let (truth, poses): (String, String) = rows.into_iter().unzip();
        std::fs::write(database.join("poses.csv"), format!("file,x,y\n{poses}"))?;
        std::fs::write(folder.join("ground_truth.csv"), format!("query,references\n{truth}"))?;
        let name = format!("town, {places} places, seed {seed}");
        Self::read(name, database, queries, folder.join("ground_truth.csv"))
    }

    /// Reads a folder with `ground_truth.csv` and two folders of these names.
    pub fn folder(folder: &Path, database: &str, queries: &str) -> anyhow::Result<Self> {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let truth = folder.join("ground_truth.csv");
        Self::read(name, folder.join(database), folder.join(queries), truth)
    }

    fn read(
        name: String,
        database: PathBuf,
        queries: PathBuf,
        truth: PathBuf,
    ) -> anyhow::Result<Self> {
        let (mut pictures, mut numbers) = (Vec::new(), HashMap::new());
        for folder in [&database, &queries] {
            let entries =
                std::fs::read_dir(folder).with_context(|| folder.display().to_string())?;
            let mut files = entries
                .map(|entry| Ok(entry?.path()))
                .collect::<std::io::Result<Vec<PathBuf>>>()?;
            files.retain(|file| file.extension().is_some_and(|end| end == "jpg" || end == "png"));
            files.sort();
            for file in files {
                numbers.insert((folder, file.file_name().map(ToOwned::to_owned)), pictures.len());
                pictures.push(file);
            }
        }
        let text = std::fs::read_to_string(&truth)?;
        let number = |folder, name: &str| numbers.get(&(folder, Some(name.into()))).copied();
        let places = text.lines().skip(1).filter_map(|line| {
            let (query, references) = line.split_once(',')?;
            let shown = references.split_whitespace().filter_map(|name| number(&database, name));
            Some(number(&queries, query).into_iter().chain(shown).collect())
        });
        let places = places.collect();
        Ok(Self { name, database, queries, truth, pictures, places })
    }
}
