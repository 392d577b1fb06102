//! The town's pictures as files, with their poses on the globe.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use rayon::prelude::*;

use whereabouts_core::{GeographicPose, Pose};
use whereabouts_town::{Shot, Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;

/// Where the demo puts things.
pub struct Folders {
    /// Map images, and poses.csv.
    pub map: PathBuf,
    /// Frames.
    pub frames: PathBuf,
    /// Each frame beside its candidates.
    pub pictures: PathBuf,
    /// The server's data.
    pub data: PathBuf,
}

/// A frame whose true pose is known.
pub struct Frame {
    /// The picture.
    pub file: PathBuf,
    /// Where it was taken.
    pub pose: Pose,
    /// The light it was taken in.
    pub light: String,
}

/// Left in the folder, so that no other folder is ever cleared.
const MARK: &str = ".whereabouts-demo";

impl Folders {
    /// Empties the folder of an earlier demo, or makes a new one.
    pub fn fresh(out: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot use the folder {}", out.display());
        if out.join(MARK).is_file() {
            std::fs::remove_dir_all(out).with_context(cannot)?;
        } else if out.exists() && out.read_dir().with_context(cannot)?.next().is_some() {
            bail!("{} holds other things; name an empty or a new folder with --out", out.display());
        }
        let folders = Self {
            map: out.join("map"),
            frames: out.join("frames"),
            pictures: out.join("pictures"),
            data: out.join("data"),
        };
        for folder in [&folders.map, &folders.frames, &folders.pictures] {
            std::fs::create_dir_all(folder).with_context(cannot)?;
        }
        std::fs::write(out.join(MARK), "`whereabouts demo` replaces this folder\n")?;
        Ok(folders)
    }
}

/// Draws one map image and one frame of every place.
pub fn render(spec: TownSpec, folders: &Folders) -> anyhow::Result<Vec<Frame>> {
    let town = Town::new(spec);
    let places: Vec<(String, Frame)> = (0..town.places())
        .into_par_iter()
        .map(|place| -> anyhow::Result<_> {
            let reference = town.reference(place);
            let name = format!("place-{place:04}.jpg");
            std::fs::write(folders.map.join(&name), encode_jpeg(&reference.image)?)?;
            let query = town.query(place, 0);
            let file = folders.frames.join(format!("frame-{place:04}.jpg"));
            std::fs::write(&file, encode_jpeg(&query.image)?)?;
            let light = format!("{:?}", query.light).to_lowercase();
            let frame = Frame { file, pose: Pose::Geographic(on_globe(&query)), light };
            Ok((csv_row(&name, &on_globe(&reference)), frame))
        })
        .collect::<Result<_, _>>()?;
    let (rows, frames): (Vec<String>, Vec<Frame>) = places.into_iter().unzip();
    let csv = format!("file,lat,lon,heading\n{}\n", rows.join("\n"));
    std::fs::write(folders.map.join("poses.csv"), csv)?;
    Ok(frames)
}

fn csv_row(name: &str, pose: &GeographicPose) -> String {
    format!("{name},{:.7},{:.7},{:.1}", pose.lat, pose.lon, pose.heading.unwrap_or_default())
}

/// Lays the town's plane on the globe, at a place in the sea where no street is.
///
/// The plane touches the globe at the origin; across a town of a few kilometres the error is far
/// below a metre.
fn on_globe(shot: &Shot) -> GeographicPose {
    const ORIGIN: (f64, f64) = (45.0, -30.0);
    const METRES_PER_DEGREE: f64 = 111_195.0;
    let lat = ORIGIN.0 + shot.y / METRES_PER_DEGREE;
    let lon = ORIGIN.1 + shot.x / (METRES_PER_DEGREE * ORIGIN.0.to_radians().cos());
    GeographicPose { lat, lon, alt: None, heading: Some(shot.heading) }
}
