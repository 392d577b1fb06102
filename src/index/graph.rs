//! The growing graph: HNSW (Malkov and Yashunin, 2018) by `hnsw_rs`.

use hnsw_rs::prelude::{Distance, FilterT, Hnsw};

use super::{IndexSettings, ScoredSlot};
use whereabouts_core::dot;

/// One minus the dot product of unit vectors.
///
/// The crate's own `DistDot` panics if rounding makes a dot product exceed 1.
#[derive(Clone, Copy, Default)]
struct CosineDistance;

impl Distance<f32> for CosineDistance {
    fn eval(&self, a: &[f32], b: &[f32]) -> f32 {
        (1.0 - dot(a, b)).max(0.0)
    }
}

/// A point of the graph and its links.
pub(super) struct Linked {
    /// Slot of the point.
    pub slot: usize,
    /// Slots of the point's neighbours in each of its layers, lowest layer first.
    pub layers: Vec<Vec<usize>>,
}

pub(super) struct Graph {
    hnsw: Hnsw<'static, f32, CosineDistance>,
}

impl Graph {
    pub fn new(settings: &IndexSettings) -> Self {
        // A hint for the initial allocation, not a limit.
        const EXPECTED: usize = 16_384;
        const LAYERS: usize = 16;
        let hnsw =
            Hnsw::new(settings.m, EXPECTED, LAYERS, settings.ef_construction, CosineDistance);
        Self { hnsw }
    }

    pub fn insert(&self, slot: usize, vector: &[f32]) {
        self.hnsw.insert((vector, slot));
    }

    /// All points with their links.
    pub fn linked(&self) -> Vec<Linked> {
        let points = self.hnsw.get_point_indexation();
        let layers = 0..=usize::from(points.get_max_level_observed());
        layers
            .flat_map(|layer| points.get_layer_iterator(layer))
            .map(|point| Linked {
                slot: point.get_origin_id(),
                layers: point
                    .get_neighborhood_id()
                    .iter()
                    // A point has lists for all layers, but belongs only to those up to its own.
                    .take(usize::from(point.get_point_id().0) + 1)
                    .map(|layer| layer.iter().map(|neighbour| neighbour.d_id).collect())
                    .collect(),
            })
            .collect()
    }

    /// Returns the `k` nearest slots that pass `keep`.
    pub fn search(
        &self,
        query: &[f32],
        k: usize,
        ef: usize,
        keep: &dyn Fn(usize) -> bool,
    ) -> Vec<ScoredSlot> {
        let filter = |slot: &usize| keep(*slot);
        self.hnsw
            .search_filter(query, k, ef, Some(&filter as &dyn FilterT))
            .into_iter()
            .map(|neighbour| ScoredSlot {
                slot: neighbour.d_id,
                similarity: 1.0 - neighbour.distance,
            })
            .collect()
    }
}
