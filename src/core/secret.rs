//! Credentials that must not appear in logs or printed settings.

use std::fmt;

use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Placeholder printed instead of the secret.
const HIDDEN: &str = "[hidden]";

/// A credential. `Debug` and `Serialize` print a placeholder, and there is no `Display`.
#[derive(Clone, Default, PartialEq, Eq)]
pub struct Secret(String);

impl Secret {
    /// Wraps a credential, trimming surrounding whitespace.
    pub fn new(key: &str) -> Self {
        Self(key.trim().to_owned())
    }

    /// Whether no credential is set.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The credential in plain text, for the code that sends it.
    pub fn expose(&self) -> &str {
        &self.0
    }

    /// Replaces the credential in `text` by a placeholder; servers tend to echo a rejected key.
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
        deserializer.deserialize_any(SecretVisitor)
    }
}

/// Accepts numbers too: an environment variable that consists of digits is deserialized as a number.
struct SecretVisitor;

impl Visitor<'_> for SecretVisitor {
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
    fn a_secret_is_never_printed() {
        let key = Secret::new(" sk-very-secret\n");
        assert_eq!(format!("{key:?}"), "[hidden]");
        assert_eq!(serde_json::to_string(&key).unwrap(), "\"[hidden]\"");
        assert_eq!(key.scrub("bad key sk-very-secret!"), "bad key [hidden]!");
        assert_eq!(Secret::default().scrub("as it is"), "as it is");
    }

    #[test]
    fn a_secret_of_digits_is_accepted() {
        let key: Secret = serde_json::from_str("12345").unwrap();
        assert_eq!(key, Secret::new("12345"));
        let key: Secret = serde_json::from_str("\"sk-1\"").unwrap();
        assert_eq!(key, Secret::new("sk-1"));
    }
}
