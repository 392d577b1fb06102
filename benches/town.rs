//! How fast the town is drawn, in pictures a second, on all cores and on one.

use std::time::Instant;

use rayon::prelude::*;
use whereabouts::demo::{Town, TownSpec};

const PICTURES: usize = 120;

fn main() {
    let town = Town::new(TownSpec { places: PICTURES, ..TownSpec::default() });
    let draw = |place: usize| {
        let shot =
            if place.is_multiple_of(2) { town.reference(place) } else { town.query(place, 0) };
        shot.image.len()
    };
    let start = Instant::now();
    let bytes: usize = (0..PICTURES).into_par_iter().map(draw).sum();
    let all = PICTURES as f64 / start.elapsed().as_secs_f64();
    let start = Instant::now();
    let again: usize = (0..PICTURES).map(draw).sum();
    let one = PICTURES as f64 / start.elapsed().as_secs_f64();
    assert_eq!(bytes, again);
    println!(
        "640×480: {all:.1} pictures/s on {} threads, {one:.1} on one; {:.2} × with all",
        rayon::current_num_threads(),
        all / one
    );
}
