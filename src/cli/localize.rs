//! `whereabouts localize`.

use std::path::PathBuf;

use anyhow::Context;
use serde_json::Value;

use super::client::{ServerArg, segment};
use whereabouts_api::Answer;
use whereabouts_core::{Job, MapName, MediaType, Pose, RefinerKind};

/// Localize an image on a server
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Image file: JPEG, PNG, WebP, TIFF, BMP, GIF or PNM
    file: PathBuf,
    /// Map to search
    #[arg(long)]
    map: MapName,
    /// Number of candidates to show
    #[arg(short, default_value_t = 5)]
    k: usize,
    /// Wait for the refinement and show its ranking
    #[arg(long)]
    refine: bool,
    /// Refiner to use, of those that the server allows; with --refine
    #[arg(long, requires = "refine")]
    refiner: Option<RefinerKind>,
    /// Print the server's answer as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let frame = std::fs::read(&args.file)
        .with_context(|| format!("cannot read {}", args.file.display()))?;
    // The server decides about bytes of an unknown format.
    let media_type = MediaType::sniff(&frame).map_or("application/octet-stream", MediaType::as_str);
    let mode = if args.refine { "wait" } else { "off" };
    let path = format!("/localize?map={}&k={}&refine={mode}", segment(args.map.as_str()), args.k);
    let refiner = args.refiner.map(|refiner| ("refiner", refiner.as_str()));
    let request = client
        .post(&path)
        .query(&Vec::from_iter(refiner))
        .header("content-type", media_type)
        .body(frame);
    let answer: Value = client.json(request).await?;
    if args.json {
        println!("{answer}");
        return Ok(());
    }
    let answer: Answer = serde_json::from_value(answer)?;
    print_answer(&answer);
    for warning in &answer.warnings {
        eprintln!("warning: {warning}");
    }
    if let Some(link) = &answer.job {
        print_job(&client.json(client.get(&link.href)).await?);
    } else if let Some(reason) = &answer.no_job {
        println!("not refined: {}", reason.detail);
    }
    Ok(())
}

fn print_answer(answer: &Answer) {
    println!("model {}, {:.1} ms", answer.model, answer.timing_ms.total);
    for candidate in &answer.candidates {
        println!(
            "{:3}  {:.4}  {}  {}",
            candidate.rank,
            candidate.similarity,
            candidate.image_id,
            format_pose(candidate.pose)
        );
    }
    match &answer.estimate {
        Some(estimate) => println!(
            "estimate: {} {}, confidence {} ({})",
            estimate.image_id,
            format_pose(estimate.pose),
            format_confidence(estimate.confidence),
            match (&estimate.reason, estimate.known, estimate.confidence) {
                (Some(reason), ..) => reason,
                (None, true, _) => "a known place",
                (None, false, Some(_)) => "possibly not in the map",
                (None, false, None) => "the map was changed lately; ask again in a while",
            }
        ),
        None => println!("the map has no images yet; add some with `whereabouts index`"),
    }
}

/// Prints a job for a human reader.
pub(super) fn print_job(job: &Job) {
    println!(
        "job {} (map {}, refiner {}), attempts: {}",
        job.id, job.map, job.refiner, job.attempts
    );
    let error = job.error.as_ref().map_or(String::new(), |error| format!(": {error}"));
    println!("  {}{error}", job.state);
    for candidate in job.ranking.iter().flat_map(|ranking| ranking.as_slice()) {
        println!(
            "{:3}  (was {:2})  {}  {}",
            candidate.rank,
            candidate.coarse_rank,
            candidate.image_id,
            format_pose(candidate.pose)
        );
    }
    for verdict in &job.verdicts {
        let certainty = verdict.certainty.map_or("", |certainty| certainty.as_str());
        println!(
            "  {}: {} of {} candidates, confidence {} {certainty}{}",
            verdict.refiner,
            verdict.image_id,
            verdict.compared,
            format_confidence(verdict.confidence),
            verdict.then.as_ref().map_or(String::new(), |then| format!("; {then}"))
        );
    }
    if let Some(reasoning) = &job.reasoning {
        println!("  {reasoning}");
    }
}

fn format_confidence(confidence: Option<f32>) -> String {
    confidence.map_or("not measured yet".into(), |confidence| format!("{confidence:.3}"))
}

/// Formats a pose in a few characters.
pub(super) fn format_pose(pose: Option<Pose>) -> String {
    match pose {
        None => "(no pose)".into(),
        Some(Pose::Geographic(pose)) => {
            let heading = pose.heading.map_or(String::new(), |h| format!(" facing {h:.0}°"));
            format!("{:.6}, {:.6}{heading}", pose.lat, pose.lon)
        }
        Some(Pose::Metric(pose)) => {
            let z = pose.z.map_or(String::new(), |z| format!(", {z:.2}"));
            format!("({:.2}, {:.2}{z}) m", pose.x, pose.y)
        }
    }
}
