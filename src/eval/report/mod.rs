//! The results as one self-contained HTML page: tables, curves, and example images.
//!
//! The page has no scripts and loads nothing: images are scaled down and embedded, curves are inline SVG, and
//! colours follow the reader's light or dark setting. `maud` escapes every text.

mod charts;
mod examples;
mod page;

use super::{Dataset, MethodOutcomes, Summary};
use whereabouts_vision::ImageLimits;

/// Renders the page. Reads the image files of the examples.
///
/// # Errors
/// An image cannot be read.
pub fn html(
    summary: &Summary,
    data: &Dataset,
    methods: &[MethodOutcomes],
    limits: ImageLimits,
) -> anyhow::Result<String> {
    let examples = examples::choose(data, methods);
    let pictures = examples::Pictures::new(data, limits);
    page::page(summary, data, methods, &examples, &pictures)
}
