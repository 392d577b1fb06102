//! Universal Transverse Mercator: metres in one of 60 zones of a hemisphere, to and from WGS84.
//!
//! The series of Krüger to the fourth order in the third flattening, as in Karney, *Transverse Mercator with an
//! accuracy of a few nanometers* (2011); errors are below a millimetre in a zone and its neighbours.

use std::fmt;

/// Equatorial radius of WGS84 in metres.
const A: f64 = 6_378_137.0;
/// Flattening of WGS84.
const F: f64 = 1.0 / 298.257_223_563;
/// Third flattening.
const N: f64 = F / (2.0 - F);
/// Scale on the central meridian.
const K0: f64 = 0.9996;
const FALSE_EASTING: f64 = 500_000.0;
const FALSE_NORTHING_SOUTH: f64 = 10_000_000.0;

/// Forward coefficients.
const ALPHA: [f64; 4] = [
    N / 2.0 - 2.0 / 3.0 * N * N + 5.0 / 16.0 * N * N * N + 41.0 / 180.0 * N * N * N * N,
    13.0 / 48.0 * N * N - 3.0 / 5.0 * N * N * N + 557.0 / 1440.0 * N * N * N * N,
    61.0 / 240.0 * N * N * N - 103.0 / 140.0 * N * N * N * N,
    49561.0 / 161_280.0 * N * N * N * N,
];

/// Inverse coefficients.
const BETA: [f64; 4] = [
    N / 2.0 - 2.0 / 3.0 * N * N + 37.0 / 96.0 * N * N * N - N * N * N * N / 360.0,
    N * N / 48.0 + N * N * N / 15.0 - 437.0 / 1440.0 * N * N * N * N,
    17.0 / 480.0 * N * N * N - 37.0 / 840.0 * N * N * N * N,
    4397.0 / 161_280.0 * N * N * N * N,
];

/// Radius of the rectifying sphere, times the scale.
const RADIUS: f64 =
    K0 * A / (1.0 + N) * (1.0 + N * N / 4.0 + N * N * N * N / 64.0 + N * N * N * N * N * N / 256.0);

/// A zone of a hemisphere, in which coordinates are in metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct UtmZone {
    number: u8,
    is_south: bool,
}

impl UtmZone {
    /// The zone with this number, 1 to 60, of a hemisphere.
    pub fn new(number: u8, is_south: bool) -> Option<Self> {
        (1..=60).contains(&number).then_some(Self { number, is_south })
    }

    /// The zone in which a position lies, without the exceptions of Norway and Svalbard.
    pub fn containing(lat: f64, lon: f64) -> Option<Self> {
        let number = ((lon + 180.0).rem_euclid(360.0) / 6.0).floor() + 1.0;
        // At most 60, and at least 1 unless the longitude is not a number.
        number.is_finite().then(|| Self { number: number.min(60.0) as u8, is_south: lat < 0.0 })
    }

    /// The zone of a northing whose letter may be a latitude band (C to X) or a hemisphere (N or S). `S` is both: the
    /// band from 32° to 40° north, unless the northing does not lie in it. `lat` is a latitude that is given as well.
    ///
    /// # Errors
    /// There is no such zone, or the letter contradicts the northing or the latitude.
    pub fn with_letter(
        number: u8,
        letter: char,
        northing: f64,
        lat: Option<f64>,
    ) -> Result<Self, UtmZoneError> {
        let of = |is_south| Self::new(number, is_south).ok_or(UtmZoneError::Unknown);
        let is_north = |lat: f64| lat >= 0.0;
        match letter.to_ascii_uppercase() {
            'N' if lat.is_none_or(is_north) => of(false),
            'N' => Err(UtmZoneError::Contradiction),
            'S' => {
                let in_band = of(false)?.is_in_band(northing, 'S');
                match lat.map_or(in_band, is_north) {
                    false => of(true),
                    true if in_band => of(false),
                    true => Err(UtmZoneError::Contradiction),
                }
            }
            letter => {
                let zone = of(band_start(letter).ok_or(UtmZoneError::Unknown)? < 0.0)?;
                let fits = zone.is_in_band(northing, letter)
                    && lat.is_none_or(|lat| is_north(lat) != zone.is_south);
                if fits { Ok(zone) } else { Err(UtmZoneError::Contradiction) }
            }
        }
    }

    /// Whether a northing lies in a latitude band, or so near to it that the series and the rounding of places may
    /// have moved it there.
    fn is_in_band(self, northing: f64, letter: char) -> bool {
        const MARGIN: f64 = 0.5;
        const LAST: f64 = 72.0;
        let Some(start) = band_start(letter) else { return false };
        let end = start + if start == LAST { 12.0 } else { 8.0 };
        let at = |lat: f64| self.to_metres(lat, self.central_meridian()).map(|(_, y)| y);
        let bounds = at(start - MARGIN).zip(at(end + MARGIN));
        bounds.is_some_and(|(low, high)| (low..=high).contains(&northing))
    }

    fn central_meridian(self) -> f64 {
        f64::from(self.number) * 6.0 - 183.0
    }

    fn false_northing(self) -> f64 {
        if self.is_south { FALSE_NORTHING_SOUTH } else { 0.0 }
    }

    /// Converts an easting and a northing in metres to latitude and longitude in degrees; `None` far outside
    /// the zone.
    pub fn to_degrees(self, easting: f64, northing: f64) -> Option<(f64, f64)> {
        let is_plausible =
            (-500_000.0..=1_500_000.0).contains(&easting) && (-1e7..=2e7).contains(&northing);
        if !is_plausible {
            return None;
        }
        let xi = (northing - self.false_northing()) / RADIUS;
        let eta = (easting - FALSE_EASTING) / RADIUS;
        let (mut xi_, mut eta_) = (xi, eta);
        for (beta, double) in BETA.iter().zip([2.0, 4.0, 6.0, 8.0]) {
            xi_ -= beta * (double * xi).sin() * (double * eta).cosh();
            eta_ -= beta * (double * xi).cos() * (double * eta).sinh();
        }
        let conformal = xi_.sin() / eta_.sinh().hypot(xi_.cos());
        let lat = tangent_of_latitude(conformal).atan().to_degrees();
        let lon = eta_.sinh().atan2(xi_.cos()).to_degrees() + self.central_meridian();
        let lon = if lon < -180.0 {
            lon + 360.0
        } else if lon > 180.0 {
            lon - 360.0
        } else {
            lon
        };
        (lat.is_finite() && lon.is_finite()).then_some((lat, lon))
    }

    /// Converts latitude and longitude in degrees to an easting and a northing in metres; `None` more than 30°
    /// from the central meridian.
    pub fn to_metres(self, lat: f64, lon: f64) -> Option<(f64, f64)> {
        let from_meridian = (lon - self.central_meridian() + 180.0).rem_euclid(360.0) - 180.0;
        if !(from_meridian.abs() <= 30.0 && lat.abs() <= 90.0) {
            return None;
        }
        let (lat, lon) = (lat.to_radians(), from_meridian.to_radians());
        let conformal = conformal(lat.tan());
        let xi_ = conformal.atan2(lon.cos());
        let eta_ = (lon.sin() / conformal.hypot(lon.cos())).asinh();
        let (mut xi, mut eta) = (xi_, eta_);
        for (alpha, double) in ALPHA.iter().zip([2.0, 4.0, 6.0, 8.0]) {
            xi += alpha * (double * xi_).sin() * (double * eta_).cosh();
            eta += alpha * (double * xi_).cos() * (double * eta_).sinh();
        }
        Some((FALSE_EASTING + RADIUS * eta, self.false_northing() + RADIUS * xi))
    }
}

/// Why a number and a letter are not the zone of a position.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum UtmZoneError {
    /// There is no such zone.
    #[error(
        "there is no such UTM zone: it has a number from 1 to 60 and a letter from C to X, but I and O"
    )]
    Unknown,
    /// The letter is of another part of the globe.
    #[error("the letter of the UTM zone contradicts the northing or the latitude")]
    Contradiction,
}

/// The southern end of a latitude band in degrees.
fn band_start(letter: char) -> Option<f64> {
    // I and O are no bands.
    let index = "CDEFGHJKLMNPQRSTUVWX".find(letter)?;
    Some(index as f64 * 8.0 - 80.0)
}

impl fmt::Display for UtmZone {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.number, if self.is_south { "south" } else { "north" })
    }
}

fn eccentricity() -> f64 {
    (F * (2.0 - F)).sqrt()
}

/// The tangent of the conformal latitude, from that of the latitude.
fn conformal(tangent: f64) -> f64 {
    let e = eccentricity();
    let root = tangent.hypot(1.0);
    let sigma = (e * (e * tangent / root).atanh()).sinh();
    tangent * sigma.hypot(1.0) - sigma * root
}

/// The inverse of [`conformal`], by Newton's method.
fn tangent_of_latitude(wanted: f64) -> f64 {
    let flat = 1.0 - F * (2.0 - F);
    let mut tangent = wanted;
    for _ in 0..5 {
        let root = tangent.hypot(1.0);
        let now = conformal(tangent);
        let slope = (1.0 + flat * tangent * tangent) / (flat * root * now.hypot(1.0));
        tangent += (wanted - now) * slope;
    }
    tangent
}

#[cfg(test)]
mod tests {
    use super::*;

    fn zone(number: u8, is_south: bool) -> UtmZone {
        UtmZone::new(number, is_south).unwrap()
    }

    /// Positions that the Python package `utm` 0.9 converted.
    const PLACES: [(f64, f64, u8, bool, f64, f64); 5] = [
        (40.4406, -79.9959, 17, false, 585156.962, 4477145.420),
        (37.75595, -122.50916, 10, false, 543236.996, 4178851.128),
        (-33.8568, 151.2153, 56, true, 334900.570, 6252288.753),
        (35.6595, 139.7005, 54, false, 382374.497, 3946960.800),
        (-27.4698, 153.0251, 56, true, 502479.869, 6961528.093),
    ];

    #[test]
    fn places_convert_as_in_another_implementation() {
        for (lat, lon, number, is_south, easting, northing) in PLACES {
            let zone = zone(number, is_south);
            assert_eq!(UtmZone::containing(lat, lon), Some(zone));
            let (x, y) = zone.to_metres(lat, lon).unwrap();
            assert!((x - easting).abs() < 0.01 && (y - northing).abs() < 0.01, "{x} {y}");
            let (back_lat, back_lon) = zone.to_degrees(easting, northing).unwrap();
            assert!((back_lat - lat).abs() < 1e-7 && (back_lon - lon).abs() < 1e-7);
        }
    }

    #[test]
    fn conversion_there_and_back_is_exact_to_a_millimetre() {
        for number in [1, 10, 33, 60] {
            for easting in [-100_000.0, 166_000.0, 500_000.0, 834_000.0] {
                for northing in [0.5, 1e6, 4_177_000.0, 7_900_000.0] {
                    let zone = zone(number, false);
                    let (lat, lon) = zone.to_degrees(easting, northing).unwrap();
                    assert!((-180.0..=180.0).contains(&lon), "{lon}");
                    let (x, y) = zone.to_metres(lat, lon).unwrap();
                    assert!((x - easting).abs() < 1e-3 && (y - northing).abs() < 1e-3);
                }
            }
        }
    }

    #[test]
    fn a_letter_is_a_band_or_a_hemisphere() {
        let of = |letter, northing| UtmZone::with_letter(10, letter, northing, None);
        assert_eq!(of('T', 4.4e6), Ok(zone(10, false)));
        assert_eq!(of('H', 6.2e6), Ok(zone(10, true)));
        assert_eq!(of('s', 4_178_900.0), Ok(zone(10, false)), "the band S");
        assert_eq!(of('S', 6_252_000.0), Ok(zone(10, true)), "south");
        assert_eq!(of('N', 100.0), Ok(zone(10, false)));
        for letter in ['A', 'I', 'o', 'Z', '1', 'é'] {
            assert_eq!(of(letter, 0.0), Err(UtmZoneError::Unknown), "{letter}");
        }
        assert_eq!(UtmZone::with_letter(0, 'T', 4.4e6, None), Err(UtmZoneError::Unknown));
        assert!(UtmZone::new(61, false).is_none());
    }

    #[test]
    fn a_band_that_contradicts_the_northing_or_the_latitude_is_refused() {
        // Berlin, 5.8 million metres north of the equator.
        for letter in "CDEFGJKLMPQRTVWX".chars() {
            let got = UtmZone::with_letter(33, letter, 5_820_000.0, None);
            assert_eq!(got, Err(UtmZoneError::Contradiction), "{letter}");
        }
        // As southern metres, 5.82 million are in the band H.
        for (letter, lat, is_south) in [
            ('U', Some(52.5), Some(false)),
            ('U', None, Some(false)),
            ('N', Some(52.5), Some(false)),
            ('S', Some(52.5), None),
            ('S', Some(-37.8), Some(true)),
            ('H', Some(52.5), None),
            ('H', Some(-37.8), Some(true)),
            ('U', Some(-37.8), None),
            ('N', Some(-37.8), None),
        ] {
            let got = UtmZone::with_letter(33, letter, 5_820_000.0, lat).ok();
            assert_eq!(got, is_south.map(|is_south| zone(33, is_south)), "{letter} {lat:?}");
        }
    }

    #[test]
    fn every_band_takes_the_places_in_it() {
        for (index, letter) in "CDEFGHJKLMNPQRSTUVWX".chars().enumerate() {
            for lat in [0.1, 4.0, 7.9].map(|up| index as f64 * 8.0 - 80.0 + up) {
                for lon in [12.1, 15.0, 17.9] {
                    let (_, northing) = zone(33, lat < 0.0).to_metres(lat, lon).unwrap();
                    for given in [None, Some(lat)] {
                        let got = UtmZone::with_letter(33, letter, northing, given);
                        assert_eq!(got, Ok(zone(33, lat < 0.0)), "{letter} {lat} {lon}");
                    }
                }
            }
        }
    }

    #[test]
    fn coordinates_far_outside_a_zone_are_refused() {
        assert_eq!(zone(10, false).to_degrees(9e7, 0.0), None);
        assert_eq!(zone(10, false).to_degrees(f64::NAN, 0.0), None);
        assert_eq!(zone(10, false).to_metres(0.0, 60.0), None);
        assert_eq!(zone(10, false).to_metres(f64::NAN, -123.0), None);
    }
}
