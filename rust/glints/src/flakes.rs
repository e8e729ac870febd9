//! The sum over flakes of Eq. 11 (Atanasov et al. 2021), term by term: shared by every method that represents
//! the footprint by weighted normals.

use glam::{Vec2, Vec3};

use crate::half_vector::DirectionPair;
use crate::lobe_range::{flat_lobe_integral, lobe_integral};
use crate::methods::Reflection;
use crate::microfacet::Flake;

/// How the texels of a footprint are weighted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Normalization {
    /// Every texel covers its share of the *projected* area, `w_k / (t_k . n)`: the distribution of normals
    /// integrates to one against the cosine, as in Yan et al. 2016.
    #[default]
    Projected,
    /// The literal Eq. 5: every texel is weighted with its share of the texture's area.
    Paper,
}

/// One micro-BRDF and the weighting of its texels.
#[derive(Clone, Copy, Debug)]
pub struct FlakeModel {
    pub flake: Flake,
    pub normalization: Normalization,
}

impl FlakeModel {
    #[inline]
    fn share(&self, weight: f32, t: Vec3) -> f32 {
        match self.normalization {
            Normalization::Projected => weight / t.z,
            Normalization::Paper => weight,
        }
    }

    /// The terms of reflection and density of one normal `t` with texel weight `weight`.
    #[inline]
    pub fn reflection(&self, pair: &DirectionPair, t: Vec3, weight: f32) -> Reflection {
        let (distribution, cos) = self.flake.distribution(pair.half, t);
        if distribution == 0.0 {
            return Reflection::default();
        }
        let shadowing = self.flake.smith_g1(pair.wi.dot(t)) * self.flake.smith_g1(pair.wo.dot(t));
        Reflection {
            value: self.share(weight, t) * distribution * shadowing,
            density: weight * distribution * cos,
        }
    }

    /// The term of the distribution of normals.
    #[inline]
    pub fn ndf(&self, h: Vec3, t: Vec3, weight: f32) -> f32 {
        self.share(weight, t) * self.flake.distribution(h, t).0
    }

    /// The term of the integral of [`FlakeModel::ndf`] over a rectangle of the projected disk.
    pub fn ndf_integral(&self, t: Vec3, weight: f32, low: Vec2, high: Vec2) -> f64 {
        f64::from(self.share(weight, t)) * lobe_integral(&self.flake, t, low, high)
    }

    /// The same by [`flat_lobe_integral`], for sums over many flakes.
    pub fn flat_ndf_integral(&self, t: Vec3, weight: f32, low: Vec2, high: Vec2) -> f64 {
        f64::from(self.share(weight, t)) * flat_lobe_integral(&self.flake, t, low, high)
    }

    /// The term of the half vector's density.
    #[inline]
    pub fn density(&self, h: Vec3, t: Vec3, weight: f32) -> f32 {
        let (distribution, cos) = self.flake.distribution(h, t);
        weight * distribution * cos
    }

    /// Draws a half vector about `t`; `None` below the horizon, where no pair of directions has one.
    #[inline]
    pub fn sample(&self, t: Vec3, u: [f32; 2]) -> Option<Vec3> {
        let m = self.flake.sample(t, u);
        (m.z > 0.0).then_some(m)
    }
}
