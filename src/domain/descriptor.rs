//! Global descriptors: one unit vector for one picture.

/// The global descriptor of one picture: finite numbers of unit Euclidean norm.
///
/// The dot product of two descriptors is their cosine similarity, −1 to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Descriptor(Vec<f32>);

/// Why numbers could not become a [`Descriptor`].
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum DescriptorError {
    /// All numbers are zero, or there is none, so that no direction is left.
    #[error("the descriptor is all zeros: the picture gave the model nothing to see")]
    Zero,
    /// A number is infinite or not a number.
    #[error("the descriptor holds a number that is not finite")]
    NotFinite,
}

impl Descriptor {
    /// Scales `numbers` to unit norm.
    pub fn normalised(mut numbers: Vec<f32>) -> Result<Self, DescriptorError> {
        // Summed in f64, so that the norm of a stored descriptor is 1 to within f32 rounding.
        let norm = numbers.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
        if !norm.is_finite() {
            return Err(DescriptorError::NotFinite);
        }
        if norm < 1e-12 {
            return Err(DescriptorError::Zero);
        }
        let scale = (1.0 / norm) as f32;
        numbers.iter_mut().for_each(|x| *x *= scale);
        Ok(Self(numbers))
    }

    /// How many numbers it has.
    pub fn dim(&self) -> usize {
        self.0.len()
    }

    /// The numbers.
    pub fn as_slice(&self) -> &[f32] {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_descriptor_has_unit_norm() {
        let descriptor = Descriptor::normalised(vec![3.0, 4.0]).unwrap();
        assert_eq!(descriptor.as_slice(), [0.6, 0.8]);
    }

    #[test]
    fn numbers_without_a_direction_are_refused() {
        assert_eq!(Descriptor::normalised(vec![]), Err(DescriptorError::Zero));
        assert_eq!(Descriptor::normalised(vec![0.0; 4]), Err(DescriptorError::Zero));
        assert_eq!(Descriptor::normalised(vec![f32::NAN]), Err(DescriptorError::NotFinite));
        assert_eq!(Descriptor::normalised(vec![f32::INFINITY]), Err(DescriptorError::NotFinite));
    }
}
