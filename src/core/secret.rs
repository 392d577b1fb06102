//! A key that must not be seen.

use std::fmt;

use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// What stands where the key would.
const HIDDEN: &str = "[hidden]";

/// A key. It is shown neither by `Debug` nor when settings are written out; there is no `Display`.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// Takes a key; spaces and line ends around it are not part of it.
    pub fn new(key: &str) -> Self {
        Self(key.trim().to_owned())
    }

    /// Whether there is no key.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The key itself, for the one place that needs it.
    pub fn expose(&self) -> &str {
        &self.0
    }

    /// `text` without the key: servers like to repeat what they refuse.
    pub fn scrub(&self, text: &str) -> String {
        if self.0.is_empty() { text.to_owned() } else { text.replace(&self.0, HIDDEN) }
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.0.is_empty() { "none" } else { HIDDEN })
    }
}

impl Serialize for Secret {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(if self.0.is_empty() { "" } else { HIDDEN })
    }
}

impl<'de> Deserialize<'de> for Secret {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AnyKey)
    }
}

/// An environment variable of digits alone arrives as a number; as a key it is a text all the same.
struct AnyKey;

impl Visitor<'_> for AnyKey {
    type Value = Secret;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a key as text")
    }

    fn visit_str<E: Error>(self, key: &str) -> Result<Secret, E> {
        Ok(Secret::new(key))
    }

    fn visit_u64<E: Error>(self, key: u64) -> Result<Secret, E> {
        Ok(Secret(key.to_string()))
    }

    fn visit_i64<E: Error>(self, key: i64) -> Result<Secret, E> {
        Ok(Secret(key.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_shown_nowhere() {
        let key = Secret::new(" sk-very-secret\n");
        assert_eq!(format!("{key:?}"), "[hidden]");
        assert_eq!(serde_json::to_string(&key).unwrap(), "\"[hidden]\"");
        assert_eq!(key.scrub("bad key sk-very-secret!"), "bad key [hidden]!");
        assert_eq!(Secret::default().scrub("as it is"), "as it is");
    }

    #[test]
    fn a_key_of_digits_is_a_key() {
        let key: Secret = serde_json::from_str("12345").unwrap();
        assert_eq!(key, Secret::new("12345"));
        let key: Secret = serde_json::from_str("\"sk-1\"").unwrap();
        assert_eq!(key, Secret::new("sk-1"));
    }
}
