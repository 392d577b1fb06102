//! Pixels as the input of a model.

use image::RgbImage;

/// Writes a picture into a plane of blue, one of green and one of red, each of rows of `width` numbers: samples of 0 to
/// 1, minus the mean, divided by the deviation. What is right of a narrower picture stays as it is.
pub(super) fn fill(
    planes: &mut [f32],
    width: usize,
    picture: &RgbImage,
    mean: [f32; 3],
    std: [f32; 3],
) {
    let size = planes.len() / 3;
    for (x, y, pixel) in picture.enumerate_pixels() {
        let at = y as usize * width + x as usize;
        for plane in 0..3 {
            let sample = f32::from(pixel.0[2 - plane]) / 255.0;
            planes[plane * size + at] = (sample - mean[plane]) / std[plane];
        }
    }
}
