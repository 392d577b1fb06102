//! One picture for each frame: the frame, the first candidate, and the first after refinement.

use std::path::PathBuf;

use anyhow::Context;
use image::{Rgb, RgbImage, imageops};
use rayon::prelude::*;

use super::Visit;
use super::account::Verdict;
use super::town::Folders;
use whereabouts_core::ImageId;

const WIDTH: u32 = 400;
const HEIGHT: u32 = 300;
const BORDER: u32 = 8;

const GREY: Rgb<u8> = Rgb([120, 120, 120]);
const GREEN: Rgb<u8> = Rgb([30, 160, 60]);
const RED: Rgb<u8> = Rgb([200, 40, 40]);

/// Writes `pictures/frame-….png` for every visit: grey border for the frame, green for a right
/// candidate, red for a wrong one.
pub fn side_by_side(visits: &[Visit], folders: &Folders) -> anyhow::Result<()> {
    visits.par_iter().try_for_each(|visit| {
        let verdict = Verdict::of(visit);
        let colour = |right: bool| if right { GREEN } else { RED };
        let mut panels = vec![(visit.frame.file.clone(), GREY)];
        if let Some(coarse) = visit.answer.candidates.first() {
            panels.push((map_picture(folders, &coarse.image_id), colour(verdict.before)));
        }
        if let Some(refined) = visit.job.ranking.as_ref().and_then(|ranking| ranking.first()) {
            panels.push((map_picture(folders, &refined.image_id), colour(verdict.after)));
        }
        let mut sheet =
            RgbImage::new(panels.len() as u32 * (WIDTH + 2 * BORDER), HEIGHT + 2 * BORDER);
        for (index, (file, colour)) in panels.iter().enumerate() {
            paint(&mut sheet, index as u32 * (WIDTH + 2 * BORDER), file, *colour)?;
        }
        let file = picture_of(visit, folders);
        sheet.save(&file).with_context(|| format!("cannot write {}", file.display()))
    })
}

/// Where the picture of a visit is.
pub fn picture_of(visit: &Visit, folders: &Folders) -> PathBuf {
    let name = visit.frame.file.file_stem().unwrap_or_default();
    folders.pictures.join(name).with_extension("png")
}

fn map_picture(folders: &Folders, id: &ImageId) -> PathBuf {
    folders.map.join(id.as_str())
}

fn paint(
    sheet: &mut RgbImage,
    left: u32,
    file: &std::path::Path,
    border: Rgb<u8>,
) -> anyhow::Result<()> {
    let picture = image::open(file).with_context(|| format!("cannot read {}", file.display()))?;
    let small =
        imageops::resize(&picture.into_rgb8(), WIDTH, HEIGHT, imageops::FilterType::Triangle);
    let frame = RgbImage::from_pixel(WIDTH + 2 * BORDER, HEIGHT + 2 * BORDER, border);
    imageops::replace(sheet, &frame, i64::from(left), 0);
    imageops::replace(sheet, &small, i64::from(left + BORDER), i64::from(BORDER));
    Ok(())
}
