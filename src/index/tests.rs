//! Search, sealing and removal on vectors in memory.

use super::test_rows::*;
use super::*;

#[test]
fn the_graph_finds_what_exact_search_finds() {
    let rows = clustered(1500, 48);
    let index = filled(&rows);
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 200, &threads()).or(sealed);
    }
    assert_eq!(index.graphed(), 1500);
    let sealed = sealed.unwrap();
    assert_eq!((sealed.len(), sealed.end(), sealed.dim()), (1500, 1500, 48));
    let (mut same, mut all) = (0, 0);
    for query in rows.0.iter().step_by(15) {
        let exact = index.search(&rows, query, 10, SearchMode::Exact);
        let fast = index.search(&rows, query, 10, SearchMode::Fast);
        assert_eq!(fast.len(), 10);
        same += exact.iter().filter(|e| fast.iter().any(|f| f.slot == e.slot)).count();
        all += exact.len();
    }
    assert!(same * 100 >= all * 99, "recall@10 is {same}/{all}");
}

#[test]
fn a_scan_of_all_points_finds_what_exact_search_finds() {
    // A fifth of the images are equal to others, and a third of all are removed.
    let mut rows = clustered(1500, 48);
    for slot in (0..1500).step_by(5) {
        rows.0[slot] = rows.0[slot * 7 % 1500].clone();
    }
    let index = filled(&rows);
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 200, &threads()).or(sealed);
    }
    let sealed = sealed.unwrap();
    let keep = |slot: usize| !slot.is_multiple_of(3);
    (0..1500).filter(|slot| !keep(*slot)).for_each(|slot| index.remove(slot));
    for (k, ef) in [(1, 1), (10, 64), (10, 4), (2000, 64)] {
        for query in rows.0.iter().step_by(31) {
            let exact = index.search(&rows, query, k, SearchMode::Exact);
            assert_eq!(sealed.scan(&rows, query, (k, ef), keep), exact, "k {k}, ef {ef}");
        }
    }
}

#[test]
fn a_sealed_graph_round_trips_and_detects_damage() {
    let rows = clustered(400, 20);
    let index = filled(&rows);
    let mut sealed = None;
    while index.has_work() {
        sealed = index.catch_up(&rows, 100, &threads()).or(sealed);
    }
    let mut bytes = sealed.unwrap().to_bytes();
    let restored = filled(&rows);
    restored.restore(SealedGraph::from_bytes(&bytes).unwrap());
    assert_eq!((restored.graphed(), restored.has_work()), (400, false));
    for query in rows.0.iter().step_by(37) {
        let search = |index: &MapIndex| index.search(&rows, query, 5, SearchMode::Fast);
        assert_eq!(search(&restored), search(&index));
    }
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    assert!(SealedGraph::from_bytes(&bytes).is_err());
    bytes[middle] ^= 1;
    assert!(SealedGraph::from_bytes(&bytes[..bytes.len() - 1]).is_err());
    assert!(SealedGraph::from_bytes(&[]).is_err());
}

#[test]
fn graphs_are_merged_as_a_map_grows_and_every_image_is_found_meanwhile() {
    let rows = clustered(1000, 24);
    let index = MapIndex::new(SETTINGS);
    let mut seals = Vec::new();
    for slot in 0..1000 {
        index.add(slot);
        // Images arrive in bursts, between which the indexer catches up.
        while slot % 100 == 70 && index.has_work() {
            seals.extend(index.catch_up(&rows, 16, &threads()).map(|sealed| sealed.end()));
        }
        if slot % 50 == 0 {
            let found = index.search(&rows, &rows.0[slot], 1, SearchMode::Fast);
            assert_eq!(found[0].slot, slot);
        }
    }
    while index.has_work() {
        seals.extend(index.catch_up(&rows, 16, &threads()).map(|sealed| sealed.end()));
    }
    assert!(seals.len() > 1 && seals.is_sorted(), "{seals:?}");
    assert_eq!(index.graphed(), 1000);
    for slot in (0..1000).step_by(13) {
        let found = index.search(&rows, &rows.0[slot], 1, SearchMode::Fast);
        assert_eq!(found[0].slot, slot);
    }
}

#[test]
fn an_image_is_found_before_it_is_in_the_graph() {
    let rows = clustered(250, 16);
    let index = MapIndex::new(SETTINGS);
    let found = |slot: usize| index.search(&rows, &rows.0[slot], 1, SearchMode::Fast)[0].slot;
    (0..200).for_each(|slot| index.add(slot));
    index.catch_up(&rows, 100, &threads());
    index.catch_up(&rows, 100, &threads());
    assert_eq!((index.graphed(), found(7), found(199)), (0, 7, 199));
    caught_up(&index, &rows);
    assert_eq!(index.graphed(), 200);
    (200..250).for_each(|slot| index.add(slot));
    index.catch_up(&rows, 25, &threads());
    assert_eq!((index.graphed(), found(7), found(220), found(249)), (225, 7, 220, 249));
}

/// What robots leave that stand still: pictures that hardly differ, of very many places.
#[test]
fn no_place_is_lost_among_many_of_which_there_are_many_images() {
    let rows = around(400, 0.2, 20_000, 32);
    let settings = IndexSettings { m: 8, ef_construction: 40, ef_search: 32, ..SETTINGS };
    let index = MapIndex::new(settings);
    (0..20_000).for_each(|slot| index.add(slot));
    while index.has_work() {
        index.catch_up(&rows, 1000, &threads());
    }
    let lost = (0..20_000).step_by(10).filter(|&slot| {
        let found = index.search(&rows, &rows.0[slot], 10, SearchMode::Fast);
        found.iter().all(|found| found.slot % 400 != slot % 400)
    });
    assert_eq!(lost.count(), 0);
}

#[test]
fn a_removed_image_is_never_found() {
    let rows = clustered(300, 16);
    let index = filled(&rows);
    while index.has_work() {
        index.catch_up(&rows, 64, &threads());
    }
    for slot in (0..300).step_by(2) {
        index.remove(slot);
    }
    index.remove(0);
    assert_eq!(index.len(), 150);
    for mode in [SearchMode::Fast, SearchMode::Exact] {
        let found = index.search(&rows, &rows.0[8], 20, mode);
        assert_eq!(found.len(), 20, "{mode:?}");
        assert!(found.iter().all(|found| found.slot % 2 == 1), "{mode:?}");
    }
}

#[test]
fn a_graph_with_too_many_removed_points_is_rebuilt_without_them() {
    let rows = clustered(400, 16);
    let index = filled(&rows);
    let threads = threads();
    let catch_up = || {
        let mut sealed = None;
        while index.has_work() {
            sealed = index.catch_up(&rows, 64, &threads).or(sealed);
        }
        sealed.map(|sealed| sealed.len())
    };
    assert_eq!(catch_up(), Some(400));
    (0..100).for_each(|slot| index.remove(slot));
    assert_eq!(catch_up(), None);
    (100..125).for_each(|slot| index.remove(slot));
    assert_eq!(catch_up(), Some(275));
    let found = index.search(&rows, &rows.0[200], 1, SearchMode::Fast);
    assert_eq!(found[0].slot, 200);
}

#[test]
fn a_small_map_never_builds_a_graph() {
    let rows = clustered(100, 8);
    let index = filled(&rows);
    index.catch_up(&rows, 1000, &threads());
    assert_eq!(index.graphed(), 0);
    assert_eq!(index.search(&rows, &rows.0[3], 500, SearchMode::Fast).len(), 100);
}

#[test]
fn an_empty_map_returns_nothing() {
    let index = MapIndex::new(SETTINGS);
    assert!(index.search(&clustered(1, 8), &[0.0; 8], 10, SearchMode::Fast).is_empty());
}

/// Builds whatever waits to be built.
pub(super) fn caught_up(index: &MapIndex, rows: &Rows) {
    while index.has_work() {
        index.catch_up(rows, 1000, &threads());
    }
}

/// The number of live slots whose own descriptor finds neither them nor a twin first.
pub(super) fn lost(index: &MapIndex, rows: &Rows) -> usize {
    let misses = |slot: &usize| {
        let found = index.search(rows, &rows.0[*slot], 10, SearchMode::Fast);
        found.first().is_none_or(|first| rows.0[first.slot] != rows.0[*slot])
    };
    let live = index.live().slots.clone();
    (0..rows.0.len()).filter(|slot| live[*slot]).filter(misses).count()
}

/// An index of all rows: the first `sealed` of them in the sealed graph, the rest in the growing one, because they
/// arrive a few at a time.
pub(super) fn grown(rows: &Rows, sealed: usize, settings: IndexSettings) -> MapIndex {
    let index = MapIndex::new(settings);
    (0..sealed).for_each(|slot| index.add(slot));
    caught_up(&index, rows);
    for slot in sealed..rows.0.len() {
        index.add(slot);
        if slot % 32 == 0 {
            caught_up(&index, rows);
        }
    }
    caught_up(&index, rows);
    index
}

pub(super) const DEFAULTS: IndexSettings = IndexSettings {
    exact_up_to: 0,
    m: 16,
    ef_construction: 200,
    ef_search: 96,
    max_dead_share: 0.3,
    threads: 0,
    check_s: 0,
};

#[test]
fn identical_images_crowd_no_other_image_out() {
    for (twins, others) in [(600, 900), (10_000, 2000)] {
        let mut rows = around(900, 0.6, twins + others, 32);
        let picture = rows.0[0].clone();
        rows.0[..twins].fill(picture);
        for sealed in [rows.0.len(), twins + others * 2 / 3] {
            let index = grown(&rows, sealed, DEFAULTS);
            assert_eq!(lost(&index, &rows), 0, "{twins} twins, {sealed} of {others} others sealed");
            assert_eq!(index.graphs().sealed.as_ref().unwrap().unreachable(), 0);
        }
    }
}

#[test]
fn identical_images_that_arrive_in_the_growing_graph_crowd_no_other_image_out() {
    let mut rows = around(1000, 0.6, 3000, 32);
    let picture = rows.0[0].clone();
    rows.0[1600..2200].fill(picture);
    let index = grown(&rows, 1600, DEFAULTS);
    assert!(index.graphs().growing.is_some(), "the rest is in the growing graph");
    assert_eq!(lost(&index, &rows), 0);
}

#[test]
fn of_equal_images_that_arrive_in_the_growing_graph_the_first_are_found() {
    let mut rows = around(1000, 0.6, 1400, 32);
    let picture = rows.0[1200].clone();
    rows.0[1200..1400].fill(picture.clone());
    let index = MapIndex::new(DEFAULTS);
    (0..1100).for_each(|slot| index.add(slot));
    caught_up(&index, &rows);
    // They arrive at once, and several threads insert them.
    (1100..1400).for_each(|slot| index.add(slot));
    let several = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
    while index.has_work() {
        index.catch_up(&rows, 1000, &several);
    }
    let found = index.search(&rows, &picture, 10, SearchMode::Fast);
    assert!(index.graphs().growing.is_some());
    assert!(found.iter().map(|found| found.slot).eq(1200..1210), "{found:?}");
}

#[test]
fn many_images_that_arrive_at_once_are_built_into_a_new_graph() {
    let rows = around(1000, 0.6, 2000, 32);
    for (at_once, is_whole) in [(400, false), (600, true)] {
        let (sealed, all) = (1400, 1400 + at_once);
        let index = MapIndex::new(DEFAULTS);
        (0..sealed).for_each(|slot| index.add(slot));
        caught_up(&index, &rows);
        (sealed..all).for_each(|slot| index.add(slot));
        caught_up(&index, &rows);
        let graphs = index.graphs().clone();
        assert_eq!((graphs.sealed_end() == all, graphs.growing.is_none()), (is_whole, is_whole));
        assert_eq!(graphs.graphed, all);
    }
}

#[test]
fn a_robot_that_stands_still_hides_no_other_place() {
    // 100 frames that hardly differ at each of 100 places, in the order in which they are taken.
    let spread = around(100, 0.1, 10_000, 32);
    let rows = Rows((0..10_000).map(|i| spread.0[i / 100 + i % 100 * 100].clone()).collect());
    // All are sealed, or half of them are in the growing graph.
    for sealed in [10_000, 5_100] {
        let index = grown(&rows, sealed, DEFAULTS);
        assert_eq!(index.graphs().growing.is_some(), sealed < 10_000);
        assert_eq!(lost(&index, &rows), 0);
        let places = (0..rows.0.len()).step_by(7).filter(|&slot| {
            let found = index.search(&rows, &rows.0[slot], 10, SearchMode::Fast);
            found.iter().any(|found| found.slot / 100 != slot / 100)
        });
        assert_eq!(places.count(), 0, "ten frames of a place are nearer than any of another");
    }
}

#[test]
fn a_removed_twin_leaves_the_others() {
    let mut rows = around(100, 0.6, 300, 16);
    let picture = rows.0[0].clone();
    rows.0[..50].fill(picture.clone());
    let index = grown(&rows, 300, DEFAULTS);
    (0..49).for_each(|slot| index.remove(slot));
    assert_eq!(index.search(&rows, &picture, 1, SearchMode::Fast)[0].slot, 49);
    index.remove(49);
    assert_ne!(index.search(&rows, &picture, 1, SearchMode::Fast)[0].slot, 49);
}

#[test]
fn a_graph_file_with_an_index_out_of_bounds_is_refused() {
    let rows = around(10, 0.6, 100, 8);
    let index = grown(&rows, 100, DEFAULTS);
    let sealed = index.graphs().sealed.clone().unwrap();
    let bytes = sealed.to_bytes();
    assert_eq!(SealedGraph::from_bytes(&bytes).as_ref(), Ok(&*sealed));
    for at in (12..bytes.len() - 4).step_by(4) {
        let mut forged = bytes.clone();
        forged[at..at + 4].copy_from_slice(&0x7fff_fff0_u32.to_le_bytes());
        let checksum = crc32fast::hash(&forged[12..]).to_le_bytes();
        forged[8..12].copy_from_slice(&checksum);
        if let Ok(read) = SealedGraph::from_bytes(&forged) {
            // It differs in numbers that are no indices; a search still works.
            let _ = read.search(&rows, &rows.0[0], (5, 32), |_| true);
            let _ = read.unreachable();
        }
    }
}
