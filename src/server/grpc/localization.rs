//! `LocalizationService`: localizes one frame, or the newest of a stream.

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
use super::streams::{ResponseStream, until_over};
use super::{Api, CallContext, convert, status};
use whereabouts_service::{Odometry, ServiceError, TrackStep};

#[tonic::async_trait]
impl LocalizationService for Api {
    type LocalizeStreamStream = ResponseStream<LocalizeStreamResponse>;

    async fn localize(
        &self,
        request: Request<LocalizeRequest>,
    ) -> Result<Response<LocalizeResponse>, Status> {
        let context = self.context(request.extensions()).map_err(status::of)?;
        let answer = context.localize(request.into_inner()).await.map_err(status::of)?;
        Ok(Response::new(answer))
    }

    async fn localize_stream(
        &self,
        request: Request<Streaming<LocalizeStreamRequest>>,
    ) -> Result<Response<Self::LocalizeStreamStream>, Status> {
        let context = Arc::new(self.context(request.extensions()).map_err(status::of)?);
        let frames = Frames {
            incoming: request.into_inner(),
            newest: None,
            skipped: 0,
            charged: false,
            ended: None,
            context: Arc::clone(&context),
        };
        let answers = stream::unfold(frames, |mut frames| async {
            let answer = frames.next().await?;
            Some((answer, frames))
        });
        let answers = until_over(answers, &self.readiness, context.as_ref().clone());
        Ok(Response::new(answers))
    }
}

impl CallContext {
    async fn localize(&self, request: LocalizeRequest) -> Result<LocalizeResponse, ServiceError> {
        let LocalizeRequest { map, image, k, refine, priority, track, refiner } = request;
        let track = track.map(|track| self.step(track)).transpose()?;
        let request = whereabouts_service::LocalizeRequest {
            map: self.map(&map)?,
            k: k.map(|k| k as usize),
            refine: convert::refine_mode(refine)?,
            refiner: convert::refiner(refiner)?,
            priority: convert::priority(priority)?,
            frame: image,
            deadline: self.deadline.0,
            track,
            idempotency_id: None,
        };
        Ok(self.service.localizer.localize(request).await?.into())
    }

    fn step(&self, track: proto::Track) -> Result<TrackStep, ServiceError> {
        let captured_at = track.captured_at.map(convert::moment).transpose()?;
        let odometry = match (track.moved_m, track.moved) {
            (Some(metres), None) => Some(Odometry::distance(metres)?),
            (None, Some(moved)) => {
                let pose = [moved.dx, moved.dy, moved.dyaw];
                Some(Odometry::relative_pose(pose, &moved.covariance)?)
            }
            (None, None) => None,
            (Some(_), Some(_)) => {
                return Err(ServiceError::unprocessable(
                    "odometry is either moved_m or moved; leave one of them out",
                ));
            }
        };
        TrackStep::new(&self.caller, track.id, captured_at, odometry)
    }
}

/// The frames of a stream. The newest is localized next; older ones are skipped.
struct Frames {
    incoming: Streaming<LocalizeStreamRequest>,
    newest: Option<(LocalizeStreamRequest, Option<OwnedSemaphorePermit>)>,
    /// Frames replaced by newer ones since the last answer.
    skipped: u32,
    /// Whether the first frame was charged to the rate limit, as the request that opened the stream.
    charged: bool,
    /// How the stream of frames ended; `None` while it is open.
    ended: Option<Result<(), Status>>,
    context: Arc<CallContext>,
}

impl Frames {
    /// The next answer; `None` after the last.
    async fn next(&mut self) -> Option<Result<LocalizeStreamResponse, Status>> {
        while self.newest.is_none() && self.ended.is_none() {
            let next = self.incoming.message().await;
            self.receive(next);
        }
        // Frames that arrived in the meantime are newer.
        while self.ended.is_none()
            && let Some(next) = self.incoming.message().now_or_never()
        {
            self.receive(next);
        }
        let Some((frame, _memory)) = self.newest.take() else {
            return self.ended.replace(Ok(()))?.err().map(Err);
        };
        let skipped = std::mem::take(&mut self.skipped);
        let LocalizeStreamRequest { frame_number, frame } = frame;
        let (context, start) = (Arc::clone(&self.context), Instant::now());
        let charged = std::mem::replace(&mut self.charged, true);
        let mut working = std::pin::pin!(async move {
            // Each frame counts as one request of the key; the gate has charged the first.
            if charged {
                context.service.keys.limits.take_extra_request(&context.caller).await?;
            }
            context.localize(frame.unwrap_or_default()).await
        });
        let answer = loop {
            tokio::select! {
                answer = &mut working => break answer,
                next = self.incoming.message(), if self.ended.is_none() => self.receive(next),
            }
        };
        let metrics = &self.context.metrics;
        let outcome = match answer {
            Ok(answer) => {
                metrics.frame_of_stream(start.elapsed());
                Outcome::Answer(answer)
            }
            Err(error) => Outcome::Problem(convert::problem(error)),
        };
        let outcome = Some(outcome);
        Some(Ok(LocalizeStreamResponse { frame_number, skipped, outcome }))
    }

    fn receive(&mut self, next: Result<Option<LocalizeStreamRequest>, Status>) {
        match next {
            Ok(Some(frame)) => {
                let replaced = self.newest.replace((frame, self.context.budget.take())).is_some();
                self.skipped += u32::from(replaced);
            }
            Ok(None) => self.ended = Some(Ok(())),
            Err(status) => self.ended = Some(Err(status)),
        }
    }
}
