//! Curves as inline SVG, in the colours of the page.

use std::fmt::{self, Write};

use super::super::open_set::{First, Point};

/// The size of a chart in its own units; at 390 pixels of page width a unit is about a pixel.
const WIDTH: f64 = 360.0;
const HEIGHT: f64 = 240.0;
/// Room for the numbers beside the plot.
const LEFT: f64 = 40.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 38.0;

/// Colours that the page defines.
pub const COLOURS: usize = 6;

/// Bars of a histogram.
const BINS: usize = 24;

fn across(share: f64) -> f64 {
    LEFT + share * (WIDTH - LEFT - RIGHT)
}

fn up(share: f64) -> f64 {
    HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)
}

/// Opens a chart with its frame, its grid and its labels; `x` and `y` name the numbers at a share of
/// the axis.
fn open(
    out: &mut String,
    title: &str,
    x: (&str, &dyn Fn(f64) -> String),
    y: (&str, &dyn Fn(f64) -> String),
) -> fmt::Result {
    write!(out, r#"<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">"#)?;
    for step in 0..=4 {
        let share = f64::from(step) / 4.0;
        let (at_x, at_y) = (across(share), up(share));
        write!(
            out,
            r#"<line class="grid" x1="{LEFT}" x2="{}" y1="{at_y:.1}" y2="{at_y:.1}"/>"#,
            across(1.0)
        )?;
        let (below, beside) = (up(0.0) + 15.0, LEFT - 6.0);
        write!(
            out,
            r#"<text x="{at_x:.1}" y="{below:.1}" text-anchor="middle">{}</text><text x="{beside:.1}" y="{:.1}" text-anchor="end">{}</text>"#,
            x.1(share),
            at_y + 4.0,
            y.1(share)
        )?;
    }
    write!(
        out,
        r#"<text class="axis" x="{:.1}" y="{:.1}" text-anchor="middle">{}</text><text class="axis" transform="translate(11 {:.1}) rotate(-90)" text-anchor="middle">{}</text>"#,
        across(0.5),
        HEIGHT - 6.0,
        x.0,
        up(0.5),
        y.0
    )
}

/// Precision over recall, a line for each method in the order of the page's colours.
pub fn precision_recall(curves: &[Vec<Point>]) -> String {
    let mut out = String::new();
    // Writing to a String never fails.
    let _ = draw_curves(curves, &mut out);
    out
}

fn draw_curves(curves: &[Vec<Point>], out: &mut String) -> fmt::Result {
    let percent = |share: f64| format!("{:.0}", 100.0 * share);
    open(out, "Precision over recall", ("recall, %", &percent), ("precision, %", &percent))?;
    for (index, curve) in curves.iter().enumerate() {
        let class = index % COLOURS + 1;
        write!(out, r#"<polyline class="line c{class}" points=""#)?;
        if let Some(first) = curve.first() {
            write!(out, "{:.1},{:.1} ", across(0.0), up(first.precision))?;
        }
        for point in curve {
            write!(out, "{:.1},{:.1} ", across(point.recall), up(point.precision))?;
        }
        out.push_str(r#""/>"#);
    }
    out.push_str("</svg>");
    Ok(())
}

/// How many first answers of each confidence are true and how many false, with a line at `threshold`.
pub fn histogram(first: &[First], threshold: Option<f64>) -> String {
    let mut out = String::new();
    let _ = draw_histogram(first, threshold, &mut out);
    out
}

fn draw_histogram(first: &[First], threshold: Option<f64>, out: &mut String) -> fmt::Result {
    let scores = || first.iter().map(|first| first.score);
    let low = scores().fold(f64::INFINITY, f64::min);
    let high = scores().fold(f64::NEG_INFINITY, f64::max);
    let span = (high - low).max(1e-9);
    let share = |score: f64| ((score - low) / span).clamp(0.0, 1.0);
    let mut bins = [[0_usize; 2]; BINS];
    for first in first {
        let bin = (share(first.score) * BINS as f64) as usize;
        bins[bin.min(BINS - 1)][usize::from(!first.right)] += 1;
    }
    let most = bins.iter().map(|[right, wrong]| right + wrong).max().unwrap_or_default().max(4);
    // Whole numbers at each of the four steps.
    let most = most.next_multiple_of(4) as f64;
    open(
        out,
        "Confidence in true and false first answers",
        ("confidence in the first answer", &|share| format!("{:.2}", low + share * span)),
        ("queries", &|share| format!("{:.0}", share * most)),
    )?;
    let width = (across(1.0) - across(0.0)) / BINS as f64;
    for (index, counts) in bins.iter().enumerate() {
        let x = across(index as f64 / BINS as f64);
        let mut floor = 0.0;
        for (count, class) in counts.iter().zip(["right", "wrong"]) {
            if *count > 0 {
                let top = floor + *count as f64 / most;
                write!(
                    out,
                    r#"<rect class="{class}" x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}"/>"#,
                    x + 0.5,
                    up(top),
                    width - 1.0,
                    up(floor) - up(top)
                )?;
                floor = top;
            }
        }
    }
    if let Some(threshold) = threshold {
        let x = across(share(threshold));
        let (anchor, beside) = if x > WIDTH / 2.0 { ("end", x - 5.0) } else { ("start", x + 5.0) };
        write!(
            out,
            r#"<line class="threshold" x1="{x:.1}" x2="{x:.1}" y1="{:.1}" y2="{:.1}"/><text class="axis" x="{beside:.1}" y="{:.1}" text-anchor="{anchor}">{threshold:.3}</text>"#,
            up(0.0),
            up(1.0),
            up(1.0) + 10.0
        )?;
    }
    out.push_str("</svg>");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_of_nothing_and_of_one_number_can_be_drawn() {
        assert!(histogram(&[], None).ends_with("</svg>"));
        let one = First { score: 0.5, right: true, in_map: true };
        let drawn = histogram(&[one], Some(0.5));
        assert!(drawn.contains(r#"class="right""#) && !drawn.contains("NaN"), "{drawn}");
    }
}
