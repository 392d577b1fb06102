//! Approximate search: an HNSW graph (Malkov and Yashunin, 2018) built by `hnsw_rs`.

use hnsw_rs::prelude::{Distance, FilterT, Hnsw};

use super::{IndexSettings, ScoredSlot};
use whereabouts_core::dot;

/// One minus the dot product of unit vectors.
///
/// The crate's own `DistDot` panics on a dot product slightly above 1, which rounding produces.
#[derive(Clone, Copy, Default)]
struct CosineDistance;

impl Distance<f32> for CosineDistance {
    fn eval(&self, a: &[f32], b: &[f32]) -> f32 {
        (1.0 - dot(a, b)).max(0.0)
    }
}

/// A point of a graph.
pub(super) struct Linked {
    /// Its slot.
    pub slot: usize,
    /// The slots of its neighbours in each of its layers, the lowest layer first.
    pub layers: Vec<Vec<usize>>,
}

pub(super) struct Graph {
    hnsw: Hnsw<'static, f32, CosineDistance>,
}

impl Graph {
    pub fn new(settings: &IndexSettings) -> Self {
        // The number of elements is a hint for the first allocation, not a bound.
        const EXPECTED: usize = 16_384;
        const LAYERS: usize = 16;
        let hnsw =
            Hnsw::new(settings.m, EXPECTED, LAYERS, settings.ef_construction, CosineDistance);
        Self { hnsw }
    }

    pub fn insert(&self, slot: usize, vector: &[f32]) {
        self.hnsw.insert((vector, slot));
    }

    /// Its points, each with its neighbours.
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
                    // A point has room for all layers, but is part of those up to its own.
                    .take(usize::from(point.get_point_id().0) + 1)
                    .map(|layer| layer.iter().map(|neighbour| neighbour.d_id).collect())
                    .collect(),
            })
            .collect()
    }

    /// The `k` nearest among the slots that `keep` lets through.
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
