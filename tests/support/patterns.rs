//! Pictures that a broken camera, a cable or a screen sends instead of a scene.

use image::{Rgb, RgbImage};

/// Colour bars of 640×480: the first row of bars, and two rows below them if it is a whole card.
pub fn colour_bars(card: bool) -> RgbImage {
    const BARS: [[u8; 3]; 8] = [
        [255; 3],
        [255, 255, 0],
        [0, 255, 255],
        [0, 255, 0],
        [255, 0, 255],
        [255, 0, 0],
        [0, 0, 255],
        [0; 3],
    ];
    RgbImage::from_fn(640, 480, |x, y| {
        let bar = (x / 80) as usize;
        Rgb(match y {
            320..360 if card => BARS[7 - bar],
            360.. if card => [[9; 3], [255; 3], [50, 0, 106], [19; 3]][bar / 2],
            _ => BARS[bar],
        })
    })
}
