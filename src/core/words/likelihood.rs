//! How well a description fits the images of a map: the likelihood that it names its signs, by a Bernoulli model of the
//! signs of each image (Ponte and Croft, A language modeling approach to information retrieval, 1998), smoothed by the
//! signs of the whole map (Jelinek-Mercer: Zhai and Lafferty, A study of smoothing methods, 2001).

use std::collections::BTreeSet;

use super::{Sign, SignIn};
use crate::SamePlace;

/// The parameters of the model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WordsModel {
    /// Probability, before anything is known, that the place is not in the map.
    pub off_map: f64,
    /// Share of the names in a description that the image of its place does not show: read wrongly, out of the picture, or
    /// of another place.
    pub other_names: f64,
    /// The same share of words that may be no names.
    pub other_words: f64,
    /// How much a sign counts that only another image of the same place shows.
    pub beside: f64,
}

impl Default for WordsModel {
    fn default() -> Self {
        Self { off_map: 0.2, other_names: 0.2, other_words: 0.5, beside: 0.3 }
    }
}

/// How well an image fits.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// The image, by its index.
    pub image: usize,
    /// Probability, 0 to 1, that the image shows the place.
    pub probability: f64,
    /// Probability, 0 to 1, of the place: of all images that show the same.
    pub place: f64,
}

/// A description, and what was read in the images of a map.
#[derive(Debug)]
pub struct Described<'a> {
    /// The signs that it names.
    pub signs: &'a [Sign],
    /// Number of images with at least one of the signs.
    pub with_signs: usize,
    /// Images in the map, read or not.
    pub images: usize,
    /// Images of the map that were not read. Each may show any sign.
    pub unread: usize,
}

/// A sign in an image, and how many times as probable the description is that names it, if this is its image.
struct Gain<'a> {
    sign: usize,
    at: &'a SignIn,
    ratio: f64,
}

impl Described<'_> {
    /// The images with their probabilities, the most probable first, of those that are at least as probable as an image
    /// without any of the signs. `same_place` says which of the images, by index, show the same place.
    ///
    /// Sign t is named in a description of image i with P(t|i) ∝ (1 − λ) s + λ P(t|map), where s is how well a line of the
    /// image matches, from 0 to 1, λ the share of signs that the image does not show, and P(t|map) the share of the images
    /// that show it, with one more image than there are. Outside the map, signs are as frequent as within it. Everything
    /// is relative to that: a sign that was read nowhere counts λ against the map, and a frequent one counts little for an
    /// image.
    pub fn fits(&self, model: &WordsModel, same_place: &SamePlace) -> Vec<Fit> {
        let gains = self.gains(model);
        let shares: Vec<f64> = self.signs.iter().map(|sign| model.other(sign)).collect();
        // ln of the likelihood of an image without any sign, relative to a place outside the map.
        let nothing: f64 = shares.iter().map(|share| share.ln()).sum();
        let count = self.with_signs;
        let mut ratios = vec![shares; count];
        let own = ratios_of(&gains, &ratios);
        for (image, ratios) in ratios.iter_mut().enumerate() {
            for (sign, ratio) in ratios.iter_mut().enumerate() {
                let beside = (0..count)
                    .filter(|&other| other != image && same_place.contains(image, other))
                    .map(|other| (own[other][sign] - *ratio) * model.beside + *ratio);
                *ratio = beside.fold(own[image][sign], f64::max);
            }
        }
        let logs: Vec<f64> =
            ratios.iter().map(|ratios| ratios.iter().map(|ratio| ratio.ln()).sum()).collect();
        self.posterior(model, &logs, nothing, same_place)
    }

    fn posterior(
        &self,
        model: &WordsModel,
        logs: &[f64],
        nothing: f64,
        same_place: &SamePlace,
    ) -> Vec<Fit> {
        let each = (1.0 - model.off_map) / self.images.max(1) as f64;
        let unread = self.unread.min(self.images.saturating_sub(logs.len()));
        let others = self.images - logs.len().min(self.images) - unread;
        let largest = logs.iter().copied().fold(0.0, f64::max);
        let weight = |log: f64| (log - largest).exp();
        let all: f64 = model.off_map * weight(0.0)
            + each * unread as f64 * weight(0.0)
            + each * others as f64 * weight(nothing)
            + logs.iter().map(|log| each * weight(*log)).sum::<f64>();
        let probability = |image: usize| each * weight(logs[image]) / all;
        let mut fits: Vec<Fit> = (0..logs.len())
            .filter(|&image| logs[image] > nothing)
            .map(|image| {
                let of_place = |other: &usize| same_place.contains(image, *other);
                let place = (0..logs.len()).filter(of_place).map(probability).sum::<f64>();
                Fit { image, probability: probability(image), place: place.min(1.0) }
            })
            .collect();
        fits.sort_by(|a, b| b.probability.total_cmp(&a.probability).then(a.image.cmp(&b.image)));
        fits
    }

    /// The signs in each image, the strongest evidence first.
    fn gains(&self, model: &WordsModel) -> Vec<Vec<Gain<'_>>> {
        let mut gains: Vec<Vec<Gain<'_>>> = (0..self.with_signs).map(|_| Vec::new()).collect();
        for (sign, named) in self.signs.iter().enumerate() {
            let worth = |at: &SignIn| f64::from(2.0 * at.score - 1.0).clamp(0.0, 1.0);
            let read: f64 = named.images.iter().map(worth).sum();
            let frequency = sign_frequency(read, self.images.saturating_sub(self.unread));
            for at in &named.images {
                let ratio = sign_ratio(model.other(named), worth(at), frequency);
                gains[at.image].push(Gain { sign, at, ratio });
            }
        }
        for gains in &mut gains {
            gains.sort_by(|a, b| b.ratio.total_cmp(&a.ratio));
        }
        gains
    }
}

impl WordsModel {
    fn other(&self, sign: &Sign) -> f64 {
        if sign.is_name { self.other_names } else { self.other_words }
    }
}

/// Share of images that show a sign, P(t|map), given the sum of how well it was read in them and their number, with one more
/// image that shows it than there is.
pub fn sign_frequency(shown: f64, images: usize) -> f64 {
    (shown + 1.0) / (images as f64 + 1.0).max(shown + 1.0)
}

/// How many times as probable it is that a sign is named of an image which shows it with `worth`, from 0 to 1, as of any
/// image: λ + (1 − λ) s / P(t|map), where λ is the share `other` of signs that the image of a place does not show.
pub fn sign_ratio(other: f64, worth: f64, frequency: f64) -> f64 {
    other + (1.0 - other) * worth / frequency
}

/// The ratios of each image for each sign. A line is evidence once: another sign that it matches too counts as not shown.
fn ratios_of(gains: &[Vec<Gain<'_>>], without: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut ratios = without.to_vec();
    for (ratios, gains) in ratios.iter_mut().zip(gains) {
        let mut used: BTreeSet<usize> = BTreeSet::new();
        for gain in gains {
            let is_new = gain.at.lines.iter().all(|line| !used.contains(line));
            if is_new {
                ratios[gain.sign] = gain.ratio;
                used.extend(&gain.at.lines);
            }
        }
    }
    ratios
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{CalibrationSettings, Pose};

    /// A sign with the images and scores where it was read, and the line in each.
    fn sign(text: &str, at: &[(usize, f32, usize)]) -> Sign {
        let at = at.iter().map(|&(image, score, line)| SignIn { image, score, lines: vec![line] });
        Sign { text: text.into(), is_name: true, images: at.collect() }
    }

    fn fits(signs: &[Sign], images: usize, unread: usize) -> Vec<Fit> {
        let described = Described { signs, with_signs: 3, images, unread };
        described.fits(&WordsModel::default(), &SamePlace::default())
    }

    #[test]
    fn the_probability_is_that_of_the_model() {
        // One sign in one of ten images: each image has 0.08 at first, and other places 0.2.
        let found = fits(&[sign("a", &[(0, 1.0, 0)])], 10, 0);
        let ratio = 0.2 + 0.8 / (2.0 / 11.0);
        let expected = 0.08 * ratio / (0.2 + 0.08 * ratio + 9.0 * 0.08 * 0.2);
        assert_eq!(found.len(), 1);
        assert!((found[0].probability - expected).abs() < 1e-12, "{found:?} {expected}");
        assert!(found[0].probability < 0.9, "one sign is not enough");
        let two = fits(&[sign("a", &[(0, 1.0, 0)]), sign("b", &[(0, 1.0, 1)])], 100, 0);
        assert!(two[0].probability > 0.9 && two[0].probability < 1.0, "{two:?}");
    }

    #[test]
    fn what_makes_a_place_less_certain_lowers_its_probability() {
        let (a, b) = (sign("a", &[(0, 1.0, 0)]), sign("b", &[(0, 1.0, 1)]));
        let probability = |signs: &[Sign], unread| fits(signs, 100, unread)[0].probability;
        let sure = probability(&[a.clone(), b.clone()], 0);
        // A name that was read nowhere, images that were not read, a sign that is on other images too, and a worse match.
        assert!(probability(&[a.clone(), b.clone(), sign("c", &[])], 0) < sure);
        assert!(probability(&[a.clone(), b.clone()], 90) < sure);
        let elsewhere = sign("b", &[(0, 1.0, 1), (1, 1.0, 0), (2, 1.0, 0)]);
        assert!(probability(&[a.clone(), elsewhere], 0) < sure);
        assert!(probability(&[a.clone(), sign("b", &[(0, 0.7, 1)])], 0) < sure);
        // Two words of the same line are evidence once.
        assert!(
            probability(&[a.clone(), sign("b", &[(0, 1.0, 0)])], 0) < probability(&[a], 0) + 1e-12
        );
    }

    #[test]
    fn nothing_named_or_nothing_read_is_no_place() {
        assert!(fits(&[], 10, 0).is_empty());
        assert!(fits(&[sign("a", &[])], 10, 0).is_empty());
        assert!(fits(&[sign("a", &[])], 0, 0).is_empty());
    }

    #[test]
    fn images_of_one_place_share_their_signs_and_add_up() {
        let at = |x: f64| -> (Option<usize>, Option<Pose>) {
            (None, serde_json::from_value(serde_json::json!({ "x": x, "y": 0.0 })).ok())
        };
        let settings = CalibrationSettings { place_m: 10.0, ..CalibrationSettings::default() };
        let places = SamePlace::of(&[at(0.0), at(5.0), at(500.0)], 100, &settings);
        // Alice: there is an a and a b on different sides. No image shows both, but two images of one place do.
        let signs = [sign("a", &[(0, 1.0, 0), (2, 1.0, 0)]), sign("b", &[(1, 1.0, 0)])];
        let described = Described { signs: &signs, with_signs: 3, images: 100, unread: 0 };
        let together = described.fits(&WordsModel::default(), &places);
        assert!(together[0].image < 2 && together[0].place > 1.5 * together[0].probability);
        let apart = described.fits(&WordsModel::default(), &SamePlace::default());
        assert!(together[0].place > apart[0].place, "{together:?} {apart:?}");
        let sum: f64 = together.iter().map(|fit| fit.probability).sum();
        assert!(sum < 1.0);
    }
}
