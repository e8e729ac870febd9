//! Small dense matrices in double precision, n x n with n a multiple of eight: the normal equations.

use wide::f64x4;

/// Replaces a symmetric positive definite matrix, `matrix[row * n + column]`, by its inverse: Gauss-Jordan elimination with
/// pivots from the diagonal.
///
/// A row and column whose diagonal element is zero, or eaten by rounding, is left out: its part of the inverse is zero.
pub fn invert(matrix: &mut [f64], n: usize) {
    let smallest: Vec<f64> = (0..n).map(|k| 1e-14 * matrix[k * n + k]).collect();
    let mut left_out = Vec::new();
    let mut pivot_row = vec![0.0; n];
    for pivot in 0..n {
        let value = matrix[pivot * n + pivot];
        if value <= smallest[pivot] {
            left_out.push(pivot);
            continue;
        }
        pivot_row.copy_from_slice(&matrix[pivot * n..][..n]);
        pivot_row[pivot] = 1.0;
        for element in &mut pivot_row {
            *element /= value;
        }
        for row in matrix.chunks_exact_mut(n) {
            let scale = row[pivot];
            row[pivot] = 0.0;
            for (elements, pivots) in row.chunks_exact_mut(8).zip(pivot_row.chunks_exact(8)) {
                for (element, &pivot) in elements.iter_mut().zip(pivots) {
                    *element -= scale * pivot;
                }
            }
        }
        matrix[pivot * n..][..n].copy_from_slice(&pivot_row);
    }
    for k in left_out {
        for other in 0..n {
            matrix[k * n + other] = 0.0;
            matrix[other * n + k] = 0.0;
        }
    }
}

/// `result[row * n + r] = sum_k left(row, k) right[k * n + r]` for n a multiple of eight, where
/// `left(row, k) = left[row * steps[0] + k * steps[1]]`.
pub fn multiply(left: &[f64], steps: [usize; 2], right: &[f64], n: usize, result: &mut [f64]) {
    const ROWS: usize = 4;
    let rows = result.len() / n;
    for first in (0..rows).step_by(ROWS) {
        // Rows behind the last one repeat it.
        let starts: [usize; ROWS] = std::array::from_fn(|row| (first + row).min(rows - 1) * steps[0]);
        for column in (0..n).step_by(8) {
            let mut sums = [[f64x4::ZERO; 2]; ROWS];
            for (k, right) in right.chunks_exact(n).enumerate() {
                let right: &[f64; 8] = right[column..column + 8].try_into().expect("eight values");
                let right: [f64x4; 2] = bytemuck::cast(*right);
                for (sums, start) in sums.iter_mut().zip(starts) {
                    let left = f64x4::splat(left[start + k * steps[1]]);
                    sums[0] = left.mul_add(right[0], sums[0]);
                    sums[1] = left.mul_add(right[1], sums[1]);
                }
            }
            for (sums, row) in sums.iter().zip(first..rows) {
                result[row * n + column..][..8].copy_from_slice(bytemuck::cast_slice(sums));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gram(n: usize, rows: usize) -> Vec<f64> {
        let element = |row: usize, k: usize| ((row * 31 + k * 17) % 23) as f64 / 23.0 - 0.4;
        let dot = |a: usize, b: usize| (0..rows).map(|row| element(row, a) * element(row, b)).sum();
        (0..n * n).map(|k| dot(k / n, k % n)).collect()
    }

    fn product(a: &[f64], b: &[f64], n: usize) -> Vec<f64> {
        (0..n * n)
            .map(|e| (0..n).map(|k| a[e / n * n + k] * b[k * n + e % n]).sum())
            .collect()
    }

    #[test]
    fn inverse_times_matrix_is_identity() {
        for n in [8, 16, 32] {
            let mut matrix = gram(n, 97);
            (0..n).for_each(|k| matrix[k * n + k] += 1.0);
            let mut inverse = matrix.clone();
            invert(&mut inverse, n);
            for (k, value) in product(&matrix, &inverse, n).iter().enumerate() {
                let identity = if k / n == k % n { 1.0 } else { 0.0 };
                assert!((value - identity).abs() < 1e-9, "{value} at {k}");
            }
        }
    }

    #[test]
    fn inverse_of_singular_matrix_is_finite() {
        let mut zero = [0.0; 64];
        invert(&mut zero, 8);
        assert_eq!(zero, [0.0; 64]);
        let mut ones = [1.0; 64];
        invert(&mut ones, 8);
        let mut expected = [0.0; 64];
        expected[0] = 1.0;
        assert_eq!(ones, expected);
    }

    #[test]
    fn products_of_every_shape_are_right() {
        for (rows, inner, n) in [(1, 1, 8), (4, 3, 16), (7, 0, 8), (9, 5, 24)] {
            let left: Vec<f64> = (0..rows * inner).map(|k| (k * 7 % 11) as f64 - 5.0).collect();
            let right: Vec<f64> = (0..inner * n).map(|k| (k * 5 % 13) as f64 - 6.0).collect();
            for steps in [[inner, 1], [1, rows]] {
                let mut result = vec![f64::NAN; rows * n];
                multiply(&left, steps, &right, n, &mut result);
                for (e, value) in result.iter().enumerate() {
                    let term = |k: usize| left[e / n * steps[0] + k * steps[1]] * right[k * n + e % n];
                    assert_eq!(*value, (0..inner).map(term).sum::<f64>());
                }
            }
        }
    }
}
