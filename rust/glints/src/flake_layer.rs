//! A layer of flakes that leaves gaps: a filtered normal map over the texels that hold a flake, and the share
//! of the footprint that they cover.
//!
//! **Source** The car paint of Atanasov et al. 2021, Section 6: flakes filtered by the inverse bin map, a Smith
//! term as `G_x`, and the layer's transparency from a mip map of the flakes' mask. Any [`Method`] will do.
//!
//! **Computes** For two directions above the horizon the sum of Eq. 11 over the flakes alone, the shares `w_k`
//! of their texels being shares of the whole footprint: it sums to the cover `a`, and `1 - a` is left to what
//! lies below.
//!
//! **Texels without flake** must not contribute, but a method knows no gaps. They are therefore *parked*: their
//! normals are turned to the horizon ([`parked_normal`]). Under a coat of refractive index `eta`, all
//! directions lie within `asin(1 / eta)` of the normal, and so do their half vectors; a parked lobe is cut off
//! to exactly zero there, as long as the flakes are not too rough. [`FlakeLayer::new`] tests that on the method
//! it was given, over the whole border of the cone, and refuses a layer for which it does not hold. Within the
//! cone the sum over flakes is then exact, whatever the method does. Without a mask nothing is parked, and
//! every direction and roughness is allowed.
//!
//! **Sampling** draws a texel with its share `w_k`. A flake there answers with a direction; a gap says so
//! ([`Drawn::Gap`]), with the probability `1 - a`. [`FlakeLayer::cover`] is `a` exactly for footprints of up to
//! [`crate::mip_map::EXACT_TEXELS`] texels, and within the mip map's error for larger ones.

use glam::Vec3;

use crate::brdf::{Evaluation, SmithMasking, four_uniforms};
use crate::error::{Error, Result};
use crate::footprint::Footprint;
use crate::gtr::{Gtr, GtrMasking};
use crate::half_vector::DirectionPair;
use crate::methods::Method;
use crate::mip_map::MipMap;
use crate::normal_map::{MIN_Z, NormalMap, slope_covariance};

/// Shadowing and masking `G_x` of the whole layer; a flake's own Smith term is always present.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum LayerMasking {
    /// `G_x = 1`.
    None,
    /// Smith term of a Beckmann surface with the covariance of the flakes' slopes, gaps left out.
    #[default]
    Beckmann,
    /// The same with explicit roughness along u and v, both at least zero.
    Explicit { alpha_u: f32, alpha_v: f32 },
    /// Smith term of the distribution that the flakes were drawn from.
    Gtr(Gtr),
}

enum Masking {
    Smith(SmithMasking),
    Gtr(GtrMasking),
}

/// What [`FlakeLayer::sample`] came upon.
#[derive(Clone, Copy, Debug)]
pub enum Drawn {
    /// A flake, and the direction to which it reflects; its density is that of [`FlakeLayer::evaluate`].
    Flake(Vec3),
    /// A texel without flake.
    Gap,
    /// A flake that reflects nowhere: the draw counts as zero.
    Nothing,
}

/// See the module.
pub struct FlakeLayer {
    method: Box<dyn Method>,
    mask: Option<MipMap>,
    masking: Masking,
}

impl FlakeLayer {
    /// A layer of the flakes of `map`; `mask` says which texels hold one (255) and which do not (0), `None` that
    /// all do. All directions that the layer will be asked about lie within `asin(largest_sine)` of +z, e.g.
    /// `1 / eta` under a coat. `build` makes the method from the map with its gaps parked.
    ///
    /// # Errors
    /// A mask of another size than the map's, without any flake, or with gaps whose parked lobes reach the
    /// directions; a masking roughness below zero; the errors of `build`.
    pub fn new(
        map: &NormalMap,
        mask: Option<MipMap>,
        masking: LayerMasking,
        largest_sine: f32,
        build: impl FnOnce(&NormalMap) -> Result<Box<dyn Method>>,
    ) -> Result<Self> {
        let Some(mask) = mask else {
            return Ok(Self {
                masking: Masking::new(masking, map.normals())?,
                method: build(map)?,
                mask: None,
            });
        };
        check_size(map, &mask)?;
        let is_flake = |i: u32| mask.texel(i % map.width(), i / map.width()) > 0;
        let texels = 0..map.width() * map.height();
        let flakes: Vec<Vec3> = texels
            .clone()
            .filter(|&i| is_flake(i))
            .map(|i| texel(map, i))
            .collect();
        if flakes.is_empty() {
            let reason =
                "is zero everywhere, so there is no flake; leave the mask out if every texel holds one";
            return Err(Error::Parameter {
                name: "mask",
                value: map.name().into(),
                reason: reason.into(),
            });
        }
        let parked = parked_normal();
        let normals: Vec<Vec3> = texels
            .clone()
            .map(|i| if is_flake(i) { texel(map, i) } else { parked })
            .collect();
        let with_gaps = NormalMap::from_normals(map.name(), map.width(), map.height(), &normals)?;
        let method = build(&with_gaps)?;
        if let Some(gap) = texels.clone().find(|&i| !is_flake(i)) {
            check_parking(
                method.as_ref(),
                (gap % map.width(), gap / map.width()),
                largest_sine,
            )?;
        }
        Ok(Self {
            masking: Masking::new(masking, &flakes)?,
            method,
            mask: Some(mask),
        })
    }

    /// The filter behind the layer.
    pub fn method(&self) -> &dyn Method {
        self.method.as_ref()
    }

    /// Roughness of `G_x` along u and v; zero for that of a GTR distribution.
    pub fn masking_alphas(&self) -> (f32, f32) {
        match &self.masking {
            Masking::Smith(smith) => smith.alphas(),
            Masking::Gtr(_) => (0.0, 0.0),
        }
    }

    /// The footprint at `uv` with its partial derivatives, over the layer's map.
    pub fn footprint(&self, uv: [f32; 2], duv_dx: [f32; 2], duv_dy: [f32; 2]) -> Footprint {
        let (width, height) = self.method.map_size();
        Footprint::new(width, height, uv, duv_dx, duv_dy)
    }

    /// The share `a` of the footprint that flakes cover, in [0, 1].
    pub fn cover(&self, footprint: &Footprint) -> f32 {
        self.mask.as_ref().map_or(1.0, |mask| mask.mean_over(footprint))
    }

    /// `f cos theta_o` of the flakes, without Fresnel term and colour, and the density of `wo` per solid angle
    /// among all draws of [`FlakeLayer::sample`]; both are proportional to the cover. Zero below the horizon.
    pub fn evaluate(&self, footprint: &Footprint, wi: Vec3, wo: Vec3) -> Evaluation {
        let Some(pair) = DirectionPair::new(wi, wo) else {
            return Evaluation::default();
        };
        let reflection = self.method.evaluate(footprint, &pair);
        Evaluation {
            value: self.masking.g1(wi) * self.masking.g1(wo) * reflection.value / (4.0 * wi.z),
            pdf: reflection.density / (4.0 * pair.cos),
        }
    }

    /// Draws a texel and, if it holds a flake, a direction, from three independent uniform numbers.
    pub fn sample(&self, footprint: &Footprint, wi: Vec3, u: [f32; 3]) -> Drawn {
        let u = four_uniforms(u);
        if let Some(mask) = &self.mask {
            // The texel that the method draws from the same numbers.
            let (column, row) = footprint.sample_texel([u[0].into(), u[1].into()]);
            if mask.texel(column, row) == 0 {
                return Drawn::Gap;
            }
        }
        let pair = self
            .method
            .sample(footprint, u)
            .and_then(|half| DirectionPair::reflected(wi, half));
        pair.map_or(Drawn::Nothing, |pair| Drawn::Flake(pair.wo))
    }

    /// Bytes that all of this needs: the method's structure, the mip map and the table of `G_x`.
    pub fn structure_bytes(&self) -> usize {
        let table = match &self.masking {
            Masking::Smith(_) => 0,
            Masking::Gtr(table) => table.bytes(),
        };
        self.method.structure_bytes() + self.mask.as_ref().map_or(0, MipMap::bytes) + table
    }
}

impl Masking {
    /// `flakes`: the normals whose slopes shadow.
    fn new(masking: LayerMasking, flakes: &[Vec3]) -> Result<Self> {
        use crate::brdf::Masking as Smith;
        let smith = match masking {
            LayerMasking::Gtr(gtr) => return Ok(Self::Gtr(GtrMasking::new(&gtr))),
            LayerMasking::None => Smith::None,
            LayerMasking::Beckmann => Smith::Beckmann,
            LayerMasking::Explicit { alpha_u, alpha_v } => Smith::Explicit { alpha_u, alpha_v },
        };
        Ok(Self::Smith(SmithMasking::new(smith, || {
            slope_covariance(flakes)
        })?))
    }

    #[inline]
    fn g1(&self, v: Vec3) -> f32 {
        match self {
            Self::Smith(smith) => smith.g1(v),
            Self::Gtr(table) => table.g1(v.z),
        }
    }
}

/// The normal of a texel without flake: at the horizon, farthest from all directions.
fn parked_normal() -> Vec3 {
    let z = 1.1 * MIN_Z;
    Vec3::new((1.0 - z * z).sqrt(), 0.0, z)
}

fn texel(map: &NormalMap, index: u32) -> Vec3 {
    map.normals()[index as usize]
}

fn check_size(map: &NormalMap, mask: &MipMap) -> Result<()> {
    let (width, height) = mask.size();
    if (width, height) == (map.width(), map.height()) {
        return Ok(());
    }
    Err(Error::Parameter {
        name: "mask",
        value: format!("{width} x {height} texels"),
        reason: format!(
            "must have the size of the normal map \"{}\", {} x {} texels",
            map.name(),
            map.width(),
            map.height()
        ),
    })
}

/// Is the lobe of the parked texel `gap` zero for all half vectors? It falls with the distance to its centre, so
/// the border of the cone decides; a method may shift centres, so all of the border is looked at.
fn check_parking(method: &dyn Method, gap: (u32, u32), largest_sine: f32) -> Result<()> {
    let (width, height) = method.map_size();
    let uv = [
        (gap.0 as f32 + 0.5) / width as f32,
        (gap.1 as f32 + 0.5) / height as f32,
    ];
    let footprint = Footprint::new(width, height, uv, [0.0; 2], [0.0; 2]);
    let radius = largest_sine.min(1.0 - 1e-6);
    let reached = (0..720).any(|i| {
        let (sin, cos) = (i as f32 / 720.0 * std::f32::consts::TAU).sin_cos();
        let h = Vec3::new(radius * cos, radius * sin, (1.0 - radius * radius).sqrt());
        method.ndf(&footprint, h) > 0.0 || method.density(&footprint, h) > 0.0
    });
    if !reached {
        return Ok(());
    }
    Err(Error::Parameter {
        name: "alpha",
        value: "(roughness of a flake)".into(),
        reason: "is too large for a mask under this coat: lobes of texels without flake would reach visible \
                 directions. Reduce it (below 0.12 for an index of refraction of 1.5), raise \"coat_int_ior\", \
                 or leave the mask out"
            .into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flake_map::{FlakeMap, FlakeMapOptions, generate};
    use crate::flakes::{FlakeModel, Normalization};
    use crate::methods::direct::Direct;
    use crate::methods::inverse_bin_map::{InverseBinMap, Options};
    use crate::microfacet::{Distribution, Flake};
    use approx::assert_relative_eq;

    const SINE: f32 = 1.0 / 1.5;

    fn model(alpha: f32) -> FlakeModel {
        FlakeModel {
            flake: Flake::new(Distribution::default(), alpha).unwrap(),
            normalization: Normalization::Projected,
        }
    }

    fn flakes() -> FlakeMap {
        generate(&FlakeMapOptions {
            size: 64,
            density: 0.4,
            alpha: 0.15,
            ..FlakeMapOptions::default()
        })
        .unwrap()
    }

    fn map_of(flakes: &FlakeMap) -> NormalMap {
        NormalMap::from_normals("flakes", flakes.width, flakes.height, &flakes.normals).unwrap()
    }

    fn mask_of(flakes: &FlakeMap) -> MipMap {
        let values = flakes.mask.iter().map(|&m| (255.0 * m) as u8).collect();
        MipMap::new("mask", flakes.width, flakes.height, values).unwrap()
    }

    fn layer(flakes: &FlakeMap, alpha: f32, masking: LayerMasking, direct: bool) -> Result<FlakeLayer> {
        FlakeLayer::new(&map_of(flakes), Some(mask_of(flakes)), masking, SINE, |map| {
            if direct {
                Ok(Box::new(Direct::new(map.clone(), model(alpha))))
            } else {
                Ok(Box::new(InverseBinMap::new(
                    map,
                    model(alpha),
                    Options::default(),
                )?))
            }
        })
    }

    fn direction(sin: f32, phi: f32) -> Vec3 {
        Vec3::new(sin * phi.cos(), sin * phi.sin(), (1.0 - sin * sin).sqrt())
    }

    /// The sum over the flakes' texels, written down.
    #[test]
    fn only_flakes_reflect() {
        let flakes = flakes();
        let layer = layer(&flakes, 0.05, LayerMasking::None, true).unwrap();
        let footprint = layer.footprint([0.0; 2], [1.0, 0.0], [0.0, 1.0]);
        let (wi, wo) = (direction(0.3, 0.4), direction(0.25, 3.6));
        let pair = DirectionPair::new(wi, wo).unwrap();
        let texels = flakes
            .normals
            .iter()
            .zip(&flakes.mask)
            .filter(|(_, mask)| **mask > 0.0);
        let term = |t: Vec3| model(0.05).reflection(&pair, t, 1.0 / 4096.0).value;
        let expected = texels.map(|(t, _)| f64::from(term(*t))).sum::<f64>();
        let found = layer.evaluate(&footprint, wi, wo).value * 4.0 * wi.z;
        assert!(expected > 0.1);
        assert_relative_eq!(f64::from(found), expected, max_relative = 1e-4);
        // The broken twin: the gaps' +z would add their lobes.
        let twin = flakes.normals.iter().map(|t| f64::from(term(*t))).sum::<f64>();
        assert!(twin > 1.2 * expected);
        let cover = flakes.mask.iter().sum::<f32>() / 4096.0;
        assert_relative_eq!(layer.cover(&footprint), cover, epsilon = 0.002);
    }

    #[test]
    fn draws_have_the_density_and_gaps_the_rest() {
        let flakes = flakes();
        for direct in [true, false] {
            let layer = layer(&flakes, 0.05, LayerMasking::Beckmann, direct).unwrap();
            let footprint = layer.footprint([0.3, 0.6], [0.11, 0.02], [-0.03, 0.14]);
            let wi = direction(0.3, 0.1);
            const COUNT: u32 = 100_000;
            let (mut gaps, mut integral) = (0.0, 0.0);
            for i in 0..COUNT {
                let u =
                    [0.819_172_5, 0.671_043_6, 0.549_700_5].map(|g: f64| (g * f64::from(i)).fract() as f32);
                match layer.sample(&footprint, wi, u) {
                    Drawn::Gap => gaps += 1.0,
                    // Any function of the direction would do.
                    Drawn::Flake(wo) if wo.y > 0.0 => integral += 1.0,
                    _ => (),
                }
            }
            let count = f64::from(COUNT);
            assert_relative_eq!(
                gaps / count,
                1.0 - f64::from(layer.cover(&footprint)),
                epsilon = 0.005
            );
            const SIDE: usize = 500;
            let density = |i: usize| {
                // wo on the half disk y > 0: d wo = dA / wo.z.
                let (r, phi) = ((i / SIDE) as f32 + 0.5, (i % SIDE) as f32 + 0.5);
                let (r, phi) = (r / SIDE as f32, phi / SIDE as f32 * std::f32::consts::PI);
                let wo = direction(r, phi);
                f64::from(layer.evaluate(&footprint, wi, wo).pdf * r / wo.z)
            };
            let expected =
                (0..SIDE * SIDE).map(density).sum::<f64>() * std::f64::consts::PI / (SIDE * SIDE) as f64;
            assert!(expected > 0.05, "{expected}");
            assert_relative_eq!(integral / count, expected, epsilon = 0.006);
        }
    }

    /// The claim of the module: whatever the layer accepts, parked lobes are zero at every half vector.
    #[test]
    fn rough_flakes_under_a_mask_are_refused_before_parked_lobes_show() {
        let flakes = flakes();
        let (mut accepted, mut refused) = (0.0_f32, 1.0_f32);
        for alpha in [
            0.002, 0.01, 0.04, 0.08, 0.1, 0.12, 0.14, 0.16, 0.18, 0.2, 0.3, 1.0,
        ] {
            for direct in [true, false] {
                match layer(&flakes, alpha, LayerMasking::None, direct) {
                    Ok(_) => accepted = accepted.max(alpha),
                    Err(error) => {
                        assert!(error.to_string().contains("alpha"), "{error}");
                        refused = refused.min(alpha);
                    }
                }
            }
        }
        println!("accepted to {accepted}, refused from {refused}");
        assert!(accepted >= 0.12 && refused > 0.12 && refused <= 0.3);
    }

    #[test]
    fn gaps_do_not_change_the_masking() {
        let mut flakes = flakes();
        let with = layer(&flakes, 0.01, LayerMasking::Beckmann, true)
            .unwrap()
            .masking_alphas();
        // The same flakes without gaps: fill them with copies of two opposite flakes' worth of nothing new.
        let only: Vec<Vec3> = flakes
            .normals
            .iter()
            .zip(&flakes.mask)
            .filter(|(_, m)| **m > 0.0)
            .map(|(n, _)| *n)
            .collect();
        let compact = NormalMap::from_normals("compact", only.len() as u32, 1, &only).unwrap();
        let covariance = compact.slope_covariance();
        assert_relative_eq!(
            f64::from(with.0),
            (2.0 * covariance.xx).sqrt(),
            max_relative = 1e-5
        );
        assert_relative_eq!(
            f64::from(with.1),
            (2.0 * covariance.yy).sqrt(),
            max_relative = 1e-5
        );
        let gtr = LayerMasking::Gtr(Gtr::new(1.5, 0.3).unwrap());
        let layer = layer(&flakes, 0.01, gtr, true).unwrap();
        assert!(layer.masking.g1(direction(0.99, 0.0)) < 0.9);
        assert!(layer.structure_bytes() > 64 * 64 * 13);
        flakes.mask.fill(0.0);
        assert!(
            FlakeLayer::new(
                &map_of(&flakes),
                Some(mask_of(&flakes)),
                LayerMasking::None,
                SINE,
                |_| panic!()
            )
            .is_err()
        );
    }
}
