//! Preprocessing: from pixels to the input tensor described by a manifest.

use std::borrow::Cow;

use fast_image_resize::images::{TypedImage, TypedImageRef};
use fast_image_resize::pixels::U8x3;
use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions, Resizer};
use image::RgbImage;

use super::decode::Needed;
use super::manifest::{Input, Interpolation, Resize};

/// The input tensor of one picture: 3 × height × width, as RGB planes.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// `3 * height * width` numbers, plane by plane.
    pub data: Vec<f32>,
}

impl Tensor {
    /// A blank picture.
    pub(super) fn grey(width: usize, height: usize) -> Self {
        Self { height, width, data: vec![0.0; 3 * width * height] }
    }
}

/// A picture cannot be resized.
#[derive(Debug, thiserror::Error)]
#[error("cannot resize a picture of {width}×{height} pixels: {reason}")]
pub struct PreprocessError {
    width: u32,
    height: u32,
    reason: String,
}

/// The resolution needed to fit a picture to the input.
pub fn needed(input: &Input) -> Needed {
    match input.resize {
        Resize::LongestEdge => Needed::LongestEdge(input.width.max(input.height)),
        Resize::Squash | Resize::CentreCrop => Needed::Size(input.width, input.height),
    }
}

/// Fits a picture to the input with an antialiasing filter and normalises its channels.
///
/// `size` is the width and height of the picture in its file, from which the target shape is derived. `pixels` may
/// have a lower resolution, see [`needed`].
pub fn preprocess(
    pixels: &RgbImage,
    size: (u32, u32),
    input: &Input,
) -> Result<Tensor, PreprocessError> {
    let (width, height) = target_size(size, input);
    let resized = resize(pixels, width, height, input)?;
    let plane = width as usize * height as usize;
    let mut data = vec![0.0; 3 * plane];
    let (red, rest) = data.split_at_mut(plane);
    let (green, blue) = rest.split_at_mut(plane);
    // (x / 255 - mean) / std as one multiplication and one addition.
    let scale = input.std.map(|std| 1.0 / (255.0 * std));
    let offset = [0, 1, 2].map(|channel| -input.mean[channel] / input.std[channel]);
    let pixels = &resized[..3 * plane];
    for i in 0..plane {
        red[i] = f32::from(pixels[3 * i]) * scale[0] + offset[0];
        green[i] = f32::from(pixels[3 * i + 1]) * scale[1] + offset[1];
        blue[i] = f32::from(pixels[3 * i + 2]) * scale[2] + offset[2];
    }
    Ok(Tensor { height: height as usize, width: width as usize, data })
}

/// Scales a picture down so that neither edge exceeds `max_edge`. A smaller picture is returned unchanged.
pub fn shrink_to(pixels: &RgbImage, max_edge: u32) -> Result<RgbImage, PreprocessError> {
    let (width, height) = pixels.dimensions();
    let longest = width.max(height);
    if longest <= max_edge {
        return Ok(pixels.clone());
    }
    let scaled = |edge: u32| {
        let exact = f64::from(edge) * f64::from(max_edge) / f64::from(longest);
        (exact.round() as u32).max(1)
    };
    let (to_width, to_height) = (scaled(width), scaled(height));
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::CatmullRom));
    let buffer = run_resize(pixels, to_width, to_height, &options)?;
    RgbImage::from_raw(to_width, to_height, buffer)
        .ok_or_else(|| failure(pixels, "the resized buffer has the wrong size"))
}

fn target_size((width, height): (u32, u32), input: &Input) -> (u32, u32) {
    if input.resize != Resize::LongestEdge {
        return (input.width, input.height);
    }
    let longest = f64::from(input.width.max(input.height));
    let scale = longest / f64::from(width.max(height).max(1));
    let multiple = f64::from(input.multiple);
    let fit = |edge: u32| {
        let cells = (f64::from(edge) * scale / multiple).round().max(1.0);
        ((cells * multiple).min(longest)) as u32
    };
    (fit(width), fit(height))
}

fn resize<'a>(
    pixels: &'a RgbImage,
    width: u32,
    height: u32,
    input: &Input,
) -> Result<Cow<'a, [u8]>, PreprocessError> {
    if pixels.dimensions() == (width, height) {
        return Ok(Cow::Borrowed(pixels.as_raw()));
    }
    let filter = match input.interpolation {
        Interpolation::Bicubic => FilterType::CatmullRom,
        Interpolation::Bilinear => FilterType::Bilinear,
    };
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(filter));
    let options = match input.resize {
        Resize::CentreCrop => options.fit_into_destination(Some((0.5, 0.5))),
        Resize::Squash | Resize::LongestEdge => options,
    };
    Ok(run_resize(pixels, width, height, &options)?.into())
}

fn run_resize(
    pixels: &RgbImage,
    width: u32,
    height: u32,
    options: &ResizeOptions,
) -> Result<Vec<u8>, PreprocessError> {
    // The typed call compiles the filters for one pixel type instead of for all.
    let source =
        TypedImageRef::<U8x3>::from_buffer(pixels.width(), pixels.height(), pixels.as_raw())
            .map_err(|error| failure(pixels, &error.to_string()))?;
    let mut buffer = vec![0; width as usize * height as usize * 3];
    let mut canvas = TypedImage::<U8x3>::from_buffer(width, height, &mut buffer)
        .map_err(|error| failure(pixels, &error.to_string()))?;
    Resizer::new()
        .resize_typed(&source, &mut canvas, options)
        .map_err(|error| failure(pixels, &error.to_string()))?;
    Ok(buffer)
}

fn failure(pixels: &RgbImage, reason: &str) -> PreprocessError {
    PreprocessError { width: pixels.width(), height: pixels.height(), reason: reason.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    fn input(resize: Resize) -> Input {
        Input {
            name: "image".into(),
            width: 32,
            height: 16,
            resize,
            interpolation: Interpolation::Bicubic,
            multiple: 8,
            mean: [0.5, 0.0, 0.0],
            std: [0.5, 1.0, 1.0],
        }
    }

    #[test]
    fn channels_are_normalised_plane_by_plane() {
        let grey = RgbImage::from_pixel(32, 16, Rgb([255, 51, 0]));
        let tensor = preprocess(&grey, grey.dimensions(), &input(Resize::Squash)).unwrap();
        assert_eq!(tensor.data.len(), 3 * 32 * 16);
        let plane = |c: usize| tensor.data[c * 512];
        assert!((plane(0) - 1.0).abs() < 1e-6);
        assert!((plane(1) - 0.2).abs() < 1e-6);
        assert_eq!(plane(2), 0.0);
    }

    #[test]
    fn a_crop_keeps_the_centre_and_the_shape() {
        let mut wide = RgbImage::from_pixel(96, 16, Rgb([0, 0, 0]));
        for x in 32..64 {
            for y in 0..16 {
                wide.put_pixel(x, y, Rgb([0, 255, 0]));
            }
        }
        let tensor = preprocess(&wide, wide.dimensions(), &input(Resize::CentreCrop)).unwrap();
        assert!(tensor.data[512..1024].iter().all(|&green| green == 1.0));
    }

    #[test]
    fn the_longest_edge_bounds_a_picture_of_any_shape() {
        let shape = |width, height| target_size((width, height), &input(Resize::LongestEdge));
        assert_eq!(shape(640, 480), (32, 24));
        assert_eq!(shape(480, 640), (24, 32));
        assert_eq!(shape(10_000, 1), (32, 8));
        assert_eq!(shape(1, 1), (32, 32));
    }

    #[test]
    fn downsizing_averages_instead_of_skipping() {
        let stripes =
            RgbImage::from_fn(320, 160, |x, _| Rgb([if x % 2 == 0 { 0 } else { 255 }; 3]));
        let tensor = preprocess(&stripes, stripes.dimensions(), &input(Resize::Squash)).unwrap();
        assert!(tensor.data[512..].iter().all(|&value| (value - 0.5).abs() < 0.05));
    }

    #[test]
    fn shrinking_keeps_the_shape_and_never_enlarges() {
        let picture = RgbImage::new(400, 100);
        assert_eq!(shrink_to(&picture, 200).unwrap().dimensions(), (200, 50));
        assert_eq!(shrink_to(&picture, 800).unwrap().dimensions(), (400, 100));
        assert_eq!(shrink_to(&picture, 1).unwrap().dimensions(), (1, 1));
    }
}
