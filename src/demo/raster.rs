//! Turns a scene into pixels.
//!
//! Visibility is found at two samples per pixel with a depth buffer, so that silhouettes are
//! smooth; a pixel is then shaded once per surface in it, because paints filter themselves.

use image::RgbImage;
use rayon::prelude::*;

use super::camera::{Camera, View};
use super::dice::{Dice, grain};
use super::geometry::{Rgb, Vec3};
use super::scene::Scene;
use super::surface::{Outline, Surface};

/// Rows that are drawn together: few enough for the sample buffers to stay in cache.
const BAND: usize = 16;
/// Where in a pixel visibility is sampled: on a diagonal, which softens upright and level edges
/// alike.
const SAMPLES: [(f32, f32); 2] = [(0.25, 0.25), (0.75, 0.75)];
/// The surface number of the sky.
const SKY: u32 = 0;

pub(super) fn render(
    scene: &Scene<'_>,
    camera: &Camera,
    (width, height): (u32, u32),
    grain: &mut Dice,
) -> RgbImage {
    let mut visible: Vec<Visible<'_>> = scene
        .surfaces
        .iter()
        .filter_map(|surface| Visible::new(surface, camera, width, height))
        .collect();
    // Near surfaces first, so that most of what they hide is never entered.
    visible.sort_by(|one, other| one.distance.total_cmp(&other.distance));
    let canvas = Canvas {
        scene,
        camera,
        visible: &visible,
        width: width as usize,
        grain: grain.bits() as u32,
    };
    let mut image = RgbImage::new(width, height);
    let stride = 3 * canvas.width.max(1);
    image
        .par_chunks_mut(stride * BAND)
        .enumerate()
        .for_each(|(band, pixels)| canvas.draw_band(band * BAND, pixels, stride));
    image
}

/// A surface that reaches into the picture.
struct Visible<'a> {
    surface: &'a Surface<'a>,
    view: View,
    /// First and last pixel row it may touch.
    rows: (f32, f32),
    /// To its middle, in metres.
    distance: f32,
    /// The normal on the side that is seen.
    facing: Vec3,
    /// Whether nothing painted on it is thinner than two pixels, so that every other pixel of a
    /// row, and of a column, tells its shade.
    is_coarse: (bool, bool),
}

impl<'a> Visible<'a> {
    fn new(surface: &'a Surface<'a>, camera: &Camera, width: u32, height: u32) -> Option<Self> {
        let view = camera.view(&surface.panel)?;
        let range = |values: &mut dyn Iterator<Item = f32>| {
            values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| {
                (low.min(value), high.max(value))
            })
        };
        let columns = range(&mut view.outline.iter().map(|point| point.0));
        let rows = range(&mut view.outline.iter().map(|point| point.1));
        let inside =
            columns.1 > 0.0 && columns.0 < width as f32 && rows.1 > 0.0 && rows.0 < height as f32;
        let panel = &surface.panel;
        let sight = panel.point(panel.width / 2.0, panel.height / 2.0) - camera.eye;
        let normal = panel.normal();
        let behind = normal.dot(panel.corner - camera.eye) > 0.0;
        let (thin, flat) = surface.paint.finest();
        let corners = || view.outline.iter().map(|&(x, y)| view.footprint(x, y));
        let is_coarse = (
            corners().all(|corner| corner.across * 2.0 < thin),
            corners().all(|corner| corner.rise * 2.0 < flat),
        );
        inside.then_some(Visible {
            is_coarse,
            facing: if behind { normal * -1.0 } else { normal },
            surface,
            view,
            rows,
            distance: sight.dot(sight).sqrt(),
        })
    }

    /// Where the outline crosses a horizontal line, in pixels.
    fn span(&self, y: f32) -> Option<(f32, f32)> {
        let outline = &self.view.outline;
        let mut span: Option<(f32, f32)> = None;
        for (index, &(x0, y0)) in outline.iter().enumerate() {
            let (x1, y1) = outline[(index + 1) % outline.len()];
            if (y0 <= y) != (y1 <= y) {
                let x = x0 + (x1 - x0) * ((y - y0) / (y1 - y0));
                let (left, right) = span.unwrap_or((x, x));
                span = Some((left.min(x), right.max(x)));
            }
        }
        span
    }
}

/// The nearest surface at every sample of a band.
struct Samples {
    inverse_depth: Vec<f32>,
    surface: Vec<u32>,
}

impl Samples {
    /// The surfaces seen by the samples of a band's pixel.
    #[inline]
    fn at(&self, pixel: usize, width: usize) -> [u32; SAMPLES.len()] {
        // A row of pixels is stored as two lines of samples, one after the other.
        let first = pixel + pixel / width * width;
        [self.surface[first], self.surface[first + width]]
    }
}

struct Canvas<'a> {
    scene: &'a Scene<'a>,
    camera: &'a Camera,
    visible: &'a [Visible<'a>],
    width: usize,
    grain: u32,
}

impl Canvas<'_> {
    fn draw_band(&self, top: usize, pixels: &mut [u8], stride: usize) {
        let rows = pixels.len() / stride;
        let samples = self.sample(top, rows);
        let radiance = self.shade(&samples, top, rows);
        for (row, line) in pixels.chunks_exact_mut(stride).enumerate() {
            let colours = &radiance[row * self.width..];
            for ((column, pixel), &colour) in line.chunks_exact_mut(3).enumerate().zip(colours) {
                pixel.copy_from_slice(&self.develop(colour, column, top + row));
            }
        }
    }

    /// Shades every other pixel of every other row, and of the rest those whose neighbours differ
    /// in surface or shade: smooth walls, ground and sky need no more.
    fn shade(&self, samples: &Samples, top: usize, rows: usize) -> Vec<Rgb> {
        let mut radiance = vec![Rgb::BLACK; self.width * rows];
        for (first_row, first_column) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            for row in (first_row..rows).step_by(2) {
                for column in (first_column..self.width).step_by(2) {
                    let at = (column, row);
                    let smooth = match (first_row, first_column) {
                        (0, 0) => None,
                        (0, _) => self.between_columns(samples, &radiance, at),
                        _ => self.between_rows(samples, &radiance, at),
                    };
                    radiance[row * self.width + column] =
                        smooth.unwrap_or_else(|| self.pixel(samples, at, top + row));
                }
            }
        }
        radiance
    }

    /// The mean of the pixels to the left and right, where that is as good as shading.
    fn between_columns(
        &self,
        samples: &Samples,
        radiance: &[Rgb],
        (column, row): (usize, usize),
    ) -> Option<Rgb> {
        let here = row * self.width + column;
        let is_coarse = |visible: &Visible<'_>| visible.is_coarse.0;
        let smooth = column + 1 < self.width
            && self.is_uniform(samples, [here - 1, here, here + 1], is_coarse);
        smooth.then(|| radiance[here - 1].between(radiance[here + 1])).flatten()
    }

    /// The mean of the pixels above and below, where that is as good as shading.
    fn between_rows(
        &self,
        samples: &Samples,
        radiance: &[Rgb],
        (column, row): (usize, usize),
    ) -> Option<Rgb> {
        let here = row * self.width + column;
        let (above, below) = (here - self.width, here + self.width);
        let is_coarse = |visible: &Visible<'_>| visible.is_coarse.1;
        let smooth =
            below < radiance.len() && self.is_uniform(samples, [above, here, below], is_coarse);
        smooth.then(|| radiance[above].between(radiance[below])).flatten()
    }

    /// Whether pixels of a band show one and the same surface, and that is coarse.
    fn is_uniform(
        &self,
        samples: &Samples,
        pixels: [usize; 3],
        is_coarse: impl Fn(&Visible<'_>) -> bool,
    ) -> bool {
        let [first, _] = samples.at(pixels[0], self.width);
        self.surface(first).is_none_or(is_coarse)
            && pixels.iter().all(|&pixel| samples.at(pixel, self.width) == [first; SAMPLES.len()])
    }

    fn sample(&self, top: usize, rows: usize) -> Samples {
        let lines = rows * SAMPLES.len();
        let mut samples = Samples {
            inverse_depth: vec![0.0; self.width * lines],
            surface: vec![SKY; self.width * lines],
        };
        for (number, visible) in (SKY + 1..).zip(self.visible) {
            let (first, last) = visible.rows;
            let start = ((first - top as f32).max(0.0) as usize).min(rows);
            let end = ((last - top as f32 + 1.0).max(0.0) as usize).min(rows);
            for line in start * SAMPLES.len()..end * SAMPLES.len() {
                let (right, down) = SAMPLES[line % SAMPLES.len()];
                let y = (top + line / SAMPLES.len()) as f32 + down;
                let at = line * self.width..(line + 1) * self.width;
                let depths = &mut samples.inverse_depth[at.clone()];
                scan(visible, number, (right, y), depths, &mut samples.surface[at]);
            }
        }
        samples
    }

    /// The mean radiance of a pixel, shading each surface in it where it is seen.
    fn pixel(&self, samples: &Samples, (column, row): (usize, usize), y: usize) -> Rgb {
        let [one, other] = samples.at(row * self.width + column, self.width);
        let (x, y) = (column as f32, y as f32);
        if one == other {
            return self.radiance(one, x + 0.5, y + 0.5);
        }
        let seen = |number: u32, sample: usize| {
            let (right, down) = SAMPLES[sample];
            self.radiance(number, x + right, y + down)
        };
        (seen(one, 0) + seen(other, 1)) * 0.5
    }

    /// A surface by its number, or `None` for the sky.
    fn surface(&self, number: u32) -> Option<&Visible<'_>> {
        self.visible.get((number as usize).wrapping_sub(1))
    }

    fn radiance(&self, number: u32, x: f32, y: f32) -> Rgb {
        let ray = self.camera.ray(x, y);
        match self.surface(number) {
            None => self.scene.lighting.sky(ray),
            Some(visible) => {
                let seen = visible.view.footprint(x, y);
                let facing = visible.facing;
                self.scene.shade(visible.surface, &seen, facing, ray)
            }
        }
    }

    /// Exposure, a film-like shoulder, display gamma and sensor noise.
    fn develop(&self, radiance: Rgb, column: usize, row: usize) -> [u8; 3] {
        let lighting = &self.scene.lighting;
        // The grain's standard deviation is 1/√12.
        let spread = lighting.noise * 3.46;
        let noise = grain(column as i32, row as i32, self.grain);
        let levels = radiance.tint(lighting.exposure).map(|light| {
            let shoulder = light * (1.0 + 0.18 * light) / (1.0 + 0.55 * light);
            255.0 * shoulder.max(0.0).sqrt() + 0.5
        });
        let [red, green, blue] = levels.channels();
        [
            (red + noise[0] * spread) as u8,
            (green + noise[1] * spread) as u8,
            (blue + noise[2] * spread) as u8,
        ]
    }
}

/// Enters a surface into one line of samples wherever it is the nearest so far. The samples lie
/// `right` of each pixel's left edge, at height `y`.
fn scan(
    visible: &Visible<'_>,
    number: u32,
    (right, y): (f32, f32),
    depths: &mut [f32],
    surfaces: &mut [u32],
) {
    let Some((from, to)) = visible.span(y) else {
        return;
    };
    let sample = |x: f32| (x - right + 1.0).clamp(0.0, depths.len() as f32) as usize;
    let (start, end) = (sample(from), sample(to));
    let form = visible.view.inverse_depth;
    let first = form.at(right, y);
    let line = depths[start..end].iter_mut().zip(&mut surfaces[start..end]);
    for (index, (depth, surface)) in (start..end).zip(line) {
        let inverse_depth = first + form.dx * index as f32;
        if inverse_depth <= *depth {
            continue;
        }
        if !matches!(visible.surface.outline, Outline::Full) {
            let (u, v) = visible.view.uv(index as f32 + right, y);
            if !Scene::covers(visible.surface, u, v) {
                continue;
            }
        }
        *depth = inverse_depth;
        *surface = number;
    }
}
