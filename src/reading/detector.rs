//! Finds the lines of text in a picture.

use image::RgbImage;
use image::imageops::{FilterType, resize};

use super::ReadError;
use super::geometry::{Point, Quad, Rectangle, contains};
use super::manifest::DetectorSpec;
use super::model::Model;
use super::tensor::fill;

/// Sides of the input are multiples of this many pixels.
const MULTIPLE: u32 = 32;

/// Regions that are narrower than this many pixels of the input, and lines that are so after they were enlarged, are left
/// out.
const NARROWEST: [f32; 2] = [3.0, 5.0];

#[derive(Debug)]
pub(super) struct Detector {
    pub model: Model,
    pub spec: DetectorSpec,
    /// Most lines of a picture: those with the most pixels.
    pub max_lines: usize,
}

impl Detector {
    /// The lines of a picture, in its pixels, from top to bottom.
    pub fn lines(&self, picture: &RgbImage) -> Result<Vec<Quad>, ReadError> {
        let (width, height) = picture.dimensions();
        let longest = width.max(height).max(1);
        let scale = (self.spec.longest_side as f32 / longest as f32).min(1.0);
        let side = |length: u32| {
            let multiples = (length as f32 * scale / MULTIPLE as f32).round() as u32;
            multiples.max(1) * MULTIPLE
        };
        let (across, down) = (side(width), side(height));
        let scaled;
        let input = match (across, down) == (width, height) {
            true => picture,
            false => {
                scaled = resize(picture, across, down, FilterType::Triangle);
                &scaled
            }
        };
        let (across, down) = (across as usize, down as usize);
        let mut planes = vec![0.0; 3 * across * down];
        fill(&mut planes, across, input, self.spec.mean, self.spec.std);
        let mut lines: Vec<Quad> = self.model.run([1, 3, down, across], &planes, |_, map| {
            if map.len() != across * down {
                return Err(ReadError::Model(format!(
                    "the detector gives {} numbers for {across} × {down} pixels",
                    map.len()
                )));
            }
            let regions = regions(map, across, self.spec.pixel_threshold, self.max_lines);
            Ok(regions.into_iter().filter_map(|region| self.line(map, across, region)).collect())
        })?;
        let (width, height) = (width as f32, height as f32);
        let (by_x, by_y) = (width / across as f32, height / down as f32);
        for [x, y] in lines.iter_mut().flatten() {
            (*x, *y) = ((*x * by_x).clamp(0.0, width), (*y * by_y).clamp(0.0, height));
        }
        lines.sort_by(|a, b| a[0][1].total_cmp(&b[0][1]).then(a[0][0].total_cmp(&b[0][0])));
        Ok(lines)
    }

    /// The line around a region, if it is wide and probable enough.
    fn line(&self, map: &[f32], across: usize, region: Vec<Point>) -> Option<Quad> {
        let rectangle = Rectangle::around(region)?;
        if rectangle.shorter() < NARROWEST[0]
            || mean_within(map, across, &rectangle.corners()) < self.spec.line_threshold
        {
            return None;
        }
        let line = rectangle.enlarged(self.spec.unclip);
        (line.shorter() >= NARROWEST[1]).then(|| line.corners())
    }
}

/// The pixels of each connected region (8 neighbours) of at least this probability: of the `most` largest, those that
/// have a neighbour outside in their row.
fn regions(map: &[f32], across: usize, threshold: f32, most: usize) -> Vec<Vec<Point>> {
    let down = map.len() / across;
    let mut waits: Vec<bool> = map.iter().map(|probability| *probability > threshold).collect();
    let inside = waits.clone();
    let mut found: Vec<(usize, Vec<Point>)> = Vec::new();
    let mut stack = Vec::new();
    for start in 0..map.len() {
        if !std::mem::take(&mut waits[start]) {
            continue;
        }
        stack.push(start);
        let (mut size, mut edge) = (0, Vec::new());
        while let Some(at) = stack.pop() {
            let (x, y) = (at % across, at / across);
            size += 1;
            if x == 0 || x + 1 == across || !inside[at - 1] || !inside[at + 1] {
                edge.push([x as f32, y as f32]);
            }
            for y in y.saturating_sub(1)..(y + 2).min(down) {
                for x in x.saturating_sub(1)..(x + 2).min(across) {
                    if std::mem::take(&mut waits[y * across + x]) {
                        stack.push(y * across + x);
                    }
                }
            }
        }
        found.push((size, edge));
    }
    found.sort_by_key(|(size, _)| std::cmp::Reverse(*size));
    found.into_iter().take(most).map(|(_, edge)| edge).collect()
}

/// The mean of the numbers whose pixels are in a quadrilateral; 0 if there are none.
fn mean_within(map: &[f32], across: usize, quad: &Quad) -> f32 {
    let down = map.len() / across;
    let bounds = |axis: usize, end: usize| {
        let (least, most) = quad.iter().fold((f32::MAX, 0.0_f32), |(least, most), point| {
            (least.min(point[axis]), most.max(point[axis]))
        });
        least.floor().max(0.0) as usize..(most.ceil() as usize + 1).min(end)
    };
    let (mut sum, mut count) = (0.0, 0);
    for y in bounds(1, down) {
        for x in bounds(0, across) {
            if contains(quad, [x as f32, y as f32]) {
                sum += map[y * across + x];
                count += 1;
            }
        }
    }
    if count == 0 { 0.0 } else { sum / count as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regions_that_touch_at_a_corner_are_one_and_the_largest_come_first() {
        #[rustfmt::skip]
        let map = [
            0.9, 0.0, 0.0, 0.0, 0.0,
            0.0, 0.9, 0.0, 0.0, 0.9,
            0.0, 0.0, 0.9, 0.0, 0.0,
        ];
        let found = regions(&map, 5, 0.3, 10);
        assert_eq!(found.iter().map(Vec::len).collect::<Vec<_>>(), [3, 1]);
        assert_eq!(regions(&map, 5, 0.3, 1).len(), 1);
        assert!(regions(&[0.0; 15], 5, 0.3, 10).is_empty());
    }

    #[test]
    fn the_mean_counts_the_pixels_within() {
        let map: Vec<f32> =
            (0..25).map(|at| if (1..3).contains(&(at % 5)) { 1.0 } else { 0.0 }).collect();
        let quad = [[1.0, 1.0], [2.0, 1.0], [2.0, 3.0], [1.0, 3.0]];
        assert_eq!(mean_within(&map, 5, &quad), 1.0);
        assert_eq!(mean_within(&map, 5, &quad.map(|[x, y]| [x + 1.0, y])), 0.5);
        assert_eq!(mean_within(&map, 5, &quad.map(|[x, y]| [x + 90.0, y])), 0.0);
    }
}
