//! Prepares the map that a folder is added to: it is created, or its coordinate frame and that of the poses are
//! brought together.

use anyhow::{Context, bail};
use reqwest::StatusCode;
use serde::Deserialize;

use super::super::client::{Client, explained, segment};
use super::Args;
use whereabouts_api::{MapChange, MapState};
use whereabouts_core::{CoordinateFrame, UtmZone};
use whereabouts_eval::{Folder, FolderPoses, zone_in_name};
use whereabouts_vision::exif;

/// Creates or changes the map, and converts the poses to its coordinate frame. Returns the path of the map.
pub async fn prepare(
    client: &Client,
    args: &Args,
    folder: &Folder,
    poses: &mut FolderPoses,
) -> anyhow::Result<String> {
    let path = format!("/maps/{}", segment(args.map.as_str()));
    if let Some(frame) = args.frame {
        poses.convert_to(frame)?;
    }
    let known = known_map(client, &path).await?.filter(|map| map.images > 0);
    let wanted = args.frame.or(poses.frame()).or_else(|| match &known {
        // Only EXIF can have poses; look for one only if the frame would have to change for it.
        Some(map) if map.frame == CoordinateFrame::Metric && has_exif_pose(folder) => {
            Some(CoordinateFrame::Wgs84)
        }
        _ => None,
    });
    match (&known, wanted) {
        (Some(map), Some(frame)) if map.frame != frame && args.frame.is_none() => {
            // A map in which no image has a pose can change its frame.
            if !put(client, args, &path, Some(frame)).await? {
                put(client, args, &path, None).await?;
                poses.convert_to(map.frame).with_context(|| {
                    format!(
                        "the map {} has poses in {}, and those of the folder are in {frame}",
                        args.map, map.frame
                    )
                })?;
            } else {
                poses.convert_to(frame)?;
            }
        }
        _ => {
            if !put(client, args, &path, wanted).await? {
                // Without the frame of the folder, what else is refused is explained.
                put(client, args, &path, None).await?;
            }
            if let (None, Some(map)) = (wanted, &known) {
                poses.convert_to(map.frame)?;
            }
        }
    }
    if let (Some(zone), Some(_)) = (poses.zone(), &known) {
        check_zone(client, args, &path, zone).await?;
    }
    Ok(path)
}

async fn known_map(client: &Client, path: &str) -> anyhow::Result<Option<MapState>> {
    let response = client.response_with_retries(|| Ok(client.get(path))).await?;
    match response.status() {
        StatusCode::NOT_FOUND => Ok(None),
        status if status.is_success() => Ok(Some(
            response.json().await.context("the server's response is not the expected JSON")?,
        )),
        _ => Err(explained(response).await),
    }
}

/// Creates or changes the map. Returns `false` if another coordinate frame than asked for by the user is refused.
async fn put(
    client: &Client,
    args: &Args,
    path: &str,
    frame: Option<CoordinateFrame>,
) -> anyhow::Result<bool> {
    let change = MapChange {
        model: args.model.clone(),
        scene: args.scene,
        descriptor: args.descriptor,
        frame,
        ..MapChange::default()
    };
    let response = client.response_with_retries(|| Ok(client.put(path).json(&change))).await?;
    match response.status() {
        status if status.is_success() => Ok(true),
        StatusCode::CONFLICT if args.frame.is_none() && frame.is_some() => {
            // The frame is not the user's wish; anything else that was refused is refused again without it.
            Ok(false)
        }
        _ => Err(explained(response).await),
    }
}

fn has_exif_pose(folder: &Folder) -> bool {
    let has_pose = |bytes: Vec<u8>| exif::gps(&bytes).pose.is_some();
    folder.pictures.iter().any(|picture| std::fs::read(&picture.file).is_ok_and(has_pose))
}

/// Refuses metres of a UTM zone for a map with metres of another one, which would pile up different places.
async fn check_zone(client: &Client, args: &Args, path: &str, zone: UtmZone) -> anyhow::Result<()> {
    #[derive(Deserialize)]
    struct Page {
        images: Vec<Named>,
    }
    #[derive(Deserialize)]
    struct Named {
        id: String,
    }
    let page = format!("{path}/images?limit=1000");
    let response = client.send_with_retries(|| Ok(client.get(&page))).await?;
    let page: Page =
        response.json().await.context("the server's response is not the expected JSON")?;
    let other = page.images.iter().find_map(|image| {
        zone_in_name(&image.id).filter(|other| *other != zone).map(|other| (&image.id, other))
    });
    if let Some((id, other)) = other {
        bail!(
            "the map {} has images in metres of UTM zone {other}, such as {id}, and those of the folder are in \
             metres of zone {zone}; index a folder that holds both into a new map, which gets the frame wgs84",
            args.map
        );
    }
    Ok(())
}
