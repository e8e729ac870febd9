//! The third mode in a smaller basis: the images of a group resemble each other.

/// Coefficients of the fibres along the third mode in an orthonormal basis of some of them: Gram-Schmidt with pivots, as
/// in a QR decomposition with column pivoting. The basis itself is not kept; inner products of fibres, and with them the
/// best first and second factors, do not depend on it.
pub struct Compressed {
    places: usize,
    /// `[row * places + place]`.
    values: Vec<f32>,
    squared_rest: f64,
}

impl Compressed {
    /// `value(place, index)` are the fibres, of unit norm together; `error` is that of the approximation.
    pub fn new(places: usize, length: usize, value: impl Fn(usize, usize) -> f32, error: f64) -> Self {
        if error == 0.0 {
            let values = (0..length * places)
                .map(|e| value(e % places, e / places))
                .collect();
            return Self {
                places,
                values,
                squared_rest: 0.0,
            };
        }
        let mut rests: Vec<f32> = (0..places * length)
            .map(|e| value(e / length, e % length))
            .collect();
        let mut values = Vec::new();
        let mut squares: Vec<f64> = rests
            .chunks_exact(length)
            .map(|rest| f64::from(dot(rest, rest)))
            .collect();
        let mut squared_rest = squares.iter().sum::<f64>();
        let mut basis = vec![0.0; length];
        while squared_rest > error * error && values.len() < length * places {
            let pivot = (0..places)
                .max_by(|&a, &b| squares[a].total_cmp(&squares[b]))
                .expect("a place");
            let scale = (1.0 / squares[pivot].sqrt()) as f32;
            for (basis, rest) in basis.iter_mut().zip(&rests[pivot * length..]) {
                *basis = rest * scale;
            }
            squared_rest = 0.0;
            for (rest, square) in rests.chunks_exact_mut(length).zip(&mut squares) {
                let coefficient = dot(rest, &basis);
                for (rest, basis) in rest.iter_mut().zip(&basis) {
                    *rest -= coefficient * basis;
                }
                *square = f64::from(dot(rest, rest));
                squared_rest += *square;
                values.push(coefficient);
            }
        }
        Self {
            places,
            values,
            squared_rest,
        }
    }

    /// Size of the basis.
    pub fn rows(&self) -> usize {
        self.values.len() / self.places.max(1)
    }

    pub fn value(&self, row: usize, place: usize) -> f32 {
        self.values[row * self.places + place]
    }

    /// Squared norm of what is not represented.
    pub fn squared_rest(&self) -> f64 {
        self.squared_rest
    }
}

/// In eight partial sums, so that the compiler may use vectors.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0_f32; 8];
    let (a, b) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a.zip(b) {
        for lane in 0..8 {
            sums[lane] = a[lane].mul_add(b[lane], sums[lane]);
        }
    }
    sums.iter().sum::<f32>() + rest
}
