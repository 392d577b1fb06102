//! Localizing: one frame, or the newest of many.

use std::sync::Arc;
use std::time::Instant;

use futures_util::{FutureExt, stream};
use tokio::sync::OwnedSemaphorePermit;
use tonic::{Request, Response, Status, Streaming};

use super::proto::localization_service_server::LocalizationService;
use super::proto::localize_stream_response::Outcome;
use super::proto::{
    self, LocalizeRequest, LocalizeResponse, LocalizeStreamRequest, LocalizeStreamResponse,
};
use super::streams::{Answers, until_over};
use super::{Api, Asked, convert, status};
use whereabouts_service::{ServiceError, TrackStep};

#[tonic::async_trait]
impl LocalizationService for Api {
    type LocalizeStreamStream = Answers<LocalizeStreamResponse>;

    async fn localize(
        &self,
        request: Request<LocalizeRequest>,
    ) -> Result<Response<LocalizeResponse>, Status> {
        let asked = self.asked(request.extensions()).map_err(status::of)?;
        let answer = asked.localize(request.into_inner()).await.map_err(status::of)?;
        Ok(Response::new(answer))
    }

    async fn localize_stream(
        &self,
        request: Request<Streaming<LocalizeStreamRequest>>,
    ) -> Result<Response<Self::LocalizeStreamStream>, Status> {
        let asked = Arc::new(self.asked(request.extensions()).map_err(status::of)?);
        let frames = Frames {
            coming: request.into_inner(),
            newest: None,
            skipped: 0,
            counted: false,
            ended: None,
            asked: Arc::clone(&asked),
        };
        let answers = stream::unfold(frames, |mut frames| async {
            let answer = frames.next().await?;
            Some((answer, frames))
        });
        let answers = until_over(answers, &self.door, asked.as_ref().clone());
        Ok(Response::new(answers))
    }
}

impl Asked {
    async fn localize(&self, request: LocalizeRequest) -> Result<LocalizeResponse, ServiceError> {
        let LocalizeRequest { map, image, k, refine, priority, track } = request;
        let track = track.map(|track| self.step(track)).transpose()?;
        let request = whereabouts_service::LocalizeRequest {
            map: self.map(&map)?,
            k: k.map(|k| k as usize),
            refine: convert::refine_mode(refine)?,
            priority: convert::priority(priority)?,
            frame: image,
            deadline: self.deadline.0,
            track,
            once: None,
        };
        Ok(self.service.localizer.localize(request).await?.into())
    }

    fn step(&self, track: proto::Track) -> Result<TrackStep, ServiceError> {
        let captured_at = track.captured_at.map(convert::moment).transpose()?;
        TrackStep::new(&self.caller, track.id, captured_at, track.moved_m)
    }
}

/// The frames of a stream, of which the newest is localized next.
struct Frames {
    coming: Streaming<LocalizeStreamRequest>,
    newest: Option<(LocalizeStreamRequest, Option<OwnedSemaphorePermit>)>,
    /// Frames that newer ones have replaced since the last answer.
    skipped: u32,
    /// Whether one has been counted, as the request that the stream began with.
    counted: bool,
    /// How the frames ended, once they have.
    ended: Option<Result<(), Status>>,
    asked: Arc<Asked>,
}

impl Frames {
    /// The next answer; `None` when the last has been given.
    async fn next(&mut self) -> Option<Result<LocalizeStreamResponse, Status>> {
        while self.newest.is_none() && self.ended.is_none() {
            let next = self.coming.message().await;
            self.take(next);
        }
        // Those that have come meanwhile are newer.
        while self.ended.is_none()
            && let Some(next) = self.coming.message().now_or_never()
        {
            self.take(next);
        }
        let Some((frame, _memory)) = self.newest.take() else {
            return self.ended.replace(Ok(()))?.err().map(Err);
        };
        let skipped = std::mem::take(&mut self.skipped);
        let LocalizeStreamRequest { frame_number, frame } = frame;
        let (asked, begun) = (Arc::clone(&self.asked), Instant::now());
        let counted = std::mem::replace(&mut self.counted, true);
        let mut working = std::pin::pin!(async move {
            // Each frame counts as a request of the key, of which the first is counted already.
            if counted {
                asked.service.keys.limits.take_one_more(&asked.caller).await?;
            }
            asked.localize(frame.unwrap_or_default()).await
        });
        let answer = loop {
            tokio::select! {
                answer = &mut working => break answer,
                next = self.coming.message(), if self.ended.is_none() => self.take(next),
            }
        };
        let metrics = &self.asked.metrics;
        let outcome = match answer {
            Ok(answer) => {
                metrics.frame_of_stream(begun.elapsed());
                Outcome::Answer(answer)
            }
            Err(error) => Outcome::Problem(status::problem(error)),
        };
        let outcome = Some(outcome);
        Some(Ok(LocalizeStreamResponse { frame_number, skipped, outcome }))
    }

    fn take(&mut self, next: Result<Option<LocalizeStreamRequest>, Status>) {
        match next {
            Ok(Some(frame)) => {
                let replaced = self.newest.replace((frame, self.asked.held.take())).is_some();
                self.skipped += u32::from(replaced);
            }
            Ok(None) => self.ended = Some(Ok(())),
            Err(status) => self.ended = Some(Err(status)),
        }
    }
}
