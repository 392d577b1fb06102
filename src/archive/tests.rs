//! Archives that are complete, resumed, truncated, corrupted and forged.

use std::fs;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use tempfile::TempDir;
use uuid::Uuid;

use super::*;
use whereabouts_core::ExportedImage;
use whereabouts_core::{CoordinateFrame, Descriptor, DescriptorKind, Image, Map, Precision, Scene};

pub(super) fn map(name: &str) -> Map {
    Map {
        uid: Uuid::nil(),
        name: name.parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: CoordinateFrame::Wgs84,
        model: "m".into(),
        model_digest: Digest::of(b"m"),
        precision: Precision::Full,
        dim: 2,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: Timestamp::UNIX_EPOCH,
    }
}

pub(super) fn image(id: &str) -> (ExportedImage, Bytes) {
    let bytes = Bytes::from(format!("picture of {id}"));
    let image = Image {
        id: id.parse().unwrap(),
        digest: Digest::of(&bytes),
        pose: None,
        captured_at: None,
        tags: vec![],
        media_type: MediaType::Jpeg,
        width: 1,
        height: 1,
        created_at: Timestamp::UNIX_EPOCH,
    };
    let descriptor = Some(Descriptor::normalised(vec![1.0, 2.0]).unwrap());
    (ExportedImage { image, descriptor, position: Some(7), recording: None, texts: None }, bytes)
}

fn archived(name: &str, images: usize) -> ArchivedMap {
    let left_out = if name == "a" { vec![left_out()] } else { vec![] };
    ArchivedMap { name: name.parse().unwrap(), images, left_out }
}

/// An image that sorts between the two images of map a.
fn left_out() -> LeftOut {
    LeftOut { id: "1-damaged".parse().unwrap(), why: "damaged".into() }
}

fn names(names: &[&str]) -> Vec<MapName> {
    names.iter().map(|name| name.parse().unwrap()).collect()
}

fn add(writer: &mut Writer, map: &str, id: &str) {
    let (image, bytes) = image(id);
    writer.image(&map.parse().unwrap(), &image, &bytes).unwrap();
}

/// Writes an archive with two images in map a and one in map b.
fn write(dir: &TempDir) -> PathBuf {
    let path = dir.path().join("backup.tar");
    let mut writer = Writer::begin(&path, &Manifest::new(names(&["a", "b"]))).unwrap();
    writer.map(&map("a"), None).unwrap();
    add(&mut writer, "a", "1");
    writer.left_out(&"a".parse().unwrap(), &left_out()).unwrap();
    add(&mut writer, "a", "2");
    writer.map(&map("b"), None).unwrap();
    add(&mut writer, "b", "1");
    writer.finish(vec![archived("a", 2), archived("b", 1)]).unwrap();
    path
}

pub(super) fn read(path: &Path) -> Result<Vec<Item>, ArchiveError> {
    let (mut reader, mut items) = (Reader::open(path)?, Vec::new());
    while let Some(item) = reader.next_item()? {
        items.push(item);
    }
    Ok(items)
}

#[test]
fn an_archive_reads_back_what_was_written() {
    let dir = TempDir::new().unwrap();
    let path = write(&dir);
    assert!(!partial_path(&path).exists());
    let items = read(&path).unwrap();
    let images = items.iter().filter_map(|item| match item {
        Item::Image(image, bytes) => Some((image.clone(), bytes.clone())),
        _ => None,
    });
    assert_eq!(images.collect::<Vec<_>>(), [image("1"), image("2"), image("1")]);
    assert!(matches!(items.last(), Some(Item::End(end)) if end.entries == 10));
}

#[test]
fn a_corrupted_byte_is_detected() {
    let dir = TempDir::new().unwrap();
    let path = write(&dir);
    let bytes = fs::read(&path).unwrap();
    for at in (0..bytes.len()).step_by(7) {
        let mut damaged = bytes.clone();
        damaged[at] ^= 0x20;
        let path = dir.path().join("damaged.tar");
        fs::write(&path, damaged).unwrap();
        // The checksum does not cover end.json itself, whose timestamp a restore does not use.
        let in_last_entry = at > bytes.len() - 4 * BLOCK;
        assert!(read(&path).is_err() || in_last_entry, "byte {at}");
    }
}

#[test]
fn a_truncated_archive_is_rejected_and_can_be_resumed() {
    let dir = TempDir::new().unwrap();
    let path = write(&dir);
    let bytes = fs::read(&path).unwrap();
    for length in (0..bytes.len()).step_by(311) {
        let path = dir.path().join("cut.tar");
        fs::write(&path, &bytes[..length]).unwrap();
        assert!(read(&path).is_err(), "{length} bytes");

        fs::rename(&path, partial_path(&path)).unwrap();
        let Some((mut writer, _, resumed)) = Writer::resume(&path, &names(&["a", "b"])).unwrap()
        else {
            assert!(length < 2 * BLOCK, "{length} bytes");
            continue;
        };
        let last = resumed.last.as_ref().map(ImageId::as_str);
        let started: Vec<_> = resumed.maps.iter().map(|map| map.name.as_str()).collect();
        if started.is_empty() {
            writer.map(&map("a"), None).unwrap();
        }
        if started.len() < 2 {
            let rest = ["1", "1-damaged", "2"].into_iter();
            for id in rest.filter(|id| last.is_none_or(|last| *id > last)) {
                match id {
                    "1-damaged" => writer.left_out(&"a".parse().unwrap(), &left_out()).unwrap(),
                    id => add(&mut writer, "a", id),
                }
            }
            writer.map(&map("b"), None).unwrap();
        }
        if started.len() < 2 || last.is_none() {
            add(&mut writer, "b", "1");
        }
        writer.finish(vec![archived("a", 2), archived("b", 1)]).unwrap();
        assert_eq!(read(&path).unwrap().len(), 8);
    }
}

#[test]
fn a_backup_of_other_maps_is_not_resumed() {
    let dir = TempDir::new().unwrap();
    let path = write(&dir);
    fs::rename(&path, partial_path(&path)).unwrap();
    assert!(Writer::resume(&path, &names(&["a"])).unwrap().is_none());
}

#[test]
fn rewinding_discards_a_map() {
    let dir = TempDir::new().unwrap();
    let path = dir.path().join("backup.tar");
    let mut writer = Writer::begin(&path, &Manifest::new(names(&["a", "b"]))).unwrap();
    writer.map(&map("a"), None).unwrap();
    add(&mut writer, "a", "1");
    writer.left_out(&"a".parse().unwrap(), &left_out()).unwrap();
    let checkpoint = writer.checkpoint();
    writer.map(&map("b"), None).unwrap();
    add(&mut writer, "b", "1");
    writer.rewind(&checkpoint).unwrap();
    writer.finish(vec![archived("a", 1)]).unwrap();
    assert_eq!(read(&path).unwrap().len(), 5);
}

/// Writes a tar file of these entries with the tar library.
fn forged(path: &Path, entries: &[(tar::EntryType, &str, &[u8])]) {
    let mut tar = tar::Builder::new(fs::File::create(path).unwrap());
    for (kind, name, bytes) in entries {
        let mut header = tar::Header::new_ustar();
        header.set_entry_type(*kind);
        header.as_ustar_mut().unwrap().name[..name.len()].copy_from_slice(name.as_bytes());
        header.set_size(bytes.len() as u64);
        header.set_cksum();
        tar.append(&header, *bytes).unwrap();
    }
    tar.finish().unwrap();
}

#[test]
fn a_forged_archive_is_rejected() {
    let dir = TempDir::new().unwrap();
    let path = dir.path().join("forged.tar");
    let manifest = serde_json::to_vec(&Manifest::new(names(&["a"]))).unwrap();
    let regular = tar::EntryType::Regular;
    let first = (regular, MANIFEST, manifest.as_slice());
    let record = serde_json::to_vec(&map("a")).unwrap();
    let started = (regular, "maps/a/map.json", record.as_slice());
    let other = serde_json::to_vec(&map("b")).unwrap();
    let cases: &[&[(tar::EntryType, &str, &[u8])]] = &[
        &[],
        &[(regular, "picture.jpg", b"x")],
        &[(regular, MANIFEST, b"{}")],
        &[(tar::EntryType::Symlink, MANIFEST, b"")],
        &[first],
        &[first, (regular, "../../etc/passwd", b"x")],
        &[first, (regular, "/etc/passwd", b"x")],
        &[first, (tar::EntryType::Symlink, "maps/a/map.json", b"")],
        &[first, (tar::EntryType::GNUSparse, "maps/a/map.json", b"")],
        &[first, (regular, "maps/b/map.json", &other)],
        &[first, (regular, "maps/a/map.json", &other)],
        &[first, started, started],
        &[first, started, (regular, "maps/a/00.json", b"{}")],
    ];
    for (number, case) in cases.iter().enumerate() {
        forged(&path, case);
        assert!(read(&path).is_err(), "case {number}");
    }
    // A header that claims a terabyte, or 60 MB, followed by a few bytes.
    forged(&path, &[first, started]);
    let mut bytes = fs::read(&path).unwrap();
    let at = 2 * BLOCK;
    let mut header = tar::Header::from_byte_slice(&bytes[at..at + BLOCK]).clone();
    for (size, refused) in [(1 << 40, true), (60 << 20, false)] {
        header.set_size(size);
        header.set_cksum();
        bytes[at..at + BLOCK].copy_from_slice(header.as_bytes());
        fs::write(&path, &bytes).unwrap();
        let error = read(&path).unwrap_err();
        assert_eq!(matches!(error, ArchiveError::Refused(_)), refused, "{error}");
        assert_eq!(matches!(error, ArchiveError::Truncated(_)), !refused, "{error}");
    }
}
