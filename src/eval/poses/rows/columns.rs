//! The columns of a table of poses, and the place that a row of them says.

use std::path::Path;

use anyhow::{Context, anyhow, bail};

use super::values::{LATITUDE, LONGITUDE, coordinate, length, number, pair};
use crate::poses::place::{Place, checked};
use crate::table_file::{TableRow, plain};
use whereabouts_core::{CoordinateFrame, GeographicPose, MetricPose, Pose, PoseInput, UtmZone};

/// What a column means, and the names that it has, without case, spaces and punctuation. Of several names of a
/// file, the first that a table has is taken.
const COLUMNS: [(Column, &[&str]); 18] = [
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
    (Column::Letter, &["zoneletter", "utmzoneletter", "utmletter", "band", "utmband", HEMISPHERE]),
    (Column::LatRef, &["latref", "latituderef", "gpslatituderef", "gpslatref", "ns"]),
    (Column::LonRef, &["lonref", "longituderef", "gpslongituderef", "gpslonref", "ew"]),
    (Column::AltRef, &["altref", "altituderef", "gpsaltituderef", "gpsaltref"]),
    (
        Column::LatLon,
        &["gpsposition", "gpscoordinates", "coordinates", "latlon", "latlng", "latlong"],
    ),
];

/// The column whose letter cannot be that of a band.
const HEMISPHERE: &str = "hemisphere";

/// Columns that say a position in degrees.
const DEGREES: [Column; 8] = [
    Column::Lat,
    Column::Lon,
    Column::LatLon,
    Column::LatRef,
    Column::LonRef,
    Column::Alt,
    Column::AltRef,
    Column::Heading,
];

/// Columns that say a position in metres.
const METRES: [Column; 9] = [
    Column::X,
    Column::Y,
    Column::Z,
    Column::Qx,
    Column::Qy,
    Column::Qz,
    Column::Qw,
    Column::Zone,
    Column::Letter,
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Column {
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
    Letter,
    LatRef,
    LonRef,
    AltRef,
    /// A latitude and a longitude in one cell.
    LatLon,
}

/// The names of a column.
pub(super) fn synonyms(column: Column) -> &'static [&'static str] {
    COLUMNS.iter().find(|(one, _)| *one == column).map_or(&[], |(_, names)| names)
}

/// The columns of a table.
pub(super) struct Columns {
    known: Vec<(Column, usize)>,
    has_hemisphere: bool,
}

/// What a row says.
#[derive(Debug, Default)]
pub(super) struct RowPlace {
    /// Its place; `None` without coordinates.
    pub place: Option<Place>,
    /// The number of a UTM zone without a hemisphere, which is not used.
    pub half_zone: Option<u8>,
}

/// The UTM zone of a row.
enum Zone {
    None,
    Half(u8),
    Known(UtmZone),
}

impl Columns {
    pub(super) fn find(header: &[String]) -> Self {
        let plain: Vec<String> = header.iter().map(|name| plain(name)).collect();
        let index = |names: &[&str]| {
            names.iter().find_map(|name| plain.iter().position(|column| column == name))
        };
        let known: Vec<(Column, usize)> =
            COLUMNS.iter().filter_map(|(column, names)| Some((*column, index(names)?))).collect();
        let letter = known.iter().find(|(column, _)| *column == Column::Letter);
        let has_hemisphere = letter.is_some_and(|(_, index)| plain[*index] == HEMISPHERE);
        let mut columns = Self { known, has_hemisphere };
        if columns.has(&[Column::Lat, Column::Lon]) {
            columns.known.retain(|(column, _)| *column != Column::LatLon);
        }
        columns
    }

    fn index(&self, column: Column) -> Option<usize> {
        self.known.iter().find(|(one, _)| *one == column).map(|(_, index)| *index)
    }

    fn has(&self, columns: &[Column]) -> bool {
        columns.iter().all(|&column| self.index(column).is_some())
    }

    fn has_degrees(&self) -> bool {
        self.has(&[Column::Lat, Column::Lon]) || self.has(&[Column::LatLon])
    }

    fn has_metres(&self) -> bool {
        self.has(&[Column::X, Column::Y])
    }

    pub(super) fn check(&self, file: &Path, header: &[String]) -> anyhow::Result<()> {
        let missing = match (self.index(Column::File), self.has_degrees() || self.has_metres()) {
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

    /// The names of the columns that no pose needs.
    pub(super) fn unused(&self, header: &[String]) -> Vec<String> {
        let degrees = DEGREES.iter().filter(|_| self.has_degrees());
        let metres = METRES.iter().filter(|_| self.has_metres());
        let used: Vec<usize> = degrees
            .chain(metres)
            .chain([&Column::File])
            .filter_map(|column| self.index(*column))
            .collect();
        let names = header.iter().enumerate().filter(|(index, _)| !used.contains(index));
        names.map(|(_, name)| name.clone()).filter(|name| !name.is_empty()).collect()
    }

    /// The names of the columns in degrees and of those in metres, if the table has both.
    pub(super) fn both_frames(&self, header: &[String]) -> Option<[Vec<String>; 2]> {
        let names = |columns: &[Column]| -> Vec<String> {
            let indices = columns.iter().filter_map(|column| self.index(*column));
            indices.filter_map(|index| header.get(index).cloned()).collect()
        };
        let has_both = self.has_degrees() && self.has_metres();
        has_both.then(|| [names(&DEGREES), names(&METRES)])
    }

    pub(super) fn text<'a>(&self, row: &'a TableRow, column: Column) -> &'a str {
        self.index(column).and_then(|index| row.cells.get(index)).map_or("", String::as_str)
    }

    fn number(&self, row: &TableRow, column: Column) -> anyhow::Result<Option<f64>> {
        let text = self.text(row, column);
        number(text).map_err(|()| anyhow!("{text:?} is not a number"))
    }

    /// The place of a row. Both frames are read: it depends on the folder which is used.
    pub(super) fn place(&self, row: &TableRow) -> anyhow::Result<RowPlace> {
        let geographic = self.geographic(row)?;
        let metric = self.metric(row)?;
        let zone = match metric {
            Some(pose) => self.zone(row, pose.y, geographic.map(|pose| pose.lat))?,
            None => Zone::None,
        };
        let (zone, half_zone) = match zone {
            Zone::None => (None, None),
            Zone::Half(number) => (None, Some(number)),
            Zone::Known(zone) => (Some(zone), None),
        };
        let is_place = geographic.is_some() || metric.is_some();
        let place = is_place.then_some(Place { geographic, metric, zone });
        Ok(RowPlace { place, half_zone })
    }

    fn geographic(&self, row: &TableRow) -> anyhow::Result<Option<GeographicPose>> {
        let text = |column| self.text(row, column);
        let both = text(Column::LatLon);
        let (lat, lon) =
            match self.has(&[Column::LatLon]) && !number(both).is_ok_and(|n| n.is_none()) {
                true => pair(both).with_context(|| {
                    format!("{both:?} is not a latitude and a longitude with a comma between them")
                })?,
                false => (text(Column::Lat), text(Column::Lon)),
            };
        let lat = coordinate(lat, text(Column::LatRef), &LATITUDE).map_err(|why| anyhow!(why))?;
        let lon = coordinate(lon, text(Column::LonRef), &LONGITUDE).map_err(|why| anyhow!(why))?;
        if (lat, lon) == (None, None) {
            return Ok(None);
        }
        let alt = text(Column::Alt);
        let alt = length(alt, text(Column::AltRef))
            .map_err(|()| anyhow!("{alt:?} is not a number of metres"))?;
        let heading = self.number(row, Column::Heading)?;
        let input = PoseInput { lat, lon, alt, heading, ..PoseInput::default() };
        Ok(match checked(input, CoordinateFrame::Wgs84)? {
            Pose::Geographic(pose) => Some(pose),
            Pose::Metric(_) => None,
        })
    }

    fn metric(&self, row: &TableRow) -> anyhow::Result<Option<MetricPose>> {
        let number = |column| self.number(row, column);
        let (x, y) = (number(Column::X)?, number(Column::Y)?);
        if (x, y) == (None, None) {
            return Ok(None);
        }
        let (qx, qy) = (number(Column::Qx)?, number(Column::Qy)?);
        let (qz, qw) = (number(Column::Qz)?, number(Column::Qw)?);
        let input =
            PoseInput { x, y, z: number(Column::Z)?, qx, qy, qz, qw, ..PoseInput::default() };
        Ok(match checked(input, CoordinateFrame::Metric)? {
            Pose::Metric(pose) => Some(pose),
            Pose::Geographic(_) => None,
        })
    }

    /// Reads `10`, `10S`, `10 south` or `EPSG:32610`, with the letter in this column or in one of its own.
    fn zone(&self, row: &TableRow, northing: f64, lat: Option<f64>) -> anyhow::Result<Zone> {
        let text = self.text(row, Column::Zone);
        if number(text).is_ok_and(|number| number.is_none()) {
            return Ok(Zone::None);
        }
        let no_zone = || format!("{text:?} is not a UTM zone, such as 10S");
        let upper = text.to_ascii_uppercase();
        let code = upper.strip_prefix("EPSG:").unwrap_or(&upper);
        let end = code.find(|c: char| !c.is_ascii_digit()).unwrap_or(code.len());
        let (digits, rest) = code.split_at(end);
        let zone: u32 = digits.parse().with_context(no_zone)?;
        // The codes of all zones of WGS 84, north and south.
        if let (32_601..=32_660 | 32_701..=32_760, "") = (zone, rest) {
            let number = u8::try_from(zone % 100).with_context(no_zone)?;
            return UtmZone::new(number, zone > 32_700).map(Zone::Known).with_context(no_zone);
        }
        let zone = u8::try_from(zone).with_context(no_zone)?;
        let word = rest.strip_prefix(".0").unwrap_or(rest).trim();
        let letter = self.text(row, Column::Letter).to_ascii_uppercase();
        let (word, is_hemisphere) =
            if word.is_empty() { (letter.as_str(), self.has_hemisphere) } else { (word, false) };
        let mut letters = word.chars();
        let known = match (letters.next(), letters.next()) {
            (None, _) => match lat {
                None => {
                    UtmZone::new(zone, false).with_context(no_zone)?;
                    return Ok(Zone::Half(zone));
                }
                Some(lat) => UtmZone::new(zone, lat < 0.0),
            },
            (Some('N' | 'S'), None) if is_hemisphere => UtmZone::new(zone, word == "S"),
            (Some(letter), None) => {
                let zone = UtmZone::with_letter(zone, letter, northing, lat);
                return zone.map(Zone::Known).with_context(no_zone);
            }
            _ if word == "NORTH" || word == "SOUTH" => UtmZone::new(zone, word == "SOUTH"),
            _ => None,
        };
        known.map(Zone::Known).with_context(no_zone)
    }
}
