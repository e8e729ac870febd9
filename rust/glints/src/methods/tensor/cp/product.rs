//! The one expensive step: products of the unfolded tensor with a thin matrix, six rows at a time in registers.

use wide::f32x8;

/// Rows that are computed together: six times two vectors of sums, two of the thin matrix and a value fit into the
/// sixteen registers of AVX2.
const ROWS: usize = 6;

/// A matrix in panels of six rows, column after column, filled up with zero rows.
pub struct Panels {
    rows: usize,
    columns: usize,
    values: Vec<[f32; ROWS]>,
}

impl Panels {
    /// `value(row, column)` is asked once for every element.
    pub fn new(rows: usize, columns: usize, value: impl Fn(usize, usize) -> f32) -> Self {
        let element = |row, column| if row < rows { value(row, column) } else { 0.0 };
        let mut values = Vec::with_capacity(rows.div_ceil(ROWS) * columns);
        for first in (0..rows).step_by(ROWS) {
            values.extend((0..columns).map(|column| std::array::from_fn(|row| element(first + row, column))));
        }
        Self {
            rows,
            columns,
            values,
        }
    }

    pub fn rows(&self) -> usize {
        self.rows
    }

    /// `result = self * thin`, both matrices with `width` vectors a row.
    pub fn multiply(&self, thin: &[f32x8], width: usize, result: &mut [f32x8]) {
        assert_eq!(thin.len(), self.columns * width);
        assert_eq!(result.len(), self.rows * width);
        if self.columns == 0 {
            return result.fill(f32x8::ZERO);
        }
        let panels = self.values.chunks_exact(self.columns);
        for (panel, result) in panels.zip(result.chunks_mut(ROWS * width)) {
            let mut first = 0;
            while first + 2 <= width {
                store(&sums::<2>(panel, thin, width, first), width, first, result);
                first += 2;
            }
            if first < width {
                store(&sums::<1>(panel, thin, width, first), width, first, result);
            }
        }
    }
}

/// A panel times the columns of `thin` from vector `first` on.
#[inline(always)]
fn sums<const N: usize>(
    panel: &[[f32; ROWS]],
    thin: &[f32x8],
    width: usize,
    first: usize,
) -> [[f32x8; N]; ROWS] {
    let mut sums = [[f32x8::ZERO; N]; ROWS];
    for (column, row) in panel.iter().zip(thin.chunks_exact(width)) {
        let row: &[f32x8; N] = row[first..first + N].try_into().expect("N vectors");
        for (sums, &value) in sums.iter_mut().zip(column) {
            let value = f32x8::splat(value);
            for (sum, &thin) in sums.iter_mut().zip(row) {
                *sum = value.mul_add(thin, *sum);
            }
        }
    }
    sums
}

fn store<const N: usize>(sums: &[[f32x8; N]; ROWS], width: usize, first: usize, result: &mut [f32x8]) {
    for (sums, result) in sums.iter().zip(result.chunks_exact_mut(width)) {
        result[first..first + N].copy_from_slice(sums);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_every_shape_are_right() {
        let value = |row: usize, column: usize| ((row * 7 + column * 3) % 11) as f32 - 4.0;
        for (rows, columns, width) in [(1, 1, 1), (5, 3, 2), (6, 4, 3), (13, 9, 4), (3, 0, 1)] {
            let thin: Vec<f32x8> = (0..columns * width)
                .map(|k| f32x8::new(std::array::from_fn(|lane| ((k * 8 + lane) % 13) as f32 - 6.0)))
                .collect();
            let mut result = vec![f32x8::splat(f32::NAN); rows * width];
            Panels::new(rows, columns, value).multiply(&thin, width, &mut result);
            for (k, result) in result.iter().enumerate() {
                let (row, vector) = (k / width, k % width);
                for (lane, &result) in result.to_array().iter().enumerate() {
                    let terms =
                        (0..columns).map(|c| value(row, c) * thin[c * width + vector].to_array()[lane]);
                    assert_eq!(result, terms.sum::<f32>());
                }
            }
        }
    }
}
