//! The choice of a refiner, from the table of refiners.

use std::sync::LazyLock;

use clap::ValueEnum;
use clap::builder::PossibleValue;
use serde::{Deserialize, Serialize};

use whereabouts_core::RefinerKind;
use whereabouts_refine::{REFINERS, RefinerEntry, RefinerSettings};

use super::Config;

/// A refiner of the table [`REFINERS`], or none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct RefinerChoice(Option<&'static RefinerEntry>);

impl RefinerChoice {
    /// No refinement.
    pub const OFF: Self = Self(None);

    /// Returns the refiner's row in the table, if there is to be one.
    pub fn entry(self) -> Option<&'static RefinerEntry> {
        self.0
    }

    /// Returns the refiner of a new job, if there is to be one.
    pub fn kind(self) -> Option<RefinerKind> {
        self.0.map(|entry| entry.kind)
    }

    fn name(self) -> &'static str {
        self.0.map_or("off", RefinerEntry::name)
    }
}

/// All choices, in the order of the table.
static CHOICES: LazyLock<Vec<RefinerChoice>> = LazyLock::new(|| {
    let refiners = REFINERS.iter().map(|entry| RefinerChoice(Some(entry)));
    refiners.chain([RefinerChoice::OFF]).collect()
});

impl ValueEnum for RefinerChoice {
    fn value_variants<'a>() -> &'a [Self] {
        &CHOICES
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        let help = self.0.map_or("No refinement", |entry| entry.summary);
        Some(PossibleValue::new(self.name()).help(help))
    }
}

impl From<RefinerKind> for RefinerChoice {
    fn from(kind: RefinerKind) -> Self {
        Self(REFINERS.iter().find(|entry| entry.kind == kind))
    }
}

impl TryFrom<String> for RefinerChoice {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        CHOICES.iter().find(|choice| choice.name() == text).copied().ok_or_else(|| {
            let names: Vec<&str> = CHOICES.iter().map(|choice| choice.name()).collect();
            format!("unknown refiner {text:?}, expected one of {}", names.join(", "))
        })
    }
}

impl From<RefinerChoice> for String {
    fn from(choice: RefinerChoice) -> Self {
        choice.name().to_owned()
    }
}

impl Config {
    /// Returns the settings of all refiners.
    pub fn refiner_settings(&self) -> RefinerSettings {
        RefinerSettings {
            known_confidence: self.localize.known_confidence,
            places: self.confidence.calibration(self.refine.local_candidates),
            local_candidates: self.refine.local_candidates,
            mllm_candidates: self.refine.candidates,
            cascade: self.cascade,
            mllm: self.mllm.clone(),
            job_timeout_s: self.jobs.timeout.as_secs(),
        }
    }

    /// Returns the refiners that maps and requests may choose, the configured one first.
    pub fn allowed_refiners(&self) -> Vec<&'static RefinerEntry> {
        let mut entries: Vec<&'static RefinerEntry> = Vec::new();
        for choice in [self.refine.refiner].iter().chain(&self.refine.allowed) {
            entries.extend(choice.entry().filter(|entry| !entries.contains(entry)));
        }
        entries
    }

    /// Returns how many candidates the configured refiner compares.
    pub fn compared_candidates(&self) -> usize {
        let entry = self.refine.refiner.entry();
        entry.map_or(self.refine.local_candidates, |entry| {
            (entry.candidates)(&self.refiner_settings())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_refiner_of_the_table_can_be_chosen_by_its_name() {
        for entry in REFINERS {
            let choice = RefinerChoice::try_from(entry.name().to_owned()).unwrap();
            assert_eq!(choice.kind(), Some(entry.kind));
            assert_eq!(String::from(choice), entry.kind.as_str());
        }
        assert_eq!(RefinerChoice::try_from("off".to_owned()), Ok(RefinerChoice::OFF));
        let error = RefinerChoice::try_from("remote".to_owned()).unwrap_err();
        assert_eq!(error, "unknown refiner \"remote\", expected one of local, cascade, mllm, off");
    }

    #[test]
    fn the_help_lists_every_choice_with_its_summary() {
        let help: Vec<(String, String)> = RefinerChoice::value_variants()
            .iter()
            .filter_map(ValueEnum::to_possible_value)
            .map(|value| {
                let help = value.get_help().map(ToString::to_string).unwrap_or_default();
                (value.get_name().to_owned(), help)
            })
            .collect();
        let names: Vec<&str> = help.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["local", "cascade", "mllm", "off"]);
        assert!(help.iter().all(|(_, help)| !help.is_empty()), "{help:?}");
    }
}
