//! Reasons for rejections, and the metric that counts them. The server counts into it too.

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use whereabouts_telemetry::metrics::{Registry, register};
use whereabouts_vision::RejectReason;

/// Why a request, a job or a connection was rejected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Rejection {
    /// The admission queue is full.
    Queue,
    /// A picture waited too long for admission, or would have.
    Wait,
    /// The caller's deadline passed, or would have before the answer.
    Deadline,
    /// A frame was answered without a job.
    Jobs,
    /// Too many requests are in progress.
    Requests,
    /// The memory budget for bodies is used up.
    Bodies,
    /// A request head or body arrived too slowly.
    Slow,
    /// Too many connections are open.
    Connections,
}

impl Rejection {
    /// The value of the metric label.
    fn as_str(self) -> &'static str {
        match self {
            Self::Queue => "queue",
            Self::Wait => "wait",
            Self::Deadline => "deadline",
            Self::Jobs => "jobs",
            Self::Requests => "requests",
            Self::Bodies => "bodies",
            Self::Slow => "slow",
            Self::Connections => "connections",
        }
    }
}

impl From<RejectReason> for Rejection {
    fn from(reason: RejectReason) -> Self {
        match reason {
            RejectReason::QueueFull => Self::Queue,
            RejectReason::WaitTooLong => Self::Wait,
            RejectReason::DeadlineTooSoon => Self::Deadline,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RejectionLabels {
    reason: &'static str,
}

/// The metric family of rejections, shared by the service and the server.
#[derive(Debug)]
pub struct Rejections(Family<RejectionLabels, Counter>);

impl Rejections {
    /// Registers the family.
    pub fn register(registry: &mut Registry) -> Self {
        Self(register(
            registry,
            "refused",
            "Requests, jobs and connections that were rejected or aborted, by reason",
            Family::default(),
        ))
    }

    /// Counts one rejection.
    pub fn count(&self, reason: Rejection) {
        self.0.get_or_create(&RejectionLabels { reason: reason.as_str() }).inc();
    }
}
