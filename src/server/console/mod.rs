//! The operator's console: a page of plain JavaScript modules and one stylesheet, embedded in the binary. It uses
//! the public API with the key of the operator who signed in, and nothing else.

use axum::extract::Path;
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, IF_NONE_MATCH,
};
use axum::http::header::{REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS};
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use crate::gate::{RoutePolicy, Routes};
use whereabouts_core::Digest;

/// The page.
const PAGE: &str = "index.html";

macro_rules! assets {
    ($($name:literal),+ $(,)?) => {
        &[$(($name, include_str!(concat!("assets/", $name)))),+]
    };
}

/// Every file of the page.
const ASSETS: &[(&str, &str)] = assets![
    "api.js",
    "app.js",
    "chart.js",
    "dom.js",
    "format.js",
    "health.js",
    "icon.svg",
    "images.js",
    "index.html",
    "job.js",
    "jobs.js",
    "map.js",
    "maps.js",
    "pair.js",
    "plan.js",
    "points.js",
    "style.css",
    "texts.js",
    "tracks.js",
    "try.js",
    "words.js",
];

/// Headers that restrict what the page may do in a browser.
#[derive(Debug, Clone)]
struct PageSecurity {
    policy: Option<HeaderValue>,
    referrer: &'static str,
}

/// The routes of the page. `tiles` is the URL of map tiles, whose host may serve images.
pub(crate) fn routes<S: Clone + Send + Sync + 'static>(tiles: Option<&str>) -> Routes<S> {
    let security = PageSecurity {
        policy: HeaderValue::from_str(&policy(tiles)).ok(),
        // Tile servers require a referrer.
        referrer: if tiles.is_some() { "strict-origin" } else { "no-referrer" },
    };
    let for_page = security.clone();
    let page = get(move |headers: HeaderMap| async move { file(PAGE, &headers, for_page) });
    let files = get(move |Path(name): Path<String>, headers: HeaderMap| async move {
        file(&name, &headers, security)
    });
    Routes::new().get("/", RoutePolicy::public(), page).get(
        "/console/{file}",
        RoutePolicy::public(),
        files,
    )
}

/// The content security policy: only this server and the tiles, and no inline script or style.
fn policy(tiles: Option<&str>) -> String {
    let origin = tiles.and_then(|url| {
        let (scheme, rest) = url.split_once("://")?;
        Some(format!(" {scheme}://{}", rest.split('/').next()?))
    });
    format!(
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:{}; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
        origin.unwrap_or_default()
    )
}

fn file(name: &str, headers: &HeaderMap, security: PageSecurity) -> Response {
    let Some((_, text)) = ASSETS.iter().find(|(known, _)| *known == name) else {
        return StatusCode::NOT_FOUND.into_response();
    };
    let tag = format!("\"{}\"", &Digest::of(text.as_bytes()).hex()[..16]);
    let unchanged =
        headers.get(IF_NONE_MATCH).is_some_and(|sent| sent.as_bytes() == tag.as_bytes());
    let mut response = match unchanged {
        true => StatusCode::NOT_MODIFIED.into_response(),
        false => ([(CONTENT_TYPE, media_type(name))], *text).into_response(),
    };
    let headers = response.headers_mut();
    // Revalidated on each load, and sent again only when it has changed.
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    headers.insert(X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    headers.insert(REFERRER_POLICY, HeaderValue::from_static(security.referrer));
    headers.extend(HeaderValue::from_str(&tag).ok().map(|tag| (ETAG, tag)));
    headers.extend(security.policy.map(|policy| (CONTENT_SECURITY_POLICY, policy)));
    response
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("html") => "text/html; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("svg") => "image/svg+xml",
        Some("webmanifest") => "application/manifest+json",
        _ => "text/javascript; charset=utf-8",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_asset_is_served_and_all_together_are_small() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("console/assets");
        let mut present: Vec<_> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        present.sort();
        let mut served: Vec<_> = ASSETS.iter().map(|(name, _)| (*name).to_owned()).collect();
        served.sort();
        assert_eq!(served, present);
        let bytes: usize = ASSETS.iter().map(|(_, text)| text.len()).sum();
        assert!(bytes < 200_000, "{bytes} bytes");
    }

    #[test]
    fn the_policy_allows_images_from_the_tile_server_and_nothing_else() {
        assert!(policy(None).contains("img-src 'self' blob:;"));
        let with_tiles = policy(Some("https://tiles.example:8443/{z}/{x}/{y}.png"));
        assert!(with_tiles.contains("img-src 'self' blob: https://tiles.example:8443;"));
    }
}
