//! Canonical polyadic decomposition (CPD, CANDECOMP/PARAFAC) of small tensors by alternating least squares.
//!
//! A tensor T of I x J x K values is approximated by R products of three vectors (Deng et al. 2022, Eq. 5; Kolda and
//! Bader, "Tensor Decompositions and Applications", 2009, Section 3):
//!
//! ```text
//! T_ijk ~ sum_r X_ir Y_jr Z_kr
//! ```
//!
//! Minimised is the squared error plus a ridge, in units of the squared norm of T,
//!
//! ```text
//! F = |T - T'|^2 / |T|^2 + ridge * sum_r |x_r|^2 |y_r|^2 |z_r|^2 / |T|^2
//! ```
//!
//! The ridge does not depend on how a component's weight is spread over its three vectors. It bounds components that
//! grow while they cancel each other, as happens where no best approximation exists (de Silva and Lim, 2008): their
//! squared norms sum up to at most `|T|^2 / ridge`. It is also the expected error of storage: vectors that are rounded
//! with relative errors of variance v cost `3 v sum_r |x_r|^2 |y_r|^2 |z_r|^2`.
//!
//! **A sweep** solves for Z, X and Y in turn, each a linear least squares problem with the R x R normal equations
//!
//! ```text
//! Z (G + ridge diag G) = T_(3) (Y . X),   G = X^T X * Y^T Y,   . by columns (Khatri-Rao), * by elements
//! ```
//!
//! The right-hand side is the expensive part. T, stored as a matrix of K x (I J), is multiplied twice in a sweep, with
//! I J x R for Z, and transposed with K x R for what X and Y share: `M_(ij)r = sum_k T_ijk Z_kr`, from which theirs
//! follow by sums over j or i. So let the third mode be the long one. Right-hand sides are computed in single
//! precision, normal equations in double. The error follows from the same products, but as a difference of nearly equal
//! numbers when it is small; then, and at the end, it is computed from the residuals.

mod dense;
mod product;

use wide::f32x8;

use self::product::Panels;
use crate::hash;

/// Ridges are at least this: beyond a condition of its inverse, right-hand sides in single precision mean nothing.
const MIN_RIDGE: f64 = 1e-8;

/// Squared relative errors below this are computed from residuals.
const CANCELLATION: f64 = 1e-3;

/// A tensor, `values[(k * dims[1] + j) * dims[0] + i]`.
#[derive(Clone, Copy, Debug)]
pub struct Tensor<'a> {
    pub dims: [usize; 3],
    pub values: &'a [f32],
}

/// Where the iteration starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Initialisation {
    /// Numbers in [0, 1).
    Random,
    /// The singular vectors of the unfoldings (HOSVD; Kolda and Bader 2009, Section 3.4), then random ones.
    SingularVectors,
}

/// How a tensor is decomposed.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Number of components R.
    pub rank: usize,
    /// Relative error `|T - T'| / |T|` at which to stop.
    pub tolerance: f64,
    /// Most sweeps.
    pub max_iterations: usize,
    pub initialisation: Initialisation,
    /// Weight of the components' squared norms against the squared error, at least 1e-8.
    pub ridge: f64,
    /// Stops when ten sweeps together have reduced F by less than this part; 0: never.
    pub stall: f64,
    /// Seed of the random start.
    pub seed: u64,
}

impl Options {
    /// The setting of Deng et al. 2022, Section 4.2.
    pub fn published() -> Self {
        Self {
            rank: 16,
            tolerance: 1e-4,
            max_iterations: 500,
            initialisation: Initialisation::Random,
            ridge: 0.0,
            stall: 0.0,
            seed: 0,
        }
    }
}

impl Default for Options {
    fn default() -> Self {
        Self {
            initialisation: Initialisation::SingularVectors,
            ridge: 1e-6,
            stall: 1e-3,
            ..Self::published()
        }
    }
}

/// The sum of `rank` products of three vectors.
#[derive(Clone, Debug, PartialEq)]
pub struct Decomposition {
    pub rank: usize,
    /// `factors[mode][index * rank + component]`. Columns of the first two have unit norm or are zero, those of the
    /// third carry the weight.
    pub factors: [Vec<f32>; 3],
    /// `|T - T'| / |T|`, from the residuals; 0 for a zero tensor.
    pub relative_error: f64,
    /// Root of the sum of the components' squared norms over the tensor's norm. Large: components cancel each other.
    pub condition: f64,
    pub iterations: usize,
}

impl Decomposition {
    /// The approximation of one value.
    pub fn value(&self, [i, j, k]: [usize; 3]) -> f32 {
        let [x, y, z] = [(0, i), (1, j), (2, k)]
            .map(|(mode, row): (usize, usize)| &self.factors[mode][row * self.rank..][..self.rank]);
        x.iter().zip(y).zip(z).map(|((x, y), z)| x * y * z).sum()
    }
}

/// Decomposes `tensor`; the answer depends on nothing but the arguments.
///
/// Every finite tensor has an answer: a zero one zero factors, and where the rank is larger than the tensor's own, some
/// components may be zero.
///
/// # Panics
///
/// If the number of values is not the product of the dimensions, a value is not finite, or the rank is 0.
pub fn decompose(tensor: &Tensor, options: &Options) -> Decomposition {
    let [i, j, k] = tensor.dims;
    assert_eq!(
        tensor.values.len(),
        i * j * k,
        "the dimensions do not fit the values"
    );
    assert!(options.rank > 0, "a decomposition needs a component");
    let norm = tensor
        .values
        .iter()
        .map(|&v| f64::from(v).powi(2))
        .sum::<f64>()
        .sqrt();
    assert!(norm.is_finite(), "a tensor's values must be finite");
    if norm == 0.0 {
        return Decomposition {
            rank: options.rank,
            factors: tensor.dims.map(|rows| vec![0.0; rows * options.rank]),
            relative_error: 0.0,
            condition: 0.0,
            iterations: 0,
        };
    }
    Solver::new(tensor, norm, options).run(tensor, norm)
}

/// The lowest of `ranks`, which ascend, whose decomposition has a relative error of at most `target`, else the last.
///
/// # Panics
///
/// As [`decompose`], and if there is no rank.
pub fn decompose_to(tensor: &Tensor, ranks: &[usize], target: f64, options: &Options) -> Decomposition {
    let (&last, others) = ranks.split_last().expect("a choice of ranks");
    let with_rank = |rank| {
        decompose(
            tensor,
            &Options {
                rank,
                ..options.clone()
            },
        )
    };
    others
        .iter()
        .map(|&rank| with_rank(rank))
        .find(|decomposition| decomposition.relative_error <= target)
        .unwrap_or_else(|| with_rank(last))
}

/// Rows of `width` vectors: a column for each component, and zero columns up to the next multiple of eight.
#[derive(Clone)]
struct Factor {
    width: usize,
    values: Vec<f32x8>,
}

impl Factor {
    fn zero(rows: usize, width: usize) -> Self {
        let values = vec![f32x8::ZERO; rows * width];
        Self { width, values }
    }

    fn rows(&self) -> std::slice::ChunksExact<'_, f32x8> {
        self.values.chunks_exact(self.width)
    }

    /// Inner products of the columns.
    fn gram(&self) -> Vec<f64> {
        let n = 8 * self.width;
        let mut gram = vec![0.0; n * n];
        let mut row = vec![0.0; n];
        for vectors in self.rows() {
            for (row, &value) in row.iter_mut().zip(bytemuck::cast_slice::<f32x8, f32>(vectors)) {
                *row = f64::from(value);
            }
            for (sums, &scale) in gram.chunks_exact_mut(n).zip(&row) {
                for (sum, &value) in sums.iter_mut().zip(&row) {
                    *sum += scale * value;
                }
            }
        }
        gram
    }

    /// Makes columns unit vectors, zero ones left as they are.
    fn normalise(&mut self) {
        let mut squares = vec![f32x8::ZERO; self.width];
        for row in self.values.chunks_exact(self.width) {
            for (sum, &value) in squares.iter_mut().zip(row) {
                *sum = value.mul_add(value, *sum);
            }
        }
        let scales: Vec<f32x8> = squares
            .iter()
            .map(|sums| {
                f32x8::new(sums.to_array().map(|s| {
                    if s > f32::MIN_POSITIVE {
                        s.sqrt().recip()
                    } else {
                        0.0
                    }
                }))
            })
            .collect();
        for row in self.values.chunks_exact_mut(self.width) {
            for (value, &scale) in row.iter_mut().zip(&scales) {
                *value *= scale;
            }
        }
    }

    /// Without the zero columns.
    fn packed(&self, rank: usize, scale: f32) -> Vec<f32> {
        let rows = bytemuck::cast_slice::<f32x8, f32>(&self.values).chunks_exact(8 * self.width);
        rows.flat_map(|row| row[..rank].iter().map(|value| value * scale))
            .collect()
    }
}

/// F and its first part.
#[derive(Clone, Copy)]
struct Fit {
    objective: f64,
    squared_error: f64,
}

/// The tensor, scaled to unit norm, both ways it is multiplied, and the options.
struct Solver<'a> {
    dims: [usize; 3],
    width: usize,
    ridge: f64,
    options: &'a Options,
    /// K x (I J).
    slices: Panels,
    /// (I J) x K.
    fibres: Panels,
    start: [Factor; 2],
}

impl<'a> Solver<'a> {
    fn new(tensor: &Tensor, norm: f64, options: &'a Options) -> Self {
        let [i, j, k] = tensor.dims;
        let scale = (1.0 / norm) as f32;
        let value = |slice: usize, fibre: usize| scale * tensor.values[slice * i * j + fibre];
        let width = options.rank.div_ceil(8);
        Self {
            dims: tensor.dims,
            width,
            ridge: options.ridge.max(MIN_RIDGE),
            options,
            slices: Panels::new(k, i * j, value),
            fibres: Panels::new(i * j, k, |fibre, slice| value(slice, fibre)),
            start: start(tensor, options),
        }
    }

    fn run(&self, tensor: &Tensor, norm: f64) -> Decomposition {
        let [mut x, mut y] = self.start.clone();
        let mut objectives = Vec::new();
        let mut iterations = 0;
        let z = loop {
            let (z, fit) = self.solve_z(&x, &y, tensor, norm);
            iterations += 1;
            objectives.push(fit.objective);
            let done = fit.squared_error <= self.options.tolerance.powi(2);
            if done || iterations >= self.options.max_iterations || self.stalled(&objectives) {
                break z;
            }
            let shared = self.contract_z(&z);
            let z_gram = z.gram();
            x = self.solve_x(&shared, &y, &z_gram);
            y = self.solve_y(&shared, &x, &z_gram);
        };
        let condition = z
            .values
            .iter()
            .flat_map(|v| v.to_array())
            .map(|v| f64::from(v).powi(2))
            .sum::<f64>();
        let rank = self.options.rank;
        let mut decomposition = Decomposition {
            rank,
            factors: [
                x.packed(rank, 1.0),
                y.packed(rank, 1.0),
                z.packed(rank, norm as f32),
            ],
            relative_error: 0.0,
            condition: condition.sqrt(),
            iterations,
        };
        decomposition.relative_error = self.squared_residual(&x, &y, &z, tensor, norm).sqrt();
        decomposition
    }

    fn stalled(&self, objectives: &[f64]) -> bool {
        let n = objectives.len();
        n > 10 && objectives[n - 11] - objectives[n - 1] < self.options.stall * objectives[n - 1]
    }

    /// The best Z, and how good it is.
    fn solve_z(&self, x: &Factor, y: &Factor, tensor: &Tensor, norm: f64) -> (Factor, Fit) {
        let mut right = Factor::zero(self.dims[2], self.width);
        self.slices
            .multiply(&khatri_rao(x, y), self.width, &mut right.values);
        let gram = hadamard(&x.gram(), &y.gram());
        let z = self.solve(&right, &gram);
        let n = 8 * self.width;
        let squares = hadamard(&gram, &z.gram());
        let own: f64 = squares.iter().sum();
        let components: f64 = (0..n).map(|r| squares[r * n + r]).sum();
        let common: f64 = dot(&right.values, &z.values);
        let mut squared_error = 1.0 - 2.0 * common + own;
        if squared_error < CANCELLATION {
            squared_error = self.squared_residual(x, y, &z, tensor, norm);
        }
        let objective = squared_error + self.ridge * components;
        (
            z,
            Fit {
                objective,
                squared_error,
            },
        )
    }

    /// `M_(ij)r = sum_k T_ijk Z_kr`.
    fn contract_z(&self, z: &Factor) -> Vec<f32x8> {
        let mut shared = vec![f32x8::ZERO; self.dims[0] * self.dims[1] * self.width];
        self.fibres.multiply(&z.values, self.width, &mut shared);
        shared
    }

    fn solve_x(&self, shared: &[f32x8], y: &Factor, z_gram: &[f64]) -> Factor {
        let mut right = Factor::zero(self.dims[0], self.width);
        let slices = shared.chunks_exact((self.dims[0] * self.width).max(1));
        for (slice, y) in slices.zip(y.rows()) {
            for (sums, row) in right
                .values
                .chunks_exact_mut(self.width)
                .zip(slice.chunks_exact(self.width))
            {
                for ((sum, &value), &y) in sums.iter_mut().zip(row).zip(y) {
                    *sum = value.mul_add(y, *sum);
                }
            }
        }
        let mut x = self.solve(&right, &hadamard(&y.gram(), z_gram));
        x.normalise();
        x
    }

    fn solve_y(&self, shared: &[f32x8], x: &Factor, z_gram: &[f64]) -> Factor {
        let mut right = Factor::zero(self.dims[1], self.width);
        let slices = shared.chunks_exact((self.dims[0] * self.width).max(1));
        for (slice, sums) in slices.zip(right.values.chunks_exact_mut(self.width)) {
            for (row, x) in slice.chunks_exact(self.width).zip(x.rows()) {
                for ((sum, &value), &x) in sums.iter_mut().zip(row).zip(x) {
                    *sum = value.mul_add(x, *sum);
                }
            }
        }
        let mut y = self.solve(&right, &hadamard(&x.gram(), z_gram));
        y.normalise();
        y
    }

    /// `right (gram + ridge diag gram)^-1`.
    fn solve(&self, right: &Factor, gram: &[f64]) -> Factor {
        let n = 8 * self.width;
        let mut matrix = gram.to_vec();
        for r in 0..n {
            matrix[r * n + r] *= 1.0 + self.ridge;
        }
        let inverse = dense::inverse(&matrix, n);
        let mut solution = Factor::zero(0, self.width);
        let mut sums = vec![0.0; n];
        for row in right.rows() {
            sums.fill(0.0);
            for (&value, inverse) in bytemuck::cast_slice::<f32x8, f32>(row)
                .iter()
                .zip(inverse.chunks_exact(n))
            {
                for (sum, inverse) in sums.iter_mut().zip(inverse) {
                    *sum += f64::from(value) * inverse;
                }
            }
            let vectors = sums.chunks_exact(8);
            solution
                .values
                .extend(vectors.map(|v| f32x8::new(std::array::from_fn(|lane| v[lane] as f32))));
        }
        solution
    }

    /// `|T - T'|^2 / |T|^2`.
    fn squared_residual(&self, x: &Factor, y: &Factor, z: &Factor, tensor: &Tensor, norm: f64) -> f64 {
        let scale = (1.0 / norm) as f32;
        let products = khatri_rao(x, y);
        let slices = tensor.values.chunks_exact((self.dims[0] * self.dims[1]).max(1));
        slices
            .zip(z.rows())
            .map(|(slice, z)| {
                let fibres = slice.iter().zip(products.chunks_exact(self.width));
                let squares = fibres.map(|(value, products)| {
                    let mut sum = f32x8::ZERO;
                    for (&product, &z) in products.iter().zip(z) {
                        sum = product.mul_add(z, sum);
                    }
                    f64::from(value * scale - sum.reduce_add()).powi(2)
                });
                squares.sum::<f64>()
            })
            .sum()
    }
}

/// Row `j * I + i` is the product of row i of `x` and row j of `y`.
fn khatri_rao(x: &Factor, y: &Factor) -> Vec<f32x8> {
    let mut products = Vec::with_capacity(x.values.len() * y.values.len() / x.width);
    for y in y.rows() {
        for x in x.rows() {
            products.extend(x.iter().zip(y).map(|(&x, &y)| x * y));
        }
    }
    products
}

fn hadamard(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

fn dot(a: &[f32x8], b: &[f32x8]) -> f64 {
    let products = a.iter().zip(b).map(|(&a, &b)| f64::from((a * b).reduce_add()));
    products.sum()
}

/// X and Y to start from, with unit columns.
fn start(tensor: &Tensor, options: &Options) -> [Factor; 2] {
    let width = options.rank.div_ceil(8);
    [0, 1].map(|mode| {
        let rows = tensor.dims[mode];
        let vectors = match options.initialisation {
            Initialisation::Random => Vec::new(),
            Initialisation::SingularVectors => dense::eigenvectors(mode_gram(tensor, mode), rows),
        };
        let value = |row: usize, component: usize| {
            if component >= options.rank {
                0.0
            } else if component * rows < vectors.len() {
                vectors[component * rows + row] as f32
            } else {
                random(options.seed, [mode, row, component])
            }
        };
        let mut factor = Factor::zero(0, width);
        for row in 0..rows {
            let vectors = 0..width;
            factor
                .values
                .extend(vectors.map(|v| f32x8::new(std::array::from_fn(|lane| value(row, 8 * v + lane)))));
        }
        factor.normalise();
        factor
    })
}

/// In [0, 1), the same for the same arguments.
fn random(seed: u64, place: [usize; 3]) -> f32 {
    let bits = place.iter().fold(hash::mix(seed), |bits, &p| {
        hash::mix(bits.wrapping_add(0x9e37_79b9_7f4a_7c15).wrapping_add(p as u64))
    });
    (bits >> 40) as f32 / (1 << 24) as f32
}

/// Inner products of the slices of mode 0 or 1, those of a tensor of unit maximum.
fn mode_gram(tensor: &Tensor, mode: usize) -> Vec<f64> {
    let [i, j, _] = tensor.dims;
    let n = tensor.dims[mode];
    let scale = tensor.values.iter().fold(0.0_f32, |max, v| max.max(v.abs()));
    let mut gram = vec![0.0; n * n];
    let mut fibre = vec![0.0; n];
    for slice in tensor.values.chunks_exact((i * j).max(1)) {
        for other in 0..i * j / n.max(1) {
            for (index, value) in fibre.iter_mut().enumerate() {
                let place = if mode == 0 {
                    other * i + index
                } else {
                    index * i + other
                };
                *value = f64::from(slice[place] / scale);
            }
            for (sums, &a) in gram.chunks_exact_mut(n).zip(&fibre) {
                if a != 0.0 {
                    for (sum, &b) in sums.iter_mut().zip(&fibre) {
                        *sum += a * b;
                    }
                }
            }
        }
    }
    gram
}

#[cfg(test)]
mod tests;
