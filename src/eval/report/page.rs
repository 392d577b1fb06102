//! The page of the report.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::super::open_set::correctness_curve;
use super::super::recall::{AtK, Change};
use super::super::summary::{Quantiles, top_predictions};
use super::super::{
    Dataset, MethodOutcomes, MethodSummary, Prediction, QueryKind, QueryOutcome, Summary,
};
use super::charts;
use super::examples::{Example, Group, Pictures};
use whereabouts_core::ImageId;

const STYLE: &str = include_str!("page.css");

/// Renders the page.
pub fn page(
    summary: &Summary,
    data: &Dataset,
    methods: &[MethodOutcomes],
    examples: &[Group<'_>],
    pictures: &Pictures<'_>,
) -> anyhow::Result<String> {
    let examples: Vec<Markup> =
        examples.iter().map(|group| example_group(group, pictures)).collect::<Result<_, _>>()?;
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { "Recall on " (summary.conditions.query_folder) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                (introduction(summary))
                (recall_table(summary))
                @for method in &summary.methods {
                    @if let Some(change) = &method.change { (refinement(method, change)) }
                }
                (confidence(summary, data, methods))
                (time_table(summary))
                @for group in examples { (group) }
            }
        }
    };
    Ok(page.into_string())
}

fn introduction(summary: &Summary) -> Markup {
    let Summary { queries, skipped, unknown, references, left_out, conditions, methods } = summary;
    html! {
        h1 { "How often the first answer is correct" }
        p {
            (queries) " queries of " b { (conditions.query_folder) } " against " (references)
            " references of " b { (conditions.database) } ", with the model " b { (conditions.model) }
            " (" (conditions.execution) "). A reference is correct if it is " (conditions.truth) "."
            @if *skipped > 0 {
                " " (skipped) " more queries have no correct reference and are left out."
            }
            @if !left_out.queries.is_empty() {
                " " (left_out.queries.len()) " of them have no position."
            }
            @if !left_out.references.is_empty() {
                " " (left_out.references.len()) " references have no position and are left out."
            }
            @if *unknown > 0 { " " (unknown) " more queries show places that are not in the map." }
        }
        @for method in methods {
            @if let Some(reason) = &method.degraded_why {
                p.warning {
                    (method.name) ": " (method.degraded) " queries were not fully refined: " (reason)
                }
            }
        }
    }
}

fn recall_table(summary: &Summary) -> Markup {
    let columns = |method: &MethodSummary| {
        let AtK { one, five, ten } = method.recall;
        let interval = method.interval;
        let change = method.change.map(|change| change.recall);
        [
            (one, interval.one, change.map(|change| change.one)),
            (five, interval.five, change.map(|change| change.five)),
            (ten, interval.ten, change.map(|change| change.ten)),
        ]
    };
    html! {
        h2 { "Recall" }
        div.scroll {
            table {
                tr { th { "Method" } th { "R@1" } th { "R@5" } th { "R@10" } }
                @for method in &summary.methods {
                    tr {
                        td { (method.name) }
                        @for (recall, [low, high], change) in columns(method) {
                            td {
                                (format!("{recall:.1}"))
                                @if let Some(change) = change { (recall_change(change)) }
                                small { (format!("{low:.1} – {high:.1}")) }
                            }
                        }
                    }
                }
            }
        }
        p.soft {
            "In percent of the queries, with the change by refinement and the 95 % bootstrap interval below."
        }
    }
}

fn recall_change(change: f64) -> Markup {
    html! {
        @if change >= 0.05 { small.up { (format!("{change:.1} ↑")) } }
        @else if change <= -0.05 { small.down { (format!("{:.1} ↓", -change)) } }
        @else { small { "no change" } }
    }
}

fn refinement(method: &MethodSummary, change: &Change) -> Markup {
    let (usage, [low, high]) = (&method.usage, change.interval.one);
    html! {
        p {
            b { (method.name) } " corrected " (change.helped) " queries, made " (change.harmed)
            " worse and left " (change.left_alone) " unchanged; the 95 % interval of the change of R@1 is "
            (format!("{low:+.1} to {high:+.1}")) " points."
            @if usage.calls > 0 || usage.cached > 0 {
                " It took " (usage.calls) " calls, " (usage.prompt_tokens) " prompt tokens and "
                (usage.completion_tokens) " completion tokens; " (usage.cached)
                " descriptions came from the cache."
            }
        }
    }
}

fn confidence(summary: &Summary, data: &Dataset, methods: &[MethodOutcomes]) -> Markup {
    let predictions: Vec<_> = methods.iter().map(|method| top_predictions(data, method)).collect();
    let curves: Vec<_> = predictions.iter().map(|method| correctness_curve(method)).collect();
    html! {
        h2 { "When to trust the first answer" }
        div.charts {
            figure {
                (charts::precision_recall(&curves))
                figcaption {
                    @for (index, method) in summary.methods.iter().enumerate() {
                        span.key {
                            svg viewBox="0 0 22 10" {
                                line class=(charts::line_class(index)) x1="0" x2="22" y1="5" y2="5" {}
                            }
                            (method.name)
                        }
                    }
                    "Accepting first answers in the order of their confidence."
                }
            }
            @for (method, predictions) in summary.methods.iter().zip(&predictions) {
                @let suggested = method.known.suggested;
                figure {
                    (charts::histogram(predictions, suggested.map(|point| point.threshold)))
                    figcaption {
                        b { (method.name) } ": " span.up { "correct" } " and " span.down { "wrong" }
                        " first answers."
                        @if let Some(point) = suggested {
                            (format!(
                                " At a confidence of {:.3} or more, {:.1} % are correct (precision), out of \
                                 {:.1} % of all that could be (recall): the suggested threshold of ",
                                point.threshold, 100.0 * point.precision, 100.0 * point.recall
                            ))
                            code { "known" } " (best F1)."
                        }
                        (open_set(method))
                    }
                }
            }
        }
    }
}

fn open_set(method: &MethodSummary) -> Markup {
    let known = &method.known;
    html! {
        @if let (Some(at_95), Some(at_99), Some(auc)) = (&known.at_95, &known.at_99, known.auc) {
            (format!(
                " Against {} places that are not in the map: precision {:.1} % at 95 % recall, {:.1} % at \
                 99 %, AUC {auc:.3}.",
                known.unknown, 100.0 * at_95.precision, 100.0 * at_99.precision
            ))
        }
    }
}

fn time_table(summary: &Summary) -> Markup {
    let stages = |method: &MethodSummary| {
        let times = method.timing_ms;
        [
            Some(times.decode),
            Some(times.extract),
            Some(times.search),
            times.refine,
            times.refine_pair,
        ]
    };
    html! {
        h2 { "Time" }
        div.scroll {
            table {
                tr {
                    @for heading in ["Method", "decode", "extract", "search", "refine", "one pair"] {
                        th { (heading) }
                    }
                }
                @for method in &summary.methods {
                    tr {
                        td { (method.name) }
                        @for stage in stages(method) {
                            td {
                                @if let Some(Quantiles { median, p95 }) = stage {
                                    (format!("{median:.2}")) small { (format!("95 %: {p95:.2}")) }
                                } @else { "–" }
                            }
                        }
                    }
                }
            }
        }
        p.soft { "Milliseconds per query: median and 95th percentile." }
    }
}

fn example_group(group: &Group<'_>, pictures: &Pictures<'_>) -> anyhow::Result<Markup> {
    let examples: Vec<Markup> =
        group.shown.iter().map(|one| example(one, pictures)).collect::<Result<_, _>>()?;
    Ok(html! {
        h2 { (group.method) ": " (group.kind.heading()) }
        @if group.count == 0 {
            p.soft { "No query." }
        } @else if group.count > examples.len() {
            p.soft { (examples.len()) " of " (group.count) " queries." }
        }
        @for example in examples { (example) }
    })
}

fn example(example: &Example<'_>, pictures: &Pictures<'_>) -> anyhow::Result<Markup> {
    let Example { query, before, after } = example;
    let prediction = |label: &str, prediction: &Prediction| -> anyhow::Result<Markup> {
        let class = if query.truth.contains(&prediction.image_id) { "right" } else { "wrong" };
        let similarity = format!(", similarity {:.3}", prediction.similarity);
        let picture = pictures.reference(&prediction.image_id)?;
        Ok(figure(class, label, &prediction.image_id, &similarity, &picture))
    };
    let picture = pictures.picture(&query.picture.file)?;
    let mut figures = vec![figure("query", "query", &query.picture.id, "", &picture)];
    figures.push(prediction("before", before)?);
    if let Some((after, _)) = after {
        figures.push(prediction("after", after)?);
    }
    let is_shown = |id: &ImageId| {
        before.image_id == *id || after.is_some_and(|(after, _)| after.image_id == *id)
    };
    let is_missed = query.kind == QueryKind::InMap && !query.truth.iter().any(is_shown);
    if let Some(truth) = query.truth.iter().min().filter(|_| is_missed) {
        figures.push(figure("right", "correct", truth, "", &pictures.reference(truth)?));
    }
    Ok(html! {
        section.example {
            div.pictures {
                @for figure in figures { (figure) }
            }
            @if let Some((after, outcome)) = after { (refiner_texts(before, after, outcome)) }
        }
    })
}

fn figure(class: &str, label: &str, id: &ImageId, note: &str, picture: &str) -> Markup {
    html! {
        figure class=(class) {
            img alt=(label) src=(picture);
            figcaption { b { (label) } " " (id.as_str()) (note) }
        }
    }
}

/// Shows the refiner's description of the first candidate after refinement, and its other texts folded.
fn refiner_texts(before: &Prediction, after: &Prediction, outcome: &QueryOutcome) -> Markup {
    let description = |id: &ImageId| {
        let mut descriptions = outcome.descriptions.iter();
        let description = descriptions.find(|description| description.image_id == *id);
        description.map(|description| description.text.as_str())
    };
    let text = |label: &str, text: &str| html! { p.said { b { (label) ":" } " " (text) } };
    let before_text = description(&before.image_id).filter(|_| before.image_id != after.image_id);
    html! {
        @if let Some(after_text) = description(&after.image_id) { (text("after", after_text)) }
        @if before_text.is_some() || outcome.reasoning.is_some() {
            details {
                summary { "More from the refiner" }
                @if let Some(before_text) = before_text { (text("before", before_text)) }
                @if let Some(reasoning) = &outcome.reasoning { (text("reasoning", reasoning)) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_conditions_recalls_changes_and_times() {
        let summary = crate::table::tests::summary();
        let [_, refined] = &summary.methods[..] else { panic!() };
        let sections = [
            introduction(&summary),
            recall_table(&summary),
            refinement(refined, refined.change.as_ref().unwrap()),
            time_table(&summary),
        ];
        let page = sections.map(Markup::into_string).join("\n\n");
        insta::assert_snapshot!("page", page.replace("><", ">\n<"));
    }

    #[test]
    fn an_image_id_cannot_become_markup() {
        let id: ImageId = r#"<b onclick="x">&.jpg"#.parse().unwrap();
        let figure = figure("query", "query", &id, "", "data:").into_string();
        assert!(figure.contains("&lt;b onclick=&quot;x&quot;&gt;&amp;.jpg"), "{figure}");
    }
}
