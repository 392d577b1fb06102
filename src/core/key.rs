//! API keys: role, permitted maps, rate limits and expiry.

use std::fmt;
use std::str::FromStr;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use subtle::ConstantTimeEq;
use utoipa::ToSchema;

use super::digest::hex;
use super::map::display_as_written;
use super::{Digest, InvalidName, MapName};

/// The role of a key. Each role includes the permissions of the roles before it.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, ToSchema,
)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// May localize frames, and read maps and single jobs.
    Robot,
    /// May also list, cancel and retry jobs, and list, add and remove images.
    Operator,
    /// Full access: maps, keys, backups.
    Admin,
}

display_as_written!(Role { Robot => "robot", Operator => "operator", Admin => "admin" });

/// Rate limits of a key.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct KeyLimits {
    /// Requests per minute, at least 1; null for unlimited.
    #[serde(default)]
    #[schema(nullable, minimum = 1)]
    pub requests_per_minute: Option<u32>,
    /// Bytes of request bodies per minute, at least 1; null for unlimited.
    #[serde(default)]
    #[schema(nullable, minimum = 1)]
    pub bytes_per_minute: Option<u64>,
}

/// An API key without its secret.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ApiKey {
    /// Id: the middle part of the key.
    pub id: String,
    /// Name for people.
    pub name: String,
    /// Role of the key.
    pub role: Role,
    /// Maps that the key may access; all maps if empty.
    pub maps: Vec<MapName>,
    /// Rate limits of the key.
    pub limits: KeyLimits,
    /// When the key was created.
    pub created_at: Timestamp,
    /// When the key expires; null for never.
    #[schema(nullable)]
    pub expires_at: Option<Timestamp>,
    /// When the key was revoked; null if it is not revoked.
    #[schema(nullable)]
    pub revoked_at: Option<Timestamp>,
}

impl ApiKey {
    /// Whether the key is neither revoked nor expired at `now`.
    pub fn is_valid(&self, now: Timestamp) -> bool {
        self.revoked_at.is_none() && self.expires_at.is_none_or(|end| now < end)
    }

    /// Whether the key may access the map.
    pub fn may_use(&self, map: &MapName) -> bool {
        self.maps.is_empty() || self.maps.contains(map)
    }
}

/// An API key as stored. The store keeps a digest, so the secret cannot be recovered from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StoredKey {
    /// The key.
    #[serde(flatten)]
    pub key: ApiKey,
    /// SHA-256 of the whole token. The secret has 256 random bits, so a slow password hash is not needed.
    pub digest: Digest,
}

impl StoredKey {
    /// Whether `token` is this key. Compares in constant time.
    pub fn matches(&self, token: &Token) -> bool {
        token.digest().as_bytes().ct_eq(self.digest.as_bytes()).into()
    }
}

/// The text of an API key: `wab_`, an id of 12 characters, `_`, and a secret of 64 hexadecimal digits.
/// `Debug` hides the secret.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// Prefix of every token.
    pub const PREFIX: &str = "wab_";
    /// Length of the id in characters.
    pub const ID: usize = 12;
    const SECRET: usize = 64;

    /// Builds a token from 38 random bytes.
    pub fn new(random: &[u8; 38]) -> Self {
        let digits = hex(random);
        let (id, secret) = digits.split_at(Self::ID);
        Self(format!("{}{id}_{secret}", Self::PREFIX))
    }

    /// The id of the key.
    pub fn id(&self) -> &str {
        &self.0[Self::PREFIX.len()..Self::PREFIX.len() + Self::ID]
    }

    /// Extracts the id from `text`, which is either a whole token or an id.
    pub fn id_of(text: &str) -> Option<&str> {
        match parts(text) {
            Some((id, _)) => Some(id),
            None => (text.len() == Self::ID && is_hex(text)).then_some(text),
        }
    }

    /// The digest under which the token is stored.
    pub fn digest(&self) -> Digest {
        Digest::of(self.0.as_bytes())
    }

    /// The whole token in plain text; shown to the user once.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl FromStr for Token {
    type Err = InvalidName;

    fn from_str(text: &str) -> Result<Self, InvalidName> {
        match parts(text) {
            Some(_) => Ok(Self(text.to_owned())),
            None => Err(InvalidName("not an API key: keys begin with \"wab_\"".into())),
        }
    }
}

/// Splits a token into its id and its secret.
fn parts(text: &str) -> Option<(&str, &str)> {
    let (id, secret) = text.strip_prefix(Token::PREFIX)?.split_once('_')?;
    let lengths_match = (id.len(), secret.len()) == (Token::ID, Token::SECRET);
    (lengths_match && is_hex(id) && is_hex(secret)).then_some((id, secret))
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
    fn a_token_parses_and_hides_its_secret() {
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
    fn a_key_is_invalid_once_expired_or_revoked() {
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
    fn roles_are_ordered_by_permission() {
        assert!(Role::Robot < Role::Operator && Role::Operator < Role::Admin);
    }
}
