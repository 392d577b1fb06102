//! The results as a table: one row per method, with R@1, R@5 and R@10.

use std::fmt::{self, Write};

use super::open_set::KnownRates;
use super::recall::Change;
use super::{MethodSummary, Summary};

/// Formats the table and further figures for a terminal of 80 columns.
pub fn table(summary: &Summary) -> String {
    let mut text = String::new();
    // Writing to a String never fails.
    let _ = write(summary, &mut text);
    text
}

fn write(summary: &Summary, out: &mut String) -> fmt::Result {
    let Summary { queries, skipped, unknown, references, left_out, conditions, methods } = summary;
    writeln!(
        out,
        "{queries} queries, {references} references; model {} ({})",
        conditions.model, conditions.execution
    )?;
    writeln!(out, "a reference is correct if it is {}", conditions.truth)?;
    if *skipped > 0 {
        writeln!(out, "{skipped} more queries have no correct reference and are left out")?;
    }
    if !left_out.queries.is_empty() {
        writeln!(out, "{} of them have no position", left_out.queries.len())?;
    }
    if !left_out.references.is_empty() {
        writeln!(
            out,
            "{} references have no position and are left out",
            left_out.references.len()
        )?;
    }
    if *unknown > 0 {
        writeln!(out, "{unknown} more queries show places that are not in the map")?;
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
        let interval = |[low, high]: [f64; 2]| format!("{low:.1} to {high:.1}");
        let bounds = &method.interval;
        let cells = [bounds.one, bounds.five, bounds.ten].map(interval);
        writeln!(out, "{:<11} {:>14} {:>14} {:>14}", "", cells[0], cells[1], cells[2])?;
    }
    writeln!(out, "in percent, with the 95 % bootstrap interval below each\n")?;
    write_known_table(summary, out)?;
    methods.iter().try_for_each(|method| write_method(method, conditions.k, out))
}

/// Writes what is called known, and what a model costs.
fn write_known_table(summary: &Summary, out: &mut String) -> fmt::Result {
    writeln!(
        out,
        "{:<27} {:>9} {:>9} {:>9} {:>12}",
        "called known", "right", "wrong", "unknown", "calls/query"
    )?;
    let cell = |rate: Option<f64>| match rate {
        Some(rate) => format!("{:.1}", 100.0 * rate),
        None => "-".to_owned(),
    };
    let mut row = |name: &str, rates: &KnownRates, calls: &str| {
        let cells = [rates.right, rates.wrong, rates.unknown].map(cell);
        writeln!(out, "{name:<27} {:>9} {:>9} {:>9} {calls:>12}", cells[0], cells[1], cells[2])
    };
    for method in &summary.methods {
        let queries = (summary.queries + summary.unknown).max(1);
        // A cached description is a call that another method of the run, or an earlier run, has made.
        let calls = f64::from(method.usage.calls + method.usage.cached) / queries as f64;
        row(&method.name, &method.known.called, &format!("{calls:.2}"))?;
        if let Some(alternatives) = &method.alternatives {
            row("  by similarity alone", &alternatives.similarity, "")?;
            row("  by the model's word", &alternatives.stated, "")?;
        }
    }
    writeln!(
        out,
        "in percent of correct first answers, of wrong ones, and of places outside the map, at a\n\
         confidence of {} or more; cached descriptions count as calls\n",
        summary.conditions.known_confidence
    )
}

fn write_method(method: &MethodSummary, k: usize, out: &mut String) -> fmt::Result {
    let name = &method.name;
    if let Some(Change { helped, harmed, left_alone, interval, .. }) = &method.change {
        writeln!(
            out,
            "{name}: helped {helped} queries, harmed {harmed}, left {left_alone} unchanged; R@1 changed by \
             {:+.1} to {:+.1}",
            interval.one[0], interval.one[1]
        )?;
    }
    let times = &method.timing_ms;
    match (&times.refine, &times.refine_pair) {
        (Some(refine), Some(pair)) => writeln!(
            out,
            "{name}: refine {k} candidates {:.1} ms, one pair {:.2} ms (medians; 95th percentile {:.2})",
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
            "{name}: {} calls, {} cached descriptions, {} prompt tokens, {} completion tokens",
            usage.calls, usage.cached, usage.prompt_tokens, usage.completion_tokens
        )?;
    }
    if let Some(reason) = &method.degraded_why {
        writeln!(
            out,
            "{name}: WARNING: {} queries were not fully refined: {reason}",
            method.degraded
        )?;
    }
    write_known(method, out)
}

fn write_known(method: &MethodSummary, out: &mut String) -> fmt::Result {
    let (name, known) = (&method.name, &method.known);
    for (point, origin) in [(&known.suggested, "best F1"), (&known.given, "requested")] {
        if let Some(point) = point {
            writeln!(
                out,
                "{name}: first answers at a confidence of {:.3} or more ({origin}): precision {:.1} %, recall \
                 {:.1} %",
                point.threshold,
                100.0 * point.precision,
                100.0 * point.recall
            )?;
        }
    }
    if let (Some(at_95), Some(at_99), Some(auc)) = (&known.at_95, &known.at_99, known.auc) {
        writeln!(
            out,
            "{name}: known places against {} unknown ones: precision {:.1} % at 95 % recall (confidence \
             {:.3}), {:.1} % at 99 % ({:.3}); AUC {auc:.3}",
            known.unknown,
            100.0 * at_95.precision,
            at_95.threshold,
            100.0 * at_99.precision,
            at_99.threshold
        )?;
    }
    Ok(())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::KnownAlternatives;
    use crate::LeftOut;
    use crate::open_set::{OpenSetMetrics, OperatingPoint};
    use crate::recall::AtK;
    use crate::summary::{Quantiles, RunConditions, Timing};
    use whereabouts_core::Usage;

    fn quantiles(median: f64) -> Quantiles {
        Quantiles { median, p95: 2.0 * median }
    }

    fn point(threshold: f64) -> OperatingPoint {
        OperatingPoint { threshold, precision: 0.975, recall: 0.8125 }
    }

    fn coarse() -> MethodSummary {
        MethodSummary {
            name: "gem".into(),
            recall: AtK { one: 62.5, five: 87.5, ten: 100.0 },
            interval: AtK { one: [37.5, 81.3], five: [68.8, 100.0], ten: [100.0, 100.0] },
            change: None,
            timing_ms: Timing {
                decode: quantiles(2.04),
                extract: quantiles(18.7),
                search: quantiles(0.123),
                refine: None,
                refine_pair: None,
            },
            usage: Usage::default(),
            degraded: 0,
            degraded_why: None,
            known: OpenSetMetrics {
                called: KnownRates {
                    threshold: 0.9,
                    right: Some(0.75),
                    wrong: Some(0.05),
                    unknown: None,
                },
                suggested: Some(point(0.4321)),
                given: None,
                unknown: 0,
                at_95: None,
                at_99: None,
                auc: None,
            },
            alternatives: None,
        }
    }

    fn refined() -> MethodSummary {
        let coarse = coarse();
        MethodSummary {
            name: "gem+mllm".into(),
            recall: AtK { one: 81.25, ..coarse.recall },
            change: Some(Change {
                recall: AtK { one: 18.75, five: 0.0, ten: 0.0 },
                interval: AtK { one: [6.25, 37.5], ..AtK::default() },
                helped: 4,
                harmed: 1,
                left_alone: 11,
            }),
            timing_ms: Timing {
                refine: Some(quantiles(5230.0)),
                refine_pair: Some(quantiles(523.0)),
                ..coarse.timing_ms
            },
            usage: Usage {
                calls: 176,
                cached: 3,
                prompt_tokens: 90_000,
                completion_tokens: 40_000,
                estimated: 0,
            },
            degraded: 2,
            degraded_why: Some("the model's answer is not JSON".into()),
            known: OpenSetMetrics {
                called: KnownRates { unknown: Some(0.125), ..coarse.known.called },
                given: Some(point(0.5)),
                unknown: 8,
                at_95: Some(point(0.61)),
                at_99: Some(point(0.42)),
                auc: Some(0.9531),
                ..coarse.known
            },
            alternatives: Some(KnownAlternatives {
                similarity: KnownRates { right: Some(0.18), ..coarse.known.called },
                stated: KnownRates { wrong: Some(1.0), ..coarse.known.called },
            }),
            ..coarse
        }
    }

    /// A coarse and a refined method.
    pub fn summary() -> Summary {
        let conditions = RunConditions {
            database: "database".into(),
            query_folder: "queries".into(),
            truth: "within 25 m".into(),
            model: "xfeat".into(),
            execution: "cpu at full precision".into(),
            k: 10,
            known_threshold: Some(0.5),
            known_confidence: 0.9,
            search: "fast".into(),
        };
        Summary {
            queries: 16,
            skipped: 2,
            unknown: 8,
            references: 20,
            left_out: LeftOut::default(),
            conditions,
            methods: vec![coarse(), refined()],
        }
    }

    #[test]
    fn the_table_has_recalls_changes_times_and_open_set_metrics() {
        insta::assert_snapshot!("table", table(&summary()));
    }

    #[test]
    fn the_summary_is_written_as_json() {
        insta::assert_snapshot!("summary", serde_json::to_string_pretty(&summary()).unwrap());
    }
}
