//! Which refiner refines a job: the server allows some, a map may be set to one of them, and a request may choose one that
//! costs no more.

use whereabouts_api::{ErrorKind, NoJob, NoJobReason};
use whereabouts_core::{Map, RefinerKind};

use super::ServiceError;

/// The refiners that maps and requests may choose.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct AllowedRefiners {
    /// The refiner of jobs for which nothing is chosen; `None` for no job.
    pub default: Option<RefinerKind>,
    /// All refiners, each with the number of candidates that it compares.
    pub allowed: Vec<(RefinerKind, usize)>,
}

impl AllowedRefiners {
    /// Returns how many candidates a refiner compares; 0 for one that is not allowed.
    pub fn candidates(&self, kind: RefinerKind) -> usize {
        let found = self.allowed.iter().find(|(allowed, _)| *allowed == kind);
        found.map_or(0, |(_, candidates)| *candidates)
    }

    /// Returns the most candidates that any refiner compares.
    pub fn most_candidates(&self) -> usize {
        self.allowed.iter().map(|(_, candidates)| *candidates).max().unwrap_or_default()
    }

    /// Returns how many candidates the costliest refiner compares.
    pub fn model_candidates(&self) -> Option<usize> {
        let costliest = self.allowed.iter().max_by_key(|(kind, _)| kind.cost());
        costliest.map(|(_, candidates)| *candidates)
    }

    /// Refuses a refiner that the server does not allow.
    pub fn check(&self, kind: RefinerKind) -> Result<(), ServiceError> {
        if self.is_allowed(kind) {
            return Ok(());
        }
        let names: Vec<&str> = self.allowed.iter().map(|(kind, _)| kind.as_str()).collect();
        let allowed = if names.is_empty() { "none".into() } else { names.join(", ") };
        Err(ServiceError::new(
            ErrorKind::Forbidden,
            format!(
                "the refiner {kind} is not allowed here; allowed: {allowed} (the operator sets refine.refiner and \
                 refine.allowed)"
            ),
        ))
    }

    /// Returns the refiner of a job: the one that was asked for, else that of the map, else that of the server.
    pub fn choose(&self, map: &Map, asked: Option<RefinerKind>) -> Result<Chosen, ServiceError> {
        let Some(asked) = asked else { return Ok(self.of(map)) };
        self.check(asked)?;
        match map.refiner {
            Some(set) if asked.cost() > set.cost() => Err(ServiceError::new(
                ErrorKind::Forbidden,
                format!(
                    "the refiner {asked} may cost more than {set}, which the map {} is set to; leave refiner out, or \
                     have an operator change the map (PUT /maps/{} with \"refiner\")",
                    map.name, map.name
                ),
            )),
            _ => Ok(Chosen::Refiner(asked)),
        }
    }

    /// Returns the refiner of a map. If the server no longer allows what the map is set to, the costliest of those that
    /// cost less.
    fn of(&self, map: &Map) -> Chosen {
        let Some(set) = map.refiner else {
            return match self.default {
                Some(kind) => Chosen::Refiner(kind),
                None => Chosen::none("the server has no refiner (refine.refiner)"),
            };
        };
        let kinds = self.allowed.iter().map(|(kind, _)| *kind);
        let fitting = kinds.filter(|kind| kind.cost() <= set.cost());
        match fitting.max_by_key(|kind| kind.cost()) {
            Some(kind) => Chosen::Refiner(kind),
            None => Chosen::none(
                "the server allows no refiner that costs as little as that of the map (refine.allowed)",
            ),
        }
    }

    fn is_allowed(&self, kind: RefinerKind) -> bool {
        self.allowed.iter().any(|(allowed, _)| *allowed == kind)
    }
}

/// The refiner of a job, or why there is none.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Chosen {
    /// The refiner.
    Refiner(RefinerKind),
    /// There is none.
    None(NoJob),
}

impl Chosen {
    fn none(detail: &str) -> Self {
        Self::None(NoJob::new(NoJobReason::NoRefiner, detail))
    }
}

#[cfg(test)]
mod tests {
    use RefinerKind::{Cascade, Local, Mllm};

    use super::*;

    fn map(refiner: Option<RefinerKind>) -> Map {
        Map { refiner, ..crate::tests::map("yard") }
    }

    fn allowing(default: Option<RefinerKind>, all: &[RefinerKind]) -> AllowedRefiners {
        AllowedRefiners { default, allowed: all.iter().map(|kind| (*kind, 10)).collect() }
    }

    fn chosen(choice: Result<Chosen, ServiceError>) -> Option<RefinerKind> {
        match choice.unwrap() {
            Chosen::Refiner(kind) => Some(kind),
            Chosen::None(_) => None,
        }
    }

    #[test]
    fn a_request_chooses_among_what_the_server_allows() {
        let allowed = allowing(Some(Local), &[Local, Mllm]);
        assert_eq!(chosen(allowed.choose(&map(None), None)), Some(Local));
        assert_eq!(chosen(allowed.choose(&map(None), Some(Mllm))), Some(Mllm));
        let refused = allowed.choose(&map(None), Some(Cascade)).unwrap_err();
        assert_eq!(refused.kind, ErrorKind::Forbidden);
        assert!(refused.detail.contains("allowed: local, mllm"), "{refused}");
    }

    #[test]
    fn nobody_spends_money_where_only_local_is_allowed() {
        let local = allowing(Some(Local), &[Local]);
        for paid in [Cascade, Mllm] {
            assert!(local.choose(&map(None), Some(paid)).is_err());
            // Nor by a setting that a map has from before.
            assert_eq!(chosen(local.choose(&map(Some(paid)), None)), Some(Local));
        }
        let all = allowing(Some(Mllm), &[Local, Cascade, Mllm]);
        let refused = all.choose(&map(Some(Local)), Some(Mllm)).unwrap_err();
        assert!(refused.detail.contains("which the map yard is set to"), "{refused}");
        assert!(all.choose(&map(Some(Local)), Some(Cascade)).is_err());
        assert_eq!(chosen(all.choose(&map(Some(Cascade)), Some(Local))), Some(Local));
    }

    #[test]
    fn a_map_has_its_own_refiner() {
        let all = allowing(Some(Local), &[Local, Cascade, Mllm]);
        for kind in [Local, Cascade, Mllm] {
            assert_eq!(chosen(all.choose(&map(Some(kind)), None)), Some(kind));
        }
        let off = allowing(None, &[Mllm]);
        assert_eq!(chosen(off.choose(&map(None), None)), None);
        assert_eq!(chosen(off.choose(&map(None), Some(Mllm))), Some(Mllm));
        assert_eq!(chosen(off.choose(&map(Some(Local)), None)), None, "mllm costs more");
    }
}
