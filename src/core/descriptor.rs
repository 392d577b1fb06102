//! Global descriptors: one unit vector per picture.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use multiversion::multiversion;
use serde::{Deserialize, Serialize};

/// The global descriptor of one picture: finite numbers of unit Euclidean norm.
///
/// The dot product of two descriptors is their cosine similarity, −1 to 1.
///
/// Serialized as base64 of its numbers in little-endian order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Descriptor(Vec<f32>);

/// Why a vector is not valid as a [`Descriptor`].
#[derive(Debug, Clone, thiserror::Error, PartialEq, Eq)]
pub enum DescriptorError {
    /// The vector is empty or all zeros, so it has no direction.
    #[error("the descriptor is all zeros: the model found no features in the picture")]
    Zero,
    /// An element is infinite or NaN.
    #[error("the descriptor contains a number that is not finite")]
    NotFinite,
    /// The string is not base64 of 32-bit floats.
    #[error("the text is not base64 of 32-bit floats")]
    Unreadable,
}

impl Descriptor {
    /// Scales `numbers` to unit norm.
    pub fn normalised(mut numbers: Vec<f32>) -> Result<Self, DescriptorError> {
        let norm = norm(&numbers);
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

    /// Restores a stored descriptor. If it has unit norm, its bits are kept unchanged.
    pub fn stored(numbers: Vec<f32>) -> Result<Self, DescriptorError> {
        let is_unit = (norm(&numbers) - 1.0).abs() < 1e-4;
        if is_unit { Ok(Self(numbers)) } else { Self::normalised(numbers) }
    }

    /// Cosine similarity to another descriptor of the same dimension, −1 to 1.
    pub fn similarity(&self, other: &Self) -> f32 {
        dot(&self.0, &other.0)
    }

    /// Number of dimensions.
    pub fn dim(&self) -> usize {
        self.0.len()
    }

    /// The elements of the vector.
    pub fn as_slice(&self) -> &[f32] {
        &self.0
    }
}

/// The Euclidean norm, summed in f64 so that a stored descriptor has norm 1 to within f32 rounding.
fn norm(numbers: &[f32]) -> f64 {
    numbers.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt()
}

/// The dot product, accumulated in 16 lanes that the compiler can keep in vector registers.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0.0_f32; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    // Indices, because iterator adapters are not always inlined into a multiversioned function.
    for chunk in 0..a.len().min(b.len()) {
        let (x, y) = (&a[chunk], &b[chunk]);
        for lane in 0..LANES {
            sums[lane] += x[lane] * y[lane];
        }
    }
    let mut sum: f32 = sums.iter().sum();
    for index in 0..a_rest.len().min(b_rest.len()) {
        sum += a_rest[index] * b_rest[index];
    }
    sum
}

impl From<Descriptor> for String {
    fn from(descriptor: Descriptor) -> Self {
        let bytes: Vec<u8> = descriptor.0.iter().flat_map(|number| number.to_le_bytes()).collect();
        STANDARD.encode(bytes)
    }
}

impl TryFrom<String> for Descriptor {
    type Error = DescriptorError;

    fn try_from(text: String) -> Result<Self, DescriptorError> {
        let bytes = STANDARD.decode(text).map_err(|_| DescriptorError::Unreadable)?;
        let (numbers, rest) = bytes.as_chunks::<4>();
        if !rest.is_empty() {
            return Err(DescriptorError::Unreadable);
        }
        Self::stored(numbers.iter().copied().map(f32::from_le_bytes).collect())
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
    fn a_descriptor_round_trips_through_json() {
        let descriptor = Descriptor::normalised(vec![3.0, -4.0, 12.0]).unwrap();
        let read: Descriptor =
            serde_json::from_str(&serde_json::to_string(&descriptor).unwrap()).unwrap();
        assert_eq!(read, descriptor);
        let scaled: Descriptor =
            STANDARD.encode([6_f32.to_le_bytes()].concat()).try_into().unwrap();
        assert_eq!(scaled.as_slice(), [1.0]);
        for text in ["\"AAAA\"", "\"not base64\"", "\"\""] {
            assert!(serde_json::from_str::<Descriptor>(text).is_err(), "{text}");
        }
    }

    #[test]
    fn vectors_without_a_direction_are_rejected() {
        assert_eq!(Descriptor::normalised(vec![]), Err(DescriptorError::Zero));
        assert_eq!(Descriptor::normalised(vec![0.0; 4]), Err(DescriptorError::Zero));
        assert_eq!(Descriptor::normalised(vec![f32::NAN]), Err(DescriptorError::NotFinite));
        assert_eq!(Descriptor::normalised(vec![f32::INFINITY]), Err(DescriptorError::NotFinite));
    }

    #[test]
    fn the_dot_product_handles_any_length() {
        for length in [0, 1, 15, 16, 17, 576] {
            let a: Vec<f32> = (0..length).map(|i| i as f32 % 7.0).collect();
            let expected: f32 = a.iter().map(|x| x * x).sum();
            assert_eq!(dot(&a, &a), expected);
        }
    }
}
