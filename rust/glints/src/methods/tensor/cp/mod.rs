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
//! **A sweep** solves for Z, X and Y in turn, each a linear least squares problem with R x R normal equations
//!
//! ```text
//! Z (G + ridge diag G) = T_(3) (Y . X),   G = X^T X * Y^T Y,   . by columns (Khatri-Rao), * by elements
//! ```
//!
//! The right-hand side is the expensive part. T, stored as a matrix of K x (I J), is multiplied twice in a sweep, with
//! I J x R for Z, and transposed with K x R for what X and Y share: `M_(ij)r = sum_k T_ijk Z_kr`, from which theirs
//! follow by sums over j or i. So let the third mode be the long one. The matrix is made small first: rows (ij) that are
//! all zero are left out, and the third mode is compressed (`compression`). Right-hand sides are computed in single
//! precision, normal equations in double. The error follows from the same products, but as a difference of nearly equal
//! numbers when it is small; then, and at the end, it is computed from the residuals.
//!
//! **Convergence** of plain sweeps is slow where components resemble each other. Two things help. The first stages of ten
//! sweeps have larger ridges, which fall by a factor of ten: components share the tensor before they specialise, and
//! the local minima they end in are better ones than those of plain sweeps from the same start. And sweeps are
//! combined by Anderson acceleration (`acceleration`); a combination that makes F larger is dropped for the last sweep's
//! own result, so F falls from sweep to sweep within a stage.
//!
//! The start is random. Singular vectors of the unfoldings as a start led to worse minima: on blocks with a ridge three
//! times the error.

mod acceleration;
mod compression;
mod dense;
mod product;

use wide::f32x8;

use self::acceleration::Acceleration;
use self::compression::Compressed;
use self::product::Panels;
use crate::hash;

/// Ridges are at least this: beyond a condition of its inverse, right-hand sides in single precision mean nothing.
const MIN_RIDGE: f64 = 1e-8;

/// Squared relative errors below this are computed from residuals: right-hand sides have errors around 1e-6.
const CANCELLATION: f64 = 1e-4;

/// Sweeps of the first stages; also those over which the iteration must not stall.
const STAGE: usize = 10;

/// A tensor, `values[(k * dims[1] + j) * dims[0] + i]`.
#[derive(Clone, Copy, Debug)]
pub struct Tensor<'a> {
    pub dims: [usize; 3],
    pub values: &'a [f32],
}

/// How a tensor is decomposed.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Number of components R.
    pub rank: usize,
    /// Relative error `|T - T'| / |T|` at which to stop.
    pub tolerance: f64,
    /// Most sweeps from one start.
    pub max_iterations: usize,
    /// Weight of the components' squared norms against the squared error, at least 1e-8.
    pub ridge: f64,
    /// Stages of ten sweeps before the last one, each with ten times the ridge of the next.
    pub stages: usize,
    /// Combines sweeps by Anderson acceleration.
    pub accelerated: bool,
    /// Stops when ten sweeps of the last stage together have reduced F by less than this part; 0: never.
    pub stall: f64,
    /// Relative error, lower than `tolerance`, up to which the third mode is compressed during the sweeps; 0: not at all.
    /// The last Z is that of the full tensor.
    pub compression: f64,
    /// Random starts, of which the one that the first stages have led furthest is continued; at least one.
    pub starts: usize,
    /// Seed of the random starts.
    pub seed: u64,
}

impl Options {
    /// The setting of Deng et al. 2022, Section 4.2: plain sweeps from a random start.
    pub fn published() -> Self {
        Self {
            rank: 16,
            tolerance: 1e-4,
            max_iterations: 500,
            ridge: 0.0,
            stages: 0,
            accelerated: false,
            stall: 0.0,
            compression: 0.0,
            starts: 1,
            seed: 0,
        }
    }
}

impl Default for Options {
    /// Lower errors than the published setting in a fraction of its time, and components that hardly cancel.
    fn default() -> Self {
        Self {
            rank: 16,
            tolerance: 1e-3,
            max_iterations: 250,
            ridge: 1e-4,
            stages: 3,
            accelerated: true,
            stall: 1e-3,
            compression: 7e-4,
            starts: 2,
            seed: 0,
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
    /// Sweeps from the start that was continued; an extrapolation that failed counts as one.
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
    Solver::new(tensor, norm, options).run()
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

    fn row(&self, row: usize) -> &[f32x8] {
        &self.values[row * self.width..][..self.width]
    }

    /// Inner products of the columns.
    fn gram(&self) -> Vec<f64> {
        let n = 8 * self.width;
        let mut gram = vec![0.0; n * n];
        let values = doubles(&self.values);
        dense::multiply(&values, [1, n], &values, n, &mut gram);
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
struct Fit {
    objective: f64,
    squared_error: f64,
}

/// Where some sweeps have led.
struct Descent {
    state: State,
    objective: f64,
    squared_error: f64,
    sweeps: usize,
}

impl Descent {
    /// No sweep yet.
    fn from(state: State) -> Self {
        let (objective, squared_error) = (f64::INFINITY, f64::INFINITY);
        Self {
            state,
            objective,
            squared_error,
            sweeps: 0,
        }
    }

    fn is_within(&self, tolerance: f64) -> bool {
        self.squared_error <= tolerance * tolerance
    }
}

/// X and Y, one behind the other: what a sweep starts from.
type State = Vec<f32x8>;

/// The tensor, scaled to unit norm and compressed, both ways it is multiplied.
struct Solver<'a> {
    tensor: &'a Tensor<'a>,
    norm: f64,
    options: &'a Options,
    width: usize,
    /// i and j of the fibres along the third mode that are not zero.
    places: Vec<[usize; 2]>,
    compressed: Compressed,
    /// Rows of the compressed third mode x fibres.
    slices: Panels,
    /// Transposed.
    fibres: Panels,
}

impl<'a> Solver<'a> {
    fn new(tensor: &'a Tensor<'a>, norm: f64, options: &'a Options) -> Self {
        let [i, j, k] = tensor.dims;
        let occupied = |p: usize| (0..k).any(|slice| tensor.values[slice * i * j + p] != 0.0);
        let places: Vec<[usize; 2]> = (0..i * j)
            .filter(|&p| occupied(p))
            .map(|p| [p % i, p / i])
            .collect();
        let scaled = scaled(tensor, norm, &places);
        let compressed = Compressed::new(
            places.len(),
            k,
            |place, slice| scaled(slice, place),
            options.compression,
        );
        let (rows, count) = (compressed.rows(), places.len());
        Self {
            tensor,
            norm,
            options,
            width: options.rank.div_ceil(8),
            slices: Panels::new(rows, count, |row, place| compressed.value(row, place)),
            fibres: Panels::new(count, rows, |place, row| compressed.value(row, place)),
            places: places.clone(),
            compressed,
        }
    }

    fn run(&self) -> Decomposition {
        let last_ridge = self.options.ridge.max(MIN_RIDGE);
        let starts = (0..self.options.starts.max(1)).map(|number| self.first_stages(number, last_ridge));
        let first = starts
            .min_by(|a, b| a.objective.total_cmp(&b.objective))
            .expect("at least one start");
        let rest = self.options.max_iterations.saturating_sub(first.sweeps);
        let sweeps = if first.is_within(self.options.tolerance) {
            0
        } else {
            rest
        };
        let last = self.descend(first.state, last_ridge, sweeps);
        let iterations = first.sweeps + last.sweeps;
        let state = last.state;
        let [x, y] = self.factors(&state);
        let scaled = scaled(self.tensor, self.norm, &self.places);
        let slices = Panels::new(self.tensor.dims[2], self.places.len(), &scaled);
        let (z, _) = self.solve_z(&slices, &x, &y, last_ridge);
        let rank = self.options.rank;
        Decomposition {
            rank,
            relative_error: squared_residual(&x, &y, &z, &self.places, &scaled).sqrt(),
            condition: dot(&z.values, &z.values).sqrt(),
            factors: [
                x.packed(rank, 1.0),
                y.packed(rank, 1.0),
                z.packed(rank, self.norm as f32),
            ],
            iterations,
        }
    }

    /// The stages with larger ridges, from one of the starts.
    fn first_stages(&self, number: usize, last_ridge: f64) -> Descent {
        let mut descent = Descent::from(start(self.tensor, self.options, number));
        for stage in (1..=self.options.stages).rev() {
            let sweeps = STAGE.min(self.options.max_iterations - descent.sweeps);
            let next = self.descend(descent.state, last_ridge * 10.0_f64.powi(stage as i32), sweeps);
            descent = Descent {
                sweeps: descent.sweeps + next.sweeps,
                ..next
            };
            if descent.is_within(self.options.tolerance) {
                break;
            }
        }
        descent
    }

    /// Sweeps until the tolerance is reached or the objective stalls.
    fn descend(&self, mut state: State, ridge: f64, max_sweeps: usize) -> Descent {
        let mut acceleration = Acceleration::default();
        let mut objectives: Vec<f64> = Vec::new();
        let mut best = Descent::from(state.clone());
        for sweeps in 1..=max_sweeps {
            let [x, y] = self.factors(&state);
            let (z, products) = self.solve_z(&self.slices, &x, &y, ridge);
            let fit = self.fit([&x, &y, &z], &products, ridge);
            best.sweeps = sweeps;
            if acceleration.is_extrapolated() && objectives.last().is_some_and(|&last| fit.objective > last) {
                state = acceleration.retreat();
                continue;
            }
            objectives.push(fit.objective);
            best.objective = fit.objective;
            best.squared_error = fit.squared_error;
            best.state = state;
            if best.is_within(self.options.tolerance) || self.is_stalled(&objectives) {
                break;
            }
            let swept = self.sweep(&y, &z, ridge);
            state = if self.options.accelerated {
                acceleration.next(&best.state, swept)
            } else {
                swept
            };
        }
        best
    }

    fn is_stalled(&self, objectives: &[f64]) -> bool {
        let n = objectives.len();
        n > STAGE && objectives[n - 1 - STAGE] - objectives[n - 1] < self.options.stall * objectives[n - 1]
    }

    /// X and Y with unit columns.
    fn factors(&self, state: &State) -> [Factor; 2] {
        let (x, y) = state.split_at(self.tensor.dims[0] * self.width);
        [x, y].map(|values| {
            let mut factor = Factor {
                width: self.width,
                values: values.to_vec(),
            };
            factor.normalise();
            factor
        })
    }

    /// The best Z, for the rows of `slices`, and its right-hand side.
    fn solve_z(&self, slices: &Panels, x: &Factor, y: &Factor, ridge: f64) -> (Factor, Factor) {
        let mut right = Factor::zero(slices.rows(), self.width);
        slices.multiply(&self.products(x, y), self.width, &mut right.values);
        let z = solve(&right, hadamard(&x.gram(), &y.gram()), ridge);
        (z, right)
    }

    /// How well X, Y, Z fit, with Z's right-hand side.
    fn fit(&self, [x, y, z]: [&Factor; 3], right: &Factor, ridge: f64) -> Fit {
        let n = 8 * self.width;
        let squares = hadamard(&hadamard(&x.gram(), &y.gram()), &z.gram());
        let components: f64 = (0..n).map(|r| squares[r * n + r]).sum();
        let mut squared_error = 1.0 - 2.0 * dot(&right.values, &z.values) + squares.iter().sum::<f64>();
        if squared_error < CANCELLATION {
            let value = |row: usize, place: usize| self.compressed.value(row, place);
            squared_error = self.compressed.squared_rest() + squared_residual(x, y, z, &self.places, value);
        }
        Fit {
            objective: squared_error + ridge * components,
            squared_error,
        }
    }

    /// Products of the rows of X and Y at the occupied places.
    fn products(&self, x: &Factor, y: &Factor) -> Vec<f32x8> {
        let mut products = Vec::with_capacity(self.places.len() * self.width);
        for &[i, j] in &self.places {
            products.extend(x.row(i).iter().zip(y.row(j)).map(|(&x, &y)| x * y));
        }
        products
    }

    /// X and Y that follow from Y and Z.
    fn sweep(&self, y: &Factor, z: &Factor, ridge: f64) -> State {
        let mut shared = vec![f32x8::ZERO; self.places.len() * self.width];
        self.fibres.multiply(&z.values, self.width, &mut shared);
        let z_gram = z.gram();
        let x = solve(&self.right(0, &shared, y), hadamard(&y.gram(), &z_gram), ridge);
        let y = solve(&self.right(1, &shared, &x), hadamard(&x.gram(), &z_gram), ridge);
        let mut state = x.values;
        state.extend_from_slice(&y.values);
        state
    }

    /// The right-hand side of X (mode 0) or Y (mode 1), from the other one and the products of T and Z.
    fn right(&self, mode: usize, shared: &[f32x8], other: &Factor) -> Factor {
        let mut right = Factor::zero(self.tensor.dims[mode], self.width);
        for (place, shared) in self.places.iter().zip(shared.chunks_exact(self.width)) {
            let sums = &mut right.values[place[mode] * self.width..][..self.width];
            for ((sum, &shared), &other) in sums.iter_mut().zip(shared).zip(other.row(place[1 - mode])) {
                *sum = shared.mul_add(other, *sum);
            }
        }
        right
    }
}

/// The values of unit norm together, by slice and place.
fn scaled<'a>(tensor: &'a Tensor, norm: f64, places: &'a [[usize; 2]]) -> impl Fn(usize, usize) -> f32 + 'a {
    let [i, j, _] = tensor.dims;
    move |slice, place| {
        let [x, y] = places[place];
        (f64::from(tensor.values[(slice * j + y) * i + x]) / norm) as f32
    }
}

/// `right (gram + ridge diag gram)^-1`.
fn solve(right: &Factor, mut gram: Vec<f64>, ridge: f64) -> Factor {
    let n = 8 * right.width;
    for r in 0..n {
        gram[r * n + r] *= 1.0 + ridge;
    }
    dense::invert(&mut gram, n);
    let mut solution = vec![0.0; right.values.len() * 8];
    dense::multiply(&doubles(&right.values), [n, 1], &gram, n, &mut solution);
    let vectors = solution
        .chunks_exact(8)
        .map(|v| f32x8::new(std::array::from_fn(|lane| v[lane] as f32)));
    Factor {
        width: right.width,
        values: vectors.collect(),
    }
}

/// `sum |value(k, place) - T'|^2`, zero values between the places included.
fn squared_residual(
    x: &Factor,
    y: &Factor,
    z: &Factor,
    places: &[[usize; 2]],
    value: impl Fn(usize, usize) -> f32,
) -> f64 {
    // T' is the product of Z and the transposed products of X and Y, eight values of i in a vector.
    let n = 8 * x.width;
    let [rows, columns] = [x, y].map(|factor| factor.values.len() / factor.width);
    let vectors = (rows * columns).div_ceil(8);
    let [floats_x, floats_y, floats_z] = [x, y, z].map(|f| bytemuck::cast_slice::<f32x8, f32>(&f.values));
    let mut products = Vec::with_capacity(n * vectors);
    for r in 0..n {
        products.extend((0..vectors).map(|v| {
            f32x8::new(std::array::from_fn(|lane| {
                let p = 8 * v + lane;
                if p < rows * columns {
                    floats_x[p % rows * n + r] * floats_y[p / rows * n + r]
                } else {
                    0.0
                }
            }))
        }));
    }
    let slices = z.values.len() / z.width;
    let mut model = vec![f32x8::ZERO; slices * vectors];
    Panels::new(slices, n, |k, r| floats_z[k * n + r]).multiply(&products, vectors, &mut model);
    let model: &mut [f32] = bytemuck::cast_slice_mut(&mut model);
    for (k, model) in model.chunks_exact_mut((8 * vectors).max(1)).enumerate() {
        for (place, &[i, j]) in places.iter().enumerate() {
            model[j * rows + i] -= value(k, place);
        }
    }
    model.iter().map(|&v| f64::from(v).powi(2)).sum()
}

fn doubles(vectors: &[f32x8]) -> Vec<f64> {
    bytemuck::cast_slice::<f32x8, f32>(vectors)
        .iter()
        .map(|&v| f64::from(v))
        .collect()
}

fn hadamard(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a * b).collect()
}

fn dot(a: &[f32x8], b: &[f32x8]) -> f64 {
    let mut sum = f32x8::ZERO;
    for (&a, &b) in a.iter().zip(b) {
        sum = a.mul_add(b, sum);
    }
    sum.to_array().iter().map(|&v| f64::from(v)).sum()
}

/// X and Y to start from: random numbers in [0, 1), as the values are mostly positive.
fn start(tensor: &Tensor, options: &Options, number: usize) -> State {
    let value = |mode: usize, row: usize, component: usize| {
        if component < options.rank {
            random(options.seed, [mode + 2 * number, row, component])
        } else {
            0.0
        }
    };
    let mut state = Vec::new();
    for mode in [0, 1] {
        for row in 0..tensor.dims[mode] {
            let vectors = (0..options.rank.div_ceil(8))
                .map(|v| std::array::from_fn(|lane| value(mode, row, 8 * v + lane)));
            state.extend(vectors.map(f32x8::new));
        }
    }
    state
}

/// In [0, 1), the same for the same arguments.
fn random(seed: u64, place: [usize; 3]) -> f32 {
    let bits = place.iter().fold(hash::mix(seed), |bits, &p| {
        hash::mix(bits.wrapping_add(0x9e37_79b9_7f4a_7c15).wrapping_add(p as u64))
    });
    (bits >> 40) as f32 / (1 << 24) as f32
}

#[cfg(test)]
mod tests;
