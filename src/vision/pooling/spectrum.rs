//! The leading eigenvectors of a symmetric matrix.

use whereabouts_core::dot;

use super::vlad::{add, norm};

/// Up to this many rows, all eigenvectors are computed.
const DIRECT: usize = 384;

/// Vectors that are iterated besides those that are wanted, so that the last of these converge too.
const SPARE: usize = 16;

/// Rounds of subspace iteration. What matters is the subspace, not each vector in it.
const ROUNDS: usize = 8;

/// Seed of [`sign`]. Another one would change every vocabulary that is fitted.
const SEED: u64 = 2 << 20;

/// Sweeps of the Jacobi method. It converges quadratically; ten are enough for any matrix of this size.
const SWEEPS: usize = 12;

/// Returns the `count` largest eigenvalues of a positive semi-definite matrix of `size` rows with their unit
/// eigenvectors, in descending order.
pub(super) fn leading(matrix: &[f32], size: usize, count: usize) -> Vec<(f64, Vec<f32>)> {
    if size <= DIRECT {
        let rows: Vec<f64> = matrix.iter().map(|&x| f64::from(x)).collect();
        let mut all = jacobi(rows, size);
        all.truncate(count);
        return all;
    }
    let mut vectors: Vec<Vec<f32>> = (0..(count + SPARE).min(size))
        .map(|k| (0..size).map(|row| sign(k, row)).collect())
        .collect();
    orthonormalise(&mut vectors);
    for _ in 0..ROUNDS {
        vectors = vectors.iter().map(|vector| times(matrix, vector)).collect();
        orthonormalise(&mut vectors);
    }
    // Rayleigh and Ritz: the eigenvectors within the subspace.
    let images: Vec<Vec<f32>> = vectors.iter().map(|vector| times(matrix, vector)).collect();
    let inner = vectors.iter().flat_map(|a| images.iter().map(|b| f64::from(dot(a, b))));
    let found = jacobi(inner.collect(), vectors.len());
    found
        .into_iter()
        .take(count)
        .map(|(value, shares)| {
            let mut vector = vec![0.0; size];
            shares.iter().zip(&vectors).for_each(|(&share, from)| add(&mut vector, from, share));
            (value, vector)
        })
        .collect()
}

/// 1 or -1, at random: the bit of an index pair after splitmix64, so that every machine gets the same.
pub(super) fn sign(a: usize, b: usize) -> f32 {
    let mut x = ((((a as u64) << 32) | b as u64) ^ SEED).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    if (x ^ (x >> 31)) & 1 == 0 { 1.0 } else { -1.0 }
}

/// Makes vectors orthonormal, each to those before it; twice, for the sake of rounding. One that depends on the others
/// becomes zero.
pub(super) fn orthonormalise(vectors: &mut [Vec<f32>]) {
    for at in 0..vectors.len() {
        let (before, rest) = vectors.split_at_mut(at);
        let Some(vector) = rest.first_mut() else { return };
        let original = norm(vector);
        for _ in 0..2 {
            for other in before.iter() {
                let share = dot(vector, other);
                add(vector, other, -share);
            }
        }
        let length = norm(vector);
        let scale = if length > 1e-6 * original { 1.0 / length } else { 0.0 };
        vector.iter_mut().for_each(|x| *x *= scale);
    }
}

fn times(matrix: &[f32], vector: &[f32]) -> Vec<f32> {
    matrix.chunks_exact(vector.len()).map(|row| dot(row, vector)).collect()
}

/// The cyclic Jacobi method (Golub and Van Loan, *Matrix Computations*, 8.5). Consumes a symmetric matrix.
fn jacobi(mut a: Vec<f64>, size: usize) -> Vec<(f64, Vec<f32>)> {
    // Row k is the eigenvector of the diagonal element k.
    let mut vectors = vec![0.0; size * size];
    (0..size).for_each(|k| vectors[k * size + k] = 1.0);
    let total: f64 = a.iter().map(|x| x * x).sum();
    for _ in 0..SWEEPS {
        let diagonal: f64 = (0..size).map(|k| a[k * size + k].powi(2)).sum();
        if total - diagonal <= 1e-14 * total {
            break;
        }
        for p in 0..size {
            for q in p + 1..size {
                let apq = a[p * size + q];
                if apq.abs() < 1e-300 {
                    continue;
                }
                let theta = (a[q * size + q] - a[p * size + p]) / (2.0 * apq);
                let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
                let t = if theta == 0.0 { 1.0 } else { t };
                let c = 1.0 / (t * t + 1.0).sqrt();
                rotate_rows(&mut a, size, p, q, c, t * c);
                // The columns, of which the rows are the mirror image.
                for k in 0..size {
                    let (x, y) = (a[k * size + p], a[k * size + q]);
                    a[k * size + p] = c * x - t * c * y;
                    a[k * size + q] = t * c * x + c * y;
                }
                rotate_rows(&mut vectors, size, p, q, c, t * c);
            }
        }
    }
    let mut order: Vec<usize> = (0..size).collect();
    order.sort_by(|&x, &y| a[y * size + y].total_cmp(&a[x * size + x]));
    let found = order.into_iter().map(|k| {
        let vector = vectors[k * size..(k + 1) * size].iter().map(|&x| x as f32).collect();
        (a[k * size + k], vector)
    });
    found.collect()
}

fn rotate_rows(rows: &mut [f64], size: usize, p: usize, q: usize, c: f64, s: f64) {
    let (before, after) = rows.split_at_mut(q * size);
    let (first, second) = (&mut before[p * size..(p + 1) * size], &mut after[..size]);
    for (x, y) in first.iter_mut().zip(second) {
        (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A positive semi-definite matrix with eigenvalues that fall by a tenth each.
    fn matrix(size: usize) -> (Vec<f32>, Vec<Vec<f32>>) {
        let unit = |k: usize, row: usize| if k == row { 1.0 } else { 0.0 };
        let mut axes: Vec<Vec<f32>> = (0..size)
            .map(|k| (0..size).map(|row| unit(k, row) + 0.1 * sign(k + 900, row)).collect())
            .collect();
        orthonormalise(&mut axes);
        let mut matrix = vec![0.0; size * size];
        for (k, axis) in axes.iter().enumerate() {
            let value = 0.9_f32.powi(k as i32);
            for (row, &x) in matrix.chunks_exact_mut(size).zip(axis) {
                add(row, axis, value * x);
            }
        }
        (matrix, axes)
    }

    #[test]
    fn the_largest_eigenvalues_are_found_in_small_and_in_large_matrices() {
        for size in [1, 2, 40, DIRECT + 16] {
            let (matrix, axes) = matrix(size);
            let found = leading(&matrix, size, 20);
            assert_eq!(found.len(), size.min(20));
            for (k, (value, vector)) in found.iter().enumerate() {
                let expected = 0.9_f64.powi(k as i32);
                assert!((value - expected).abs() < 1e-3, "{size}: {value} is not {expected}");
                let cosine = dot(vector, &axes[k]).abs();
                assert!(cosine > 0.99, "{size}: the vector {k} has a cosine of {cosine}");
            }
        }
    }

    #[test]
    fn a_matrix_of_zeros_has_eigenvalues_of_zero() {
        assert!(leading(&[0.0; 9], 3, 3).iter().all(|(value, _)| *value == 0.0));
    }

    #[test]
    fn vectors_that_depend_on_others_become_zero() {
        let mut vectors = vec![vec![3.0, 4.0], vec![6.0, 8.0], vec![1.0, 0.0]];
        orthonormalise(&mut vectors);
        assert_eq!(vectors[1], [0.0, 0.0]);
        assert!(
            (norm(&vectors[2]) - 1.0).abs() < 1e-6 && dot(&vectors[0], &vectors[2]).abs() < 1e-6
        );
    }
}
