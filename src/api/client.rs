//! The HTTP client. Errors carry the server's explanation, and requests are retried while the server is overloaded.

use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use reqwest::{RequestBuilder, Response, StatusCode};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use whereabouts_core::{ImageId, MapName};

use crate::{ImageAnswer, ImagePatch};

/// A client of one server. Clones share its connections.
#[derive(Debug, Clone)]
pub struct Client {
    base: String,
    http: reqwest::Client,
}

/// Maximum attempts while the server is overloaded.
pub const MAX_ATTEMPTS: usize = 60;

/// Maximum pause between attempts.
pub const MAX_PAUSE: Duration = Duration::from_secs(30);

impl Client {
    /// Creates a client of the server at a base URL, with an optional API key.
    pub fn new(server: &str, api_key: Option<&str>) -> anyhow::Result<Self> {
        let mut headers = HeaderMap::new();
        if let Some(key) = api_key {
            let mut bearer =
                HeaderValue::from_str(&format!("Bearer {}", key.trim())).map_err(|_| {
                    anyhow!("WHEREABOUTS_API_KEY is not an API key: keys begin with \"wab_\"")
                })?;
            bearer.set_sensitive(true);
            headers.insert(AUTHORIZATION, bearer);
        }
        let http = reqwest::Client::builder()
            .default_headers(headers)
            .timeout(Duration::from_secs(180))
            .build()
            .context("cannot start an HTTP client")?;
        Ok(Self { base: server.trim_end_matches('/').to_owned(), http })
    }

    /// Builds a GET request to a path of the API.
    pub fn get(&self, path: &str) -> RequestBuilder {
        self.http.get(format!("{}{path}", self.base))
    }

    /// Builds a DELETE request to a path of the API.
    pub fn delete(&self, path: &str) -> RequestBuilder {
        self.http.delete(format!("{}{path}", self.base))
    }

    /// Builds a PUT request to a path of the API.
    pub fn put(&self, path: &str) -> RequestBuilder {
        self.http.put(format!("{}{path}", self.base))
    }

    /// Builds a PATCH request to a path of the API.
    pub fn patch(&self, path: &str) -> RequestBuilder {
        self.http.patch(format!("{}{path}", self.base))
    }

    /// Changes the pose, time or tags of an image.
    pub async fn update_image(
        &self,
        map: &MapName,
        id: &ImageId,
        change: &ImagePatch,
    ) -> anyhow::Result<ImageAnswer> {
        let path = format!("/maps/{}/images/{}", segment(map.as_str()), segment(id.as_str()));
        self.json(self.patch(&path).json(change)).await
    }

    /// Builds a POST request to a path of the API.
    pub fn post(&self, path: &str) -> RequestBuilder {
        self.http.post(format!("{}{path}", self.base))
    }

    /// Sends a request and deserializes its JSON response.
    pub async fn json<T: DeserializeOwned>(&self, request: RequestBuilder) -> anyhow::Result<T> {
        let response = self.send(request).await?;
        response.json().await.context("the server's response is not the expected JSON")
    }

    /// Sends a request and reads its response as text.
    pub async fn text(&self, request: RequestBuilder) -> anyhow::Result<String> {
        self.send(request).await?.text().await.context("the server's response was interrupted")
    }

    /// Sends a request. A status other than success is an error with the server's explanation.
    pub async fn send(&self, request: RequestBuilder) -> anyhow::Result<Response> {
        let response = request.send().await.map_err(|error| self.unreachable(error))?;
        match response.status().is_success() {
            true => Ok(response),
            false => Err(explained(response).await),
        }
    }

    /// Like [`Self::send`], but retries the request built by `make` while the server is overloaded.
    pub async fn send_with_retries(
        &self,
        make: impl Fn() -> anyhow::Result<RequestBuilder>,
    ) -> anyhow::Result<Response> {
        let response = self.response_with_retries(make).await?;
        match response.status().is_success() {
            true => Ok(response),
            false => Err(explained(response).await),
        }
    }

    /// Like [`Self::send_with_retries`], but also returns responses with an error status.
    pub async fn response_with_retries(
        &self,
        make: impl Fn() -> anyhow::Result<RequestBuilder>,
    ) -> anyhow::Result<Response> {
        for _ in 0..MAX_ATTEMPTS {
            let response = make()?.send().await.map_err(|error| self.unreachable(error))?;
            match response.status() {
                StatusCode::TOO_MANY_REQUESTS => tokio::time::sleep(retry_after(&response)).await,
                _ => return Ok(response),
            }
        }
        bail!("the server is still overloaded after {MAX_ATTEMPTS} attempts")
    }

    fn unreachable(&self, error: reqwest::Error) -> anyhow::Error {
        if error.is_connect() {
            return anyhow!(
                "no server answers at {}; start one with `whereabouts serve`, or name another with \
                 --server",
                self.base
            );
        }
        anyhow::Error::new(error).context(format!("the request to {} failed", self.base))
    }
}

/// Percent-encodes a file or map name as one path segment.
pub fn segment(text: &str) -> String {
    text.bytes()
        .map(|byte| match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => {
                char::from(byte).to_string()
            }
            _ => format!("%{byte:02X}"),
        })
        .collect()
}

fn retry_after(response: &Response) -> Duration {
    let header = response.headers().get(reqwest::header::RETRY_AFTER);
    let seconds = header.and_then(|value| value.to_str().ok()?.parse().ok()).unwrap_or(1);
    Duration::from_secs(seconds).min(MAX_PAUSE)
}

/// Converts an error response to an error with the server's explanation.
pub async fn explained(response: Response) -> anyhow::Error {
    #[derive(Deserialize)]
    struct Problem {
        title: String,
        detail: String,
    }
    let status = response.status();
    match response.json::<Problem>().await {
        Ok(Problem { title, detail }) => anyhow!("{title} ({}): {detail}", status.as_u16()),
        Err(_) => anyhow!("the server answered {status}"),
    }
}
