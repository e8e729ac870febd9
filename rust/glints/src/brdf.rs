//! A BRDF without Fresnel term and colour: one method, the whole map's shadowing, reflection at half vectors.
//!
//! `value = G_x(i, o) R(i, o) / (4 (i . n))` is `f cos theta_o` of Eq. 11 (Atanasov et al. 2021) with `F =
//! 1`, where `i` points to the viewer (`wi`) and `o` to the light (`wo`); the density of `wo` is that of the
//! half vector over `4 (o . h)`.

use glam::{Vec2, Vec3};

use crate::error::{Error, Result};
use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;
use crate::hash::mix;
use crate::methods::Method;
use crate::microfacet::beckmann_g1;
use crate::normal_map::{NormalMap, SlopeCovariance};

/// Shadowing and masking `G_x` of the whole map; a flake's own Smith term is always present.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Masking {
    /// `G_x = 1`.
    None,
    /// Separable Smith term of a Beckmann surface with the covariance of the map's slopes, anisotropic.
    #[default]
    Beckmann,
    /// The same with explicit roughness along u and v, both at least zero.
    Explicit { alpha_u: f32, alpha_v: f32 },
}

/// Smith's `G1` of an anisotropic Beckmann surface. The quadratic form is `alpha(phi)^2 sin^2 theta` for a
/// direction with azimuth phi, and `alpha(phi)^2` is twice the variance of the slopes along it (Heitz 2014,
/// Section 5.3).
#[derive(Clone, Copy, Debug)]
pub(crate) struct SmithMasking {
    xx: f32,
    xy: f32,
    yy: f32,
}

impl SmithMasking {
    /// `slopes`: those of the map, asked for by [`Masking::Beckmann`] only.
    pub(crate) fn new(masking: Masking, slopes: impl FnOnce() -> SlopeCovariance) -> Result<Self> {
        let squared = |name, alpha: f32| {
            if alpha.is_finite() && alpha >= 0.0 {
                Ok(alpha * alpha)
            } else {
                Err(Error::parameter(name, alpha, "must be a roughness >= 0"))
            }
        };
        Ok(match masking {
            Masking::None => Self {
                xx: 0.0,
                xy: 0.0,
                yy: 0.0,
            },
            Masking::Beckmann => Self::of_slopes(slopes()),
            Masking::Explicit { alpha_u, alpha_v } => Self {
                xx: squared("masking_alpha_u", alpha_u)?,
                xy: 0.0,
                yy: squared("masking_alpha_v", alpha_v)?,
            },
        })
    }

    /// The term of a surface whose slopes have this covariance.
    pub(crate) fn of_slopes(slopes: SlopeCovariance) -> Self {
        Self {
            xx: (2.0 * slopes.xx) as f32,
            xy: (2.0 * slopes.xy) as f32,
            yy: (2.0 * slopes.yy) as f32,
        }
    }

    /// Roughness along u and v.
    pub(crate) fn alphas(&self) -> (f32, f32) {
        (self.xx.sqrt(), self.yy.sqrt())
    }

    #[inline]
    pub(crate) fn g1(&self, v: Vec3) -> f32 {
        let form = self.xx * v.x * v.x + 2.0 * self.xy * v.x * v.y + self.yy * v.y * v.y;
        beckmann_g1(form / (v.z * v.z))
    }
}

/// `f cos theta_o` and the density of `wo` per solid angle.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Evaluation {
    pub value: f32,
    pub pdf: f32,
}

/// A drawn direction with its evaluation.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    pub wo: Vec3,
    pub evaluation: Evaluation,
}

/// See the module.
pub struct Brdf {
    method: Box<dyn Method>,
    masking: SmithMasking,
}

impl Brdf {
    /// `map` is the map the method was built from; only its slope covariance is used.
    pub fn new(
        map: &NormalMap,
        masking: Masking,
        method: impl FnOnce() -> Result<Box<dyn Method>>,
    ) -> Result<Self> {
        Self::with_slopes(|| map.slope_covariance(), masking, method)
    }

    /// The same without the map; `slopes` is called for [`Masking::Beckmann`] only.
    pub fn with_slopes(
        slopes: impl FnOnce() -> SlopeCovariance,
        masking: Masking,
        method: impl FnOnce() -> Result<Box<dyn Method>>,
    ) -> Result<Self> {
        Ok(Self {
            masking: SmithMasking::new(masking, slopes)?,
            method: method()?,
        })
    }

    pub fn method(&self) -> &dyn Method {
        self.method.as_ref()
    }

    /// Roughness of `G_x` along u and v.
    pub fn masking_alphas(&self) -> (f32, f32) {
        self.masking.alphas()
    }

    /// The footprint at `uv` with its partial derivatives, over this BRDF's map.
    pub fn footprint(&self, uv: [f32; 2], duv_dx: [f32; 2], duv_dy: [f32; 2]) -> Footprint {
        let (width, height) = self.method.map_size();
        Footprint::new(width, height, uv, duv_dx, duv_dy)
    }

    /// Value and density for two unit directions; zero below the horizon.
    pub fn evaluate(&self, footprint: &Footprint, wi: Vec3, wo: Vec3) -> Evaluation {
        DirectionPair::new(wi, wo).map_or(Evaluation::default(), |pair| self.evaluate_pair(footprint, &pair))
    }

    /// The density alone.
    pub fn pdf(&self, footprint: &Footprint, wi: Vec3, wo: Vec3) -> f32 {
        DirectionPair::new(wi, wo).map_or(0.0, |pair| {
            self.method.density(footprint, pair.half) / (4.0 * pair.cos)
        })
    }

    /// The filtered distribution of normals at the unit vector `h`; zero below the horizon.
    pub fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        if h.z > 0.0 {
            self.method.ndf(footprint, h)
        } else {
            0.0
        }
    }

    /// [`Method::ndf_over`].
    pub fn ndf_over(&self, footprint: &Footprint, low: Vec2, high: Vec2) -> Option<f32> {
        self.method.ndf_over(footprint, low, high)
    }

    /// Draws `wo` from three independent uniform numbers; `None` if the draw failed, which counts as zero.
    pub fn sample(&self, footprint: &Footprint, wi: Vec3, u: [f32; 3]) -> Option<Sample> {
        if wi.z <= 0.0 {
            return None;
        }
        let half = self.method.sample(footprint, four_uniforms(u))?;
        // The half vector of the two directions, as any later query sees it: rounding in the reflection then
        // cannot tell a sample's density from that query's.
        let pair = DirectionPair::reflected(wi, half)?;
        let evaluation = self.evaluate_pair(footprint, &pair);
        (evaluation.pdf > 0.0).then_some(Sample {
            wo: pair.wo,
            evaluation,
        })
    }

    /// `G_x` of the whole map.
    pub(crate) fn masking(&self, pair: &DirectionPair) -> f32 {
        self.masking.g1(pair.wi) * self.masking.g1(pair.wo)
    }

    fn evaluate_pair(&self, footprint: &Footprint, pair: &DirectionPair) -> Evaluation {
        let reflection = self.method.evaluate(footprint, pair);
        if reflection.density == 0.0 {
            return Evaluation::default();
        }
        Evaluation {
            value: self.masking(pair) * reflection.value / (4.0 * pair.wi.z),
            pdf: reflection.density / (4.0 * pair.cos),
        }
    }
}

/// Four uniform numbers from the three that renderers hand to a BSDF.
///
/// The flake's normal is drawn with the caller's second and third number as they are, so that a stratified
/// sampler keeps its stratification over the lobe. The point of the footprint comes from a 64-bit hash (the
/// finaliser of SplitMix64) of all bits of the three numbers: it changes with each of them, is independent of
/// the lobe's number for a given one through the first number, and has no structure that an image could show.
pub(crate) fn four_uniforms([u1, u2, u3]: [f32; 3]) -> [f32; 4] {
    let word = |u: f32| u64::from(u.to_bits());
    let z = mix(word(u1)
        .wrapping_mul(0x9e37_79b9_7f4a_7c15)
        .wrapping_add(word(u2) << 32 | word(u3)));
    let uniform = |bits: u64| (bits & 0xff_ffff) as f32 * (1.0 / 16_777_216.0);
    [uniform(z >> 40), uniform(z >> 16), u2, u3]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flakes::{FlakeModel, Normalization};
    use crate::methods::direct::Direct;
    use crate::methods::inverse_bin_map::{InverseBinMap, Options};
    use crate::microfacet::{Distribution, Flake};
    use approx::assert_relative_eq;

    fn wavy_map() -> NormalMap {
        let normals: Vec<Vec3> = (0..256)
            .map(|i| Vec3::new((i as f32).sin() * 0.3, (i as f32 * 1.7).cos() * 0.2, 1.0))
            .collect();
        NormalMap::from_normals("wavy", 16, 16, &normals).unwrap()
    }

    fn brdfs(alpha: f32, masking: Masking) -> [Brdf; 2] {
        let map = wavy_map();
        let model = FlakeModel {
            flake: Flake::new(Distribution::default(), alpha).unwrap(),
            normalization: Normalization::Projected,
        };
        let direct = Brdf::new(&map, masking, || Ok(Box::new(Direct::new(map.clone(), model))));
        let ibm = Brdf::new(&map, masking, || {
            Ok(Box::new(InverseBinMap::new(&map, model, Options::default())?))
        });
        [direct.unwrap(), ibm.unwrap()]
    }

    fn direction(cos: f32, phi: f32) -> Vec3 {
        let sin = (1.0 - cos * cos).sqrt();
        Vec3::new(sin * phi.cos(), sin * phi.sin(), cos)
    }

    /// Integral of value and density over the hemisphere of `wo`.
    fn integrate(brdf: &Brdf, footprint: &Footprint, wi: Vec3) -> (f64, f64) {
        const SIDE: usize = 400;
        let (mut value, mut pdf) = (0.0, 0.0);
        for i in 0..SIDE * SIDE {
            let cos = (i / SIDE) as f32 + 0.5;
            let phi = (i % SIDE) as f32 + 0.5;
            let wo = direction(cos / SIDE as f32, phi / SIDE as f32 * std::f32::consts::TAU);
            let e = brdf.evaluate(footprint, wi, wo);
            value += f64::from(e.value);
            pdf += f64::from(e.pdf);
        }
        let cell = std::f64::consts::TAU / (SIDE * SIDE) as f64;
        (value * cell, pdf * cell)
    }

    #[test]
    fn a_white_furnace_gains_nothing_and_loses_little() {
        for brdf in brdfs(0.15, Masking::Beckmann) {
            let footprint = brdf.footprint([0.4, 0.3], [0.3, 0.1], [-0.1, 0.4]);
            for cos in [0.3, 0.7, 0.95] {
                let (albedo, pdf) = integrate(&brdf, &footprint, direction(cos, 0.7));
                assert!(albedo < 1.005, "{} cos {cos}: {albedo}", brdf.method().name());
                assert!(albedo > if cos > 0.6 { 0.95 } else { 0.6 }, "cos {cos}: {albedo}");
                assert!(pdf < 1.001 && pdf > 0.6, "cos {cos}: {pdf}");
            }
        }
    }

    #[test]
    fn sampling_estimates_the_integral_of_the_value() {
        for brdf in brdfs(0.1, Masking::Beckmann) {
            let footprint = brdf.footprint([0.4, 0.3], [0.3, 0.1], [-0.1, 0.4]);
            let wi = direction(0.8, -0.4);
            let (albedo, pdf) = integrate(&brdf, &footprint, wi);
            const COUNT: u32 = 200_000;
            let (mut estimate, mut drawn) = (0.0, 0.0);
            for i in 0..COUNT {
                // A rank-1 lattice: the golden ratio's generalisation to three dimensions.
                let u =
                    [0.819_172_5, 0.671_043_6, 0.549_700_5].map(|g: f64| (g * f64::from(i)).fract() as f32);
                if let Some(s) = brdf.sample(&footprint, wi, u) {
                    assert_eq!(s.evaluation, brdf.evaluate(&footprint, wi, s.wo));
                    estimate += f64::from(s.evaluation.value / s.evaluation.pdf);
                    drawn += 1.0;
                }
            }
            assert_relative_eq!(estimate / f64::from(COUNT), albedo, max_relative = 0.01);
            assert_relative_eq!(drawn / f64::from(COUNT), pdf, max_relative = 0.005);
        }
    }

    #[test]
    fn mirrored_grazing_directions_have_a_positive_density() {
        let normals = [Vec3::Z];
        let map = NormalMap::from_normals("flat", 1, 1, &normals).unwrap();
        let model = FlakeModel {
            flake: Flake::new(Distribution::default(), 0.1).unwrap(),
            normalization: Normalization::Projected,
        };
        let brdf = Brdf::new(&map, Masking::None, || {
            Ok(Box::new(Direct::new(map.clone(), model)))
        })
        .unwrap();
        let footprint = brdf.footprint([0.5; 2], [0.0; 2], [0.0; 2]);
        let (wi, wo) = (Vec3::new(1.0, 0.0, 1e-4), Vec3::new(-0.999_999_94, 0.0, 1e-4));
        assert!(brdf.evaluate(&footprint, wi, wo).pdf > 0.0);
        assert!(brdf.pdf(&footprint, wi, wo) > 0.0);
    }

    #[test]
    fn the_point_of_the_footprint_is_uniform() {
        // Also along a line of the lobe's numbers, and for consecutive first numbers.
        const CELLS: usize = 16;
        const COUNT: u32 = 200_000;
        let fixed = |i: u32| [i as f32 / COUNT as f32, 0.25, 0.75];
        let lattice = |i: u32| [0.5, (i % 500) as f32 / 500.0, (i / 500) as f32 / 400.0];
        for numbers in [&fixed as &dyn Fn(u32) -> [f32; 3], &lattice] {
            let mut counts = [0.0_f64; CELLS * CELLS];
            for i in 0..COUNT {
                let [x, y, _, _] = four_uniforms(numbers(i));
                counts[(x * CELLS as f32) as usize * CELLS + (y * CELLS as f32) as usize] += 1.0;
            }
            let expected = f64::from(COUNT) / counts.len() as f64;
            let statistic: f64 = counts.iter().map(|c| (c - expected).powi(2) / expected).sum();
            // 255 degrees of freedom: mean 255, standard deviation 23.
            assert!((255.0 - 100.0..255.0 + 115.0).contains(&statistic), "{statistic}");
        }
    }

    #[test]
    fn values_are_reciprocal() {
        for brdf in brdfs(0.1, Masking::Beckmann) {
            let footprint = brdf.footprint([0.4, 0.3], [0.3, 0.1], [-0.1, 0.4]);
            let (a, b) = (direction(0.9, 0.3), direction(0.7, 3.5));
            let forward = brdf.evaluate(&footprint, a, b).value / b.z;
            let backward = brdf.evaluate(&footprint, b, a).value / a.z;
            assert!(forward > 0.0);
            assert_relative_eq!(forward, backward, max_relative = 1e-5);
        }
    }

    #[test]
    fn nothing_is_reflected_below_the_horizon() {
        for brdf in brdfs(0.1, Masking::None) {
            let footprint = brdf.footprint([0.4, 0.3], [0.3, 0.1], [-0.1, 0.4]);
            let (up, down) = (direction(0.9, 0.3), direction(-0.1, 2.0));
            assert_eq!(brdf.evaluate(&footprint, up, down), Evaluation::default());
            assert_eq!(brdf.evaluate(&footprint, down, up), Evaluation::default());
            assert!(brdf.sample(&footprint, down, [0.5; 3]).is_none());
            let nan = Vec3::splat(f32::NAN);
            assert_eq!(brdf.evaluate(&footprint, up, nan), Evaluation::default());
        }
    }

    #[test]
    fn explicit_masking_replaces_the_covariance() {
        let alphas = |masking| brdfs(0.1, masking)[0].masking_alphas();
        assert_eq!(alphas(Masking::None), (0.0, 0.0));
        let (alpha_u, alpha_v) = alphas(Masking::Explicit {
            alpha_u: 0.3,
            alpha_v: 0.1,
        });
        assert_relative_eq!(alpha_u, 0.3);
        assert_relative_eq!(alpha_v, 0.1);
        let (alpha_u, _) = alphas(Masking::Beckmann);
        assert_relative_eq!(alpha_u, 0.3, max_relative = 0.05);
    }
}
