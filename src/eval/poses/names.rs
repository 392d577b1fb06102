//! Positions in file names, as data sets of visual place recognition have them:
//! `@easting@northing@zone@letter@latitude@longitude@…@.jpg`. All fields behind the northing may be absent, and
//! any may be empty.

use std::path::Path;

use super::place::Place;
use crate::folder::is_picture_name;
use whereabouts_core::{GeographicPose, MetricPose, Pose, UtmZone, UtmZoneError};

/// Reads the position in the name of a file. The error says why a name that should have one does not.
pub(super) fn place_in_name(name: &str) -> Result<Option<Place>, &'static str> {
    let stem = match is_picture_name(Path::new(name)) {
        true => name.rsplit_once('.').map_or(name, |(stem, _)| stem),
        false => name,
    };
    let Some(fields) = stem.strip_prefix('@') else { return Ok(None) };
    let fields: Vec<&str> = fields.split('@').map(str::trim).collect();
    let field = |index: usize| fields.get(index).copied().unwrap_or("");
    let number = |index: usize| field(index).parse::<f64>().ok().filter(|value| value.is_finite());
    let geographic = number(4).zip(number(5)).and_then(|(lat, lon)| {
        let pose = GeographicPose { lat, lon, alt: None, heading: None };
        // Programs write 0, 0 where they know no position.
        let is_known = (lat, lon) != (0.0, 0.0) && Pose::Geographic(pose).checked().is_ok();
        is_known.then_some(pose)
    });
    let metric = number(0).zip(number(1)).and_then(|(x, y)| {
        let pose = MetricPose { x, y, z: None, qx: None, qy: None, qz: None, qw: None };
        Pose::Metric(pose).checked().ok().map(|_| pose)
    });
    let zone = match metric {
        Some(pose) => zone(field(2), field(3), pose, geographic)?,
        None => None,
    };
    match (metric, geographic) {
        (None, None) if fields.len() > 2 || stem.len() > 1 => Err(
            "its name begins with @, but has neither an easting and a northing nor a latitude and a longitude",
        ),
        (None, None) => Ok(None),
        // The degrees in names are often rounded more than the metres.
        _ => Ok(Some(Place { geographic: geographic.filter(|_| zone.is_none()), metric, zone })),
    }
}

/// The UTM zone of a name. A number alone may mean anything; with a letter, or with a latitude and a longitude, it
/// is a zone, and must be one.
fn zone(
    number: &str,
    letter: &str,
    pose: MetricPose,
    geographic: Option<GeographicPose>,
) -> Result<Option<UtmZone>, &'static str> {
    let digits = number.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let is_plausible = (0.0..=1e6).contains(&pose.x) && (0.0..=1e7).contains(&pose.y);
    let Some(number_of_zone) = digits.parse::<u8>().ok().filter(|_| is_plausible) else {
        return Ok(None);
    };
    let letters: Vec<char> = number[digits.len()..].chars().chain(letter.chars()).collect();
    let zone = match (&letters[..], geographic.map(|pose| pose.lat)) {
        ([], None) => return Ok(None),
        ([], Some(lat)) => UtmZone::new(number_of_zone, lat < 0.0).ok_or(UtmZoneError::Unknown),
        ([letter], lat) => UtmZone::with_letter(number_of_zone, *letter, pose.y, lat),
        // Words behind the northing are of another convention.
        _ if letters.len() > 2 => return Ok(None),
        _ => Err(UtmZoneError::Unknown),
    };
    zone.map(Some).map_err(|error| match error {
        UtmZoneError::Unknown => {
            "its name has no UTM zone behind the northing: a number from 1 to 60 and a letter from C to X, but I and O"
        }
        UtmZoneError::Contradiction => {
            "the letter of the UTM zone in its name contradicts the northing or the latitude there; bands from C to M \
             are south of the equator, from N to X north of it"
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(name: &str) -> Place {
        place_in_name(name).unwrap().unwrap_or_else(|| panic!("no place in {name}"))
    }

    fn zone_of(name: &str) -> Option<String> {
        place(name).zone.map(|zone| zone.to_string())
    }

    #[test]
    fn a_zone_that_does_not_exist_is_an_error_and_not_left_out() {
        for zone in ["10@I", "10@o", "99@S", "0@T", "1O@S", "10S@T", "61K@"] {
            assert!(place_in_name(&format!("@543270@4178900@{zone}@.jpg")).is_err(), "{zone}");
        }
        for other in ["", "7", "cam1@left", "2@left"] {
            assert_eq!(zone_of(&format!("@543270@4178900@{other}@.jpg")), None, "{other}");
        }
    }

    #[test]
    fn a_letter_that_contradicts_the_numbers_is_an_error() {
        for zone in [
            "33@K@",
            "33@K@52.5@13.4@",
            "33K@",
            "33@S@52.5@13.4@",
            "33@N@-33.8@13.4@",
            "33@T@",
            "33@H@52.5@13.4@",
        ] {
            let error = place_in_name(&format!("@391000@5820000@{zone}.jpg")).unwrap_err();
            assert!(error.contains("contradicts"), "{zone}: {error}");
        }
        for (zone, expected) in [
            ("33@U@", "33 north"),
            ("33@N@", "33 north"),
            ("33@U@0@0@", "33 north"),
            ("33@S@", "33 south"),
            ("33@H@", "33 south"),
        ] {
            let of = zone_of(&format!("@391000@5820000@{zone}.jpg"));
            assert_eq!(of.as_deref(), Some(expected), "{zone}");
        }
    }

    #[test]
    fn easting_northing_and_zone_are_read() {
        let place = place("@0584522.50@4477231.25@17@T@40.4@-80.0@p@0@060@@@@201311@@.jpg");
        let pose = place.metric.unwrap();
        assert_eq!((pose.x, pose.y), (584522.5, 4477231.25));
        assert_eq!((place.geographic, place.zone), (None, UtmZone::new(17, false)));
    }

    #[test]
    fn a_zone_is_read_only_where_it_is_one() {
        for (name, zone) in [
            ("@543250.96@4178900.70@10@S@.jpg", Some("10 north")),
            ("@543250.96@4178900.70@10S@.jpg", Some("10 north")),
            ("@334900.5@6252288.7@56@H@-33.85@151.2@.jpg", Some("56 south")),
            ("@334900.5@6252288.7@56@H@.jpg", Some("56 south")),
            ("@334900.5@6252288.7@56@S@.jpg", Some("56 south")),
            ("@334900.5@6252288.7@56@@-33.85@151.2@.jpg", Some("56 south")),
            ("@1000.0@5.0@12@.jpg", None),
            ("@1000.0@5.0@q@.jpg", None),
            ("@1000.0@5.0@.jpg", None),
            ("@1000.0@5.0@left@camera@.jpg", None),
            ("@-10.5@5.0@10@S@.jpg", None),
            ("@543250.96@4178900.70.jpg", None),
        ] {
            assert_eq!(zone_of(name).as_deref(), zone, "{name}");
        }
    }

    #[test]
    fn latitude_and_longitude_stand_in_for_empty_fields() {
        let place = place("@@@17@T@40.44@-79.99@p1@.jpg");
        assert_eq!((place.metric, place.zone), (None, None));
        assert_eq!(place.geographic.map(|pose| (pose.lat, pose.lon)), Some((40.44, -79.99)));
    }

    #[test]
    fn a_name_without_a_position_says_so() {
        assert_eq!(place_in_name("a.jpg"), Ok(None));
        for name in [
            "@.jpg",
            "@1@.jpg",
            "@x@y@.jpg",
            "@nan@1@.jpg",
            "@1e30@1@.jpg",
            "@5@@@@.jpg",
            "@@@17@T@91@-79.99@.jpg",
            "@@@17@T@0.0@0.0@.jpg",
            "@@@17@T@@@.jpg",
        ] {
            let is_place = matches!(place_in_name(name), Ok(Some(_)));
            assert!(!is_place, "{name}");
        }
        assert!(place_in_name("@5@@@@.jpg").is_err());
    }
}
