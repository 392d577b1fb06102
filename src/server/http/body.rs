//! Extracts queries, path segments, JSON, and pictures, raw or in a form.

use axum::extract::{FromRequest, FromRequestParts, Multipart, Path, Query, Request};
use axum::http::header::CONTENT_TYPE;
use axum::http::request::Parts;
use axum::http::{HeaderMap, StatusCode};
use bytes::Bytes;
use serde::de::DeserializeOwned;

use super::state::AppState;
use crate::gate::{Problem, read_whole, throw_away, too_large};
use whereabouts_api::ErrorKind;
use whereabouts_service::Service;
use whereabouts_vision::AdmissionRequest;

/// The query string.
pub(super) struct Params<T>(pub T);

impl<T: DeserializeOwned> FromRequestParts<AppState> for Params<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &AppState) -> Result<Self, Problem> {
        match Query::<T>::from_request_parts(parts, state).await {
            Ok(Query(params)) => Ok(Self(params)),
            Err(rejection) => Err(Problem::new(ErrorKind::Malformed, rejection.body_text())),
        }
    }
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
        let bytes = read_whole(request.into_body(), state.gate.settings.body_limit_bytes).await?;
        let text: &[u8] = if bytes.is_empty() { b"{}" } else { &bytes };
        serde_json::from_slice(text).map(Self).map_err(|error| {
            Problem::new(
                ErrorKind::Malformed,
                format!("the body is not the JSON expected: {error}"),
            )
        })
    }
}

/// A picture, and the part `meta` if the body is a form that has one.
pub(super) struct PictureBody {
    pub picture: Bytes,
    pub meta: Option<Bytes>,
}

impl PictureBody {
    /// Reads a picture, unless the server is overloaded: then it is refused before its body is read.
    pub async fn read(
        request: Request,
        state: &AppState,
        service: &Service,
        demand: AdmissionRequest,
    ) -> Result<Self, Problem> {
        if let Err(rejected) = service.maps.imaging.check_admission(demand) {
            throw_away(request);
            return Err(rejected.into());
        }
        match body_type(request.headers())? {
            BodyType::Raw => Ok(Self {
                picture: read_whole(request.into_body(), state.gate.settings.body_limit_bytes)
                    .await?,
                meta: None,
            }),
            BodyType::Form => from_form(request, state.gate.settings.body_limit_bytes).await,
        }
    }
}

enum BodyType {
    Raw,
    Form,
}

/// The `Content-Type` as it was sent, and its media type in lower case without parameters.
pub(super) fn content_type(headers: &HeaderMap) -> (&str, String) {
    let header = headers.get(CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or("");
    (header, header.split(';').next().unwrap_or("").trim().to_ascii_lowercase())
}

fn body_type(headers: &HeaderMap) -> Result<BodyType, Problem> {
    let (header, media_type) = content_type(headers);
    match media_type.as_str() {
        "application/octet-stream" => Ok(BodyType::Raw),
        // The bytes decide which format it is.
        image if image.starts_with("image/") => Ok(BodyType::Raw),
        "multipart/form-data" => Ok(BodyType::Form),
        _ => Err(Problem::new(
            ErrorKind::UnsupportedMedia,
            format!(
                "the Content-Type is {header:?}; send a picture as image/jpeg, image/png or \
                 another image type (with curl: -H 'Content-Type: image/jpeg' --data-binary @frame.jpg), or \
                 multipart/form-data with a part \"image\" (-F image=@frame.jpg)"
            ),
        )),
    }
}

/// Reads a form. The router bounds its size; `limit` is only for the error.
pub(super) async fn from_form(request: Request, limit: usize) -> Result<PictureBody, Problem> {
    let malformed = |detail: String| Problem::new(ErrorKind::Malformed, detail);
    let mut form = Multipart::from_request(request, &())
        .await
        .map_err(|rejection| malformed(rejection.body_text()))?;
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
