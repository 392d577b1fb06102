//! Compares the recall with a brute-force computation that shares no code with the index or the recall.

use std::collections::HashSet;

use super::*;
use whereabouts_core::{
    Descriptor, DescriptorKind, Digest, Image, ImageId, Map, MediaType, Precision, Scene, Usage,
};
use whereabouts_index::{IndexSettings, SearchMode};
use whereabouts_store::embedded::{EmbeddedSettings, EmbeddedStore};
use whereabouts_store::{DescriptionBounds, MapStore};

const DIM: usize = 24;
const REFERENCES: usize = 400;
const QUERIES: usize = 60;

/// A reproducible pseudorandom number between −1 and 1.
fn noise(state: &mut u64) -> f32 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 40) as f32 / (1_u32 << 23) as f32 - 1.0
}

fn descriptors(count: usize, seed: u64) -> Vec<Descriptor> {
    let mut state = seed;
    let mut one = || Descriptor::normalised((0..DIM).map(|_| noise(&mut state)).collect()).unwrap();
    (0..count).map(|_| one()).collect()
}

fn id(index: usize) -> ImageId {
    format!("{index:04}.jpg").parse().unwrap()
}

/// The synthetic ground truth of a query: no reference, one, or a few scattered ones.
fn truth(query: usize) -> Vec<usize> {
    (0..query % 5).map(|i| (query * 37 + i * 101) % REFERENCES).collect()
}

fn store(dir: &std::path::Path, exact_up_to: usize) -> EmbeddedStore {
    let index = IndexSettings {
        exact_up_to,
        m: 16,
        ef_construction: 200,
        ef_search: 200,
        threads: 0,
        max_dead_share: 1.0,
        check_s: 0,
    };
    let max_age = std::time::Duration::from_secs(3600);
    EmbeddedStore::open(&EmbeddedSettings {
        dir: dir.to_owned(),
        index,
        index_threads: 1,
        min_free_bytes: 0,
        db_cache_bytes: 1 << 20,
        commit_batch: 64,
        descriptions: DescriptionBounds { max_bytes: 1 << 20, max_age },
    })
    .unwrap()
}

async fn map_of(store: &EmbeddedStore, descriptors: &[Descriptor]) -> Map {
    let now = jiff::Timestamp::now();
    let map = Map {
        uid: uuid::Uuid::now_v7(),
        name: "random".parse().unwrap(),
        scene: Scene::Outdoor,
        descriptor: DescriptorKind::GEM,
        frame: whereabouts_core::CoordinateFrame::Metric,
        model: "none".into(),
        model_digest: Digest::of(b""),
        precision: Precision::Full,
        dim: DIM,
        revision: 0,
        refiner: None,
        vocabulary: None,
        keeps_shipped: false,
        description: None,
        created_at: now,
    };
    let (map, _) = store.put_map(map).await.unwrap();
    for (index, descriptor) in descriptors.iter().enumerate() {
        let image = Image {
            id: id(index),
            digest: Digest::of(&index.to_le_bytes()),
            pose: None,
            captured_at: None,
            tags: Vec::new(),
            media_type: MediaType::Jpeg,
            width: 1,
            height: 1,
            created_at: now,
        };
        store.add_image(&map, image, descriptor.clone()).await.unwrap();
    }
    while store.index_state(&map).await.unwrap().behind {
        tokio::task::yield_now().await;
    }
    map
}

fn dataset() -> Dataset {
    let picture = |id: ImageId| PictureFile { file: id.as_str().into(), id };
    let query = |query: usize| {
        let truth: HashSet<ImageId> = truth(query).into_iter().map(id).collect();
        let kind = if truth.is_empty() { QueryKind::Skipped } else { QueryKind::InMap };
        EvaluatedQuery { picture: picture(id(query)), kind, truth }
    };
    Dataset {
        references: (0..REFERENCES).map(|index| picture(id(index))).collect(),
        queries: (0..QUERIES).map(query).collect(),
        left_out: LeftOut::default(),
    }
}

async fn outcome(
    store: &EmbeddedStore,
    map: &Map,
    query: &Descriptor,
    mode: SearchMode,
) -> QueryOutcome {
    let candidates = store.search(map, query.clone(), 10, mode).await.unwrap();
    let predictions = candidates.into_iter().map(|candidate| Prediction {
        image_id: candidate.image_id,
        similarity: candidate.similarity,
        coarse_rank: candidate.rank,
    });
    QueryOutcome {
        query: id(0),
        digest: Digest::of(b""),
        predictions: predictions.collect(),
        confidence: Some(0.0),
        alternatives: None,
        descriptions: Vec::new(),
        reasoning: None,
        usage: Usage::default(),
        times: StageTimes::default(),
        degraded: None,
    }
}

async fn summary(store: &EmbeddedStore, map: &Map, mode: SearchMode) -> Summary {
    let mut outcomes = Vec::new();
    for query in &descriptors(QUERIES, 2) {
        outcomes.push(outcome(store, map, query, mode).await);
    }
    let method = Method { descriptor: DescriptorKind::GEM, refiner: None };
    let conditions = RunConditions {
        database: String::new(),
        query_folder: String::new(),
        truth: String::new(),
        model: String::new(),
        execution: String::new(),
        k: 10,
        known_threshold: None,
        known_confidence: 0.9,
        search: String::new(),
    };
    Summary::new(conditions, &dataset(), &[MethodOutcomes { method, outcomes }])
}

/// A query is correct at K if fewer than K references are more similar than its best correct one.
fn brute_force(references: &[Descriptor], k: usize) -> f64 {
    let cosine = |a: &Descriptor, b: &Descriptor| -> f64 {
        a.as_slice().iter().zip(b.as_slice()).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
    };
    let (mut correct, mut all) = (0, 0);
    for (index, query) in descriptors(QUERIES, 2).iter().enumerate() {
        let references_of_query = truth(index);
        if references_of_query.is_empty() {
            continue;
        }
        let best = references_of_query
            .iter()
            .map(|&reference| cosine(query, &references[reference]))
            .fold(f64::NEG_INFINITY, f64::max);
        let above = references.iter().filter(|other| cosine(query, other) > best).count();
        all += 1;
        correct += usize::from(above < k);
    }
    100.0 * f64::from(u32::try_from(correct).unwrap()) / f64::from(all)
}

#[tokio::test]
async fn recall_equals_brute_force() {
    // Moves a correct reference of half of the queries near them, so that no recall is 0 or 100.
    let mut references = descriptors(REFERENCES, 1);
    for (index, query) in descriptors(QUERIES, 2).iter().enumerate().step_by(2) {
        if let Some(&near) = truth(index).first() {
            let strength = (index % 7) as f32 / 7.0;
            let mixed = query.as_slice().iter().zip(references[near].as_slice());
            let mixed = mixed.map(|(q, r)| strength * q + r).collect();
            references[near] = Descriptor::normalised(mixed).unwrap();
        }
    }
    let expected = recall::AtK::of(|k| brute_force(&references, k));
    assert!(
        expected.one > 2.0 && expected.one < expected.ten && expected.ten < 98.0,
        "{expected:?}"
    );
    let dir = tempfile::TempDir::new().unwrap();
    let store = store(dir.path(), 50);
    let map = map_of(&store, &references).await;
    assert!(store.index_state(&map).await.unwrap().graph);
    for mode in [SearchMode::Exact, SearchMode::Fast] {
        let summary = summary(&store, &map, mode).await;
        assert_eq!((summary.queries, summary.skipped), (QUERIES * 4 / 5, QUERIES / 5));
        assert_eq!(summary.methods[0].recall, expected, "{mode:?}");
    }
}
