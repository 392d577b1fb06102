//! Extracts queries, path segments, JSON, and pictures, raw or in a form.

use axum::extract::{FromRequest, FromRequestParts, Multipart, Path, Query, Request};
use axum::http::header::CONTENT_TYPE;
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode};
use bytes::Bytes;
use percent_encoding::percent_decode_str;
use serde::de::DeserializeOwned;

use super::state::AppState;
use crate::gate::{Problem, read_whole, throw_away, too_large};
use whereabouts_api::ErrorKind;
use whereabouts_core::MediaType;
use whereabouts_service::Service;
use whereabouts_vision::{AdmissionRequest, Foreign, RawPixels};

/// The query string.
pub(super) struct Params<T>(pub T);

impl<T: DeserializeOwned> FromRequestParts<AppState> for Params<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &AppState) -> Result<Self, Problem> {
        check_utf8(parts.uri.query().unwrap_or_default())?;
        match Query::<T>::from_request_parts(parts, state).await {
            Ok(Query(params)) => Ok(Self(params)),
            Err(rejection) => Err(Problem::new(ErrorKind::Malformed, rejection.body_text())),
        }
    }
}

/// Refuses a query string that is not UTF-8, which the parser would repair with replacement characters.
fn check_utf8(query: &str) -> Result<(), Problem> {
    for pair in query.split('&') {
        if percent_decode_str(pair).decode_utf8().is_err() {
            let name = pair.split('=').next().unwrap_or_default();
            let detail = format!(
                "the query parameter {:?} is not UTF-8; percent-encode its text as UTF-8, such as %C3%A9 for é",
                name.chars().take(80).collect::<String>()
            );
            return Err(Problem::new(ErrorKind::Malformed, detail));
        }
    }
    Ok(())
}

/// The variable segments of the path.
pub(super) struct Segments<T>(pub T);

impl<T: DeserializeOwned + Send> FromRequestParts<AppState> for Segments<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &AppState) -> Result<Self, Problem> {
        match Path::<T>::from_request_parts(parts, state).await {
            Ok(Path(segments)) => Ok(Self(segments)),
            Err(rejection) => Err(Problem::new(ErrorKind::Malformed, rejection.body_text())),
        }
    }
}

/// A JSON body; an empty one is an empty object.
pub(super) struct JsonBody<T>(pub T);

impl<T: DeserializeOwned> FromRequest<AppState> for JsonBody<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &AppState) -> Result<Self, Problem> {
        let bytes =
            read_whole(request.into_body(), state.gate.settings.server.body_limit_bytes).await?;
        let text: &[u8] = if bytes.is_empty() { b"{}" } else { &bytes };
        object(text).map(Self).map_err(|error| {
            Problem::new(
                ErrorKind::Malformed,
                format!("the body is not the JSON expected: {error}"),
            )
        })
    }
}

/// Reads a JSON object. An array is refused, which the fields of a type would be read from in their order.
pub(super) fn object<T: DeserializeOwned>(text: &[u8]) -> Result<T, serde_json::Error> {
    // Windows PowerShell writes a byte order mark.
    let text = text.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(text);
    match text.trim_ascii_start().first() {
        Some(b'[') => Err(serde::de::Error::custom("it is an array; send an object")),
        _ => serde_json::from_slice(text),
    }
}

/// A picture, and the part `meta` if the body is a form that has one.
pub(super) struct PictureBody {
    pub picture: Bytes,
    pub meta: Option<Bytes>,
}

impl PictureBody {
    /// Reads a picture, a file or pixels with this layout, unless the server is overloaded: then it is refused before
    /// its body is read.
    pub async fn read(
        request: Request,
        state: &AppState,
        service: &Service,
        demand: AdmissionRequest,
        layout: Option<RawPixels>,
    ) -> Result<Self, Problem> {
        if let Err(rejected) = service.maps.imaging.check_admission(demand) {
            throw_away(request);
            return Err(rejected.into());
        }
        let limit = state.gate.settings.server.body_limit_bytes;
        let (header, media_type) = content_type(request.headers());
        let body = match media_type.as_str() {
            "multipart/form-data" => from_form(request, limit).await?,
            other if other.starts_with("multipart/") => return Err(unsupported(header)),
            other => {
                let (trusted, header) = (may_be_picture(other), header.to_owned());
                let picture = read_whole(request.into_body(), limit).await?;
                // Whatever the header says, the bytes decide. The decoders know what to do about other formats.
                let is_known =
                    MediaType::sniff(&picture).is_some() || Foreign::sniff(&picture).is_some();
                if !trusted && layout.is_none() && !is_known {
                    return Err(unsupported(&header));
                }
                Self { picture, meta: None }
            }
        };
        match layout {
            None => Ok(body),
            Some(layout) => {
                let picture = service.maps.imaging.png_of(layout, body.picture).await?;
                Ok(Self { picture, ..body })
            }
        }
    }
}

/// The `Content-Type` as it was sent, and its media type in lower case without parameters.
pub(super) fn content_type(headers: &HeaderMap) -> (&str, String) {
    let header = headers.get(CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or("");
    (header, header.split(';').next().unwrap_or("").trim().to_ascii_lowercase())
}

/// Whether a body of this type is given to the decoders, whose errors say more.
fn may_be_picture(media_type: &str) -> bool {
    media_type.starts_with("image/")
        || ["", "*/*", "application/octet-stream", "binary/octet-stream"].contains(&media_type)
}

fn unsupported(header: &str) -> Problem {
    let detail = format!(
        "the Content-Type is {header:?}, and the body is not a picture; send the bytes of a picture (with curl: \
         -H 'Content-Type: image/jpeg' --data-binary @frame.jpg), or multipart/form-data with a part \"image\" (-F \
         image=@frame.jpg)"
    );
    Problem::new(ErrorKind::UnsupportedMedia, detail)
}

/// Says that a body cannot be read as a form.
pub(super) fn no_form(why: &str) -> String {
    format!(
        "{why}; leave the Content-Type of a form to the HTTP client, which adds the boundary (with curl: -F, with \
         Python requests: files=)"
    )
}

/// Reads a form. The router bounds its size; `limit` is only for the error.
pub(super) async fn from_form(request: Request, limit: usize) -> Result<PictureBody, Problem> {
    let malformed = |detail: String| Problem::new(ErrorKind::Malformed, detail);
    let mut form = Multipart::from_request(request, &())
        .await
        .map_err(|rejection| malformed(no_form(&rejection.body_text())))?;
    let unreadable = |error: axum::extract::multipart::MultipartError| match error.status() {
        StatusCode::PAYLOAD_TOO_LARGE => Problem::new(ErrorKind::TooLarge, too_large(limit)),
        _ => malformed(format!("the form cannot be read: {}", error.body_text())),
    };
    let (mut picture, mut meta) = (None, None);
    while let Some(part) = form.next_field().await.map_err(unreadable)? {
        let slot = match part.name() {
            Some("image") => &mut picture,
            Some("meta") => &mut meta,
            other => {
                let name = other.unwrap_or("").chars().take(80).collect::<String>();
                return Err(malformed(format!(
                    "the form has a part {name:?}; only \"image\" and \"meta\" are known"
                )));
            }
        };
        if slot.replace(part.bytes().await.map_err(unreadable)?).is_some() {
            return Err(malformed("the form has a part twice".into()));
        }
    }
    let picture = picture.ok_or_else(|| malformed("the form has no part \"image\"".into()))?;
    Ok(PictureBody { picture, meta })
}
