//! The name of a kind of descriptor.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::InvalidName;

/// Longest name, in bytes.
const MAX: usize = 24;

/// The kind of global descriptor that a map compares: a name that the model's manifest declares, such as `gem`
/// (generalised mean over the local features), `cls` (`[CLS]` token of a transformer) or `vlad` (sums of residuals
/// to the centres of a vocabulary). 1 to 24 of `a-z 0-9 _ -`, starting with a letter.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(try_from = "String", into = "String")]
#[schema(value_type = String, example = "gem")]
pub struct DescriptorKind(
    /// The name in ASCII, padded with zeros. Inline, so that a kind is as cheap to pass as a number.
    [u8; MAX],
);

impl DescriptorKind {
    /// Generalised-mean pooling over the local features, which every model has.
    pub const GEM: Self = Self::padded(b"gem");
    /// The `[CLS]` token of a transformer.
    pub const CLS: Self = Self::padded(b"cls");

    const fn padded(text: &[u8]) -> Self {
        let mut name = [0; MAX];
        let mut at = 0;
        while at < text.len() {
            name[at] = text[at];
            at += 1;
        }
        Self(name)
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        let length = self.0.iter().position(|&b| b == 0).unwrap_or(MAX);
        // The name is ASCII, so this never falls back.
        std::str::from_utf8(&self.0[..length]).unwrap_or_default()
    }
}

impl FromStr for DescriptorKind {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        let allowed = |b: u8| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-');
        let starts = text.bytes().next().is_some_and(|b| b.is_ascii_lowercase());
        if text.len() > MAX || !starts || !text.bytes().all(allowed) {
            return Err(InvalidName(format!(
                "a kind of descriptor is 1 to {MAX} of a-z, 0-9, '_' and '-', starting with a letter, such as \
                 gem, cls or vlad; got {:?}",
                text.chars().take(80).collect::<String>()
            )));
        }
        Ok(Self::padded(text.as_bytes()))
    }
}

impl DescriptorKind {
    /// Whether a model may have a vocabulary for descriptors of this kind; its manifest says whether it has.
    pub fn may_have_vocabulary(self) -> bool {
        ![Self::GEM, Self::CLS].contains(&self)
    }
}

impl TryFrom<String> for DescriptorKind {
    type Error = InvalidName;

    fn try_from(text: String) -> Result<Self, InvalidName> {
        text.parse()
    }
}

impl From<DescriptorKind> for String {
    fn from(kind: DescriptorKind) -> Self {
        kind.as_str().to_owned()
    }
}

impl fmt::Display for DescriptorKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl fmt::Debug for DescriptorKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.as_str().fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_kind_is_written_as_its_name() {
        for name in ["gem", "cls", "vlad", "a", "gem-1x1_p4", &"a".repeat(MAX)] {
            let kind: DescriptorKind = name.parse().unwrap();
            assert_eq!((kind.as_str(), kind.to_string().as_str()), (name, name));
            let json = serde_json::to_string(&kind).unwrap();
            assert_eq!(json, format!("{name:?}"));
            assert_eq!(serde_json::from_str::<DescriptorKind>(&json).unwrap(), kind);
        }
        assert_eq!("gem".parse(), Ok(DescriptorKind::GEM));
        assert_eq!("cls".parse(), Ok(DescriptorKind::CLS));
    }

    #[test]
    fn a_name_that_no_manifest_can_declare_is_refused() {
        for name in ["", "GEM", "Gem", "1x1", "-a", "a b", "a.b", "a/b", "é", &"a".repeat(MAX + 1)]
        {
            let error = name.parse::<DescriptorKind>().unwrap_err().to_string();
            assert!(error.contains("gem, cls or vlad"), "{name}: {error}");
        }
    }
}
