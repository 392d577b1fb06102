//! The refiners among which maps and requests choose.

use std::sync::Arc;

use async_trait::async_trait;
use whereabouts_core::RefinerKind;

use super::{
    NegativeEvidence, PaidCalls, PaidNegatives, Progress, RefineError, RefineInput, Refinement,
    Refiner, RegionMatcher,
};

/// Has each job refined by the refiner that it names.
///
/// Its other abilities are those of the first refiner that has them.
pub struct RefinerSet {
    first: Arc<dyn Refiner>,
    others: Vec<Arc<dyn Refiner>>,
}

impl RefinerSet {
    /// Creates a set. The first refines jobs that name none. Those whose refiner is no longer there are refined by the
    /// costliest that costs less, or else by the first, and are marked as degraded.
    pub fn new(first: Arc<dyn Refiner>, others: Vec<Arc<dyn Refiner>>) -> Self {
        Self { first, others }
    }

    fn all(&self) -> impl Iterator<Item = &dyn Refiner> {
        std::iter::once(&self.first).chain(&self.others).map(AsRef::as_ref)
    }
}

#[async_trait]
impl Refiner for RefinerSet {
    fn kind(&self) -> RefinerKind {
        self.first.kind()
    }

    async fn refine(
        &self,
        input: &RefineInput,
        progress: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let Some(wanted) = input.refiner else { return self.first.refine(input, progress).await };
        if let Some(named) = self.all().find(|refiner| refiner.kind() == wanted) {
            return named.refine(input, progress).await;
        }
        let cheaper = self.all().filter(|refiner| refiner.kind().cost() < wanted.cost());
        let stand_in = cheaper.max_by_key(|refiner| refiner.kind().cost());
        let stand_in = stand_in.unwrap_or(self.first.as_ref());
        let refinement = stand_in.refine(input, progress).await?;
        let why = format!(
            "refined by `{}` instead of `{wanted}`, which this server no longer has (refine.allowed)",
            stand_in.kind()
        );
        Ok(refinement.stands_in(stand_in.kind(), why))
    }

    fn wants_descriptor(&self) -> bool {
        self.all().any(Refiner::wants_descriptor)
    }

    fn region_matcher(&self) -> Option<&dyn RegionMatcher> {
        self.all().find_map(Refiner::region_matcher)
    }

    fn negative_evidence(&self) -> Option<&dyn NegativeEvidence> {
        self.all().find_map(Refiner::negative_evidence)
    }

    fn paid_negatives(&self) -> Option<&dyn PaidNegatives> {
        // The costliest asks about the most candidates.
        let costliest = self.all().max_by_key(|refiner| refiner.kind().cost());
        costliest.and_then(Refiner::paid_negatives)
    }

    fn paid_calls(&self) -> Option<&dyn PaidCalls> {
        self.all().find_map(Refiner::paid_calls)
    }

    /// Which refiner the next job names is not known, so one with room suffices. `jobs.in_progress` bounds what waits.
    async fn room(&self) {
        futures_util::future::select_all(self.all().map(Refiner::room)).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mllm::tests::limits::Reverse;
    use crate::mllm::tests::shelf::{Bench, Steps};
    use whereabouts_testkit::mock_mllm::Script;

    #[tokio::test]
    async fn a_job_is_refined_by_the_refiner_that_it_names_or_else_by_the_first() {
        let bench = Bench::new(Script::default()).await;
        let model: Arc<dyn Refiner> = Arc::new(bench.model());
        let choice = RefinerSet::new(Arc::new(Reverse), vec![model]);
        assert_eq!(choice.kind(), RefinerKind::Local);
        assert!(choice.paid_calls().is_some() && choice.region_matcher().is_none());
        let gone = Some(RefinerKind::Cascade);
        for (named, calls) in
            [(None, 0), (Some(RefinerKind::Local), 0), (gone, 0), (Some(RefinerKind::Mllm), 4)]
        {
            let input = RefineInput { refiner: named, ..bench.input(3) };
            let refinement = choice.refine(&input, &Steps::default()).await.unwrap();
            assert_eq!(refinement.degraded.is_some(), named == gone, "{:?}", refinement.degraded);
            let made = bench.mock.describe_calls() + bench.mock.reason_calls();
            assert_eq!(made, calls, "{named:?}");
        }
    }
}
