//! Packed ranks and quantised similarities.

use super::*;

#[test]
fn packed_similarities_sort_by_similarity() {
    let similarities = [-1.0, -0.5, -0.0, 0.0, 1e-9, 0.5, 1.0];
    let ranks: Vec<u64> = similarities.iter().map(|&s| ranked(s, 7)).collect();
    assert!(ranks.is_sorted());
    assert_eq!(point_of(ranked(-0.3, 12)), 12);
}

#[test]
fn quantised_similarities_are_accurate_to_a_hundredth() {
    let wave = |phase: f32| -> Vec<f32> {
        let wave: Vec<f32> = (0..384).map(|i| (i as f32 * 0.7 + phase).sin()).collect();
        let norm = wave.iter().map(|x| x * x).sum::<f32>().sqrt();
        wave.iter().map(|x| x / norm).collect()
    };
    let a = wave(0.0);
    for phase in [0.0, 0.3, 1.5, 3.0] {
        let b = wave(phase);
        let (mut ca, mut cb) = (Vec::new(), Vec::new());
        let (sa, sb) = (quantise(&a, &mut ca), quantise(&b, &mut cb));
        let coded = coded_dot(&ca, &cb) as f32 * sa * sb;
        assert!((coded - dot(&a, &b)).abs() < 0.01);
    }
}
