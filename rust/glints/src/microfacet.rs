//! The micro-BRDF of a flake: Beckmann or GGX distribution and Smith shadowing (Walter et al. 2007), about any
//! normal.
//!
//! Section 5.1 of Atanasov et al. 2021 makes the normal explicit, `D^alpha(h, t)` and `G^alpha(i, o, h, t)`,
//! because every texel of a normal map carries its own micro-BRDF about its own normal `t`. All vectors are
//! unit vectors in the local shading frame; `alpha` is the roughness of the flake.

use glam::Vec3;

use crate::error::{Error, Result};

/// Exponent beyond which the Beckmann lobe counts as zero: e^-40 = 4e-18 of its peak.
const LARGEST_EXPONENT: f32 = 40.0;

/// The distribution of the microfacets of one flake.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Distribution {
    /// Gaussian slopes, of standard deviation `alpha / sqrt(2)` along each axis: what the published glint
    /// methods use. Nearly all of the lobe is within three standard deviations, `tan <= 2.1 alpha`.
    #[default]
    Beckmann,
    /// Trowbridge and Reitz, "GGX" in Walter et al. 2007: a heavy tail, of which `1 / (1 + x^2)` is beyond
    /// `tan = x alpha`: 18 % beyond Beckmann's three standard deviations, 1 % beyond ten `alpha`. Its slopes
    /// have no finite variance.
    Ggx,
}

/// A rough mirror: the lobe of one flake.
#[derive(Clone, Copy, Debug)]
pub struct Flake {
    kind: Distribution,
    alpha: f32,
    /// 1 / alpha^2.
    inv_alpha2: f32,
    /// Squared chord |h - t|^2 from which on the lobe counts as zero.
    max_chord2: f32,
}

impl Flake {
    /// `alpha` in [1e-4, 1]: below, single-precision directions do not resolve the lobe.
    ///
    /// # Errors
    /// `alpha` outside its domain.
    pub fn new(distribution: Distribution, alpha: f32) -> Result<Self> {
        if !(1e-4..=1.0).contains(&alpha) {
            return Err(Error::parameter(
                "alpha",
                alpha,
                "must be the roughness of a flake in [0.0001, 1]",
            ));
        }
        Ok(Self {
            kind: distribution,
            alpha,
            inv_alpha2: (1.0 / f64::from(alpha).powi(2)) as f32,
            max_chord2: max_chord2(distribution, alpha.into()) as f32,
        })
    }

    pub fn alpha(&self) -> f32 {
        self.alpha
    }

    /// Which distribution it is.
    pub fn kind(&self) -> Distribution {
        self.kind
    }

    /// The distribution `D^alpha(h, t)` per solid angle (Eq. 14; Walter et al. 2007, Eq. 25 and 33), and the
    /// cosine `h . t`.
    ///
    /// The angle comes from the chord `|h - t|`, not from `h . t`: at alpha = 0.0025 the rounding error of a
    /// single-precision cosine is a percent of the exponent.
    #[inline]
    pub fn distribution(&self, h: Vec3, t: Vec3) -> (f32, f32) {
        self.distribution_at_chord2((h - t).length_squared())
    }

    /// The same as a function of the squared chord `|h - t|^2`.
    #[inline]
    pub fn distribution_at_chord2(&self, chord2: f32) -> (f32, f32) {
        if chord2 >= self.max_chord2 {
            return (0.0, 0.0);
        }
        let cos = 1.0 - 0.5 * chord2;
        let cos2 = cos * cos;
        let sin2 = chord2 * (1.0 - 0.25 * chord2);
        let peak = std::f32::consts::FRAC_1_PI * self.inv_alpha2;
        let density = match self.kind {
            Distribution::Beckmann => {
                let tan2 = sin2 / cos2;
                peak * (-tan2 * self.inv_alpha2).exp() / (cos2 * cos2)
            }
            Distribution::Ggx => {
                let form = cos2 + sin2 * self.inv_alpha2;
                peak / (form * form)
            }
        };
        (density, cos)
    }

    /// Whether `D^alpha(h, t)` counts as zero for all of `normals`: true for nearly all blocks of a
    /// glittering map with Beckmann flakes.
    #[inline]
    pub fn misses_all(&self, h: Vec3, normals: &[Vec3]) -> bool {
        let near = |t: &Vec3| (h - *t).length_squared() < self.max_chord2;
        !normals.iter().fold(false, |any, t| any | near(t))
    }

    /// Draws a normal about `t` with the density `D^alpha(m, t) (m . t)` per solid angle.
    #[inline]
    pub fn sample(&self, t: Vec3, u: [f32; 2]) -> Vec3 {
        let rest = (1.0 - u[0]).max(f32::MIN_POSITIVE);
        let tan2 = match self.kind {
            Distribution::Beckmann => -self.alpha * self.alpha * rest.ln(),
            Distribution::Ggx => self.alpha * self.alpha * (u[0] / rest),
        };
        let cos = 1.0 / (1.0 + tan2).sqrt();
        let (sin_phi, cos_phi) = (std::f32::consts::TAU * u[1]).sin_cos();
        let sin = tan2.sqrt() * cos;
        let (x, y) = t.any_orthonormal_pair();
        (x * (sin * cos_phi) + y * (sin * sin_phi) + t * cos).normalize()
    }

    /// Smith's `G1(v, t)` of the flake for `cos = v . t`; zero below the flake's horizon.
    #[inline]
    pub fn smith_g1(&self, cos: f32) -> f32 {
        if cos <= 0.0 {
            return 0.0;
        }
        let tan2 = (1.0 - cos * cos).max(0.0) / (cos * cos);
        let alpha_tan2 = self.alpha * self.alpha * tan2;
        match self.kind {
            Distribution::Beckmann => beckmann_g1(alpha_tan2),
            Distribution::Ggx => ggx_g1(alpha_tan2),
        }
    }
}

/// The squared chord from which on a lobe counts as zero.
///
/// Beckmann's is cut where its exponent is [`LARGEST_EXPONENT`]. GGX is not cut: its tail has no width to cut
/// at (1e-5 of the peak would be at `tan = 18 alpha`, with 0.3 % of the mass beyond), so it ends at the flake's
/// horizon, `h . t = 0`, and leaves nothing out.
fn max_chord2(distribution: Distribution, alpha: f64) -> f64 {
    match distribution {
        Distribution::Beckmann => {
            // tan^2 = x  <=>  cos = 1 / sqrt(1 + x), and |h - t|^2 = 2 - 2 cos.
            let x = f64::from(LARGEST_EXPONENT) * alpha.powi(2);
            2.0 - 2.0 / (1.0 + x).sqrt()
        }
        Distribution::Ggx => 2.0,
    }
}

/// Smith's masking function of the GGX distribution as a function of `(alpha tan theta)^2`, exact (Walter et
/// al. 2007, Eq. 34).
#[inline]
fn ggx_g1(alpha_tan2: f32) -> f32 {
    2.0 / (1.0 + (1.0 + alpha_tan2).sqrt())
}

/// Smith's masking function of the Beckmann distribution as a function of `(alpha tan theta)^2`, in the
/// rational approximation of Walter et al. 2007 (Section 5.2; relative error below 0.35 %), which renderers
/// share.
#[inline]
pub fn beckmann_g1(alpha_tan2: f32) -> f32 {
    if alpha_tan2 * (1.6 * 1.6) <= 1.0 {
        return 1.0;
    }
    let a = 1.0 / alpha_tan2.sqrt();
    (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    #[test]
    fn the_distribution_is_beckmann() {
        let alpha = 0.2;
        let flake = Flake::new(Distribution::Beckmann, alpha).unwrap();
        for theta in [0.0_f64, 0.1, 0.3, 0.7] {
            let t = Vec3::new(0.6, 0.0, 0.8);
            let h = glam::Quat::from_rotation_y(theta as f32) * t;
            let (density, cos) = flake.distribution(h, t);
            let tan2 = theta.tan().powi(2);
            let alpha2 = f64::from(alpha).powi(2);
            let expected = (-tan2 / alpha2).exp() / (std::f64::consts::PI * alpha2 * theta.cos().powi(4));
            assert_relative_eq!(f64::from(density), expected, max_relative = 1e-4);
            assert_relative_eq!(f64::from(cos), theta.cos(), epsilon = 1e-6);
        }
    }

    #[test]
    fn the_heavy_tail_is_ggx_up_to_the_horizon() {
        for alpha in [0.0025, 0.2, 1.0] {
            let flake = Flake::new(Distribution::Ggx, alpha).unwrap();
            let t = Vec3::new(0.6, 0.0, 0.8);
            for theta in [0.0_f64, 0.003, 0.1, 0.7, 1.5, 1.6] {
                let h = glam::Quat::from_rotation_y(theta as f32) * t;
                let (density, cos) = flake.distribution(h, t);
                let alpha2 = f64::from(alpha).powi(2);
                let form = theta.cos().powi(2) + theta.sin().powi(2) / alpha2;
                let expected = if theta < 1.57 {
                    1.0 / (std::f64::consts::PI * alpha2 * form * form)
                } else {
                    0.0
                };
                assert_relative_eq!(f64::from(density), expected, max_relative = 1e-3);
                assert_relative_eq!(f64::from(cos), theta.cos().max(0.0), epsilon = 1e-6);
                assert_eq!(flake.misses_all(h, &[t]), expected == 0.0);
            }
        }
    }

    #[test]
    fn smith_terms_of_ggx_normalise_the_visible_normals() {
        // The definition of G1: G1(v) integral of D(m) max(v . m, 0) dm = v . t (Heitz 2014, Eq. 13), t = z.
        let flake = Flake::new(Distribution::Ggx, 0.4).unwrap();
        for cos in [0.15_f32, 0.4, 0.8, 1.0] {
            let v = Vec3::new((1.0 - cos * cos).sqrt(), 0.0, cos);
            const SIDE: usize = 800;
            let mut visible = 0.0;
            for i in 0..SIDE * SIDE {
                // Normals drawn by `sample` have the density D (m . t); squaring tames the tail at u = 1.
                let [a, b] = [i % SIDE, i / SIDE].map(|i| (i as f32 + 0.5) / SIDE as f32);
                let m = flake.sample(Vec3::Z, [1.0 - a * a, b]);
                visible += f64::from(2.0 * a * v.dot(m).max(0.0) / m.z);
            }
            let g1 = f64::from(cos) * (SIDE * SIDE) as f64 / visible;
            assert_relative_eq!(f64::from(flake.smith_g1(cos)), g1, max_relative = 2e-3);
        }
    }

    #[test]
    fn narrow_lobes_keep_their_shape_in_single_precision() {
        let alpha = 0.0025;
        let flake = Flake::new(Distribution::Beckmann, alpha).unwrap();
        let t = Vec3::new(0.5, -0.3, 1.0).normalize();
        let x = t.any_orthonormal_vector();
        for slopes in [0.5, 1.0, 2.0] {
            let h = (t + slopes * alpha * x).normalize();
            let (peak, _) = flake.distribution(t, t);
            assert_relative_eq!(
                flake.distribution(h, t).0 / peak,
                (-slopes * slopes).exp(),
                max_relative = 2e-3
            );
        }
    }

    #[test]
    fn smith_terms_meet_their_limits() {
        let flake = Flake::new(Distribution::Beckmann, 0.3).unwrap();
        assert_eq!(flake.smith_g1(1.0), 1.0);
        assert_eq!(flake.smith_g1(0.0), 0.0);
        assert_eq!(flake.smith_g1(-0.5), 0.0);
        assert!(flake.smith_g1(0.05) < flake.smith_g1(0.2));
    }

    #[test]
    fn roughness_outside_its_domain_is_refused() {
        for alpha in [0.0, -0.1, 1.5, f32::NAN] {
            let message = Flake::new(Distribution::Beckmann, alpha).unwrap_err().to_string();
            assert!(message.contains("\"alpha\""), "{message}");
        }
    }
}
