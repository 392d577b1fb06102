//! `whereabouts index --reindex`: starts a reindex on the server and waits until it ends.

use std::time::Duration;

use anyhow::{Context, bail};

use super::super::client::{Client, segment};
use super::super::progress::ProgressMeter;
use super::Args;
use whereabouts_api::{MapState, ReindexRequest, ReindexState};

/// How often the state of the map is polled.
const POLL_INTERVAL: Duration = Duration::from_millis(300);

pub async fn run(client: &Client, args: &Args) -> anyhow::Result<()> {
    let path = format!("/maps/{}", segment(args.map.as_str()));
    let request = ReindexRequest {
        model: args.model.clone(),
        descriptor: args.descriptor,
        vocabulary: args.vocabulary,
    };
    let request = client.post(&format!("{path}/reindex")).json(&request);
    let started: MapState = client.json(request).await?;
    let progress = ProgressMeter::new("images", started.images);
    let ended = loop {
        let response = client.send_with_retries(|| Ok(client.get(&path))).await;
        let lost = || {
            format!(
                "lost track of the reindex, which may still be running; GET {path} has its state"
            )
        };
        let map: MapState = response.with_context(lost)?.json().await.with_context(lost)?;
        let Some(reindex) = &map.reindex else {
            bail!(
                "the server restarted before the reindex had ended, and the map {} still has the model \
                 {:?}; run this command again",
                args.map,
                map.model
            );
        };
        if reindex.state != ReindexState::Running {
            break map;
        }
        progress.set(reindex.done, reindex.total);
        tokio::time::sleep(POLL_INTERVAL).await;
    };
    progress.finish();
    if args.json {
        println!("{}", serde_json::to_string(&ended)?);
    }
    let Some(reindex) = &ended.reindex else { return Ok(()) };
    if let Some(error) = &reindex.error {
        bail!("the map {} still has the model {:?}: {error}", args.map, ended.model);
    }
    if !args.json {
        let ended_at = reindex.finished_at.unwrap_or(reindex.started_at);
        println!(
            "{}: computed new descriptors for {} images with {} ({}, {} precision, {} dimensions); {:.1} s",
            args.map,
            reindex.done,
            ended.model,
            ended.descriptor,
            ended.precision,
            ended.dim,
            ended_at.duration_since(reindex.started_at).as_secs_f64()
        );
    }
    Ok(())
}
