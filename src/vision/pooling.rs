//! Pooling of local features to a global descriptor: the `[CLS]` token, the generalised mean or VLAD.

mod kinds;
mod own;
mod spectrum;
mod vlad;

pub use self::kinds::{DescriptorSpec, Kinds, VocabularyError};
pub(crate) use self::own::OWN_BLOCK;
pub use self::own::OwnVocabulary;
pub use self::vlad::Vocabulary;
use super::manifest::{Layout, Output, Pooling};
use whereabouts_core::dense::DenseFeaturesError;
use whereabouts_core::{DenseFeatures, Descriptor, DescriptorError, DescriptorKind};

/// The output of a model for one picture, before any normalisation.
#[derive(Debug, Clone, PartialEq)]
pub struct LocalFeatures {
    /// Rows of cells.
    pub height: usize,
    /// Columns of cells.
    pub width: usize,
    /// Numbers in each cell.
    pub channels: usize,
    /// Row-major cells, channels innermost.
    pub cells: Vec<f32>,
    /// The `[CLS]` token, if the model has one.
    pub cls: Option<Vec<f32>>,
    /// The model's reliability of each cell, 0 to 1, if it outputs one.
    pub reliability: Option<Vec<f32>>,
}

/// What to compute from the local features of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FeatureSet {
    /// The global descriptor, which is enough to index or search.
    DescriptorOnly,
    /// The global descriptor and the dense features, which local refinement compares.
    DescriptorAndDense,
}

/// Why the output of a model cannot be pooled.
#[derive(Debug, Clone, thiserror::Error, PartialEq)]
pub enum PoolingError {
    /// The output does not have the shape declared in the manifest.
    #[error("the model's output has {got} numbers, but its manifest declares {expected}")]
    Shape {
        /// Numbers in the output.
        got: usize,
        /// Numbers declared in the manifest.
        expected: usize,
    },
    /// The model has no such kind of descriptor.
    #[error("this model has no descriptor {kind:?}; it has {declared}")]
    NoKind {
        /// The kind that was requested.
        kind: DescriptorKind,
        /// The kinds that the manifest declares.
        declared: String,
    },
    /// The descriptor has no direction.
    #[error(transparent)]
    Descriptor(#[from] DescriptorError),
    /// The output is not a valid feature map.
    #[error(transparent)]
    Dense(#[from] DenseFeaturesError),
}

impl LocalFeatures {
    /// Reads one picture's part of the output tensor, for a feature map of `height` × `width` cells.
    pub fn from_output(
        output: &Output,
        (height, width): (usize, usize),
        features: &[f32],
        reliability: Option<&[f32]>,
    ) -> Result<Self, PoolingError> {
        let (channels, cells) = (output.channels, height * width);
        let lead = usize::from(output.cls) + output.registers;
        let expected = (lead + cells) * channels;
        if features.len() != expected {
            return Err(PoolingError::Shape { got: features.len(), expected });
        }
        if let Some(map) = reliability
            && map.len() != cells
        {
            return Err(PoolingError::Shape { got: map.len(), expected: cells });
        }
        let (cls, cells) = match output.layout {
            Layout::Map => (None, transposed(features, channels, cells)),
            Layout::Tokens => (
                output.cls.then(|| features[..channels].to_vec()),
                features[lead * channels..].to_vec(),
            ),
        };
        let reliability = reliability.map(<[f32]>::to_vec);
        Ok(Self { height, width, channels, cells, cls, reliability })
    }

    /// Computes the global descriptor, and the dense features if requested.
    pub fn pool(
        self,
        spec: &DescriptorSpec,
        features: FeatureSet,
        kinds: &Kinds,
    ) -> Result<(Descriptor, Option<DenseFeatures>), PoolingError> {
        let descriptor = kinds.descriptor(spec, &self)?;
        let dense = match features {
            FeatureSet::DescriptorOnly => None,
            FeatureSet::DescriptorAndDense => Some(self.into_dense()?),
        };
        Ok((descriptor, dense))
    }

    /// Converts the local features to dense features, normalising each cell.
    pub fn into_dense(self) -> Result<DenseFeatures, PoolingError> {
        let Self { height, width, channels, cells, reliability, .. } = self;
        Ok(DenseFeatures::new(height, width, channels, cells, reliability)?)
    }

    /// Signed generalised mean over each part of the grid, in row-major order of the parts.
    ///
    /// m = mean(sign(x)·|x|ᵖ), g = sign(m)·|m|^(1/p): GeM (Radenović et al., 2018) as AnyLoc
    /// (Keetha et al., 2023) applies it to signed features.
    fn gem(&self, pooling: &Pooling) -> Vec<f32> {
        let [rows, columns] = pooling.grid;
        let mut numbers = Vec::with_capacity(self.channels * rows * columns);
        for row in 0..rows {
            let part_rows = row * self.height / rows..(row + 1) * self.height / rows;
            for column in 0..columns {
                let part_columns =
                    column * self.width / columns..(column + 1) * self.width / columns;
                numbers.extend(self.gem_of_part(part_rows.clone(), part_columns, pooling.gem_p));
            }
        }
        numbers
    }

    fn gem_of_part(
        &self,
        rows: std::ops::Range<usize>,
        columns: std::ops::Range<usize>,
        p: f32,
    ) -> Vec<f32> {
        let mut sums = vec![0.0_f32; self.channels];
        let count = (rows.len() * columns.len()).max(1) as f32;
        for row in rows {
            let start = (row * self.width + columns.start) * self.channels;
            let end = (row * self.width + columns.end) * self.channels;
            for cell in self.cells[start..end].chunks_exact(self.channels) {
                for (sum, &x) in sums.iter_mut().zip(cell) {
                    // Nearly every manifest has p = 3, and a cube is much cheaper than `powf`.
                    *sum += if p == 3.0 { x * x * x } else { x.signum() * x.abs().powf(p) };
                }
            }
        }
        sums.iter_mut().for_each(|sum| {
            let mean = *sum / count;
            *sum = mean.signum() * mean.abs().powf(1.0 / p);
        });
        sums
    }
}

/// Turns planes into cells, in blocks that stay in the processor's first cache.
fn transposed(planes: &[f32], channels: usize, cells: usize) -> Vec<f32> {
    const BLOCK: usize = 64;
    let mut out = vec![0.0; planes.len()];
    for first in (0..cells).step_by(BLOCK) {
        let end = (first + BLOCK).min(cells);
        let block = &mut out[first * channels..end * channels];
        for (channel, plane) in planes.chunks_exact(cells).enumerate() {
            for (cell, &value) in block.chunks_exact_mut(channels).zip(&plane[first..end]) {
                cell[channel] = value;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::Manifest;

    fn map_output(channels: usize) -> Output {
        Output {
            features: "features".into(),
            layout: Layout::Map,
            reliability: None,
            channels,
            stride: 8,
            registers: 0,
            cls: false,
        }
    }

    fn pooling(grid: [usize; 2], p: f32) -> Pooling {
        Pooling { gem_p: p, grid, dimension: 0 }
    }

    /// Those of the built-in model.
    fn kinds() -> Kinds {
        let text = include_str!("../../deploy/models/xfeat.toml");
        let manifest = Manifest::parse(text, Path::new("manifest.toml")).unwrap();
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/models");
        Kinds::load(&manifest, Path::new(folder)).unwrap()
    }

    #[test]
    fn signed_gem_keeps_the_sign_of_the_mean() {
        let features =
            LocalFeatures::from_output(&map_output(2), (1, 2), &[1.0, 3.0, -1.0, -3.0], None)
                .unwrap();
        let expected = ((1.0_f32 + 27.0) / 2.0).cbrt();
        let numbers = features.gem(&pooling([1, 1], 3.0));
        assert!((numbers[0] - expected).abs() < 1e-6 && (numbers[1] + expected).abs() < 1e-6);
        let odd_power = features.gem(&pooling([1, 1], 3.0 + 1e-6));
        assert!((numbers[0] - odd_power[0]).abs() < 1e-4);
    }

    #[test]
    fn each_part_of_the_grid_is_pooled_separately() {
        let cells: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let features = LocalFeatures::from_output(&map_output(1), (3, 4), &cells, None).unwrap();
        let numbers = features.gem(&pooling([3, 2], 1.0));
        assert_eq!(numbers, [0.5, 2.5, 4.5, 6.5, 8.5, 10.5]);
    }

    #[test]
    fn patch_tokens_exclude_cls_and_registers() {
        let output = Output { layout: Layout::Tokens, registers: 1, cls: true, ..map_output(2) };
        let tokens = [9.0, 0.0, 7.0, 7.0, 1.0, 1.0, 2.0, 2.0];
        let features = LocalFeatures::from_output(&output, (1, 2), &tokens, None).unwrap();
        assert_eq!(features.cells, [1.0, 1.0, 2.0, 2.0]);
        assert_eq!(features.cls, Some(vec![9.0, 0.0]));
    }

    #[test]
    fn a_map_layout_is_transposed_to_channels_innermost() {
        let features =
            LocalFeatures::from_output(&map_output(2), (1, 3), &[1., 2., 3., 10., 20., 30.], None)
                .unwrap();
        assert_eq!(features.cells, [1., 10., 2., 20., 3., 30.]);
    }

    #[test]
    fn a_kind_that_is_not_declared_is_refused_with_those_that_are() {
        let features =
            LocalFeatures::from_output(&map_output(64), (1, 1), &[1.0; 64], None).unwrap();
        let error =
            kinds().descriptor(&DescriptorKind::CLS.into(), &features).unwrap_err().to_string();
        assert!(error.starts_with("this model has no descriptor \"cls\"; it has gem"), "{error}");
    }

    #[test]
    fn dense_features_are_made_only_on_request_and_do_not_change_the_descriptor() {
        let cells: Vec<f32> = (1..=64 * 9).map(|i| i as f32).collect();
        let features = LocalFeatures::from_output(&map_output(64), (3, 3), &cells, None).unwrap();
        let pool = |set| features.clone().pool(&DescriptorKind::GEM.into(), set, &kinds());
        let (descriptor, none) = pool(FeatureSet::DescriptorOnly).unwrap();
        let (same, dense) = pool(FeatureSet::DescriptorAndDense).unwrap();
        assert_eq!((descriptor, none), (same, None));
        assert_eq!(dense.unwrap(), features.into_dense().unwrap());
    }

    #[test]
    fn an_output_of_the_wrong_shape_is_rejected() {
        let result = LocalFeatures::from_output(&map_output(2), (2, 2), &[0.0; 7], None);
        assert_eq!(result, Err(PoolingError::Shape { got: 7, expected: 8 }));
    }
}
