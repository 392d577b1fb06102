//! The outcome as one self-contained page: numbers, curves, and examples with their pictures.
//!
//! The page needs no script and loads nothing: pictures are shrunk and held in the page, curves are
//! inline SVG, colours follow the reader's light or dark setting. Every text that comes from a file
//! name or a model is escaped.

mod charts;
mod examples;
mod page;

use std::fmt;

use super::{Dataset, MethodOutcomes, Summary};
use whereabouts_vision::ImageLimits;

/// Text that cannot be taken for markup.
struct Escaped<'a>(&'a str);

impl fmt::Display for Escaped<'_> {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.chars().try_for_each(|character| match character {
            '&' => out.write_str("&amp;"),
            '<' => out.write_str("&lt;"),
            '>' => out.write_str("&gt;"),
            '"' => out.write_str("&quot;"),
            '\'' => out.write_str("&#39;"),
            other => fmt::Write::write_char(out, other),
        })
    }
}

/// The page. Reads the pictures of the examples.
///
/// # Errors
/// A picture that cannot be read.
pub fn html(
    summary: &Summary,
    data: &Dataset,
    found: &[MethodOutcomes],
    limits: ImageLimits,
) -> anyhow::Result<String> {
    let examples = examples::choose(data, found);
    let pictures = examples::Pictures::new(data, limits);
    page::page(summary, data, found, &examples, &pictures)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_can_become_markup() {
        let text = r#"<img src=x onerror="a('b')"> & co"#;
        let escaped = Escaped(text).to_string();
        assert_eq!(escaped, "&lt;img src=x onerror=&quot;a(&#39;b&#39;)&quot;&gt; &amp; co");
    }
}
