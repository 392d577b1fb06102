//! Parsers of untrusted data. Each target returns whether it accepted its input, and checks the invariants of what
//! it accepted.

use std::collections::HashSet;
use std::io::Cursor;
use std::path::Path;

use axum::body::Body;
use axum::http::Request;
use tokio::runtime::{Builder, Runtime};
use whereabouts_archive::{Item, Reader};
use whereabouts_core::{CoordinateFrame, Pose, PoseInput};
use whereabouts_eval::{Folder, FolderPoses, PictureFile, TruthSource};
use whereabouts_index::SealedGraph;
use whereabouts_refine::mllm::{Labels, is_readable};
use whereabouts_server::http::is_picture_form;
use whereabouts_vision::ImageLimits;
use whereabouts_vision::decode::{Needed, decode};
use whereabouts_vision::exif::gps;
use whereabouts_vision::manifest::Manifest;

const LIMITS: ImageLimits = ImageLimits { max_pixels: 1 << 16 };

pub fn picture(bytes: &[u8]) -> bool {
    let all = decode(bytes, LIMITS, Needed::All);
    let some = decode(bytes, LIMITS, Needed::Size(16, 16));
    assert_eq!(all.is_ok(), some.is_ok());
    let Ok(picture) = all else { return false };
    let (width, height) = picture.pixels.dimensions();
    assert!(u64::from(width) * u64::from(height) <= LIMITS.max_pixels);
    true
}

pub fn manifest(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    let Ok(manifest) = Manifest::parse(text, Path::new("manifest.toml")) else { return false };
    let again = manifest.to_toml().unwrap();
    Manifest::parse(&again, Path::new("manifest.toml")).unwrap();
    true
}

pub fn graph(bytes: &[u8]) -> bool {
    let Ok(graph) = SealedGraph::from_bytes(bytes) else { return false };
    assert!(graph.to_bytes().len() <= bytes.len());
    true
}

pub fn archive(bytes: &[u8]) -> bool {
    let mut reader = Reader::new(Cursor::new(bytes));
    loop {
        match reader.next_item() {
            Ok(Some(Item::End(_))) => return true,
            Ok(Some(_)) => {}
            Ok(None) | Err(_) => return false,
        }
    }
}

fn folder() -> Folder {
    let names = ["a.jpg", "b.jpg", "c.jpg", "d/a b.jpg"];
    let pictures = names.map(|name| PictureFile { file: name.into(), id: name.parse().unwrap() });
    Folder { dir: ".".into(), pictures: pictures.into(), skipped: Vec::new() }
}

/// A file for a parser that takes a path.
fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), bytes).unwrap();
    file
}

pub fn poses(bytes: &[u8]) -> bool {
    if let Ok(pose) = serde_json::from_slice::<PoseInput>(bytes) {
        let posed =
            [CoordinateFrame::Wgs84, CoordinateFrame::Metric].map(|frame| pose.check(frame));
        let posed: Vec<Pose> = posed.into_iter().flatten().collect();
        posed.iter().for_each(usable);
        return !posed.is_empty();
    }
    let file = file(bytes);
    let folder = folder();
    let Ok(mut poses) = FolderPoses::read(&folder, Some(file.path())) else { return false };
    let account = poses.account().unwrap();
    let counted = account.matched + account.repeated + account.without_position;
    assert_eq!(counted + account.unmatched.len(), account.rows);
    for frame in [None, Some(CoordinateFrame::Wgs84), Some(CoordinateFrame::Metric)] {
        if frame.is_none_or(|frame| poses.convert_to(frame).is_ok()) {
            let found = folder.pictures.iter().filter_map(|one| poses.find(&one.id, b"").pose);
            found.for_each(|pose| usable(&pose));
        }
    }
    true
}

/// Asserts that a pose is in range, so that distances from it are finite.
fn usable(pose: &Pose) {
    assert!(pose.distance_m(pose).unwrap().abs() < 1e-3, "{pose:?}");
}

pub fn exif(bytes: &[u8]) -> bool {
    let Some(pose) = gps(bytes).pose else { return false };
    usable(&Pose::Geographic(pose));
    true
}

pub fn truth(bytes: &[u8]) -> bool {
    let (file, folder) = (file(bytes), folder());
    TruthSource::Listed(file.path().to_owned()).read(&folder, &folder).is_ok()
}

pub fn answer(bytes: &[u8]) -> bool {
    const CANDIDATES: usize = 10;
    let text = String::from_utf8_lossy(bytes);
    let labels = Labels::new((0..CANDIDATES).collect(), None);
    let Ok(verdict) = labels.parse(&text, false) else { return false };
    let once: HashSet<usize> = verdict.order.iter().copied().collect();
    assert!(once.len() == CANDIDATES && verdict.order.len() == CANDIDATES);
    assert!(once.iter().all(|&index| index < CANDIDATES));
    true
}

pub fn completion(bytes: &[u8]) -> bool {
    is_readable(bytes)
}

pub fn form(bytes: &[u8]) -> bool {
    thread_local! {
        static RUNTIME: Runtime = Builder::new_current_thread().build().unwrap();
    }
    let request = Request::post("/maps/m/images")
        .header("content-type", "multipart/form-data; boundary=XX")
        .body(Body::from(bytes.to_vec()))
        .unwrap();
    RUNTIME.with(|runtime| runtime.block_on(is_picture_form(request)))
}
