//! Finds the pose of each image in a folder: in a table, in a file next to it, in its name, or in its EXIF data.
//! Each image has its own source, so that one odd file does not cost the others their poses.

mod account;
mod matching;
mod names;
mod place;
mod rows;
pub(crate) mod sidecar;
#[cfg(test)]
mod tests;

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use anyhow::{Context, bail};
use jiff::Timestamp;
use serde::Serialize;

pub use self::account::{LooseRow, RowAccount, UnmatchedRow};
pub use self::matching::MatchKind;
use self::place::{Grid, Place};
use self::rows::PoseRows;
pub use self::sidecar::UNUSED_DESCRIPTION;
use super::Folder;
use whereabouts_core::{CoordinateFrame, ImageId, Pose, UtmZone};
use whereabouts_vision::exif;

/// Name of a table of poses that is found by itself.
pub(crate) const POSES_FILE: &str = "poses.csv";

/// Where the pose of an image comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PoseSource {
    /// A row of a table.
    Table,
    /// The file `NAME.json` next to the image `NAME`.
    Sidecar,
    /// The name of the file, of the form `@easting@northing@…`.
    Name,
    /// EXIF GPS or XMP.
    Exif,
}

/// The poses of the images in a folder.
#[derive(Debug)]
pub struct FolderPoses {
    known: HashMap<ImageId, KnownImage>,
    /// Coordinates of all poses; `None` if only EXIF can have any.
    grid: Option<Grid>,
    /// Whether the metres have an origin that only the table or the sidecars know.
    is_local: bool,
    account: Option<RowAccount>,
}

/// What is known about an image before its bytes are read.
#[derive(Debug, Default)]
struct KnownImage {
    /// The place of the first source that has one.
    place: Option<(PoseSource, Place)>,
    /// Why its name has none.
    without_place: Option<&'static str>,
    captured_at: Option<Timestamp>,
    tags: Vec<String>,
    warnings: Vec<String>,
}

/// What is known about an image.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FoundPose {
    /// Its pose, in the frame of the folder.
    pub pose: Option<Pose>,
    /// Where the pose comes from.
    pub source: Option<PoseSource>,
    /// When it was taken, if a file next to it says so.
    pub captured_at: Option<Timestamp>,
    /// Its tags, if a file next to it has any.
    pub tags: Vec<String>,
    /// What was not taken, and why.
    pub warnings: Vec<String>,
}

impl FolderPoses {
    /// Reads the sources of a folder, except for EXIF: the given table, or `poses.csv` in the folder; the files
    /// next to the images; and their names.
    ///
    /// # Errors
    /// The table cannot be read, a row is not a pose, two rows contradict each other, or no row matches an image.
    pub fn read(folder: &Folder, table: Option<&Path>) -> anyhow::Result<Self> {
        let default = folder.dir.join(POSES_FILE);
        let table = table.or(default.is_file().then_some(default.as_path()));
        let rows = table.map(PoseRows::read).transpose()?;
        let mut known: HashMap<ImageId, KnownImage> = HashMap::new();
        for picture in &folder.pictures {
            let mut image = sidecar::read(&picture.file);
            let name = picture.id.as_str().rsplit('/').next().unwrap_or_default();
            match names::place_in_name(name) {
                Ok(place) => {
                    image.place = image.place.or(place.map(|place| (PoseSource::Name, place)));
                }
                Err(why) => image.without_place = Some(why),
            }
            known.insert(picture.id.clone(), image);
        }
        let account = match rows {
            Some(rows) => Some(account::apply(rows, folder, &mut known)?),
            None => None,
        };
        let mut poses = Self { known, grid: None, is_local: false, account };
        poses.grid = poses.natural_grid();
        poses.note_frame();
        Ok(poses)
    }

    /// What became of the rows of the table; `None` if there is none.
    pub fn account(&self) -> Option<&RowAccount> {
        self.account.as_ref()
    }

    /// The coordinate frame of the poses, unless only EXIF can have any.
    pub fn frame(&self) -> Option<CoordinateFrame> {
        self.grid.map(Grid::frame)
    }

    /// The UTM zone of the poses, if they are metres in one.
    pub fn zone(&self) -> Option<UtmZone> {
        match self.grid {
            Some(Grid::Metric(zone)) if !self.is_local => zone,
            _ => None,
        }
    }

    /// The coordinates that suit the most explicit source: those of the table, else of the sidecars, else of the
    /// names. UTM coordinates stay metres unless they span zones, where equal numbers are different places.
    fn natural_grid(&mut self) -> Option<Grid> {
        let of = |wanted: PoseSource| -> Vec<&Place> {
            let places = self.known.values().filter_map(|image| image.place.as_ref());
            places.filter(|(source, _)| *source == wanted).map(|(_, place)| place).collect()
        };
        let sources = [PoseSource::Table, PoseSource::Sidecar, PoseSource::Name];
        let (source, places) = sources
            .into_iter()
            .map(|source| (source, of(source)))
            .find(|(_, places)| !places.is_empty())?;
        let zones: BTreeSet<UtmZone> = places.iter().filter_map(|place| place.zone).collect();
        let has_metres = places.iter().any(|place| place.metric.is_some());
        let has_degrees = places.iter().any(|place| place.geographic.is_some());
        let prefers_degrees = source != PoseSource::Name && has_degrees;
        let grid = match (zones.len(), has_metres) {
            _ if prefers_degrees => Grid::Wgs84,
            (0, false) => Grid::Wgs84,
            (0, true) => Grid::Metric(None),
            (1, _) => Grid::Metric(zones.first().copied()),
            _ => Grid::Wgs84,
        };
        self.is_local = source != PoseSource::Name && grid == Grid::Metric(None);
        Some(grid)
    }

    /// Converts the poses to another coordinate frame.
    ///
    /// # Errors
    /// The table or a sidecar has a pose that cannot be converted, or no pose in a name can be.
    pub fn convert_to(&mut self, frame: CoordinateFrame) -> anyhow::Result<()> {
        if self.grid.map(Grid::frame) == Some(frame) {
            return Ok(());
        }
        let zones = || self.known.values().filter_map(|image| image.place?.1.zone).min();
        let grid = match frame {
            CoordinateFrame::Wgs84 => Grid::Wgs84,
            CoordinateFrame::Metric => Grid::Metric(zones()),
        };
        let mut misfits = Vec::new();
        let mut fitting = 0;
        for (id, image) in &self.known {
            match image.place.map(|(source, place)| (source, place.in_grid(grid))) {
                None => {}
                Some((_, Ok(_))) => fitting += 1,
                Some((PoseSource::Table, Err(why))) => {
                    bail!("the pose of {id} in the table of poses cannot be used: {why}")
                }
                Some((PoseSource::Sidecar, Err(why))) => {
                    bail!("the pose of {id} in the file next to it cannot be used: {why}")
                }
                Some((_, Err(why))) => misfits.push((id, why)),
            }
        }
        // One odd name is a warning, all of them are not.
        if let (Some((id, why)), 0) = (misfits.iter().min(), fitting) {
            bail!(
                "no position in the names of the images can be used, such as that of {id}: {why}"
            );
        }
        self.is_local &= frame == CoordinateFrame::Metric;
        self.grid = Some(grid);
        self.note_frame();
        Ok(())
    }

    fn note_frame(&mut self) {
        let frame = self.frame();
        if let Some(account) = &mut self.account {
            account.set_frame(frame);
        }
    }

    /// Returns the pose of an image. EXIF data are read from `bytes` if no other source has a pose.
    pub fn find(&self, id: &ImageId, bytes: &[u8]) -> FoundPose {
        let empty = KnownImage::default();
        let image = self.known.get(id).unwrap_or(&empty);
        let mut found = FoundPose {
            captured_at: image.captured_at,
            tags: image.tags.clone(),
            warnings: image.warnings.clone(),
            ..FoundPose::default()
        };
        let grid = self.grid.unwrap_or(Grid::Wgs84);
        match &image.place {
            Some((PoseSource::Name, place)) if self.is_local && place.metric.is_some() => {
                let why = "its name has a position, but the metres of the table have an origin of their own";
                found.warnings.push(why.to_owned());
            }
            Some((source, place)) => match place.in_grid(grid) {
                Ok(pose) => {
                    (found.pose, found.source) = (Some(pose), Some(*source));
                    return found;
                }
                Err(why) => found.warnings.push(why.to_owned()),
            },
            None => found.warnings.extend(image.without_place.map(str::to_owned)),
        }
        let exif::GpsReading { pose, warnings } = exif::gps(bytes);
        found.warnings.extend(warnings);
        if let Some(pose) = pose {
            match Place::of(Pose::Geographic(pose)).in_grid(grid) {
                Ok(pose) => (found.pose, found.source) = (Some(pose), Some(PoseSource::Exif)),
                Err(why) => found.warnings.push(format!("{why}: its EXIF GPS is not taken")),
            }
        }
        found
    }

    /// Returns the poses of all images of a folder, reading their bytes only for EXIF.
    ///
    /// # Errors
    /// An image cannot be read.
    pub fn find_all(&self, folder: &Folder) -> anyhow::Result<Vec<FoundPose>> {
        let find = |picture: &super::PictureFile| {
            let is_known = self.known.get(&picture.id).is_some_and(|image| image.place.is_some());
            let bytes = match is_known {
                true => Vec::new(),
                false => std::fs::read(&picture.file)
                    .with_context(|| format!("cannot read {}", picture.file.display()))?,
            };
            Ok(self.find(&picture.id, &bytes))
        };
        folder.pictures.iter().map(find).collect()
    }
}

/// Finds the image that each of these distinct names means, if it is clear.
pub(crate) fn match_names<'a>(names: &[&str], folder: &'a Folder) -> Vec<Option<&'a ImageId>> {
    let ids: Vec<&str> = folder.pictures.iter().map(|picture| picture.id.as_str()).collect();
    let matches = matching::match_rows(names, &ids, &folder.dir);
    let image =
        |found: Result<(usize, MatchKind), String>| Some(&folder.pictures[found.ok()?.0].id);
    matches.into_iter().map(image).collect()
}

/// The UTM zone in the name of an image, if it has a position in metres.
pub fn zone_in_name(id: &str) -> Option<UtmZone> {
    let name = id.rsplit('/').next()?;
    names::place_in_name(name).ok()??.zone
}
