//! Reads the rows of a table of poses.

mod columns;
mod values;

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use self::columns::{Column, Columns, RowPlace, synonyms};
use super::place::Place;
use crate::table_file::Table;
use whereabouts_core::CoordinateFrame;

/// A row of a table of poses.
#[derive(Debug, Clone)]
pub(super) struct PoseRow {
    pub line: u64,
    pub name: String,
    /// `None` if the row has no coordinates.
    pub place: Option<Place>,
}

/// A table of poses.
#[derive(Debug)]
pub(super) struct PoseRows {
    pub file: PathBuf,
    /// One row for each name.
    pub rows: Vec<PoseRow>,
    /// Rows that say the same as an earlier one.
    pub repeated: usize,
    /// Columns that are not used.
    pub unused: Vec<String>,
    /// The columns in degrees and those in metres, if there are both.
    pub both_frames: Option<[Vec<String>; 2]>,
    /// What the user should know of the table.
    pub notes: Vec<String>,
}

impl PoseRows {
    /// Reads a table of poses.
    ///
    /// # Errors
    /// The table cannot be read or lacks a column, a row is not a pose, rows are of different coordinate frames,
    /// or two rows give one file different poses.
    pub(super) fn read(file: &Path) -> anyhow::Result<Self> {
        let table = Table::read(file, |name| synonyms(Column::File).contains(&name))?;
        let columns = Columns::find(&table.header);
        columns.check(file, &table.header)?;
        let unused = columns.unused(&table.header);
        let both_frames = columns.both_frames(&table.header);
        let mut half_zones: BTreeMap<u8, u64> = BTreeMap::new();
        let mut all: Vec<PoseRow> = Vec::with_capacity(table.rows.len());
        let (mut by_name, mut repeated) = (HashMap::new(), 0);
        let mut frame: Option<(u64, CoordinateFrame)> = None;
        for row in &table.rows {
            let line = row.line;
            let at = || format!("{} line {line}", file.display());
            let name = columns.text(row, Column::File).to_owned();
            if name.is_empty() {
                bail!("{} names no file", at());
            }
            let RowPlace { place, half_zone } = columns.place(row).with_context(at)?;
            half_zones.extend(half_zone.map(|zone| (zone, line)));
            if let Some(own) = place.as_ref().and_then(only_frame) {
                let (first, of_file) = *frame.get_or_insert((line, own));
                if of_file != own {
                    bail!(
                        "{} mixes lat,lon and x,y with line {first}; use one frame per file",
                        at()
                    );
                }
            }
            let key = name.replace('\\', "/");
            let key = key.trim_start_matches("./").to_owned();
            let known = by_name.get(&key).map(|&index: &usize| &all[index]);
            match known {
                Some(known) if known.place == place => repeated += 1,
                Some(known) => bail!(
                    "{} lines {} and {line} give {name:?} different poses; remove one of them",
                    file.display(),
                    known.line
                ),
                None => {
                    by_name.insert(key, all.len());
                    all.push(PoseRow { line, name, place });
                }
            }
        }
        if all.is_empty() {
            bail!("{} has no rows; add one per image", file.display());
        }
        let mut notes = Vec::new();
        match (half_zones.first_key_value(), half_zones.last_key_value()) {
            (Some((zone, line)), Some((other, other_line))) if zone != other => bail!(
                "{} has UTM zones without a hemisphere, such as {zone} in line {line} and {other} in line \
                 {other_line}; write {zone}N or {zone}S, so that places can be told apart",
                file.display()
            ),
            (Some((zone, _)), _) => notes.push(format!(
                "the UTM zone {zone} has no hemisphere and is not used; write {zone}N or {zone}S if the metres are \
                 to be converted to degrees"
            )),
            (None, _) => {}
        }
        let is_at_zero =
            |place: &Place| place.geographic.is_some_and(|pose| (pose.lat, pose.lon) == (0.0, 0.0));
        let at_zero = all.iter().filter(|row| row.place.as_ref().is_some_and(is_at_zero)).count();
        if at_zero > 0 {
            notes.push(format!(
                "rows at latitude 0 and longitude 0 ({at_zero}), which receivers write without a fix; empty these \
                 cells if the place is not known"
            ));
        }
        Ok(Self { file: file.to_owned(), rows: all, repeated, unused, both_frames, notes })
    }
}

/// The frame of a place that is given in one only.
fn only_frame(place: &Place) -> Option<CoordinateFrame> {
    match (place.geographic, place.metric, place.zone) {
        (Some(_), None, _) => Some(CoordinateFrame::Wgs84),
        (None, Some(_), None) => Some(CoordinateFrame::Metric),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
