//! Light of an environment reflected by a filtered NDF: environment prefiltering, Section 5.4 of Deng et al. 2022.
//!
//! **Computes** one draw of the estimator
//!
//! ```text
//! E_k / p_k  F G / (4 (i . n))  mean of D_A over the rectangle of lobe k
//! ```
//!
//! of the light that a mixture of spherical Gaussians, of energies `E_k`, sends to the viewer: lobe `k` is chosen
//! with probability `p_k`, a direction `o` from it (for `F`, `G` and the caller's shadow ray), and the NDF
//! is averaged over the half vectors of the lobe's support ([`crate::half_vector_range`]) instead of being evaluated
//! at one. Energies and Fresnel term are the caller's.
//!
//! **Choice of the lobe** By its energy times a cheap NDF, a Gaussian with the slopes' covariance of the whole
//! map, of a flake and of the lobe; a tenth of the draws goes by energy alone, so that no weight is more than
//! ten times that of such draws, however the footprint differs from the map. What one footprint shows of the map
//! may differ much: several candidates are drawn so, stratified, and one of them is kept in proportion to its
//! reflection (resampled importance sampling; Talbot et al. 2005), which costs a range query each.
//!
//! **What is exact, and what is not** The sum over lobes is unbiased, choice and shadows included. The mean over the
//! rectangle is the approximation: light is moved within its lobe's support. The part of the rectangle outside the
//! disk holds no half vectors and does not count for the mean. The masking of a flake is taken at the half
//! vector instead of its normal. A lobe whose support lies below the horizon has no rectangle; the little
//! that its tail sends above is evaluated at its direction.

use std::f32::consts::TAU;

use arrayvec::ArrayVec;
use glam::{Mat3, Vec2, Vec3};

use crate::brdf::{Brdf, four_uniforms};
use crate::error::{Error, Result};
use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;
use crate::half_vector_range::half_vector_rectangle;
use crate::methods::MAX_RANGES;
use crate::microfacet::Flake;
use crate::normal_map::NormalMap;
use crate::spherical_gaussians::{MAX_LOBES, SphericalGaussian, SphericalGaussians};

/// Share of the draws that chooses lobes by their energy alone.
const DEFENSIVE: f32 = 0.1;

/// Most candidates of a draw.
pub const MAX_CANDIDATES: usize = MAX_RANGES;

/// Least cosine of a half vector that the cheap NDF is evaluated at.
const LEAST_COSINE: f32 = 0.05;

/// One number a lobe.
type Probabilities = ArrayVec<f32, MAX_LOBES>;

/// A mixture and the supports of its lobes.
#[derive(Clone, Debug)]
pub struct Environment {
    mixture: SphericalGaussians,
    support_cos: Vec<f32>,
    candidates: u32,
}

impl Environment {
    /// `epsilon` in (0, 1): the supports are where the lobes are above so many times their peaks (the paper's 0.3).
    /// `candidates` in [1, [`MAX_CANDIDATES`]]: lobes that a draw looks at.
    ///
    /// # Errors
    /// `epsilon` or `candidates` outside its domain.
    pub fn new(mixture: SphericalGaussians, epsilon: f32, candidates: u32) -> Result<Self> {
        if !(1..=MAX_CANDIDATES as u32).contains(&candidates) {
            return Err(Error::Parameter {
                name: "candidates",
                value: candidates.to_string(),
                reason: format!("must be a number of lobes in [1, {MAX_CANDIDATES}]"),
            });
        }
        if !(epsilon > 0.0 && epsilon < 1.0) {
            return Err(Error::parameter(
                "epsilon",
                epsilon,
                "must be in (0, 1): the share of a lobe's peak at the border of its support",
            ));
        }
        let support_cos = mixture
            .lobes()
            .iter()
            .map(|lobe| lobe.support_cos(epsilon))
            .collect();
        Ok(Self {
            mixture,
            support_cos,
            candidates,
        })
    }

    pub fn mixture(&self) -> &SphericalGaussians {
        &self.mixture
    }

    /// See [`SphericalGaussians::turned`].
    pub fn turned(&self, axes: &Mat3) -> Self {
        Self {
            mixture: self.mixture.turned(axes),
            ..self.clone()
        }
    }
}

/// What prefiltering needs of a BRDF besides the method's answers.
#[derive(Clone, Copy, Debug)]
pub struct Prefilter {
    flake: Flake,
    /// Covariance of the slopes of map and flake.
    slopes: [f32; 3],
}

/// One draw: unit energy of the lobe gives `value / probability`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LobeSample {
    pub lobe: usize,
    /// Of the choice of the lobe, positive; among several candidates what stands for it (a random number then, above
    /// one where a candidate was lucky).
    pub probability: f32,
    /// A direction of the lobe above the horizon, in the local frame.
    pub wo: Vec3,
    /// `f cos theta_o` averaged over the lobe, without Fresnel term and colour; not negative.
    pub value: f32,
}

/// A lobe that was chosen and a direction from it, before the NDF is asked.
struct Candidate {
    lobe: usize,
    pair: DirectionPair,
    wo: Vec3,
    /// The half vectors of the lobe's support; `None` where it lies below the horizon.
    rectangle: Option<(Vec2, Vec2)>,
}

impl Prefilter {
    pub fn new(map: &NormalMap, flake: Flake) -> Self {
        let covariance = map.slope_covariance();
        let own = 0.5 * f64::from(flake.alpha()).powi(2);
        Self {
            flake,
            slopes: [covariance.xx + own, covariance.xy, covariance.yy + own].map(|x| x as f32),
        }
    }

    /// Draws a lobe of `environment` and a direction from it; `None`: nothing, which counts as zero.
    ///
    /// `to_local` takes directions of the environment to the local frame; `u`: independent uniform numbers,
    /// `u[0]` chooses the lobe, the others the direction. `brdf`'s method has to answer [`crate::methods::Method::ndf_over`],
    /// or nothing is ever drawn.
    pub fn sample(
        &self,
        brdf: &Brdf,
        footprint: &Footprint,
        wi: Vec3,
        to_local: &Mat3,
        environment: &Environment,
        u: [f32; 3],
    ) -> Option<LobeSample> {
        if wi.z.is_nan() || wi.z <= 0.0 {
            return None;
        }
        let probabilities = self.probabilities(wi, to_local, environment)?;
        let count = environment.candidates;
        let draw = |index: u32| {
            // Strata for the lobes; an additive recurrence for the directions (Roberts 2018).
            let shifted = |u: f32, step: f32| (u + index as f32 * step).fract();
            let lobe = choose(&probabilities, (index as f32 + u[0]) / count as f32)?;
            let local = local_lobe(&environment.mixture.lobes()[lobe], to_local);
            let wo = local.sample([shifted(u[1], 0.754_877_7), shifted(u[2], 0.569_840_3)]);
            Some(Candidate {
                lobe,
                pair: DirectionPair::new(wi, wo)?,
                wo,
                rectangle: half_vector_rectangle(wi, local.axis, environment.support_cos[lobe]),
            })
        };
        let drawn: ArrayVec<Candidate, MAX_CANDIDATES> = (0..count).filter_map(draw).collect();
        let values = self.values(brdf, footprint, wi, &drawn)?;
        let candidates = drawn.iter().zip(values).map(|(candidate, value)| LobeSample {
            lobe: candidate.lobe,
            probability: probabilities[candidate.lobe],
            wo: candidate.wo,
            value,
        });
        let candidates: ArrayVec<LobeSample, MAX_CANDIDATES> = candidates.collect();
        if count == 1 {
            return candidates.first().copied();
        }
        // The reflection of each, by the luminance of its lobe.
        let reflected = |s: &LobeSample| environment.mixture.weights()[s.lobe] * s.value / s.probability;
        let total: f32 = candidates.iter().map(reflected).sum();
        let mut rest = four_uniforms(u)[0] * total;
        let mut visible = candidates.iter().filter(|s| s.value > 0.0);
        let found = visible.clone().find(|s| {
            rest -= reflected(s);
            rest < 0.0
        });
        // Rounding may leave a rest behind the last one.
        let kept = found.or_else(|| visible.next_back())?;
        let probability = environment.mixture.weights()[kept.lobe] * kept.value * count as f32 / total;
        Some(LobeSample { probability, ..*kept })
    }

    /// The reflection of each candidate's lobe; one question about the NDF for all.
    fn values(
        &self,
        brdf: &Brdf,
        footprint: &Footprint,
        wi: Vec3,
        candidates: &[Candidate],
    ) -> Option<ArrayVec<f32, MAX_CANDIDATES>> {
        let rectangles = candidates.iter().filter_map(|candidate| candidate.rectangle);
        let rectangles: ArrayVec<(Vec2, Vec2), MAX_CANDIDATES> = rectangles.collect();
        let mut means = brdf.method().ndf_over_all(footprint, &rectangles)?.into_iter();
        let value = |candidate: &Candidate| match candidate.rectangle {
            Some(rectangle) => Some(self.averaged(brdf, &candidate.pair, rectangle, means.next()?)),
            None => Some(brdf.evaluate(footprint, wi, candidate.wo).value),
        };
        candidates.iter().map(value).collect()
    }

    /// `G / (4 (i . n))` times the mean of the NDF over the part of the rectangle inside the disk; `mean`: over all of it.
    fn averaged(&self, brdf: &Brdf, pair: &DirectionPair, (low, high): (Vec2, Vec2), mean: f32) -> f32 {
        let flake = self.flake.smith_g1(pair.wi.dot(pair.half)) * self.flake.smith_g1(pair.wo.dot(pair.half));
        let inside = share_inside_disk(low, high);
        mean / inside * flake * brdf.masking(pair) / (4.0 * pair.wi.z)
    }

    /// The probabilities of the lobes, which sum to one; `None` if no lobe has light above the horizon.
    fn probabilities(&self, wi: Vec3, to_local: &Mat3, environment: &Environment) -> Option<Probabilities> {
        let mixture = &environment.mixture;
        let lobes = mixture.lobes().iter().zip(mixture.weights());
        let scores: ArrayVec<(f32, f32), MAX_LOBES> = lobes
            .map(|(lobe, &weight)| {
                let local = local_lobe(lobe, to_local);
                let light = weight * share_above_horizon(&local);
                (light, light * self.cheap_ndf(wi, &local))
            })
            .collect();
        let (light, guided) = scores
            .iter()
            .fold((0.0, 0.0), |sum: (f32, f32), s| (sum.0 + s.0, sum.1 + s.1));
        if light.is_nan() || light <= 0.0 {
            return None;
        }
        let (by_light, by_guide) = if guided > 0.0 {
            (DEFENSIVE / light, (1.0 - DEFENSIVE) / guided)
        } else {
            (1.0 / light, 0.0)
        };
        let probability = |&(light, guided): &(f32, f32)| light * by_light + guided * by_guide;
        Some(scores.iter().map(probability).collect())
    }

    /// The NDF of Gaussian slopes of map, flake and lobe at the lobe's half vector, per solid angle.
    fn cheap_ndf(&self, wi: Vec3, lobe: &SphericalGaussian) -> f32 {
        // A lobe with its axis below the horizon reflects from its part above, the nearest is on the horizon.
        let axis = lobe.axis.with_z(lobe.axis.z.max(0.0));
        let half = (wi + axis.normalize_or(Vec3::Z)).normalize_or(Vec3::Z);
        let cos2 = half.z.max(LEAST_COSINE).powi(2);
        // A half vector turns by half the angle; a slope changes with its cosine squared.
        let blur = 0.25 / (lobe.sharpness.max(1.0) * cos2 * cos2);
        let [xx, xy, yy] = [self.slopes[0] + blur, self.slopes[1], self.slopes[2] + blur];
        let determinant = (xx * yy - xy * xy).max(f32::MIN_POSITIVE);
        let (x, y) = (
            half.x / half.z.max(LEAST_COSINE),
            half.y / half.z.max(LEAST_COSINE),
        );
        let form = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant;
        (-0.5 * form).exp() / (TAU * determinant.sqrt() * cos2 * cos2)
    }
}

/// The lobe under `u` in the cumulated probabilities.
fn choose(probabilities: &Probabilities, u: f32) -> Option<usize> {
    let mut rest = u;
    let found = probabilities.iter().position(|probability| {
        rest -= probability;
        rest < 0.0
    });
    // Rounding may leave a rest behind the last one.
    found.or_else(|| probabilities.iter().rposition(|&probability| probability > 0.0))
}

fn local_lobe(lobe: &SphericalGaussian, to_local: &Mat3) -> SphericalGaussian {
    SphericalGaussian {
        axis: (*to_local * lobe.axis).normalize_or(Vec3::Z),
        ..*lobe
    }
}

/// About the share of a lobe above the horizon, positive: for choices, not for energies.
fn share_above_horizon(lobe: &SphericalGaussian) -> f32 {
    1.0 / (1.0 + (-1.7 * lobe.axis.z * lobe.sharpness.sqrt()).min(40.0).exp())
}

/// The share of the rectangle's area that is inside the unit disk; one for an empty rectangle.
fn share_inside_disk(low: Vec2, high: Vec2) -> f32 {
    let farthest = low.abs().max(high.abs());
    if farthest.length_squared() <= 1.0 || !low.cmplt(high).all() {
        return 1.0;
    }
    let (low, high) = (low.as_dvec2(), high.as_dvec2());
    // Area between y = 0 and y = top, along x from low to high, inside the disk; odd in `top`.
    let area_below = |top: f64| {
        let (left, right) = (low.x.max(-1.0), high.x.min(1.0));
        // Where the disk is higher than `top`: a strip, beside it the disk.
        let reach = (1.0 - top * top).max(0.0).sqrt();
        let (a, b) = (left.clamp(-reach, reach), right.clamp(-reach, reach));
        let strip = top.abs() * (b - a);
        let under_arc = |x: f64| 0.5 * (x * (1.0 - x * x).max(0.0).sqrt() + x.clamp(-1.0, 1.0).asin());
        let arcs = under_arc(right) - under_arc(left) - (under_arc(b) - under_arc(a));
        (strip + arcs).copysign(top)
    };
    let area = area_below(high.y) - area_below(low.y);
    let extent = high - low;
    (area / (extent.x * extent.y)).clamp(1e-3, 1.0) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::brdf::Masking;
    use crate::flakes::{FlakeModel, Normalization};
    use crate::methods::direct::Direct;
    use crate::microfacet::Distribution;
    use crate::spherical_gaussians::Light;
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    fn sphere(count: usize) -> Vec<Vec3> {
        let golden = std::f32::consts::PI * (3.0 - 5.0_f32.sqrt());
        (0..count)
            .map(|i| {
                let z = 1.0 - (2 * i + 1) as f32 / count as f32;
                let phi = golden * i as f32;
                let sin = (1.0 - z * z).sqrt();
                Vec3::new(sin * phi.cos(), sin * phi.sin(), z).normalize()
            })
            .collect()
    }

    fn environment(radiance: impl Fn(Vec3) -> f32, lobes: usize) -> Environment {
        let directions = sphere(20_000);
        let weights: Vec<f32> = directions.iter().map(|&x| radiance(x)).collect();
        let light = Light {
            directions: &directions,
            weights: &weights,
        };
        Environment::new(SphericalGaussians::fit(light, lobes, 3).unwrap(), 0.3, 1).unwrap()
    }

    fn surface(alpha: f32) -> (Brdf, Prefilter) {
        let normal = |i: u32| {
            let (a, b) = ((i as f32 * 2.399).sin(), (i as f32 * 1.713).cos());
            Vec3::new(0.25 * a, 0.25 * b, 1.0).normalize()
        };
        let normals: Vec<Vec3> = (0..32 * 32).map(normal).collect();
        let map = NormalMap::from_normals("test", 32, 32, &normals).unwrap();
        let flake = Flake::new(Distribution::Beckmann, alpha).unwrap();
        let model = FlakeModel {
            flake,
            normalization: Normalization::Projected,
        };
        let direct = Direct::new(map.clone(), model);
        let brdf = Brdf::new(&map, Masking::None, || Ok(Box::new(direct))).unwrap();
        (brdf, Prefilter::new(&map, flake))
    }

    /// Mean and its standard error of the reflected light, total energy one, over 4096 stratified draws.
    fn reflected(surface: &(Brdf, Prefilter), width: f32, wi: Vec3, environment: &Environment) -> (f64, f64) {
        let (brdf, prefilter) = surface;
        let footprint = brdf.footprint([0.4, 0.6], [width, 0.0], [0.0, width]);
        const DRAWS: usize = 4096;
        let (mut sum, mut squares) = (0.0, 0.0);
        for i in 0..DRAWS {
            let z = crate::hash::mix(i as u64 + 99);
            let u = [
                (i as f32 + 0.5) / DRAWS as f32,
                (z >> 40) as f32 / 16_777_216.0,
                ((z >> 16) & 0xff_ffff) as f32 / 16_777_216.0,
            ];
            let drawn = prefilter.sample(brdf, &footprint, wi, &Mat3::IDENTITY, environment, u);
            let value = drawn.map_or(0.0, |d| {
                f64::from(environment.mixture.weights()[d.lobe] * d.value / d.probability)
            });
            sum += value;
            squares += value * value;
        }
        let mean = sum / DRAWS as f64;
        (
            mean,
            ((squares / DRAWS as f64 - mean * mean) / DRAWS as f64).sqrt(),
        )
    }

    /// The same light without prefilter: the BRDF at many directions of the sphere.
    fn point_by_point(
        surface: &(Brdf, Prefilter),
        width: f32,
        wi: Vec3,
        radiance: impl Fn(Vec3) -> f32,
    ) -> f64 {
        let brdf = &surface.0;
        let footprint = brdf.footprint([0.4, 0.6], [width, 0.0], [0.0, width]);
        let (mut sum, mut light) = (0.0, 0.0);
        for x in sphere(40_000) {
            let weight = f64::from(radiance(x));
            light += weight;
            if x.z > 0.0 {
                sum += weight * f64::from(brdf.evaluate(&footprint, wi, x).value);
            }
        }
        sum / light
    }

    /// Under constant light the lobes overlap evenly: the mean differs by the ripple of their boxes only.
    #[test]
    fn constant_light_is_kept() {
        let surface = surface(0.05);
        let environment = environment(|_| 1.0, 64);
        let mut ratios = Vec::new();
        for (theta, phi) in [(0.0_f32, 0.0_f32), (0.3, 1.0), (0.6, 4.0), (0.9, 2.5)] {
            let wi = Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            let (found, _) = reflected(&surface, 0.2, wi, &environment);
            ratios.push(found / point_by_point(&surface, 0.2, wi, |_| 1.0));
        }
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        println!("constant light: {ratios:?}");
        assert!(
            ratios.iter().all(|ratio| (ratio - 1.0).abs() < 0.15),
            "{ratios:?}"
        );
        assert!((mean - 1.0).abs() < 0.08, "{ratios:?}");
    }

    /// A light that is itself a spherical Gaussian much narrower than the NDF: nothing to approximate.
    #[test]
    fn narrow_light_is_exact() {
        let surface = surface(0.15);
        let axis = Vec3::new(0.3, -0.1, 0.9).normalize();
        let lobe = SphericalGaussian {
            axis,
            sharpness: 600.0,
        };
        let environment = environment(|x| lobe.density(x), 1);
        let wi = Vec3::new(-0.2, 0.3, 1.0).normalize();
        let (found, error) = reflected(&surface, 0.2, wi, &environment);
        let expected = point_by_point(&surface, 0.2, wi, |x| lobe.density(x));
        assert!(error < 0.005 * found);
        assert_relative_eq!(found, expected, max_relative = 0.03);
        // Twin: the support of the mixture in which everything is in the rectangle.
        let wide = Environment {
            support_cos: vec![-1.0],
            ..environment
        };
        let (twin, _) = reflected(&surface, 0.2, wi, &wide);
        assert!((twin / expected - 1.0).abs() > 0.15, "{twin} {expected}");
    }

    /// The draws sum up what all lobes together reflect: probabilities are right.
    #[test]
    fn draws_are_unbiased_over_the_lobes() {
        let surface = surface(0.05);
        let environment = environment(|x| 0.1 + (4.0 * x.x + 3.0 * x.z).exp(), 12);
        let wi = Vec3::new(-0.4, 0.1, 1.0).normalize();
        let (brdf, prefilter) = &surface;
        let mut chosen = [0.0; 12];
        let probabilities = prefilter
            .probabilities(wi, &Mat3::IDENTITY, &environment)
            .unwrap();
        const DRAWS: usize = 100_000;
        for i in 0..DRAWS {
            let u = (i as f32 + 0.5) / DRAWS as f32;
            chosen[choose(&probabilities, u).unwrap()] += 1.0 / DRAWS as f32;
        }
        for (frequency, probability) in chosen.iter().zip(&probabilities) {
            assert_relative_eq!(frequency, probability, epsilon = 1e-4);
        }
        // Far less scatter than by energy alone, the point of the cheap NDF.
        let (mean, error) = reflected(&surface, 0.2, wi, &environment);
        assert!(error < 0.015 * mean, "{mean} {error}");
        let footprint = brdf.footprint([0.4, 0.6], [0.2, 0.0], [0.0, 0.2]);
        let mut draws = (0..1000).map(|i| i as f32 / 1000.0);
        let sample = |u| {
            prefilter.sample(
                brdf,
                &footprint,
                -wi,
                &Mat3::IDENTITY,
                &environment,
                [u, 0.5, 0.5],
            )
        };
        assert!(draws.all(|u| sample(u).is_none()));
    }

    /// The same mean with candidates, with far less scatter where a footprint differs from the map.
    #[test]
    fn candidates_change_the_noise_alone() {
        let surface = surface(0.02);
        let one = environment(|x| 0.1 + (4.0 * x.x + 3.0 * x.z).exp(), 24);
        let wi = Vec3::new(-0.4, 0.1, 1.0).normalize();
        let several = Environment {
            candidates: 8,
            ..one.clone()
        };
        let (mean, error) = reflected(&surface, 0.05, wi, &one);
        let (found, less) = reflected(&surface, 0.05, wi, &several);
        println!("candidates: {mean} +- {error}, {found} +- {less}");
        assert!((found - mean).abs() < 4.0 * (error.hypot(less)));
        assert!(error < 0.1 * mean && less < 0.6 * error, "{error} {less}");
    }

    #[test]
    fn epsilon_outside_its_domain_is_refused() {
        let mixture = environment(|_| 1.0, 2).mixture;
        for epsilon in [0.0, 1.0, f32::NAN] {
            let message = Environment::new(mixture.clone(), epsilon, 1)
                .unwrap_err()
                .to_string();
            assert!(message.contains("\"epsilon\""), "{message}");
        }
    }

    proptest! {
        #[test]
        fn shares_of_rectangles_inside_the_disk(
            x0 in -1.2..1.0_f32, y0 in -1.2..1.0_f32, width in 0.05..2.0_f32, height in 0.05..2.0_f32,
        ) {
            let (low, high) = (Vec2::new(x0, y0), Vec2::new(x0 + width, y0 + height));
            const SIDE: usize = 300;
            let inside = (0..SIDE * SIDE).filter(|i| {
                let cell = Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5) / SIDE as f32;
                (low + cell * (high - low)).length_squared() <= 1.0
            });
            let expected = (inside.count() as f32 / (SIDE * SIDE) as f32).clamp(1e-3, 1.0);
            prop_assert!((share_inside_disk(low, high) - expected).abs() < 5e-3);
        }
    }
}
