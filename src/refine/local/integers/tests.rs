//! Comparisons against a reference implementation.

use super::*;
use crate::local::cell_matcher::CellMatcher;
use crate::local::nearest::tests::cells;

fn features(count: usize, channels: usize, seed: u32) -> DenseFeatures {
    DenseFeatures::new(1, count, channels, cells(count, channels, seed), None).unwrap()
}

/// The reference implementation: every similarity in 64 bits, with as many of the lowest given to the tag as `tag` has.
fn reference(
    query: &DenseFeatures,
    candidate: &DenseFeatures,
    tag: i64,
) -> (Vec<i64>, Vec<(usize, i64)>) {
    let round = |x: &f32| i64::from((x * ONE).round_ties_even() as i32);
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| round(a) * round(b)).sum();
    let channels = query.channels();
    let rows = |of: &DenseFeatures| -> Vec<Vec<f32>> {
        of.cells().chunks(channels).map(<[f32]>::to_vec).collect()
    };
    let (ours, theirs) = (rows(query), rows(candidate));
    let mut of_query = vec![i64::MIN; ours.len()];
    let of_candidate = theirs.iter().map(|their| {
        let mut best = (0, i64::MIN);
        for (index, our) in ours.iter().enumerate() {
            let similarity: i64 = dot(our, their);
            let similarity = (similarity & !tag) | (tag - (index / GROUP) as i64);
            of_query[index] = of_query[index].max(similarity);
            if similarity > best.1 {
                best = (index, similarity);
            }
        }
        best
    });
    let of_candidate = of_candidate.collect();
    (of_query, of_candidate)
}

#[test]
fn every_processor_finds_what_the_reference_implementation_finds() {
    assert!(cfg!(not(target_feature = "avx2")) || Processor::available().next().is_some());
    for processor in Processor::available() {
        for (ours, theirs, channels) in [
            (1, 1, 1),
            (40, 1, 3),
            (1, 13, 64),
            (32, 12, 64),
            (33, 11, 64),
            (97, 25, 24),
            (33, 31, 7),
            (150, 200, 64),
            (70, 60, 385),
            (1201, 37, 16),
        ] {
            let (query, candidate) = (features(ours, channels, 7), features(theirs, channels, 8));
            let mut integers = Integers::on(processor, &query);
            // Twice, because the memory is used again; between, a candidate of another size.
            for _ in 0..2 {
                integers.find(&features(5, channels, 9), 0.0);
                let found = integers.find(&candidate, -2.0);
                let what = format!("{processor:?}: {ours} × {theirs} × {channels}");
                let tag = i64::from(integers.query.tag);
                assert!((tag as usize) < 2 * ours.div_ceil(GROUP).next_multiple_of(2), "{what}");
                let (of_query, of_candidate) = reference(&query, &candidate, tag);
                let got = integers.found.of_query.iter().map(|x| i64::from(*x));
                assert_eq!(got.take(ours).collect::<Vec<_>>(), of_query, "{what}");
                let got = integers.found.of_candidate.iter();
                let got: Vec<_> = got.map(|(cell, x)| (*cell, i64::from(*x))).collect();
                assert_eq!(got, of_candidate, "{what}");
                assert_eq!(found.best.len(), ours, "{what}");
            }
        }
    }
}

#[test]
fn of_equal_cells_the_first_are_matched() {
    let one = [1.0, 0.0];
    let other = [0.0, 1.0];
    let query = [other, one, one].concat();
    let candidate = [one, other, one, other].concat();
    let query = DenseFeatures::new(1, 3, 2, query, None).unwrap();
    let candidate = DenseFeatures::new(1, 4, 2, candidate, None).unwrap();
    for processor in Processor::available() {
        let found = Integers::on(processor, &query).find(&candidate, 0.0);
        let pairs: Vec<_> = found.pairs.iter().map(|p| (p.query, p.candidate)).collect();
        assert_eq!(pairs, [(0, 1), (1, 0)]);
        assert!(found.pairs.iter().all(|pair| (pair.similarity - 1.0).abs() < 1e-4));
    }
}

#[test]
fn every_processor_finds_the_same() {
    for (ours, theirs) in [(16, 40), (17, 40), (33, 50), (1200, 300)] {
        let (query, candidate) = (features(ours, 64, 3), features(theirs, 64, 4));
        let found: Vec<Mutual> = Processor::available()
            .map(|processor| Integers::on(processor, &query).find(&candidate, 0.0))
            .collect();
        for pair in found.windows(2) {
            assert_eq!(pair[0].pairs, pair[1].pairs, "{ours} × {theirs}");
            assert_eq!(pair[0].best, pair[1].best, "{ours} × {theirs}");
        }
    }
}

#[test]
fn matches_are_those_of_floating_point_but_for_near_ties() {
    let (query, candidate) = (features(1200, 64, 5), features(1200, 64, 6));
    let mut floats = CellMatcher::of(&query, true);
    let floats = floats.find(&query, &candidate, 0.0).unwrap();
    for processor in Processor::available() {
        let found = Integers::on(processor, &query).find(&candidate, 0.0);
        for (ours, theirs) in found.best.iter().zip(&floats.best) {
            assert!((ours - theirs).abs() < 1e-4, "{ours} {theirs}");
        }
        let same = found.pairs.iter().filter(|pair| {
            floats
                .pairs
                .iter()
                .any(|other| (pair.query, pair.candidate) == (other.query, other.candidate))
        });
        let (same, all) = (same.count(), floats.pairs.len());
        assert!(all > 100 && same * 100 >= all * 98, "{same} of {all}");
    }
}
