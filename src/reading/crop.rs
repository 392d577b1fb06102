//! Straightens a line of text.

use image::imageops::{FilterType, resize, rotate90, rotate270};
use image::{Rgb, RgbImage};

use super::geometry::{Quad, distance};

/// Lines that are higher than wide by this factor run upwards or downwards.
const STEEP: f32 = 1.5;

/// A line at this height, its width in proportion but at most `widest`. A steep line may run upwards or downwards: it is
/// returned in both directions.
pub(super) fn straightened(
    picture: &RgbImage,
    quad: &Quad,
    height: u32,
    widest: u32,
) -> Vec<RgbImage> {
    let [a, b, c, d] = *quad;
    let across = distance(a, b).max(distance(d, c)).max(1.0);
    let down = distance(a, d).max(distance(b, c)).max(1.0);
    let (columns, rows) = (across as u32, down as u32);
    let upright = RgbImage::from_fn(columns, rows, |x, y| {
        // A rectangle of the detector is one in the picture too, but for the scales of both axes.
        let (s, t) = ((x as f32 + 0.5) / columns as f32, (y as f32 + 0.5) / rows as f32);
        let place = |axis: usize| {
            let (top, bottom) =
                (a[axis] + s * (b[axis] - a[axis]), d[axis] + s * (c[axis] - d[axis]));
            top + t * (bottom - top) - 0.5
        };
        sample(picture, place(0), place(1))
    });
    let turned = match down >= STEEP * across {
        true => vec![rotate270(&upright), rotate90(&upright)],
        false => vec![upright],
    };
    let ratio = |line: &RgbImage| f64::from(line.width()) / f64::from(line.height());
    let width =
        |line| (f64::from(height) * ratio(line)).ceil().clamp(1.0, f64::from(widest)) as u32;
    turned.iter().map(|line| resize(line, width(line), height, FilterType::Triangle)).collect()
}

/// Bilinear interpolation; beyond the edge, the nearest pixel.
fn sample(picture: &RgbImage, x: f32, y: f32) -> Rgb<u8> {
    let (width, height) = picture.dimensions();
    let pixel = |x: f32, y: f32| {
        let within = |place: f32, end: u32| place.clamp(0.0, end.saturating_sub(1) as f32) as u32;
        picture.get_pixel(within(x, width), within(y, height)).0.map(f32::from)
    };
    let (left, top) = (x.floor(), y.floor());
    let (s, t) = (x - left, y - top);
    let corners = [
        pixel(left, top),
        pixel(left + 1.0, top),
        pixel(left, top + 1.0),
        pixel(left + 1.0, top + 1.0),
    ];
    let weights = [(1.0 - s) * (1.0 - t), s * (1.0 - t), (1.0 - s) * t, s * t];
    Rgb(std::array::from_fn(|channel| {
        let mixed: f32 =
            corners.iter().zip(weights).map(|(corner, weight)| corner[channel] * weight).sum();
        mixed.round() as u8
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Red on the left, blue on the right.
    fn halves() -> RgbImage {
        RgbImage::from_fn(80, 40, |x, _| if x < 40 { Rgb([255, 0, 0]) } else { Rgb([0, 0, 255]) })
    }

    /// The colours at both ends of a line.
    fn ends(line: &RgbImage) -> [[u8; 3]; 2] {
        [5, line.width() - 6].map(|x| line.get_pixel(x, 24).0)
    }

    const RED_BLUE: [[u8; 3]; 2] = [[255, 0, 0], [0, 0, 255]];

    #[test]
    fn a_line_keeps_its_direction_and_proportion() {
        let quad = [[20.0, 10.0], [60.0, 10.0], [60.0, 30.0], [20.0, 30.0]];
        let lines = straightened(&halves(), &quad, 48, 1000);
        assert_eq!((lines.len(), lines[0].dimensions(), ends(&lines[0])), (1, (96, 48), RED_BLUE));
        assert_eq!(straightened(&halves(), &quad, 48, 50)[0].dimensions(), (50, 48), "at most 50");
    }

    #[test]
    fn a_steep_line_is_turned_both_ways() {
        let picture = image::imageops::rotate90(&halves());
        // Red is above.
        let quad = [[10.0, 20.0], [30.0, 20.0], [30.0, 60.0], [10.0, 60.0]];
        let lines = straightened(&picture, &quad, 48, 1000);
        assert!(lines.iter().all(|line| line.dimensions() == (96, 48)));
        let [red, blue] = RED_BLUE;
        assert_eq!([ends(&lines[0]), ends(&lines[1])], [[red, blue], [blue, red]]);
    }

    #[test]
    fn a_line_beyond_the_picture_has_the_colours_of_its_edge() {
        let quad = [[70.0, 30.0], [100.0, 30.0], [100.0, 60.0], [70.0, 60.0]];
        let lines = straightened(&halves(), &quad, 48, 1000);
        assert!(lines[0].pixels().all(|pixel| pixel.0 == [0, 0, 255]));
    }
}
