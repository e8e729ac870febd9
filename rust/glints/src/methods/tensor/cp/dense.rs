//! Small dense matrices in double precision: what the normal equations and the initialisation need.

/// The inverse of a symmetric positive definite matrix, `matrix[row * n + column]`, by its Cholesky factor.
///
/// A row and column whose diagonal element is not positive is left out: its part of the inverse is zero.
pub fn inverse(matrix: &[f64], n: usize) -> Vec<f64> {
    let factor = cholesky(matrix, n);
    // The inverse of the lower triangle, by columns of the identity.
    let mut lower = vec![0.0; n * n];
    for column in 0..n {
        for row in column..n {
            let pivot = factor[row * n + row];
            if pivot > 0.0 {
                let known: f64 = (column..row)
                    .map(|k| factor[row * n + k] * lower[k * n + column])
                    .sum();
                let identity = if row == column { 1.0 } else { 0.0 };
                lower[row * n + column] = (identity - known) / pivot;
            }
        }
    }
    let mut inverse = vec![0.0; n * n];
    for k in 0..n {
        for row in 0..=k {
            let scale = lower[k * n + row];
            for column in 0..=k {
                inverse[row * n + column] += scale * lower[k * n + column];
            }
        }
    }
    inverse
}

/// The lower triangle L with `matrix = L L^T`; a pivot that rounding has eaten makes its row and column zero.
fn cholesky(matrix: &[f64], n: usize) -> Vec<f64> {
    let mut factor = vec![0.0; n * n];
    for row in 0..n {
        for column in 0..=row {
            let known: f64 = (0..column)
                .map(|k| factor[row * n + k] * factor[column * n + k])
                .sum();
            let rest = matrix[row * n + column] - known;
            factor[row * n + column] = if column < row {
                let pivot = factor[column * n + column];
                if pivot > 0.0 { rest / pivot } else { 0.0 }
            } else if rest > 1e-14 * matrix[row * n + row] {
                rest.sqrt()
            } else {
                0.0
            };
        }
    }
    factor
}

/// Orthonormal eigenvectors of a symmetric matrix, `[vector * n + element]`, largest eigenvalue first: Jacobi's method,
/// row by row (Golub and Van Loan, Matrix Computations, Section 8.5).
pub fn eigenvectors(mut matrix: Vec<f64>, n: usize) -> Vec<f64> {
    let mut vectors = vec![0.0; n * n];
    for k in 0..n {
        vectors[k * n + k] = 1.0;
    }
    let total: f64 = matrix.iter().map(|a| a * a).sum();
    // Converges quadratically: ten rounds are more than any matrix of a few dozen rows needs.
    for _ in 0..10 {
        let mut off_diagonal = 0.0;
        for p in 0..n {
            for q in p + 1..n {
                off_diagonal += matrix[p * n + q].powi(2);
                rotate(&mut matrix, &mut vectors, n, p, q);
            }
        }
        if off_diagonal <= 1e-20 * total {
            break;
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| matrix[b * n + b].total_cmp(&matrix[a * n + a]));
    order
        .iter()
        .flat_map(|&k| vectors[k * n..][..n].to_vec())
        .collect()
}

/// Makes element (p, q) zero.
fn rotate(matrix: &mut [f64], vectors: &mut [f64], n: usize, p: usize, q: usize) {
    let off = matrix[p * n + q];
    if off == 0.0 {
        return;
    }
    let tau = (matrix[q * n + q] - matrix[p * n + p]) / (2.0 * off);
    let tangent = tau.signum() / (tau.abs() + (1.0 + tau * tau).sqrt());
    let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
    let sine = tangent * cosine;
    let turn = |a: &mut [f64], first: usize, second: usize| {
        let (x, y) = (a[first], a[second]);
        a[first] = cosine * x - sine * y;
        a[second] = sine * x + cosine * y;
    };
    for k in 0..n {
        turn(matrix, k * n + p, k * n + q);
    }
    for k in 0..n {
        turn(matrix, p * n + k, q * n + k);
        turn(vectors, p * n + k, q * n + k);
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
        for n in [1, 4, 9] {
            let matrix = gram(n, 23);
            for (k, value) in product(&matrix, &inverse(&matrix, n), n).iter().enumerate() {
                let identity = if k / n == k % n { 1.0 } else { 0.0 };
                assert!((value - identity).abs() < 1e-9, "{value} at {k}");
            }
        }
    }

    #[test]
    fn inverse_of_singular_matrix_is_finite() {
        assert_eq!(inverse(&[0.0; 9], 3), [0.0; 9]);
        assert_eq!(inverse(&[1.0, 1.0, 1.0, 1.0], 2), [1.0, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn eigenvectors_diagonalise() {
        for (n, rows) in [(1, 3), (7, 23), (16, 5)] {
            let matrix = gram(n, rows);
            let vectors = eigenvectors(matrix.clone(), n);
            let transposed: Vec<f64> = (0..n * n).map(|e| vectors[e % n * n + e / n]).collect();
            let diagonal = product(&product(&vectors, &matrix, n), &transposed, n);
            for (k, value) in diagonal.iter().enumerate() {
                assert!(k / n == k % n || value.abs() < 1e-9, "{value} at {k}");
            }
            assert!((1..n).all(|k| diagonal[k * n + k] <= diagonal[(k - 1) * n + k - 1] + 1e-12));
        }
    }
}
