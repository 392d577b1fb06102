//! The calls there are, and what the guards have to know of each.

use whereabouts_core::Role;

/// A call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Call {
    /// Its path.
    pub path: &'static str,
    /// Who may make it; `None` for everybody.
    pub role: Option<Role>,
    /// Whether messages stream one way or both, so that it may take any time.
    pub streams: bool,
    /// Whether its messages have pictures in them.
    pub pictures: bool,
    /// Whether many of its messages are worked on at a time.
    pub many: bool,
    /// Whether it may wait for a job.
    pub waits: bool,
    /// Whether it changes something that the audit log tells of.
    pub changes: bool,
}

/// A call that robots may make: one small message, answered by one.
const fn robot(path: &'static str) -> Call {
    Call {
        path,
        role: Some(Role::Robot),
        streams: false,
        pictures: false,
        many: false,
        waits: false,
        changes: false,
    }
}

const fn operator(path: &'static str) -> Call {
    Call { role: Some(Role::Operator), ..robot(path) }
}

const fn admin(path: &'static str) -> Call {
    Call { role: Some(Role::Admin), changes: true, ..robot(path) }
}

/// All calls but those of reflection, which are `REFLECTION` and `REFLECTION_ALPHA`.
pub const CALLS: &[Call] = &[
    Call { pictures: true, waits: true, ..robot("/whereabouts.v1.LocalizationService/Localize") },
    Call {
        streams: true,
        pictures: true,
        ..robot("/whereabouts.v1.LocalizationService/LocalizeStream")
    },
    robot("/whereabouts.v1.MapService/ListMaps"),
    robot("/whereabouts.v1.MapService/GetMap"),
    admin("/whereabouts.v1.MapService/PutMap"),
    admin("/whereabouts.v1.MapService/DeleteMap"),
    Call {
        streams: true,
        pictures: true,
        many: true,
        changes: true,
        ..operator("/whereabouts.v1.MapService/AddImages")
    },
    Call { waits: true, ..robot("/whereabouts.v1.JobService/GetJob") },
    Call { streams: true, ..robot("/whereabouts.v1.JobService/WatchJob") },
    operator("/whereabouts.v1.JobService/ListJobs"),
    Call { changes: true, ..operator("/whereabouts.v1.JobService/CancelJob") },
    Call { changes: true, ..operator("/whereabouts.v1.JobService/RetryJob") },
    Call { role: None, ..robot(HEALTH_CHECK) },
    // It holds a stream, of which there are only so many.
    Call { streams: true, ..robot("/grpc.health.v1.Health/Watch") },
];

/// What a load balancer asks, of an overloaded server too.
pub const HEALTH_CHECK: &str = "/grpc.health.v1.Health/Check";

pub(super) const REFLECTION: &str = "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo";
pub(super) const REFLECTION_ALPHA: &str =
    "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo";

/// The call of a path, if it is one.
pub fn call(path: &str) -> Option<Call> {
    if [REFLECTION, REFLECTION_ALPHA].contains(&path) {
        return Some(Call { streams: true, ..robot(REFLECTION) });
    }
    CALLS.iter().find(|call| call.path == path).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use prost::Message;
    use prost_types::FileDescriptorSet;

    #[test]
    fn every_method_of_the_contract_is_a_call_that_streams_as_it_says() {
        let mut methods = 0;
        for contract in [super::super::CONTRACT, tonic_health::pb::FILE_DESCRIPTOR_SET] {
            for file in FileDescriptorSet::decode(contract).unwrap().file {
                for service in &file.service {
                    for method in &service.method {
                        let path =
                            format!("/{}.{}/{}", file.package(), service.name(), method.name());
                        let streams = method.client_streaming() || method.server_streaming();
                        assert_eq!(call(&path).map(|call| call.streams), Some(streams), "{path}");
                        methods += 1;
                    }
                }
            }
        }
        assert_eq!(methods, CALLS.len());
    }
}
