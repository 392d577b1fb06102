//! What the server acknowledged to the clients, and which states are possible after a kill.

use std::collections::BTreeMap;

use super::clients::Random;

/// A map and an image in it.
pub type Key = (String, String);

/// Bytes of an image: the number of a picture.
pub type Picture = usize;

/// What is known of one image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fact {
    /// Acknowledged: the image has this picture, or does not exist.
    Acknowledged(Option<Picture>),
    /// A change was in flight at the kill: it may have been made or not.
    Either(Option<Picture>, Option<Picture>),
}

impl Fact {
    pub fn allows(self, found: Option<Picture>) -> bool {
        match self {
            Self::Acknowledged(picture) => picture == found,
            Self::Either(before, after) => found == before || found == after,
        }
    }
}

/// The record of one client. Clients change only images of their own.
#[derive(Debug, Default)]
pub struct Ledger {
    pub images: BTreeMap<Key, Fact>,
    pub jobs: Vec<String>,
    /// Number of acknowledged changes.
    pub acknowledged: usize,
}

impl Ledger {
    /// An image that certainly exists.
    pub fn some_present(&self, random: &mut Random) -> Option<Key> {
        let present: Vec<&Key> = self
            .images
            .iter()
            .filter(|(_, fact)| matches!(fact, Fact::Acknowledged(Some(_))))
            .map(|(key, _)| key)
            .collect();
        (!present.is_empty()).then(|| present[random.below(present.len())].clone())
    }

    /// Records that a change begins: until it is acknowledged, both states are possible.
    pub fn begin(&mut self, key: &Key, after: Option<Picture>) {
        let before = match self.images.get(key) {
            None => None,
            Some(Fact::Acknowledged(picture)) => *picture,
            Some(Fact::Either(..)) => panic!("{key:?} is changed before it is known"),
        };
        self.images.insert(key.clone(), Fact::Either(before, after));
    }

    /// Records that the server acknowledged a change.
    pub fn acknowledged(&mut self, key: &Key) {
        if let Some(Fact::Either(_, after)) = self.images.get(key).copied() {
            self.images.insert(key.clone(), Fact::Acknowledged(after));
            self.acknowledged += 1;
        }
    }

    /// Records that a map is deleted with all its images.
    pub fn map_deleted(&mut self, map: &str, acknowledged: bool) {
        for (_, fact) in self.images.iter_mut().filter(|((of, _), _)| of == map) {
            match *fact {
                _ if acknowledged => *fact = Fact::Acknowledged(None),
                Fact::Acknowledged(picture) => *fact = Fact::Either(picture, None),
                Fact::Either(..) => {}
            }
        }
    }

    /// After a restart: asserts that the state found is possible, and records it.
    pub fn settle(&mut self, found: &BTreeMap<Key, Picture>) {
        for (key, fact) in &mut self.images {
            let found = found.get(key).copied();
            assert!(fact.allows(found), "{key:?}: {found:?} was found, but {fact:?} was recorded");
            *fact = Fact::Acknowledged(found);
        }
        self.images.retain(|_, fact| *fact != Fact::Acknowledged(None));
    }
}
