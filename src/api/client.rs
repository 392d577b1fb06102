//! The HTTP client: errors carry the server's explanation; an overloaded server is asked again.

use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use reqwest::header::{AUTHORIZATION, HeaderMap, HeaderValue};
use reqwest::{RequestBuilder, Response, StatusCode};
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// Talks to one server. Clones share its connections.
#[derive(Debug, Clone)]
pub struct Client {
    base: String,
    http: reqwest::Client,
}

/// How often a request is sent again while the server says that it is overloaded.
pub const PATIENCE: usize = 60;

/// The longest pause before that.
pub const LONGEST_PAUSE: Duration = Duration::from_secs(30);

impl Client {
    /// A client of the server at a base URL, with an API key if one is given.
    pub fn new(server: &str, api_key: Option<&str>) -> anyhow::Result<Self> {
        let mut headers = HeaderMap::new();
        if let Some(key) = api_key {
            let mut bearer = HeaderValue::from_str(&format!("Bearer {}", key.trim()))
                .map_err(|_| anyhow!("WHEREABOUTS_API_KEY is no key: one begins with \"wab_\""))?;
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

    /// A GET request to a path of the API.
    pub fn get(&self, path: &str) -> RequestBuilder {
        self.http.get(format!("{}{path}", self.base))
    }

    /// A DELETE request to a path of the API.
    pub fn delete(&self, path: &str) -> RequestBuilder {
        self.http.delete(format!("{}{path}", self.base))
    }

    /// A PUT request to a path of the API.
    pub fn put(&self, path: &str) -> RequestBuilder {
        self.http.put(format!("{}{path}", self.base))
    }

    /// A POST request to a path of the API.
    pub fn post(&self, path: &str) -> RequestBuilder {
        self.http.post(format!("{}{path}", self.base))
    }

    /// Sends a request and reads its JSON answer.
    pub async fn json<T: DeserializeOwned>(&self, request: RequestBuilder) -> anyhow::Result<T> {
        let response = self.send(request).await?;
        response.json().await.context("the server's answer is not the JSON expected")
    }

    /// Sends a request and reads its answer as text.
    pub async fn text(&self, request: RequestBuilder) -> anyhow::Result<String> {
        self.send(request).await?.text().await.context("the server's answer broke off")
    }

    /// Sends a request; any status but success is an error with the server's explanation.
    pub async fn send(&self, request: RequestBuilder) -> anyhow::Result<Response> {
        let response = request.send().await.map_err(|error| self.unreachable(error))?;
        match response.status().is_success() {
            true => Ok(response),
            false => Err(explained(response).await),
        }
    }

    /// As [`Self::send`], for a request that `make` can make again: waits and repeats it while
    /// the server is overloaded.
    pub async fn send_patiently(
        &self,
        make: impl Fn() -> anyhow::Result<RequestBuilder>,
    ) -> anyhow::Result<Response> {
        let response = self.answer_patiently(make).await?;
        match response.status().is_success() {
            true => Ok(response),
            false => Err(explained(response).await),
        }
    }

    /// As [`Self::send_patiently`], with an answer of any other status.
    pub async fn answer_patiently(
        &self,
        make: impl Fn() -> anyhow::Result<RequestBuilder>,
    ) -> anyhow::Result<Response> {
        for _ in 0..PATIENCE {
            let response = make()?.send().await.map_err(|error| self.unreachable(error))?;
            match response.status() {
                StatusCode::TOO_MANY_REQUESTS => tokio::time::sleep(retry_after(&response)).await,
                _ => return Ok(response),
            }
        }
        bail!("the server stayed overloaded")
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

/// A file or map name as one segment of a path.
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
    Duration::from_secs(seconds).min(LONGEST_PAUSE)
}

/// What the server says went wrong.
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
