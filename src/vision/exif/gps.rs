//! Makes a position of the fields of a GPS directory (Exif 2.32, section 4.6.6).

use super::GpsReading;
use super::tiff::{Field, Number};
use whereabouts_core::{GeographicPose, Pose};

const LATITUDE_REF: u16 = 1;
const LATITUDE: u16 = 2;
const LONGITUDE_REF: u16 = 3;
const LONGITUDE: u16 = 4;
const ALTITUDE_REF: u16 = 5;
const ALTITUDE: u16 = 6;
const STATUS: u16 = 9;
const DIRECTION_REF: u16 = 16;
const DIRECTION: u16 = 17;

/// Altitudes beyond this are the sentinels and overflows of writers, in metres.
pub(super) const MAX_ALTITUDE_M: f64 = 1e5;

/// Reads the position from the fields of a GPS directory.
pub(super) fn read(fields: &[Field<'_>]) -> GpsReading {
    let mut warnings = Vec::new();
    let lat = coordinate(fields, "latitude", (LATITUDE, LATITUDE_REF), ('N', 'S'));
    let lon = coordinate(fields, "longitude", (LONGITUDE, LONGITUDE_REF), ('E', 'W'));
    let pose = match (lat, lon) {
        (Coordinate::Missing, Coordinate::Missing) => None,
        (Coordinate::NoFix, _) | (_, Coordinate::NoFix) => None,
        (Coordinate::Known(lat), Coordinate::Known(lon)) if lat == 0.0 && lon == 0.0 => {
            warnings.push(
                "the GPS position is 0°, 0°, which cameras write without a fix: no pose is taken"
                    .into(),
            );
            None
        }
        (Coordinate::Known(lat), Coordinate::Known(lon)) => {
            let pose = GeographicPose { lat, lon, alt: None, heading: None };
            let valid = Pose::Geographic(pose).checked().is_ok();
            if !valid {
                warnings.push("the GPS position is not on the globe: no pose is taken".into());
            }
            valid.then_some(pose)
        }
        (lat, lon) => {
            for (name, one) in [("latitude", lat), ("longitude", lon)] {
                match one {
                    Coordinate::Missing => {
                        warnings.push(format!("the GPS position has no {name}: no pose is taken"))
                    }
                    Coordinate::Refused(why) => warnings.push(why),
                    Coordinate::NoFix | Coordinate::Known(_) => {}
                }
            }
            None
        }
    };
    let pose = pose.map(|pose| GeographicPose {
        alt: altitude(fields, &mut warnings),
        heading: heading(fields, &mut warnings),
        ..pose
    });
    let is_void = text_of(fields, STATUS).is_some_and(|status| status.eq_ignore_ascii_case("V"));
    if pose.is_some() && is_void {
        warnings.push("the GPS receiver marked its position as void; check the pose".into());
    }
    GpsReading { pose, warnings }
}

enum Coordinate {
    Missing,
    /// 0/0: the receiver had no fix.
    NoFix,
    /// Why it is not taken.
    Refused(String),
    /// Signed degrees.
    Known(f64),
}

fn find<'a, 'b>(fields: &'b [Field<'a>], tag: u16) -> Option<&'b Field<'a>> {
    fields.iter().find(|field| field.tag == tag)
}

fn text_of(fields: &[Field<'_>], tag: u16) -> Option<String> {
    find(fields, tag).and_then(Field::text)
}

fn coordinate(
    fields: &[Field<'_>],
    name: &str,
    (tag, reference): (u16, u16),
    (positive, negative): (char, char),
) -> Coordinate {
    let Some(field) = find(fields, tag) else { return Coordinate::Missing };
    let text = field.text().filter(|_| field.is_text());
    let parts = match &text {
        Some(text) => parts_in(text),
        None if field.is_text() => Vec::new(),
        None => field.numbers(),
    };
    let is_unknown = |part: &Number| matches!(part, Number::Unknown);
    let degrees = match parts[..] {
        [first, ..] if is_unknown(&first) => return Coordinate::NoFix,
        [] | [_, _, _, _, ..] => None,
        _ => in_degrees(&parts),
    };
    let Some(degrees) = degrees else {
        return Coordinate::Refused(format!(
            "the GPS {name} is not a number of degrees, minutes and seconds: no pose is taken"
        ));
    };
    let in_field =
        text_of(fields, reference).and_then(|text| text.chars().find(char::is_ascii_alphabetic));
    // A coordinate written as text may end with its letter.
    let at_the_end = || text?.trim_end().chars().last().filter(char::is_ascii_alphabetic);
    let letter = in_field.or_else(at_the_end).map(|letter| letter.to_ascii_uppercase());
    match letter {
        // A sign and a letter that say the same.
        Some(letter) if letter == negative => Coordinate::Known(-degrees.abs()),
        Some(letter) if letter == positive && degrees >= 0.0 => Coordinate::Known(degrees),
        Some(letter) if letter == positive => Coordinate::Refused(format!(
            "the GPS {name} is negative, but its letter is {positive}: no pose is taken"
        )),
        _ => Coordinate::Refused(format!(
            "the GPS {name} has no hemisphere letter ({positive} or {negative}): no pose is taken"
        )),
    }
}

/// Adds up one to three parts. Unused minutes and seconds are 0/0, which counts as zero.
fn in_degrees(parts: &[Number]) -> Option<f64> {
    let (mut sum, mut is_negative) = (0.0, false);
    for (part, unit) in parts.iter().zip([1.0, 60.0, 3600.0]) {
        match part {
            Number::Value(value) => {
                sum += value.abs() / unit;
                is_negative |= *value < 0.0;
            }
            Number::Unknown => {}
            Number::Invalid => return None,
        }
    }
    Some(if is_negative { -sum } else { sum })
}

/// Numbers and fractions in a text, such as `45,12.5`, `45 deg 12' 30.00"` or `45/1 12/1 30/1`.
fn parts_in(text: &str) -> Vec<Number> {
    let number_like = |c: char| c.is_ascii_digit() || matches!(c, '.' | '/' | '-' | '+');
    text.split(|c: char| !number_like(c))
        .filter(|part| part.chars().any(|c| c.is_ascii_digit()))
        .map(|part| match part.split_once('/') {
            Some((numerator, denominator)) => match (numerator.parse(), denominator.parse()) {
                (Ok(numerator), Ok(denominator)) => Number::fraction(numerator, denominator),
                _ => Number::Invalid,
            },
            None => part.parse().map_or(Number::Invalid, Number::of),
        })
        .collect()
}

/// One number of a field, written as a number or as text.
fn single(fields: &[Field<'_>], tag: u16) -> Option<Number> {
    let field = find(fields, tag)?;
    let parts = match field.text() {
        Some(text) if field.is_text() => parts_in(&text),
        _ => field.numbers(),
    };
    parts.first().copied().filter(|part| *part != Number::Unknown)
}

fn altitude(fields: &[Field<'_>], warnings: &mut Vec<String>) -> Option<f64> {
    let value = match single(fields, ALTITUDE)? {
        Number::Value(value) if value.abs() <= MAX_ALTITUDE_M => value,
        _ => {
            warnings.push("the GPS altitude is out of range and left out".into());
            return None;
        }
    };
    let reference = find(fields, ALTITUDE_REF).map(|field| match field.text() {
        Some(text) => text.chars().next().and_then(|digit| digit.to_digit(10)).map(f64::from),
        None => match field.numbers().first() {
            Some(Number::Value(reference)) => Some(*reference),
            _ => None,
        },
    });
    // 1 is below the sea level, 3 below the ellipsoid (Exif 3.0).
    let is_below =
        matches!(reference.flatten(), Some(reference) if reference == 1.0 || reference == 3.0);
    Some(if is_below { -value.abs() } else { value })
}

fn heading(fields: &[Field<'_>], warnings: &mut Vec<String>) -> Option<f64> {
    let heading = match single(fields, DIRECTION)? {
        Number::Value(value) if (0.0..=360.0).contains(&value) => value,
        // Counted from −180 to 180, as compasses of phones do.
        Number::Value(value) if (-360.0..0.0).contains(&value) => value + 360.0,
        _ => {
            warnings.push("the GPS heading is not between 0 and 360 degrees and left out".into());
            return None;
        }
    };
    let reference = text_of(fields, DIRECTION_REF).unwrap_or_default();
    if reference.eq_ignore_ascii_case("M") {
        warnings.push(
            "the GPS heading is from magnetic north; it is taken as it is, without the declination"
                .into(),
        );
    }
    Some(heading)
}
