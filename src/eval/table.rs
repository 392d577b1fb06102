//! The outcome as the field prints it: one line for each method, R@1, R@5, R@10.

use std::fmt::{self, Write};

use super::recall::Change;
use super::{MethodSummary, Summary};

/// The table with what belongs to it, for a terminal of 80 columns.
pub fn table(summary: &Summary) -> String {
    let mut text = String::new();
    // Writing to a String never fails.
    let _ = write(summary, &mut text);
    text
}

fn write(summary: &Summary, out: &mut String) -> fmt::Result {
    let Summary { queries, skipped, unknown, references, told, methods } = summary;
    writeln!(
        out,
        "{queries} queries, {references} references; model {} ({})",
        told.model, told.execution
    )?;
    writeln!(out, "a reference is true if it is {}", told.truth)?;
    if *skipped > 0 {
        writeln!(out, "{skipped} more queries have no true reference and are left out")?;
    }
    if *unknown > 0 {
        writeln!(out, "{unknown} more queries are from places that are not in the map")?;
    }
    writeln!(out, "\n{:<11} {:>14} {:>14} {:>14}", "", "R@1", "R@5", "R@10")?;
    for method in methods {
        let cell = |recall: f64, change: Option<f64>| match change {
            Some(change) => format!("{recall:.1} ({change:+.1})"),
            None => format!("{recall:.1}        "),
        };
        let (at, change) = (&method.recall, method.change.map(|change| change.recall));
        writeln!(
            out,
            "{:<11} {:>14} {:>14} {:>14}",
            method.name,
            cell(at.one, change.map(|change| change.one)),
            cell(at.five, change.map(|change| change.five)),
            cell(at.ten, change.map(|change| change.ten)),
        )?;
        let range = |[low, high]: [f64; 2]| format!("{low:.1} to {high:.1}");
        let ranges = &method.interval;
        let cells = [ranges.one, ranges.five, ranges.ten].map(range);
        writeln!(out, "{:<11} {:>14} {:>14} {:>14}", "", cells[0], cells[1], cells[2])?;
    }
    writeln!(out, "in percent; below each the 95 % bootstrap interval\n")?;
    methods.iter().try_for_each(|method| write_method(method, told.k, out))
}

fn write_method(method: &MethodSummary, k: usize, out: &mut String) -> fmt::Result {
    let name = &method.name;
    if let Some(Change { helped, harmed, left_alone, interval: range, .. }) = &method.change {
        writeln!(
            out,
            "{name}: helped {helped}, harmed {harmed}, left {left_alone} alone; R@1 by {:+.1} to \
             {:+.1}",
            range.one[0], range.one[1]
        )?;
    }
    let times = &method.timing_ms;
    match (&times.refine, &times.refine_pair) {
        (Some(refine), Some(pair)) => writeln!(
            out,
            "{name}: refining {k} candidates {:.1} ms, a pair {:.2} ms (95 % within {:.2})",
            refine.median, pair.median, pair.p95
        )?,
        _ => writeln!(
            out,
            "{name}: decode {:.1} ms, extract {:.1} ms, search {:.2} ms (medians)",
            times.decode.median, times.extract.median, times.search.median
        )?,
    }
    let usage = &method.usage;
    if usage.calls > 0 || usage.cached > 0 {
        writeln!(
            out,
            "{name}: {} calls, {} descriptions from the cache, {} tokens sent, {} received",
            usage.calls, usage.cached, usage.prompt_tokens, usage.completion_tokens
        )?;
    }
    if let Some(why) = &method.degraded_why {
        writeln!(
            out,
            "{name}: WARNING, {} queries were not fully refined: {why}",
            method.degraded
        )?;
    }
    write_known(method, out)
}

fn write_known(method: &MethodSummary, out: &mut String) -> fmt::Result {
    let (name, known) = (&method.name, &method.known);
    let called = &known.called;
    let kinds = [
        (called.right, "true first answers"),
        (called.wrong, "false ones"),
        (called.unknown, "unknown places"),
    ];
    let shares =
        kinds.iter().filter_map(|(share, of)| Some(format!("{:.1} % of {of}", 100.0 * (*share)?)));
    writeln!(
        out,
        "{name}: called known from a confidence of {}: {}",
        called.threshold,
        shares.collect::<Vec<_>>().join(", ")
    )?;
    for (point, why) in [(&known.suggested, "best F1"), (&known.given, "as given")] {
        if let Some(point) = point {
            writeln!(
                out,
                "{name}: first answers of confidence {:.3} or more ({why}): {:.1} % true, {:.1} % of \
                 all found",
                point.threshold,
                100.0 * point.precision,
                100.0 * point.recall
            )?;
        }
    }
    if let (Some(at_95), Some(at_99), Some(auc)) = (&known.at_95, &known.at_99, known.auc) {
        writeln!(
            out,
            "{name}: known against {} unknown places: precision {:.1} % at 95 % recall (from {:.3}), \
             {:.1} % at 99 % (from {:.3}); AUC {auc:.3}",
            known.unknown,
            100.0 * at_95.precision,
            at_95.threshold,
            100.0 * at_99.precision,
            at_99.threshold
        )?;
    }
    Ok(())
}
