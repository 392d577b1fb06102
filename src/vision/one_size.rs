//! Graphs that take pictures of one size only, whether they say so or not.
//!
//! Exporters of vision transformers often fix the position embedding at the size of the picture that they traced. Some
//! declare that size, others that any is taken.

use std::sync::Arc;

use ort::value::ValueType;

use super::execution::Execution;
use super::manifest::{Manifest, Resize};
use super::preprocess::Tensor;
use super::session::{Model, Runner};

/// Sizes at which vision transformers are usually exported, to be tried with graphs that declare none.
const USUAL: [u32; 6] = [224, 518, 336, 256, 384, 448];

/// The model takes another size of pictures than the manifest or a setting says.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the graph takes pictures of {width}×{height} pixels only{}, but {model:?} is to get {}×{}; set input.width = {width} \
     and input.height = {height} in its manifest, or model.sizes = [\"{model}={width}x{height}\"], or export the model \
     for any size, as deploy/models/export_dinov2.py does",
    if *is_declared { "" } else { ", although it declares any size: its exporter fixed the position embedding" },
    wanted[0],
    wanted[1]
)]
pub struct OneSize {
    /// Name of the model.
    pub model: String,
    /// Width that the graph takes.
    pub width: u32,
    /// Height that the graph takes.
    pub height: u32,
    /// Width and height that the graph was to get.
    pub wanted: [u32; 2],
    /// Whether the graph declares its size.
    pub is_declared: bool,
}

impl OneSize {
    /// Finds out why a model does not run: the one size at which it does, if there is one other than that of its manifest.
    pub(super) fn of(model: &Model) -> Option<Self> {
        let input = &model.manifest.input;
        let wanted = [input.width, input.height];
        let found = |[width, height]: [u32; 2], is_declared| Self {
            model: model.manifest.name.clone(),
            width,
            height,
            wanted,
            is_declared,
        };
        let mut manifest = Manifest::clone(&model.manifest);
        // A session that is not bound to a size.
        manifest.input.resize = Resize::LongestEdge;
        let unbound = Model { manifest: Arc::new(manifest), ..model.clone() };
        let mut runner = unbound.load(Execution::REFERENCE, 1, 1).ok()?;
        if let Some(declared) = declared(&runner, &input.name) {
            return (declared != wanted).then(|| found(declared, true));
        }
        let mut runs = |[width, height]: [u32; 2]| {
            runner.run(&[&Tensor::grey(width as usize, height as usize)]).is_ok()
        };
        if runs(wanted) {
            // It fails for another reason.
            return None;
        }
        let mut usual = USUAL.into_iter().filter(|edge| edge % input.multiple == 0);
        let edge = usual.find(|&edge| runs([edge, edge]))?;
        Some(found([edge, edge], false))
    }
}

/// Width and height of the pictures that a graph declares, if both are fixed.
fn declared(runner: &Runner, input: &str) -> Option<[u32; 2]> {
    let (inputs, _) = runner.interface();
    let ValueType::Tensor { shape, .. } =
        inputs.iter().find(|outlet| outlet.name() == input)?.dtype()
    else {
        return None;
    };
    let &[_, _, height, width] = &shape[..] else { return None };
    let edge = |edge: i64| u32::try_from(edge).ok().filter(|edge| *edge > 0);
    Some([edge(width)?, edge(height)?])
}
