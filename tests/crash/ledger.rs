//! What the server acknowledged to the clients, and which states are possible after a kill.

use std::collections::BTreeMap;

use super::clients::Random;

/// A map and an image in it.
pub type Key = (String, String);

/// What is stored of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stored {
    /// The number of its picture.
    pub picture: usize,
    /// How often its pose was corrected, which is also the pose; 0 without a pose.
    pub pose: u32,
}

/// What is known of one image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fact {
    /// Acknowledged: the image is this, or does not exist.
    Acknowledged(Option<Stored>),
    /// A change was in flight at the kill: it may have been made or not.
    Either(Option<Stored>, Option<Stored>),
}

impl Fact {
    pub fn allows(self, found: Option<Stored>) -> bool {
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
    /// An image that certainly exists, and what is stored of it.
    pub fn some_present(&self, random: &mut Random) -> Option<(Key, Stored)> {
        let stored = |(key, fact): (&Key, &Fact)| match fact {
            Fact::Acknowledged(Some(stored)) => Some((key.clone(), *stored)),
            _ => None,
        };
        let present: Vec<_> = self.images.iter().filter_map(stored).collect();
        (!present.is_empty()).then(|| present[random.below(present.len())].clone())
    }

    /// Records that a change begins: until it is acknowledged, both states are possible.
    pub fn begin(&mut self, key: &Key, after: Option<Stored>) {
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
    pub fn settle(&mut self, found: &BTreeMap<Key, Stored>) {
        for (key, fact) in &mut self.images {
            let found = found.get(key).copied();
            assert!(fact.allows(found), "{key:?}: {found:?} was found, but {fact:?} was recorded");
            *fact = Fact::Acknowledged(found);
        }
        self.images.retain(|_, fact| *fact != Fact::Acknowledged(None));
    }
}
