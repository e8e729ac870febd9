//! The micro-BRDF of a flake: Beckmann distribution and Smith shadowing (Walter et al. 2007), about any
//! normal.
//!
//! Section 5.1 of Atanasov et al. 2021 makes the normal explicit, `D^alpha(h, t)` and `G^alpha(i, o, h, t)`,
//! because every texel of a normal map carries its own micro-BRDF about its own normal `t`. All vectors are
//! unit vectors in the local shading frame; `alpha` is the Beckmann roughness, the flake's slopes having the
//! standard deviation `alpha / sqrt(2)` along each axis.

use glam::Vec3;

use crate::error::{Error, Result};

/// Exponent beyond which the Beckmann lobe counts as zero: e^-40 = 4e-18 of its peak.
const LARGEST_EXPONENT: f32 = 40.0;

/// A rough mirror: the Beckmann lobe of one flake.
#[derive(Clone, Copy, Debug)]
pub struct Flake {
    alpha: f32,
    /// 1 / alpha^2.
    inv_alpha2: f32,
    /// Squared chord |h - t|^2 at which the exponent reaches `LARGEST_EXPONENT`.
    max_chord2: f32,
}

impl Flake {
    /// `alpha` in [1e-4, 1]: below, single-precision directions do not resolve the lobe.
    pub fn new(alpha: f32) -> Result<Self> {
        if !(1e-4..=1.0).contains(&alpha) {
            return Err(Error::parameter(
                "alpha",
                alpha,
                "must be a Beckmann roughness in [0.0001, 1]",
            ));
        }
        // tan^2 = x  <=>  cos = 1 / sqrt(1 + x), and |h - t|^2 = 2 - 2 cos.
        let x = f64::from(LARGEST_EXPONENT) * f64::from(alpha).powi(2);
        Ok(Self {
            alpha,
            inv_alpha2: (1.0 / f64::from(alpha).powi(2)) as f32,
            max_chord2: (2.0 - 2.0 / (1.0 + x).sqrt()) as f32,
        })
    }

    pub fn alpha(&self) -> f32 {
        self.alpha
    }

    /// The Beckmann distribution `D^alpha(h, t)` per solid angle (Eq. 14), and the cosine `h . t`.
    ///
    /// The angle comes from the chord `|h - t|`, not from `h . t`: at alpha = 0.0025 the rounding error of a
    /// single-precision cosine is a percent of the exponent.
    #[inline]
    pub fn distribution(&self, h: Vec3, t: Vec3) -> (f32, f32) {
        let chord2 = (h - t).length_squared();
        if chord2 >= self.max_chord2 {
            return (0.0, 0.0);
        }
        let cos = 1.0 - 0.5 * chord2;
        let cos2 = cos * cos;
        let tan2 = chord2 * (1.0 - 0.25 * chord2) / cos2;
        let density =
            std::f32::consts::FRAC_1_PI * self.inv_alpha2 * (-tan2 * self.inv_alpha2).exp() / (cos2 * cos2);
        (density, cos)
    }

    /// Whether `D^alpha(h, t)` counts as zero for all of `normals`: true for nearly all blocks of a
    /// glittering map.
    #[inline]
    pub fn misses_all(&self, h: Vec3, normals: &[Vec3]) -> bool {
        let near = |t: &Vec3| (h - *t).length_squared() < self.max_chord2;
        !normals.iter().fold(false, |any, t| any | near(t))
    }

    /// Draws a normal about `t` with the density `D^alpha(m, t) (m . t)` per solid angle.
    #[inline]
    pub fn sample(&self, t: Vec3, u: [f32; 2]) -> Vec3 {
        let tan2 = -self.alpha * self.alpha * (1.0 - u[0]).max(f32::MIN_POSITIVE).ln();
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
        beckmann_g1(self.alpha * self.alpha * tan2)
    }
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
        let flake = Flake::new(alpha).unwrap();
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
    fn narrow_lobes_keep_their_shape_in_single_precision() {
        let alpha = 0.0025;
        let flake = Flake::new(alpha).unwrap();
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
        let flake = Flake::new(0.3).unwrap();
        assert_eq!(flake.smith_g1(1.0), 1.0);
        assert_eq!(flake.smith_g1(0.0), 0.0);
        assert_eq!(flake.smith_g1(-0.5), 0.0);
        assert!(flake.smith_g1(0.05) < flake.smith_g1(0.2));
    }

    #[test]
    fn roughness_outside_its_domain_is_refused() {
        for alpha in [0.0, -0.1, 1.5, f32::NAN] {
            let message = Flake::new(alpha).unwrap_err().to_string();
            assert!(message.contains("\"alpha\""), "{message}");
        }
    }
}
