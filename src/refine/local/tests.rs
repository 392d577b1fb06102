use super::*;

const CHANNELS: usize = 16;

/// A small xorshift generator for reproducible features that are unlike each other.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

/// A synthetic scene: the features of a point are a function of its position, which changes smoothly over
/// about a cell and is defined outside the picture too.
struct Scene {
    waves: Vec<[f32; 3]>,
}

impl Scene {
    fn new(seed: u64) -> Self {
        let mut noise = Noise(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
        let waves = (0..CHANNELS)
            .map(|_| [40.0 * noise.next(), 40.0 * noise.next(), 3.0 * noise.next()])
            .collect();
        Self { waves }
    }

    /// Returns a picture in which scene point `(x, y)` lies at `(s·(x − ½) + ½ + dx, …)`.
    fn picture(&self, height: usize, width: usize, scale: f32, shift: [f32; 2]) -> DenseFeatures {
        let mut cells = Vec::with_capacity(height * width * CHANNELS);
        for row in 0..height {
            for column in 0..width {
                let at = |cell: usize, cells: usize, shift: f32| {
                    ((cell as f32 + 0.5) / cells as f32 - 0.5 - shift) / scale + 0.5
                };
                let (x, y) = (at(column, width, shift[0]), at(row, height, shift[1]));
                cells.extend(self.waves.iter().map(|[a, b, c]| (a * x + b * y + c).sin()));
            }
        }
        features(height, width, cells)
    }
}

fn features(height: usize, width: usize, cells: Vec<f32>) -> DenseFeatures {
    let channels = cells.len() / (height * width);
    DenseFeatures::new(height, width, channels, cells, None).unwrap()
}

fn noise(seed: u64, height: usize, width: usize) -> DenseFeatures {
    let mut noise = Noise(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    features(height, width, (0..height * width * CHANNELS).map(|_| noise.next()).collect())
}

fn compare(query: &DenseFeatures, candidate: &DenseFeatures) -> PairMatch {
    LocalMatcher::default().compare(query, candidate).unwrap()
}

/// Returns a pair of which only the score matters.
fn scored(score: f32) -> PairMatch {
    PairMatch { score, ..compare(&noise(1, 4, 4), &noise(2, 4, 4)) }
}

#[test]
fn identical_features_agree_in_every_cell_and_nothing_moved() {
    let picture = noise(3, 12, 16);
    let pair = compare(&picture, &picture);
    assert_eq!((pair.matches.len(), pair.mutual, pair.cells), (192, 192, 192));
    assert!((pair.score - 1.0).abs() < 1e-5);
    assert!(pair.motion.shift().iter().all(|x| x.abs() < 1e-4));
    assert!((pair.motion.scale() - 1.0).abs() < 1e-4);
    assert!(pair.motion.rotation().abs() < 0.01);
    assert_eq!(pair.motion.support, 192);
}

#[test]
fn a_shifted_copy_recovers_its_shift() {
    let scene = Scene::new(4);
    let pair =
        compare(&scene.picture(24, 32, 1.0, [0.0, 0.0]), &scene.picture(24, 32, 1.0, [0.15, -0.1]));
    let [x, y] = pair.motion.shift();
    assert!((x - 0.15).abs() < 0.02 && (y + 0.1).abs() < 0.02, "{x} {y}");
    assert!((pair.motion.scale() - 1.0).abs() < 0.05);
}

#[test]
fn a_larger_copy_recovers_its_scale() {
    let scene = Scene::new(5);
    let near = scene.picture(24, 32, 1.3, [0.05, 0.0]);
    let far = scene.picture(24, 32, 1.0, [0.0, 0.0]);
    let closer = compare(&far, &near).motion;
    assert!((closer.scale() - 1.3).abs() < 0.06, "{}", closer.scale());
    assert!((closer.shift()[0] - 0.05).abs() < 0.02);
    let farther = compare(&near, &far).motion;
    assert!((farther.scale() - 1.0 / 1.3).abs() < 0.06, "{}", farther.scale());
}

#[test]
fn feature_maps_of_different_sizes_are_compared_in_fractions_of_the_picture() {
    let scene = Scene::new(6);
    let pair =
        compare(&scene.picture(16, 16, 1.0, [0.0; 2]), &scene.picture(24, 32, 1.0, [0.0; 2]));
    assert!(pair.matches.len() > 150, "{}", pair.matches.len());
    assert!(pair.motion.shift().iter().all(|x| x.abs() < 0.02));
}

#[test]
fn unrelated_features_score_far_below_the_same_place() {
    let scene = Scene::new(7);
    let query = scene.picture(24, 32, 1.0, [0.0; 2]);
    let same = scene.picture(24, 32, 1.1, [0.05, 0.02]);
    let pairs = LocalMatcher::default().compare_all(&query, &[&noise(8, 24, 32), &same]).unwrap();
    assert!(pairs[1].score > 20.0 * pairs[0].score, "{} {}", pairs[0].score, pairs[1].score);
    assert_eq!(rank(&pairs), [1, 0]);
}

#[test]
fn a_repeated_texture_matches_each_candidate_cell_at_most_once() {
    let mut tile = Noise(9);
    let tile: Vec<f32> = (0..CHANNELS).map(|_| tile.next()).collect();
    let wall = features(12, 16, tile.repeat(12 * 16));
    let pair = compare(&wall, &wall);
    assert!(pair.mutual <= 1, "{}", pair.mutual);
    assert!(pair.matches.is_empty());
}

#[test]
fn regions_that_every_candidate_shows_count_for_little() {
    let mut noise_of = Noise(10);
    let picture = |rim: &[f32], seed: u64| {
        let inside = noise(seed, 16, 16);
        let mut cells = inside.cells().to_vec();
        cells[..rim.len()].copy_from_slice(rim);
        features(16, 16, cells)
    };
    let rim: Vec<f32> = (0..8 * 16 * CHANNELS).map(|_| noise_of.next()).collect();
    let (query, other) = (picture(&rim, 11), picture(&rim, 12));
    let matcher = LocalMatcher::default();
    let alone = matcher.compare(&query, &other).unwrap();
    let among = matcher.compare_all(&query, &[&other, &query, &picture(&rim, 13)]).unwrap();
    assert!(alone.score > 0.4);
    assert!(among[0].score < 0.5 * alone.score);
    assert!(among[1].score > 2.0 * among[0].score);
    assert_eq!(among[1].distinctive, 256);
    assert_eq!(rank(&among), [1, 0, 2]);
}

#[test]
fn zero_cells_match_nothing_and_are_not_counted() {
    let scene = Scene::new(14);
    let whole = scene.picture(12, 16, 1.0, [0.0; 2]);
    let mut cells = whole.cells().to_vec();
    cells[..96 * CHANNELS].fill(0.0);
    let half = features(12, 16, cells);
    let pair = compare(&half, &whole);
    assert_eq!(pair.cells, 96);
    assert!(pair.matches.iter().all(|found| found.query[1] > 0.5));

    let blank = features(12, 16, vec![0.0; 192 * CHANNELS]);
    for pair in [compare(&blank, &whole), compare(&whole, &blank), compare(&blank, &blank)] {
        assert_eq!((pair.matches.len(), pair.mutual, pair.score), (0, 0, 0.0));
    }
}

#[test]
fn cells_with_nan_or_infinity_affect_only_themselves() {
    let scene = Scene::new(15);
    let whole = scene.picture(12, 16, 1.0, [0.0; 2]);
    let mut cells = whole.cells().to_vec();
    cells[40 * CHANNELS] = f32::NAN;
    cells[41 * CHANNELS + 3] = f32::INFINITY;
    let spoilt = features(12, 16, cells);
    for (query, candidate) in [(&spoilt, &whole), (&whole, &spoilt), (&spoilt, &spoilt)] {
        let pairs =
            LocalMatcher::default().compare_all(query, &[candidate, &noise(16, 12, 16)]).unwrap();
        assert!(pairs[0].matches.len() >= 188, "{}", pairs[0].matches.len());
        assert!(pairs.iter().all(|pair| pair.score.is_finite()));
        assert_eq!(rank(&pairs), [0, 1]);
    }
}

#[test]
fn a_single_cell_has_no_neighbourhood_and_scores_zero() {
    let pair = compare(&noise(17, 1, 1), &noise(17, 1, 1));
    assert_eq!((pair.mutual, pair.matches.len(), pair.score), (1, 0, 0.0));
}

#[test]
fn features_of_different_models_are_an_error() {
    let query = features(2, 2, vec![1.0; 4 * 8]);
    let candidate = features(2, 2, vec![1.0; 4 * 9]);
    let expected = LocalError { query: 8, candidate: 9 };
    let matcher = LocalMatcher::default();
    assert_eq!(matcher.compare(&query, &candidate), Err(expected));
    assert!(matcher.compare_all(&query, &[&query, &candidate]).is_err());
}

#[test]
fn nonsensical_settings_do_not_panic() {
    let scene = Scene::new(18);
    let query = scene.picture(8, 8, 1.0, [0.0; 2]);
    for bad in [f32::NAN, -1.0, 0.0, f32::INFINITY] {
        let settings = LocalSettings {
            min_similarity: bad,
            neighbourhood: bad,
            motion_tolerance: bad,
            grid_slack: bad,
            min_support: bad,
            vote_temperature: bad,
            motion_rounds: 2,
            first: 1,
            clear_evidence: bad,
        };
        let pairs = LocalMatcher::new(settings).compare_all(&query, &[&query, &query]).unwrap();
        assert!(pairs.iter().all(|pair| pair.score.is_finite()));
        assert!(!told(&pairs[0]).is_empty());
    }
}

#[test]
fn no_candidates_give_no_pairs() {
    let pairs = LocalMatcher::default().compare_all(&noise(19, 4, 4), &[]).unwrap();
    assert!(pairs.is_empty());
    assert!(rank(&pairs).is_empty());
}

#[test]
fn the_same_input_gives_the_same_output() {
    let scene = Scene::new(20);
    let query = scene.picture(24, 32, 1.0, [0.0; 2]);
    let candidate = scene.picture(24, 32, 1.2, [0.1, 0.0]);
    let first = LocalMatcher::default().compare_all(&query, &[&candidate, &query]).unwrap();
    let again = LocalMatcher::default().compare_all(&query, &[&candidate, &query]).unwrap();
    assert_eq!(first, again);
    assert_eq!(told(&first[0]), told(&again[0]));
}

#[test]
fn a_ranking_is_a_permutation_and_ties_keep_the_coarse_order() {
    let pairs = [0.2, 0.5, 0.2, f32::NAN, 0.5, 0.9, 0.0].map(scored);
    assert_eq!(rank(&pairs), [5, 1, 4, 0, 2, 3, 6]);
    assert_eq!(rank(&[f32::NAN, f32::NAN, 0.3].map(scored)), [2, 0, 1]);
}

#[test]
fn a_near_tie_keeps_the_coarse_order() {
    assert_eq!(rank(&[0.30, 0.32].map(scored)), [0, 1]);
    assert_eq!(rank(&[0.30, 0.34].map(scored)), [1, 0]);
}

#[test]
fn a_description_states_counts_regions_and_motion() {
    let scene = Scene::new(21);
    let query = scene.picture(24, 32, 1.0, [0.0; 2]);
    let pair = compare(&query, &scene.picture(24, 32, 1.2, [-0.35, 0.0]));
    let text = told(&pair);
    assert!(text.contains(&format!("{} of 768 regions", pair.matches.len())), "{text}");
    assert!(text.contains("35 % of the width to the left"), "{text}");
    assert!(text.contains("1.2 times larger"), "{text}");
    assert!(text.contains("taken from closer"), "{text}");
    assert!(text.contains("Hardly anything along the left edge"), "{text}");
    assert!(!text.contains("wrong answers"), "a verdict that is not measured: {text}");
}

#[test]
fn the_words_of_a_verdict_follow_from_the_confidence_and_the_threshold_of_known() {
    let scene = Scene::new(21);
    let query = scene.picture(24, 32, 1.0, [0.0; 2]);
    let pair = compare(&query, &scene.picture(24, 32, 1.2, [-0.35, 0.0]));
    let word = |confidence: f32, known_from: f64| {
        let text = describe(&pair, Standing { confidence: Some(confidence), known_from });
        let (_, verdict) = text.rsplit_once(". ").unwrap();
        verdict.to_owned()
    };
    assert!(word(0.9, 0.9).starts_with("Strong agreement: 90 % of"), "{}", word(0.9, 0.9));
    assert!(word(0.899, 0.9).starts_with("Some agreement: 89 % of"), "{}", word(0.899, 0.9));
    assert!(word(0.899, 0.8).starts_with("Strong agreement: 89 % of"));
    assert!(word(0.4, 0.9).starts_with("Weak agreement: 40 % of"), "{}", word(0.4, 0.9));
}

/// The description of a pair in a map that is not calibrated.
fn told(pair: &PairMatch) -> String {
    describe(pair, Standing { confidence: None, known_from: 0.9 })
}

#[test]
fn a_description_of_unrelated_pictures_says_that_nothing_agrees() {
    let blank = features(4, 4, vec![0.0; 16 * CHANNELS]);
    let text = told(&compare(&noise(22, 4, 4), &blank));
    assert!(text.starts_with("None of the 16 regions"), "{text}");
    assert!(text.contains("no sign that this is the same place"), "{text}");
}

#[test]
fn a_description_states_how_many_regions_have_no_better_counterpart_elsewhere() {
    let scene = Scene::new(23);
    let query = scene.picture(24, 32, 1.0, [0.0; 2]);
    let pairs = LocalMatcher::default()
        .compare_all(&query, &[&query, &scene.picture(24, 32, 1.4, [0.3, 0.0]), &noise(24, 24, 32)])
        .unwrap();
    let text = told(&pairs[0]);
    assert!(text.contains("in any of the other 2 candidates"), "{text}");
    assert!(text.contains("stayed where they were"), "{text}");
}

#[test]
fn candidates_that_are_compared_later_count_as_if_all_had_been_compared_together() {
    let scene = Scene::new(23);
    let query = scene.picture(24, 32, 1.0, [0.0; 2]);
    let (same, other, another) =
        (scene.picture(24, 32, 1.1, [0.05, 0.02]), noise(24, 24, 32), noise(25, 24, 32));
    let candidates = [&other, &another, &same];
    let (matcher, mut compared) = (LocalMatcher::default(), Compared::default());
    matcher.compare_more(&query, &candidates[..2], &mut compared).unwrap();
    matcher.compare_more(&query, &candidates, &mut compared).unwrap();
    let pairs = matcher.judge_all(&query, &candidates, &compared);
    assert_eq!(pairs, matcher.compare_all(&query, &candidates).unwrap());
}
