//! Recalls against a brute-force computation that shares no code with the index or the recall.

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

/// Numbers between −1 and 1, always the same.
fn noise(state: &mut u64) -> f32 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 40) as f32 / (1_u32 << 23) as f32 - 1.0
}

fn descriptors(count: usize, seed: u64) -> Vec<Descriptor> {
    let mut state = seed;
    let mut one = || Descriptor::normalised((0..DIM).map(|_| noise(&mut state)).collect()).unwrap();
    (0..count).map(|_| one()).collect()
}

fn id(place: usize) -> ImageId {
    format!("{place:04}.jpg").parse().unwrap()
}

/// The true references of a query, made by hand: none, one, or a few that are scattered.
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
        descriptor: DescriptorKind::Gem,
        frame: whereabouts_core::CoordinateFrame::Metric,
        model: "none".into(),
        model_digest: Digest::of(b""),
        precision: Precision::Full,
        dim: DIM,
        revision: 0,
        description: None,
        created_at: now,
    };
    let (map, _) = store.put_map(map).await.unwrap();
    for (place, descriptor) in descriptors.iter().enumerate() {
        let image = Image {
            id: id(place),
            digest: Digest::of(&place.to_le_bytes()),
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
        references: (0..REFERENCES).map(|place| picture(id(place))).collect(),
        queries: (0..QUERIES).map(query).collect(),
    }
}

async fn answered(
    store: &EmbeddedStore,
    map: &Map,
    query: &Descriptor,
    mode: SearchMode,
) -> Outcome {
    let candidates = store.search(map, query.clone(), 10, mode).await.unwrap();
    let answers = candidates.into_iter().map(|candidate| Prediction {
        image_id: candidate.image_id,
        similarity: candidate.similarity,
        coarse_rank: candidate.rank,
    });
    Outcome {
        query: id(0),
        digest: Digest::of(b""),
        answers: answers.collect(),
        confidence: 0.0,
        descriptions: Vec::new(),
        reasoning: None,
        usage: Usage::default(),
        times: Times::default(),
        degraded: None,
    }
}

async fn summary(store: &EmbeddedStore, map: &Map, mode: SearchMode) -> Summary {
    let mut outcomes = Vec::new();
    for query in &descriptors(QUERIES, 2) {
        outcomes.push(answered(store, map, query, mode).await);
    }
    let method = Method { descriptor: DescriptorKind::Gem, refiner: None };
    let told = RunConditions {
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
    Summary::new(told, &dataset(), &[MethodOutcomes { method, outcomes }])
}

/// A query is right at K if fewer than K references are more similar than its best true one.
fn brute_force(references: &[Descriptor], k: usize) -> f64 {
    let cosine = |a: &Descriptor, b: &Descriptor| -> f64 {
        a.as_slice().iter().zip(b.as_slice()).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
    };
    let (mut right, mut all) = (0, 0);
    for (place, query) in descriptors(QUERIES, 2).iter().enumerate() {
        let true_ones = truth(place);
        if true_ones.is_empty() {
            continue;
        }
        let best = true_ones
            .iter()
            .map(|&reference| cosine(query, &references[reference]))
            .fold(f64::NEG_INFINITY, f64::max);
        let above = references.iter().filter(|other| cosine(query, other) > best).count();
        all += 1;
        right += usize::from(above < k);
    }
    100.0 * f64::from(u32::try_from(right).unwrap()) / f64::from(all)
}

#[tokio::test]
async fn recalls_are_those_of_brute_force() {
    // Half of the queries' best true references are made near, so that no recall is 0 or 100.
    let mut references = descriptors(REFERENCES, 1);
    for (place, query) in descriptors(QUERIES, 2).iter().enumerate().step_by(2) {
        if let Some(&near) = truth(place).first() {
            let strength = (place % 7) as f32 / 7.0;
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
