//! `whereabouts find`.

use serde::{Deserialize, Serialize};

use super::client::{Client, ServerArg, segment};
use whereabouts_api::ImageMatch;
use whereabouts_core::{Image, MapName};

/// Search for text that was read in the images of a map: signs, shop names, street names
///
/// The best match comes first. Case, accents, spaces, some typing errors and what readers confuse (0 and O, 1 and l, rn
/// and m) make no difference. Needs a server with a reader (`make reader`).
#[derive(Debug, clap::Args)]
pub struct Args {
    /// What the sign says
    text: String,
    /// The map
    #[arg(long)]
    map: MapName,
    /// Maximum number of images to list
    #[arg(long, default_value_t = 20)]
    limit: usize,
    /// Print the server's answer as JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    server: ServerArg,
}

#[derive(Serialize, Deserialize)]
struct Page {
    images: Vec<Image>,
    matches: Vec<ImageMatch>,
    #[serde(default)]
    unread: Option<usize>,
    next_cursor: Option<String>,
}

pub async fn run(args: Args) -> anyhow::Result<()> {
    let client = args.server.client()?;
    let page = find(&client, &args).await?;
    if args.json {
        println!("{}", serde_json::to_value(page)?);
        return Ok(());
    }
    if page.matches.is_empty() {
        println!("no image of {} has that text", args.map);
    }
    for found in &page.matches {
        let lines: Vec<&str> = found.lines.iter().map(|line| line.text.as_str()).collect();
        println!("{:.2}  {}  {}", found.score, found.image_id, lines.join(" / "));
    }
    if page.next_cursor.is_some() {
        println!("there are more; list them with a larger --limit");
    }
    match page.unread {
        Some(unread) if unread > 0 => println!("{unread} images are not read yet"),
        _ => {}
    }
    Ok(())
}

/// Fetches pages until the limit or the last page is reached.
async fn find(client: &Client, args: &Args) -> anyhow::Result<Page> {
    let path = format!("/maps/{}/images", segment(args.map.as_str()));
    let mut page = Page { images: vec![], matches: vec![], unread: None, next_cursor: None };
    loop {
        let limit = args.limit.saturating_sub(page.matches.len()).clamp(1, 1000);
        let mut query = vec![("text", args.text.clone()), ("limit", limit.to_string())];
        query.extend(page.next_cursor.take().map(|cursor| ("cursor", cursor)));
        let next: Page = client.json(client.get(&path).query(&query)).await?;
        page.images.extend(next.images);
        page.matches.extend(next.matches);
        (page.unread, page.next_cursor) = (next.unread, next.next_cursor);
        if page.next_cursor.is_none() || page.matches.len() >= args.limit {
            return Ok(page);
        }
    }
}
