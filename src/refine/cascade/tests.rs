//! Tests of the cascade against a mock of the model, and with a scripted `local`.

use async_trait::async_trait;
use serde_json::json;
use whereabouts_core::confidence::NullDistribution;
use whereabouts_core::{Candidate, Certainty, MetricPose, Pose};
use whereabouts_testkit::mock_mllm::{Reply, Script};

use super::*;
use crate::mllm::MllmSettings;
use crate::mllm::tests::shelf::{Bench, Steps};

const SETTINGS: CascadeSettings =
    CascadeSettings { stop_confidence: 0.9, close: 0.7, candidates: 3 };

/// Stands in for `local`: finds so many matching regions, and ranks by them.
struct Scripted(Vec<usize>);

#[async_trait]
impl Refiner for Scripted {
    fn kind(&self) -> RefinerKind {
        RefinerKind::Local
    }

    async fn refine(
        &self,
        input: &RefineInput,
        _: &dyn Progress,
    ) -> Result<Refinement, RefineError> {
        let mut order: Vec<usize> = (0..input.candidates.len()).collect();
        order.sort_by_key(|&index| std::cmp::Reverse(self.0[index]));
        let agreement = Agreement {
            regions: 500,
            matches: self.0.clone(),
            first: order.first().copied(),
            same_place: SamePlace::of(
                &input.candidates.iter().map(|one| (None, one.pose)).collect::<Vec<_>>(),
                input.candidates.len(),
                &calibrated().settings,
            ),
        };
        let description = |candidate: &Candidate| Description {
            image_id: candidate.image_id.clone(),
            text: "of local".into(),
            cached: false,
            stands_in: None,
            took_ms: Some(1),
            usage: Usage::default(),
        };
        Ok(Refinement {
            descriptions: input.candidates.iter().map(description).collect(),
            ranking: Ranking::new(&input.candidates, &order).unwrap(),
            evidence: agreement.evidence(order[0]),
            certainty: None,
            agreement: Some(agreement),
            verdicts: Vec::new(),
            reasoning: Some("by its regions".into()),
            reasoning_took_ms: None,
            ordered_by: None,
            usage: Usage::default(),
            degraded: None,
        })
    }
}

/// The values of a map whose wrong answers have little evidence.
fn calibrated() -> Calibration {
    calibrated_to(1.0)
}

/// The values of a map whose wrong answers have at most this evidence.
fn calibrated_to(highest: f32) -> Calibration {
    let null = |highest: f32| {
        NullDistribution::from((0..40).map(|n| highest * n as f32 / 40.0).collect::<Vec<f32>>())
    };
    let mut calibration =
        Calibration { agreement: null(highest), verdict: null(1.0), ..Calibration::default() };
    calibration.settings.place_m = 25.0;
    calibration
}

struct Cascade {
    bench: Bench,
    refiner: CascadeRefiner,
    input: RefineInput,
}

/// A cascade over a `local` that finds these regions, in a map with this calibration.
async fn cascade(
    script: Script,
    regions: &[usize],
    calibration: Option<Calibration>,
    change: impl FnOnce(&mut MllmSettings),
) -> Cascade {
    let bench = Bench::with(script, |settings| {
        settings.concurrency = 1;
        change(settings);
    })
    .await;
    *bench.shelf.calibration.lock() = calibration.map(Arc::new);
    let mut input = bench.input(regions.len());
    for (index, candidate) in input.candidates.iter_mut().enumerate() {
        let x = 100.0 * index as f64;
        let (z, qx, qy, qz, qw) = (None, None, None, None, None);
        candidate.pose = Some(Pose::Metric(MetricPose { x, y: 0.0, z, qx, qy, qz, qw }));
    }
    let model = Arc::new(bench.model());
    let local = Arc::new(Scripted(regions.to_vec()));
    let refiner = CascadeRefiner::new(Arc::new(bench.shelf.clone()), local, model, SETTINGS);
    Cascade { bench, refiner, input }
}

impl Cascade {
    async fn refine(&self) -> Result<Refinement, RefineError> {
        self.refiner.refine(&self.input, &Steps::default()).await
    }

    fn calls(&self) -> (usize, usize) {
        (self.bench.mock.describe_calls(), self.bench.mock.reason_calls())
    }
}

/// Describes by number, and puts the pair of that number first.
fn preferring(first: &'static str, certainty: &'static str) -> Script {
    Script {
        describe: Box::new(|call| Reply::Text(format!("notes number {}.", call.number))),
        reason: Box::new(move |call| {
            let labels = call.labels_with_first(first);
            let answer = json!({"reasoning": "because", "ranking": labels, "certainty": certainty});
            Reply::Text(answer.to_string())
        }),
        ..Script::default()
    }
}

fn ranks(refinement: &Refinement) -> Vec<usize> {
    refinement.ranking.as_slice().iter().map(|candidate| candidate.coarse_rank).collect()
}

#[tokio::test]
async fn a_confident_answer_of_local_stands_without_any_call() {
    let cascade = cascade(
        preferring("number 1.", "certain"),
        &[20, 300, 30, 25, 10],
        Some(calibrated()),
        |_| {},
    )
    .await;
    let refinement = cascade.refine().await.unwrap();
    assert_eq!(cascade.calls(), (0, 0));
    assert_eq!(ranks(&refinement), [2, 3, 4, 1, 5]);
    assert!(matches!(refinement.evidence, Some(Evidence::Agreement(_))));
    let [verdict] = refinement.verdicts.as_slice() else { panic!("{:?}", refinement.verdicts) };
    assert!(verdict.confidence > Some(0.9) && verdict.refiner == RefinerKind::Local);
    assert!(verdict.then.as_ref().unwrap().starts_with("its answer stands"), "{verdict:?}");
}

#[tokio::test]
async fn an_answer_below_the_bound_goes_on_with_the_candidates_in_question_only() {
    let cascade = cascade(
        preferring("number 1.", "certain"),
        &[28, 30, 27, 26, 10],
        Some(calibrated()),
        |_| {},
    )
    .await;
    let refinement = cascade.refine().await.unwrap();
    assert_eq!(cascade.calls(), (3, 1));
    // The first of the search, which the model prefers; then the others of the model, then those of `local`.
    assert_eq!(ranks(&refinement)[0], 1);
    assert_eq!(ranks(&refinement)[3..], [4, 5]);
    let texts: Vec<bool> =
        refinement.descriptions.iter().map(|one| one.text == "of local").collect();
    assert_eq!(texts, [false, false, false, true, true]);
    let [first, second] = refinement.verdicts.as_slice() else { panic!("{refinement:?}") };
    assert!(first.then.as_ref().unwrap().contains("is below 0.9"), "{first:?}");
    assert_eq!((first.image_id.as_str(), second.image_id.as_str()), ("image-1", "image-0"));
    assert_eq!((second.compared, second.certainty), (3, Some(Certainty::Certain)));
    assert_eq!((refinement.usage.calls, refinement.degraded), (4, None));
    // Measured among all candidates, as the calibration is.
    let agreement = Agreement {
        regions: 500,
        matches: vec![28, 30, 27, 26, 10],
        first: Some(1),
        same_place: SamePlace::default(),
    };
    assert_eq!(refinement.evidence, agreement.verdict(0, Some(Certainty::Certain)));
}

#[tokio::test]
async fn a_close_second_of_another_place_goes_on_whatever_the_confidence() {
    let regions = [300, 290, 20, 20, 10];
    // It is known, and yet another is close.
    let calibrated = calibrated_to(0.3);
    let cascade =
        cascade(preferring("number 2.", "certain"), &regions, Some(calibrated), |_| {}).await;
    let refinement = cascade.refine().await.unwrap();
    assert_eq!(cascade.calls(), (3, 1));
    assert_eq!(ranks(&refinement)[0], 2);
    assert!(refinement.verdicts[0].then.as_ref().unwrap().contains("image-1 agrees"));
}

#[tokio::test]
async fn neighbours_of_the_same_place_are_not_in_each_others_way() {
    let regions = [300, 290, 20, 20, 10];
    let calibrated = calibrated_to(0.3);
    let mut cascade =
        cascade(preferring("number 2.", "certain"), &regions, Some(calibrated), |_| {}).await;
    // 10 m apart, or anywhere.
    let near = cascade.input.candidates[0].pose;
    for pose in [near, None] {
        cascade.input.candidates[1].pose = pose;
        cascade.refine().await.unwrap();
        assert_eq!(cascade.calls(), (0, 0));
    }
}

#[tokio::test]
async fn in_a_map_without_calibration_only_a_close_second_goes_on() {
    let small = Calibration { agreement: NullDistribution::from(vec![0.0; 5]), ..calibrated() };
    for calibration in [None, Some(small)] {
        let clear = [300, 20, 30, 25, 10];
        let cascade =
            cascade(preferring("number 1.", "certain"), &clear, calibration, |_| {}).await;
        let refinement = cascade.refine().await.unwrap();
        assert_eq!(cascade.calls(), (0, 0));
        let then = refinement.verdicts[0].then.clone().unwrap();
        assert!(then.contains("not calibrated, or too small"), "{then}");
    }
    let small = Calibration { agreement: NullDistribution::from(vec![0.0; 5]), ..calibrated() };
    let close = [300, 290, 30, 25, 10];
    let cascade = cascade(preferring("number 1.", "certain"), &close, Some(small), |_| {}).await;
    cascade.refine().await.unwrap();
    assert_eq!(cascade.calls(), (3, 1));
}

#[tokio::test]
async fn none_of_these_is_the_last_word() {
    let cascade =
        cascade(preferring("number 1.", "none"), &[30, 28, 27, 26, 10], Some(calibrated()), |_| {})
            .await;
    let refinement = cascade.refine().await.unwrap();
    assert_eq!(refinement.evidence, Some(Evidence::NONE_OF_THESE));
    assert_eq!(refinement.verdicts[1].confidence, Some(0.0));
}

#[tokio::test]
async fn the_answer_of_local_stands_where_the_model_gives_none() {
    let refused = Script {
        describe: Box::new(|_| Reply::Status(401, "no such key".into())),
        ..Script::default()
    };
    let silent = Script {
        reason: Box::new(|_| Reply::Said("I cannot rank these.".into())),
        ..preferring("number 1.", "certain")
    };
    for script in [refused, silent] {
        let cascade = cascade(script, &[26, 30, 27, 28, 10], Some(calibrated()), |settings| {
            settings.attempts = 1;
        })
        .await;
        let refinement = cascade.refine().await.unwrap();
        assert_eq!(ranks(&refinement), [2, 4, 3, 1, 5]);
        assert!(matches!(refinement.evidence, Some(Evidence::Agreement(_))));
        assert!(refinement.degraded.is_some());
        assert_eq!(refinement.verdicts.len(), 1);
        assert_eq!(refinement.reasoning.as_deref(), Some("by its regions"));
    }
}

#[tokio::test]
async fn descriptions_are_shared_with_mllm() {
    let cascade = cascade(
        preferring("number 1.", "certain"),
        &[30, 28, 27, 26, 10],
        Some(calibrated()),
        |_| {},
    )
    .await;
    cascade.bench.refiner.refine(&cascade.input, &Steps::default()).await.unwrap();
    assert_eq!(cascade.calls(), (5, 1));
    let refinement = cascade.refine().await.unwrap();
    assert_eq!(cascade.calls(), (5, 2));
    assert_eq!((refinement.usage.calls, refinement.usage.cached), (1, 3));
}

#[tokio::test]
async fn a_measurement_asks_about_as_many_candidates_as_a_job_would() {
    let regions = [300, 20, 30, 25, 10];
    let cascade =
        cascade(preferring("number 1.", "certain"), &regions, Some(calibrated()), |_| {}).await;
    let negatives = HardNegatives {
        image_id: "image-20".parse().unwrap(),
        others: cascade.input.candidates.clone(),
    };
    // Also where the answer of `local` would stand: what the model says of wrong images is the question.
    let map = &cascade.bench.shelf.map;
    let verdict = cascade.refiner.verdict(map, &negatives).await.unwrap();
    assert!(matches!(verdict, Some(Evidence::Verdict(_))), "{verdict:?}");
    assert_eq!(cascade.calls(), (3, 1));
    assert_eq!(cascade.refiner.cost(10).calls, 4);
}

#[test]
fn the_settings_are_shares_and_at_least_two_candidates() {
    assert_eq!(SETTINGS.validate(), None);
    for wrong in [
        CascadeSettings { stop_confidence: 1.5, ..SETTINGS },
        CascadeSettings { close: -0.1, ..SETTINGS },
        CascadeSettings { stop_confidence: f64::NAN, ..SETTINGS },
        CascadeSettings { candidates: 1, ..SETTINGS },
    ] {
        assert!(wrong.validate().unwrap().contains("cascade."), "{wrong:?}");
    }
}
