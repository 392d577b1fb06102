//! `whereabouts localize`.

use std::path::PathBuf;

use anyhow::Context;
use serde_json::Value;

use super::client::{ServerArg, segment};
use whereabouts_api::Answer;
use whereabouts_core::{Job, MapName, MediaType, Pose};

#[derive(Debug, clap::Args)]
pub struct Args {
    /// The picture: JPEG, PNG or WebP
    file: PathBuf,
    /// In which map to look
    #[arg(long)]
    map: MapName,
    /// How many candidates to show
    #[arg(short, default_value_t = 5)]
    k: usize,
    /// Wait for the refinement and show its order
    #[arg(long)]
    refine: bool,
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
    let media_type = MediaType::sniff(&frame)
        .with_context(|| format!("{} is not a JPEG, PNG or WebP picture", args.file.display()))?;
    let mode = if args.refine { "wait" } else { "off" };
    let path = format!("/localize?map={}&k={}&refine={mode}", segment(args.map.as_str()), args.k);
    let request = client.post(&path).header("content-type", media_type.as_str()).body(frame);
    let answer: Value = client.json(request).await?;
    if args.json {
        println!("{answer}");
        return Ok(());
    }
    let answer: Answer = serde_json::from_value(answer)?;
    print_answer(&answer);
    if let Some(link) = &answer.job {
        print_job(&client.json(client.get(&link.href)).await?);
    } else if let Some(why) = &answer.no_job {
        println!("no refinement: {}", why.detail);
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
            pose_text(candidate.pose)
        );
    }
    match &answer.estimate {
        Some(estimate) => println!(
            "estimate: {} {}, confidence {:.3} ({})",
            estimate.image_id,
            pose_text(estimate.pose),
            estimate.confidence,
            if estimate.known { "a known place" } else { "perhaps not in the map" }
        ),
        None => println!("the map has no images yet; add some with `whereabouts index`"),
    }
}

/// A job for people.
pub(super) fn print_job(job: &Job) {
    println!("job {} ({}, {}): {} attempts", job.id, job.map, job.refiner, job.attempts);
    println!(
        "  {}{}",
        job.state,
        job.error.as_ref().map_or(String::new(), |why| format!(": {why}"))
    );
    for place in job.ranking.iter().flat_map(|ranking| ranking.as_slice()) {
        println!(
            "{:3}  (was {:2})  {}  {}",
            place.rank,
            place.coarse_rank,
            place.image_id,
            pose_text(place.pose)
        );
    }
    if let Some(reasoning) = &job.reasoning {
        println!("  {reasoning}");
    }
}

/// A pose in a few characters.
pub(super) fn pose_text(pose: Option<Pose>) -> String {
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
