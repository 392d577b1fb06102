//! The page itself.

use std::fmt::{self, Write};

use super::super::open_set::precision_recall;
use super::super::summary::firsts;
use super::super::{
    Dataset, MethodOutcomes, MethodSummary, Outcome, Prediction, QueryKind, Summary,
};
use super::Escaped;
use super::charts;
use super::examples::{Example, Group, Pictures};
use whereabouts_core::ImageId;

const STYLE: &str = include_str!("page.css");

/// Puts the page together.
pub fn page(
    summary: &Summary,
    data: &Dataset,
    found: &[MethodOutcomes],
    examples: &[Group<'_>],
    pictures: &Pictures<'_>,
) -> anyhow::Result<String> {
    let mut out = String::new();
    write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>Recall on {}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n",
        Escaped(&summary.told.query_folder)
    )?;
    head(summary, &mut out)?;
    recalls(summary, &mut out)?;
    refinements(summary, &mut out)?;
    curves(summary, data, found, &mut out)?;
    times(summary, &mut out)?;
    for group in examples {
        write_group(group, pictures, &mut out)?;
    }
    out.push_str("</body>\n</html>\n");
    Ok(out)
}

fn head(summary: &Summary, out: &mut String) -> fmt::Result {
    let Summary { queries, skipped, unknown, references, told, .. } = summary;
    write!(
        out,
        "<h1>How often the first answer is right</h1>\n<p>{queries} queries of <b>{}</b> against \
         {references} references of <b>{}</b>, with the model <b>{}</b> ({}). A reference is true if it \
         is {}.",
        Escaped(&told.query_folder),
        Escaped(&told.database),
        Escaped(&told.model),
        Escaped(&told.execution),
        Escaped(&told.truth),
    )?;
    if *skipped > 0 {
        write!(out, " {skipped} more queries have no true reference and are left out.")?;
    }
    if *unknown > 0 {
        write!(out, " {unknown} more queries show places that are not in the map.")?;
    }
    out.push_str("</p>\n");
    for method in &summary.methods {
        if let Some(why) = &method.degraded_why {
            writeln!(
                out,
                "<p class=\"warning\">{}: {} queries were not fully refined: {}</p>",
                method.name,
                method.degraded,
                Escaped(why)
            )?;
        }
    }
    Ok(())
}

fn recalls(summary: &Summary, out: &mut String) -> fmt::Result {
    out.push_str(
        "<h2>Recall</h2>\n<div class=\"scroll\"><table>\n<tr><th>Method</th><th>R@1</th>\
         <th>R@5</th><th>R@10</th></tr>\n",
    );
    for method in &summary.methods {
        write!(out, "<tr><td>{}</td>", method.name)?;
        let (at, range, change) = (&method.recall, &method.interval, &method.change);
        let change = change.as_ref().map(|change| change.recall);
        cell(at.one, range.one, change.map(|change| change.one), out)?;
        cell(at.five, range.five, change.map(|change| change.five), out)?;
        cell(at.ten, range.ten, change.map(|change| change.ten), out)?;
        out.push_str("</tr>\n");
    }
    out.push_str(
        "</table></div>\n<p class=\"soft\">In percent of the queries; below each the change by \
         refinement and the 95 % bootstrap interval.</p>\n",
    );
    Ok(())
}

fn cell(recall: f64, [low, high]: [f64; 2], change: Option<f64>, out: &mut String) -> fmt::Result {
    write!(out, "<td>{recall:.1}")?;
    match change {
        Some(change) if change >= 0.05 => {
            write!(out, "<small class=\"up\">{change:.1} ↑</small>")?;
        }
        Some(change) if change <= -0.05 => {
            write!(out, "<small class=\"down\">{:.1} ↓</small>", -change)?;
        }
        Some(_) => out.push_str("<small>no change</small>"),
        None => {}
    }
    write!(out, "<small>{low:.1} – {high:.1}</small></td>")
}

fn refinements(summary: &Summary, out: &mut String) -> fmt::Result {
    for method in &summary.methods {
        if let Some(change) = &method.change {
            write!(
                out,
                "<p><b>{}</b> put {} queries right, spoilt {} and left {} as they were; the change \
                 of R@1 lies between {:+.1} and {:+.1} points.",
                method.name,
                change.helped,
                change.harmed,
                change.left_alone,
                change.interval.one[0],
                change.interval.one[1]
            )?;
            let usage = &method.usage;
            if usage.calls > 0 || usage.cached > 0 {
                write!(
                    out,
                    " It took {} calls, {} tokens sent and {} received; {} descriptions were known.",
                    usage.calls, usage.prompt_tokens, usage.completion_tokens, usage.cached
                )?;
            }
            out.push_str("</p>\n");
        }
    }
    Ok(())
}

fn curves(
    summary: &Summary,
    data: &Dataset,
    found: &[MethodOutcomes],
    out: &mut String,
) -> fmt::Result {
    let first: Vec<_> = found.iter().map(|method| firsts(data, method)).collect();
    let lines: Vec<_> = first.iter().map(|first| precision_recall(first)).collect();
    out.push_str("<h2>When to believe the first answer</h2>\n<div class=\"charts\">\n<figure>");
    out.push_str(&charts::precision_recall(&lines));
    out.push_str("<figcaption>");
    for (index, method) in summary.methods.iter().enumerate() {
        write!(
            out,
            "<span class=\"key\"><svg viewBox=\"0 0 22 10\"><line class=\"line c{}\" x1=\"0\" \
             x2=\"22\" y1=\"5\" y2=\"5\"/></svg>{}</span>",
            index % charts::COLOURS + 1,
            method.name
        )?;
    }
    out.push_str("Taking the surest first answers first.</figcaption></figure>\n");
    for (method, first) in summary.methods.iter().zip(&first) {
        let suggested = method.known.suggested;
        out.push_str("<figure>");
        out.push_str(&charts::histogram(first, suggested.map(|point| point.threshold)));
        write!(
            out,
            "<figcaption><b>{}</b>: <span class=\"up\">true</span> and <span class=\"down\">\
             false</span> first answers.",
            method.name
        )?;
        if let Some(point) = suggested {
            write!(
                out,
                " From {:.3} on, {:.1} % are true, and {:.1} % of what can be found is found: the \
                 suggested bound of <code>known</code> (best F1).",
                point.threshold,
                100.0 * point.precision,
                100.0 * point.recall
            )?;
        }
        write_known(method, out)?;
        out.push_str("</figcaption></figure>\n");
    }
    out.push_str("</div>\n");
    Ok(())
}

fn write_known(method: &MethodSummary, out: &mut String) -> fmt::Result {
    let known = &method.known;
    if let (Some(at_95), Some(at_99), Some(auc)) = (&known.at_95, &known.at_99, known.auc) {
        write!(
            out,
            " Against {} places that are not in the map: precision {:.1} % at 95 % recall, {:.1} % \
             at 99 %, AUC {auc:.3}.",
            known.unknown,
            100.0 * at_95.precision,
            100.0 * at_99.precision
        )?;
    }
    Ok(())
}

fn times(summary: &Summary, out: &mut String) -> fmt::Result {
    out.push_str(
        "<h2>Time</h2>\n<div class=\"scroll\"><table>\n<tr><th>Method</th><th>decode</th>\
         <th>extract</th><th>search</th><th>refine</th><th>a pair</th></tr>\n",
    );
    for method in &summary.methods {
        let times = &method.timing_ms;
        write!(out, "<tr><td>{}</td>", method.name)?;
        let stages = [Some(times.decode), Some(times.extract), Some(times.search)];
        for spread in stages.into_iter().chain([times.refine, times.refine_pair]) {
            match spread {
                Some(spread) => write!(
                    out,
                    "<td>{:.2}<small>95 %: {:.2}</small></td>",
                    spread.median, spread.p95
                )?,
                None => out.push_str("<td>–</td>"),
            }
        }
        out.push_str("</tr>\n");
    }
    out.push_str(
        "</table></div>\n<p class=\"soft\">Milliseconds for a query: the median, and what 95 % stay \
         within.</p>\n",
    );
    Ok(())
}

fn write_group(group: &Group<'_>, pictures: &Pictures<'_>, out: &mut String) -> anyhow::Result<()> {
    writeln!(out, "<h2>{}: {}</h2>", group.method, group.kind.heading())?;
    match (group.count, group.shown.len()) {
        (0, _) => out.push_str("<p class=\"soft\">No query.</p>\n"),
        (count, shown) if count > shown => {
            writeln!(out, "<p class=\"soft\">{shown} of {count} queries.</p>")?;
        }
        _ => {}
    }
    group.shown.iter().try_for_each(|example| write_example(example, pictures, out))
}

fn write_example(
    example: &Example<'_>,
    pictures: &Pictures<'_>,
    out: &mut String,
) -> anyhow::Result<()> {
    let Example { query, before, after } = example;
    let figure = |class: &str, picture: &str, label: &str, name: &str, note: &str| {
        format!(
            "<figure class=\"{class}\"><img alt=\"{label}\" src=\"{picture}\"><figcaption>\
             <b>{label}</b> {}{note}</figcaption></figure>\n",
            Escaped(name)
        )
    };
    let answer = |label: &str, answer: &Prediction| -> anyhow::Result<String> {
        let class = if query.truth.contains(&answer.image_id) { "right" } else { "wrong" };
        let picture = pictures.reference(&answer.image_id)?;
        let note = format!(", similarity {:.3}", answer.similarity);
        Ok(figure(class, &picture, label, answer.image_id.as_str(), &note))
    };
    out.push_str("<section class=\"example\">\n<div class=\"pictures\">\n");
    let picture = pictures.picture(&query.picture.file)?;
    out.push_str(&figure("query", &picture, "query", query.picture.id.as_str(), ""));
    out.push_str(&answer("before", before)?);
    if let Some((after, _)) = after {
        out.push_str(&answer("after", after)?);
    }
    let shown = |id: &ImageId| {
        before.image_id == *id || after.is_some_and(|(after, _)| after.image_id == *id)
    };
    let missed = query.kind == QueryKind::InMap && !query.truth.iter().any(shown);
    if let Some(truth) = query.truth.iter().min().filter(|_| missed) {
        let picture = pictures.reference(truth)?;
        out.push_str(&figure("right", &picture, "a true one", truth.as_str(), ""));
    }
    out.push_str("</div>\n");
    if let Some((after, outcome)) = after {
        write_said(before, after, outcome, out)?;
    }
    out.push_str("</section>\n");
    Ok(())
}

/// What the refiner said of the first after refinement, and folded up what it said besides.
fn write_said(
    before: &Prediction,
    after: &Prediction,
    outcome: &Outcome,
    out: &mut String,
) -> fmt::Result {
    let said = |id: &ImageId| {
        let of = outcome.descriptions.iter().find(|description| description.image_id == *id);
        of.map(|description| description.text.as_str())
    };
    if let Some(text) = said(&after.image_id) {
        writeln!(out, "<p class=\"said\"><b>after:</b> {}</p>", Escaped(text))?;
    }
    let other = said(&before.image_id).filter(|_| before.image_id != after.image_id);
    if other.is_none() && outcome.reasoning.is_none() {
        return Ok(());
    }
    out.push_str("<details><summary>What else the refiner said</summary>\n");
    for (label, text) in [("before", other), ("why", outcome.reasoning.as_deref())] {
        if let Some(text) = text {
            writeln!(out, "<p class=\"said\"><b>{label}:</b> {}</p>", Escaped(text))?;
        }
    }
    out.push_str("</details>\n");
    Ok(())
}
