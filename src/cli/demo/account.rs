//! What the demo says.

use std::time::Duration;

use super::super::localize::pose_text;
use super::pictures::picture_of;
use super::town::Folders;
use super::{Args, Choice, MAP, Visit, index, shown};
use whereabouts_core::Pose;
use whereabouts_town::SUCCESS_RADIUS_M;

/// Whether the first place was right.
pub struct Verdict {
    /// In the coarse order.
    pub before: bool,
    /// In the refined order.
    pub after: bool,
}

impl Verdict {
    /// Compares with the true pose.
    pub fn of(visit: &Visit) -> Self {
        let right = |pose: Option<Pose>| {
            pose.and_then(|pose| pose.distance_m(&visit.frame.pose))
                .is_some_and(|metres| metres <= SUCCESS_RADIUS_M)
        };
        let coarse = visit.answer.candidates.first();
        let refined = visit.job.ranking.as_ref().and_then(|ranking| ranking.first());
        Self {
            before: coarse.is_some_and(|first| right(first.pose)),
            after: refined.is_some_and(|first| right(first.pose)),
        }
    }
}

pub fn heading(args: &Args, text: &str) {
    if !args.json {
        println!("\n{text}");
    }
}

pub fn rendered(args: &Args, folders: &Folders, places: usize, took: Duration) {
    if !args.json {
        println!(
            "   drew {places} map images and {places} frames in {:.1} s: {} and {}",
            took.as_secs_f64(),
            shown(&folders.map),
            shown(&folders.frames)
        );
    }
}

pub fn chosen(args: &Args, choice: &Choice) {
    if !args.json {
        println!("   model {}: {}", choice.model, choice.why);
    }
}

pub fn indexed(args: &Args, outcome: &index::Outcome, server: &str) {
    if !args.json {
        println!("   indexed {} images at {server} in {:.1} s", outcome.images, outcome.seconds);
    }
}

/// The account of all visits, or the same as JSON.
pub fn visits(
    args: &Args,
    visits: &[Visit],
    choice: &Choice,
    folders: &Folders,
    took: Duration,
) -> anyhow::Result<()> {
    let verdicts: Vec<Verdict> = visits.iter().map(Verdict::of).collect();
    if args.json {
        println!("{}", as_json(visits, &verdicts, choice, took));
        return Ok(());
    }
    let told = telling(&verdicts);
    for &index in &told {
        tell(&visits[index], &verdicts[index], folders);
    }
    println!("   ... and {} more frames.\n", visits.len() - told.len());
    summary(visits, &verdicts, folders, took);
    Ok(())
}

/// One frame that refinement put right, one that was right anyway, one that stayed wrong.
fn telling(verdicts: &[Verdict]) -> Vec<usize> {
    let kinds = [(false, true), (true, true), (false, false)];
    let first = |kind| verdicts.iter().position(|v| (v.before, v.after) == kind);
    kinds.into_iter().filter_map(first).collect()
}

fn tell(visit: &Visit, verdict: &Verdict, folders: &Folders) {
    let mark = |right: bool| if right { "right" } else { "wrong" };
    println!(
        "\n   {} ({}), truly at {}",
        shown(&visit.frame.file),
        visit.frame.light,
        pose_text(Some(visit.frame.pose))
    );
    println!(
        "   answered in {:.1} ms by {}; the first candidate is {}:",
        visit.answer.timing_ms.total,
        visit.answer.model,
        mark(verdict.before)
    );
    for candidate in visit.answer.candidates.iter().take(3) {
        println!(
            "     {}. {}  similarity {:.3}  {}",
            candidate.rank,
            candidate.image_id,
            candidate.similarity,
            pose_text(candidate.pose)
        );
    }
    println!(
        "   the job compared {} pairs ({}); its first is {}:",
        visit.job.descriptions.len(),
        visit.job.refiner,
        mark(verdict.after)
    );
    let ranking = visit.job.ranking.iter().flat_map(|ranking| ranking.as_slice());
    for place in ranking.clone().take(3) {
        println!("     {}. {}  (was {})", place.rank, place.image_id, place.coarse_rank);
    }
    let first = ranking.clone().next();
    let text = visit
        .job
        .descriptions
        .iter()
        .find(|text| first.is_some_and(|first| first.image_id == text.image_id));
    if let Some(text) = text {
        println!("   of the first it says: {}", text.text);
    }
    println!("   picture: {}", shown(&picture_of(visit, folders)));
}

fn summary(visits: &[Visit], verdicts: &[Verdict], folders: &Folders, took: Duration) {
    let outcome = Outcome::of(visits, verdicts);
    println!("4. The outcome");
    println!(
        "   R@1 before refinement {:.1} %, after {:.1} %  (within {SUCCESS_RADIUS_M} m, {} frames; \
         {} put right, {} spoilt)",
        outcome.before,
        outcome.after,
        visits.len(),
        outcome.helped,
        outcome.harmed
    );
    println!(
        "   /localize median {:.1} ms; a job median {:.0} ms for {} pairs",
        outcome.localize_ms,
        outcome.job_ms,
        visits.first().map_or(0, |visit| visit.job.descriptions.len())
    );
    println!("   pictures of every frame beside its candidates: {}", shown(&folders.pictures));
    println!("   all of it took {:.1} s", took.as_secs_f64());
    println!("\n5. The same by hand");
    println!("   target/release/whereabouts serve --data {} &", shown(&folders.data));
    println!("   target/release/whereabouts index {} --map {MAP}", shown(&folders.map));
    let frame = visits.first().map_or_else(String::new, |visit| shown(&visit.frame.file));
    println!(
        "   curl -H 'Content-Type: image/jpeg' --data-binary @{frame} \\\n     \
         'http://127.0.0.1:8080/localize?map={MAP}&k=10'"
    );
    println!("   curl 'http://127.0.0.1:8080/jobs?map={MAP}&limit=1'");
}

struct Outcome {
    before: f64,
    after: f64,
    helped: usize,
    harmed: usize,
    localize_ms: f64,
    job_ms: f64,
}

impl Outcome {
    fn of(visits: &[Visit], verdicts: &[Verdict]) -> Self {
        let count = |test: fn(&Verdict) -> bool| verdicts.iter().filter(|v| test(v)).count();
        let percent = |right: usize| 100.0 * right as f64 / verdicts.len().max(1) as f64;
        let job_ms = |visit: &Visit| {
            let worked = visit.job.started_at.zip(visit.job.finished_at);
            worked.map_or(0.0, |(start, end)| end.duration_since(start).as_secs_f64() * 1e3)
        };
        Self {
            before: percent(count(|v| v.before)),
            after: percent(count(|v| v.after)),
            helped: count(|v| !v.before && v.after),
            harmed: count(|v| v.before && !v.after),
            localize_ms: median(visits.iter().map(|visit| visit.answer.timing_ms.total)),
            job_ms: median(visits.iter().map(job_ms)),
        }
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

fn as_json(
    visits: &[Visit],
    verdicts: &[Verdict],
    choice: &Choice,
    took: Duration,
) -> serde_json::Value {
    let outcome = Outcome::of(visits, verdicts);
    serde_json::json!({
        "queries": visits.len(),
        "model": choice.model,
        "why": choice.why,
        "recall_at_1": { "before": outcome.before, "after": outcome.after },
        "helped": outcome.helped,
        "harmed": outcome.harmed,
        "localize_ms": outcome.localize_ms,
        "job_ms": outcome.job_ms,
        "seconds": took.as_secs_f64(),
    })
}
