//! What a verdict of the model is worth as evidence.

use async_trait::async_trait;
use parking_lot::Mutex;
use serde_json::json;
use whereabouts_core::{
    Agreement, Candidate, Certainty, Evidence, ImageId, PairRegion, RefinerKind, SamePlace,
};
use whereabouts_store::HardNegatives;

use super::*;
use crate::RegionMatcher;

/// Stands in for the local refiner: so many regions of each candidate match the frame.
pub struct Regions(pub Vec<usize>);

#[async_trait]
impl Refiner for Regions {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Local
    }

    async fn refine(&self, _: &RefineInput, _: &dyn Progress) -> Result<Refinement, RefineError> {
        Err(RefineError::Permanent("this refiner refines nothing".into()))
    }

    fn region_matcher(&self) -> Option<&dyn RegionMatcher> {
        Some(self)
    }
}

#[async_trait]
impl RegionMatcher for Regions {
    async fn regions(
        &self,
        _: &RefineInput,
        _: &ImageId,
    ) -> Result<Option<Vec<PairRegion>>, RefineError> {
        Ok(None)
    }

    async fn agreement(&self, input: &RefineInput) -> Result<Agreement, RefineError> {
        match self.0.get(..input.candidates.len()) {
            Some(matches) => Ok(Agreement {
                regions: 500,
                matches: matches.to_vec(),
                first: Some(1),
                same_place: SamePlace::default(),
            }),
            None => Err(RefineError::Transient("no features".into())),
        }
    }
}

/// Puts the candidate with these notes first, with this certainty.
fn judging(first: &'static str, certainty: &'static str) -> Script {
    Script {
        reason: Box::new(move |call| {
            let labels = call.labels_with_first(first);
            let answer = json!({"reasoning": "because", "ranking": labels, "certainty": certainty});
            Reply::Text(answer.to_string())
        }),
        ..numbered()
    }
}

async fn bench(first: &'static str, certainty: &'static str) -> Bench {
    let mut bench =
        Bench::with(judging(first, certainty), |settings| settings.concurrency = 1).await;
    bench.fallback = Some(Arc::new(Regions(vec![20, 200, 30, 10, 5])));
    bench.rebuild(|_| {});
    bench
}

#[tokio::test]
async fn a_verdict_is_worth_what_the_regions_bear_out() {
    let agreement = Agreement {
        regions: 500,
        matches: vec![20, 200, 30, 10, 5],
        first: Some(1),
        same_place: SamePlace::default(),
    };
    for (first, of) in [("number 2.", 1), ("number 4.", 3)] {
        for (certainty, says) in [("certain", Certainty::Certain), ("unsure", Certainty::Unsure)] {
            let refinement = bench(first, certainty).await.refine(5).await.unwrap();
            assert_eq!(refinement.certainty, Some(says));
            assert_eq!(refinement.evidence, agreement.verdict(of, Some(says)));
            assert_eq!(refinement.why_unknown(), None);
        }
    }
}

#[tokio::test]
async fn none_of_these_makes_the_place_unknown_whatever_the_regions_say() {
    let refinement = bench("number 2.", "none").await.refine(5).await.unwrap();
    assert_eq!(refinement.evidence, Some(Evidence::NONE_OF_THESE));
    assert!(refinement.why_unknown().unwrap().contains("none of the candidates"));
    // Without regions, too.
    let alone = Bench::new(judging("number 2.", "none")).await;
    assert_eq!(alone.refine(5).await.unwrap().evidence, Some(Evidence::NONE_OF_THESE));
}

#[tokio::test]
async fn without_regions_a_verdict_is_no_evidence() {
    let alone = Bench::new(judging("number 2.", "certain")).await;
    let refinement = alone.refine(5).await.unwrap();
    assert_eq!((refinement.evidence, refinement.degraded), (None, None));
    // The comparison fails, the verdict stands.
    let refinement = bench("number 2.", "certain").await.refine(6).await.unwrap();
    assert_eq!((refinement.evidence, refinement.degraded), (None, None));
}

#[tokio::test]
async fn a_first_candidate_that_was_not_described_has_no_certainty() {
    let pairs = Mutex::new(Vec::new());
    let script = Script {
        describe: Box::new(move |call| {
            let mut pairs = pairs.lock();
            let known = pairs.iter().position(|pair| *pair == call.pair);
            let number = known.unwrap_or(pairs.len()) + 1;
            if known.is_none() {
                pairs.push(call.pair.clone());
            }
            match number {
                1 => Reply::Said("I'm sorry, I can't help with that.".into()),
                number => Reply::Text(format!("notes number {number}.")),
            }
        }),
        ..judging("number 3.", "certain")
    };
    let mut bench = Bench::with(script, |settings| settings.concurrency = 1).await;
    bench.fallback = Some(Arc::new(Regions(vec![20, 200, 30])));
    bench.rebuild(|_| {});
    let refinement = bench.refine(3).await.unwrap();
    assert_eq!(refinement.ranking.first().unwrap().coarse_rank, 1);
    assert_eq!(refinement.certainty, None);
}

fn negatives(count: usize) -> HardNegatives {
    let candidate = |index: usize| Candidate {
        rank: index + 1,
        image_id: format!("image-{index}").parse().unwrap(),
        similarity: 0.9,
        pose: None,
        order: None,
    };
    HardNegatives {
        image_id: "image-20".parse().unwrap(),
        others: (0..count).map(candidate).collect(),
    }
}

#[tokio::test]
async fn the_model_is_asked_about_images_of_other_places_at_the_cost_it_says() {
    let bench = bench("number 4.", "likely").await;
    let verdict = bench.refiner.verdict(&bench.shelf.map, &negatives(5)).await.unwrap();
    let agreement = Agreement {
        regions: 500,
        matches: vec![20, 200, 30, 10, 5],
        first: Some(1),
        same_place: SamePlace::default(),
    };
    assert_eq!(verdict, agreement.strongest_verdict(Some(Certainty::Likely)));
    let cost = bench.refiner.cost(5);
    let calls = bench.mock.describe_calls() + bench.mock.reason_calls();
    assert_eq!((cost.calls, calls), (6, 6));
    assert!(cost.tokens > 5000 && cost.money == 0.0);
    let spent = bench.cache.spent.lock().iter().map(|spent| spent.usage.calls).sum::<u32>();
    assert_eq!(spent, 6, "it is in the accounts");
}

#[tokio::test]
async fn an_answer_of_another_refiner_is_no_verdict_of_the_model() {
    let script = Script {
        describe: Box::new(|_| Reply::Status(401, "no such key".into())),
        ..Script::default()
    };
    let mut bench = Bench::new(script).await;
    bench.fallback = Some(Arc::new(super::limits::Reverse));
    bench.rebuild(|settings| settings.attempts = 1);
    let verdict = bench.refiner.verdict(&bench.shelf.map, &negatives(5)).await.unwrap();
    assert_eq!(verdict, None);
}
