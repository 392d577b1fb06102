//! The predictions for each query, as CSV.

use std::path::Path;

use anyhow::Context;

use super::summary::query_outcomes;
use super::{Dataset, MethodOutcomes, QueryKind};

/// Writes one line per prediction: `query,method,rank,reference,similarity,coarse_rank,true,confidence`.
/// The column `true` is `yes` or `no`, or `skipped` or `unknown` if the query has no correct reference.
/// Only the first prediction of a query has a confidence; it is empty if it could not be measured.
///
/// # Errors
/// The file cannot be written.
pub fn write(file: &Path, data: &Dataset, methods: &[MethodOutcomes]) -> anyhow::Result<()> {
    let mut writer =
        csv::Writer::from_path(file).with_context(|| format!("cannot write {}", file.display()))?;
    let header =
        ["query", "method", "rank", "reference", "similarity", "coarse_rank", "true", "confidence"];
    writer.write_record(header)?;
    for method in methods {
        let name = method.method.name();
        for (query, outcome) in query_outcomes(data, method) {
            for (index, prediction) in outcome.predictions.iter().enumerate() {
                let verdict = match query.kind {
                    QueryKind::InMap if query.truth.contains(&prediction.image_id) => "yes",
                    QueryKind::InMap => "no",
                    QueryKind::Skipped => "skipped",
                    QueryKind::Unknown => "unknown",
                };
                let confidence = match index {
                    0 => outcome.confidence.map_or(String::new(), |of| format!("{of:.4}")),
                    _ => String::new(),
                };
                writer.write_record([
                    query.picture.id.as_str(),
                    &name,
                    &(index + 1).to_string(),
                    prediction.image_id.as_str(),
                    &format!("{:.6}", prediction.similarity),
                    &prediction.coarse_rank.to_string(),
                    verdict,
                    &confidence,
                ])?;
            }
        }
    }
    writer.flush().with_context(|| format!("cannot write {}", file.display()))
}
