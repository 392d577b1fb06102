//! API keys: who may do what, in which maps, how often and until when.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use subtle::ConstantTimeEq;
use utoipa::ToSchema;

use super::digest::hex;
use super::map::display_as_written;
use super::{Digest, InvalidName, MapName};

/// What the holder of a key may do; each role may do what those before it may.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Localize frames, look at jobs by their id and at maps.
    Robot,
    /// Also list, cancel and retry jobs, and list, add and remove images.
    Operator,
    /// Everything: maps, keys, backups.
    Admin,
}

display_as_written!(Role { Robot => "robot", Operator => "operator", Admin => "admin" });

/// How much a key may ask for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct KeyLimits {
    /// Requests in a minute, at least 1; null for no bound.
    #[serde(default)]
    #[schema(nullable, minimum = 1)]
    pub requests_per_minute: Option<u32>,
    /// Bytes of bodies in a minute, at least 1; null for no bound.
    #[serde(default)]
    #[schema(nullable, minimum = 1)]
    pub bytes_per_minute: Option<u64>,
}

/// A key, without its secret.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ApiKey {
    /// Its id: the middle part of the key.
    pub id: String,
    /// What people call it.
    pub name: String,
    /// What its holder may do.
    pub role: Role,
    /// In which maps; in all, if there is none.
    pub maps: Vec<MapName>,
    /// How often.
    pub limits: KeyLimits,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it ends; null for never.
    #[schema(nullable)]
    pub expires_at: Option<Timestamp>,
    /// When it was revoked; null if it was not.
    #[schema(nullable)]
    pub revoked_at: Option<Timestamp>,
}

impl ApiKey {
    /// Whether it is good at that moment.
    pub fn is_valid(&self, now: Timestamp) -> bool {
        self.revoked_at.is_none() && self.expires_at.is_none_or(|end| now < end)
    }

    /// Whether its holder may use that map.
    pub fn may_use(&self, map: &MapName) -> bool {
        self.maps.is_empty() || self.maps.contains(map)
    }
}

/// A key as it is stored: the secret is known to its holder alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredKey {
    /// The key.
    #[serde(flatten)]
    pub key: ApiKey,
    /// The SHA-256 of its whole text. The secret is 256 random bits, so that no slow hash is needed.
    pub digest: Digest,
}

impl StoredKey {
    /// Whether this is the key; takes as long for a wrong one as for the right one.
    pub fn matches(&self, token: &Token) -> bool {
        token.digest().as_bytes().ct_eq(self.digest.as_bytes()).into()
    }
}

/// The text of a key: `wab_`, the id of 12 characters, `_`, and 64 hexadecimal digits of secret. It shows
/// itself in no log and no error.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// What every key begins with.
    pub const PREFIX: &str = "wab_";
    /// Characters of its id.
    pub const ID: usize = 12;
    const SECRET: usize = 64;

    /// The token of 38 random bytes.
    pub fn new(random: &[u8; 38]) -> Self {
        let digits = hex(random);
        let (id, secret) = digits.split_at(Self::ID);
        Self(format!("{}{id}_{secret}", Self::PREFIX))
    }

    /// The id of the key.
    pub fn id(&self) -> &str {
        &self.0[Self::PREFIX.len()..Self::PREFIX.len() + Self::ID]
    }

    /// The id that a text is, or the id of the key that it is.
    pub fn id_of(text: &str) -> Option<&str> {
        match parts(text) {
            Some((id, _)) => Some(id),
            None => (text.len() == Self::ID && is_hex(text)).then_some(text),
        }
    }

    /// What is stored of it.
    pub fn digest(&self) -> Digest {
        Digest::of(self.0.as_bytes())
    }

    /// The whole key, to be shown once.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl FromStr for Token {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        match parts(text) {
            Some(_) => Ok(Self(text.to_owned())),
            None => Err(InvalidName("this is no key: one begins with \"wab_\"".into())),
        }
    }
}

/// The id and the secret of a key.
fn parts(text: &str) -> Option<(&str, &str)> {
    let (id, secret) = text.strip_prefix(Token::PREFIX)?.split_once('_')?;
    let fit = (id.len(), secret.len()) == (Token::ID, Token::SECRET);
    (fit && is_hex(id) && is_hex(secret)).then_some((id, secret))
}

fn is_hex(text: &str) -> bool {
    text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'))
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}_…", Self::PREFIX, self.id())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn token(byte: u8) -> Token {
        Token::new(&[byte; 38])
    }

    #[test]
    fn a_token_reads_back_and_does_not_show_its_secret() {
        let token = token(0xa7);
        assert_eq!(token.reveal().parse(), Ok(token.clone()));
        assert_eq!(token.id(), "a7a7a7a7a7a7");
        assert_eq!(token.reveal().len(), 4 + 12 + 1 + 64);
        assert_eq!(format!("{token:?}"), "wab_a7a7a7a7a7a7_…");
        let long = format!("{}0", token.reveal());
        for text in
            ["", "wab_", "wab__", &long, &token.reveal()[1..], &token.reveal().to_uppercase()]
        {
            assert!(text.parse::<Token>().is_err(), "{text}");
        }
        assert!("wab_ä_".parse::<Token>().is_err());
        for text in [token.reveal(), token.id()] {
            assert_eq!(Token::id_of(text), Some(token.id()));
        }
        for text in ["", "../maps/vault", &token.id()[1..], "A7A7A7A7A7A7", &token.reveal()[1..]] {
            assert_eq!(Token::id_of(text), None, "{text}");
        }
    }

    #[test]
    fn a_key_ends_when_it_expires_or_is_revoked() {
        let at = |text: &str| text.parse::<Timestamp>().unwrap();
        let mut key = ApiKey {
            id: token(1).id().to_owned(),
            name: "n".into(),
            role: Role::Robot,
            maps: vec!["yard".parse().unwrap()],
            limits: KeyLimits::default(),
            created_at: at("2026-01-01T00:00:00Z"),
            expires_at: Some(at("2026-02-01T00:00:00Z")),
            revoked_at: None,
        };
        assert!(key.is_valid(at("2026-01-31T23:59:59Z")));
        assert!(!key.is_valid(at("2026-02-01T00:00:00Z")));
        assert!(key.may_use(&"yard".parse().unwrap()) && !key.may_use(&"town".parse().unwrap()));
        key.revoked_at = Some(at("2026-01-02T00:00:00Z"));
        assert!(!key.is_valid(at("2026-01-03T00:00:00Z")));
        let stored = StoredKey { key, digest: token(1).digest() };
        assert!(stored.matches(&token(1)) && !stored.matches(&token(2)));
    }

    #[test]
    fn a_role_may_do_what_those_before_it_may() {
        assert!(Role::Robot < Role::Operator && Role::Operator < Role::Admin);
    }
}
