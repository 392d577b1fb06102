//! Curves and histograms as inline SVG, in the colours of the page.

use maud::{Markup, html};

use super::super::open_set::{OperatingPoint, TopPrediction};

/// Size of a chart in SVG units; on a page 390 pixels wide, a unit is about a pixel.
const WIDTH: f64 = 360.0;
const HEIGHT: f64 = 240.0;
/// Margins around the plot, with room for the axis labels.
const LEFT: f64 = 40.0;
const RIGHT: f64 = 12.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 38.0;

/// Number of line colours that the page defines.
pub const COLOURS: usize = 6;

/// Number of bars in a histogram.
const BINS: usize = 24;

/// Converts a fraction of the horizontal axis to a coordinate.
fn to_x(fraction: f64) -> f64 {
    LEFT + fraction * (WIDTH - LEFT - RIGHT)
}

/// Converts a fraction of the vertical axis to a coordinate.
fn to_y(fraction: f64) -> f64 {
    HEIGHT - BOTTOM - fraction * (HEIGHT - TOP - BOTTOM)
}

/// Formats a coordinate with one decimal.
fn px(coordinate: f64) -> String {
    format!("{coordinate:.1}")
}

/// An axis: its title, and the label at a fraction of it.
struct Axis<'a> {
    title: &'a str,
    label: &'a dyn Fn(f64) -> String,
}

/// Draws a chart: grid, labels and titles, and the `plot` on top of them.
fn chart(title: &str, x: &Axis, y: &Axis, plot: &Markup) -> Markup {
    html! {
        svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(title) {
            @for step in 0..=4 {
                @let fraction = f64::from(step) / 4.0;
                @let line = px(to_y(fraction));
                line.grid x1=(LEFT) x2=(to_x(1.0)) y1=(line) y2=(line) {}
                text x=(px(to_x(fraction))) y=(px(to_y(0.0) + 15.0)) text-anchor="middle" {
                    ((x.label)(fraction))
                }
                text x=(px(LEFT - 6.0)) y=(px(to_y(fraction) + 4.0)) text-anchor="end" {
                    ((y.label)(fraction))
                }
            }
            text.axis x=(px(to_x(0.5))) y=(px(HEIGHT - 6.0)) text-anchor="middle" { (x.title) }
            text.axis transform=(format!("translate(11 {:.1}) rotate(-90)", to_y(0.5)))
                text-anchor="middle" { (y.title) }
            (plot)
        }
    }
}

/// Draws precision over recall, one line per method in the order of the page's colours.
pub fn precision_recall(curves: &[Vec<OperatingPoint>]) -> Markup {
    let percent = |fraction: f64| format!("{:.0}", 100.0 * fraction);
    let points = |curve: &[OperatingPoint]| {
        let start = curve.first().map(|first| (0.0, first.precision));
        let points = curve.iter().map(|point| (point.recall, point.precision));
        let coordinates = start.into_iter().chain(points);
        coordinates.map(|(x, y)| format!("{:.1},{:.1} ", to_x(x), to_y(y))).collect::<String>()
    };
    let plot = html! {
        @for (index, curve) in curves.iter().enumerate() {
            polyline class=(line_class(index)) points=(points(curve)) {}
        }
    };
    chart(
        "Precision over recall",
        &Axis { title: "recall, %", label: &percent },
        &Axis { title: "precision, %", label: &percent },
        &plot,
    )
}

/// Returns the CSS classes of the line of a method.
pub fn line_class(method: usize) -> String {
    format!("line c{}", method % COLOURS + 1)
}

/// Draws a histogram of the confidence in correct and wrong first predictions, with a line at `threshold`.
pub fn histogram(predictions: &[TopPrediction], threshold: Option<f64>) -> Markup {
    let scores = || predictions.iter().map(|prediction| prediction.score);
    let low = scores().fold(f64::INFINITY, f64::min);
    let high = scores().fold(f64::NEG_INFINITY, f64::max);
    let span = (high - low).max(1e-9);
    let fraction = |score: f64| ((score - low) / span).clamp(0.0, 1.0);
    let mut bins = [[0_usize; 2]; BINS];
    for prediction in predictions {
        let bin = (fraction(prediction.score) * BINS as f64) as usize;
        bins[bin.min(BINS - 1)][usize::from(!prediction.correct)] += 1;
    }
    let highest =
        bins.iter().map(|[correct, wrong]| correct + wrong).max().unwrap_or_default().max(4);
    // A multiple of four gives whole numbers at the grid lines.
    let highest = highest.next_multiple_of(4) as f64;
    let width = (to_x(1.0) - to_x(0.0)) / BINS as f64;
    let plot = html! {
        @for (index, [correct, wrong]) in bins.iter().enumerate() {
            @let x = px(to_x(index as f64 / BINS as f64) + 0.5);
            @let middle = *correct as f64 / highest;
            @let top = middle + *wrong as f64 / highest;
            @for (from, to, class) in [(0.0, middle, "right"), (middle, top, "wrong")] {
                @if to > from {
                    rect class=(class) x=(x) y=(px(to_y(to))) width=(px(width - 1.0))
                        height=(px(to_y(from) - to_y(to))) {}
                }
            }
        }
        @if let Some(threshold) = threshold {
            @let x = to_x(fraction(threshold));
            @let (anchor, label_x) =
                if x > WIDTH / 2.0 { ("end", x - 5.0) } else { ("start", x + 5.0) };
            line.threshold x1=(px(x)) x2=(px(x)) y1=(px(to_y(0.0))) y2=(px(to_y(1.0))) {}
            text.axis x=(px(label_x)) y=(px(to_y(1.0) + 10.0)) text-anchor=(anchor) {
                (format!("{threshold:.3}"))
            }
        }
    };
    chart(
        "Confidence in correct and wrong first answers",
        &Axis {
            title: "confidence in the first answer",
            label: &|fraction| format!("{:.2}", low + fraction * span),
        },
        &Axis { title: "queries", label: &|fraction| format!("{:.0}", fraction * highest) },
        &plot,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_of_no_values_or_of_one_can_be_drawn() {
        assert!(histogram(&[], None).into_string().ends_with("</svg>"));
        let one = TopPrediction { score: 0.5, correct: true, in_map: true };
        let drawn = histogram(&[one], Some(0.5)).into_string();
        assert!(drawn.contains(r#"class="right""#) && !drawn.contains("NaN"), "{drawn}");
    }
}
