//! Dense features: the local feature map of one image.

/// The local feature map of one image: `height × width` cells of `channels` numbers each.
///
/// Cell `(row, col)` covers the part of the picture around
/// `((col + 0.5) / width, (row + 0.5) / height)` in fractions of the picture's edges. Each cell is
/// L2-normalised, so that the dot product of two cells is their cosine similarity.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseFeatures {
    height: usize,
    width: usize,
    channels: usize,
    /// Row-major, channels innermost: `height * width * channels` numbers.
    cells: Vec<f32>,
    /// The model's reliability of each cell, 0 to 1, if it outputs one: `height * width` numbers.
    reliability: Option<Vec<f32>>,
}

/// Why a buffer is not valid as [`DenseFeatures`].
#[derive(Debug, Clone, thiserror::Error, PartialEq, Eq)]
pub enum DenseFeaturesError {
    /// The buffer is empty or does not hold `height * width * channels` numbers.
    #[error("dense features of {height}×{width}×{channels} cannot hold {got} numbers")]
    Shape {
        /// Rows of cells.
        height: usize,
        /// Columns of cells.
        width: usize,
        /// Numbers in a cell.
        channels: usize,
        /// Numbers in the buffer.
        got: usize,
    },
    /// The reliability map does not hold one number per cell.
    #[error("a reliability map of {got} numbers does not fit {cells} cells")]
    Reliability {
        /// Cells of the feature map.
        cells: usize,
        /// Numbers in the buffer.
        got: usize,
    },
}

impl DenseFeatures {
    /// Builds a feature map from row-major cells, normalising each one. A cell that is zero or not
    /// finite has no direction: it is set to zero and matches nothing.
    pub fn new(
        height: usize,
        width: usize,
        channels: usize,
        mut cells: Vec<f32>,
        reliability: Option<Vec<f32>>,
    ) -> Result<Self, DenseFeaturesError> {
        let count = height * width;
        if count * channels == 0 || cells.len() != count * channels {
            let got = cells.len();
            return Err(DenseFeaturesError::Shape { height, width, channels, got });
        }
        if let Some(map) = &reliability
            && map.len() != count
        {
            return Err(DenseFeaturesError::Reliability { cells: count, got: map.len() });
        }
        for cell in cells.chunks_exact_mut(channels) {
            let norm = cell.iter().map(|x| x * x).sum::<f32>().sqrt();
            if norm > 1e-12 && norm.is_finite() {
                cell.iter_mut().for_each(|x| *x /= norm);
            } else {
                cell.fill(0.0);
            }
        }
        Ok(Self { height, width, channels, cells, reliability })
    }

    /// Rows of cells.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Columns of cells.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Numbers in a cell.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Number of cells: `height × width`.
    pub fn len(&self) -> usize {
        self.height * self.width
    }

    /// Whether there are no cells; always false for a constructed value.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// All cells, row-major, channels innermost.
    pub fn cells(&self) -> &[f32] {
        &self.cells
    }

    /// The reliability of each cell, 0 to 1, if the model outputs one.
    pub fn reliability(&self) -> Option<&[f32]> {
        self.reliability.as_deref()
    }

    /// Heap memory used, in bytes.
    pub fn bytes(&self) -> usize {
        (self.cells.len() + self.reliability.as_ref().map_or(0, Vec::len)) * size_of::<f32>()
    }
}
