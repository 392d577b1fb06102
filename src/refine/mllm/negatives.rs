//! The model's verdicts on images of other places, from which its certainty is calibrated.

use async_trait::async_trait;
use whereabouts_core::{Evidence, Map};
use whereabouts_store::HardNegatives;

use super::MllmRefiner;
use crate::{PaidMeasurement, PaidNegatives, RefineError, RefineInput, Refiner, Unwatched};

/// Estimated tokens of a describe call, for a picture of 640×480: the prompt, two pictures, and the answer.
const DESCRIBE_TOKENS: (u64, u64) = (1400, 400);

/// Estimated tokens of a reason call: those of the prompt without descriptions, and of the answer.
const REASON_TOKENS: (u64, u64) = (700, 400);

#[async_trait]
impl PaidNegatives for MllmRefiner {
    fn cost(&self, candidates: usize) -> PaidMeasurement {
        let pairs = candidates as u64;
        let (prompt, answer) = DESCRIBE_TOKENS;
        let sent = pairs * (prompt + answer) + REASON_TOKENS.0;
        let received = pairs * answer + REASON_TOKENS.1;
        let per_million = |tokens: u64, price: f64| tokens as f64 / 1e6 * price;
        PaidMeasurement {
            calls: candidates + 1,
            tokens: sent + received,
            money: per_million(sent, self.settings.price_prompt)
                + per_million(received, self.settings.price_completion),
        }
    }

    async fn verdict(
        &self,
        map: &Map,
        negatives: &HardNegatives,
    ) -> Result<Option<Evidence>, RefineError> {
        let input = RefineInput::of_negatives(map, negatives, self.maps.as_ref()).await?;
        let Some(input) = input else { return Ok(None) };
        let refinement = self.refine(&input, &Unwatched).await?;
        // The order of another refiner, or of a part of the pairs, is no verdict of the model.
        let is_verdict = refinement.ordered_by.is_none() && refinement.degraded.is_none();
        let agreement = refinement.agreement.filter(|_| is_verdict);
        // Whichever image it is certain of: the worst that its certainty can do is to be that of the best match.
        Ok(agreement.and_then(|agreement| agreement.strongest_verdict(refinement.certainty)))
    }
}
