//! Ground truth: the correct references of each query.
//!
//! | source | a reference is correct if |
//! |---|---|
//! | a CSV or JSON file of queries and references | it is listed |
//! | positions (table, file names, EXIF GPS) | it was taken within a distance of the query |
//! | frame order | its index in the folder differs by no more than a number of frames |

mod listed;

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use super::{Folder, FolderPoses, PictureFile, RowAccount};
use whereabouts_core::{CoordinateFrame, ImageId, Pose};

/// Source of the ground truth.
#[derive(Debug, Clone)]
pub enum TruthSource {
    /// A CSV file with the columns `query` and `references`, or a JSON file `{"query": ["reference"]}`.
    Listed(PathBuf),
    /// The order of the files: both folders were recorded along the same route.
    Frames {
        /// Largest difference in frames of a correct reference.
        tolerance: usize,
    },
    /// The positions of both folders.
    Positions {
        /// Table with the positions of the references; `None` to find them in the folder.
        database: Option<PathBuf>,
        /// Table with the positions of the queries; `None` to find them in the folder.
        queries: Option<PathBuf>,
        /// Largest distance of a correct reference, in metres.
        threshold_m: f64,
    },
}

/// The correct references of each query.
#[derive(Debug, Clone, Default)]
pub struct GroundTruth {
    /// One entry for each query, in their order; `None` if it is not known which references are correct.
    pub correct: Vec<Option<HashSet<ImageId>>>,
    /// References of which it is not known for which queries they are correct.
    pub unknown_references: HashSet<ImageId>,
    /// What became of the rows of the tables of positions.
    pub tables: Vec<RowAccount>,
    /// Images with the warnings about their positions.
    pub warnings: Vec<(ImageId, String)>,
}

/// Names of ground-truth files that are found by themselves.
const GROUND_TRUTH_FILES: [&str; 2] = ["ground_truth.csv", "ground_truth.json"];

impl TruthSource {
    /// Finds a `ground_truth.csv` or `.json` in the folder of queries, or next to the two folders.
    pub fn find_listed(database: &Path, queries: &Path) -> Option<Self> {
        let parent = queries.parent().filter(|parent| database.parent() == Some(parent));
        [Some(queries), parent]
            .into_iter()
            .flatten()
            .flat_map(|folder| GROUND_TRUTH_FILES.map(|name| folder.join(name)))
            .find(|file| file.is_file())
            .map(Self::Listed)
    }

    /// Describes when a reference is correct; completes the sentence "a reference is correct if it is …".
    pub fn criterion(&self) -> String {
        match self {
            Self::Listed(file) => format!("listed in {}", file.display()),
            Self::Frames { tolerance } => format!(
                "at most {tolerance} frames apart, in the natural order of the names (2.jpg before 10.jpg)"
            ),
            Self::Positions { threshold_m, .. } => format!("within {threshold_m} m"),
        }
    }

    /// Reads the correct references of each query.
    ///
    /// # Errors
    /// A file cannot be read, or names an image that does not exist; no image of a folder has a position; or
    /// images are missing of which the order is needed.
    pub fn read(&self, database: &Folder, queries: &Folder) -> anyhow::Result<GroundTruth> {
        let certain = |correct: Vec<HashSet<ImageId>>| GroundTruth {
            correct: correct.into_iter().map(Some).collect(),
            ..GroundTruth::default()
        };
        match self {
            Self::Listed(file) => Ok(certain(listed::read(file, database, queries)?)),
            Self::Frames { tolerance } => {
                in_order(database)?;
                in_order(queries)?;
                let count = queries.pictures.len();
                Ok(certain(within_frames(*tolerance, &database.pictures, count)))
            }
            Self::Positions { database: poses, queries: query_poses, threshold_m } => {
                let poses = FolderPoses::read(database, poses.as_deref())?;
                let query_poses = FolderPoses::read(queries, query_poses.as_deref())?;
                within_distance((database, poses), (queries, query_poses), *threshold_m)
            }
        }
    }
}

/// Refuses a folder in which a picture is missing, which would shift all after it.
fn in_order(folder: &Folder) -> anyhow::Result<()> {
    let Some(first) = folder.skipped.iter().find(|skipped| skipped.is_lost) else { return Ok(()) };
    bail!(
        "the order of the frames in {} is not certain, because {} files cannot be taken, starting with {} ({}); \
         repair or remove them in both folders",
        folder.dir.display(),
        folder.lost(),
        first.file,
        first.why
    );
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

/// The position of each image in a folder.
fn positions(
    folder: &Folder,
    poses: &FolderPoses,
    truth: &mut GroundTruth,
) -> anyhow::Result<Vec<Option<Pose>>> {
    let found = poses.find_all(folder)?;
    truth.tables.extend(poses.account().cloned());
    let mut positions = Vec::with_capacity(found.len());
    for (picture, found) in folder.pictures.iter().zip(found) {
        let warnings = found.warnings.into_iter().map(|text| (picture.id.clone(), text));
        truth.warnings.extend(warnings);
        positions.push(found.pose);
    }
    if positions.iter().all(Option::is_none) {
        let why = match truth.warnings.last() {
            Some((id, why)) => format!(" (of {id}: {why})"),
            None => String::new(),
        };
        bail!(
            "{count} of {count} images in {} have no position, starting with {}{why}. Give positions in a table \
             (--database-poses, --queries-poses: file, and lat,lon or x,y), in file names @easting@northing@…, \
             or as EXIF GPS; or give the correct references with --ground-truth FILE or --frame-tolerance N",
            folder.dir.display(),
            folder.pictures.first().map_or("", |picture| picture.id.as_str()),
            count = positions.len(),
        );
    }
    Ok(positions)
}

fn within_distance(
    (database, mut poses): (&Folder, FolderPoses),
    (queries, mut query_poses): (&Folder, FolderPoses),
    threshold_m: f64,
) -> anyhow::Result<GroundTruth> {
    // Metres of different zones, and metres and degrees, compare on the globe.
    let is_one_frame = poses.frame() == query_poses.frame();
    let spans_zones = poses
        .zone()
        .zip(query_poses.zone())
        .is_some_and(|(of_database, of_queries)| of_database != of_queries);
    if !is_one_frame || spans_zones {
        for poses in [&mut poses, &mut query_poses] {
            poses.convert_to(CoordinateFrame::Wgs84).context(
                "the positions of the references and of the queries are in different coordinate frames; give \
                 both in the same one",
            )?;
        }
    }
    let mut truth = GroundTruth::default();
    let references = positions(database, &poses, &mut truth)?;
    let positions = positions(queries, &query_poses, &mut truth)?;
    let is_near = |query: &Pose, reference: &Pose| {
        query.distance_m(reference).is_some_and(|metres| metres <= threshold_m)
    };
    let posed: Vec<(&Pose, &PictureFile)> = references
        .iter()
        .zip(&database.pictures)
        .filter_map(|(pose, picture)| Some((pose.as_ref()?, picture)))
        .collect();
    let correct = |query: &Pose| {
        let correct = posed.iter().filter(|(pose, _)| is_near(query, pose));
        correct.map(|(_, picture)| picture.id.clone()).collect()
    };
    truth.correct = positions.iter().map(|query| query.as_ref().map(correct)).collect();
    let unposed = database.pictures.iter().zip(&references).filter(|(_, pose)| pose.is_none());
    truth.unknown_references = unposed.map(|(picture, _)| picture.id.clone()).collect();
    Ok(truth)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(names: &[&str]) -> Folder {
        let of = |name: &&str| PictureFile { file: name.into(), id: name.parse().unwrap() };
        let pictures = names.iter().map(of).collect();
        Folder { dir: "/nowhere".into(), pictures, skipped: Vec::new() }
    }

    fn read(source: &TruthSource, database: &[&str], queries: &[&str]) -> Vec<Vec<String>> {
        let truth = source.read(&folder(database), &folder(queries)).unwrap();
        truth
            .correct
            .into_iter()
            .map(|ids| {
                let mut ids: Vec<String> = ids.unwrap().into_iter().map(String::from).collect();
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
    fn a_file_lists_the_correct_references() {
        let dir = tempfile::TempDir::new().unwrap();
        for (name, text) in [
            ("truth.csv", "query,references\nq.jpg,a.jpg  b c.jpg\n"),
            ("truth.csv", "\u{feff}Query;References\n# by hand\nq.jpg;a.jpg \"b c.jpg\"\n"),
            ("truth.csv", "query,references\nq.jpg,\"[\"\"a.jpg\"\", \"\"b c.jpg\"\"]\"\n"),
            ("truth.csv", "query,reference\nq.jpg,a.jpg\nq.jpg,b c.jpg\n"),
            ("truth.csv", "query,references\n./q.jpg,\"\"\"b c.jpg\"\" a.jpg\"\n"),
            ("truth.csv", "query,references\nq,a b c.jpg\n".replace("a b", "a.jpg b").as_str()),
            ("truth.json", r#"{"q.jpg": ["a.jpg", "b c.jpg"]}"#),
            ("truth.json", r#"[{"query": "q.jpg", "references": ["a.jpg", "b c.jpg"]}]"#),
        ] {
            let file = dir.path().join(name);
            std::fs::write(&file, text).unwrap();
            let truth =
                read(&TruthSource::Listed(file), &["a.jpg", "b c.jpg"], &["p.jpg", "q.jpg"]);
            assert_eq!(truth, [vec![], vec!["a.jpg", "b c.jpg"]], "{text}");
        }
        let file = dir.path().join("truth.csv");
        std::fs::write(&file, "query,references\nq.jpg,c.jpg\n").unwrap();
        let source = TruthSource::Listed(file);
        let error = source.read(&folder(&["a.jpg"]), &folder(&["q.jpg"])).unwrap_err().to_string();
        assert!(error.contains("line 2") && error.contains("c.jpg"), "{error}");
    }

    #[test]
    fn images_without_positions_are_counted_and_the_error_names_the_alternatives() {
        let dir = tempfile::TempDir::new().unwrap();
        std::fs::write(dir.path().join("a.jpg"), "no picture").unwrap();
        let source = TruthSource::Positions { database: None, queries: None, threshold_m: 25.0 };
        let folder = Folder::read(dir.path()).unwrap();
        let error = source.read(&folder, &folder).unwrap_err().to_string();
        assert!(error.contains("1 of 1") && error.contains("--ground-truth"), "{error}");
    }

    #[test]
    fn an_image_without_a_position_does_not_cost_the_others_theirs() {
        let dir = tempfile::TempDir::new().unwrap();
        for name in ["@1.0@2.0@.jpg", "overview.jpg"] {
            std::fs::write(dir.path().join(name), "no picture").unwrap();
        }
        let source = TruthSource::Positions { database: None, queries: None, threshold_m: 25.0 };
        let folder = Folder::read(dir.path()).unwrap();
        let truth = source.read(&folder, &folder).unwrap();
        assert_eq!(truth.correct.iter().map(Option::is_some).collect::<Vec<_>>(), [true, false]);
        assert_eq!(truth.unknown_references, ["overview.jpg".parse().unwrap()].into());
    }

    #[test]
    fn queries_of_another_zone_or_in_degrees_are_compared_on_the_globe() {
        let source = TruthSource::Positions { database: None, queries: None, threshold_m: 25.0 };
        // 0° 0′ 0″ of the zones 31 and 32 are the same numbers, 667 km apart.
        let here = ["@500000.0@4000000.0@31@S@.jpg"];
        assert_eq!(
            read(&source, &here, &["@500000.0@4000000.0@32@S@.jpg"]),
            [Vec::<String>::new()]
        );
        assert_eq!(read(&source, &here, &["@500010.0@4000000.0@31@S@.jpg"]), [here.to_vec()]);
        assert_eq!(read(&source, &here, &["@@@31@S@36.14472@3.0@.jpg"]), [here.to_vec()]);
    }

    #[test]
    fn a_missing_frame_would_shift_the_order_and_is_an_error() {
        let mut folder = folder(&["1.jpg", "3.jpg"]);
        let source = TruthSource::Frames { tolerance: 0 };
        assert!(source.read(&folder, &folder).is_ok());
        let skipped =
            |is_lost| crate::SkippedFile { file: "2.jpg".into(), why: "cut".into(), is_lost };
        folder.skipped.push(skipped(false));
        assert!(source.read(&folder, &folder).is_ok());
        folder.skipped.push(skipped(true));
        let error = source.read(&folder, &folder).unwrap_err().to_string();
        assert!(error.contains("1 files") && error.contains("2.jpg"), "{error}");
    }
}
