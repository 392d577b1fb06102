//! `whereabouts localize`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use serde_json::Value;

use super::client::{Client, ServerArg, segment};
use whereabouts_api::{Answer, WordsAnswer, WordsRequest};
use whereabouts_core::{Job, MapName, MediaType, Pose, RefinerKind};

/// Localize an image, or a description in words, on a server
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Image file: JPEG, PNG, WebP, TIFF, BMP, GIF or PNM
    #[arg(required_unless_present = "text")]
    file: Option<PathBuf>,
    /// Instead of an image: what is there, above all what signs say, such as "opposite the pharmacy, KAWA COFFEE is on
    /// its left". Needs a map whose images were read (`make reader`)
    #[arg(long, conflicts_with_all = ["file", "refine"])]
    text: Option<String>,
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
    match (&args.text, &args.file) {
        (Some(text), _) => by_words(&client, &args, text).await,
        (None, Some(file)) => by_frame(&client, &args, file).await,
        // The parser asks for one of them.
        (None, None) => Ok(()),
    }
}

async fn by_words(client: &Client, args: &Args, text: &str) -> anyhow::Result<()> {
    let path = format!("/localize?map={}&k={}", segment(args.map.as_str()), args.k);
    let request = client.post(&path).json(&WordsRequest { text: text.to_owned() });
    let answer: Value = client.json(request).await?;
    if args.json {
        println!("{answer}");
        return Ok(());
    }
    print_words(&serde_json::from_value(answer)?);
    Ok(())
}

async fn by_frame(client: &Client, args: &Args, file: &Path) -> anyhow::Result<()> {
    let frame = std::fs::read(file).with_context(|| format!("cannot read {}", file.display()))?;
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

fn print_words(answer: &WordsAnswer) {
    let signs = answer.signs.iter().map(|sign| match sign.images {
        0 => format!("{:?} (nowhere)", sign.text),
        1 => format!("{:?} (1 image)", sign.text),
        more => format!("{:?} ({more} images)", sign.text),
    });
    let signs: Vec<String> = signs.collect();
    if !signs.is_empty() {
        println!("signs: {}", signs.join(", "));
    }
    for candidate in &answer.candidates {
        let lines = candidate.signs.iter().flat_map(|sign| &sign.lines);
        let lines: Vec<&str> = lines.map(|line| line.text.as_str()).collect();
        println!(
            "{:3}  {:.3}  {}  {}  {}",
            candidate.rank,
            candidate.probability,
            candidate.image_id,
            format_pose(candidate.pose),
            lines.join(" / ")
        );
    }
    match &answer.estimate {
        Some(estimate) => println!(
            "estimate: {} {}, probability {:.3} ({})",
            estimate.image_id,
            format_pose(estimate.pose),
            estimate.probability,
            answer.reason.as_deref().unwrap_or("a known place")
        ),
        None => println!("not found: {}", answer.reason.as_deref().unwrap_or("no image fits")),
    }
    for warning in &answer.warnings {
        eprintln!("warning: {warning}");
    }
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
