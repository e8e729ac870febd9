//! Vectors of a decomposition in eight bits.
//!
//! X and Y are rounded, each component to a largest value of 127, and Z is solved for again. From there on the atoms, products
//! of a component's rounded X and Y, are exact, and only Z remains to be fitted and rounded.
//!
//! **Fit** What counts of a pixel is `max(c, 0)`. Where c is below zero and the pixel is dark, T < [`DARK`] of the block's mean,
//! nothing is gained by lifting c: there c itself is taken for the pixel's value, and Z is solved for anew. The error of what
//! counts falls with every such step, since `max(c, 0)` is never further from a dark pixel than its new c is from the old one.
//!
//! **Rounding** The squared error of a row of Z is a quadratic form `d^T H d` of its deviation d from the best one. With `H = M^T
//! M`, M lower triangular, it is a sum of squares, the k-th of which has the deviations of components 0 to k only. So components
//! are rounded one after the other, each to the value that makes up best for those before it: the nearest plane of Babai (1986),
//! which turns errors of one component into those of others where they cancel.

use super::{BLOCK, PIXELS};

/// Largest magnitude of what is stored.
pub const LARGEST: f32 = 127.0;

/// Most a scale may be: with it, all products are finite.
pub const LARGEST_SCALE: f32 = 1e6;

/// Steps of the fit.
const STEPS: usize = 3;

/// Share of the mean of a block's pixels below which one is dark.
const DARK: f32 = 0.05;

/// Relative to the diagonal, so that components that are all but the same have a solution.
const LEAST_RIDGE: f64 = 1e-7;

/// A group in integers: component by component side by side.
pub struct Quantised {
    pub rank: usize,
    /// `C_r`, each the upper half of an f32.
    pub scales: Vec<u16>,
    /// 16 rows of Y, 16 of X.
    pub factors: Vec<i8>,
    /// L rows of Z.
    pub rows: Vec<i8>,
}

/// The upper half of an f32.
pub fn scale(bits: u16) -> f32 {
    f32::from_bits(u32::from(bits) << 16)
}

/// The least such number that is no less, for a value from zero on.
fn rounded_up(value: f32) -> u16 {
    let bits = value.min(LARGEST_SCALE).to_bits();
    ((bits + 0xffff) >> 16) as u16
}

/// `factors` are columns, rows and blocks as the solver has them, `values` the blocks, 256 pixels each.
pub fn quantise(factors: &[Vec<f32>; 3], rank: usize, values: &[f32], ridge: f64) -> Quantised {
    let [y, x] = [1, 0].map(|axis| integers(&factors[axis], rank));
    let atoms = atoms(&y, &x, rank);
    let h = Quadratic::new(&atoms, rank, ridge);
    let z = fit(&atoms, &h, values, rank);
    let peaks = (0..rank).map(|r| {
        let column = z[r..].iter().step_by(rank);
        column.fold(0.0_f32, |peak, value| peak.max(value.abs()))
    });
    let scales: Vec<u16> = peaks.map(|peak| rounded_up(peak / LARGEST)).collect();
    let mut rows = Vec::with_capacity(z.len());
    for row in z.chunks_exact(rank) {
        rows.extend(h.rounded(row, &scales));
    }
    Quantised {
        rank,
        scales,
        factors: [y, x].concat(),
        rows,
    }
}

impl Quantised {
    /// What counts of all pixels, row after row of Z.
    pub fn reconstructed(&self) -> Vec<f32> {
        let (y, x) = self.factors.split_at(BLOCK * self.rank);
        let atoms = atoms(y, x, self.rank);
        let scales: Vec<f32> = self.scales.iter().map(|&bits| scale(bits)).collect();
        let z: Vec<f32> = self
            .rows
            .chunks_exact(self.rank)
            .flat_map(|row| row.iter().zip(&scales).map(|(&z, scale)| f32::from(z) * scale))
            .collect();
        let mut values = products(&atoms, &z, self.rank);
        values.iter_mut().for_each(|value| *value = value.max(0.0));
        values
    }
}

fn integers(factor: &[f32], rank: usize) -> Vec<i8> {
    let mut values = vec![0; factor.len()];
    for r in 0..rank {
        let component = || factor[r..].iter().step_by(rank);
        let peak = component().fold(0.0_f32, |peak, v| peak.max(v.abs()));
        if peak > 0.0 {
            for (value, f) in values[r..].iter_mut().step_by(rank).zip(component()) {
                *value = (f / peak * LARGEST).round() as i8;
            }
        }
    }
    values
}

/// Products of rows and columns, one component after the other.
fn atoms(y: &[i8], x: &[i8], rank: usize) -> Vec<f32> {
    let at = |values: &[i8], i: usize, r: usize| f32::from(values[i * rank + r]);
    (0..rank)
        .flat_map(|r| (0..PIXELS).map(move |pixel| at(y, pixel / BLOCK, r) * at(x, pixel % BLOCK, r)))
        .collect()
}

/// `sum_r z_r atom_r` of every row of `z`.
fn products(atoms: &[f32], z: &[f32], rank: usize) -> Vec<f32> {
    let mut values = vec![0.0; z.len() / rank * PIXELS];
    for (values, row) in values.chunks_exact_mut(PIXELS).zip(z.chunks_exact(rank)) {
        for (atom, &z) in atoms.chunks_exact(PIXELS).zip(row) {
            values.iter_mut().zip(atom).for_each(|(v, a)| *v += z * a);
        }
    }
    values
}

/// Z that fits what counts.
fn fit(atoms: &[f32], h: &Quadratic, values: &[f32], rank: usize) -> Vec<f32> {
    let mut z = h.solve(atoms, values);
    for _ in 0..STEPS {
        let mut goal = products(atoms, &z, rank);
        for (goal, values) in goal.chunks_exact_mut(PIXELS).zip(values.chunks_exact(PIXELS)) {
            let dark = DARK / PIXELS as f32 * values.iter().sum::<f32>();
            for (goal, &value) in goal.iter_mut().zip(values) {
                if *goal > 0.0 || value > dark {
                    *goal = value;
                }
            }
        }
        z = h.solve(atoms, &goal);
    }
    z
}

/// The quadratic form of the atoms with a ridge: `M^T M`.
struct Quadratic {
    n: usize,
    /// Lower triangular, `m[row * n + column]`; a component that is no other than those behind it has a row of zeros.
    m: Vec<f64>,
}

impl Quadratic {
    fn new(atoms: &[f32], n: usize, ridge: f64) -> Self {
        let mut h = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..=a {
                let pairs = atoms[a * PIXELS..][..PIXELS]
                    .iter()
                    .zip(&atoms[b * PIXELS..][..PIXELS]);
                // Integers below 2^28, 256 of them: exact.
                let sum = pairs.map(|(&a, &b)| f64::from(a * b)).sum::<f64>();
                h[a * n + b] = sum;
                h[b * n + a] = sum;
            }
            h[a * n + a] *= 1.0 + ridge.max(LEAST_RIDGE);
        }
        // From the last component to the first: column k of M^T, and what is left of H.
        let mut m = vec![0.0; n * n];
        for k in (0..n).rev() {
            if h[k * n + k] <= 0.0 {
                continue;
            }
            let root = h[k * n + k].sqrt();
            for j in 0..=k {
                m[k * n + j] = h[k * n + j] / root;
            }
            for i in 0..k {
                for j in 0..k {
                    h[i * n + j] -= m[k * n + i] * m[k * n + j];
                }
            }
        }
        Self { n, m }
    }

    /// The best Z for pixels: `M^T M z = atoms values`, row by row.
    fn solve(&self, atoms: &[f32], values: &[f32]) -> Vec<f32> {
        let n = self.n;
        let mut solution = Vec::with_capacity(values.len() / PIXELS * n);
        let mut z = vec![0.0; n];
        for pixels in values.chunks_exact(PIXELS) {
            for (z, atom) in z.iter_mut().zip(atoms.chunks_exact(PIXELS)) {
                *z = dot(atom, pixels);
            }
            for k in (0..n).rev() {
                let row = &self.m[k * n..][..=k];
                z[k] = if row[k] > 0.0 { z[k] / row[k] } else { 0.0 };
                let solved = z[k];
                z[..k].iter_mut().zip(row).for_each(|(z, m)| *z -= m * solved);
            }
            for k in 0..n {
                let row = &self.m[k * n..][..=k];
                let known: f64 = row[..k].iter().zip(&z).map(|(m, z)| m * z).sum();
                z[k] = if row[k] > 0.0 {
                    (z[k] - known) / row[k]
                } else {
                    0.0
                };
            }
            solution.extend(z.iter().map(|&z| z as f32));
        }
        solution
    }

    /// A row of Z in multiples of the scales.
    fn rounded(&self, z: &[f32], scales: &[u16]) -> Vec<i8> {
        let n = self.n;
        let mut deviations = vec![0.0; n];
        let mut integers = vec![0; n];
        for k in 0..n {
            let (row, step) = (&self.m[k * n..][..=k], f64::from(scale(scales[k])));
            if row[k] <= 0.0 || step <= 0.0 {
                continue;
            }
            let known: f64 = row[..k].iter().zip(&deviations).map(|(m, d)| m * d).sum();
            let wanted = f64::from(z[k]) - known / row[k];
            let largest = f64::from(LARGEST);
            let integer = (wanted / step).round().clamp(-largest, largest);
            deviations[k] = integer * step - f64::from(z[k]);
            integers[k] = integer as i8;
        }
        integers
    }
}

/// In eight partial sums, so that the compiler may use vectors.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0.0_f32; 8];
    for (a, b) in a.chunks_exact(8).zip(b.chunks_exact(8)) {
        for lane in 0..8 {
            sums[lane] = a[lane].mul_add(b[lane], sums[lane]);
        }
    }
    sums.iter().map(|&sum| f64::from(sum)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::tensor::tests::random;

    const RANK: usize = 11;
    const ROWS: usize = 9;

    /// Factors of a group, and its pixels with some that no factors have.
    fn group() -> ([Vec<f32>; 3], Vec<f32>) {
        let factor = |rows: usize, which: u64| -> Vec<f32> {
            let shape = |i: usize| random(i, which) - if which == 22 { 0.0 } else { 0.3 };
            (0..rows * RANK).map(shape).collect()
        };
        let factors = [factor(BLOCK, 20), factor(BLOCK, 21), factor(ROWS, 22)];
        let values = (0..ROWS * PIXELS)
            .map(|e| {
                let (z, y, x) = (e / PIXELS, e % PIXELS / BLOCK, e % BLOCK);
                let at = |axis: usize, i: usize, r: usize| factors[axis][i * RANK + r];
                let sum: f32 = (0..RANK).map(|r| at(0, x, r) * at(1, y, r) * at(2, z, r)).sum();
                (sum + 0.05 * random(e, 23)).max(0.0)
            })
            .collect();
        (factors, values)
    }

    fn squared_error(found: &[f32], expected: &[f32]) -> f64 {
        let pairs = found.iter().zip(expected);
        pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum()
    }

    /// Rounding alone, of factors as they are.
    fn plain(factors: &[Vec<f32>; 3]) -> Quantised {
        let mut scales = vec![1.0_f32; RANK];
        for factor in factors {
            for (r, scale) in scales.iter_mut().enumerate() {
                let column = factor[r..].iter().step_by(RANK);
                *scale *= column.fold(0.0_f32, |peak, v| peak.max(v.abs())) / LARGEST;
            }
        }
        Quantised {
            rank: RANK,
            scales: scales.into_iter().map(rounded_up).collect(),
            factors: [1, 0].map(|axis| integers(&factors[axis], RANK)).concat(),
            rows: integers(&factors[2], RANK),
        }
    }

    #[test]
    fn fitted_and_rounded_together_beats_rounding() {
        let (factors, values) = group();
        let fitted = quantise(&factors, RANK, &values, 1e-4).reconstructed();
        let plain = plain(&factors).reconstructed();
        let (ours, theirs) = (squared_error(&fitted, &values), squared_error(&plain, &values));
        assert!(ours < 0.5 * theirs, "{ours} against {theirs}");
    }

    #[test]
    fn the_form_is_that_of_the_atoms() {
        let (factors, values) = group();
        let [y, x] = [1, 0].map(|axis| integers(&factors[axis], RANK));
        let atoms = atoms(&y, &x, RANK);
        let form = Quadratic::new(&atoms, RANK, 0.0);
        // Residuals of the best Z are orthogonal to all atoms.
        let residual: Vec<f32> = products(&atoms, &form.solve(&atoms, &values), RANK)
            .iter()
            .zip(&values)
            .map(|(a, b)| a - b)
            .collect();
        for pixels in residual.chunks_exact(PIXELS) {
            for atom in atoms.chunks_exact(PIXELS) {
                let norms = dot(atom, atom).sqrt() * dot(&values, &values).sqrt();
                assert!(dot(atom, pixels).abs() < 1e-4 * norms);
            }
        }
    }

    #[test]
    fn scales_are_rounded_up() {
        for value in [0.0, 1e-30, 0.1, 1.0, 1.5, 12_345.678, LARGEST_SCALE] {
            let stored = scale(rounded_up(value));
            assert!(value <= stored && stored <= value * 1.008, "{value}: {stored}");
        }
    }

    #[test]
    fn components_of_nothing_are_nothing() {
        let factors = [
            vec![0.0; BLOCK * RANK],
            vec![1.0; BLOCK * RANK],
            vec![1.0; ROWS * RANK],
        ];
        let quantised = quantise(&factors, RANK, &[0.5; ROWS * PIXELS], 0.0);
        assert!(quantised.reconstructed().iter().all(|&value| value == 0.0));
    }
}
