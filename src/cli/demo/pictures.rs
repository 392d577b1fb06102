//! One picture per frame: the frame, the first candidate, and the first candidate after refinement.

use std::path::PathBuf;

use anyhow::Context;
use image::{Rgb, RgbImage, imageops};
use rayon::prelude::*;

use super::LocalizedFrame;
use super::report::Verdict;
use super::town::DemoFolders;
use whereabouts_core::ImageId;

const WIDTH: u32 = 400;
const HEIGHT: u32 = 300;
const BORDER: u32 = 8;

const GREY: Rgb<u8> = Rgb([120, 120, 120]);
const GREEN: Rgb<u8> = Rgb([30, 160, 60]);
const RED: Rgb<u8> = Rgb([200, 40, 40]);

/// Writes `pictures/frame-….png` for every frame. The frame has a grey border, a correct candidate a green
/// one, a wrong candidate a red one.
pub fn write_all(localized: &[LocalizedFrame], folders: &DemoFolders) -> anyhow::Result<()> {
    localized.par_iter().try_for_each(|localized| {
        let verdict = Verdict::of(localized);
        let colour = |correct: bool| if correct { GREEN } else { RED };
        let mut panels = vec![(localized.frame.file.clone(), GREY)];
        if let Some(coarse) = localized.answer.candidates.first() {
            panels.push((map_image(folders, &coarse.image_id), colour(verdict.before)));
        }
        if let Some(refined) = localized.job.ranking.as_ref().and_then(|ranking| ranking.first()) {
            panels.push((map_image(folders, &refined.image_id), colour(verdict.after)));
        }
        let mut sheet =
            RgbImage::new(panels.len() as u32 * (WIDTH + 2 * BORDER), HEIGHT + 2 * BORDER);
        for (index, (file, colour)) in panels.iter().enumerate() {
            paint(&mut sheet, index as u32 * (WIDTH + 2 * BORDER), file, *colour)?;
        }
        let file = folders.picture_of(&localized.frame);
        sheet.save(&file).with_context(|| format!("cannot write {}", file.display()))
    })
}

fn map_image(folders: &DemoFolders, id: &ImageId) -> PathBuf {
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
