//! What was read in images, and the index by which a search finds it.
//!
//! A record begins with the reader, whether it failed, and the number of lines, so that images can be counted without
//! reading the texts.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use async_trait::async_trait;
use sled::Transactional;
use uuid::Uuid;

use super::super::StoreError;
use super::trees::{Trees, decode, encode, failed, image_key, transaction_failed};
use super::{EmbeddedStore, blocking};
use crate::{TextCandidate, TextCounts, TextStore};
use whereabouts_core::text_search::grams;
use whereabouts_core::{Digest, Image, ImageId, ImageTexts, Map};

/// Bytes before the texts: a digest, a flag and a number.
const HEAD: usize = 32 + 1 + 4;

/// What a record begins with.
struct Head {
    reader: Digest,
    failed: bool,
    lines: usize,
}

impl Head {
    fn of(record: &[u8]) -> Option<Self> {
        let (reader, rest) = record.split_first_chunk::<32>()?;
        let (&failed, rest) = rest.split_first()?;
        let lines = u32::from_le_bytes(*rest.first_chunk()?) as usize;
        Some(Self { reader: Digest::from(*reader), failed: failed != 0, lines })
    }
}

fn to_record(texts: &ImageTexts) -> Result<Vec<u8>, StoreError> {
    let mut record = texts.reader.as_bytes().to_vec();
    record.push(u8::from(texts.error.is_some()));
    record.extend(u32::try_from(texts.lines.len()).unwrap_or(u32::MAX).to_le_bytes());
    record.extend(encode(texts)?);
    Ok(record)
}

fn from_record(record: &[u8]) -> Result<ImageTexts, StoreError> {
    decode(record.get(HEAD..).unwrap_or_default())
}

/// The keys of an image in the index of grams. A record that cannot be read has none: what is left of it in the index
/// is skipped by searches.
pub(super) fn gram_keys(map_uid: Uuid, id: &ImageId, record: &[u8]) -> Vec<Vec<u8>> {
    let texts = from_record(record).ok();
    let lines = texts.iter().flat_map(|texts| &texts.lines).map(|line| line.text.as_str());
    grams(lines).into_iter().map(|gram| gram_key(map_uid, gram, id)).collect()
}

fn gram_prefix(map_uid: Uuid, gram: u32) -> Vec<u8> {
    [map_uid.as_bytes().as_slice(), &gram.to_be_bytes()].concat()
}

fn gram_key(map_uid: Uuid, gram: u32, id: &ImageId) -> Vec<u8> {
    [gram_prefix(map_uid, gram).as_slice(), id.as_str().as_bytes()].concat()
}

impl Trees {
    /// Returns what was read in an image.
    pub fn read_texts(
        &self,
        map_uid: Uuid,
        id: &ImageId,
    ) -> Result<Option<ImageTexts>, StoreError> {
        let record = self.texts.get(image_key(map_uid, id)).map_err(failed)?;
        record.map(|record| from_record(&record)).transpose()
    }

    fn put_texts(&self, map_uid: Uuid, id: &ImageId, texts: &ImageTexts) -> Result<(), StoreError> {
        let (key, record) = (image_key(map_uid, id), to_record(texts)?);
        let added = gram_keys(map_uid, id, &record);
        (&self.texts, &self.text_grams)
            .transaction(|(texts, grams)| {
                let before = texts.insert(key.as_slice(), record.as_slice())?;
                for key in before.iter().flat_map(|before| gram_keys(map_uid, id, before)) {
                    grams.remove(key)?;
                }
                for key in &added {
                    grams.insert(key.as_slice(), &[] as &[u8])?;
                }
                Ok(())
            })
            .map_err(transaction_failed)
    }

    /// Whether a reader has tried to read an image.
    fn is_read(&self, map_uid: Uuid, id: &ImageId, reader: &Digest) -> Result<bool, StoreError> {
        let record = self.texts.get(image_key(map_uid, id)).map_err(failed)?;
        Ok(record.and_then(|record| Head::of(&record)).is_some_and(|head| head.reader == *reader))
    }

    /// Removes texts that belong to no image, and what the index has of them, and writes the index of the others again
    /// where it lacks something. Returns how many records had to be changed; with `repair` unset, how many would be.
    pub fn check_texts(&self, map_uids: &[Uuid], repair: bool) -> Result<usize, StoreError> {
        let mut wrong = 0;
        for entry in self.texts.iter() {
            let (key, record) = entry.map_err(failed)?;
            let owner = owner_of(&key, 16).filter(|(uid, _)| map_uids.contains(uid));
            let has_image = self.images.contains_key(&key).map_err(failed)?;
            let texts = from_record(&record).ok().filter(|_| Head::of(&record).is_some());
            match (owner, texts) {
                (Some((uid, id)), Some(texts)) if has_image => {
                    let keys = gram_keys(uid, &id, &record);
                    let mut lacks = false;
                    for key in keys {
                        lacks |= !self.text_grams.contains_key(key).map_err(failed)?;
                    }
                    if lacks && repair {
                        self.put_texts(uid, &id, &texts)?;
                    }
                    wrong += usize::from(lacks);
                }
                // Without its record, the image is read again.
                _ => {
                    if repair {
                        self.texts.remove(&key).map_err(failed)?;
                    }
                    wrong += 1;
                }
            }
        }
        for key in self.text_grams.iter().keys() {
            let key = key.map_err(failed)?;
            let texts = owner_of(&key, 20).map(|(uid, id)| image_key(uid, &id));
            let is_owned = match texts {
                Some(texts) => self.texts.contains_key(texts).map_err(failed)?,
                None => false,
            };
            if !is_owned {
                if repair {
                    self.text_grams.remove(&key).map_err(failed)?;
                }
                wrong += 1;
            }
        }
        Ok(wrong)
    }
}

/// The map and the image of a key in which the id begins at this byte.
fn owner_of(key: &[u8], id_at: usize) -> Option<(Uuid, ImageId)> {
    let uid = Uuid::from_slice(key.get(..16)?).ok()?;
    Some((uid, std::str::from_utf8(key.get(id_at..)?).ok()?.parse().ok()?))
}

#[async_trait]
impl TextStore for EmbeddedStore {
    async fn put_texts(
        &self,
        map: &Map,
        image: &Image,
        texts: ImageTexts,
    ) -> Result<bool, StoreError> {
        let (uid, image) = (map.uid, image.clone());
        let texts = texts.checked();
        let put = move |trees: &Trees| {
            let stored = trees.image(uid, &image.id)?;
            if stored.is_none_or(|stored| stored.image.digest != image.digest) {
                return Ok(false);
            }
            trees.put_texts(uid, &image.id, &texts).map(|()| true)
        };
        self.inner.writer.commit(move |trees, _| put(trees), |_| {}).await
    }

    async fn texts(
        &self,
        map: &Map,
        ids: &[ImageId],
    ) -> Result<Vec<Option<ImageTexts>>, StoreError> {
        let (inner, uid, ids) = (Arc::clone(&self.inner), map.uid, ids.to_vec());
        blocking(move || ids.iter().map(|id| inner.trees.read_texts(uid, id)).collect()).await
    }

    async fn unread(
        &self,
        map: &Map,
        reader: &Digest,
        after: Option<&ImageId>,
        limit: usize,
    ) -> Result<Vec<Image>, StoreError> {
        let (inner, uid, after) = (Arc::clone(&self.inner), map.uid, after.cloned());
        let reader = *reader;
        blocking(move || {
            let mut unread = Vec::new();
            for stored in inner.trees.images_after(uid, after.as_ref()) {
                if unread.len() >= limit {
                    break;
                }
                let image = stored?.image;
                if !inner.trees.is_read(uid, &image.id, &reader)? {
                    unread.push(image);
                }
            }
            Ok(unread)
        })
        .await
    }

    async fn text_counts(
        &self,
        map: &Map,
        reader: Option<&Digest>,
    ) -> Result<TextCounts, StoreError> {
        let (inner, uid, reader) = (Arc::clone(&self.inner), map.uid, reader.copied());
        blocking(move || {
            let mut counts = TextCounts::default();
            for record in inner.trees.texts.scan_prefix(uid.as_bytes()).values() {
                let record = record.map_err(failed)?;
                match Head::of(&record) {
                    Some(head) if reader.is_some_and(|reader| reader != head.reader) => {}
                    Some(Head { failed: true, .. }) => counts.failed += 1,
                    Some(Head { lines, .. }) => {
                        counts.read += 1;
                        counts.lines += lines;
                    }
                    None => {}
                }
            }
            Ok(counts)
        })
        .await
    }

    async fn text_candidates(
        &self,
        map: &Map,
        grams: &BTreeSet<u32>,
        limit: usize,
    ) -> Result<Vec<TextCandidate>, StoreError> {
        let (inner, uid, grams) = (Arc::clone(&self.inner), map.uid, grams.clone());
        blocking(move || {
            let mut shared: BTreeMap<Vec<u8>, usize> = BTreeMap::new();
            for gram in grams {
                for key in inner.trees.text_grams.scan_prefix(gram_prefix(uid, gram)).keys() {
                    let id = key.map_err(failed)?.get(20..).unwrap_or_default().to_vec();
                    *shared.entry(id).or_default() += 1;
                }
            }
            let mut found: Vec<(Vec<u8>, usize)> = shared.into_iter().collect();
            // Stable, so that those with as many stay in the order of ids.
            found.sort_by_key(|(_, shared)| std::cmp::Reverse(*shared));
            found.truncate(limit);
            let candidate = |(id, shared): (Vec<u8>, usize)| {
                let image = std::str::from_utf8(&id).ok()?.parse().ok()?;
                Some(TextCandidate { image, shared })
            };
            Ok(found.into_iter().filter_map(candidate).collect())
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use super::super::images::StoredImage;
    use super::super::test_records;
    use super::*;
    use whereabouts_core::TextLine;

    #[test]
    fn the_doctor_corrects_texts_that_do_not_fit_together() {
        let dir = tempfile::tempdir().unwrap();
        let trees = Trees::open(dir.path(), 1 << 20).unwrap();
        let map = test_records::map();
        let line =
            |text: &str| TextLine { text: text.into(), confidence: 1.0, corners: [[0.0; 2]; 4] };
        let texts = ImageTexts::read(Digest::of(b"reader"), vec![line("Bank")]);
        for (slot, id) in ["a", "b", "c"].into_iter().enumerate() {
            let image = test_records::image(id, id.as_bytes());
            trees.put_texts(map.uid, &image.id, &texts).unwrap();
            let stored = StoredImage { image, slot, recording: None };
            trees.insert_image(map.uid, &stored).unwrap();
        }
        let check = |repair| trees.check_texts(&[map.uid], repair).unwrap();
        assert_eq!(check(false), 0);
        let id = |id: &str| -> ImageId { id.parse().unwrap() };
        // One lacks a gram, one is damaged, and one has no image.
        let gram = *grams(["Bank"]).first().unwrap();
        trees.text_grams.remove(gram_key(map.uid, gram, &id("a"))).unwrap();
        trees.texts.insert(image_key(map.uid, &id("b")), b"damaged").unwrap();
        trees.images.remove(image_key(map.uid, &id("c"))).unwrap();
        assert_eq!(check(false), 3);
        assert!(check(true) >= 3);
        assert_eq!(check(false), 0);
        assert_eq!(trees.read_texts(map.uid, &id("a")).unwrap(), Some(texts));
        assert_eq!(trees.read_texts(map.uid, &id("b")).unwrap(), None);
        assert_eq!(trees.text_grams.len(), 3, "those of one image");
        assert_eq!(check_other(&trees), 4, "those of a map that is gone");
    }

    /// What is wrong if the map is not there: its texts, and its grams only once those are gone.
    fn check_other(trees: &Trees) -> usize {
        let wrong = trees.check_texts(&[Uuid::nil()], true).unwrap();
        assert!(trees.texts.is_empty() && trees.text_grams.is_empty());
        wrong
    }
}
