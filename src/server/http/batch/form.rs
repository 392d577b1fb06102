//! Reads the images of a form, part by part.

use axum::extract::multipart::{Field, MultipartError};
use axum::extract::{FromRequest, Multipart, Request};
use bytes::{Bytes, BytesMut};
use futures_util::{Stream, stream};
use tokio::sync::OwnedSemaphorePermit;

use super::{FIRST_RESERVATION, LARGEST_META, Room, described, unreadable};
use crate::gate::Problem;
use crate::http::body::no_form;
use whereabouts_api::ErrorKind;
use whereabouts_service::{BulkImage, ServiceError};

/// The images of a form, as its parts arrive.
pub(super) async fn images(
    request: Request,
    room: Room,
) -> Result<impl Stream<Item = Result<Result<BulkImage, ServiceError>, Problem>> + Send, Problem> {
    let malformed = |detail: String| Problem::new(ErrorKind::Malformed, detail);
    let form = Multipart::from_request(request, &())
        .await
        .map_err(|rejection| malformed(no_form(&rejection.body_text())))?;
    Ok(stream::try_unfold(Parts { form, room }, |mut parts| async {
        Ok(parts.next().await?.map(|image| (image, parts)))
    }))
}

struct Parts {
    form: Multipart,
    room: Room,
}

impl Parts {
    async fn next(&mut self) -> Result<Option<Result<BulkImage, ServiceError>>, Problem> {
        let malformed = |detail: String| Problem::new(ErrorKind::Malformed, detail);
        let mut meta = None;
        while let Some(part) = self.form.next_field().await.map_err(broken)? {
            let name = part.name().unwrap_or("").chars().take(80).collect::<String>();
            match name.as_str() {
                "meta" if meta.is_none() => {
                    meta = Some(whole(part, LARGEST_META, "a part \"meta\"").await?);
                }
                "meta" => {
                    return Err(malformed(
                        "there are two parts \"meta\" in a row; each describes the part \"image\" that follows"
                            .into(),
                    ));
                }
                "image" => {
                    let file = part.file_name().map(str::to_owned);
                    let picture = picture(&self.room, part).await?;
                    self.room.allow(0);
                    let meta = described(meta.as_deref(), file.as_deref());
                    return Ok(Some(picture.and_then(|(bytes, memory)| {
                        Ok(BulkImage { bytes, meta: meta?, memory: Some(memory) })
                    })));
                }
                other => {
                    return Err(malformed(format!(
                        "the form has a part {other:?}; only \"image\" and \"meta\" are known"
                    )));
                }
            }
        }
        match meta {
            None => Ok(None),
            Some(_) => {
                Err(malformed("the last part is \"meta\", and no \"image\" follows it".into()))
            }
        }
    }
}

/// Reads a picture, and reserves memory for it. A picture that is too large is read to its end and dropped.
async fn picture(
    room: &Room,
    mut part: Field<'_>,
) -> Result<Result<(Bytes, OwnedSemaphorePermit), ServiceError>, Problem> {
    let limit = room.settings.server.body_limit_bytes;
    let mut reserved = room.reserve(FIRST_RESERVATION.min(limit)).await?;
    let (mut bytes, mut too_large) = (BytesMut::new(), false);
    while let Some(chunk) = part.chunk().await.map_err(broken)? {
        room.allow(0);
        let length = bytes.len() + chunk.len();
        too_large |= room.is_too_small(length);
        if too_large {
            continue;
        }
        if reserved.num_permits() < length {
            reserved.merge(room.reserve(limit - reserved.num_permits()).await?);
        }
        bytes.extend_from_slice(&chunk);
    }
    drop(reserved.split(reserved.num_permits().saturating_sub(bytes.len())));
    Ok(if too_large { Err(room.too_large()) } else { Ok((bytes.freeze(), reserved)) })
}

/// Reads a part of at most `limit` bytes.
async fn whole(mut part: Field<'_>, limit: usize, what: &str) -> Result<Vec<u8>, Problem> {
    let mut bytes = Vec::new();
    while let Some(chunk) = part.chunk().await.map_err(broken)? {
        if bytes.len() + chunk.len() > limit {
            let detail = format!("{what} exceeds {limit} bytes");
            return Err(Problem::new(ErrorKind::TooLarge, detail));
        }
        bytes.extend_from_slice(&chunk);
    }
    Ok(bytes)
}

fn broken(error: MultipartError) -> Problem {
    unreadable(&error, &error.body_text())
}
