//! Prepared pictures that are kept for other pairs: the candidates of one job are often those of the next.

use std::collections::HashMap;

use parking_lot::Mutex;
use whereabouts_core::Digest;

use super::pictures::SentPicture;

/// Keeps prepared pictures by the digest of the original, within a number of bytes; the least recently used are dropped
/// first.
#[derive(Debug)]
pub(super) struct KeptPictures {
    max_bytes: usize,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// The pictures, and when each was last used.
    pictures: HashMap<Digest, (SentPicture, u64)>,
    bytes: usize,
    /// Counts uses, to order them.
    clock: u64,
}

impl KeptPictures {
    pub fn new(max_bytes: usize) -> Self {
        Self { max_bytes, state: Mutex::default() }
    }

    pub fn get(&self, original: &Digest) -> Option<SentPicture> {
        let mut state = self.state.lock();
        state.clock += 1;
        let now = state.clock;
        let (picture, last_used) = state.pictures.get_mut(original)?;
        *last_used = now;
        Some(picture.clone())
    }

    pub fn keep(&self, original: Digest, picture: SentPicture) {
        let bytes = picture.url.len();
        if bytes > self.max_bytes {
            return;
        }
        let mut state = self.state.lock();
        state.clock += 1;
        let now = state.clock;
        if let Some((old, _)) = state.pictures.insert(original, (picture, now)) {
            state.bytes -= old.url.len();
        }
        state.bytes += bytes;
        while state.bytes > self.max_bytes {
            state.drop_oldest();
        }
    }
}

impl State {
    /// Scans all pictures, of which there are hundreds, because each is 100 kB or more.
    fn drop_oldest(&mut self) {
        let oldest = self.pictures.iter().min_by_key(|(_, (_, used))| *used).map(|(key, _)| *key);
        if let Some((picture, _)) = oldest.and_then(|key| self.pictures.remove(&key)) {
            self.bytes -= picture.url.len();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(bytes: usize) -> SentPicture {
        SentPicture { url: "x".repeat(bytes).into(), tokens: 1 }
    }

    fn key(name: &[u8]) -> Digest {
        Digest::of(name)
    }

    #[test]
    fn the_least_recently_used_pictures_are_dropped_first() {
        let kept = KeptPictures::new(30);
        kept.keep(key(b"a"), picture(10));
        kept.keep(key(b"b"), picture(10));
        kept.keep(key(b"c"), picture(10));
        assert!(kept.get(&key(b"a")).is_some());
        kept.keep(key(b"d"), picture(10));
        assert!(kept.get(&key(b"a")).is_some() && kept.get(&key(b"b")).is_none());
        assert_eq!(kept.state.lock().bytes, 30);
        kept.keep(key(b"a"), picture(20));
        assert_eq!(kept.state.lock().bytes, 30);
    }

    #[test]
    fn what_is_larger_than_the_bound_is_not_kept() {
        let kept = KeptPictures::new(0);
        kept.keep(key(b"a"), picture(1));
        assert!(kept.get(&key(b"a")).is_none());
    }
}
