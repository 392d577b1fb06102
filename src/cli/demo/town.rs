//! Renders the town to image files, with geographic poses.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use rayon::prelude::*;

use whereabouts_core::{GeographicPose, Pose};
use whereabouts_town::{Shot, Town, TownSpec};
use whereabouts_vision::decode::encode_jpeg;

/// The folders of the demo.
pub struct DemoFolders {
    /// Map images, and poses.csv.
    pub map: PathBuf,
    /// Frames.
    pub frames: PathBuf,
    /// Each frame next to its candidates.
    pub pictures: PathBuf,
    /// The server's data.
    pub data: PathBuf,
}

/// A rendered frame with its true pose.
pub struct Frame {
    /// The image.
    pub file: PathBuf,
    /// Where it was taken.
    pub pose: Pose,
    /// The light that it was rendered in.
    pub light: String,
}

/// A file that marks a folder as the output of a demo. No other folder is ever emptied.
const MARKER: &str = ".whereabouts-demo";

impl DemoFolders {
    /// Returns the path of the picture that shows a frame next to its candidates.
    pub fn picture_of(&self, frame: &Frame) -> PathBuf {
        let name = frame.file.file_stem().unwrap_or_default();
        self.pictures.join(name).with_extension("png")
    }

    /// Creates the folder, and replaces one of an earlier demo.
    pub fn create(out: &Path) -> anyhow::Result<Self> {
        let cannot = || format!("cannot use the folder {}", out.display());
        if out.join(MARKER).is_file() {
            std::fs::remove_dir_all(out).with_context(cannot)?;
        } else if out.exists() && out.read_dir().with_context(cannot)?.next().is_some() {
            bail!(
                "{} is not empty and not the output of a demo; name another folder with --out",
                out.display()
            );
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
        std::fs::write(out.join(MARKER), "`whereabouts demo` replaces this folder\n")?;
        Ok(folders)
    }
}

/// Renders one map image and one frame of every place.
pub fn render(spec: TownSpec, folders: &DemoFolders) -> anyhow::Result<Vec<Frame>> {
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
            let frame = Frame { file, pose: Pose::Geographic(to_geographic(&query)), light };
            Ok((csv_row(&name, &to_geographic(&reference)), frame))
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

/// Projects the town's plane onto the globe, at a point in the ocean.
///
/// The plane is tangent to the globe at the origin; across a town of a few kilometres the error is far
/// below a metre.
fn to_geographic(shot: &Shot) -> GeographicPose {
    const ORIGIN: (f64, f64) = (45.0, -30.0);
    const METRES_PER_DEGREE: f64 = 111_195.0;
    let lat = ORIGIN.0 + shot.y / METRES_PER_DEGREE;
    let lon = ORIGIN.1 + shot.x / (METRES_PER_DEGREE * ORIGIN.0.to_radians().cos());
    GeographicPose { lat, lon, alt: None, heading: Some(shot.heading) }
}
