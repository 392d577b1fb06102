//! What was read in an image.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{Digest, TextLine};

/// The lines of text in an image, and what read them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ImageTexts {
    /// Identifies the reader. An image is read again when another one is installed.
    #[schema(value_type = String)]
    pub reader: Digest,
    /// The lines, from top to bottom.
    pub lines: Vec<TextLine>,
    /// How many further lines were read and not kept.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub left_out: usize,
    /// Why the image could not be read, if so. It is not tried again by the same reader.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
fn is_zero(number: &usize) -> bool {
    *number == 0
}

impl ImageTexts {
    /// The most lines that are kept of an image.
    pub const MAX_LINES: usize = 200;
    /// The most characters that are kept of a line, and of an error.
    pub const MAX_CHARS: usize = 200;

    /// What was read, within bounds: the surest lines, in their order, each cut to the most characters. Lines without
    /// text are dropped, and control characters are spaces.
    pub fn read(reader: Digest, lines: Vec<TextLine>) -> Self {
        let mut lines: Vec<TextLine> = lines.into_iter().filter_map(bounded).collect();
        let left_out = lines.len().saturating_sub(Self::MAX_LINES);
        if left_out > 0 {
            let mut order: Vec<usize> = (0..lines.len()).collect();
            order.sort_by(|a, b| lines[*b].confidence.total_cmp(&lines[*a].confidence));
            order.truncate(Self::MAX_LINES);
            order.sort_unstable();
            lines = order.into_iter().map(|at| lines[at].clone()).collect();
        }
        Self { reader, lines, left_out, error: None }
    }

    /// An image that could not be read.
    pub fn failed(reader: Digest, error: &str) -> Self {
        let error = Some(error.chars().take(Self::MAX_CHARS).collect());
        Self { reader, lines: Vec::new(), left_out: 0, error }
    }

    /// The same within bounds, for texts from outside.
    pub fn checked(self) -> Self {
        match self.error {
            Some(error) => Self::failed(self.reader, &error),
            None => {
                let read = Self::read(self.reader, self.lines);
                Self { left_out: read.left_out + self.left_out, ..read }
            }
        }
    }
}

fn bounded(line: TextLine) -> Option<TextLine> {
    let text: String = line.text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let text: String = text.trim().chars().take(ImageTexts::MAX_CHARS).collect();
    let share = |number: f32| if number.is_finite() { number.clamp(0.0, 1.0) } else { 0.0 };
    (!text.is_empty()).then(|| TextLine {
        text,
        confidence: share(line.confidence),
        corners: line.corners.map(|corner| corner.map(share)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(text: &str, confidence: f32) -> TextLine {
        TextLine { text: text.into(), confidence, corners: [[0.0; 2]; 4] }
    }

    #[test]
    fn texts_are_kept_within_bounds() {
        let long = "é".repeat(500);
        let mut lines = vec![line(&long, 0.9), line("\0 \n", 0.9), line("A\tB", f32::NAN)];
        lines.extend((0..300).map(|number| line(&format!("{number}"), number as f32 / 300.0)));
        let read = ImageTexts::read(Digest::of(b"reader"), lines);
        assert_eq!(read.lines.len(), ImageTexts::MAX_LINES);
        assert_eq!(read.left_out, 302 - ImageTexts::MAX_LINES);
        assert_eq!(read.lines[0].text.chars().count(), ImageTexts::MAX_CHARS);
        assert_eq!(read.lines[1].text, "101", "the surest remain, in their order");
        assert_eq!(read.clone().checked(), read);
        let small = ImageTexts::read(Digest::of(b"reader"), vec![line(" A\tB\u{0} ", f32::NAN)]);
        assert_eq!((small.lines[0].text.as_str(), small.lines[0].confidence), ("A B", 0.0));
    }
}
