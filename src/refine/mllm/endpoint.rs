//! The URL and the headers of calls to a server.

use reqwest::Url;
use reqwest::header::{AUTHORIZATION, CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue};
use whereabouts_core::Secret;

use super::settings::{KeyHeader, MllmSettings, MllmSettingsError};

/// Returns the URL of chat completions.
pub(super) fn url(settings: &MllmSettings) -> Result<Url, MllmSettingsError> {
    let invalid =
        |reason: String| MllmSettingsError::Url { url: settings.base_url.clone(), reason };
    let text = format!("{}/chat/completions", settings.base_url.trim_end_matches('/'));
    let mut url = Url::parse(&text).map_err(|error| invalid(error.to_string()))?;
    if !matches!(url.scheme(), "http" | "https") {
        return Err(invalid(format!("its scheme is {}", url.scheme())));
    }
    if !settings.api_version.is_empty() {
        url.query_pairs_mut().append_pair("api-version", &settings.api_version);
    }
    Ok(url)
}

/// Returns the headers of every call, which carry the key.
pub(super) fn headers(key: &Secret, header: KeyHeader) -> Result<HeaderMap, MllmSettingsError> {
    let mut headers = HeaderMap::new();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static("application/json"));
    if key.is_empty() {
        return Ok(headers);
    }
    let (name, text) = match header {
        KeyHeader::Authorization => (AUTHORIZATION, format!("Bearer {}", key.expose())),
        KeyHeader::ApiKey => (HeaderName::from_static("api-key"), key.expose().to_owned()),
    };
    let mut value = HeaderValue::try_from(text).map_err(|_| MllmSettingsError::Key)?;
    value.set_sensitive(true);
    headers.insert(name, value);
    Ok(headers)
}
