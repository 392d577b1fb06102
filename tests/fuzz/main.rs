//! Mutated input for every parser of untrusted data. Nothing may panic, and accepted input must satisfy the
//! invariants of its parser.
//!
//! Each target starts from inputs that are whole, and from those in `tests/fuzz/found/TARGET/`, which once
//! failed. `make fuzz` runs a million mutations, `make test` some thousands; the seed decides which.

#![allow(
    clippy::expect_used,
    clippy::panic,
    clippy::unwrap_used,
    reason = "clippy lets tests do this, but not what tests call"
)]

mod mutate;
mod seeds;
mod targets;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

use mutate::Mutator;

/// Mutations of each target in `make test`.
const RUNS: usize = 1500;
/// Maximum time for an input of a few kilobytes, on a busy machine.
const SLOWEST: Duration = Duration::from_secs(5);

fn number(name: &str, default: usize) -> usize {
    std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
}

fn fuzz(target: &str, seeds: Vec<Vec<u8>>, read: fn(&[u8]) -> bool) {
    let runs = number("WHEREABOUTS_FUZZ_RUNS", RUNS);
    let seed = number("WHEREABOUTS_FUZZ_SEED", 1);
    for seed in &seeds {
        assert!(run(target, seed, read), "a whole input of {target} is refused");
    }
    let found = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/found").join(target);
    let found = std::fs::read_dir(found).into_iter().flatten().flatten();
    let found: Vec<Vec<u8>> = found.map(|file| std::fs::read(file.path()).unwrap()).collect();
    for input in &found {
        run(target, input, read);
    }
    let mut mutator = Mutator::new(seed as u64, seeds.into_iter().chain(found).collect());
    let (mut accepted, mut slowest) = (0, Duration::ZERO);
    for _ in 0..runs {
        let input = mutator.next_input();
        let start = Instant::now();
        accepted += usize::from(run(target, &input, read));
        slowest = slowest.max(start.elapsed());
    }
    println!("{target}: {runs} mutations (seed {seed}), {accepted} accepted, slowest {slowest:?}");
}

/// Runs one input; saves it if it fails.
fn run(target: &str, input: &[u8], read: fn(&[u8]) -> bool) -> bool {
    let start = Instant::now();
    let outcome = catch_unwind(AssertUnwindSafe(|| read(input)));
    let took = start.elapsed();
    match outcome {
        Ok(accepted) if took < SLOWEST => return accepted,
        _ => {}
    }
    let file = std::env::temp_dir().join(format!("{target}-{}", uuid::Uuid::now_v7()));
    std::fs::write(&file, input).unwrap();
    panic!(
        "{target} failed or took too long ({took:?}); the input is {}: mend it, and keep the input in \
         tests/fuzz/found/{target}/",
        file.display()
    );
}

#[test]
fn pictures() {
    fuzz("pictures", seeds::pictures(), targets::picture);
}

#[test]
fn manifests() {
    fuzz("manifests", seeds::manifests(), targets::manifest);
}

#[test]
fn graphs() {
    fuzz("graphs", seeds::graphs(), targets::graph);
}

#[test]
fn archives() {
    fuzz("archives", seeds::archives(), targets::archive);
}

#[test]
fn poses() {
    fuzz("poses", seeds::poses(), targets::poses);
}

#[test]
fn exif_positions() {
    fuzz("exif", seeds::exif(), targets::exif);
}

#[test]
fn ground_truths() {
    fuzz("truths", seeds::truths(), targets::truth);
}

#[test]
fn forms() {
    fuzz("forms", seeds::forms(), targets::form);
}

#[test]
fn responses_of_language_model_servers() {
    fuzz("completions", seeds::completions(), targets::completion);
}

#[test]
fn answers_of_language_models() {
    fuzz("answers", seeds::answers(), targets::answer);
}
