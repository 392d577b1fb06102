//! Reads the poses of the images in a folder from a CSV file, from their names, or from EXIF GPS.

use std::collections::HashMap;
use std::io::Cursor;
use std::path::Path;

use anyhow::{Context, bail};
use exif::{In, Rational, Tag, Value};
use serde::Deserialize;

use super::PictureFile;
use whereabouts_core::{CoordinateFrame, GeographicPose, MetricPose, Pose, PoseInput};

/// Source of the poses of a whole folder.
#[derive(Debug)]
pub enum PoseSource {
    /// A CSV file.
    Csv {
        /// Coordinate frame of all poses.
        frame: CoordinateFrame,
        /// Poses by path relative to the folder, or by file name.
        poses: HashMap<String, Pose>,
    },
    /// File names of the form `@easting@northing@…`, in metres of a UTM zone.
    Names,
    /// EXIF GPS of each file.
    Exif,
}

impl PoseSource {
    /// Finds the source: the given CSV file, otherwise `poses.csv` in the folder, otherwise the file names if all of
    /// them have positions, otherwise EXIF.
    ///
    /// # Errors
    /// The CSV file cannot be read, or a row is not a pose.
    pub fn find(dir: &Path, csv: Option<&Path>, files: &[PictureFile]) -> anyhow::Result<Self> {
        let default = dir.join("poses.csv");
        match csv.or(default.is_file().then_some(default.as_path())) {
            Some(file) => Self::from_csv(file),
            None if files
                .iter()
                .all(|file| pose_in_name(file_name(file.id.as_str())).is_some()) =>
            {
                Ok(Self::Names)
            }
            None => Ok(Self::Exif),
        }
    }

    fn from_csv(file: &Path) -> anyhow::Result<Self> {
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_path(file)
            .with_context(|| format!("cannot read {}", file.display()))?;
        let mut poses = HashMap::new();
        let mut frame = None;
        for (index, row) in reader.deserialize::<Row>().enumerate() {
            // The header is line 1.
            let line = index + 2;
            let row = row.with_context(|| format!("{} line {line}", file.display()))?;
            let name = row.file.clone();
            let pose = row.pose().with_context(|| format!("{} line {line}", file.display()))?;
            if *frame.get_or_insert(pose.frame()) != pose.frame() {
                bail!(
                    "{} line {line} mixes lat,lon and x,y with other rows; use one frame per file",
                    file.display()
                );
            }
            poses.insert(name, pose);
        }
        let frame =
            frame.with_context(|| format!("{} has no rows; add one per image", file.display()))?;
        Ok(Self::Csv { frame, poses })
    }

    /// Names the source for an error message.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Csv { .. } => "the CSV file of poses",
            Self::Names => "their file names",
            Self::Exif => "their EXIF data",
        }
    }

    /// Returns the coordinate frame of the poses, unless it differs from file to file.
    pub fn frame(&self) -> Option<CoordinateFrame> {
        match self {
            Self::Csv { frame, .. } => Some(*frame),
            Self::Names => Some(CoordinateFrame::Metric),
            Self::Exif => None,
        }
    }

    /// Returns the pose of one image; `None` if the source has none. Only EXIF reads `bytes`.
    ///
    /// # Errors
    /// The EXIF position is out of range.
    pub fn pose(&self, id: &str, bytes: &[u8]) -> anyhow::Result<Option<Pose>> {
        match self {
            Self::Csv { poses, .. } => {
                Ok(poses.get(id).or_else(|| poses.get(file_name(id))).copied())
            }
            Self::Names => Ok(pose_in_name(file_name(id))),
            Self::Exif => pose_in_exif(bytes),
        }
    }
}

#[derive(Debug, Deserialize)]
struct Row {
    #[serde(alias = "image", alias = "id", alias = "name", alias = "filename")]
    file: String,
    lat: Option<f64>,
    lon: Option<f64>,
    alt: Option<f64>,
    heading: Option<f64>,
    x: Option<f64>,
    y: Option<f64>,
    z: Option<f64>,
    qx: Option<f64>,
    qy: Option<f64>,
    qz: Option<f64>,
    qw: Option<f64>,
}

impl Row {
    fn pose(self) -> anyhow::Result<Pose> {
        let Self { lat, lon, alt, heading, x, y, z, qx, qy, qz, qw, .. } = self;
        let position = PoseInput { lat, lon, x, y, ..PoseInput::default() };
        let frame = position.frame().context("a row needs either lat and lon, or x and y")?;
        // Columns of the other frame are ignored: tables often have more of them than a pose needs.
        let pose = match frame {
            CoordinateFrame::Wgs84 => PoseInput { alt, heading, ..position },
            CoordinateFrame::Metric => PoseInput { z, qx, qy, qz, qw, ..position },
        };
        Ok(pose.check(frame)?)
    }
}

fn file_name(id: &str) -> &str {
    id.rsplit('/').next().unwrap_or(id)
}

/// Parses the first two fields of `@easting@northing@…`, the naming convention of VPR data sets.
fn pose_in_name(name: &str) -> Option<Pose> {
    let mut fields = name.strip_prefix('@')?.split('@');
    let (x, y) = (fields.next()?.parse().ok()?, fields.next()?.parse().ok()?);
    let pose = MetricPose { x, y, z: None, qx: None, qy: None, qz: None, qw: None };
    Pose::Metric(pose).checked().ok()
}

fn pose_in_exif(bytes: &[u8]) -> anyhow::Result<Option<Pose>> {
    let Ok(exif) = exif::Reader::new().read_from_container(&mut Cursor::new(bytes)) else {
        return Ok(None);
    };
    let rationals = |tag: Tag| match exif.get_field(tag, In::PRIMARY).map(|field| &field.value) {
        Some(Value::Rational(values)) => values.iter().map(Rational::to_f64).collect(),
        _ => Vec::new(),
    };
    let starts_with = |tag: Tag, prefix: &str| {
        exif.get_field(tag, In::PRIMARY)
            .is_some_and(|field| field.display_value().to_string().starts_with(prefix))
    };
    let degrees = |tag: Tag| match rationals(tag)[..] {
        [degrees, minutes, seconds] => Some(degrees + minutes / 60.0 + seconds / 3600.0),
        _ => None,
    };
    let (Some(lat), Some(lon)) = (degrees(Tag::GPSLatitude), degrees(Tag::GPSLongitude)) else {
        return Ok(None);
    };
    let below_sea = exif
        .get_field(Tag::GPSAltitudeRef, In::PRIMARY)
        .and_then(|field| field.value.get_uint(0))
        .is_some_and(|reference| reference == 1);
    let alt = rationals(Tag::GPSAltitude).first().map(|&alt| if below_sea { -alt } else { alt });
    let heading = rationals(Tag::GPSImgDirection).first().copied();
    let pose = Pose::Geographic(GeographicPose {
        lat: if starts_with(Tag::GPSLatitudeRef, "S") { -lat } else { lat },
        lon: if starts_with(Tag::GPSLongitudeRef, "W") { -lon } else { lon },
        alt: alt.filter(|alt| alt.is_finite()),
        heading: heading.filter(|heading| heading.is_finite()),
    });
    Ok(Some(pose.checked().context("the EXIF GPS position is out of range")?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn csv(text: &str) -> anyhow::Result<PoseSource> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        PoseSource::from_csv(file.path())
    }

    #[test]
    fn easting_and_northing_are_read_from_file_names() {
        let Some(Pose::Metric(pose)) = pose_in_name("@0584522.50@4477231.25@17@T@40.4@-80.0@.jpg")
        else {
            panic!("no pose");
        };
        assert_eq!((pose.x, pose.y), (584522.5, 4477231.25));
        for name in ["a.jpg", "@.jpg", "@1@.jpg", "@x@y@.jpg", "@nan@1@.jpg", "@1e30@1@.jpg"] {
            assert!(pose_in_name(name).is_none(), "{name}");
        }
    }

    #[test]
    fn a_csv_refers_to_files_by_path_or_by_name() {
        let source =
            csv("file, lat, lon, heading\na/1.jpg, 35.5, 139.5, 90\n2.jpg,1,2,\n").unwrap();
        assert_eq!(source.frame(), Some(CoordinateFrame::Wgs84));
        assert!(source.pose("a/1.jpg", b"").unwrap().is_some());
        assert!(source.pose("b/2.jpg", b"").unwrap().is_some());
        assert!(source.pose("3.jpg", b"").unwrap().is_none());
    }

    #[test]
    fn an_invalid_row_is_reported_with_its_line() {
        for text in
            ["file,lat,lon\na,1,2\nb,95,2", "file,x,y\na,1,2\nb,,2", "file,x,y\na,1,2\nb,q,2"]
        {
            let error = format!("{:#}", csv(text).unwrap_err());
            assert!(error.contains("line 3"), "{error}");
        }
        assert!(csv("file,lat,lon\n").is_err());
    }
}
