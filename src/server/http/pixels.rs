//! The layout of a body that is pixels without a file format, from the query string.

use crate::gate::Problem;
use whereabouts_api::ErrorKind;
use whereabouts_service::ServiceError;
use whereabouts_vision::RawPixels;

/// The parameters `encoding`, `width`, `height` and `step`.
#[derive(Debug, Default)]
pub(super) struct PixelParams<'a> {
    pub encoding: Option<&'a str>,
    pub width: Option<u32>,
    pub height: Option<u32>,
    pub step: Option<u64>,
}

impl PixelParams<'_> {
    /// The layout of the body; `None` if it is a file.
    pub fn layout(self) -> Result<Option<RawPixels>, Problem> {
        let malformed = |detail: &str| Problem::new(ErrorKind::Malformed, detail);
        let Self { encoding, width, height, step } = self;
        let Some(encoding) = encoding else {
            return match (width, height, step) {
                (None, None, None) => Ok(None),
                _ => Err(malformed(
                    "width, height and step describe pixels without a file format, which also need encoding, such \
                     as encoding=rgb8; leave them out for a JPEG or PNG",
                )),
            };
        };
        let encoding = encoding.parse().map_err(|error: whereabouts_vision::RawPixelsError| {
            Problem::from(ServiceError::unprocessable(error.to_string()))
        })?;
        let (Some(width), Some(height)) = (width, height) else {
            return Err(malformed(
                "encoding needs width and height, such as encoding=rgb8&width=640&height=480",
            ));
        };
        Ok(Some(RawPixels { encoding, width, height, step }))
    }
}
