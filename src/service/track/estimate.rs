//! The places where a robot probably is, given what the filter believes.

use super::TrackSettings;
use super::ground::Ground;
use super::posterior::{MIN_IMAGES, Posterior};
use whereabouts_api::{TrackEstimate, TrackHypothesis};

/// Images within this many times the usual distance of neighbours show the same place.
const SAME_PLACE: f64 = 2.5;

/// Standard deviation of the kernel by which an image's neighbours support it, in units of the usual distance.
const SUPPORT: f64 = 0.7;

/// Maximum number of images around one that support it.
const MAX_SUPPORT: usize = 512;

/// Smallest probability of a hypothesis.
const MIN_HYPOTHESIS: f64 = 0.1;

/// Maximum number of hypotheses in addition to the estimate.
const HYPOTHESES: usize = 2;

/// Radius of a place in metres.
pub(super) fn place_radius(ground: &Ground, place_m: f64) -> f64 {
    place_m.min(SAME_PLACE * ground.paths.spacing())
}

/// Where a robot is.
pub(super) fn estimate(
    (id, frames): (String, u64),
    Posterior { belief, presence }: &Posterior,
    ground: &Ground,
    place_m: f64,
    settings: &TrackSettings,
) -> TrackEstimate {
    let on_map = presence.on_map();
    let spacing = ground.paths.spacing();
    let radius = place_radius(ground, place_m);
    let share = belief.elsewhere() / ground.len().max(1) as f64;
    let mut masses = vec![0.0_f32; ground.len()];
    for (image, mass) in belief.masses() {
        masses[image as usize] = mass as f32;
    }
    let near = |image: u32| {
        let reach = SAME_PLACE * spacing;
        let near = ground.grid.near(image, reach, MAX_SUPPORT);
        near.unwrap_or_else(|| vec![(image, 0.0)])
    };
    let mut rivals: Vec<(u32, f64)> = belief.masses();
    rivals.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    rivals.truncate(RIVALS);
    for (image, mass) in &mut rivals {
        let support = |(other, metres): (u32, f64)| {
            let off = metres / (SUPPORT * spacing);
            f64::from(masses[other as usize]) * (-0.5 * off * off).exp()
        };
        *mass = near(*image).into_iter().map(support).sum();
    }
    rivals.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let probability = |image: u32| -> f64 {
        let same = near(image).into_iter().filter(|(_, metres)| *metres <= radius);
        let sum: f64 = same.map(|(other, _)| f64::from(masses[other as usize]) + share).sum();
        sum.min(1.0) * on_map
    };
    let mut places: Vec<TrackHypothesis> = Vec::new();
    let mut taken: Vec<u32> = Vec::new();
    for (image, _) in rivals {
        if taken.iter().any(|other| ground.grid.distance(*other, image) <= 2.0 * radius) {
            continue;
        }
        let probability = probability(image);
        if taken.is_empty() || probability >= MIN_HYPOTHESIS {
            taken.push(image);
            let pose = Some(ground.pose(image));
            places.push(TrackHypothesis { image_id: ground.id(image).clone(), pose, probability });
        }
        if places.len() > HYPOTHESES {
            break;
        }
    }
    let mut places = places.into_iter();
    let best = places.next();
    let probability = best.as_ref().map_or(0.0, |best| best.probability);
    TrackEstimate {
        id,
        frames,
        image_id: best.as_ref().map(|best| best.image_id.clone()),
        pose: best.and_then(|best| best.pose),
        probability,
        known: probability >= settings.known_probability && ground.len() >= MIN_IMAGES,
        off_map: 1.0 - on_map,
        others: places.collect(),
        is_late: false,
    }
}

/// Number of images that may be the estimate.
const RIVALS: usize = 64;
