//! Reads the rows of a table of poses.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use super::place::{Place, checked};
use crate::table_file::{Table, TableRow, plain};
use whereabouts_core::{CoordinateFrame, Pose, PoseInput, UtmZone};

/// What a column means, and the names that it has, without case, spaces and punctuation. Of several names of a
/// file, the first that a table has is taken.
const COLUMNS: [(Column, &[&str]); 13] = [
    (
        Column::File,
        &[
            "file",
            "filename",
            "filepath",
            "sourcefile",
            "imagepath",
            "imagefile",
            "imagefilename",
            "imagename",
            "path",
            "image",
            "img",
            "picture",
            "photo",
            "name",
            "label",
            "frame",
            "imageid",
            "id",
        ],
    ),
    (Column::Lat, &["lat", "latitude", "gpslatitude", "gpslat", "latdeg", "latitudedeg", "ylat"]),
    (
        Column::Lon,
        &[
            "lon",
            "long",
            "lng",
            "longitude",
            "gpslongitude",
            "gpslon",
            "gpslong",
            "gpslng",
            "londeg",
            "longitudedeg",
        ],
    ),
    (
        Column::Alt,
        &["alt", "altitude", "gpsaltitude", "gpsalt", "elevation", "height", "altm", "altitudem"],
    ),
    (
        Column::Heading,
        &["heading", "bearing", "azimuth", "compass", "compassangle", "gpsimgdirection"],
    ),
    (
        Column::X,
        &[
            "x",
            "easting",
            "east",
            "utmeasting",
            "utmeast",
            "utmx",
            "tx",
            "px",
            "posx",
            "positionx",
            "xm",
        ],
    ),
    (
        Column::Y,
        &[
            "y",
            "northing",
            "north",
            "utmnorthing",
            "utmnorth",
            "utmy",
            "ty",
            "py",
            "posy",
            "positiony",
            "ym",
        ],
    ),
    (Column::Z, &["z", "tz", "pz", "posz", "positionz", "zm"]),
    (Column::Qx, &["qx"]),
    (Column::Qy, &["qy"]),
    (Column::Qz, &["qz"]),
    (Column::Qw, &["qw"]),
    (Column::Zone, &["zone", "utmzone", "zonenumber", "utmzonenumber"]),
];

/// Names of the column with the letter of a UTM zone.
const LETTER: [&str; 6] =
    ["zoneletter", "utmzoneletter", "utmletter", "band", "utmband", "hemisphere"];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Column {
    File,
    Lat,
    Lon,
    Alt,
    Heading,
    X,
    Y,
    Z,
    Qx,
    Qy,
    Qz,
    Qw,
    Zone,
}

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
        let mut all: Vec<PoseRow> = Vec::with_capacity(table.rows.len());
        let (mut by_name, mut repeated) = (HashMap::new(), 0);
        let mut frame: Option<(u64, CoordinateFrame)> = None;
        for row in &table.rows {
            let line = row.line;
            let at = || format!("{} line {line}", file.display());
            let name = columns.text(row, columns.file).to_owned();
            if name.is_empty() {
                bail!("{} names no file", at());
            }
            let place = columns.place(row).with_context(at)?;
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
        Ok(Self { file: file.to_owned(), rows: all, repeated, unused })
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

fn synonyms(column: Column) -> &'static [&'static str] {
    COLUMNS.iter().find(|(one, _)| *one == column).map_or(&[], |(_, names)| names)
}

/// The index of each column.
struct Columns {
    file: Option<usize>,
    lat: Option<usize>,
    lon: Option<usize>,
    alt: Option<usize>,
    heading: Option<usize>,
    position: [Option<usize>; 3],
    quaternion: [Option<usize>; 4],
    zone: Option<usize>,
    letter: Option<usize>,
}

impl Columns {
    fn find(header: &[String]) -> Self {
        let plain: Vec<String> = header.iter().map(|name| plain(name)).collect();
        let first = |names: &[&str]| {
            names.iter().find_map(|name| plain.iter().position(|column| column == name))
        };
        let of = |column: Column| first(synonyms(column));
        Self {
            file: of(Column::File),
            lat: of(Column::Lat),
            lon: of(Column::Lon),
            alt: of(Column::Alt),
            heading: of(Column::Heading),
            position: [Column::X, Column::Y, Column::Z].map(of),
            quaternion: [Column::Qx, Column::Qy, Column::Qz, Column::Qw].map(of),
            zone: of(Column::Zone),
            letter: first(&LETTER),
        }
    }

    fn check(&self, file: &Path, header: &[String]) -> anyhow::Result<()> {
        let [x, y, _] = self.position;
        let has_position =
            (self.lat.is_some() && self.lon.is_some()) || (x.is_some() && y.is_some());
        let missing = match (self.file, has_position) {
            (Some(_), true) => return Ok(()),
            (None, _) => "names the files (file)",
            (Some(_), false) => "has positions (lat and lon, or x and y)",
        };
        bail!(
            "{} has no column that {missing}; its first row is taken as the header and has {}",
            file.display(),
            header.iter().map(|name| format!("{name:?}")).collect::<Vec<_>>().join(", ")
        )
    }

    fn unused(&self, header: &[String]) -> Vec<String> {
        let has_degrees = self.lat.is_some() && self.lon.is_some();
        let has_metres = self.position[0].is_some() && self.position[1].is_some();
        let degrees =
            [self.lat, self.lon, self.alt, self.heading].map(|index| index.filter(|_| has_degrees));
        let metres = self.position.iter().chain(&self.quaternion).chain([&self.zone, &self.letter]);
        let metres = metres.map(|index| index.filter(|_| has_metres));
        let used: Vec<usize> =
            degrees.into_iter().chain(metres).chain([self.file]).flatten().collect();
        let names = header.iter().enumerate().filter(|(index, _)| !used.contains(index));
        names.map(|(_, name)| name.clone()).filter(|name| !name.is_empty()).collect()
    }

    fn text<'a>(&self, row: &'a TableRow, column: Option<usize>) -> &'a str {
        column.and_then(|index| row.cells.get(index)).map_or("", String::as_str)
    }

    fn number(&self, row: &TableRow, column: Option<usize>) -> anyhow::Result<Option<f64>> {
        let text = self.text(row, column);
        number(text).map_err(|()| anyhow::anyhow!("{text:?} is not a number"))
    }

    /// The place of a row; `None` if it has no coordinates.
    fn place(&self, row: &TableRow) -> anyhow::Result<Option<Place>> {
        let number = |column| self.number(row, column);
        let [x, y, z] = self.position;
        let (lat, lon, x, y) = (number(self.lat)?, number(self.lon)?, number(x)?, number(y)?);
        // Columns of the other frame are ignored: tables often have more of them than a pose needs.
        let geographic = match (lat, lon) {
            (None, None) => None,
            _ => {
                let (alt, heading) = (number(self.alt)?, number(self.heading)?);
                let input = PoseInput { lat, lon, alt, heading, ..PoseInput::default() };
                Some(checked(input, CoordinateFrame::Wgs84)?)
            }
        };
        let metric = match (x, y) {
            (None, None) => None,
            _ => {
                let [qx, qy, qz, qw] = self.quaternion;
                let (qx, qy, qz, qw) = (number(qx)?, number(qy)?, number(qz)?, number(qw)?);
                let input =
                    PoseInput { x, y, z: number(z)?, qx, qy, qz, qw, ..PoseInput::default() };
                Some(checked(input, CoordinateFrame::Metric)?)
            }
        };
        let mut place = Place::default();
        for pose in [geographic, metric].into_iter().flatten() {
            match pose {
                Pose::Geographic(pose) => place.geographic = Some(pose),
                Pose::Metric(pose) => {
                    place.metric = Some(pose);
                    place.zone = self.zone(row, pose.y)?;
                }
            }
        }
        Ok((geographic.is_some() || metric.is_some()).then_some(place))
    }

    fn zone(&self, row: &TableRow, northing: f64) -> anyhow::Result<Option<UtmZone>> {
        let text = self.text(row, self.zone);
        if text.is_empty() {
            return Ok(None);
        }
        let digits = text.trim_end_matches(|c: char| c.is_alphabetic() || c == ' ');
        let letter = text[digits.len()..].trim().chars().next();
        let letter = letter.or_else(|| self.text(row, self.letter).chars().next());
        let number = digits.trim_end_matches(".0").parse().ok();
        let zone = number.and_then(|number| UtmZone::with_letter(number, letter, northing));
        zone.map(Some).with_context(|| format!("{text:?} is not a UTM zone, such as 10S"))
    }
}

/// Parses a number with a decimal point or comma; `None` for an empty cell and for what programs write instead.
fn number(text: &str) -> Result<Option<f64>, ()> {
    let text = text.trim_matches(|c: char| c.is_whitespace() || c == '\u{b0}');
    let lower = text.to_ascii_lowercase();
    if ["", "nan", "null", "none", "na", "n/a", "-"].contains(&lower.as_str()) {
        return Ok(None);
    }
    let mut text = text.replace('\u{2212}', "-");
    if text.matches(',').count() == 1 && !text.contains('.') {
        text = text.replace(',', ".");
    }
    text.parse().ok().filter(|value: &f64| value.is_finite()).map(Some).ok_or(())
}

#[cfg(test)]
mod tests;
