//! Texts as messages of gRPC.

use super::{ImagePage, MapTexts, proto};
use whereabouts_core::TextLine;

impl From<TextLine> for proto::TextLine {
    fn from(line: TextLine) -> Self {
        let TextLine { text, confidence, corners } = line;
        let corners = corners.map(|[x, y]| proto::PicturePoint { x, y });
        Self { text, confidence, corners: corners.into() }
    }
}

impl From<MapTexts> for proto::MapTexts {
    fn from(texts: MapTexts) -> Self {
        let MapTexts { reader, read, failed, waiting, lines } = texts;
        Self {
            reader: reader.map_or_else(String::new, |reader| reader.to_string()),
            read: read as u64,
            failed: failed as u64,
            waiting: waiting.unwrap_or_default() as u64,
            lines: lines as u64,
        }
    }
}

impl From<ImagePage> for proto::FindImagesResponse {
    fn from(page: ImagePage) -> Self {
        let ImagePage { images, next_cursor, matches, unread } = page;
        let found = images.into_iter().zip(matches.unwrap_or_default());
        let found = found.map(|(image, found)| proto::FoundImage {
            image: Some(image.into()),
            score: found.score,
            lines: found.lines.into_iter().map(Into::into).collect(),
        });
        Self {
            found: found.collect(),
            next_cursor: next_cursor.unwrap_or_default(),
            unread: unread.unwrap_or_default() as u64,
        }
    }
}
