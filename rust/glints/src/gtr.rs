//! The generalised Trowbridge-Reitz distribution of normals (GTR) and its Smith masking.
//!
//! **Source** Burley, *Physically Based Shading at Disney*, 2012, appendix B (the distribution); Dimov,
//! *Deriving the Smith shadowing function G1 for gamma in (0, 4]*, 2015 (masking); Heitz, *Understanding the
//! Masking-Shadowing Function in Microfacet-Based BRDFs*, 2014, Section 5.1 (the identity used here).
//!
//! ```text
//! D(theta) = c / (alpha^2 cos^2 theta + sin^2 theta)^gamma,
//! ```
//!
//! with `c` such that `D cos` integrates to one over the hemisphere. `gamma = 2` is GGX; a smaller gamma has a
//! longer tail. Atanasov et al. 2021 draw the flakes of a car paint from it (Figure 1: gamma 1.5, alpha
//! 0.002).

use std::f64::consts::{FRAC_1_PI, TAU};

use glam::Vec3;

use crate::error::{Error, Result};

/// Isotropic GTR about +z.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gtr {
    gamma: f64,
    /// alpha^2.
    alpha2: f64,
    /// The factor c of the module.
    scale: f64,
}

impl Gtr {
    /// Exponent `gamma` in (0, 10], roughness `alpha` in [1e-4, 1].
    ///
    /// # Errors
    /// Parameters outside their domains, under the names `gtr_gamma` and `gtr_alpha`.
    pub fn new(gamma: f32, alpha: f32) -> Result<Self> {
        if !(gamma > 0.0 && gamma <= 10.0) {
            let reason = "must be an exponent in (0, 10]; 2 is GGX";
            return Err(Error::parameter("gtr_gamma", gamma, reason));
        }
        if !(1e-4..=1.0).contains(&alpha) {
            return Err(Error::parameter(
                "gtr_alpha",
                alpha,
                "must be a roughness in [0.0001, 1]",
            ));
        }
        let (gamma, alpha2) = (f64::from(gamma), f64::from(alpha).powi(2));
        // The integral of D cos over the hemisphere is pi c times that of s^-gamma over s in [alpha^2, 1],
        // divided by 1 - alpha^2 (s as in `sample`); for alpha = 1, D is constant.
        let width = 1.0 - alpha2;
        let scale = if width == 0.0 {
            FRAC_1_PI
        } else {
            FRAC_1_PI * width / power_integral(gamma, alpha2)
        };
        Ok(Self { gamma, alpha2, scale })
    }

    /// `D` at the angle with cosine `cos` in [0, 1], per solid angle.
    pub fn distribution(&self, cos: f64) -> f64 {
        self.scale * self.base(cos * cos).powf(-self.gamma)
    }

    /// `s = alpha^2 cos^2 + sin^2` as a function of `cos^2`.
    fn base(&self, cos2: f64) -> f64 {
        self.alpha2 * cos2 + (1.0 - cos2)
    }

    /// The probability of a normal within the angle with cosine `cos`, under the density `D cos`.
    pub fn cumulative(&self, cos: f64) -> f64 {
        if self.alpha2 == 1.0 {
            return 1.0 - cos * cos;
        }
        let inside =
            power_integral(self.gamma, self.alpha2) - power_integral(self.gamma, self.base(cos * cos));
        inside / power_integral(self.gamma, self.alpha2)
    }

    /// Draws a normal with the density `D cos` per solid angle, from two uniform numbers in [0, 1), by
    /// inversion.
    pub fn sample(&self, u: [f64; 2]) -> Vec3 {
        let sin2 = if self.alpha2 == 1.0 {
            u[0]
        } else {
            // (s^k - alpha^2k) / (1 - alpha^2k) = u with k = 1 - gamma, solved for ln s; the limit for k = 0.
            let (k, log_alpha2) = (1.0 - self.gamma, self.alpha2.ln());
            let log_s = if k.abs() < 1e-9 {
                (1.0 - u[0]) * log_alpha2
            } else {
                ((1.0 - u[0]) * (k * log_alpha2).exp_m1()).ln_1p() / k
            };
            ((log_s.exp() - self.alpha2) / (1.0 - self.alpha2)).clamp(0.0, 1.0)
        };
        let (sin_phi, cos_phi) = (TAU * u[1]).sin_cos();
        let sin = sin2.sqrt();
        Vec3::new(
            (sin * cos_phi) as f32,
            (sin * sin_phi) as f32,
            (1.0 - sin2).sqrt() as f32,
        )
    }
}

/// The integral of `s^-gamma` from `low > 0` to 1.
fn power_integral(gamma: f64, low: f64) -> f64 {
    let k = 1.0 - gamma;
    if k.abs() < 1e-9 {
        -low.ln()
    } else {
        -(k * low.ln()).exp_m1() / k
    }
}

/// Smith's `G1` of a [`Gtr`], tabulated.
///
/// There is no closed form for general gamma. The masking function follows from the distribution alone: the
/// visible normals project to the macrosurface, `G1(v) = cos_v / integral of max(0, v . m) D(m) dm`. For an
/// isotropic D the azimuth can be integrated in closed form, and with `x = tan theta_m tan theta_v`
///
/// ```text
/// 1 / G1 - 1 = Lambda(v) = integral over theta_m of h(x) D cos dm,
/// h(x) = (acos(-1/x) + sqrt(x^2 - 1)) / pi - 1   for x > 1, else 0.
/// ```
///
/// The table is over `ln tan theta_v` and interpolated linearly; its error is below 1e-4.
#[derive(Clone, Debug)]
pub struct GtrMasking {
    g1: Vec<f32>,
}

impl GtrMasking {
    const INTERVALS: usize = 512;
    /// The table's domain in `ln tan theta_v`; beyond, the tangent is clamped.
    const LOG_TAN: (f64, f64) = (-12.0, 12.0);

    pub fn new(distribution: &Gtr) -> Self {
        let (low, high) = Self::LOG_TAN;
        let step = (high - low) / Self::INTERVALS as f64;
        let g1 = (0..=Self::INTERVALS)
            .map(|i| (1.0 / (1.0 + lambda(distribution, low + i as f64 * step))) as f32)
            .collect();
        Self { g1 }
    }

    /// `G1` of a direction with cosine `cos` to the surface's normal; zero below the horizon.
    #[inline]
    pub fn g1(&self, cos: f32) -> f32 {
        if cos <= 0.0 {
            return 0.0;
        }
        let tan2 = ((1.0 - cos * cos) / (cos * cos)).max(f32::MIN_POSITIVE);
        let (low, high) = (Self::LOG_TAN.0 as f32, Self::LOG_TAN.1 as f32);
        let position = (0.5 * tan2.ln() - low) / (high - low) * Self::INTERVALS as f32;
        let position = position.clamp(0.0, Self::INTERVALS as f32);
        let i = (position as usize).min(Self::INTERVALS - 1);
        let f = position - i as f32;
        self.g1[i] * (1.0 - f) + self.g1[i + 1] * f
    }

    /// Memory of the table.
    pub fn bytes(&self) -> usize {
        size_of_val(self.g1.as_slice())
    }
}

/// Smith's `Lambda` at `ln tan theta_v`, by the trapezoidal rule over `y = ln x` from 0, where h begins, to
/// where its tail, which falls at least as `e^-y` once `tan theta_m > 1`, is below 1e-8.
fn lambda(distribution: &Gtr, log_tan_v: f64) -> f64 {
    const STEP: f64 = 0.02;
    let last = 20.0 + log_tan_v.max(0.0);
    let steps = (last / STEP) as usize;
    let term = |i: usize| {
        let y = i as f64 * STEP;
        let tan2 = (2.0 * (y - log_tan_v)).exp();
        let cos2 = 1.0 / (1.0 + tan2);
        // D cos dm = 2 pi D cos sin dtheta, and dtheta = cos^2 dtan = cos^2 tan dy.
        let density = TAU * distribution.distribution(cos2.sqrt()) * tan2 * cos2 * cos2;
        let x = y.exp();
        density * (((-1.0 / x).acos() + (x * x - 1.0).max(0.0).sqrt()) * FRAC_1_PI - 1.0)
    };
    (1..=steps).map(term).sum::<f64>() * STEP
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn sampling_inverts_the_cumulative_distribution(
            gamma in 0.1_f32..5.0, log_alpha in -8.0_f32..0.0, u in 0.0..1.0_f64, v in 0.0..1.0_f64
        ) {
            let gtr = Gtr::new(gamma, log_alpha.exp()).unwrap();
            let m = gtr.sample([u, v]);
            prop_assert!((m.length() - 1.0).abs() < 1e-6 && m.z >= 0.0);
            // From the sine: single-precision cosines near one do not resolve the narrow lobes.
            let sin2 = m.truncate().as_dvec2().length_squared();
            prop_assert!((gtr.cumulative((1.0 - sin2).sqrt()) - u).abs() < 1e-5);
        }
    }

    #[test]
    fn the_distribution_is_the_derivative_of_the_cumulative_one() {
        for (gamma, alpha) in [(0.5, 0.3), (1.0, 0.05), (1.5, 0.002), (2.0, 0.1), (3.0, 1.0)] {
            let gtr = Gtr::new(gamma, alpha).unwrap();
            for cos in [0.2_f64, 0.7, 0.99] {
                let d = 1e-6;
                let slope = (gtr.cumulative(cos - d) - gtr.cumulative(cos + d)) / (2.0 * d);
                // dm = 2 pi dcos
                assert_relative_eq!(slope, TAU * gtr.distribution(cos) * cos, max_relative = 1e-4);
            }
            assert_relative_eq!(gtr.cumulative(0.0), 1.0, epsilon = 1e-12);
        }
    }

    #[test]
    fn gamma_two_is_ggx() {
        for alpha in [0.003_f32, 0.1, 0.6, 1.0] {
            let gtr = Gtr::new(2.0, alpha).unwrap();
            let masking = GtrMasking::new(&gtr);
            let alpha2 = f64::from(alpha).powi(2);
            for cos in [1.0_f64, 0.9, 0.5, 0.1, 0.01, 1e-3] {
                let ggx = alpha2 * FRAC_1_PI / (cos * cos * (alpha2 - 1.0) + 1.0).powi(2);
                assert_relative_eq!(gtr.distribution(cos), ggx, max_relative = 1e-6);
                let tan2 = (1.0 - cos * cos) / (cos * cos);
                let expected = 2.0 / (1.0 + (1.0 + alpha2 * tan2).sqrt());
                let found = f64::from(masking.g1(cos as f32));
                assert_relative_eq!(found, expected, epsilon = 1e-4);
            }
        }
    }

    /// For other exponents the identity itself, `cos_v = G1 integral max(0, v . m) D dm`, by sampling.
    #[test]
    fn masking_projects_the_visible_area_to_the_surface() {
        for (gamma, alpha) in [(1.0, 0.3), (1.5, 0.1), (4.0, 0.5)] {
            let gtr = Gtr::new(gamma, alpha).unwrap();
            let masking = GtrMasking::new(&gtr);
            for cos in [0.9_f32, 0.4, 0.15] {
                let v = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
                const SIDE: usize = 1000;
                let mut projected = 0.0;
                for i in 0..SIDE * SIDE {
                    let [w, azimuth] =
                        [(i / SIDE) as f64, (i % SIDE) as f64].map(|x| (x + 0.5) / SIDE as f64);
                    // 1 - u = w^2: the integrand grows as 1 / w towards the horizon.
                    let m = gtr.sample([1.0 - w * w, azimuth]);
                    projected += 2.0 * w * f64::from(m.dot(v).max(0.0) / m.z);
                }
                let area = projected / (SIDE * SIDE) as f64;
                assert_relative_eq!(
                    f64::from(masking.g1(cos)) * area,
                    f64::from(cos),
                    max_relative = 5e-3
                );
            }
        }
    }

    #[test]
    fn parameters_outside_their_domains_are_refused() {
        for (gamma, alpha, name) in [
            (0.0, 0.1, "gtr_gamma"),
            (f32::NAN, 0.1, "gtr_gamma"),
            (1.5, 0.0, "gtr_alpha"),
            (1.5, 2.0, "gtr_alpha"),
        ] {
            let message = Gtr::new(gamma, alpha).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
        }
    }
}
