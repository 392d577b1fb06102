//! `whereabouts index --reindex`: begins it on the server, and watches until it has ended.

use std::time::Duration;
use whereabouts_api::{MapState, ReindexRequest, ReindexState};

use anyhow::{Context, bail};

use super::super::client::{Client, segment};
use super::Args;
use crate::progress::Progress;

/// The pause between two looks at the map.
const PAUSE: Duration = Duration::from_millis(300);

pub async fn run(client: &Client, args: &Args) -> anyhow::Result<()> {
    let path = format!("/maps/{}", segment(args.map.as_str()));
    let request = ReindexRequest { model: args.model.clone(), descriptor: args.descriptor };
    let begin = client.post(&format!("{path}/reindex")).json(&request);
    let begun: MapState = client.json(begin).await?;
    let progress = Progress::new("images", begun.images);
    let ended = loop {
        let looked = client.send_with_retries(|| Ok(client.get(&path))).await;
        let unknown = || format!("it is not known how the reindex ended; GET {path} tells");
        let map: MapState = looked.with_context(unknown)?.json().await.with_context(unknown)?;
        let Some(reindex) = &map.reindex else {
            bail!(
                "the server was started again before the reindex had ended, and the map {} still \
                 has the model {:?}; run this command again",
                args.map,
                map.model
            );
        };
        if reindex.state != ReindexState::Running {
            break map;
        }
        progress.at(reindex.done, reindex.total);
        tokio::time::sleep(PAUSE).await;
    };
    progress.end();
    if args.json {
        println!("{}", serde_json::to_string(&ended)?);
    }
    let Some(reindex) = &ended.reindex else { return Ok(()) };
    if let Some(why) = &reindex.error {
        bail!("the map {} still has the model {:?}: {why}", args.map, ended.model);
    }
    if !args.json {
        let ended_at = reindex.finished_at.unwrap_or(reindex.started_at);
        println!(
            "{}: {} images have new descriptors of {} ({}, {} precision, {} numbers); {:.1} s",
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
