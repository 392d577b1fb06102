//! Text that was read in a picture: signs, shop names, street names, door numbers.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// A line of text in a picture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct TextLine {
    /// What was read, in Unicode.
    pub text: String,
    /// Mean probability of the characters, from 0 to 1, as the recognition model gives it. It is not
    /// calibrated.
    pub confidence: f32,
    /// Corners of the quadrilateral around the line: top left, top right, bottom right, bottom left in the
    /// picture, whichever way the text runs. Each is `[x, y]` as a fraction of the width and height of the
    /// picture, after its EXIF orientation was applied.
    pub corners: [[f32; 2]; 4],
}

/// Lines that say this, somewhere in a picture.
#[cfg(test)]
pub(crate) fn lines(texts: &[&str]) -> Vec<TextLine> {
    let line =
        |text: &&str| TextLine { text: (*text).into(), confidence: 0.9, corners: [[0.0; 2]; 4] };
    texts.iter().map(line).collect()
}
