//! Anderson acceleration of the sweeps.

use wide::f32x8;

use super::{dense, dot};

/// A fixed-point iteration `u -> g(u)` is taken to be linear near its goal, and the combination of the last states is
/// sought at which `g(u) - u` vanishes, in the least squares sense (Anderson 1965; Walker and Ni 2011, Eq. 2.2).
#[derive(Default)]
pub struct Acceleration {
    last: Option<Step>,
    /// Differences from one to the next, oldest first, at most [`HISTORY`].
    steps: Vec<Step>,
    extrapolated: bool,
}

/// `g(u) - u` and `g(u)`, or differences of them.
struct Step {
    change: Vec<f32x8>,
    swept: Vec<f32x8>,
}

/// Sweeps that are combined; a multiple of eight for `dense`.
const HISTORY: usize = 8;

/// Ridge, relative to the diagonal, of the normal equations of the combination.
const RIDGE: f64 = 1e-6;

impl Acceleration {
    /// The last answer was no sweep's own result.
    pub fn is_extrapolated(&self) -> bool {
        self.extrapolated
    }

    /// The last sweep's own result instead of the extrapolation; starts anew from there.
    pub fn retreat(&mut self) -> Vec<f32x8> {
        self.extrapolated = false;
        self.steps.clear();
        self.last.take().map(|last| last.swept).unwrap_or_default()
    }

    /// Where to go from `state`, whose sweep has led to `swept`.
    pub fn next(&mut self, state: &[f32x8], swept: Vec<f32x8>) -> Vec<f32x8> {
        let change = difference(&swept, state);
        if let Some(last) = &self.last {
            if self.steps.len() == HISTORY {
                self.steps.remove(0);
            }
            self.steps.push(Step {
                change: difference(&change, &last.change),
                swept: difference(&swept, &last.swept),
            });
        }
        self.extrapolated = !self.steps.is_empty();
        let mut next = swept.clone();
        for (weight, step) in self.weights(&change).into_iter().zip(&self.steps) {
            let weight = f32x8::splat(weight as f32);
            for (next, &step) in next.iter_mut().zip(&step.swept) {
                *next -= weight * step;
            }
        }
        self.last = Some(Step { change, swept });
        next
    }

    /// Multiples of the steps' changes whose sum comes closest to `change`.
    fn weights(&self, change: &[f32x8]) -> [f64; HISTORY] {
        let mut matrix = [0.0; HISTORY * HISTORY];
        for (row, a) in self.steps.iter().enumerate() {
            for (column, b) in self.steps[..=row].iter().enumerate() {
                let product = dot(&a.change, &b.change);
                matrix[row * HISTORY + column] = product;
                matrix[column * HISTORY + row] = product;
            }
            matrix[row * HISTORY + row] *= 1.0 + RIDGE;
        }
        dense::invert(&mut matrix, HISTORY);
        let mut weights = [0.0; HISTORY];
        for (k, step) in self.steps.iter().enumerate() {
            let right = dot(&step.change, change);
            for (weight, inverse) in weights.iter_mut().zip(&matrix[k * HISTORY..]) {
                *weight += inverse * right;
            }
        }
        weights
    }
}

fn difference(a: &[f32x8], b: &[f32x8]) -> Vec<f32x8> {
    a.iter().zip(b).map(|(&a, &b)| a - b).collect()
}
