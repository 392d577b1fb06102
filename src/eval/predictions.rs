//! What was answered to each query, as CSV.

use std::path::Path;

use anyhow::Context;

use super::summary::visits;
use super::{Dataset, MethodOutcomes, QueryKind};

/// Writes one line for each answer: `query,method,rank,reference,similarity,coarse_rank,true,confidence`,
/// where `true` is `yes` or `no`, and `skipped` or `unknown` for a query that has no true reference.
/// Only a first answer has a confidence.
pub fn write(file: &Path, data: &Dataset, found: &[MethodOutcomes]) -> anyhow::Result<()> {
    let mut writer =
        csv::Writer::from_path(file).with_context(|| format!("cannot write {}", file.display()))?;
    let header =
        ["query", "method", "rank", "reference", "similarity", "coarse_rank", "true", "confidence"];
    writer.write_record(header)?;
    for method in found {
        let name = method.method.name();
        for (query, outcome) in visits(data, method) {
            for (place, answer) in outcome.answers.iter().enumerate() {
                let verdict = match query.kind {
                    QueryKind::InMap if query.truth.contains(&answer.image_id) => "yes",
                    QueryKind::InMap => "no",
                    QueryKind::Skipped => "skipped",
                    QueryKind::Unknown => "unknown",
                };
                let confidence = match place {
                    0 => format!("{:.4}", outcome.confidence),
                    _ => String::new(),
                };
                writer.write_record([
                    query.picture.id.as_str(),
                    &name,
                    &(place + 1).to_string(),
                    answer.image_id.as_str(),
                    &format!("{:.6}", answer.similarity),
                    &answer.coarse_rank.to_string(),
                    verdict,
                    &confidence,
                ])?;
            }
        }
    }
    writer.flush().with_context(|| format!("cannot write {}", file.display()))
}
