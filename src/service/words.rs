//! Localization from words alone: by the signs that a description names.

use std::collections::BTreeSet;
use std::time::Instant;

use super::text_search::check_read;
use super::{LocalizeSettings, Maps, ServiceError};
use whereabouts_api::{
    ErrorKind, NamedSign, SeenSign, WordsAnswer, WordsCandidate, WordsEstimate, WordsTimingMs,
};
use whereabouts_core::text_search::TextQuery;
use whereabouts_core::words::{
    Described, Fit, MAX_CHARS, MAX_WORDS, Run, Sign, WordsModel, find_signs, runs,
};
use whereabouts_core::{CalibrationSettings, ImageId, Map, MapName, Pose, SamePlace, TextLine};

/// The most images whose texts are compared with a word: those that share most pairs of characters.
const MAX_CANDIDATES: usize = 1000;

/// The most images that are weighed against each other.
const MAX_FITS: usize = 1000;

/// Images whose texts are read at a time.
const PAGE: usize = 100;

/// The most characters of the lines that are compared with the words. A search takes about a second then.
const MAX_CHARS_COMPARED: usize = 4_000_000;

/// Another place is named as possible too if it has at least this share of the probability.
const ALSO_POSSIBLE: f64 = 0.25;

/// A place described in words, to be found in a map.
#[derive(Debug)]
pub struct WordsQuery {
    /// The map to search.
    pub map: MapName,
    /// The description.
    pub text: String,
    /// Number of candidates in the answer; the configured number by default.
    pub k: Option<usize>,
}

/// Finds places by descriptions.
pub struct WordsLocalizer {
    /// The maps.
    pub maps: Maps,
    /// Bounds and defaults.
    pub settings: LocalizeSettings,
    /// Which images show the same place.
    pub places: CalibrationSettings,
}

/// An image with at least one of the signs.
struct Seen {
    id: ImageId,
    lines: Vec<TextLine>,
}

/// The signs that a description names, and the images with at least one of them, to which the signs refer by index.
struct Found {
    signs: Vec<Sign>,
    images: Vec<Seen>,
    warnings: Vec<String>,
}

impl WordsLocalizer {
    /// Answers with the images in which the signs were read that the description names.
    pub async fn localize(&self, query: WordsQuery) -> Result<WordsAnswer, ServiceError> {
        let start = Instant::now();
        let k = self.settings.checked_k(query.k)?;
        let runs = runs_of(&query.text)?;
        let map = self.maps.find(&query.map).await?;
        let images = self.maps.store.index_state(&map).await?.images;
        let counts = self.maps.reading.state_of(&map, images).await?;
        check_read(&map, images, counts.as_ref())?;
        let unread = images.saturating_sub(counts.map_or(0, |counts| counts.read));
        let Found { signs, images: seen, warnings } = self.search(&map, runs).await?;

        let ids: Vec<ImageId> = seen.iter().map(|seen| seen.id.clone()).collect();
        let poses: Vec<Option<Pose>> = self
            .maps
            .store
            .images_by_id(&map, &ids)
            .await?
            .into_iter()
            .map(|image| image.and_then(|image| image.pose))
            .collect();
        let slots = self.maps.store.slots(&map, &ids).await?;
        let places: Vec<_> = slots.into_iter().zip(poses.iter().copied()).collect();
        let places = SamePlace::of(&places, images, &self.places);
        let described = Described { signs: &signs, with_signs: seen.len(), images, unread };
        let fits = described.fits(&WordsModel::default(), &places);

        let estimate = fits.first().map(|fit| WordsEstimate {
            image_id: seen[fit.image].id.clone(),
            pose: poses[fit.image],
            probability: fit.place,
            known: fit.place >= self.settings.known_confidence,
        });
        let is_known = estimate.as_ref().is_some_and(|estimate| estimate.known);
        let candidate = |(at, fit): (usize, &Fit)| WordsCandidate {
            rank: at + 1,
            image_id: seen[fit.image].id.clone(),
            pose: poses[fit.image],
            probability: fit.probability,
            signs: signs.iter().filter_map(|sign| seen_in(sign, fit.image, &seen)).collect(),
        };
        Ok(WordsAnswer {
            map: map.name,
            candidates: fits.iter().take(k).enumerate().map(candidate).collect(),
            estimate,
            reason: (!is_known).then(|| why_unknown(&signs, &fits, &places, unread)),
            signs: signs.iter().map(named).collect(),
            unread,
            warnings,
            timing_ms: WordsTimingMs { total: start.elapsed().as_secs_f64() * 1e3 },
        })
    }

    /// Finds the signs among the texts of the map.
    async fn search(&self, map: &Map, runs: Vec<Run>) -> Result<Found, ServiceError> {
        let texts = self.maps.reading.texts();
        // One search at a time: it takes a core for up to a second.
        let _turn = self.maps.reading.searching.acquire().await.map_err(internal)?;
        // Each word by itself, and all of a run, whose sign then is among the first however frequent its words are.
        let words = runs.iter().flat_map(|run| &run.words).map(|word| word.text.clone());
        let mut wanted = BTreeSet::new();
        for text in words.chain(runs.iter().map(Run::text)).collect::<BTreeSet<String>>() {
            let grams = TextQuery::grams(&text);
            let found = texts.text_candidates(map, &grams, MAX_CANDIDATES).await?;
            wanted.extend(found.into_iter().map(|candidate| candidate.image));
        }
        let wanted: Vec<ImageId> = wanted.into_iter().collect();
        let (mut read, mut chars, mut warnings) = (Vec::new(), 0, Vec::new());
        for page in wanted.chunks(PAGE) {
            for (id, found) in page.iter().zip(texts.texts(map, page).await?) {
                let Some(found) = found else { continue };
                chars += found.lines.iter().map(|line| line.text.len()).sum::<usize>();
                read.push(Seen { id: id.clone(), lines: found.lines });
            }
            if chars > MAX_CHARS_COMPARED {
                let compared = read.len();
                warnings.push(format!(
                    "only the first {compared} of {} images that may match were compared; send fewer words",
                    wanted.len()
                ));
                break;
            }
        }
        if runs.iter().map(|run| run.words.len()).sum::<usize>() == MAX_WORDS {
            warnings.push(format!(
                "words behind the first {MAX_WORDS} that may be on signs were ignored"
            ));
        }
        let find = move || {
            let lines: Vec<&[TextLine]> = read.iter().map(|seen| seen.lines.as_slice()).collect();
            let signs = find_signs(&runs, &lines);
            let (signs, images) = only_with_signs(signs, read);
            Found { signs, images, warnings }
        };
        tokio::task::spawn_blocking(find).await.map_err(internal)
    }
}

fn internal(error: impl std::fmt::Display) -> ServiceError {
    ServiceError::new(ErrorKind::Internal, error.to_string())
}

/// The runs of words of a description that may be on signs.
fn runs_of(text: &str) -> Result<Vec<Run>, ServiceError> {
    let length = text.chars().count();
    if length > MAX_CHARS {
        return Err(ServiceError::unprocessable(format!(
            "text has {length} characters, more than {MAX_CHARS}; send what the signs say"
        )));
    }
    if TextQuery::new(text).is_none() {
        return Err(ServiceError::unprocessable(
            "text has neither letters nor digits; describe the place, above all what signs say",
        ));
    }
    Ok(runs(text))
}

/// Drops the images without signs, and of very many those with the weakest. The signs refer to what is left.
fn only_with_signs(mut signs: Vec<Sign>, images: Vec<Seen>) -> (Vec<Sign>, Vec<Seen>) {
    let mut scores = vec![0.0; images.len()];
    for at in signs.iter().flat_map(|sign| &sign.images) {
        scores[at.image] += at.score;
    }
    let mut kept: Vec<usize> = (0..images.len()).filter(|&at| scores[at] > 0.0).collect();
    kept.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    kept.truncate(MAX_FITS);
    kept.sort_unstable();
    for sign in &mut signs {
        sign.images.retain_mut(|at| match kept.binary_search(&at.image) {
            Ok(index) => {
                at.image = index;
                true
            }
            Err(_) => false,
        });
    }
    let images = images.into_iter().enumerate();
    let images = images.filter(|(at, _)| kept.binary_search(at).is_ok()).map(|(_, seen)| seen);
    (signs, images.collect())
}

fn seen_in(sign: &Sign, image: usize, seen: &[Seen]) -> Option<SeenSign> {
    let at = sign.images.iter().find(|at| at.image == image)?;
    let lines = at.lines.iter().filter_map(|&line| seen[image].lines.get(line).cloned()).collect();
    Some(SeenSign { text: sign.text.clone(), lines })
}

fn named(sign: &Sign) -> NamedSign {
    NamedSign { text: sign.text.clone(), is_name: sign.is_name, images: sign.images.len() }
}

/// Why the place is not known, and what would help.
fn why_unknown(signs: &[Sign], fits: &[Fit], places: &SamePlace, unread: usize) -> String {
    let waiting = match unread {
        0 => String::new(),
        1 => "; one image is not read yet, and may".into(),
        more => format!("; {more} images are not read yet, and may"),
    };
    let Some(first) = fits.first() else {
        return match signs.first() {
            None => format!(
                "no sign of the map says any of this{waiting}. Quote what signs say, such as \"City Bank\""
            ),
            Some(_) => format!("no image of the map shows any of the signs{waiting}"),
        };
    };
    let other = fits.iter().find(|fit| !places.contains(first.image, fit.image));
    let missing: Vec<String> = signs
        .iter()
        .filter(|sign| sign.is_name && sign.images.is_empty())
        .map(|sign| format!("{:?}", sign.text))
        .collect();
    if other.is_some_and(|other| other.place >= ALSO_POSSIBLE * first.place) {
        "the signs fit more than one place; name another sign that is seen there".into()
    } else if !missing.is_empty() {
        format!(
            "no image of the map shows {}; the place may be another one{waiting}",
            missing.join(", ")
        )
    } else {
        format!("the signs may be elsewhere too; name another sign that is seen there{waiting}")
    }
}
