//! The records of images: by id the whole image, and by slot what searches need of it.
//!
//! A map is opened from the latter, which take a fraction of the bytes and can be read by several threads. Both change
//! in one transaction. Those by id are the image; those by slot follow from them, and `doctor` can write them again.

use std::ops::Range;

use serde::{Deserialize, Serialize};
use sled::Transactional;
use uuid::Uuid;

use super::super::StoreError;
use super::texts::gram_keys;
use super::trees::{
    BlobOwner, Trees, blob_ref_key, decode, encode, failed, get, image_key, transaction_failed,
};
use whereabouts_core::{GeographicPose, Image, ImageId, MetricPose, Pose, Recording};

/// An image and the slot of its descriptor.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct StoredImage {
    pub image: Image,
    pub slot: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recording: Option<Recording>,
}

/// What searches and tracks need of an image.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Entry {
    pub id: ImageId,
    pub pose: Option<Pose>,
    pub recording: Option<Recording>,
}

impl From<&StoredImage> for Entry {
    fn from(stored: &StoredImage) -> Self {
        let Image { id, pose, .. } = &stored.image;
        Self { id: id.clone(), pose: *pose, recording: stored.recording }
    }
}

/// The most numbers of a pose.
const NUMBERS: usize = 7;
const NO_POSE: u8 = 0;
const GEOGRAPHIC: u8 = 1;
const METRIC: u8 = 2;
/// Added to the kind of the pose of an image that belongs to a recording.
const RECORDED: u8 = 0x10;

impl Entry {
    /// The record in sled: the kind of the pose, a bit for each of its numbers that is known, these numbers
    /// (little-endian), the recording with the image's number in it, if there is one, and the id.
    pub fn to_bytes(&self) -> Vec<u8> {
        let (kind, numbers): (u8, &[Option<f64>]) = match &self.pose {
            None => (NO_POSE, &[]),
            Some(Pose::Geographic(GeographicPose { lat, lon, alt, heading })) => {
                (GEOGRAPHIC, &[Some(*lat), Some(*lon), *alt, *heading])
            }
            Some(Pose::Metric(MetricPose { x, y, z, qx, qy, qz, qw })) => {
                (METRIC, &[Some(*x), Some(*y), *z, *qx, *qy, *qz, *qw])
            }
        };
        let mut known = 0_u8;
        let mut bytes = Vec::with_capacity(2 + 8 * NUMBERS + 20 + self.id.as_str().len());
        bytes.extend([kind, 0]);
        for (bit, number) in numbers.iter().enumerate() {
            if let Some(number) = number {
                known |= 1 << bit;
                bytes.extend(number.to_le_bytes());
            }
        }
        bytes[1] = known;
        if let Some(Recording { id, number }) = &self.recording {
            bytes[0] |= RECORDED;
            bytes.extend(id.as_bytes());
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(self.id.as_str().as_bytes());
        bytes
    }

    /// Reads what [`Entry::to_bytes`] wrote; `None` if the bytes are anything else.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (&[kind, known], mut rest) = bytes.split_first_chunk()?;
        let mut numbers = [None; NUMBERS];
        for (bit, number) in numbers.iter_mut().enumerate() {
            if known & (1 << bit) != 0 {
                let (first, others) = rest.split_first_chunk()?;
                *number = Some(f64::from_le_bytes(*first));
                rest = others;
            }
        }
        let mut recording = None;
        if kind & RECORDED != 0 {
            let (id, others) = rest.split_first_chunk()?;
            let (number, others) = others.split_first_chunk()?;
            recording =
                Some(Recording { id: Uuid::from_bytes(*id), number: u32::from_le_bytes(*number) });
            rest = others;
        }
        let pose = match (kind & !RECORDED, numbers) {
            (NO_POSE, [None, ..]) => None,
            (GEOGRAPHIC, [Some(lat), Some(lon), alt, heading, ..]) => {
                Some(Pose::Geographic(GeographicPose { lat, lon, alt, heading }))
            }
            (METRIC, [Some(x), Some(y), z, qx, qy, qz, qw]) => {
                Some(Pose::Metric(MetricPose { x, y, z, qx, qy, qz, qw }))
            }
            _ => return None,
        };
        let id = std::str::from_utf8(rest).ok()?.parse().ok()?;
        Some(Self { id, pose, recording })
    }
}

impl Trees {
    /// Returns an image of a map.
    pub fn image(&self, map_uid: Uuid, id: &ImageId) -> Result<Option<StoredImage>, StoreError> {
        get(&self.images, &image_key(map_uid, id))
    }

    /// Iterates over the images of a map, by id.
    pub fn images_of(
        &self,
        map_uid: Uuid,
    ) -> impl Iterator<Item = Result<StoredImage, StoreError>> + use<> {
        self.images_after(map_uid, None)
    }

    /// Iterates over the images of a map whose ids sort after `after`, by id.
    pub fn images_after(
        &self,
        map_uid: Uuid,
        after: Option<&ImageId>,
    ) -> impl Iterator<Item = Result<StoredImage, StoreError>> + use<> {
        let start = match after {
            // The smallest key after the cursor's.
            Some(id) => [image_key(map_uid, id), vec![0]].concat(),
            None => map_uid.as_bytes().to_vec(),
        };
        self.images
            .range(start..)
            .take_while(move |entry| {
                entry.as_ref().map_or(true, |(key, _)| key.starts_with(map_uid.as_bytes()))
            })
            .map(|entry| decode(&entry.map_err(failed)?.1))
    }

    /// Returns the first slot beyond those of a map's images.
    pub fn slot_end(&self, map_uid: Uuid) -> Result<usize, StoreError> {
        let last = self.slots.scan_prefix(map_uid.as_bytes()).next_back();
        let last = last.transpose().map_err(failed)?;
        last.map_or(Ok(0), |(key, _)| Ok(slot_of(&key)? + 1))
    }

    /// Iterates over the images of a map in a range of slots, by slot.
    pub fn entries_in(
        &self,
        map_uid: Uuid,
        slots: Range<usize>,
    ) -> impl Iterator<Item = Result<(usize, Entry), StoreError>> + use<> {
        let keys = slot_key(map_uid, slots.start)..slot_key(map_uid, slots.end);
        self.slots.range(keys).map(|entry| {
            let (key, value) = entry.map_err(failed)?;
            Ok((slot_of(&key)?, Entry::from_bytes(&value).ok_or_else(damaged)?))
        })
    }

    /// Returns what searches need of the image in a slot.
    pub fn entry(&self, map_uid: Uuid, slot: usize) -> Result<Option<Entry>, StoreError> {
        let value = self.slots.get(slot_key(map_uid, slot)).map_err(failed)?;
        value.map(|value| Entry::from_bytes(&value).ok_or_else(damaged)).transpose()
    }

    /// Iterates over the slots of a map that list an image.
    pub fn slots_of(
        &self,
        map_uid: Uuid,
    ) -> impl Iterator<Item = Result<usize, StoreError>> + use<> {
        let keys = self.slots.scan_prefix(map_uid.as_bytes()).keys();
        keys.map(|key| slot_of(&key.map_err(failed)?))
    }

    /// Removes what is listed in a slot.
    pub fn forget_slot(&self, map_uid: Uuid, slot: usize) -> Result<(), StoreError> {
        self.slots.remove(slot_key(map_uid, slot)).map(drop).map_err(failed)
    }

    /// Writes again what searches need of an image.
    pub fn put_entry(&self, map_uid: Uuid, stored: &StoredImage) -> Result<(), StoreError> {
        let (key, value) = entry_record(map_uid, stored);
        self.slots.insert(key, value).map(drop).map_err(failed)
    }

    /// Stores a new image.
    pub fn insert_image(&self, map_uid: Uuid, stored: &StoredImage) -> Result<(), StoreError> {
        let key = image_key(map_uid, &stored.image.id);
        let owner = BlobOwner::Image { map_uid, id: &stored.image.id };
        let reference = blob_ref_key(&stored.image.digest, &owner);
        let value = encode(stored)?;
        let (slot, located) = entry_record(map_uid, stored);
        (&self.images, &self.slots, &self.blob_refs)
            .transaction(|(images, slots, refs)| {
                images.insert(key.as_slice(), value.as_slice())?;
                slots.insert(&slot, located.as_slice())?;
                refs.insert(reference.as_slice(), &[] as &[u8])?;
                Ok(())
            })
            .map_err(transaction_failed)
    }

    /// Replaces the record of an image, whose bytes and slot stay the same, and counts a changed pose.
    pub fn replace_image(
        &self,
        map_uid: Uuid,
        stored: &StoredImage,
        moved: bool,
    ) -> Result<(), StoreError> {
        let key = image_key(map_uid, &stored.image.id);
        let value = encode(stored)?;
        let (slot, located) = entry_record(map_uid, stored);
        let count = encode(&(self.moved(map_uid)? + u64::from(moved)))?;
        (&self.images, &self.slots, &self.moves)
            .transaction(|(images, slots, moves)| {
                images.insert(key.as_slice(), value.as_slice())?;
                if moved {
                    slots.insert(&slot, located.as_slice())?;
                    moves.insert(map_uid.as_bytes().as_slice(), count.as_slice())?;
                }
                Ok(())
            })
            .map_err(transaction_failed)
    }

    /// Removes images, what was read in them and their references to bytes.
    pub fn remove_images(&self, map_uid: Uuid, removed: &[StoredImage]) -> Result<(), StoreError> {
        (&self.images, &self.slots, &self.blob_refs, &self.texts, &self.text_grams)
            .transaction(|(images, slots, refs, texts, grams)| {
                for StoredImage { image, slot, .. } in removed {
                    images.remove(image_key(map_uid, &image.id))?;
                    slots.remove(&slot_key(map_uid, *slot))?;
                    let owner = BlobOwner::Image { map_uid, id: &image.id };
                    refs.remove(blob_ref_key(&image.digest, &owner))?;
                    let read = texts.remove(image_key(map_uid, &image.id))?;
                    for key in read.iter().flat_map(|read| gram_keys(map_uid, &image.id, read)) {
                        grams.remove(key)?;
                    }
                }
                Ok(())
            })
            .map_err(transaction_failed)
    }
}

fn entry_record(map_uid: Uuid, stored: &StoredImage) -> ([u8; 24], Vec<u8>) {
    (slot_key(map_uid, stored.slot), Entry::from(stored).to_bytes())
}

/// The key of a slot; the slots of a map sort by number.
fn slot_key(map_uid: Uuid, slot: usize) -> [u8; 24] {
    let mut key = [0; 24];
    key[..16].copy_from_slice(map_uid.as_bytes());
    key[16..].copy_from_slice(&(slot as u64).to_be_bytes());
    key
}

fn slot_of(key: &[u8]) -> Result<usize, StoreError> {
    let slot = key.last_chunk().map(|slot| u64::from_be_bytes(*slot));
    slot.and_then(|slot| usize::try_from(slot).ok()).ok_or_else(damaged)
}

fn damaged() -> StoreError {
    StoreError::Damaged(
        "the record of a slot cannot be read; `whereabouts doctor --repair` writes it again".into(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_and_every_kind_of_pose_are_read_as_they_were_written() {
        let geographic = GeographicPose { lat: 52.5, lon: -13.25, alt: None, heading: None };
        let metric =
            MetricPose { x: 1e-300, y: -0.0, z: None, qx: None, qy: None, qz: None, qw: None };
        let turned =
            MetricPose { qx: Some(0.0), qy: Some(0.6), qz: Some(0.0), qw: Some(0.8), ..metric };
        let poses = [
            None,
            Some(Pose::Geographic(geographic)),
            Some(Pose::Geographic(GeographicPose { alt: Some(7.0), ..geographic })),
            Some(Pose::Geographic(GeographicPose { heading: Some(359.9), ..geographic })),
            Some(Pose::Metric(metric)),
            Some(Pose::Metric(MetricPose { z: Some(f64::MAX), ..metric })),
            Some(Pose::Metric(turned)),
        ];
        let longest = "ü".repeat(ImageId::MAX_BYTES / 2);
        for pose in poses {
            for id in ["0", "a/b.jpg", longest.as_str()] {
                for recording in [None, Some(Recording { id: Uuid::from_u128(9), number: 300 })] {
                    let entry = Entry { id: id.parse().unwrap(), pose, recording };
                    assert_eq!(Entry::from_bytes(&entry.to_bytes()), Some(entry));
                }
            }
        }
    }

    #[test]
    fn damaged_records_are_refused() {
        let pose = Pose::Metric(MetricPose {
            x: 1.0,
            y: 2.0,
            z: None,
            qx: None,
            qy: None,
            qz: None,
            qw: None,
        });
        let recording = Some(Recording { id: Uuid::nil(), number: 1 });
        let sound = Entry { id: "a".parse().unwrap(), pose: Some(pose), recording }.to_bytes();
        for length in 0..sound.len() {
            assert_eq!(Entry::from_bytes(&sound[..length]), None, "{length} bytes");
        }
        let altered = |at: usize, byte: u8| {
            let mut bytes = sound.clone();
            bytes[at] = byte;
            Entry::from_bytes(&bytes)
        };
        assert_eq!(altered(0, 3), None, "an unknown kind of pose");
        assert_eq!(altered(0, RECORDED), None, "numbers without a pose");
        assert_eq!(altered(1, 0b01), None, "a pose without y");
        assert_eq!(altered(sound.len() - 1, 0xff), None, "an id that is not UTF-8");
    }

    #[test]
    fn the_slots_of_a_map_are_read_in_order_and_apart_from_those_of_others() {
        let dir = tempfile::tempdir().unwrap();
        let trees = Trees::open(dir.path(), 1 << 20).unwrap();
        let uids = [Uuid::from_u128(7), Uuid::from_u128(8)];
        for uid in uids {
            assert_eq!(trees.slot_end(uid).unwrap(), 0);
            for slot in [300, 2, 255, 256] {
                let id: ImageId = format!("{uid}-{slot}").parse().unwrap();
                let entry = Entry { id, pose: None, recording: None };
                trees.slots.insert(slot_key(uid, slot), entry.to_bytes()).unwrap();
            }
        }
        for uid in uids {
            assert_eq!(trees.slot_end(uid).unwrap(), 301);
            let read: Vec<_> = trees.entries_in(uid, 0..300).collect::<Result<_, _>>().unwrap();
            let slots: Vec<_> = read.iter().map(|(slot, _)| *slot).collect();
            assert_eq!(slots, [2, 255, 256]);
            assert!(read.iter().all(|(slot, one)| one.id.as_str() == format!("{uid}-{slot}")));
        }
    }
}
