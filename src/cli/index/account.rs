//! The account of a folder: every picture ends in one entry, every row of poses in one count.

use serde::Serialize;

use anyhow::bail;
use whereabouts_core::{ImageField, ImageId, MapName};
use whereabouts_eval::account::{bounded, skipped_lines, warning_lines};
use whereabouts_eval::{PoseSource, RowAccount, SkippedFile, UNUSED_DESCRIPTION};

/// Most names in one line, and lines of one kind, for people; JSON has all of them.
const MOST: usize = 20;

/// What became of a folder.
#[derive(Debug, Serialize)]
pub struct IndexReport {
    pub map: MapName,
    /// Images in the folder.
    pub images: usize,
    pub added: usize,
    /// Images that the map had, as they are.
    pub present: usize,
    /// Images that the map had, and whose pose, time or tags have changed.
    pub changed: usize,
    /// Images that have no pose in the map.
    pub without_pose: usize,
    pub failed: Vec<FailedImage>,
    /// Files that are not images of the map, and why.
    pub skipped: Vec<SkippedFile>,
    /// What became of the rows of the table of poses.
    pub rows: Option<RowAccount>,
    /// One entry for each picture of the folder, in its order, and each skipped file.
    pub account: Vec<Entry>,
    /// Duration of the upload.
    pub seconds: f64,
    pub images_per_second: f64,
}

/// An image that could not be added.
#[derive(Debug, Serialize)]
pub struct FailedImage {
    pub file: std::path::PathBuf,
    pub error: String,
}

/// What became of one file.
#[derive(Debug, Serialize)]
pub struct Entry {
    /// The id of the image, or the path of a skipped file.
    pub file: String,
    pub outcome: Outcome,
    /// Where its pose comes from; null if it has none.
    pub pose: Option<PoseOrigin>,
    /// The fields that have changed.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub changed: Vec<ImageField>,
    /// Why it was skipped or failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// What was not taken of it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

/// Where the pose of an image in the map comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseOrigin {
    Table,
    Sidecar,
    Name,
    Exif,
    /// The folder has no pose, and the map keeps the one that it has.
    Map,
}

impl PoseOrigin {
    /// The origin of a pose that the folder has or not, and the map has or not.
    pub fn new(in_folder: Option<PoseSource>, is_in_map: bool) -> Option<Self> {
        match in_folder {
            Some(PoseSource::Table) => Some(Self::Table),
            Some(PoseSource::Sidecar) => Some(Self::Sidecar),
            Some(PoseSource::Name) => Some(Self::Name),
            Some(PoseSource::Exif) => Some(Self::Exif),
            None => is_in_map.then_some(Self::Map),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    Added,
    Present,
    Changed,
    Skipped,
    Failed,
}

impl IndexReport {
    /// Counts the entries of the images, and adds those of the skipped files.
    pub fn new(
        map: MapName,
        mut account: Vec<Entry>,
        failed: Vec<FailedImage>,
        skipped: Vec<SkippedFile>,
        rows: Option<RowAccount>,
        seconds: f64,
    ) -> Self {
        let count = |outcome| account.iter().filter(|entry| entry.outcome == outcome).count();
        let stored = |entry: &&Entry| entry.outcome != Outcome::Failed;
        let (added, present, changed) =
            (count(Outcome::Added), count(Outcome::Present), count(Outcome::Changed));
        let images = account.len();
        let without_pose =
            account.iter().filter(stored).filter(|entry| entry.pose.is_none()).count();
        account.extend(skipped.iter().map(|skipped| Entry {
            file: skipped.file.clone(),
            outcome: Outcome::Skipped,
            pose: None,
            changed: Vec::new(),
            why: Some(skipped.why.clone()),
            warnings: Vec::new(),
        }));
        Self {
            map,
            images,
            added,
            present,
            changed,
            without_pose,
            failed,
            skipped,
            rows,
            account,
            seconds,
            images_per_second: images as f64 / seconds.max(1e-9),
        }
    }

    /// Prints the report. Pictures that were lost are an error.
    pub fn print(&self, json: bool) -> anyhow::Result<()> {
        if json {
            println!("{}", serde_json::to_string(self)?);
        } else {
            self.lines().iter().for_each(|line| println!("{line}"));
        }
        let lost = self.skipped.iter().filter(|skipped| skipped.is_lost).count();
        if lost > 0 || !self.failed.is_empty() {
            bail!(
                "{} of {} images were not added; repair or remove them, then run the same command again",
                self.failed.len() + lost,
                self.images + lost
            );
        }
        let is_unused = |warning: &String| warning.starts_with(UNUSED_DESCRIPTION);
        let undescribed =
            self.account.iter().filter(|entry| entry.warnings.iter().any(is_unused)).count();
        if undescribed > 0 {
            bail!(
                "the descriptions next to {undescribed} of {} images were not used; repair or remove them, then run \
                 the same command again",
                self.images
            );
        }
        Ok(())
    }

    fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!(
            "{}: {} added, {} already present, {} changed, {} failed, {} skipped, {} without a pose; {:.1} s, \
             {:.1} images/s",
            self.map,
            self.added,
            self.present,
            self.changed,
            self.failed.len(),
            self.skipped.len(),
            self.without_pose,
            self.seconds,
            self.images_per_second
        )];
        lines.extend(
            self.failed
                .iter()
                .take(MOST)
                .map(|failed| format!("failed {}: {}", failed.file.display(), failed.error)),
        );
        if self.failed.len() > MOST {
            lines.push(format!("failed {} more", self.failed.len() - MOST));
        }
        lines.extend(skipped_lines(&self.skipped, MOST));
        let images: Vec<&Entry> =
            self.account.iter().filter(|entry| entry.outcome != Outcome::Skipped).collect();
        let changed: Vec<&&Entry> =
            images.iter().filter(|entry| !entry.changed.is_empty()).collect();
        if !changed.is_empty() {
            let of = |entry: &&&Entry| {
                let fields: Vec<&str> = entry.changed.iter().map(|field| field.as_str()).collect();
                format!("{} ({})", entry.file, fields.join(", "))
            };
            lines.push(format!("changed ({}): {}", changed.len(), bounded(&changed, MOST, of)));
        }
        let is_unposed = |entry: &&&Entry| entry.outcome != Outcome::Failed && entry.pose.is_none();
        let unposed: Vec<&&Entry> = images.iter().filter(is_unposed).collect();
        if !unposed.is_empty() {
            let names = bounded(&unposed, MOST, |entry| entry.file.clone());
            lines.push(format!("no pose ({}): {names}", unposed.len()));
        }
        let is_kept = |entry: &&&Entry| entry.pose == Some(PoseOrigin::Map);
        let kept: Vec<&&Entry> = images.iter().filter(is_kept).collect();
        if !kept.is_empty() {
            let names = bounded(&kept, MOST, |entry| entry.file.clone());
            let count = kept.len();
            lines.push(format!("no pose in the folder, the map keeps its own ({count}): {names}"));
        }
        lines.extend(self.rows.iter().flat_map(|rows| rows.lines(MOST)));
        let warnings: Vec<(ImageId, String)> = images
            .iter()
            .flat_map(|entry| entry.warnings.iter().map(|text| (entry.file.parse(), text.clone())))
            .filter_map(|(id, text)| Some((id.ok()?, text)))
            .collect();
        lines.extend(warning_lines(&warnings, MOST));
        lines
    }
}
