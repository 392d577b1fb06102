//! Gives the rows of a table to the images, and accounts for every row.

use std::collections::HashMap;

use anyhow::bail;
use serde::{Deserialize, Serialize};

use super::matching::{MatchKind, match_rows};
use super::rows::PoseRows;
use super::{KnownImage, PoseSource};
use crate::Folder;
use crate::account::bounded;
use whereabouts_core::{CoordinateFrame, ImageId};

/// What became of the rows of a table of poses. Every row is counted once.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RowAccount {
    /// The table.
    pub table: String,
    /// Number of rows.
    pub rows: usize,
    /// Rows that give an image its pose.
    pub matched: usize,
    /// Rows that say the same as an earlier one.
    pub repeated: usize,
    /// Rows that match an image and have no coordinates.
    pub without_position: usize,
    /// Rows that match no image.
    pub unmatched: Vec<UnmatchedRow>,
    /// Rows that name their image other than by its exact path.
    pub loose: Vec<LooseRow>,
    /// Images that match no row; some may have a pose from another source.
    pub images_without_row: Vec<ImageId>,
    /// Columns that are not used.
    pub unused_columns: Vec<String>,
    /// Columns in the coordinate frame that the poses are not taken in, if the table has both.
    #[serde(default)]
    pub other_frame_columns: Vec<String>,
    /// What the user should know of the table.
    #[serde(default)]
    pub notes: Vec<String>,
    /// Columns in degrees and in metres, if there are both.
    #[serde(skip)]
    both_frames: Option<[Vec<String>; 2]>,
}

/// A row that matches no image.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct UnmatchedRow {
    /// Its line in the file, from 1.
    pub line: u64,
    /// The file that it names.
    pub name: String,
    /// Why it matches none.
    pub why: String,
}

/// A row that names its image other than by its exact path.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LooseRow {
    /// Its line in the file, from 1.
    pub line: u64,
    /// The file that it names.
    pub name: String,
    /// The image that is meant.
    pub image: ImageId,
    /// How it names the image.
    pub by: MatchKind,
}

/// Gives the rows to the images of a folder.
///
/// # Errors
/// No row matches an image.
pub(super) fn apply(
    table: PoseRows,
    folder: &Folder,
    known: &mut HashMap<ImageId, KnownImage>,
) -> anyhow::Result<RowAccount> {
    let names: Vec<&str> = table.rows.iter().map(|row| row.name.as_str()).collect();
    let ids: Vec<&str> = folder.pictures.iter().map(|picture| picture.id.as_str()).collect();
    let mut account = RowAccount {
        table: table.file.display().to_string(),
        rows: table.rows.len() + table.repeated,
        matched: 0,
        repeated: table.repeated,
        without_position: 0,
        unmatched: Vec::new(),
        loose: Vec::new(),
        images_without_row: Vec::new(),
        unused_columns: table.unused.clone(),
        other_frame_columns: Vec::new(),
        notes: table.notes.clone(),
        both_frames: table.both_frames.clone(),
    };
    let mut has_row = vec![false; ids.len()];
    for (row, found) in table.rows.iter().zip(match_rows(&names, &ids, &folder.dir)) {
        let (line, name) = (row.line, row.name.clone());
        let (index, by) = match found {
            Ok(found) => found,
            Err(why) => {
                account.unmatched.push(UnmatchedRow { line, name, why });
                continue;
            }
        };
        has_row[index] = true;
        let image = folder.pictures[index].id.clone();
        match row.place {
            Some(place) => {
                account.matched += 1;
                let known = known.entry(image.clone()).or_default();
                known.place = Some((PoseSource::Table, place));
            }
            None => account.without_position += 1,
        }
        if by != MatchKind::Path {
            account.loose.push(LooseRow { line, name, image, by });
        }
    }
    let pictures = folder.pictures.iter().zip(&has_row);
    let without = pictures.filter(|(_, has_row)| !**has_row).map(|(picture, _)| picture.id.clone());
    account.images_without_row = without.collect();
    match (table.rows.first(), folder.pictures.first()) {
        (Some(row), Some(picture)) if account.unmatched.len() == table.rows.len() => bail!(
            "none of the {} rows of {} matches one of the {} images in {}: the first row is of {:?} (line {}), \
             the first image is {:?}. Rows name files by their paths relative to the folder",
            account.rows,
            account.table,
            ids.len(),
            folder.dir.display(),
            row.name,
            row.line,
            picture.id.as_str()
        ),
        _ => Ok(account),
    }
}

impl RowAccount {
    /// Notes the coordinate frame in which the poses are taken.
    pub(super) fn set_frame(&mut self, frame: Option<CoordinateFrame>) {
        let Some([degrees, metres]) = &self.both_frames else { return };
        let others = match frame {
            Some(CoordinateFrame::Metric) => degrees,
            _ => metres,
        };
        self.other_frame_columns.clone_from(others);
    }

    /// The account in lines for people, each list bounded to `most` names.
    pub fn lines(&self, most: usize) -> Vec<String> {
        let Self { table, rows, matched, repeated, without_position, unmatched, .. } = self;
        let mut lines = vec![format!(
            "rows of {table}: {rows} in all, {matched} matched, {} without an image, {without_position} without a \
             position, {repeated} repeated",
            unmatched.len()
        )];
        let mut list = |what: &str, count: usize, names: String| {
            if count > 0 {
                lines.push(format!("{what} ({count}): {names}"));
            }
        };
        let of = |row: &UnmatchedRow| format!("{:?} (line {}: {})", row.name, row.line, row.why);
        list("rows without an image", unmatched.len(), bounded(unmatched, most, of));
        let images = &self.images_without_row;
        list("images without a row", images.len(), bounded(images, most, ImageId::to_string));
        for kind in
            [MatchKind::OtherCase, MatchKind::NoExtension, MatchKind::Folder, MatchKind::BaseName]
        {
            let rows: Vec<&LooseRow> = self.loose.iter().filter(|row| row.by == kind).collect();
            let of =
                |row: &&LooseRow| format!("{:?} (line {}) for {}", row.name, row.line, row.image);
            let what = format!("rows that name their images {}", kind.how());
            list(&what, rows.len(), bounded(&rows, most.min(3), of));
        }
        let columns = &self.unused_columns;
        let names = bounded(columns, most, |name| format!("{name:?}"));
        let hint = "a direction is read from heading, in degrees clockwise from north";
        list("columns that are not used", columns.len(), format!("{names}; {hint}"));
        let columns = &self.other_frame_columns;
        let names = bounded(columns, most, |name| format!("{name:?}"));
        let hint = "each map has one frame (index --frame wgs84 or metric)";
        let what = "columns of the other coordinate frame, which are used only where a row has no other position";
        list(what, columns.len(), format!("{names}; {hint}"));
        lines.extend(self.notes.iter().take(most).cloned());
        lines
    }
}
