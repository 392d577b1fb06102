//! Reasons for which something is refused, as metrics name them.

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use whereabouts_telemetry::metrics::{Registry, register};
use whereabouts_vision::RejectReason;

/// Why a request, a part of one or a connection was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Rejection {
    /// As many pictures wait for a permit as may.
    Queue,
    /// A picture would have waited for too long, or has.
    Wait,
    /// The answer would come after the caller's deadline, or it passed meanwhile.
    Deadline,
    /// A frame was answered without a job.
    Jobs,
    /// As many requests are in progress as may be.
    Requests,
    /// Bodies take as much memory as they may.
    Bodies,
    /// A head or a body came too slowly.
    Slow,
    /// As many connections are open as may be.
    Connections,
}

impl Rejection {
    /// Its label.
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
    fn from(refusal: RejectReason) -> Self {
        match refusal {
            RejectReason::QueueFull => Self::Queue,
            RejectReason::WaitTooLong => Self::Wait,
            RejectReason::DeadlineTooSoon => Self::Deadline,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RefusedLabels {
    reason: &'static str,
}

/// The metric family of rejections, shared by the service and the server.
#[derive(Debug)]
pub struct Rejections(Family<RefusedLabels, Counter>);

impl Rejections {
    /// Registers the family.
    pub fn register(registry: &mut Registry) -> Self {
        Self(register(
            registry,
            "refused",
            "Requests, jobs and connections that were refused or broken off, by reason",
            Family::default(),
        ))
    }

    /// Counts one rejection.
    pub fn count(&self, reason: Rejection) {
        self.0.get_or_create(&RefusedLabels { reason: reason.as_str() }).inc();
    }
}
