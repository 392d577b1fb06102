//! Blank frames of many kinds, and scenes in good and bad conditions.

use image::{Rgb, RgbImage};
use whereabouts_testkit::patterns::colour_bars;

use super::*;
use crate::Manifest;
use crate::decode::{ImageLimits, Needed, decode, encode_jpeg};
use crate::preprocess::preprocess;

const LIMITS: ImageLimits = ImageLimits { max_pixels: 10_000_000 };
const SCENES: [&[u8]; 2] =
    [include_bytes!("../samples/street-day.jpg"), include_bytes!("../samples/street-night.jpg")];

fn measured(pixels: &RgbImage) -> Information {
    let manifest = include_str!("../../../deploy/models/xfeat.toml");
    let manifest = Manifest::parse(manifest, "xfeat.toml".as_ref()).unwrap();
    let tensor = preprocess(pixels, pixels.dimensions(), &manifest.input).unwrap();
    Information::of(&tensor, &manifest.input)
}

fn compressed(pixels: &RgbImage) -> RgbImage {
    decode(&encode_jpeg(pixels).unwrap(), LIMITS, Needed::All).unwrap().pixels
}

/// Numbers of the standard normal distribution, nearly: sums of twelve uniform ones.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (self.0 >> 40) as f32 / (1 << 24) as f32
    }

    fn normal(&mut self) -> f32 {
        (0..12).map(|_| self.uniform()).sum::<f32>() - 6.0
    }

    /// Adds noise to each pixel: the same to all channels, and less to each of them.
    fn over(&mut self, pixels: &RgbImage, sigma: f32) -> RgbImage {
        let mut noisy = pixels.clone();
        for pixel in noisy.pixels_mut() {
            let grey = self.normal() * sigma;
            pixel.0 =
                pixel.0.map(|value| (f32::from(value) + grey + self.normal() * sigma / 2.0) as u8);
        }
        noisy
    }
}

fn uniform(colour: [u8; 3]) -> RgbImage {
    RgbImage::from_pixel(640, 480, Rgb(colour))
}

fn changed(pixels: &RgbImage, change: impl Fn(f32) -> f32) -> RgbImage {
    let mut pixels = pixels.clone();
    pixels.pixels_mut().for_each(|p| p.0 = p.0.map(|value| change(f32::from(value)) as u8));
    pixels
}

#[track_caller]
fn assert_uninformative(name: &str, pixels: &RgbImage) {
    for (how, pixels) in [("as it is", pixels.clone()), ("as JPEG", compressed(pixels))] {
        let information = measured(&pixels);
        assert!(information.lack().is_some(), "{name}, {how}: {information:?}");
    }
}

#[test]
fn uniform_frames_of_any_colour_and_sensor_noise_are_uninformative() {
    for colour in [[0; 3], [255; 3], [128; 3], [0, 135, 0], [40, 0, 0], [200, 180, 20]] {
        assert_uninformative("uniform", &uniform(colour));
        for sigma in [1.0, 4.0, 12.0] {
            assert_uninformative("noisy", &Noise(7).over(&uniform(colour), sigma));
        }
    }
}

#[test]
fn gradients_and_vignettes_are_uninformative() {
    let shade = |f: fn(f32, f32) -> f32| {
        RgbImage::from_fn(640, 480, |x, y| {
            Rgb([(255.0 * f(x as f32 / 640.0, y as f32 / 480.0)) as u8; 3])
        })
    };
    for (name, pixels) in [
        ("horizontal", shade(|x, _| x)),
        ("vertical", shade(|_, y| y)),
        ("diagonal", shade(|x, y| (x + y) / 2.0)),
        ("vignette", shade(|x, y| 0.9 - 1.4 * ((x - 0.5).powi(2) + (y - 0.5).powi(2)))),
    ] {
        assert_uninformative(name, &pixels);
        assert_uninformative(name, &Noise(3).over(&pixels, 4.0));
    }
}

#[test]
fn noise_is_uninformative_at_any_size() {
    for (width, height) in [(640, 480), (320, 240), (160, 120), (1920, 1080), (64, 64)] {
        let mut noise = Noise(u64::from(width));
        let coloured = RgbImage::from_fn(width, height, |_, _| {
            Rgb([0; 3].map(|_: u8| (noise.uniform() * 255.0) as u8))
        });
        assert_uninformative("coloured noise", &coloured);
        let grey =
            RgbImage::from_fn(width, height, |_, _| Rgb([(noise.uniform() * 255.0) as u8; 3]));
        assert_uninformative("grey noise", &grey);
    }
}

#[test]
fn pictures_of_a_few_pixels_are_uninformative() {
    let checks = |width, height| {
        RgbImage::from_fn(width, height, |x, y| Rgb([255 * ((x + y) % 2) as u8; 3]))
    };
    for (width, height) in [(1, 1), (2, 2), (1, 2), (3, 2), (1, 1000), (1000, 1)] {
        let information = measured(&checks(width, height));
        assert!(information.lack().is_some(), "{width}×{height}: {information:?}");
    }
}

#[test]
fn fog_darkness_and_defocus_beyond_recognition_are_uninformative() {
    for scene in SCENES {
        let scene = decode(scene, LIMITS, Needed::All).unwrap().pixels;
        let fog = changed(&scene, |value| 0.02 * value + 0.98 * 200.0);
        assert_uninformative("fog", &Noise(5).over(&fog, 2.0));
        assert_uninformative("darkness", &changed(&scene, |value| 0.02 * value));
        let blurred = image::imageops::blur(&scene, scene.width() as f32 / 12.0);
        assert_uninformative("defocus", &blurred);
    }
}

#[test]
fn scenes_are_informative_in_good_and_bad_conditions() {
    for scene in SCENES {
        let scene = decode(scene, LIMITS, Needed::All).unwrap().pixels;
        let dim = changed(&scene, |value| 0.2 * value);
        let haze = changed(&scene, |value| 0.3 * value + 0.7 * 220.0);
        let small = image::imageops::thumbnail(&scene, 64, 48);
        let noisy = Noise(9).over(&scene, 12.0);
        let soft = image::imageops::blur(&scene, scene.width() as f32 / 200.0);
        for (name, pixels) in [
            ("as it is", scene),
            ("dim", dim),
            ("haze", haze),
            ("small", small),
            ("noisy", noisy),
            ("soft", soft),
        ] {
            let information = measured(&pixels);
            assert_eq!(information.lack(), None, "{name}: {information:?}");
        }
    }
}

fn shaded(value: impl Fn(u32, u32) -> f32) -> RgbImage {
    RgbImage::from_fn(640, 480, |x, y| Rgb([value(x, y) as u8; 3]))
}

fn is_odd(number: u32) -> f32 {
    255.0 * (number % 2) as f32
}

#[test]
fn stripes_checkerboards_colour_bars_and_rings_are_uninformative() {
    let mut patterns =
        vec![("bars".to_owned(), colour_bars(false)), ("card".into(), colour_bars(true))];
    for size in [3, 4, 8, 16, 20, 24, 32, 40, 60, 64] {
        patterns.extend([
            (format!("columns of {size}"), shaded(|x, _| is_odd(x / size))),
            (format!("rows of {size}"), shaded(|_, y| is_odd(y / size))),
            (format!("diagonals of {size}"), shaded(|x, y| is_odd((x + y) / size))),
            (format!("squares of {size}"), shaded(|x, y| is_odd(x / size + y / size))),
        ]);
    }
    for period in [8.0, 20.0] {
        let ring = |x: u32, y: u32| (x as f32 - 320.0).hypot(y as f32 - 240.0) / period;
        patterns.push(("rings".into(), shaded(|x, y| 127.0 + 120.0 * ring(x, y).sin())));
    }
    for (name, pattern) in patterns {
        assert_uninformative(&name, &pattern);
        assert_uninformative(&format!("{name}, noisy"), &Noise(11).over(&pattern, 4.0));
    }
}

#[test]
fn a_scene_of_which_a_large_part_is_missing_is_uninformative() {
    for scene in SCENES {
        let scene = decode(scene, LIMITS, Needed::All).unwrap().pixels;
        let (width, height) = scene.dimensions();
        let without = |is_missing: &dyn Fn(u32, u32) -> bool, fill: [u8; 3]| {
            let mut scene = scene.clone();
            let missing = scene.enumerate_pixels_mut().filter(|(x, y, _)| is_missing(*x, *y));
            missing.for_each(|(.., pixel)| *pixel = Rgb(fill));
            scene
        };
        for fill in [[128; 3], [0, 135, 0], [0; 3], [255; 3]] {
            assert_uninformative("lower half", &without(&|_, y| 2 * y >= height, fill));
            assert_uninformative("right half", &without(&|x, _| 2 * x >= width, fill));
        }
        assert_uninformative("lower 40 %", &without(&|_, y| 10 * y >= 6 * height, [128; 3]));
        // Bars above and below a picture are no fault.
        let bars = without(&|_, y| y < height / 8 || y >= height - height / 8, [0; 3]);
        assert_eq!(measured(&bars).lack(), None);
    }
}
