//! What is really written in a picture: the truth for readers of scene text.

use image::RgbImage;

use super::camera::Camera;
use super::facade::fascia_text;
use super::layout::{GroundFloor, Lot, PAVEMENT_HEIGHT, Street};

/// The least difference of two pixels, summed over the channels, by which letters show.
const CONTRAST: u16 = 24;

/// Letters that show in fewer pixels cannot be read by anyone.
const LEAST_PIXELS: usize = 8;

/// A sign board over a shop, as far as it is in a picture.
#[derive(Clone, Debug, PartialEq)]
pub struct VisibleSign {
    /// What is written on it.
    pub text: &'static str,
    /// Corners of the text in pixels: top left, top right, bottom right, bottom left. Some may be outside the picture.
    pub corners: [[f32; 2]; 4],
    /// Height of its letters in the middle, in pixels.
    pub letter_height: f32,
    /// Share of the letters within the picture that nothing covers, 0 to 1.
    pub uncovered: f32,
}

impl VisibleSign {
    /// Whether the whole text is within a picture.
    pub fn is_within(&self, width: u32, height: u32) -> bool {
        let inside = |[x, y]: [f32; 2]| {
            (0.0..=width as f32).contains(&x) && (0.0..=height as f32).contains(&y)
        };
        self.corners.into_iter().all(inside)
    }
}

/// The pixels of a picture that letters change.
#[derive(Clone, Debug)]
pub struct Letters {
    width: u32,
    height: u32,
    shown: Vec<bool>,
}

impl Letters {
    /// Compares a picture with the same one without any letters.
    pub(super) fn between(with: &RgbImage, without: &RgbImage) -> Self {
        let differs = |(a, b): (&image::Rgb<u8>, &image::Rgb<u8>)| {
            let channels = a.0.iter().zip(b.0);
            channels.map(|(a, b)| u16::from(a.abs_diff(b))).sum::<u16>() >= CONTRAST
        };
        let (width, height) = with.dimensions();
        Self { width, height, shown: with.pixels().zip(without.pixels()).map(differs).collect() }
    }

    /// How many pixels of letters are in the bounds of a quadrilateral.
    pub fn within(&self, corners: &[[f32; 2]; 4]) -> usize {
        let range = |axis: usize, end: u32| {
            let along = corners.map(|corner| corner[axis].clamp(0.0, end as f32));
            let least = along.iter().copied().fold(f32::INFINITY, f32::min);
            let most = along.iter().copied().fold(0.0, f32::max);
            least.floor() as usize..most.ceil() as usize
        };
        let (columns, rows) = (range(0, self.width), range(1, self.height));
        let in_row = |row: usize| {
            let start = row * self.width as usize;
            self.shown.get(start + columns.start..start + columns.end).unwrap_or_default()
        };
        rows.flat_map(in_row).filter(|shown| **shown).count()
    }
}

/// The signs over shops whose letters are in the picture of a camera, given the letters that show in it, and those that would
/// without people, vehicles, trees and what stands on the pavement.
pub(super) fn signs(
    street: &Street,
    camera: &Camera,
    shown: &Letters,
    uncovered: &Letters,
) -> Vec<VisibleSign> {
    let sign = |lot: &Lot| {
        let Lot::Built(building) = lot else { return None };
        let GroundFloor::Shop(brand) = building.ground else { return None };
        let (left, right, bottom, top) = fascia_text(building, brand.name);
        let pixel = |(u, v): (f32, f32)| {
            let (x, y, _) = camera.project(building.at.point(u, 0.0, PAVEMENT_HEIGHT + v))?;
            Some([x, y])
        };
        let corners = [
            pixel((left, top))?,
            pixel((right, top))?,
            pixel((right, bottom))?,
            pixel((left, bottom))?,
        ];
        let middle = (left + right) / 2.0;
        let letter_height = pixel((middle, bottom))?[1] - pixel((middle, top))?[1];
        let whole = uncovered.within(&corners);
        (whole >= LEAST_PIXELS).then(|| VisibleSign {
            text: brand.name,
            corners,
            letter_height,
            uncovered: (shown.within(&corners) as f32 / whole as f32).min(1.0),
        })
    };
    street.lots.iter().filter_map(sign).collect()
}
