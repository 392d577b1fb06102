//! The text that decides the file name of cached outcomes.
//!
//! The text is written field by field rather than derived, so that renaming a type or a field does not
//! orphan the outcomes that earlier runs have cached. Its bytes must not change; a new setting that
//! affects outcomes is appended.

use whereabouts_core::{Calibration, CalibrationSettings, Digest, MapName, Scene};
use whereabouts_index::SearchMode;

/// Everything that decides the outcome of a method for a query.
pub(super) struct CacheKey<'a> {
    /// The version of this program.
    pub version: &'a str,
    /// The map of the references.
    pub map: &'a MapName,
    /// Digest of the references.
    pub references: Digest,
    /// How the map is searched.
    pub search: SearchMode,
    /// Number of candidates.
    pub k: usize,
    /// The scene and the fingerprint of the refiners' settings, for a refined method.
    pub refinement: Option<(Scene, &'a str)>,
    /// The settings of the calibration.
    pub calibration: CalibrationSettings,
    /// The map's own vocabulary.
    pub vocabulary: Option<Digest>,
    /// What reads the signs that a refiner compares.
    pub reader: Option<Digest>,
}

impl CacheKey<'_> {
    /// Returns the text to hash.
    pub fn text(&self) -> String {
        let Self {
            version,
            map,
            references,
            search,
            k,
            refinement,
            calibration,
            vocabulary,
            reader,
        } = self;
        let search = match search {
            SearchMode::Fast => "Fast",
            SearchMode::Exact => "Exact",
        };
        let refinement = refinement.map_or_else(
            || "None".to_owned(),
            |(scene, settings)| {
                let scene = match scene {
                    Scene::Outdoor => "Outdoor",
                    Scene::Indoor => "Indoor",
                };
                format!("Some(({scene}, {}))", quoted(settings))
            },
        );
        let CalibrationSettings { images, refined, candidates, place_images, place_m, model_calls } =
            calibration;
        let model_calls =
            if *model_calls > 0 { format!("\nmodel_calls: {model_calls}") } else { String::new() };
        let vocabulary =
            vocabulary.map_or_else(String::new, |digest| format!("\nvocabulary: {digest}"));
        let reader = reader.map_or_else(String::new, |digest| format!("\nreader: {digest}"));
        let place_m = float(*place_m);
        // A cached confidence is of the evidence that was measured then.
        let evidence = Calibration::EVIDENCE;
        format!(
            "{version}\n{map}\n{references}\n{search}\n{k}\n{refinement}\nCalibrationSettings {{ \
             images: {images}, refined: {refined}, candidates: {candidates}, place_images: \
             {place_images}, place_m: {place_m} }}{model_calls}{vocabulary}{reader}\nevidence: {evidence}"
        )
    }
}

/// Writes a finite number with a decimal point, in as few digits as identify it.
fn float(number: f64) -> String {
    let text = number.to_string();
    if text.contains('.') { text } else { text + ".0" }
}

/// Writes a text in double quotes, with `"` and `\` escaped.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_key_has_the_same_bytes_in_every_build() {
        let key = |search, refinement| {
            let calibration = CalibrationSettings {
                images: 200,
                refined: 20,
                candidates: 10,
                place_images: 5,
                place_m: 25.0,
                model_calls: 0,
            };
            let map = "references-gem".parse().unwrap();
            CacheKey {
                version: "0.1.0",
                map: &map,
                references: Digest::of(b"references"),
                search,
                k: 10,
                refinement,
                calibration,
                vocabulary: None,
                reader: None,
            }
            .text()
        };
        assert_eq!(
            key(SearchMode::Fast, None),
            format!(
                "0.1.0\nreferences-gem\n{}\nFast\n10\nNone\nCalibrationSettings {{ images: 200, \
                 refined: 20, candidates: 10, place_images: 5, place_m: 25.0 }}\nevidence: 4",
                Digest::of(b"references")
            )
        );
        let refined = key(SearchMode::Exact, Some((Scene::Indoor, r#"v3 {"a":"b\c"}"#)));
        assert!(
            refined.contains("\nExact\n10\nSome((Indoor, \"v3 {\\\"a\\\":\\\"b\\\\c\\\"}\"))\n"),
            "{refined}"
        );
    }
}
