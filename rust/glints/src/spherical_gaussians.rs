//! Environment light as a mixture of spherical Gaussians (Section 5.4 of Deng et al. 2022; Tsai and Shih 2006).
//!
//! **Computes** from weighted directions, the light of an environment, the mixture of von Mises-Fisher
//! distributions of largest likelihood,
//!
//! ```text
//! m(x) = sum_k pi_k v_k(x),   v(x) = lambda / (2 pi (1 - exp(-2 lambda))) exp(lambda (x . mu - 1)),
//! ```
//!
//! which are spherical Gaussians with axis `mu`, sharpness `lambda` and integral one. Expectation maximisation
//! (Banerjee et al. 2005; the mean resultant length is inverted exactly) starts from centres drawn as in
//! k-means++ (Arthur and Vassilvitskii 2007) and stops when the likelihood does.
//!
//! **Energy.** Expectation assigns to every direction its shares `pi_k v_k(x) / m(x)`, which sum to one. A lobe's
//! weight is the sum of its shares, so no light is lost or invented, whatever the fit: total and centre of
//! gravity of the light are those of the mixture. [`SphericalGaussians::energies`] splits any further channels of
//! the same light (colours, wavelengths) by the same shares. What a mixture cannot follow, such as the edge of
//! a window, is light moved within a lobe's extent; [`SphericalGaussians::residual`] tells how much.
//!
//! **Determinism** The directions are summed in fixed chunks, in order, whatever the number of threads.

use glam::{DVec3, Mat3, Vec3};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::hash::mix;

/// Most lobes of a mixture.
pub const MAX_LOBES: usize = 1024;

/// Sharpness is kept in this interval: nearly uniform, and a standard deviation of a tenth of a degree.
const SHARPNESS: (f64, f64) = (1e-3, 3e5);

/// Iterations of expectation maximisation, at most.
const MAX_ITERATIONS: usize = 100;

/// It stops when an iteration gains less than this in mean log-likelihood.
const LEAST_GAIN: f64 = 1e-4;

/// Directions that are summed up together.
const CHUNK: usize = 2048;

/// Least share of the light that a lobe keeps: below, it has lost its directions to others.
const LEAST_WEIGHT: f64 = 1e-9;

/// A spherical Gaussian whose integral over the sphere is one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SphericalGaussian {
    /// Unit vector.
    pub axis: Vec3,
    /// `lambda` in `exp(lambda (x . axis - 1))`.
    pub sharpness: f32,
}

impl SphericalGaussian {
    /// The density at the unit vector `x`, per solid angle.
    pub fn density(&self, x: Vec3) -> f32 {
        // 1 - cos from the chord: at high sharpness the rounding of a cosine would show.
        let exponent = -0.5 * self.sharpness * (x - self.axis).length_squared();
        self.peak() * exponent.exp()
    }

    /// The density on the axis.
    fn peak(&self) -> f32 {
        (f64::from(self.sharpness) / (std::f64::consts::TAU * -(-2.0 * f64::from(self.sharpness)).exp_m1()))
            as f32
    }

    /// Draws a direction with the density [`SphericalGaussian::density`].
    pub fn sample(&self, u: [f32; 2]) -> Vec3 {
        // The inverse of the distribution of 1 - cos, an exponential one cut off at two.
        let lambda = f64::from(self.sharpness);
        let drop = -(f64::from(u[0]) * (-2.0 * lambda).exp_m1()).ln_1p() / lambda;
        let drop = drop.clamp(0.0, 2.0);
        let sin = (drop * (2.0 - drop)).max(0.0).sqrt() as f32;
        let (sin_phi, cos_phi) = (std::f32::consts::TAU * u[1]).sin_cos();
        let (a, b) = self.axis.any_orthonormal_pair();
        (a * (sin * cos_phi) + b * (sin * sin_phi) + self.axis * (1.0 - drop as f32)).normalize()
    }

    /// The cosine of the angle of the compact-epsilon support: outside of it the lobe is below `epsilon` times
    /// its peak (Eq. 8 of Deng et al. 2022 with amplitude one: relative to the peak, for otherwise the angle would
    /// depend on the unit of radiance). -1 if it is nowhere so low.
    pub fn support_cos(&self, epsilon: f32) -> f32 {
        (1.0 + epsilon.ln() / self.sharpness).clamp(-1.0, 1.0)
    }
}

/// See the module.
#[derive(Clone, Debug, PartialEq)]
pub struct SphericalGaussians {
    lobes: Vec<SphericalGaussian>,
    weights: Vec<f32>,
}

/// Directions with the light that comes from them.
#[derive(Clone, Copy, Debug)]
pub struct Light<'a> {
    /// Unit vectors towards the light.
    pub directions: &'a [Vec3],
    /// What each stands for: radiance times solid angle, not negative.
    pub weights: &'a [f32],
}

impl Light<'_> {
    fn check(&self) -> Result<f64> {
        let refuse = |name: &'static str, value: String, reason: &str| {
            Err(Error::Parameter {
                name,
                value,
                reason: reason.into(),
            })
        };
        if self.directions.len() != self.weights.len() || self.directions.is_empty() {
            let value = format!("{} and {}", self.directions.len(), self.weights.len());
            return refuse(
                "directions",
                value,
                "must be as many as weights, and at least one",
            );
        }
        if let Some(x) = self.directions.iter().find(|x| !x.is_normalized()) {
            return refuse("directions", x.to_string(), "must be unit vectors");
        }
        if let Some(w) = self.weights.iter().find(|w| !w.is_finite() || **w < 0.0) {
            return refuse("weights", w.to_string(), "must be finite and not negative");
        }
        let total: f64 = self.weights.iter().map(|&w| f64::from(w)).sum();
        if total > 0.0 {
            Ok(total)
        } else {
            refuse(
                "weights",
                "0".into(),
                "must not all be zero: the environment is black",
            )
        }
    }
}

impl SphericalGaussians {
    /// Fits at most `count` lobes, fewer if the light has fewer directions.
    ///
    /// # Errors
    /// `count` outside [1, [`MAX_LOBES`]]; directions or weights outside their domains; no light at all.
    pub fn fit(light: Light, count: usize, seed: u64) -> Result<Self> {
        if !(1..=MAX_LOBES).contains(&count) {
            return Err(Error::Parameter {
                name: "lobes",
                value: count.to_string(),
                reason: format!("must be a number of lobes in [1, {MAX_LOBES}]"),
            });
        }
        let total = light.check()?;
        let mut mixture = Self::around(centres(light, count, seed), count);
        let mut likelihood = f64::NEG_INFINITY;
        for _ in 0..MAX_ITERATIONS {
            let sums = mixture.sums(light);
            mixture = Self::maximised(&sums.lobes, total);
            let reached = sums.likelihood / total;
            if reached - likelihood < LEAST_GAIN {
                break;
            }
            likelihood = reached;
        }
        // The weights belong to the shares of the lobes as they are, not as they were.
        let weights = mixture.sums(light).lobes;
        mixture.weights = weights.iter().map(|lobe| (lobe.weight / total) as f32).collect();
        Ok(mixture)
    }

    fn around(centres: Vec<Vec3>, count: usize) -> Self {
        let weights = vec![1.0 / centres.len() as f32; centres.len()];
        // Each covers its part of the sphere: a standard deviation of sqrt(1 / lambda).
        let sharpness = count as f32;
        let lobe = |axis| SphericalGaussian { axis, sharpness };
        Self {
            lobes: centres.into_iter().map(lobe).collect(),
            weights,
        }
    }

    fn maximised(sums: &[LobeSum], total: f64) -> Self {
        let kept = sums.iter().filter(|sum| sum.weight > LEAST_WEIGHT * total);
        let (lobes, weights) = kept
            .map(|sum| {
                let resultant = sum.vector.length() / sum.weight;
                let lobe = SphericalGaussian {
                    axis: sum.vector.try_normalize().unwrap_or(DVec3::Z).as_vec3(),
                    sharpness: sharpness_of(resultant) as f32,
                };
                (lobe, (sum.weight / total) as f32)
            })
            .unzip();
        Self { lobes, weights }
    }

    /// Lobes of a fit made before, with their shares of the light.
    ///
    /// # Errors
    /// Not as many weights as lobes; none or more than [`MAX_LOBES`]; axes that are not unit vectors; sharpness or weights
    /// outside their domains, or weights that do not sum to one.
    pub fn from_lobes(lobes: Vec<SphericalGaussian>, weights: Vec<f32>) -> Result<Self> {
        let refuse = |name, value: String, reason: &str| Err(Error::parameter(name, value, reason));
        if lobes.len() != weights.len() || !(1..=MAX_LOBES).contains(&lobes.len()) {
            let value = format!("{} and {} weights", lobes.len(), weights.len());
            return refuse("lobes", value, "must be 1 to 1024, each with its weight");
        }
        if let Some(lobe) = lobes.iter().find(|lobe| !lobe.axis.is_normalized()) {
            return refuse("axis", lobe.axis.to_string(), "must be a unit vector");
        }
        let (least, most) = (SHARPNESS.0 as f32, SHARPNESS.1 as f32);
        if let Some(lobe) = lobes
            .iter()
            .find(|lobe| !(least..=most).contains(&lobe.sharpness))
        {
            return refuse(
                "sharpness",
                lobe.sharpness.to_string(),
                "must be in [0.001, 300000]",
            );
        }
        if let Some(weight) = weights.iter().find(|&&w| !(w > 0.0 && w.is_finite())) {
            return refuse("weight", weight.to_string(), "must be positive and finite");
        }
        let total: f64 = weights.iter().map(|&w| f64::from(w)).sum();
        if (total - 1.0).abs() > 1e-3 {
            return refuse("weight", total.to_string(), "must sum to one over the lobes");
        }
        Ok(Self { lobes, weights })
    }

    /// The same light in another frame; the columns of `axes` are where x, y and z are there: unit vectors at
    /// right angles.
    pub fn turned(&self, axes: &Mat3) -> Self {
        let turn = |lobe: &SphericalGaussian| SphericalGaussian {
            axis: (*axes * lobe.axis).normalize_or(Vec3::Z),
            ..*lobe
        };
        Self {
            lobes: self.lobes.iter().map(turn).collect(),
            weights: self.weights.clone(),
        }
    }

    /// The lobes; their integrals are one.
    pub fn lobes(&self) -> &[SphericalGaussian] {
        &self.lobes
    }

    /// The lobes' shares of the light; they sum to one.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// The mixture's density at the unit vector `x`, per solid angle.
    pub fn density(&self, x: Vec3) -> f32 {
        let terms = self.lobes.iter().zip(&self.weights);
        terms.map(|(lobe, weight)| weight * lobe.density(x)).sum()
    }

    /// The light of each lobe in each channel, lobe by lobe: `values` has `channels` numbers a direction, each
    /// radiance times solid angle. Over the lobes they sum to the sums over the directions, up to rounding.
    ///
    /// # Panics
    /// If `values` are not `channels` for each direction.
    pub fn energies(&self, directions: &[Vec3], values: &[f32], channels: usize) -> Vec<f64> {
        assert_eq!(values.len(), directions.len() * channels);
        let mut energies = vec![0.0; self.lobes.len() * channels];
        let mut shares = vec![0.0; self.lobes.len()];
        let log_peaks = self.log_peaks();
        for (x, value) in directions.iter().zip(values.chunks_exact(channels)) {
            self.shares(&log_peaks, *x, &mut shares);
            for (energy, share) in energies.chunks_exact_mut(channels).zip(&shares) {
                for (sum, &channel) in energy.iter_mut().zip(value) {
                    *sum += share * f64::from(channel);
                }
            }
        }
        energies
    }

    /// The share of the light that the mixture has elsewhere: `integral of max(L - m, 0)` over the sphere, in [0, 1],
    /// `L` normalised to one. `densities` are those with which the directions were drawn or cover the sphere,
    /// per solid angle, so that `weight / density` is in proportion to the radiance and sums to its integral.
    pub fn residual(&self, light: Light, radiances: &[f32]) -> f64 {
        let total: f64 = light.weights.iter().map(|&w| f64::from(w)).sum();
        let terms = light.directions.iter().zip(light.weights).zip(radiances);
        terms
            .filter(|(_, radiance)| **radiance > 0.0)
            .map(|((x, weight), radiance)| {
                let excess = 1.0 - total * f64::from(self.density(*x)) / f64::from(*radiance);
                f64::from(*weight) / total * excess.max(0.0)
            })
            .sum()
    }

    /// `ln (pi_k v_k)` of every lobe on its axis.
    fn log_peaks(&self) -> Vec<f64> {
        let lobes = self.lobes.iter().zip(&self.weights);
        lobes
            .map(|(lobe, &weight)| f64::from(weight * lobe.peak()).ln())
            .collect()
    }

    /// `pi_k v_k(x) / m(x)` of all lobes, and `ln m(x)`.
    fn shares(&self, log_peaks: &[f64], x: Vec3, shares: &mut [f64]) -> f64 {
        // By logarithms: far from all lobes every density underflows.
        let mut largest = f64::NEG_INFINITY;
        for ((share, lobe), &log_peak) in shares.iter_mut().zip(&self.lobes).zip(log_peaks) {
            let chord2 = (x - lobe.axis).length_squared();
            *share = log_peak - f64::from(0.5 * lobe.sharpness * chord2);
            largest = largest.max(*share);
        }
        let mut sum = 0.0;
        for share in shares.iter_mut() {
            *share = f64::from(((*share - largest) as f32).exp());
            sum += *share;
        }
        shares.iter_mut().for_each(|share| *share /= sum);
        largest + sum.ln()
    }

    fn sums(&self, light: Light) -> Sums {
        let log_peaks = self.log_peaks();
        let chunks = light
            .directions
            .par_chunks(CHUNK)
            .zip(light.weights.par_chunks(CHUNK));
        let sums: Vec<Sums> = chunks
            .map(|(directions, weights)| {
                let mut sums = Sums::new(self.lobes.len());
                let mut shares = vec![0.0; self.lobes.len()];
                for (&x, &weight) in directions.iter().zip(weights) {
                    let weight = f64::from(weight);
                    if weight > 0.0 {
                        sums.likelihood += weight * self.shares(&log_peaks, x, &mut shares);
                        sums.add(x.as_dvec3(), weight, &shares);
                    }
                }
                sums
            })
            .collect();
        let mut total = Sums::new(self.lobes.len());
        sums.iter().for_each(|part| total.merge(part));
        total
    }
}

/// What maximisation needs of a lobe.
#[derive(Clone, Copy, Default)]
struct LobeSum {
    weight: f64,
    vector: DVec3,
}

struct Sums {
    lobes: Vec<LobeSum>,
    likelihood: f64,
}

impl Sums {
    fn new(lobes: usize) -> Self {
        Self {
            lobes: vec![LobeSum::default(); lobes],
            likelihood: 0.0,
        }
    }

    fn add(&mut self, x: DVec3, weight: f64, shares: &[f64]) {
        for (lobe, share) in self.lobes.iter_mut().zip(shares) {
            lobe.weight += weight * share;
            lobe.vector += weight * share * x;
        }
    }

    fn merge(&mut self, other: &Self) {
        self.likelihood += other.likelihood;
        for (lobe, more) in self.lobes.iter_mut().zip(&other.lobes) {
            lobe.weight += more.weight;
            lobe.vector += more.vector;
        }
    }
}

/// Centres in proportion to light and squared distance from the centres before.
fn centres(light: Light, count: usize, seed: u64) -> Vec<Vec3> {
    let mut distances: Vec<f64> = light.weights.iter().map(|&w| f64::from(w)).collect();
    let mut centres = Vec::with_capacity(count);
    for step in 0..count as u64 {
        let total: f64 = distances.iter().sum();
        if total <= 0.0 {
            break;
        }
        let number = mix(mix(seed).wrapping_add((step + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)));
        let mut rest = (number >> 11) as f64 / (1_u64 << 53) as f64 * total;
        let drawn = distances.iter().position(|distance| {
            rest -= distance;
            rest < 0.0
        });
        // Rounding may leave a rest behind the last direction that has any light.
        let last = || distances.iter().rposition(|&distance| distance > 0.0);
        let Some(index) = drawn.or_else(last) else { break };
        let centre = light.directions[index];
        centres.push(centre);
        for (distance, (x, &weight)) in distances
            .iter_mut()
            .zip(light.directions.iter().zip(light.weights))
        {
            *distance = distance.min(f64::from(weight) * f64::from((*x - centre).length_squared()));
        }
    }
    centres
}

/// The sharpness whose mean resultant length is `r = coth(lambda) - 1 / lambda`, by Newton's method from the
/// approximation of Banerjee et al. 2005.
fn sharpness_of(r: f64) -> f64 {
    let r = r.clamp(0.0, 1.0 - 1e-12);
    let mut lambda = (r * (3.0 - r * r) / (1.0 - r * r)).clamp(SHARPNESS.0, SHARPNESS.1);
    for _ in 0..8 {
        let (length, slope) = mean_resultant(lambda);
        lambda = (lambda - (length - r) / slope).clamp(SHARPNESS.0, SHARPNESS.1);
    }
    lambda
}

/// `coth(lambda) - 1 / lambda` and its derivative.
fn mean_resultant(lambda: f64) -> (f64, f64) {
    if lambda < 0.05 {
        // Series: the two terms cancel.
        let x2 = lambda * lambda;
        return (lambda * (1.0 / 3.0 - x2 / 45.0), 1.0 / 3.0 - x2 / 15.0);
    }
    let sinh = lambda.min(300.0).sinh();
    let length = 1.0 / lambda.tanh() - 1.0 / lambda;
    (length, 1.0 / (lambda * lambda) - 1.0 / (sinh * sinh))
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// Equal-area directions: a spiral over the sphere.
    fn sphere(count: usize) -> Vec<Vec3> {
        let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
        (0..count)
            .map(|i| {
                let z = 1.0 - (2 * i + 1) as f64 / count as f64;
                let sin = (1.0 - z * z).sqrt();
                let phi = golden * i as f64;
                DVec3::new(sin * phi.cos(), sin * phi.sin(), z).as_vec3()
            })
            .collect()
    }

    const COUNT: usize = 200_000;

    fn integral(f: impl Fn(Vec3) -> f32) -> f64 {
        let cell = 4.0 * std::f64::consts::PI / COUNT as f64;
        sphere(COUNT).into_iter().map(|x| f64::from(f(x))).sum::<f64>() * cell
    }

    /// A dim sky, a window with sharp edges and a small lamp.
    fn studio(x: Vec3) -> f32 {
        let window = x.x > 0.7 && x.z.abs() < 0.4;
        let lamp = x.dot(Vec3::new(0.0, 0.6, 0.8)) > 0.995;
        0.1 + 0.1 * x.z.max(0.0) + if window { 3.0 } else { 0.0 } + if lamp { 40.0 } else { 0.0 }
    }

    fn fitted(count: usize) -> (SphericalGaussians, Vec<Vec3>, Vec<f32>) {
        let directions = sphere(20_000);
        let weights: Vec<f32> = directions.iter().map(|&x| studio(x)).collect();
        let light = Light {
            directions: &directions,
            weights: &weights,
        };
        (
            SphericalGaussians::fit(light, count, 1).unwrap(),
            directions,
            weights,
        )
    }

    #[test]
    fn densities_integrate_to_one() {
        for sharpness in [1e-3, 0.1, 1.0, 30.0, 1000.0] {
            let lobe = SphericalGaussian {
                axis: Vec3::new(0.6, 0.0, 0.8),
                sharpness,
            };
            assert_relative_eq!(integral(|x| lobe.density(x)), 1.0, max_relative = 2e-3);
        }
        let (mixture, ..) = fitted(32);
        assert_relative_eq!(integral(|x| mixture.density(x)), 1.0, max_relative = 5e-3);
        assert_relative_eq!(mixture.weights.iter().sum::<f32>(), 1.0, max_relative = 1e-5);
    }

    /// Chi-square of drawn directions over 8 x 16 cells of equal angle about the axis: in each, density times
    /// solid angle. 127 degrees of freedom, standard deviation 16: 127 + 6 * 16 is not reached by chance.
    fn chi_square(lobe: &SphericalGaussian, density: impl Fn(f64) -> f64) -> f64 {
        const DRAWS: usize = 200_000;
        let (a, b) = lobe.axis.any_orthonormal_pair();
        // Quantiles of the exact distribution of the cosine, from the numerical integral of `density`.
        let cells = 4096;
        let cumulated: Vec<f64> = (0..cells)
            .scan(0.0, |sum, i| {
                let drop = lobe_extent(lobe) * (i as f64 + 0.5) / cells as f64;
                *sum += density(drop) * std::f64::consts::TAU * lobe_extent(lobe) / cells as f64;
                Some(*sum)
            })
            .collect();
        let mut counts = [[0.0; 16]; 8];
        for i in 0..DRAWS {
            let z = mix(i as u64 + 1);
            let u = [z >> 40, (z >> 16) & 0xff_ffff].map(|k| k as f32 / 16_777_216.0);
            let x = lobe.sample(u);
            let drop = 0.5 * f64::from((x - lobe.axis).length_squared());
            let index = ((drop / lobe_extent(lobe) * cells as f64) as usize).min(cells - 1);
            let phi = f64::from(x.dot(b).atan2(x.dot(a)).rem_euclid(std::f32::consts::TAU));
            let column = (phi / std::f64::consts::TAU * 16.0) as usize % 16;
            counts[((cumulated[index] * 8.0) as usize).min(7)][column] += 1.0;
        }
        let expected = DRAWS as f64 / 128.0;
        counts
            .iter()
            .flatten()
            .map(|n: &f64| (n - expected).powi(2) / expected)
            .sum()
    }

    /// 1 - cos up to which practically all of a lobe lies.
    fn lobe_extent(lobe: &SphericalGaussian) -> f64 {
        (20.0 / f64::from(lobe.sharpness)).min(2.0)
    }

    #[test]
    fn directions_are_drawn_with_the_density() {
        for sharpness in [0.01, 1.5, 40.0, 5000.0] {
            let lobe = SphericalGaussian {
                axis: Vec3::new(0.36, -0.48, 0.8),
                sharpness,
            };
            let at = |lobe: SphericalGaussian| {
                move |drop: f64| f64::from(lobe.peak()) * (-f64::from(lobe.sharpness) * drop).exp()
            };
            // The borders of the eight rings are rounded to cells: allow for a quarter of a percent.
            assert!(
                chi_square(&lobe, at(lobe)) < 127.0 + 6.0 * 16.0 + 20.0,
                "{sharpness}"
            );
            let twin = SphericalGaussian {
                sharpness: sharpness * 1.3 + 0.3,
                ..lobe
            };
            assert!(chi_square(&lobe, at(twin)) > 1000.0, "{sharpness}");
        }
    }

    #[test]
    fn a_fit_keeps_energy_colour_and_centre_of_gravity() {
        let (mixture, directions, weights) = fitted(32);
        let colours: Vec<f32> = directions
            .iter()
            .zip(&weights)
            .flat_map(|(x, w)| [w * (1.0 + x.z), *w, w * (1.0 - x.y)])
            .collect();
        let energies = mixture.energies(&directions, &colours, 3);
        for channel in 0..3 {
            let sum: f64 = energies.iter().skip(channel).step_by(3).sum();
            let expected: f64 = colours
                .iter()
                .skip(channel)
                .step_by(3)
                .map(|&c| f64::from(c))
                .sum();
            assert_relative_eq!(sum, expected, max_relative = 1e-9);
        }
        let total: f64 = weights.iter().map(|&w| f64::from(w)).sum();
        let light = directions.iter().zip(&weights);
        let gravity: DVec3 = light.map(|(x, &w)| x.as_dvec3() * f64::from(w) / total).sum();
        let lobes = mixture.lobes.iter().zip(&mixture.weights);
        let mixed: DVec3 = lobes
            .map(|(lobe, &w)| lobe.axis.as_dvec3() * mean_resultant(lobe.sharpness.into()).0 * f64::from(w))
            .sum();
        assert!((gravity - mixed).length() < 5e-3, "{gravity} {mixed}");
    }

    #[test]
    fn more_lobes_leave_less() {
        let mut before = 1.0;
        for count in [1, 8, 32, 128] {
            let (mixture, directions, weights) = fitted(count);
            let light = Light {
                directions: &directions,
                weights: &weights,
            };
            let cell = 4.0 * std::f32::consts::PI / directions.len() as f32;
            let radiances: Vec<f32> = weights.iter().map(|w| w / cell).collect();
            let residual = mixture.residual(light, &radiances);
            assert!(residual < before, "{count}: {residual}");
            before = residual;
        }
        assert!(before < 0.15, "{before}");
    }

    #[test]
    fn a_known_mixture_is_found_again() {
        let lobes = [
            (Vec3::new(0.6, 0.0, 0.8), 50.0, 0.7),
            (Vec3::new(0.0, -1.0, 0.0), 8.0, 0.3),
        ];
        let directions = sphere(20_000);
        let density = |x: Vec3| {
            lobes.iter().map(move |&(axis, sharpness, weight)| {
                weight * SphericalGaussian { axis, sharpness }.density(x)
            })
        };
        let weights: Vec<f32> = directions.iter().map(|&x| density(x).sum()).collect();
        let light = Light {
            directions: &directions,
            weights: &weights,
        };
        let mixture = SphericalGaussians::fit(light, 2, 7).unwrap();
        for (axis, sharpness, weight) in lobes {
            let near = mixture
                .lobes
                .iter()
                .position(|lobe| lobe.axis.dot(axis) > 0.999)
                .unwrap();
            assert_relative_eq!(mixture.lobes[near].sharpness, sharpness, max_relative = 0.03);
            assert_relative_eq!(mixture.weights[near], weight, max_relative = 0.01);
        }
    }

    #[test]
    fn threads_do_not_matter() {
        let fit = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| fitted(16).0)
        };
        assert_eq!(fit(1), fit(3));
    }

    #[test]
    fn supports_are_where_the_lobe_is_low() {
        let lobe = SphericalGaussian {
            axis: Vec3::Z,
            sharpness: 20.0,
        };
        let cos = lobe.support_cos(0.3);
        let x = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
        assert_relative_eq!(lobe.density(x) / lobe.density(Vec3::Z), 0.3, max_relative = 1e-3);
        let wide = SphericalGaussian {
            sharpness: 0.1,
            ..lobe
        };
        assert_eq!(wide.support_cos(0.3), -1.0);
    }

    #[test]
    fn bad_light_is_refused() {
        let fit = |directions: &[Vec3], weights: &[f32], count| {
            let light = Light { directions, weights };
            SphericalGaussians::fit(light, count, 0).map_err(|e| e.to_string())
        };
        assert!(fit(&[Vec3::Z], &[1.0], 0).unwrap_err().contains("lobes"));
        assert!(fit(&[Vec3::Z], &[], 4).unwrap_err().contains("directions"));
        assert!(fit(&[Vec3::Z * 2.0], &[1.0], 4).unwrap_err().contains("unit"));
        assert!(fit(&[Vec3::Z], &[f32::NAN], 4).unwrap_err().contains("weights"));
        assert!(fit(&[Vec3::Z], &[0.0], 4).unwrap_err().contains("black"));
        // A single direction is one lobe, as sharp as lobes may be.
        assert_eq!(fit(&[Vec3::Z], &[1.0], 4).unwrap().lobes().len(), 1);
    }
}
