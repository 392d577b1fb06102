//! Fitting: makes a vocabulary of a map's own, and measures whether it is better than the model's.
//!
//! The measurement needs no frame of known position. A fifth of the images is left out of the fit, and each of these is
//! searched among the others by the model's descriptors, by the new ones, and by what both were shortened from. A
//! vocabulary is as good as it finds the image that is nearest before anything is lost.

use std::collections::HashMap;
use std::sync::Arc;

use jiff::Timestamp;
use whereabouts_api::ErrorKind;
use whereabouts_core::{
    Descriptor, DescriptorKind, Digest, Image, ImageId, Map, MapVocabulary, dot,
};
use whereabouts_vision::{
    AdmissionRequest, Extractor, FeatureSet, Manifest, OwnVocabulary, Vocabulary,
};

use super::reindex::{Reindexer, cannot_reindex};
use super::{ServiceError, VocabularySettings};

/// Images that are listed at a time.
const PAGE: usize = 256;

/// One in this many images is left out of the fit that is measured.
const LEFT_OUT: usize = 5;

/// Descriptors that are known already, by image, each with the digest of its picture.
pub(super) type KnownDescriptors = HashMap<ImageId, (Digest, Descriptor)>;

/// A vocabulary that was fitted on the images of a map.
pub(super) struct FittedVocabulary {
    pub record: MapVocabulary,
    pub vocabulary: Arc<Vocabulary>,
    pub bytes: Vec<u8>,
}

/// What a fit has found; by default, that none was made.
#[derive(Default)]
pub(super) struct Fitting {
    /// The vocabulary; `None` if the model's is better.
    pub fitted: Option<FittedVocabulary>,
    /// The descriptors of the images that were looked at, with that vocabulary or with the model's.
    pub known: KnownDescriptors,
    /// How often the nearest image was found.
    pub agreement: Option<AgreementRates>,
}

/// How often descriptors find the image that is nearest before they are shortened, from 0 to 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct AgreementRates {
    /// With the model's vocabulary.
    pub shipped: f64,
    /// With the map's own.
    pub own: f64,
}

/// An image with both of its descriptors.
pub(super) struct Sample {
    pub image: Image,
    pub shipped: Descriptor,
    pub expanded: Vec<f32>,
}

impl Reindexer {
    /// Fits a vocabulary for a map. Unless `forced`, it is only returned if it is at least as good as the model's.
    pub(super) async fn fit(
        &self,
        map: &Map,
        extractor: &Arc<Extractor>,
        kind: DescriptorKind,
        forced: bool,
    ) -> Result<Fitting, ServiceError> {
        let own = extractor
            .own_vocabulary(kind)
            .ok_or_else(|| no_vocabulary(extractor.manifest(), kind))?;
        let own = Arc::new(own);
        let mut samples = Vec::new();
        for image in self.sample(map).await? {
            samples.extend(self.expand(map, image, extractor, kind, &own).await?);
            self.maps.reindexes.set_done(map.uid, samples.len());
        }
        let of = self.maps.store.index_state(map).await?.images;
        blocking(move || decide(&own, samples, of, forced)).await
    }

    /// Both descriptors of an image; `None` if the image was deleted meanwhile or has no local features.
    pub(super) async fn expand(
        &self,
        map: &Map,
        image: Image,
        extractor: &Arc<Extractor>,
        kind: DescriptorKind,
        own: &Arc<OwnVocabulary>,
    ) -> Result<Option<Sample>, ServiceError> {
        let Some(bytes) = self.bytes_of(map, &image).await? else { return Ok(None) };
        let _permit = self.maps.reindexes.extraction.acquire().await;
        let (features, request) = (FeatureSet::DescriptorAndDense, AdmissionRequest::BACKGROUND);
        let extracting =
            self.maps.imaging.extract(extractor, bytes, kind.into(), features, request);
        let extraction = extracting.await.map_err(|error| cannot_reindex(&image, &error.detail))?;
        let Some(dense) = extraction.dense else { return Ok(None) };
        let expanding = Arc::clone(own);
        let expanded = blocking(move || Ok(expanding.expand(&dense))).await?;
        Ok(Some(Sample { image, shipped: extraction.descriptor, expanded }))
    }

    /// The images to fit on: all, or as many as may be, evenly spread.
    pub(super) async fn sample(&self, map: &Map) -> Result<Vec<Image>, ServiceError> {
        let count = self.maps.store.index_state(map).await?.images;
        let step = count.div_ceil(self.settings.max_images).max(1);
        let (mut images, mut last, mut at) = (Vec::new(), None, 0);
        loop {
            let page = self.maps.store.images(map, last.as_ref(), PAGE).await?;
            let Some(end) = page.last() else { return Ok(images) };
            last = Some(end.id.clone());
            for image in page {
                if at % step == 0 && images.len() < self.settings.max_images {
                    images.push(image);
                }
                at += 1;
            }
        }
    }
}

/// Fits a vocabulary and chooses between it and the model's.
fn decide(
    own: &OwnVocabulary,
    samples: Vec<Sample>,
    of: usize,
    forced: bool,
) -> Result<Fitting, ServiceError> {
    let agreement = compare(own, &samples)?;
    let is_better = agreement.own >= agreement.shipped;
    let fitted = if forced || is_better {
        let pictures: Vec<&[f32]> = samples.iter().map(|s| s.expanded.as_slice()).collect();
        let vocabulary = Arc::new(own.fit(&pictures).map_err(ServiceError::unprocessable)?);
        let bytes = vocabulary.to_bytes();
        let record = MapVocabulary {
            digest: Digest::of(&bytes),
            fitted_at: Timestamp::now(),
            images: samples.len(),
            of,
            requested: forced,
        };
        Some(FittedVocabulary { record, vocabulary, bytes })
    } else {
        None
    };
    let known = samples.into_iter().filter_map(|Sample { image, shipped, expanded }| {
        let descriptor = match &fitted {
            Some(fitted) => fitted.vocabulary.describe(&expanded).ok()?,
            None => shipped,
        };
        Some((image.id, (image.digest, descriptor)))
    });
    Ok(Fitting { known: known.collect(), fitted, agreement: Some(agreement) })
}

/// Measures both vocabularies on images that are left out of a fit.
fn compare(own: &OwnVocabulary, samples: &[Sample]) -> Result<AgreementRates, ServiceError> {
    let (mut asked, mut others) = (Vec::new(), Vec::new());
    for (at, sample) in samples.iter().enumerate() {
        if at % LEFT_OUT == LEFT_OUT / 2 { &mut asked } else { &mut others }.push(sample);
    }
    if asked.is_empty() || others.len() < 2 {
        return Err(ServiceError::unprocessable(format!(
            "a vocabulary cannot be fitted on {} images; add more to the map",
            samples.len()
        )));
    }
    let pictures: Vec<&[f32]> = others.iter().map(|other| other.expanded.as_slice()).collect();
    let fitted = own.fit(&pictures).map_err(ServiceError::unprocessable)?;
    let describe = |sample: &&Sample| fitted.describe(&sample.expanded).ok();
    let described: Vec<Option<Descriptor>> = others.iter().map(describe).collect();
    let (mut shipped, mut own) = (0, 0);
    for query in &asked {
        let best = nearest(&others, |other, _| Some(dot(&query.expanded, &other.expanded)));
        let by_model = nearest(&others, |other, _| Some(query.shipped.similarity(&other.shipped)));
        let query = describe(query);
        let by_own =
            nearest(&others, |_, at| Some(query.as_ref()?.similarity(described[at].as_ref()?)));
        shipped += usize::from(by_model == best);
        own += usize::from(by_own == best);
    }
    let rate = |found: usize| found as f64 / asked.len() as f64;
    Ok(AgreementRates { shipped: rate(shipped), own: rate(own) })
}

/// The index of the sample with the highest similarity.
fn nearest(
    others: &[&Sample],
    similarity: impl Fn(&Sample, usize) -> Option<f32>,
) -> Option<usize> {
    let similarities = others.iter().enumerate().map(|(at, other)| (at, similarity(other, at)));
    let known = similarities.filter_map(|(at, similarity)| Some((at, similarity?)));
    known.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))).map(|(at, _)| at)
}

/// Why the background leaves a map as it is; `None` if a vocabulary may be fitted.
pub(super) fn obstacle(map: &Map, images: usize, settings: &VocabularySettings) -> Option<String> {
    let VocabularySettings { own, min_images, max_images, .. } = *settings;
    if map.keeps_shipped {
        Some("the map was reindexed with \"vocabulary\": \"shipped\"; \"own\" undoes that".into())
    } else if !own {
        Some("vocabulary.own is off".into())
    } else if images < min_images {
        Some(format!("the map has fewer than {min_images} images (vocabulary.min_images)"))
    } else if images > max_images {
        Some(format!(
            "the map has more than {max_images} images (vocabulary.max_images), where an own vocabulary is not better"
        ))
    } else {
        None
    }
}

pub(super) fn no_vocabulary(manifest: &Manifest, kind: DescriptorKind) -> ServiceError {
    ServiceError::unprocessable(format!(
        "the descriptor {:?} of the model {:?} has no vocabulary that could be fitted on a map; leave vocabulary out",
        kind.as_str(),
        manifest.name
    ))
}

pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, ServiceError> + Send + 'static,
) -> Result<T, ServiceError> {
    let done = tokio::task::spawn_blocking(work).await;
    done.unwrap_or_else(|error| Err(ServiceError::new(ErrorKind::Internal, error.to_string())))
}

#[cfg(test)]
mod tests;
