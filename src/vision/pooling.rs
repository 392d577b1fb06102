//! Local features to a global descriptor: `[CLS]` or generalised-mean pooling.

use super::manifest::{Layout, Output, Pooling};
use whereabouts_core::dense::DenseFeaturesError;
use whereabouts_core::{DenseFeatures, Descriptor, DescriptorError, DescriptorKind};

/// What a model says about one picture, before any normalisation.
#[derive(Debug, Clone, PartialEq)]
pub struct LocalFeatures {
    /// Rows of cells.
    pub height: usize,
    /// Columns of cells.
    pub width: usize,
    /// Numbers for each cell.
    pub channels: usize,
    /// Row-major cells, channels innermost.
    pub cells: Vec<f32>,
    /// The `[CLS]` token, where the model has one.
    pub cls: Option<Vec<f32>>,
    /// How far the model trusts each cell, 0 to 1.
    pub reliability: Option<Vec<f32>>,
}

/// Why an output could not be pooled.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum PoolingError {
    /// The output does not have the shape that the manifest promises.
    #[error("the model's output holds {got} numbers where its manifest promises {expected}")]
    Shape {
        /// Numbers in the output.
        got: usize,
        /// Numbers by the manifest.
        expected: usize,
    },
    /// The model has no `[CLS]` token.
    #[error("this model has no [CLS] token; use a map with \"descriptor\": \"gem\"")]
    NoCls,
    /// The output has no direction.
    #[error(transparent)]
    Descriptor(#[from] DescriptorError),
    /// The output is no feature map.
    #[error(transparent)]
    Dense(#[from] DenseFeaturesError),
}

impl LocalFeatures {
    /// Reads one picture's part of the output tensor, for an input of `height` × `width` cells.
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

    /// The global descriptor of the given kind.
    pub fn descriptor(
        &self,
        kind: DescriptorKind,
        pooling: &Pooling,
    ) -> Result<Descriptor, PoolingError> {
        let numbers = match kind {
            DescriptorKind::Cls => self.cls.clone().ok_or(PoolingError::NoCls)?,
            DescriptorKind::Gem => self.gem(pooling),
        };
        Ok(Descriptor::normalised(numbers)?)
    }

    /// The dense features, each cell normalised.
    pub fn into_dense(self) -> Result<DenseFeatures, PoolingError> {
        let Self { height, width, channels, cells, reliability, .. } = self;
        Ok(DenseFeatures::new(height, width, channels, cells, reliability)?)
    }

    /// Signed generalised mean over each part of the grid, part by part, row by row.
    ///
    /// m = mean(sign(x)·|x|ᵖ), g = sign(m)·|m|^(1/p): GeM (Radenović et al., 2018) as AnyLoc
    /// (Keetha et al., 2023) applies it to signed features.
    fn gem(&self, pooling: &Pooling) -> Vec<f32> {
        let [rows, columns] = pooling.grid;
        let mut numbers = Vec::with_capacity(self.channels * rows * columns);
        for row in 0..rows {
            let lines = row * self.height / rows..(row + 1) * self.height / rows;
            for column in 0..columns {
                let across = column * self.width / columns..(column + 1) * self.width / columns;
                numbers.extend(self.gem_of_part(lines.clone(), across, pooling.gem_p));
            }
        }
        numbers
    }

    fn gem_of_part(
        &self,
        lines: std::ops::Range<usize>,
        across: std::ops::Range<usize>,
        p: f32,
    ) -> Vec<f32> {
        let mut sums = vec![0.0_f32; self.channels];
        let count = (lines.len() * across.len()).max(1) as f32;
        for line in lines {
            let start = (line * self.width + across.start) * self.channels;
            let end = (line * self.width + across.end) * self.channels;
            for cell in self.cells[start..end].chunks_exact(self.channels) {
                for (sum, &x) in sums.iter_mut().zip(cell) {
                    // p is 3 in nearly every manifest, and a cube is far cheaper than a power.
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

fn transposed(planes: &[f32], channels: usize, cells: usize) -> Vec<f32> {
    let mut out = vec![0.0; planes.len()];
    for (channel, plane) in planes.chunks_exact(cells).enumerate() {
        for (cell, &value) in out.chunks_exact_mut(channels).zip(plane) {
            cell[channel] = value;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn the_grid_pools_each_part_on_its_own() {
        let cells: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let features = LocalFeatures::from_output(&map_output(1), (3, 4), &cells, None).unwrap();
        let numbers = features.gem(&pooling([3, 2], 1.0));
        assert_eq!(numbers, [0.5, 2.5, 4.5, 6.5, 8.5, 10.5]);
    }

    #[test]
    fn tokens_are_told_apart_from_cls_and_registers() {
        let output = Output { layout: Layout::Tokens, registers: 1, cls: true, ..map_output(2) };
        let tokens = [9.0, 0.0, 7.0, 7.0, 1.0, 1.0, 2.0, 2.0];
        let features = LocalFeatures::from_output(&output, (1, 2), &tokens, None).unwrap();
        assert_eq!(features.cells, [1.0, 1.0, 2.0, 2.0]);
        let cls = features.descriptor(DescriptorKind::Cls, &pooling([1, 1], 3.0)).unwrap();
        assert_eq!(cls.as_slice(), [1.0, 0.0]);
    }

    #[test]
    fn a_map_layout_comes_out_channels_innermost() {
        let features =
            LocalFeatures::from_output(&map_output(2), (1, 3), &[1., 2., 3., 10., 20., 30.], None)
                .unwrap();
        assert_eq!(features.cells, [1., 10., 2., 20., 3., 30.]);
        assert_eq!(
            features.descriptor(DescriptorKind::Cls, &pooling([1, 1], 3.0)),
            Err(PoolingError::NoCls)
        );
    }

    #[test]
    fn an_output_of_another_shape_is_refused() {
        let result = LocalFeatures::from_output(&map_output(2), (2, 2), &[0.0; 7], None);
        assert_eq!(result, Err(PoolingError::Shape { got: 7, expected: 8 }));
    }
}
