//! Both pictures of a pair in one, each with its name above it, for servers that take one picture in a request.

use image::{Rgb, RgbImage, imageops};

/// Space between the pictures, and height of the strip with their names, in pixels.
const GAP: u32 = 12;
const STRIP: u32 = 28;

/// How many pixels a dot of a letter is wide and high.
const DOT: u32 = 3;

const PAPER: Rgb<u8> = Rgb([255; 3]);
const INK: Rgb<u8> = Rgb([0; 3]);

/// Puts the frame to the left and the candidate to the right.
pub(super) fn side_by_side(frame: &RgbImage, candidate: &RgbImage) -> RgbImage {
    let right = frame.width() + GAP;
    let height = STRIP + frame.height().max(candidate.height());
    let mut both = RgbImage::from_pixel(right + candidate.width(), height, PAPER);
    for (left, name, picture) in [(0, "FRAME", frame), (right, "CANDIDATE", candidate)] {
        imageops::replace(&mut both, picture, left.into(), STRIP.into());
        write(&mut both, left, name, left + picture.width());
    }
    both
}

/// Writes a name into the strip, up to the column `end`.
fn write(picture: &mut RgbImage, left: u32, name: &str, end: u32) {
    let top = (STRIP - 7 * DOT) / 2;
    for (place, letter) in (0..).zip(name.chars()) {
        for (row, dots) in (0..).zip(dots(letter)) {
            for column in (0..5).filter(|column| dots >> (4 - column) & 1 == 1) {
                let x = left + (place * 6 + column + 1) * DOT;
                let y = top + row * DOT;
                for (x, y) in (0..DOT * DOT).map(|dot| (x + dot % DOT, y + dot / DOT)) {
                    if x < end && x < picture.width() && y < picture.height() {
                        picture.put_pixel(x, y, INK);
                    }
                }
            }
        }
    }
}

/// Returns the rows of a letter, five dots in each.
fn dots(letter: char) -> [u8; 7] {
    match letter {
        'A' => [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'C' => [0b01110, 0b10001, 0b10000, 0b10000, 0b10000, 0b10001, 0b01110],
        'D' => [0b11110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b11110],
        'E' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b11111],
        'F' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b10000],
        'I' => [0b01110, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
        'M' => [0b10001, 0b11011, 0b10101, 0b10101, 0b10001, 0b10001, 0b10001],
        'N' => [0b10001, 0b11001, 0b10101, 0b10011, 0b10001, 0b10001, 0b10001],
        'R' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10100, 0b10010, 0b10001],
        'T' => [0b11111, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100],
        _ => [0; 7],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_pictures_are_whole_and_named() {
        let frame = RgbImage::from_pixel(200, 100, Rgb([200, 0, 0]));
        let candidate = RgbImage::from_pixel(180, 140, Rgb([0, 0, 200]));
        let both = side_by_side(&frame, &candidate);
        assert_eq!(both.dimensions(), (200 + GAP + 180, STRIP + 140));
        let count = |wanted: Rgb<u8>| both.pixels().filter(|pixel| **pixel == wanted).count();
        assert_eq!(
            (count(frame.pixels().copied().next().unwrap()), count(Rgb([0, 0, 200]))),
            (200 * 100, 180 * 140)
        );
        let inked = |from: u32, to: u32| {
            (from..to).any(|x| (0..STRIP).any(|y| *both.get_pixel(x, y) == INK))
        };
        assert!(inked(0, 200) && inked(200 + GAP, 392));
        // The last letter of the name that is longest.
        assert!(inked(200 + GAP + 8 * 6 * DOT, 392));
    }

    #[test]
    fn a_name_is_cut_where_a_picture_is_narrow() {
        let narrow = RgbImage::new(10, 10);
        assert_eq!(side_by_side(&narrow, &narrow).dimensions(), (10 + GAP + 10, STRIP + 10));
    }
}
