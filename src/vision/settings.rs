//! Settings of decoding and admission, and the value `"auto"` of other settings.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::admission::AdmissionSettings;
use super::batcher::Layout;
use super::decode::ImageLimits;

/// `[image]`
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageSettings {
    /// Maximum pixels of a picture.
    pub max_pixels: u64,
    /// Decoding threads; 0 for one per core.
    pub threads: usize,
    /// Maximum pictures in progress; 0 for as many as keep decoding and inference busy.
    pub permits: usize,
    /// Maximum waiting pictures.
    pub queue: usize,
    /// Maximum wait of a picture, in milliseconds.
    pub max_wait_ms: u64,
    /// Maximum `Retry-After`, in seconds.
    pub max_retry_after_s: u64,
    /// Whether a large JPEG is decoded at full resolution before it is scaled down.
    pub exact: bool,
}

impl ImageSettings {
    /// Returns why the settings are invalid, or `None` if they are valid.
    pub fn validate(&self) -> Option<String> {
        let at_least_one = [
            ("queue", self.queue as u64),
            ("max_wait_ms", self.max_wait_ms),
            ("max_retry_after_s", self.max_retry_after_s),
        ];
        let (key, _) = at_least_one.into_iter().find(|(_, value)| *value == 0)?;
        Some(format!("image.{key} must be at least 1"))
    }

    /// Limits on the size of a picture.
    pub fn limits(&self) -> ImageLimits {
        ImageLimits { max_pixels: self.max_pixels }
    }

    /// Number of decoding threads.
    pub fn decode_threads(&self) -> usize {
        threads_or_cores(self.threads)
    }

    /// Limits on pictures in progress and in the queue, for inference with this layout.
    pub fn admission(&self, layout: Layout) -> AdmissionSettings {
        let permits = match self.permits {
            // One picture per decoding thread, and decoded pictures for two rounds of inference.
            0 => self.decode_threads() + layout.capacity(),
            permits => permits,
        };
        AdmissionSettings {
            permits,
            queue: self.queue,
            max_wait: Duration::from_millis(self.max_wait_ms),
            max_retry_after: Duration::from_secs(self.max_retry_after_s),
        }
    }
}

/// Returns `threads`, or the number of cores if it is 0.
pub fn threads_or_cores(threads: usize) -> usize {
    match threads {
        0 => std::thread::available_parallelism().map_or(1, usize::from),
        threads => threads,
    }
}

/// Serializes `None` as `"auto"`, for `#[serde(with = "whereabouts_vision::auto")]`.
pub mod auto {
    use serde::de::{Error, IntoDeserializer};
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    const AUTO: &str = "auto";

    /// Serializes the value, or `"auto"` if there is none.
    pub fn serialize<T: Serialize, S: Serializer>(
        value: &Option<T>,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        match value {
            Some(value) => value.serialize(serializer),
            None => serializer.serialize_str(AUTO),
        }
    }

    /// Deserializes a value written as a string; `"auto"` becomes `None`.
    pub fn deserialize<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Option<T>, D::Error> {
        let text = String::deserialize(deserializer)?;
        if text == AUTO {
            return Ok(None);
        }
        let value = T::deserialize(text.into_deserializer());
        value.map(Some).map_err(|error: serde::de::value::Error| {
            D::Error::custom(format!("{error}, or `{AUTO}`"))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Provider;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Section {
        #[serde(with = "auto")]
        provider: Option<Provider>,
    }

    #[test]
    fn auto_is_none_and_an_unknown_value_is_an_error() {
        for (text, provider) in [
            ("provider = \"auto\"\n", None),
            ("provider = \"openvino\"\n", Some(Provider::OpenVino)),
        ] {
            let section: Section = toml::from_str(text).unwrap();
            assert_eq!(section, Section { provider });
            assert_eq!(toml::to_string(&section).unwrap(), text);
        }
        let error = toml::from_str::<Section>("provider = \"gpu\"").unwrap_err().to_string();
        assert!(error.contains("`cpu`") && error.contains("`auto`"), "{error}");
    }

    #[test]
    fn zero_permits_keep_decoding_and_inference_busy() {
        let settings = ImageSettings {
            max_pixels: 1,
            threads: 3,
            permits: 0,
            queue: 1,
            max_wait_ms: 1,
            max_retry_after_s: 1,
            exact: false,
        };
        let layout = Layout { threads: 4, sessions: 2, max_batch: 4 };
        assert_eq!(settings.admission(layout).permits, 3 + 2 * 2 * 4);
        assert_eq!(ImageSettings { permits: 7, ..settings.clone() }.admission(layout).permits, 7);
        assert_eq!(settings.validate(), None);
        let why = ImageSettings { queue: 0, ..settings }.validate().unwrap();
        assert_eq!(why, "image.queue must be at least 1");
    }
}
