//! The URL and the headers of calls to a server.

use reqwest::Url;
use reqwest::header::{AUTHORIZATION, CONTENT_TYPE, HeaderMap, HeaderName, HeaderValue};
use whereabouts_core::Secret;

use super::settings::{KeyHeader, MllmSettingsError, ServerSettings};

/// What a URL of chat completions ends with.
const PATH: &str = "/chat/completions";

/// Returns the URL of chat completions. White space around the base URL, quotes, slashes at its end and the path of
/// chat completions are removed; its query is kept.
pub(super) fn url(server: &ServerSettings) -> Result<Url, MllmSettingsError> {
    let invalid = |reason: String| MllmSettingsError::Url {
        key: server.url_key,
        url: shown_text(&server.base_url),
        reason,
    };
    let quotes: &[char] = &['"', '\'', '`', '<', '>'];
    let text = server.base_url.trim().trim_matches(quotes).trim();
    if text.is_empty() {
        return Err(invalid("it is empty".to_owned()));
    }
    if text.contains(char::is_whitespace) {
        return Err(invalid("there is white space in it".to_owned()));
    }
    let mut url = match Url::parse(text) {
        Ok(url) => url,
        Err(error) => return Err(invalid(format!("{error}; write it as http://host:port/v1"))),
    };
    if !matches!(url.scheme(), "http" | "https") {
        return Err(invalid(format!(
            "its scheme is {}; write it as http://host:port/v1",
            url.scheme()
        )));
    }
    if url.fragment().is_some() {
        return Err(invalid("it has a fragment, the part after #".to_owned()));
    }
    let base = url.path().trim_end_matches('/');
    let base = base.strip_suffix(PATH).unwrap_or(base).trim_end_matches('/');
    let path = format!("{base}{PATH}");
    url.set_path(&path);
    if !server.api_version.is_empty() {
        let named = url.query_pairs().any(|(name, _)| name == "api-version");
        if !named {
            url.query_pairs_mut().append_pair("api-version", &server.api_version);
        }
    }
    Ok(url)
}

/// Returns the URL of another path of the server: below the base URL, or at the server's root.
pub(super) fn sibling(url: &Url, path: &str, at_root: bool) -> Url {
    let mut sibling = url.clone();
    let base = url.path().strip_suffix(PATH).unwrap_or_default();
    let base = if at_root { base.strip_suffix("/v1").unwrap_or(base) } else { base };
    let path = format!("{base}/{path}");
    sibling.set_path(&path);
    sibling
}

/// Returns the base URL as it may be shown: without credentials and query.
pub(super) fn shown(url: &Url) -> String {
    let mut shown = url.clone();
    shown.set_query(None);
    // These fail for URLs without a host only.
    let _ = shown.set_password(None);
    let _ = shown.set_username("");
    let base = shown.path().strip_suffix(PATH).unwrap_or_default().to_owned();
    shown.set_path(&base);
    shown.to_string()
}

fn shown_text(text: &str) -> String {
    let text = text.split('?').next().unwrap_or_default();
    match text.split_once("://").and_then(|(scheme, rest)| Some((scheme, rest.split_once('@')?))) {
        Some((scheme, (_, rest))) => format!("{scheme}://{rest}"),
        None => text.to_owned(),
    }
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

#[cfg(test)]
mod tests {
    use super::super::settings::tests::defaults;
    use super::*;

    fn of(base_url: &str, api_version: &str) -> Result<String, MllmSettingsError> {
        let server = ServerSettings {
            base_url: base_url.into(),
            api_version: api_version.into(),
            ..defaults().describing()
        };
        url(&server).map(|url| url.to_string())
    }

    #[test]
    fn a_base_url_is_mended_where_it_is_clear_what_is_meant() {
        let plain = "http://host:8080/v1/chat/completions";
        for base_url in [
            "http://host:8080/v1",
            " http://host:8080/v1/ \n",
            "\"http://host:8080/v1\"",
            "http://host:8080/v1/chat/completions",
            "http://host:8080/v1/chat/completions/",
            "http://host:8080/v1//",
        ] {
            assert_eq!(of(base_url, "").unwrap(), plain, "{base_url}");
        }
        let query = "http://host/v1/chat/completions?api-version=1&a=b";
        assert_eq!(of("http://host/v1?api-version=1&a=b", "").unwrap(), query);
        assert_eq!(of("http://host/v1/chat/completions?api-version=1&a=b", "2").unwrap(), query);
        assert_eq!(of("http://host", "2").unwrap(), "http://host/chat/completions?api-version=2");
    }

    #[test]
    fn other_base_urls_are_refused_with_the_reason() {
        for (base_url, reason) in [
            ("", "empty"),
            ("  ", "empty"),
            ("api.openai.com/v1", "http://host:port/v1"),
            ("localhost:8080/v1", "http://host:port/v1"),
            ("ftp://host/v1", "scheme"),
            ("http://my host/v1", "white space"),
            ("http://host/v1#top", "fragment"),
            ("http://", "http://host:port/v1"),
        ] {
            let error = of(base_url, "").unwrap_err().to_string();
            assert!(
                error.contains(reason) && error.contains("mllm.base_url"),
                "{base_url}: {error}"
            );
        }
        let error = of("http://me:secret@my host/v1?key=secret", "").unwrap_err().to_string();
        assert!(!error.contains("secret"), "{error}");
    }

    #[test]
    fn a_shown_url_has_no_credentials() {
        let url = Url::parse("http://me:secret@host/v1/chat/completions?key=secret").unwrap();
        assert_eq!(shown(&url), "http://host/v1");
        assert_eq!(sibling(&url, "models", false).path(), "/v1/models");
        assert_eq!(sibling(&url, "props", true).path(), "/props");
    }
}
