//! How fast the town is drawn, in pictures a second, on all cores and on one.

use std::time::Instant;

use rayon::prelude::*;
use whereabouts_town::{Town, TownSpec};

const PICTURES: usize = 160;

fn main() -> Result<(), rayon::ThreadPoolBuildError> {
    let town = Town::new(TownSpec { places: PICTURES, ..TownSpec::default() });
    let draw = |place: usize| {
        let shot =
            if place.is_multiple_of(2) { town.reference(place) } else { town.query(place, 0) };
        shot.image.len()
    };
    let all_of_them = || (0..PICTURES).into_par_iter().map(draw).sum::<usize>();
    let start = Instant::now();
    let bytes = all_of_them();
    let all = PICTURES as f64 / start.elapsed().as_secs_f64();
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let start = Instant::now();
    let again = alone.install(all_of_them);
    let one = PICTURES as f64 / start.elapsed().as_secs_f64();
    assert_eq!(bytes, again);
    println!(
        "640×480: {all:.1} pictures/s on {} threads, {one:.1} on one; {:.2} × with all",
        rayon::current_num_threads(),
        all / one
    );
    Ok(())
}
