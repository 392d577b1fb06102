//! Ground truth: which references show the place of which query.
//!
//! | source | a reference is true if |
//! |---|---|
//! | a CSV `query,references` | it is named |
//! | positions (CSV, file names, EXIF GPS) | it was taken within so many metres of the query |
//! | frame order | its place in the folder differs by no more than so many frames |

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::Deserialize;

use super::{PictureFile, PoseSource};
use whereabouts_core::{ImageId, Pose};

/// Where the ground truth comes from.
#[derive(Debug, Clone)]
pub enum TruthSource {
    /// A CSV with the columns `query` and `references`, the latter separated by spaces.
    Csv(PathBuf),
    /// Both folders are in the order in which the same way was driven.
    Frames {
        /// By how many frames a true reference may be off.
        tolerance: usize,
    },
    /// The positions of both folders.
    Positions {
        /// Positions of the references; found in the folder if `None`.
        database: Option<PathBuf>,
        /// Positions of the queries; found in the folder if `None`.
        queries: Option<PathBuf>,
        /// The largest distance of a true reference, in metres.
        threshold_m: f64,
    },
}

/// The name of a ground-truth file that is found without being named.
const BESIDE: &str = "ground_truth.csv";

impl TruthSource {
    /// A `ground_truth.csv` in the folder of the queries, or beside the two folders.
    pub fn beside(database: &Path, queries: &Path) -> Option<Self> {
        let parent = queries.parent().filter(|parent| database.parent() == Some(parent));
        [Some(queries), parent]
            .into_iter()
            .flatten()
            .map(|folder| folder.join(BESIDE))
            .find(|file| file.is_file())
            .map(Self::Csv)
    }

    /// Says in a few words what makes a reference true.
    pub fn said(&self) -> String {
        match self {
            Self::Csv(file) => format!("named in {}", file.display()),
            Self::Frames { tolerance } => format!("at most {tolerance} frames apart"),
            Self::Positions { threshold_m, .. } => format!("within {threshold_m} m"),
        }
    }

    /// The true references of each query, in the order of the queries.
    pub fn read(
        &self,
        database: (&Path, &[PictureFile]),
        queries: (&Path, &[PictureFile]),
    ) -> anyhow::Result<Vec<HashSet<ImageId>>> {
        match self {
            Self::Csv(file) => named(file, database.1, queries.1),
            Self::Frames { tolerance } => Ok(in_order(*tolerance, database.1, queries.1.len())),
            Self::Positions { database: poses, queries: query_poses, threshold_m } => {
                let there = positions(database, poses.as_deref())?;
                let here = positions(queries, query_poses.as_deref())?;
                near(&there, &here, *threshold_m, database.1)
            }
        }
    }
}

#[derive(Debug, Deserialize)]
struct Row {
    query: String,
    references: String,
}

fn named(
    file: &Path,
    database: &[PictureFile],
    queries: &[PictureFile],
) -> anyhow::Result<Vec<HashSet<ImageId>>> {
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_path(file)
        .with_context(|| format!("cannot read {}", file.display()))?;
    let references: HashSet<&str> = database.iter().map(|picture| picture.id.as_str()).collect();
    let known: HashSet<&str> = queries.iter().map(|picture| picture.id.as_str()).collect();
    let mut rows: HashMap<String, HashSet<ImageId>> = HashMap::new();
    for (index, row) in reader.deserialize::<Row>().enumerate() {
        let at = || format!("{} line {}", file.display(), index + 2);
        let row = row.with_context(at)?;
        if !known.contains(row.query.as_str()) {
            bail!("{}: there is no query {:?} in the folder of the queries", at(), row.query);
        }
        let truth = rows.entry(row.query).or_default();
        for name in row.references.split_whitespace() {
            if !references.contains(name) {
                bail!("{}: there is no reference {name:?} in the database folder", at());
            }
            truth.insert(name.parse()?);
        }
    }
    Ok(queries.iter().map(|query| rows.remove(query.id.as_str()).unwrap_or_default()).collect())
}

fn in_order(tolerance: usize, database: &[PictureFile], queries: usize) -> Vec<HashSet<ImageId>> {
    (0..queries)
        .map(|place| {
            let end = place.saturating_add(tolerance).saturating_add(1).min(database.len());
            let start = place.saturating_sub(tolerance).min(end);
            database[start..end].iter().map(|picture| picture.id.clone()).collect()
        })
        .collect()
}

/// The position of every picture of a folder.
fn positions(
    (dir, pictures): (&Path, &[PictureFile]),
    csv: Option<&Path>,
) -> anyhow::Result<Vec<Pose>> {
    let source = PoseSource::find(dir, csv, pictures)?;
    let mut poses = Vec::with_capacity(pictures.len());
    let mut without = Vec::new();
    for picture in pictures {
        let bytes = match source {
            PoseSource::Exif => std::fs::read(&picture.file)
                .with_context(|| format!("cannot read {}", picture.file.display()))?,
            _ => Vec::new(),
        };
        match source.pose(picture.id.as_str(), &bytes)? {
            Some(pose) => poses.push(pose),
            None => without.push(picture.id.as_str()),
        }
    }
    if let Some(first) = without.first() {
        bail!(
            "{} of {} pictures in {} have no position in {}, the first is {first}; give positions \
             in a CSV (--database-poses, --queries-poses: file, and lat,lon or x,y), by \
             @easting@northing@ names or by EXIF GPS, or give the true references with \
             --ground-truth FILE or --frame-tolerance N",
            without.len(),
            pictures.len(),
            dir.display(),
            source.said()
        );
    }
    Ok(poses)
}

fn near(
    database: &[Pose],
    queries: &[Pose],
    threshold_m: f64,
    pictures: &[PictureFile],
) -> anyhow::Result<Vec<HashSet<ImageId>>> {
    if database.first().map(Pose::frame) != queries.first().map(Pose::frame) {
        bail!(
            "the database has {} positions and the queries {}; give both in the same frame",
            database.first().map_or("no", |pose| pose.frame().as_str()),
            queries.first().map_or("no", |pose| pose.frame().as_str())
        );
    }
    let within = |query: &Pose, reference: &Pose| {
        query.distance_m(reference).is_some_and(|metres| metres <= threshold_m)
    };
    Ok(queries
        .iter()
        .map(|query| {
            let true_ones = database.iter().zip(pictures).filter(|(pose, _)| within(query, pose));
            true_ones.map(|(_, picture)| picture.id.clone()).collect()
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pictures(names: &[&str]) -> Vec<PictureFile> {
        let of = |name: &&str| PictureFile { file: name.into(), id: name.parse().unwrap() };
        names.iter().map(of).collect()
    }

    fn read(source: &TruthSource, database: &[&str], queries: &[&str]) -> Vec<Vec<String>> {
        let (database, queries) = (pictures(database), pictures(queries));
        let nowhere = Path::new("/nowhere");
        let truth = source.read((nowhere, &database), (nowhere, &queries)).unwrap();
        truth
            .into_iter()
            .map(|ids| {
                let mut ids: Vec<String> = ids.into_iter().map(String::from).collect();
                ids.sort();
                ids
            })
            .collect()
    }

    #[test]
    fn names_of_the_field_are_compared_by_distance() {
        let source = TruthSource::Positions { database: None, queries: None, threshold_m: 25.0 };
        let truth = read(
            &source,
            &["@100.0@200.0@.jpg", "@100.0@224.0@a@.jpg", "@100.0@226.0@.jpg"],
            &["@100.0@200.0@q@.jpg", "@900.0@200.0@.jpg"],
        );
        assert_eq!(truth, [vec!["@100.0@200.0@.jpg", "@100.0@224.0@a@.jpg"], vec![]]);
    }

    #[test]
    fn frame_order_has_a_tolerance() {
        let truth = read(
            &TruthSource::Frames { tolerance: 1 },
            &["0.jpg", "1.jpg", "2.jpg"],
            &["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg"],
        );
        let expected: [&[&str]; 5] = [
            &["0.jpg", "1.jpg"],
            &["0.jpg", "1.jpg", "2.jpg"],
            &["1.jpg", "2.jpg"],
            &["2.jpg"],
            &[],
        ];
        assert_eq!(truth, expected);
    }

    #[test]
    fn a_csv_names_the_true_references() {
        let dir = tempfile::TempDir::new().unwrap();
        let file = dir.path().join("truth.csv");
        std::fs::write(&file, "query,references\nq.jpg,a.jpg  b.jpg\n").unwrap();
        let source = TruthSource::Csv(file.clone());
        let truth = read(&source, &["a.jpg", "b.jpg"], &["p.jpg", "q.jpg"]);
        assert_eq!(truth, [vec![], vec!["a.jpg", "b.jpg"]]);
        std::fs::write(&file, "query,references\nq.jpg,c.jpg\n").unwrap();
        let nowhere = Path::new("/nowhere");
        let (database, queries) = (pictures(&["a.jpg"]), pictures(&["q.jpg"]));
        let error = source.read((nowhere, &database), (nowhere, &queries)).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("c.jpg"), "{error}");
    }

    #[test]
    fn pictures_without_positions_are_counted_and_the_ways_out_are_named() {
        let dir = tempfile::TempDir::new().unwrap();
        std::fs::write(dir.path().join("a.jpg"), "no picture").unwrap();
        let database =
            vec![PictureFile { file: dir.path().join("a.jpg"), id: "a.jpg".parse().unwrap() }];
        let source = TruthSource::Positions { database: None, queries: None, threshold_m: 25.0 };
        let folder = (dir.path(), database.as_slice());
        let error = source.read(folder, folder).unwrap_err().to_string();
        assert!(error.contains("1 of 1") && error.contains("--ground-truth"), "{error}");
    }
}
