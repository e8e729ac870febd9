//! Distributions of normals as pictures over the projected hemisphere, whose pixels are averages.
//!
//! A point of the unit disk is a half vector h projected along the shading normal, and `dA = cos dw`: the
//! integral of D over the disk's area is that of `D cos` over solid angles, which is one for a normalized
//! distribution. A flake's lobe has the standard deviation `alpha / sqrt(2)` on the disk, times the cosine of
//! its tilt along the direction of the tilt: often less than a pixel, so that points at the pixels' centres
//! would miss most lobes. Two ways lead to averages:
//!
//! * **Grid.** Each pixel has `k x k` points, of a spacing of at most the lobe's standard deviation. The midpoint
//!   rule is then exact to 1e-4 (the Fourier transform of a Gaussian at the grid's frequency).
//! * **Draws.** Where that takes too many points, half vectors are drawn with the method itself and weighted
//!   with `D cos / density`: unbiased whatever the lobes' size. The numbers come from an additive recurrence
//!   in four dimensions (Roberts 2018, after Weyl), randomly shifted (Cranley and Patterson 1976).
//!
//! Either way the points fall into two halves, and half of their pictures' difference is the stated error: the
//! standard error of draws, and a bound, in practice, for a grid.

use std::f64::consts::PI;

use glam::Vec3;
use glints::footprint::Footprint;
use glints::methods::Method;
use rayon::prelude::*;

use crate::progress::Progress;

/// Smallest cosine of tilt that the grid resolves; steeper lobes hold hardly any projected area.
const LEAST_COSINE: f64 = 0.05;

/// Draws that are evaluated in parallel before they are summed up in order.
const BATCH: u32 = 1 << 16;

/// What is integrated.
pub struct Problem<'a> {
    /// A method, and the footprint over its map.
    pub method: (&'a dyn Method, Footprint),
    /// Another one, over the same part of the surface.
    pub compare: Option<(&'a dyn Method, Footprint)>,
    /// Standard deviation of a lobe without tilt, on the disk.
    pub lobe: f64,
    /// Pixels per side of the square around the disk.
    pub size: u32,
    /// Most points that are evaluated.
    pub points: u64,
}

/// The pictures and what is known about them.
pub struct Estimate {
    /// Of the method, and of the one it is compared with: averages of D over pixels, per steradian, row by
    /// row, row 0 at the largest v. Points outside the disk count as zero.
    pub pictures: Vec<Picture>,
    /// Integral of `|D - D_compare| cos` over that of `D_compare cos`, point by point.
    pub difference: Option<f64>,
    /// "grid" or "draws".
    pub strategy: &'static str,
    /// Number of points.
    pub points: u64,
}

pub struct Picture {
    pub pixels: Vec<f32>,
    /// Integral of `D cos`.
    pub integral: f64,
    /// Relative L1 error of the pixels, as the module says.
    pub error: f64,
}

impl Problem<'_> {
    pub fn solve(&self) -> Estimate {
        let points = self.grid_points();
        if points <= self.points {
            self.grid(points)
        } else {
            self.draws()
        }
    }

    fn methods(&self) -> impl Iterator<Item = (&dyn Method, &Footprint)> {
        let both = std::iter::once(&self.method).chain(&self.compare);
        both.map(|(method, footprint)| (*method, footprint))
    }

    fn pixel_side(&self) -> f64 {
        2.0 / f64::from(self.size)
    }

    /// Values of D at `h`; the second is zero without comparison.
    fn values(&self, h: Vec3) -> [f64; 2] {
        let mut values = [0.0; 2];
        for (value, (method, footprint)) in values.iter_mut().zip(self.methods()) {
            *value = f64::from(method.ndf(footprint, h));
        }
        values
    }

    fn estimate(&self, sums: Sums, strategy: &'static str, points: u64) -> Estimate {
        let area = self.pixel_side().powi(2);
        let pictures: Vec<Picture> = (0..self.methods().count())
            .map(|m| sums.picture(m, area))
            .collect();
        let difference = self.compare.map(|_| sums.difference / pictures[1].integral);
        Estimate {
            pictures,
            difference,
            strategy,
            points,
        }
    }

    // ---- grid ---------------------------------------------------------------------------------------------

    /// Points per side of the pixel at `column`, `row`: even, so that its halves are a chequerboard's fields;
    /// none for a pixel outside the disk.
    fn subdivision(&self, column: u32, row: u32) -> u32 {
        let side = self.pixel_side();
        // Distances of the pixel's nearest point and of its centre from the axes.
        let near = |i: u32| ((f64::from(i) + 0.5) * side - 1.0).abs() - 0.5 * side;
        let radius = near(column).max(0.0).hypot(near(row).max(0.0));
        if radius >= 1.0 {
            return 0;
        }
        // The middle of the pixel stands for it, at the rim its inner corner.
        let middle = (radius + 0.5 * side).min(1.0);
        let cosine = (1.0 - middle * middle).max(1.0 - radius * radius - side).max(0.0);
        let spacing = self.lobe * cosine.sqrt().max(LEAST_COSINE);
        2 * (0.5 * side / spacing).ceil().clamp(1.0, 1e4) as u32
    }

    fn grid_points(&self) -> u64 {
        let row_points = |row: u32| -> u64 {
            let of_pixel = |column| u64::from(self.subdivision(column, row)).pow(2);
            (0..self.size).map(of_pixel).sum()
        };
        (0..self.size).into_par_iter().map(row_points).sum()
    }

    fn grid(&self, points: u64) -> Estimate {
        let progress = Progress::bar("distribution of normals", u64::from(self.size));
        let rows: Vec<Sums> = (0..self.size)
            .into_par_iter()
            .map(|row| {
                let mut sums = Sums::new(self.size as usize);
                for column in 0..self.size {
                    self.grid_pixel(column, row, &mut sums);
                }
                progress.advance(1);
                sums
            })
            .collect();
        self.estimate(Sums::stacked(rows), "grid", points)
    }

    fn grid_pixel(&self, column: u32, row: u32, sums: &mut Sums) {
        let side = self.pixel_side();
        let k = self.subdivision(column, row);
        let weight = (side / f64::from(k)).powi(2);
        for (i, j) in (0..k).flat_map(|j| (0..k).map(move |i| (i, j))) {
            let position = |pixel: u32, point: u32| {
                (f64::from(pixel) + (f64::from(point) + 0.5) / f64::from(k)) * side - 1.0
            };
            let (x, y) = (position(column, i), -position(row, j));
            let z2 = 1.0 - x * x - y * y;
            if z2 > 0.0 {
                let h = Vec3::new(x as f32, y as f32, z2.sqrt() as f32);
                let half = ((i + j) % 2) as usize;
                sums.add(column as usize, half, weight, self.values(h));
            }
        }
    }

    // ---- draws --------------------------------------------------------------------------------------------

    fn draws(&self) -> Estimate {
        let batches = self.points.div_ceil(BATCH.into());
        let progress = Progress::bar("distribution of normals", batches);
        let mut sums = Sums::new(self.size as usize * self.size as usize);
        let total = batches * u64::from(BATCH);
        for batch in 0..batches {
            let drawn: Vec<Option<Drawn>> = (0..BATCH)
                .into_par_iter()
                .with_min_len(256)
                .map(|i| self.draw(batch * u64::from(BATCH) + u64::from(i)))
                .collect();
            for drawn in drawn.into_iter().flatten() {
                let weight = drawn.weight / total as f64;
                sums.add(drawn.pixel, drawn.half, weight, drawn.values);
            }
            progress.advance(1);
        }
        self.estimate(sums, "draws", total)
    }

    /// The draw of the given number; methods and halves take turns. `None`: it failed and counts as zero.
    fn draw(&self, index: u64) -> Option<Drawn> {
        let methods = self.methods().count() as u64;
        let (source, footprint) = match self.compare {
            Some(compare) if index % methods != 0 => compare,
            _ => self.method,
        };
        let half = (index / methods) % 2;
        let u = recurrence(index / methods / 2, half * methods + index % methods);
        let h = source.sample(&footprint, u)?;
        let densities: f64 = self
            .methods()
            .map(|(method, footprint)| f64::from(method.density(footprint, h)))
            .sum();
        if densities <= 0.0 {
            return None;
        }
        let cell = |x: f32| ((f64::from(x) + 1.0) / self.pixel_side()) as usize;
        let last = self.size as usize - 1;
        Some(Drawn {
            pixel: cell(-h.y).min(last) * self.size as usize + cell(h.x).min(last),
            half: half as usize,
            weight: f64::from(h.z) * methods as f64 / densities,
            values: self.values(h),
        })
    }
}

/// One draw: where it falls, `cos / density`, and the values of D there.
struct Drawn {
    pixel: usize,
    half: usize,
    weight: f64,
    values: [f64; 2],
}

/// Point `index` of the recurrence with the shift of the given number.
fn recurrence(index: u64, shift: u64) -> [f32; 4] {
    // The real root of x^5 = x + 1, and the inverses of its first four powers.
    const ROOT: f64 = 1.167_303_978_261_418_7;
    std::array::from_fn(|dimension| {
        let step = ROOT.powi(-(dimension as i32) - 1);
        let start = uniform(4 * shift + dimension as u64);
        let u = (start + step * index as f64).fract() as f32;
        // Rounding to single precision must not reach one.
        u.min(1.0 - f32::EPSILON)
    })
}

/// A number in [0, 1): SplitMix64 of a seed.
fn uniform(seed: u64) -> f64 {
    let mut z = (seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ z >> 31) >> 11) as f64 / (1_u64 << 53) as f64
}

/// Integrals of D over pixels, for two methods and two halves of the points, as far as they are summed up.
struct Sums {
    pixels: Vec<[[f32; 2]; 2]>,
    difference: f64,
}

impl Sums {
    fn new(pixels: usize) -> Self {
        Self {
            pixels: vec![[[0.0; 2]; 2]; pixels],
            difference: 0.0,
        }
    }

    fn stacked(rows: Vec<Self>) -> Self {
        let difference = rows.iter().map(|row| row.difference).sum();
        Self {
            pixels: rows.into_iter().flat_map(|row| row.pixels).collect(),
            difference,
        }
    }

    #[inline]
    fn add(&mut self, pixel: usize, half: usize, weight: f64, values: [f64; 2]) {
        for (sums, value) in self.pixels[pixel].iter_mut().zip(values) {
            sums[half] += (weight * value) as f32;
        }
        self.difference += weight * (values[0] - values[1]).abs();
    }

    fn picture(&self, method: usize, pixel_area: f64) -> Picture {
        let halves = || self.pixels.iter().map(move |pixel| pixel[method].map(f64::from));
        let integral: f64 = halves().map(|[a, b]| a + b).sum();
        let deviation: f64 = halves().map(|[a, b]| (a - b).abs()).sum();
        Picture {
            pixels: halves().map(|[a, b]| ((a + b) / pixel_area) as f32).collect(),
            integral,
            error: deviation / integral,
        }
    }
}

impl Picture {
    /// Largest average of a pixel, per steradian.
    pub fn peak(&self) -> f32 {
        self.pixels.iter().copied().fold(0.0, f32::max)
    }

    /// Mean of D over the disk.
    pub fn mean(&self) -> f64 {
        self.integral / PI
    }
}
