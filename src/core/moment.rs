//! Times as clients send them: RFC 3339 and its common variants, and seconds since 1970.

use std::fmt;

use jiff::Timestamp;
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer};

/// A time that cannot be understood. The message says what can be sent instead.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{text:?} is not a time{why}; send RFC 3339 with an offset, such as 2026-05-01T12:00:00Z or \
     2026-05-01T14:00:00+02:00 (in a URL, write + as %2B), or seconds since 1970, such as 1777636800.25"
)]
pub struct InvalidMoment {
    text: String,
    why: &'static str,
}

/// Parses a time.
///
/// Accepted are RFC 3339 and ISO 8601 with an offset, also when the `+` of the offset became a space in a URL; and
/// a number since 1970 as ROS prints it: seconds with or without a fraction, or 13, 16 or 19 digits of milli-, micro-
/// or nanoseconds, which cannot be seconds.
pub fn parse(text: &str) -> Result<Timestamp, InvalidMoment> {
    let invalid = |why| InvalidMoment { text: text.chars().take(80).collect(), why };
    let trimmed = text.trim();
    if trimmed.bytes().all(|byte| byte.is_ascii_digit() || b"+-.".contains(&byte))
        && !trimmed.get(1..).unwrap_or("").contains(['-', '+'])
    {
        return number(trimmed).map_err(invalid);
    }
    let with_offset = match trimmed.rsplit_once(' ') {
        Some((time, offset)) if time.contains(':') && is_offset(offset) => {
            format!("{}+{offset}", time.trim_end())
        }
        Some((time, zone)) if ["utc", "gmt", "z"].contains(&zone.to_ascii_lowercase().as_str()) => {
            format!("{}Z", time.trim_end())
        }
        _ => trimmed.to_owned(),
    };
    with_offset.parse().map_err(|_| {
        let is_local = with_offset.parse::<jiff::civil::DateTime>().is_ok();
        invalid(if is_local { " with an offset from UTC" } else { "" })
    })
}

/// Whether a text is the offset of a time, without its sign: `02:00`, `0200` or `02`.
fn is_offset(text: &str) -> bool {
    let digits = text.bytes().filter(u8::is_ascii_digit).count();
    let colons = text.bytes().filter(|byte| *byte == b':').count();
    let hours = text.get(..2).and_then(|hours| hours.parse::<u8>().ok());
    matches!((digits, colons), (2, 0) | (4, 0 | 1))
        && digits + colons == text.len()
        && hours.is_some_and(|hours| hours <= 14)
}

/// Parses a number since 1970.
fn number(text: &str) -> Result<Timestamp, &'static str> {
    let (sign, digits) = match text.strip_prefix('-') {
        Some(digits) => (-1, digits),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let is_number = |part: &str| part.bytes().all(|byte| byte.is_ascii_digit());
    if whole.is_empty() || !is_number(whole) || !is_number(fraction) {
        return Err("");
    }
    // A date without separators would be taken for a day in 1970.
    if whole.len() == 8
        && fraction.is_empty()
        && (whole.starts_with("19") || whole.starts_with("20"))
    {
        return Err(" (a date needs a time of day and an offset)");
    }
    let unit_nanoseconds: i128 = match (whole.trim_start_matches('0').len(), fraction.len()) {
        (0..=11, _) => 1_000_000_000,
        (13, 0) => 1_000_000,
        (16, 0) => 1_000,
        (19, 0) => 1,
        _ => {
            return Err(
                " (a number has up to 11 digits of seconds, or 13, 16 or 19 of milli-, micro- or nanoseconds)",
            );
        }
    };
    let whole: i128 = whole.parse().map_err(|_| "")?;
    let nanoseconds = format!("{fraction:0<9}").get(..9).and_then(|digits| digits.parse().ok());
    let nanoseconds: i128 = nanoseconds.ok_or("")?;
    Timestamp::from_nanosecond(sign * (whole * unit_nanoseconds + nanoseconds))
        .map_err(|_| " between the years -9999 and 9999")
}

/// Reads an optional time of a request: text as [`parse`] reads it, a number of seconds since 1970, or the stamp of a
/// ROS message, `{"sec", "nanosec"}`.
pub fn optional<'de, D: Deserializer<'de>>(source: D) -> Result<Option<Timestamp>, D::Error> {
    source.deserialize_option(Optional)
}

/// Like [`optional`], and distinguishes null from an omitted field.
pub fn given<'de, D: Deserializer<'de>>(source: D) -> Result<Option<Option<Timestamp>>, D::Error> {
    optional(source).map(Some)
}

struct Optional;

impl<'de> Visitor<'de> for Optional {
    type Value = Option<Timestamp>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a time: RFC 3339 such as 2026-05-01T12:00:00Z, or seconds since 1970")
    }

    fn visit_none<E: Error>(self) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_unit<E: Error>(self) -> Result<Self::Value, E> {
        Ok(None)
    }

    fn visit_some<D: Deserializer<'de>>(self, source: D) -> Result<Self::Value, D::Error> {
        source.deserialize_any(Present).map(Some)
    }
}

struct Present;

impl<'de> Visitor<'de> for Present {
    type Value = Timestamp;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Optional.expecting(f)
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Timestamp, E> {
        parse(text).map_err(E::custom)
    }

    fn visit_u64<E: Error>(self, seconds: u64) -> Result<Timestamp, E> {
        parse(&seconds.to_string()).map_err(E::custom)
    }

    fn visit_i64<E: Error>(self, seconds: i64) -> Result<Timestamp, E> {
        parse(&seconds.to_string()).map_err(E::custom)
    }

    fn visit_f64<E: Error>(self, seconds: f64) -> Result<Timestamp, E> {
        // A double of today's time is exact to less than a microsecond.
        parse(&format!("{seconds:.6}")).map_err(E::custom)
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Timestamp, A::Error> {
        let stamp = Stamp::deserialize(serde::de::value::MapAccessDeserializer::new(map))?;
        Timestamp::new(stamp.sec, stamp.nanosec).map_err(A::Error::custom)
    }
}

/// The time stamp of a ROS message.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Stamp {
    #[serde(alias = "secs")]
    sec: i64,
    #[serde(alias = "nsecs", alias = "nsec")]
    nanosec: i32,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> String {
        parse(text).map_or_else(|error| error.to_string(), |moment| moment.to_string())
    }

    #[test]
    fn variants_of_rfc_3339_are_one_time() {
        for text in [
            "2026-05-01T12:00:00Z",
            "2026-05-01t12:00:00z",
            "2026-05-01 12:00:00Z",
            "2026-05-01T14:00:00+02:00",
            "2026-05-01T14:00:00 02:00",
            "2026-05-01 14:00:00 02:00",
            "2026-05-01T14:00:00 0200",
            "2026-05-01T14:00:00 02",
            "2026-05-01T14:00:00+0200",
            "2026-05-01T14:00:00+02",
            "2026-05-01T08:30:00-03:30",
            "2026-05-01T12:00:00.000Z",
            "2026-05-01 12:00:00 UTC",
            " 2026-05-01T12:00:00Z\n",
            "1777636800",
            "1777636800.0",
            "1777636800.000000000",
            "1777636800000",
            "1777636800000000",
            "1777636800000000000",
        ] {
            assert_eq!(parsed(text), "2026-05-01T12:00:00Z", "{text}");
        }
        assert_eq!(parsed("2026-05-01T14:00:00.25 02:00"), "2026-05-01T12:00:00.25Z");
    }

    #[test]
    fn seconds_keep_their_nanoseconds() {
        assert_eq!(parsed("1777636800.123456789"), "2026-05-01T12:00:00.123456789Z");
        assert_eq!(parsed("1777636800.5"), "2026-05-01T12:00:00.5Z");
        assert_eq!(parsed("0"), "1970-01-01T00:00:00Z");
        assert_eq!(parsed("12.345"), "1970-01-01T00:00:12.345Z");
        assert_eq!(parsed("-1.5"), "1969-12-31T23:59:58.5Z");
        assert_eq!(parsed("1777636800123456789"), "2026-05-01T12:00:00.123456789Z");
    }

    #[test]
    fn a_doubtful_time_is_refused_with_an_example() {
        for text in [
            "",
            "now",
            "2026-05-01",
            "2026-05-01T12:00:00",
            "2026-05-01 12:00:00",
            "2026:05:01 12:00:00",
            "20260501",
            "20260501120000",
            "177763680000",
            "1777636800.1.2",
            "1777636800,5",
            "1e9",
            "1.5e400",
            "-",
            ".5",
            "999999999999999999999999",
            "2026-13-01T12:00:00Z",
            "2026-05-01T12:00:00 2026",
        ] {
            let refused = parse(text).unwrap_err().to_string();
            assert!(refused.contains("such as 2026-05-01T12:00:00Z"), "{text}: {refused}");
        }
        let refused = parsed("2026-05-01T12:00:00");
        assert!(refused.contains("not a time with an offset from UTC"), "{refused}");
    }

    #[test]
    fn json_holds_text_numbers_or_the_stamp_of_a_ros_message() {
        #[derive(Deserialize)]
        struct Meta {
            #[serde(default, deserialize_with = "optional")]
            at: Option<Timestamp>,
        }
        let read = |json: &str| serde_json::from_str::<Meta>(json).map(|meta| meta.at);
        let noon: Timestamp = "2026-05-01T12:00:00Z".parse().unwrap();
        for json in [
            r#"{"at": "2026-05-01T12:00:00Z"}"#,
            r#"{"at": 1777636800}"#,
            r#"{"at": 1777636800.0}"#,
            r#"{"at": "1777636800"}"#,
            r#"{"at": 1777636800000}"#,
            r#"{"at": {"sec": 1777636800, "nanosec": 0}}"#,
            r#"{"at": {"secs": 1777636800, "nsecs": 0}}"#,
        ] {
            assert_eq!(read(json).unwrap(), Some(noon), "{json}");
        }
        assert_eq!(read(r#"{"at": null}"#).unwrap(), None);
        assert_eq!(read("{}").unwrap(), None);
        let quarter = read(r#"{"at": 1777636800.25}"#).unwrap().unwrap();
        assert_eq!(quarter.to_string(), "2026-05-01T12:00:00.25Z");
        for json in
            [r#"{"at": true}"#, r#"{"at": []}"#, r#"{"at": {"sec": 1}}"#, r#"{"at": 1e300}"#]
        {
            assert!(read(json).is_err(), "{json}");
        }
        let stamp = r#"{"at": {"sec": 1, "nanosec": 2000000000}}"#;
        assert!(read(stamp).is_err());
    }
}
