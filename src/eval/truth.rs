//! Ground truth: the correct references of each query.
//!
//! | source | a reference is correct if |
//! |---|---|
//! | a CSV file `query,references` | it is listed |
//! | positions (CSV, file names, EXIF GPS) | it was taken within a distance of the query |
//! | frame order | its index in the folder differs by no more than a number of frames |

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::Deserialize;

use super::{PictureFile, PoseSource};
use whereabouts_core::{ImageId, Pose};

/// Source of the ground truth.
#[derive(Debug, Clone)]
pub enum TruthSource {
    /// A CSV file with the columns `query` and `references`, the references separated by spaces.
    Csv(PathBuf),
    /// The order of the files: both folders were recorded along the same route.
    Frames {
        /// Largest difference in frames of a correct reference.
        tolerance: usize,
    },
    /// The positions of both folders.
    Positions {
        /// CSV file with the positions of the references; `None` to find them in the folder.
        database: Option<PathBuf>,
        /// CSV file with the positions of the queries; `None` to find them in the folder.
        queries: Option<PathBuf>,
        /// Largest distance of a correct reference, in metres.
        threshold_m: f64,
    },
}

/// Name of a ground-truth file that is found by itself.
const GROUND_TRUTH_FILE: &str = "ground_truth.csv";

impl TruthSource {
    /// Finds a `ground_truth.csv` in the folder of queries, or next to the two folders.
    pub fn find_csv(database: &Path, queries: &Path) -> Option<Self> {
        let parent = queries.parent().filter(|parent| database.parent() == Some(parent));
        [Some(queries), parent]
            .into_iter()
            .flatten()
            .map(|folder| folder.join(GROUND_TRUTH_FILE))
            .find(|file| file.is_file())
            .map(Self::Csv)
    }

    /// Describes when a reference is correct; completes the sentence "a reference is correct if it is …".
    pub fn criterion(&self) -> String {
        match self {
            Self::Csv(file) => format!("listed in {}", file.display()),
            Self::Frames { tolerance } => format!("at most {tolerance} frames apart"),
            Self::Positions { threshold_m, .. } => format!("within {threshold_m} m"),
        }
    }

    /// Reads the correct references of each query, in the order of the queries.
    ///
    /// # Errors
    /// A file cannot be read, names an image that does not exist, or an image has no position.
    pub fn read(
        &self,
        database: (&Path, &[PictureFile]),
        queries: (&Path, &[PictureFile]),
    ) -> anyhow::Result<Vec<HashSet<ImageId>>> {
        match self {
            Self::Csv(file) => from_csv(file, database.1, queries.1),
            Self::Frames { tolerance } => {
                Ok(within_frames(*tolerance, database.1, queries.1.len()))
            }
            Self::Positions { database: poses, queries: query_poses, threshold_m } => {
                let poses = positions(database, poses.as_deref())?;
                let query_poses = positions(queries, query_poses.as_deref())?;
                within_distance(&poses, &query_poses, *threshold_m, database.1)
            }
        }
    }
}

#[derive(Debug, Deserialize)]
struct Row {
    query: String,
    references: String,
}

fn from_csv(
    file: &Path,
    database: &[PictureFile],
    queries: &[PictureFile],
) -> anyhow::Result<Vec<HashSet<ImageId>>> {
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_path(file)
        .with_context(|| format!("cannot read {}", file.display()))?;
    let references: HashSet<&str> = database.iter().map(|picture| picture.id.as_str()).collect();
    let query_ids: HashSet<&str> = queries.iter().map(|picture| picture.id.as_str()).collect();
    let mut rows: HashMap<String, HashSet<ImageId>> = HashMap::new();
    for (index, row) in reader.deserialize::<Row>().enumerate() {
        let line = || format!("{} line {}", file.display(), index + 2);
        let row = row.with_context(line)?;
        if !query_ids.contains(row.query.as_str()) {
            bail!("{}: the folder of queries has no image {:?}", line(), row.query);
        }
        let truth = rows.entry(row.query).or_default();
        for name in row.references.split_whitespace() {
            if !references.contains(name) {
                bail!("{}: the folder of references has no image {name:?}", line());
            }
            truth.insert(name.parse()?);
        }
    }
    Ok(queries.iter().map(|query| rows.remove(query.id.as_str()).unwrap_or_default()).collect())
}

fn within_frames(
    tolerance: usize,
    database: &[PictureFile],
    queries: usize,
) -> Vec<HashSet<ImageId>> {
    (0..queries)
        .map(|index| {
            let end = index.saturating_add(tolerance).saturating_add(1).min(database.len());
            let start = index.saturating_sub(tolerance).min(end);
            database[start..end].iter().map(|picture| picture.id.clone()).collect()
        })
        .collect()
}

/// Reads the position of every image in a folder.
fn positions(
    (dir, pictures): (&Path, &[PictureFile]),
    csv: Option<&Path>,
) -> anyhow::Result<Vec<Pose>> {
    let source = PoseSource::find(dir, csv, pictures)?;
    let mut poses = Vec::with_capacity(pictures.len());
    let mut missing = Vec::new();
    for picture in pictures {
        let bytes = match source {
            PoseSource::Exif => std::fs::read(&picture.file)
                .with_context(|| format!("cannot read {}", picture.file.display()))?,
            _ => Vec::new(),
        };
        match source.pose(picture.id.as_str(), &bytes)? {
            Some(pose) => poses.push(pose),
            None => missing.push(picture.id.as_str()),
        }
    }
    if let Some(first) = missing.first() {
        bail!(
            "{} of {} images in {} have no position in {}, starting with {first}. Give positions in a CSV \
             file (--database-poses, --queries-poses: file, and lat,lon or x,y), in file names \
             @easting@northing@…, or as EXIF GPS; or give the correct references with --ground-truth FILE or \
             --frame-tolerance N",
            missing.len(),
            pictures.len(),
            dir.display(),
            source.name()
        );
    }
    Ok(poses)
}

fn within_distance(
    database: &[Pose],
    queries: &[Pose],
    threshold_m: f64,
    pictures: &[PictureFile],
) -> anyhow::Result<Vec<HashSet<ImageId>>> {
    if database.first().map(Pose::frame) != queries.first().map(Pose::frame) {
        bail!(
            "the references have {} positions and the queries have {}; give both in the same coordinate frame",
            database.first().map_or("no", |pose| pose.frame().as_str()),
            queries.first().map_or("no", |pose| pose.frame().as_str())
        );
    }
    let is_near = |query: &Pose, reference: &Pose| {
        query.distance_m(reference).is_some_and(|metres| metres <= threshold_m)
    };
    Ok(queries
        .iter()
        .map(|query| {
            let correct = database.iter().zip(pictures).filter(|(pose, _)| is_near(query, pose));
            correct.map(|(_, picture)| picture.id.clone()).collect()
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
    fn references_within_the_distance_are_correct() {
        let source = TruthSource::Positions { database: None, queries: None, threshold_m: 25.0 };
        let truth = read(
            &source,
            &["@100.0@200.0@.jpg", "@100.0@224.0@a@.jpg", "@100.0@226.0@.jpg"],
            &["@100.0@200.0@q@.jpg", "@900.0@200.0@.jpg"],
        );
        assert_eq!(truth, [vec!["@100.0@200.0@.jpg", "@100.0@224.0@a@.jpg"], vec![]]);
    }

    #[test]
    fn references_within_the_frame_tolerance_are_correct() {
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
    fn a_csv_lists_the_correct_references() {
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
    fn images_without_positions_are_counted_and_the_error_names_the_alternatives() {
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
