//! Running one batch.

use super::{Pooled, Replies, Request};
use crate::pooling::Kinds;
use crate::preprocess::Tensor;
use crate::session::{InferenceError, Runner};

/// Runs a batch and pools its outputs.
pub(super) fn run(runner: &mut Runner, kinds: &Kinds, batch: Vec<Request>) -> Replies {
    let mut replies = Vec::with_capacity(batch.len());
    for group in group_by_shape(batch) {
        let tensors: Vec<&Tensor> = group.iter().map(|request| &request.tensor).collect();
        let batch = tensors.len();
        match runner.run(&tensors) {
            Ok(outputs) => {
                for (request, local) in group.into_iter().zip(outputs) {
                    let Request { spec, features, reply, .. } = request;
                    let pooled = local
                        .pool(&spec, features, kinds)
                        .map(|(descriptor, dense)| Pooled { descriptor, dense, batch });
                    replies.push((reply, pooled.map_err(InferenceError::from)));
                }
            }
            Err(error) => {
                let failed = group.into_iter().map(|request| request.reply);
                replies.extend(failed.map(|reply| (reply, Err(error.clone()))));
            }
        }
    }
    replies
}

/// Groups a batch by the shape of the tensors, because one run takes tensors of one shape.
fn group_by_shape(batch: Vec<Request>) -> Vec<Vec<Request>> {
    let mut groups: Vec<Vec<Request>> = Vec::new();
    for request in batch {
        let Tensor { height, width, .. } = request.tensor;
        let same_shape = |group: &&mut Vec<Request>| {
            group[0].tensor.height == height && group[0].tensor.width == width
        };
        match groups.iter_mut().find(same_shape) {
            Some(group) => group.push(request),
            None => groups.push(vec![request]),
        }
    }
    groups
}
