//! Property tests: any archive reads back what was written, however often writing was interrupted.

use std::collections::BTreeMap;
use std::path::Path;

use bytes::Bytes;
use proptest::collection::{btree_map, vec};
use proptest::option;
use proptest::prelude::*;
use tempfile::TempDir;

use super::tests::{image, map, read};
use super::*;
use whereabouts_core::{Descriptor, ExportedImage, GeographicPose, Pose};

/// An image of a map, or the reason why it was left out.
#[derive(Debug, Clone)]
enum Saved {
    Image(Box<ExportedImage>, Bytes),
    LeftOut(String),
}

fn saved() -> impl Strategy<Value = Saved> {
    let coordinates = option::of((-90.0..=90.0_f64, -180.0..=180.0_f64));
    let descriptor = option::of([0.1_f32..1.0, -1.0..1.0_f32]);
    let image = (vec(any::<u8>(), 0..2000), coordinates, vec(".{0,20}", 0..3), descriptor)
        .prop_map(|(bytes, coordinates, tags, descriptor)| {
            let (mut exported, _) = image("replaced");
            let pose =
                coordinates.map(|(lat, lon)| GeographicPose { lat, lon, alt: None, heading: None });
            exported.image.pose = pose.map(Pose::Geographic);
            exported.image.digest = Digest::of(&bytes);
            exported.image.tags = tags;
            exported.descriptor =
                descriptor.map(|numbers| Descriptor::normalised(numbers.to_vec()).unwrap());
            Saved::Image(Box::new(exported), bytes.into())
        });
    prop_oneof![4 => image, 1 => ".{0,50}".prop_map(Saved::LeftOut)]
}

type Maps = BTreeMap<String, BTreeMap<String, Saved>>;

fn maps() -> impl Strategy<Value = Maps> {
    btree_map("[a-z][a-z0-9._-]{0,20}", btree_map("[!-~]{3,40}", saved(), 0..6), 0..4)
}

fn write_image(writer: &mut Writer, map: &MapName, id: &str, saved: &Saved) {
    match saved {
        Saved::Image(image, bytes) => {
            let mut image = image.as_ref().clone();
            image.image.id = id.parse().unwrap();
            writer.image(map, &image, bytes).unwrap();
        }
        Saved::LeftOut(why) => {
            let left_out = LeftOut { id: id.parse().unwrap(), why: why.clone() };
            writer.left_out(map, &left_out).unwrap();
        }
    }
}

fn summary(maps: &Maps) -> Vec<ArchivedMap> {
    let of_map = |(name, images): (&String, &BTreeMap<String, Saved>)| {
        let left_out = images.iter().filter_map(|(id, saved)| match saved {
            Saved::LeftOut(why) => Some(LeftOut { id: id.parse().unwrap(), why: why.clone() }),
            Saved::Image(..) => None,
        });
        let left_out: Vec<_> = left_out.collect();
        let images = images.len() - left_out.len();
        ArchivedMap { name: name.parse().unwrap(), images, left_out }
    };
    maps.iter().map(of_map).collect()
}

/// Writes all maps; drops and resumes the writer before every `restart_every`th image.
fn write(path: &Path, maps: &Maps, restart_every: Option<usize>) {
    let names: Vec<MapName> = maps.keys().map(|name| name.parse().unwrap()).collect();
    let mut writer = Writer::begin(path, &Manifest::new(names.clone())).unwrap();
    let mut written = 0;
    for (name, images) in maps {
        writer.map(&map(name), None).unwrap();
        for (id, saved) in images {
            written += 1;
            if restart_every.is_some_and(|every| written % every == 0) {
                drop(writer);
                writer = Writer::resume(path, &names).unwrap().unwrap().0;
            }
            write_image(&mut writer, &name.parse().unwrap(), id, saved);
        }
    }
    writer.finish(summary(maps)).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

    #[test]
    fn an_archive_reads_back_any_maps(maps in maps(), restart_every in option::of(1..5_usize)) {
        let dir = TempDir::new().unwrap();
        let path = dir.path().join("backup.tar");
        write(&path, &maps, restart_every);
        let mut items = read(&path).unwrap().into_iter();
        prop_assert!(matches!(items.next(), Some(Item::Manifest(_))));
        for (name, images) in &maps {
            let Some(Item::Map(read, None)) = items.next() else { panic!("a map was expected") };
            prop_assert_eq!(read, map(name));
            for (id, saved) in images {
                match (items.next(), saved) {
                    (Some(Item::Image(read, bytes)), Saved::Image(image, expected)) => {
                        let mut image = image.as_ref().clone();
                        image.image.id = id.parse().unwrap();
                        prop_assert_eq!(read, image);
                        prop_assert_eq!(&bytes, expected);
                    }
                    (Some(Item::LeftOut(read)), Saved::LeftOut(why)) => {
                        prop_assert_eq!((read.id.as_str(), &read.why), (id.as_str(), why));
                    }
                    (item, _) => panic!("{item:?} is not what was written for {id:?}"),
                }
            }
        }
        let Some(Item::End(end)) = items.next() else { panic!("the end was expected") };
        prop_assert_eq!(end.maps, summary(&maps));
        prop_assert!(items.next().is_none());
    }
}
