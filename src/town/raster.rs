//! Rasterisation of a scene.
//!
//! Visibility is found at two samples per pixel with a depth buffer, so that silhouettes are
//! smooth; a pixel is then shaded once per surface in it, because paints filter themselves.

use image::RgbImage;
use rayon::prelude::*;

use super::camera::{Camera, View};
use super::dice::{Dice, grain};
use super::geometry::Rgb;
use super::light::Turned;
use super::scene::Scene;
use super::surface::{Outline, Surface};

/// Rows that are drawn together: few enough for the sample buffers to stay in cache.
const BAND: usize = 16;
/// Where in a pixel visibility is sampled: on a diagonal, which softens upright and level edges
/// alike.
const SAMPLES: [(f32, f32); 2] = [(0.25, 0.25), (0.75, 0.75)];
/// How many pixels' width a line must have to be told from the two pixels beside the one it
/// covers.
const MARGIN: f32 = 1.2;
/// Marks a pixel that shows several surfaces.
const MIXED: u32 = u32::MAX;
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
        .filter_map(|surface| Visible::new(surface, scene, camera, (width, height)))
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
    turned: Turned,
    /// The most that a pixel may cover of it, along and up, for nothing painted on it to hide
    /// between two pixels with one between them; in metres.
    widest: (f32, f32),
}

impl<'a> Visible<'a> {
    fn new(
        surface: &'a Surface<'a>,
        scene: &Scene<'_>,
        camera: &Camera,
        (width, height): (u32, u32),
    ) -> Option<Self> {
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
        let facing = if behind { normal * -1.0 } else { normal };
        inside.then_some(Visible {
            widest: (thin / MARGIN, flat / MARGIN),
            turned: scene.lighting.turned(surface.lit_normal(facing)),
            surface,
            view,
            rows,
            distance: sight.dot(sight).sqrt(),
        })
    }

    /// Whether nothing painted here could hide between two pixels, side by side or one above the
    /// other, with one between them.
    #[inline]
    fn is_coarse(&self, x: f32, y: f32, is_level: bool) -> bool {
        let (across, rise) = self.widest;
        if is_level {
            across == f32::INFINITY || self.view.is_finer_across(x, y, across)
        } else {
            rise == f32::INFINITY || self.view.is_finer_upwards(x, y, rise)
        }
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

/// The nearest surface at every sample of a band; each row of pixels is one line of samples for
/// each of [`SAMPLES`].
struct Samples {
    width: usize,
    surface: Vec<u32>,
    /// The surface of each pixel that shows only one, else [`MIXED`].
    only: Vec<u32>,
}

impl Samples {
    /// The surfaces seen by the samples of a band's pixel.
    #[inline]
    fn at(&self, (column, row): (usize, usize)) -> (u32, u32) {
        let first = SAMPLES.len() * row * self.width + column;
        (self.surface[first], self.surface[first + self.width])
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
            let (line, _) = line.as_chunks_mut::<3>();
            for ((column, pixel), &colour) in line.iter_mut().enumerate().zip(colours) {
                *pixel = self.develop(colour, column, top + row);
            }
        }
    }

    /// Shades every other pixel of every other row, and of the rest those whose neighbours differ
    /// in surface or shade: smooth walls, ground and sky need no more.
    fn shade(&self, samples: &Samples, top: usize, rows: usize) -> Vec<Rgb> {
        let width = self.width;
        let mut radiance = vec![Rgb::BLACK; width * rows];
        for row in (0..rows).step_by(2) {
            for column in (0..width).step_by(2) {
                radiance[row * width + column] = self.pixel(samples, (column, row), top);
            }
            for column in (1..width).step_by(2) {
                let beside = (column + 1 < width).then_some(1);
                self.fill(samples, &mut radiance, (column, row), top, beside);
            }
        }
        for row in (1..rows).step_by(2) {
            let beside = (row + 1 < rows).then_some(width);
            for column in 0..width {
                self.fill(samples, &mut radiance, (column, row), top, beside);
            }
        }
        radiance
    }

    /// Gives a pixel the mean of the two that lie `beside` it in memory, or shades it where that
    /// is not as good: where not all three show one and the same surface, the two differ much, or
    /// something painted on the surface could hide between them.
    #[inline]
    fn fill(
        &self,
        samples: &Samples,
        radiance: &mut [Rgb],
        (column, row): (usize, usize),
        top: usize,
        beside: Option<usize>,
    ) {
        let here = row * self.width + column;
        if let Some(step) = beside {
            let (before, after) = (here - step, here + step);
            let (one, surface, other) =
                (samples.only[before], samples.only[here], samples.only[after]);
            let is_uniform = (surface != MIXED) & (one == surface) & (other == surface);
            if is_uniform && radiance[before].is_close(radiance[after]) {
                let (x, y) = (column as u32 as f32 + 0.5, (top + row) as u32 as f32 + 0.5);
                let is_level = step == 1;
                if self.surface(surface).is_none_or(|visible| visible.is_coarse(x, y, is_level)) {
                    radiance[here] = radiance[before].mix(radiance[after], 0.5);
                    return;
                }
            }
        }
        radiance[here] = self.pixel(samples, (column, row), top);
    }

    fn sample(&self, top: usize, rows: usize) -> Samples {
        let lines = rows * SAMPLES.len();
        let mut nearness = vec![0.0; self.width * lines];
        let mut surface = vec![SKY; self.width * lines];
        for (number, visible) in (SKY + 1..).zip(self.visible) {
            let (first, last) = visible.rows;
            let start = ((first - top as f32).max(0.0) as usize).min(rows);
            let end = ((last - top as f32 + 1.0).max(0.0) as usize).min(rows);
            for line in start * SAMPLES.len()..end * SAMPLES.len() {
                let (right, down) = SAMPLES[line % SAMPLES.len()];
                let y = (top + line / SAMPLES.len()) as f32 + down;
                let at = line * self.width..(line + 1) * self.width;
                let depths = &mut nearness[at.clone()];
                scan(visible, number, (right, y), depths, &mut surface[at]);
            }
        }
        let mut only = Vec::with_capacity(self.width * rows);
        for row in surface.chunks_exact(SAMPLES.len() * self.width) {
            let (above, below) = row.split_at(self.width);
            let whole = |(&one, &other): (&u32, &u32)| if one == other { one } else { MIXED };
            only.extend(above.iter().zip(below).map(whole));
        }
        Samples { width: self.width, surface, only }
    }

    /// The mean radiance of a pixel, shading each surface in it where it is seen.
    fn pixel(&self, samples: &Samples, pixel: (usize, usize), top: usize) -> Rgb {
        let (one, other) = samples.at(pixel);
        let (x, y) = (pixel.0 as u32 as f32, (top + pixel.1) as u32 as f32);
        if one == other {
            return self.radiance(one, x + 0.5, y + 0.5);
        }
        let seen =
            |number: u32, (right, down): (f32, f32)| self.radiance(number, x + right, y + down);
        (seen(one, SAMPLES[0]) + seen(other, SAMPLES[1])) * 0.5
    }

    /// A surface by its number, or `None` for the sky.
    fn surface(&self, number: u32) -> Option<&Visible<'_>> {
        self.visible.get((number as usize).wrapping_sub(1))
    }

    fn radiance(&self, number: u32, x: f32, y: f32) -> Rgb {
        match self.surface(number) {
            None => self.scene.lighting.sky(self.camera.ray(x, y)),
            Some(visible) => {
                self.scene.shade(visible.surface, &visible.view.footprint(x, y), &visible.turned)
            }
        }
    }

    /// Exposure, a film-like shoulder, display gamma and sensor noise.
    #[inline]
    fn develop(&self, radiance: Rgb, column: usize, row: usize) -> [u8; 3] {
        let lighting = &self.scene.lighting;
        // The grain's standard deviation is 1/√12.
        let spread = lighting.noise * 3.46;
        let noise = grain(column as i32, row as i32, self.grain) * spread;
        let levels = radiance.tint(lighting.exposure).map(|light| {
            let shoulder = light * (1.0 + 0.18 * light) / (1.0 + 0.55 * light);
            255.0 * shoulder.max(0.0).sqrt()
        });
        (levels + noise).bytes()
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
    let nearness = |index: usize| form.at(index as i32 as f32 + right, y);
    let line = depths[start..end].iter_mut().zip(&mut surfaces[start..end]);
    if matches!(visible.surface.outline, Outline::Full) {
        // Without branches, so that it compiles to vector instructions.
        for (index, (depth, surface)) in (start..end).zip(line) {
            let inverse_depth = nearness(index);
            let is_nearer = inverse_depth > *depth;
            *depth = if is_nearer { inverse_depth } else { *depth };
            *surface = if is_nearer { number } else { *surface };
        }
        return;
    }
    for (index, (depth, surface)) in (start..end).zip(line) {
        let inverse_depth = nearness(index);
        if inverse_depth > *depth {
            let (u, v) = visible.view.uv(index as f32 + right, y);
            if Scene::covers(visible.surface, u, v) {
                (*depth, *surface) = (inverse_depth, number);
            }
        }
    }
}
