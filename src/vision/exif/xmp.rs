//! Reads positions from XMP packets: the properties of EXIF (XMP specification, part 2), those of drones, and the
//! heading of panoramas.

use super::GpsReading;
use super::gps;
use super::tiff::Field;
use whereabouts_core::{GeographicPose, Pose};

/// Most namespaces of a packet that are remembered.
const MAX_NAMESPACES: usize = 64;

/// The EXIF tag of each property of the EXIF namespace.
const EXIF_TAGS: [(&str, u16); 9] = [
    ("GPSLatitudeRef", 1),
    ("GPSLatitude", 2),
    ("GPSLongitudeRef", 3),
    ("GPSLongitude", 4),
    ("GPSAltitudeRef", 5),
    ("GPSAltitude", 6),
    ("GPSStatus", 9),
    ("GPSImgDirectionRef", 16),
    ("GPSImgDirection", 17),
];

const LATITUDE: &[&str] = &["GpsLatitude"];
/// Early drones of DJI have a slip of the pen.
const LONGITUDE: &[&str] = &["GpsLongitude", "GpsLongtitude"];
const ABSOLUTE_ALTITUDE: &[&str] = &["AbsoluteAltitude"];
const RELATIVE_ALTITUDE: &[&str] = &["RelativeAltitude"];
/// Of the camera; the yaw of the aircraft is that of its nose.
const YAW: &[&str] = &["GimbalYawDegree", "CameraYawDegree", "GimbalYaw"];

/// Whose properties a namespace has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Vocabulary {
    Exif,
    /// DJI, and the makers who follow it.
    Drone,
    /// Photogrammetry: angles of the camera.
    Camera,
    /// Panoramas.
    Panorama,
}

impl Vocabulary {
    /// The vocabulary of a namespace; of a prefix, if the packet does not declare it.
    fn of(prefix: &str, uri: Option<&str>) -> Option<Self> {
        match uri {
            Some(uri) => {
                let uri = uri.to_ascii_lowercase();
                let is = |part: &str| uri.contains(part);
                if is("ns.adobe.com/exif/1.0") {
                    Some(Self::Exif)
                } else if is("dji.com") || is("drone") || is("autel") {
                    Some(Self::Drone)
                } else if is("pix4d.com/camera") {
                    Some(Self::Camera)
                } else if is("google.com/photos/1.0/panorama") {
                    Some(Self::Panorama)
                } else {
                    None
                }
            }
            None if prefix == "exif" => Some(Self::Exif),
            None if prefix.starts_with("drone") => Some(Self::Drone),
            None if prefix == "GPano" => Some(Self::Panorama),
            None => None,
        }
    }
}

/// A property of a packet.
#[derive(Debug)]
struct Property<'a> {
    vocabulary: Vocabulary,
    name: &'a str,
    value: &'a str,
}

/// An XMP packet.
#[derive(Debug)]
pub(super) struct Packet<'a> {
    properties: Vec<Property<'a>>,
}

impl<'a> Packet<'a> {
    /// Reads the properties that matter, as attributes or as elements, as far as the text can be followed.
    pub(super) fn parse(text: &'a str) -> Self {
        let (mut names, mut namespaces) = (Vec::new(), Vec::new());
        scan(text, |name, value| match name.split_once(':') {
            Some(("xmlns", prefix)) if namespaces.len() < MAX_NAMESPACES => {
                namespaces.push((prefix, value));
            }
            Some((prefix, local)) if is_wanted(local) => names.push((prefix, local, value)),
            _ => {}
        });
        let property = |(prefix, name, value): (&'a str, &'a str, &'a str)| {
            let uri = namespaces.iter().find(|(known, _)| *known == prefix).map(|(_, uri)| *uri);
            Some(Property { vocabulary: Vocabulary::of(prefix, uri)?, name, value })
        };
        Self { properties: names.into_iter().filter_map(property).collect() }
    }

    fn text(&self, vocabulary: Vocabulary, names: &[&str]) -> Option<&'a str> {
        let find = |name: &&str| {
            let is = |one: &&Property<'_>| one.vocabulary == vocabulary && one.name == *name;
            self.properties.iter().find(is).map(|one| one.value)
        };
        names.iter().find_map(find)
    }

    fn number(&self, vocabulary: Vocabulary, names: &[&str]) -> Option<f64> {
        let number = self.text(vocabulary, names)?.trim().parse::<f64>().ok();
        number.filter(|number| number.is_finite())
    }

    /// The position, in the properties of EXIF or in those of a drone.
    pub(super) fn position(&self) -> GpsReading {
        let field = |(name, tag): (&str, u16)| Some((tag, self.text(Vocabulary::Exif, &[name])?));
        let fields: Vec<Field<'_>> = EXIF_TAGS
            .into_iter()
            .filter_map(field)
            .map(|(tag, text)| Field::of_text(tag, text))
            .collect();
        let mut reading = gps::read(&fields);
        if reading.pose.is_none() {
            let GpsReading { pose, warnings } = self.of_drone();
            reading.warnings = if pose.is_some() { warnings } else { reading.warnings };
            reading.pose = pose;
        }
        reading
    }

    /// The position in signed degrees; 0, 0 without a fix.
    fn of_drone(&self) -> GpsReading {
        let number = |names| self.number(Vocabulary::Drone, names);
        let pose = number(LATITUDE).zip(number(LONGITUDE)).and_then(|(lat, lon)| {
            let pose = GeographicPose { lat, lon, alt: None, heading: None };
            let is_place = (lat, lon) != (0.0, 0.0) && Pose::Geographic(pose).checked().is_ok();
            is_place.then_some(pose)
        });
        let alt = number(ABSOLUTE_ALTITUDE).filter(|alt| alt.abs() <= gps::MAX_ALTITUDE_M);
        let mut warnings = Vec::new();
        if pose.is_some() && alt.is_none() && number(RELATIVE_ALTITUDE).is_some() {
            warnings.push("the altitude is above the take-off point and left out".to_owned());
        }
        GpsReading { pose: pose.map(|pose| GeographicPose { alt, ..pose }), warnings }
    }

    /// The direction in which the camera looks, in degrees from north, where the position has none.
    pub(super) fn heading(&self) -> Option<f64> {
        let yaw = self
            .number(Vocabulary::Drone, YAW)
            .or_else(|| self.number(Vocabulary::Camera, &["Yaw"]))
            .or_else(|| self.number(Vocabulary::Panorama, &["PoseHeadingDegrees"]))?;
        (-360.0..=360.0).contains(&yaw).then_some(if yaw < 0.0 { yaw + 360.0 } else { yaw })
    }
}

fn is_wanted(local: &str) -> bool {
    let of_exif = EXIF_TAGS.iter().any(|(name, _)| *name == local);
    let others = [LATITUDE, LONGITUDE, ABSOLUTE_ALTITUDE, RELATIVE_ALTITUDE, YAW];
    of_exif
        || others.iter().any(|names| names.contains(&local))
        || ["Yaw", "PoseHeadingDegrees"].contains(&local)
}

/// Calls `each` with the name and the value of each attribute and of each element with text, in one pass.
fn scan<'a>(text: &'a str, mut each: impl FnMut(&'a str, &'a str)) {
    let mut rest = text;
    while let Some(start) = rest.find('<') {
        rest = &rest[start + 1..];
        if let Some(comment) = rest.strip_prefix("!--") {
            rest = comment.find("-->").map_or("", |end| &comment[end..]);
            continue;
        }
        let (tag, behind) = rest.split_at(end_of_tag(rest));
        rest = behind.strip_prefix('>').unwrap_or(behind);
        if tag.starts_with(['/', '?', '!']) {
            continue;
        }
        let name = tag.split(|c: char| c.is_whitespace() || c == '/').next().unwrap_or_default();
        attributes(&tag[name.len()..], &mut each);
        if !tag.ends_with('/') {
            let value = rest[..rest.find('<').unwrap_or(rest.len())].trim();
            if !value.is_empty() {
                each(name, value);
            }
        }
    }
}

/// The position of the `>` that ends a tag: the first outside of quotes.
fn end_of_tag(text: &str) -> usize {
    let mut quote = None;
    for (index, byte) in text.bytes().enumerate() {
        match (byte, quote) {
            (b'>', None) => return index,
            (b'"' | b'\'', None) => quote = Some(byte),
            (byte, Some(open)) if byte == open => quote = None,
            _ => {}
        }
    }
    text.len()
}

fn attributes<'a>(text: &'a str, each: &mut impl FnMut(&'a str, &'a str)) {
    let mut rest = text;
    while let Some((name, behind)) = rest.split_once('=') {
        let behind = behind.trim_start();
        let Some(quote @ ('"' | '\'')) = behind.chars().next() else { return };
        let Some((value, behind)) = behind[1..].split_once(quote) else { return };
        each(name.trim(), value.trim());
        rest = behind;
    }
}
