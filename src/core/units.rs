//! How settings write durations and limits: whole units in a key that names them, 0 for no limit.
//!
//! A field is `#[serde(rename = "timeout_s", with = "seconds")] timeout: Duration`.

use std::time::Duration;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

const HOUR: Duration = Duration::from_secs(3600);
const DAY: Duration = Duration::from_secs(24 * 3600);

/// A duration in seconds.
pub mod seconds {
    use super::*;

    /// Writes the whole seconds.
    pub fn serialize<S: Serializer>(duration: &Duration, to: S) -> Result<S::Ok, S::Error> {
        duration.as_secs().serialize(to)
    }

    /// Reads whole seconds.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Duration, D::Error> {
        u64::deserialize(from).map(Duration::from_secs)
    }
}

/// A duration in hours.
pub mod hours {
    use super::*;

    /// Writes the whole hours.
    pub fn serialize<S: Serializer>(duration: &Duration, to: S) -> Result<S::Ok, S::Error> {
        (duration.as_secs() / HOUR.as_secs()).serialize(to)
    }

    /// Reads whole hours.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Duration, D::Error> {
        u32::deserialize(from).map(|hours| HOUR * hours)
    }
}

/// A duration in days; 0 for no limit.
pub mod days_or_unlimited {
    use super::*;

    /// Writes the whole days.
    pub fn serialize<S: Serializer>(duration: &Option<Duration>, to: S) -> Result<S::Ok, S::Error> {
        duration.map_or(0, |duration| duration.as_secs() / DAY.as_secs()).serialize(to)
    }

    /// Reads whole days.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Duration>, D::Error> {
        u32::deserialize(from).map(|days| (days > 0).then(|| DAY * days))
    }
}

/// A number of things; 0 for no limit.
pub mod count_or_unlimited {
    use super::*;

    /// Writes the number.
    pub fn serialize<S: Serializer>(count: &Option<usize>, to: S) -> Result<S::Ok, S::Error> {
        count.unwrap_or(0).serialize(to)
    }

    /// Reads a number.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Option<usize>, D::Error> {
        usize::deserialize(from).map(|count| (count > 0).then_some(count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Settings {
        #[serde(rename = "timeout_s", with = "seconds")]
        timeout: Duration,
        #[serde(rename = "keep_hours", with = "hours")]
        keep: Duration,
        #[serde(with = "days_or_unlimited")]
        days: Option<Duration>,
        #[serde(with = "count_or_unlimited")]
        count: Option<usize>,
    }

    #[test]
    fn settings_are_written_as_they_are_read() {
        let unlimited = r#"{"timeout_s":90,"keep_hours":24,"days":0,"count":0}"#;
        let settings: Settings = serde_json::from_str(unlimited).unwrap();
        assert_eq!((settings.timeout, settings.keep), (Duration::from_secs(90), DAY));
        assert_eq!((settings.days, settings.count), (None, None));
        assert_eq!(serde_json::to_string(&settings).unwrap(), unlimited);
        let limited = r#"{"timeout_s":0,"keep_hours":0,"days":4294967295,"count":7}"#;
        let settings: Settings = serde_json::from_str(limited).unwrap();
        assert_eq!((settings.days, settings.count), (Some(DAY * u32::MAX), Some(7)));
        assert_eq!(serde_json::to_string(&settings).unwrap(), limited);
    }
}
