//! Search for the text that was read in images.

use std::cmp::Ordering;

use super::images::page_size;
use super::{Images, Reading, ServiceError};
use whereabouts_api::{ErrorKind, ImageMatch, ImagePage, ImageState, MapTexts};
use whereabouts_core::text_search::{TextMatch, TextQuery};
use whereabouts_core::{ImageId, ImageTexts, Map, MapName};

/// The most characters of a text that is searched for.
const MAX_CHARS: usize = 100;

/// The most images whose texts are compared with it: those that share most pairs of characters.
const MAX_CANDIDATES: usize = 1000;

/// Images whose texts are read at a time.
const PAGE: usize = 100;

/// The most comparisons of two characters in a search. Ordinary signs need a hundredth of it.
const MAX_COMPARISONS: usize = 500_000_000;

/// An image that matches.
#[derive(Debug, Clone)]
struct Found {
    image: ImageId,
    score: f32,
    texts: ImageTexts,
    lines: Vec<usize>,
}

impl Found {
    /// The best first, then by id.
    fn order(&self, score: f32, image: &ImageId) -> Ordering {
        score.total_cmp(&self.score).then_with(|| self.image.cmp(image))
    }
}

/// Where a page ends: the score and the id of its last image.
#[derive(Debug, Clone, PartialEq)]
struct TextCursor {
    score: f32,
    image: ImageId,
}

impl TextCursor {
    fn parse(text: &str) -> Result<Self, ServiceError> {
        let parsed = text.split_once(':').and_then(|(score, image)| {
            let score = f32::from_bits(u32::from_str_radix(score, 16).ok()?);
            Some(Self { score, image: image.parse().ok()? })
        });
        parsed.ok_or_else(|| {
            ServiceError::malformed(
                "cursor is not that of a search for text; send next_cursor of the page before, with the same text",
            )
        })
    }
}

impl std::fmt::Display for TextCursor {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:08x}:{}", self.score.to_bits(), self.image)
    }
}

impl Images {
    /// Returns an image without its bytes, and what was read in it.
    pub async fn state(&self, map: &MapName, id: &ImageId) -> Result<ImageState, ServiceError> {
        let image = self.get(map, id).await?;
        let map = self.maps.find(map).await?;
        let texts = self.maps.reading.texts().texts(&map, std::slice::from_ref(id)).await?;
        Ok(ImageState { image, texts: texts.into_iter().next().flatten() })
    }

    /// Returns a page of the images in which a text was read, the best match first. Typing errors, and what readers get
    /// wrong, are tolerated.
    pub async fn find(
        &self,
        map: &MapName,
        text: &str,
        cursor: Option<&str>,
        limit: Option<usize>,
    ) -> Result<ImagePage, ServiceError> {
        let limit = page_size(limit)?;
        let after = cursor.map(TextCursor::parse).transpose()?;
        if text.chars().count() > MAX_CHARS {
            return Err(ServiceError::unprocessable(format!(
                "text has more than {MAX_CHARS} characters; search for the name on the sign"
            )));
        }
        let query = TextQuery::new(text).ok_or_else(|| {
            ServiceError::unprocessable(
                "text has neither letters nor digits; send what the sign says",
            )
        })?;
        let map = self.maps.find(map).await?;
        let images = self.maps.store.index_state(&map).await?.images;
        let read = self.maps.reading.state_of(&map, images).await?;
        check_read(&map, images, read.as_ref())?;
        let mut found = self.maps.reading.find(&map, text, query).await?;
        if let Some(TextCursor { score, image }) = &after {
            found.retain(|found| found.order(*score, image).is_gt());
        }
        let more = found.len() > limit;
        found.truncate(limit);
        let last = found.last().filter(|_| more);
        let next_cursor = last
            .map(|Found { score, image, .. }| TextCursor { score: *score, image: image.clone() });
        let ids: Vec<ImageId> = found.iter().map(|found| found.image.clone()).collect();
        let (mut images, mut matches) = (Vec::new(), Vec::new());
        for (image, found) in self.maps.store.images_by_id(&map, &ids).await?.into_iter().zip(found)
        {
            // One that was removed meanwhile is left out.
            let Some(image) = image else { continue };
            images.push(image);
            let Found { image, score, texts, lines } = found;
            let lines = lines.into_iter().filter_map(|at| texts.lines.get(at).cloned()).collect();
            matches.push(ImageMatch { image_id: image, score, lines });
        }
        let unread = read.and_then(|read| read.waiting);
        Ok(ImagePage {
            images,
            next_cursor: next_cursor.map(|cursor| cursor.to_string()),
            matches: Some(matches),
            unread,
        })
    }
}

/// Refuses a search where nothing was read, and says what to do.
pub(super) fn check_read(
    map: &Map,
    images: usize,
    read: Option<&MapTexts>,
) -> Result<(), ServiceError> {
    let name = &map.name;
    let why = match read {
        _ if images == 0 => return Ok(()),
        None => format!(
            "no text was read in the map {name}: this server has no reader. Install one with `make reader` \
             (reading.reader names it), restart the server, and it reads the images"
        ),
        Some(MapTexts { read: 0, failed: 0, waiting: Some(waiting), .. }) => format!(
            "the text in the map {name} is not read yet: {waiting} images wait. Try again; `texts` of GET \
             /maps/{name} shows the progress"
        ),
        Some(_) => return Ok(()),
    };
    Err(ServiceError::new(ErrorKind::Conflict, why))
}

impl Reading {
    /// Returns the images of a map that match, the best first, then by id.
    async fn find(
        &self,
        map: &Map,
        text: &str,
        query: TextQuery,
    ) -> Result<Vec<Found>, ServiceError> {
        // One search at a time: it takes a core for up to a second.
        let Ok(_turn) = self.searching.acquire().await else { return Ok(Vec::new()) };
        let grams = TextQuery::grams(text);
        let candidates = self.texts().text_candidates(map, &grams, MAX_CANDIDATES).await?;
        let ids: Vec<ImageId> = candidates.into_iter().map(|candidate| candidate.image).collect();
        let (mut found, mut comparisons) = (Vec::new(), 0);
        for page in ids.chunks(PAGE) {
            let texts = self.texts().texts(map, page).await?;
            let read: Vec<(ImageId, ImageTexts)> = page
                .iter()
                .cloned()
                .zip(texts)
                .filter_map(|(id, texts)| Some((id, texts?)))
                .collect();
            let query = query.clone();
            let matching = move || matching(&query, read);
            let (matches, compared) = tokio::task::spawn_blocking(matching)
                .await
                .map_err(|error| ServiceError::new(ErrorKind::Internal, error.to_string()))?;
            found.extend(matches);
            comparisons += compared;
            if comparisons > MAX_COMPARISONS {
                tracing::warn!(map = %map.name, "a search for text was cut short: the images have very many lines");
                break;
            }
        }
        found.sort_by(|a: &Found, b| b.order(a.score, &a.image).reverse());
        Ok(found)
    }
}

/// The images that match, and about how many characters were compared.
fn matching(query: &TextQuery, read: Vec<(ImageId, ImageTexts)>) -> (Vec<Found>, usize) {
    let mut compared = 0;
    let mut found = Vec::new();
    for (image, texts) in read {
        let chars: usize = texts.lines.iter().map(|line| line.text.len()).sum();
        // Each line is compared by itself and with those before and after it, and then word by word.
        compared += 4 * chars * MAX_CHARS;
        if let Some(TextMatch { score, lines }) = query.matches(&texts.lines) {
            found.push(Found { image, score, texts, lines });
        }
    }
    (found, compared)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cursor_is_read_as_it_was_written() {
        for (score, image) in [(0.5, "a"), (1.0, "a:b/c.jpg"), (0.933_333_3, "東京")] {
            let cursor = TextCursor { score, image: image.parse().unwrap() };
            assert_eq!(TextCursor::parse(&cursor.to_string()).unwrap(), cursor);
        }
        for other in ["", "a", "image-1", "zz:a", "3f000000:"] {
            assert!(TextCursor::parse(other).is_err(), "{other:?}");
        }
    }
}
