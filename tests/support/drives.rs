//! Drives for tests and benchmarks of tracks, and the methods that a track is compared with.
//!
//! All methods take the similarity of each frame to each image of a map whose images are in the order of the drive, and
//! answer with an image for each frame. [`with_odometry`] and [`without_odometry`] are small filters that use the
//! frames so far; [`best_line`] is the sequence matching of SeqSLAM (Milford and Wyeth, 2012), which also uses later
//! frames.

use image::{Rgb, RgbImage};

/// Frames before and after one that [`best_line`] uses.
const HALF_LINE: i64 = 10;

/// Images on each side of one that SeqSLAM's contrast enhancement compares it with.
const NEIGHBOURHOOD: usize = 10;

/// The similarity of each frame to each image.
pub type Similarities = [Vec<f32>];

/// The image that is most similar to each frame.
pub fn alone(similarities: &Similarities) -> Vec<usize> {
    similarities
        .iter()
        .map(|row| largest(&row.iter().map(|s| f64::from(*s)).collect::<Vec<_>>()))
        .collect()
}

/// A forward filter over images, for a robot that moves an image a frame: on to the same, the next and the one after it
/// with 0.2, 0.6 and 0.2, and 2 % anywhere. The likelihood is exp(z), with the similarity z standardised over the map.
pub fn with_odometry(similarities: &Similarities) -> Vec<usize> {
    let count = similarities[0].len();
    let mut belief = vec![1.0 / count as f64; count];
    let mut answers = Vec::new();
    for (number, row) in similarities.iter().enumerate() {
        if number > 0 {
            let mut moved = vec![0.0; count];
            for (image, mass) in belief.iter().enumerate() {
                for (step, weight) in [0.2, 0.6, 0.2].into_iter().enumerate() {
                    moved[(image + step).min(count - 1)] += weight * mass;
                }
            }
            belief = moved.iter().map(|mass| 0.98 * mass + 0.02 / count as f64).collect();
        }
        weigh(&mut belief, &standardised(row), 1.0);
        answers.push(largest(&belief));
    }
    answers
}

/// A filter over images and speeds from −3 to 3 images a frame: the speed changes by one with probability 0.02 each way,
/// the position is off by one with 0.1 each way, and 0.5 % are anywhere. The likelihood is exp(z / 2).
pub fn without_odometry(similarities: &Similarities) -> Vec<usize> {
    const SPEEDS: usize = 7;
    let count = similarities[0].len();
    let mut belief = vec![1.0 / (SPEEDS * count) as f64; SPEEDS * count];
    let mut answers = Vec::new();
    for (number, row) in similarities.iter().enumerate() {
        if number > 0 {
            let mut moved = vec![0.0; SPEEDS * count];
            for speed in 0..SPEEDS {
                let [slower, faster] = [speed.saturating_sub(1), (speed + 1).min(SPEEDS - 1)];
                for image in 0..count {
                    let mass = 0.96 * belief[speed * count + image]
                        + 0.02 * (belief[slower * count + image] + belief[faster * count + image]);
                    for (off, weight) in [(0, 0.8), (1, 0.1), (-1, 0.1)] {
                        let to = image as i64 + speed as i64 - 3 + off;
                        if (0..count as i64).contains(&to) {
                            moved[speed * count + to as usize] += weight * mass;
                        }
                    }
                }
            }
            let total: f64 = moved.iter().sum();
            let anywhere = 0.005 / (SPEEDS * count) as f64;
            belief = moved.iter().map(|mass| 0.995 * mass / total + anywhere).collect();
        }
        let z = standardised(row);
        weigh(&mut belief, &z.repeat(SPEEDS), 0.5);
        let images: Vec<f64> =
            (0..count).map(|image| (0..SPEEDS).map(|s| belief[s * count + image]).sum()).collect();
        answers.push(largest(&images));
    }
    answers
}

/// SeqSLAM: the best line through the contrast-enhanced similarities of the frames around each one, at 0.8 to 1.2 images
/// a frame.
pub fn best_line(similarities: &Similarities) -> Vec<usize> {
    let enhanced: Vec<Vec<f64>> = similarities.iter().map(|row| enhanced(row)).collect();
    let (frames, images) = (enhanced.len() as i64, enhanced[0].len() as i64);
    let score = |frame: i64, image: i64, speed: f64| {
        let points = (-HALF_LINE..=HALF_LINE).filter_map(|step| {
            let on = image + (speed * step as f64).round() as i64;
            let inside = (0..frames).contains(&(frame + step)) && (0..images).contains(&on);
            inside.then(|| enhanced[(frame + step) as usize][on as usize])
        });
        let (sum, points) = points.fold((0.0, 0), |(sum, points), s| (sum + s, points + 1));
        if points > HALF_LINE { sum / points as f64 } else { f64::MIN }
    };
    let best = |frame: i64| {
        let scores = (0..images).map(|image| {
            let speeds = [0.8, 0.9, 1.0, 1.1, 1.2];
            speeds.into_iter().map(|speed| score(frame, image, speed)).fold(f64::MIN, f64::max)
        });
        largest(&scores.collect::<Vec<_>>())
    };
    (0..frames).map(best).collect()
}

/// Each similarity relative to those of the neighbouring images.
fn enhanced(row: &[f32]) -> Vec<f64> {
    let around = |image: usize| {
        let near = image.saturating_sub(NEIGHBOURHOOD)..(image + NEIGHBOURHOOD + 1).min(row.len());
        let (mean, deviation) = moments(&row[near]);
        (f64::from(row[image]) - mean) / (deviation + 1e-9)
    };
    (0..row.len()).map(around).collect()
}

fn standardised(row: &[f32]) -> Vec<f64> {
    let (mean, deviation) = moments(row);
    row.iter().map(|s| (f64::from(*s) - mean) / deviation.max(1e-9)).collect()
}

fn moments(numbers: &[f32]) -> (f64, f64) {
    let count = numbers.len() as f64;
    let mean = numbers.iter().map(|n| f64::from(*n)).sum::<f64>() / count;
    let variance = numbers.iter().map(|n| (f64::from(*n) - mean).powi(2)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

fn weigh(belief: &mut [f64], z: &[f64], sharpness: f64) {
    belief.iter_mut().zip(z).for_each(|(mass, z)| *mass *= (sharpness * z).exp());
    let total: f64 = belief.iter().sum();
    belief.iter_mut().for_each(|mass| *mass /= total);
}

fn largest(numbers: &[f64]) -> usize {
    (0..numbers.len()).fold(0, |best, at| if numbers[at] > numbers[best] { at } else { best })
}

/// The side of a van that fills nearly all of a picture.
pub fn behind_a_van(mut picture: RgbImage, number: usize) -> RgbImage {
    let (width, height) = picture.dimensions();
    let paint = [40, 90, 140, 190, 220].map(|level| (level + 13 * number as u32 % 35) as u8);
    let body = Rgb([paint[number % 5], paint[number / 2 % 5], paint[number / 3 % 5]]);
    for (x, y, pixel) in picture.enumerate_pixels_mut() {
        let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
        let window = (0.2..0.45).contains(&v) && (u * 5.0).fract() > 0.2;
        if u > 0.05 && v > 0.08 {
            *pixel = if window { Rgb(body.0.map(|level| level / 3)) } else { body };
        }
    }
    picture
}

/// Whether a van blocks the view at a place: three in ten, both isolated and in a row.
pub fn is_blocked(place: usize) -> bool {
    matches!(place % 20, 3 | 4 | 8 | 12 | 13 | 17)
}
