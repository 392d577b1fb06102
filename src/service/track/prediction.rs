//! What is believed before a frame is taken into account, and what the frame is compared with.

use jiff::Timestamp;

use super::TrackSettings;
use super::belief::Roads;
use super::evidence::Weights;
use super::ground::Ground;
use super::moves::Motion;
use super::posterior::{FrameWeights, Posterior};

/// What is believed before a frame is taken into account.
#[derive(Debug, Clone)]
pub(super) struct Prediction {
    pub posterior: Posterior,
    /// Share of the evidence of the frame that is new.
    pub fresh: f64,
    /// Whether the frame is older than the last one.
    pub is_late: bool,
    /// The share by which the frame differs from the one before.
    pub unlike: f64,
    /// The frame without what it has in common with others.
    pub frame: Vec<f32>,
    /// What the robot should send instead.
    pub warning: Option<String>,
    /// When the frame was taken and when it arrived.
    pub times: (Option<Timestamp>, Timestamp),
    pub motion: Option<Motion>,
    /// The highest speed that is possible, in metres per unit of time.
    pub max_speed: f64,
}

/// How much the images of a belief differ from their neighbours.
pub(super) struct Changes(pub Vec<f32>);

impl Changes {
    /// For motions that do not ask.
    pub fn none() -> Self {
        Self(Vec::new())
    }

    /// The map with them.
    pub fn roads<'a>(&'a self, ground: &'a Ground) -> Roads<'a> {
        Roads { grid: &ground.grid, paths: &ground.paths, changes: &self.0 }
    }
}

impl Prediction {
    /// The images whose similarity to the frame has to be read: those of the belief and the candidates of the search,
    /// but for the sample of the map.
    pub fn images(&self, candidates: &[u32], ground: &Ground) -> Vec<u32> {
        let mut images = [self.posterior.belief.images(), candidates].concat();
        images.sort_unstable();
        images.dedup();
        images.retain(|image| ground.sample().binary_search(image).is_err());
        images
    }

    /// The weights of images by their similarity to the frame, without the mean of the track.
    pub fn weights(
        &self,
        (images, similarities): (&[u32], &[Option<f32>]),
        confidence: Option<f32>,
        ground: &Ground,
        settings: &TrackSettings,
    ) -> Option<FrameWeights> {
        let shift = whereabouts_core::dot(&self.frame, ground.mean());
        let lengths = ground.lengths(images);
        let known = images.iter().zip(similarities).zip(lengths);
        let similar: Vec<(u32, f32)> = known
            .filter_map(|((image, similarity), length)| {
                Some((*image, ((*similarity)? - shift) / length))
            })
            .collect();
        let is_sample = |image: &u32| ground.sample().binary_search(image).is_ok();
        let sample: Vec<f32> =
            similar.iter().filter(|(image, _)| is_sample(image)).map(|(_, s)| *s).collect();
        let strength = (settings.sharpness * self.fresh, settings.outliers);
        (!sample.is_empty()).then(|| FrameWeights {
            weights: Weights::new(&similar, &sample, ground.len(), strength),
            fresh: self.fresh,
            unlike: self.unlike,
            confidence,
        })
    }
}

/// The share by which a frame differs from the one before: one minus their cosine.
pub(super) fn unlike(before: &[f32], frame: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| f64::from(whereabouts_core::dot(a, b));
    let lengths = (dot(before, before) * dot(frame, frame)).sqrt();
    if before.len() != frame.len() || lengths <= 0.0 {
        return 1.0;
    }
    (1.0 - dot(before, frame) / lengths).clamp(0.0, 1.0)
}
