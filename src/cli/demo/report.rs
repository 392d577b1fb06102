//! What the demo prints.

use std::time::Duration;

use super::super::localize::format_pose;
use super::town::DemoFolders;
use super::{LocalizedFrame, MAP, ModelChoice, index, shown};
use whereabouts_api::MapTexts;
use whereabouts_core::Pose;
use whereabouts_town::SUCCESS_RADIUS_M;

/// Whether the first candidate of a frame is correct.
pub struct Verdict {
    /// In the coarse order.
    pub before: bool,
    /// In the refined order.
    pub after: bool,
}

impl Verdict {
    /// Compares the first candidates with the true pose.
    pub fn of(localized: &LocalizedFrame) -> Self {
        let is_correct = |pose: Option<Pose>| {
            pose.and_then(|pose| pose.distance_m(&localized.frame.pose))
                .is_some_and(|metres| metres <= SUCCESS_RADIUS_M)
        };
        let coarse = localized.answer.candidates.first();
        let refined = localized.job.ranking.as_ref().and_then(|ranking| ranking.first());
        Self {
            before: coarse.is_some_and(|first| is_correct(first.pose)),
            after: refined.is_some_and(|first| is_correct(first.pose)),
        }
    }
}

/// Prints each step as it happens or, with `--json`, only the result.
#[derive(Clone, Copy)]
pub struct Reporter {
    pub json: bool,
}

impl Reporter {
    pub fn heading(self, text: &str) {
        if !self.json {
            println!("\n{text}");
        }
    }

    pub fn rendered(self, folders: &DemoFolders, places: usize, elapsed: Duration) {
        if !self.json {
            println!(
                "   rendered {places} map images and {places} frames in {:.1} s: {} and {}",
                elapsed.as_secs_f64(),
                shown(&folders.map),
                shown(&folders.frames)
            );
        }
    }

    pub fn model(self, choice: &ModelChoice) {
        if !self.json {
            println!("   model {}: {}", choice.model, choice.reason);
        }
    }

    pub fn indexed(self, report: &index::IndexReport, server: &str) {
        if !self.json {
            println!("   indexed {} images at {server} in {:.1} s", report.images, report.seconds);
        }
    }

    pub fn read(self, texts: Option<&MapTexts>) {
        if self.json {
            return;
        }
        match texts {
            Some(texts) => {
                println!("   read {} lines on signs in {} images", texts.lines, texts.read)
            }
            None => println!("   signs are not read; `make reader` installs what reads them"),
        }
    }

    /// Prints three frames in detail and the figures of all.
    pub fn results(
        self,
        localized: &[LocalizedFrame],
        choice: &ModelChoice,
        folders: &DemoFolders,
        elapsed: Duration,
    ) {
        let verdicts: Vec<Verdict> = localized.iter().map(Verdict::of).collect();
        let figures = Figures::of(localized, &verdicts);
        if self.json {
            println!("{}", figures.to_json(localized.len(), choice, elapsed));
            return;
        }
        let examples = choose_examples(&verdicts);
        for &index in &examples {
            print_example(&localized[index], &verdicts[index], folders);
        }
        println!("   ... and {} more frames.\n", localized.len() - examples.len());
        print_figures(&figures, localized, folders, elapsed);
        print_commands(localized, folders);
    }
}

/// Returns the first frame that refinement corrected, the first that was correct before and after, and the
/// first that stayed wrong.
fn choose_examples(verdicts: &[Verdict]) -> Vec<usize> {
    let kinds = [(false, true), (true, true), (false, false)];
    let first = |kind| verdicts.iter().position(|v| (v.before, v.after) == kind);
    kinds.into_iter().filter_map(first).collect()
}

fn print_example(localized: &LocalizedFrame, verdict: &Verdict, folders: &DemoFolders) {
    let LocalizedFrame { frame, answer, job } = localized;
    let mark = |correct: bool| if correct { "correct" } else { "wrong" };
    println!(
        "\n   {} ({}), true pose {}",
        shown(&frame.file),
        frame.light,
        format_pose(Some(frame.pose))
    );
    println!(
        "   answered in {:.1} ms with {}; the first candidate is {}:",
        answer.timing_ms.total,
        answer.model,
        mark(verdict.before)
    );
    for candidate in answer.candidates.iter().take(3) {
        println!(
            "     {}. {}  similarity {:.3}  {}",
            candidate.rank,
            candidate.image_id,
            candidate.similarity,
            format_pose(candidate.pose)
        );
    }
    println!(
        "   the job compared {} pairs ({}); its first candidate is {}:",
        job.descriptions.len(),
        job.refiner,
        mark(verdict.after)
    );
    let mut ranking = job.ranking.iter().flat_map(|ranking| ranking.as_slice());
    for candidate in ranking.clone().take(3) {
        println!(
            "     {}. {}  (was {})",
            candidate.rank, candidate.image_id, candidate.coarse_rank
        );
    }
    let description = ranking.next().and_then(|first| {
        job.descriptions.iter().find(|description| description.image_id == first.image_id)
    });
    if let Some(description) = description {
        println!("   its description: {}", description.text);
    }
    println!("   image: {}", shown(&folders.picture_of(frame)));
}

fn print_figures(
    figures: &Figures,
    localized: &[LocalizedFrame],
    folders: &DemoFolders,
    elapsed: Duration,
) {
    println!("4. Results");
    println!(
        "   R@1 before refinement {:.1} %, after {:.1} %  (within {SUCCESS_RADIUS_M} m, {} frames; \
         {} corrected, {} made worse)",
        figures.before,
        figures.after,
        localized.len(),
        figures.helped,
        figures.harmed
    );
    println!(
        "   median latency: /localize {:.1} ms; a job of {} pairs {:.0} ms",
        figures.localize_ms,
        localized.first().map_or(0, |localized| localized.job.descriptions.len()),
        figures.job_ms
    );
    println!("   images of every frame next to its candidates: {}", shown(&folders.pictures));
    println!("   total time {:.1} s", elapsed.as_secs_f64());
}

fn print_commands(localized: &[LocalizedFrame], folders: &DemoFolders) {
    println!("\n5. The same by hand");
    let command = std::env::args().next().unwrap_or_else(|| "whereabouts".into());
    println!("   {command} serve --data {} &", shown(&folders.data));
    println!("   {command} index {} --map {MAP}", shown(&folders.map));
    let frame = localized.first().map_or_else(String::new, |first| shown(&first.frame.file));
    println!(
        "   curl -H 'Content-Type: image/jpeg' --data-binary @{frame} \\\n     \
         'http://127.0.0.1:8080/localize?map={MAP}&k=10'"
    );
    println!("   curl 'http://127.0.0.1:8080/jobs?map={MAP}&limit=1'");
}

/// The figures of all frames.
struct Figures {
    /// Recall@1 in percent, in the coarse order.
    before: f64,
    /// Recall@1 in percent, in the refined order.
    after: f64,
    helped: usize,
    harmed: usize,
    localize_ms: f64,
    job_ms: f64,
}

impl Figures {
    fn of(localized: &[LocalizedFrame], verdicts: &[Verdict]) -> Self {
        let count = |test: fn(&Verdict) -> bool| verdicts.iter().filter(|v| test(v)).count();
        let percent = |count: usize| 100.0 * count as f64 / verdicts.len().max(1) as f64;
        let job_ms = |localized: &LocalizedFrame| {
            let span = localized.job.started_at.zip(localized.job.finished_at);
            span.map_or(0.0, |(start, end)| end.duration_since(start).as_secs_f64() * 1e3)
        };
        Self {
            before: percent(count(|v| v.before)),
            after: percent(count(|v| v.after)),
            helped: count(|v| !v.before && v.after),
            harmed: count(|v| v.before && !v.after),
            localize_ms: median(localized.iter().map(|one| one.answer.timing_ms.total)),
            job_ms: median(localized.iter().map(job_ms)),
        }
    }

    fn to_json(
        &self,
        queries: usize,
        choice: &ModelChoice,
        elapsed: Duration,
    ) -> serde_json::Value {
        serde_json::json!({
            "queries": queries,
            "model": choice.model,
            "why": choice.reason,
            "recall_at_1": { "before": self.before, "after": self.after },
            "helped": self.helped,
            "harmed": self.harmed,
            "localize_ms": self.localize_ms,
            "job_ms": self.job_ms,
            "seconds": elapsed.as_secs_f64(),
        })
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}
