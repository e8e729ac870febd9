//! One module per published method; each answers the three questions of [`Method`] over a footprint.

pub mod compact;
pub mod direct;
pub mod inverse_bin_map;
pub mod tensor;
pub mod unfiltered;
pub mod yan16;

use arrayvec::ArrayVec;
use glam::{Vec2, Vec3};

use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;

/// A distribution of normals that can be filtered over footprints.
///
/// Fresnel term, colour and the whole map's shadowing `G_x` are the caller's; a method sees a footprint and
/// directions above the horizon, and is total: every input has an answer.
///
/// `sample` and the density of [`Method::evaluate`] are exact partners: what `sample` draws has that density
/// per solid angle, and where `sample` gives up with some probability, the density integrates to one minus
/// that probability.
pub trait Method: Send + Sync {
    /// The reflection `R` and the density of `pair.half` under [`Method::sample`], both over the footprint:
    ///
    /// ```text
    /// R = sum_k w_k D^alpha(h, t_k) G1(i, t_k) G1(o, t_k)   [/ (t_k . n) when normalized by projected area]
    /// ```
    ///
    /// so that the BRDF is `F(i, h) G_x R / (4 (i . n) (o . n))`, Eq. 11 of Atanasov et al. 2021.
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection;

    /// The density of the half vector `h` under [`Method::sample`], per solid angle.
    fn density(&self, footprint: &Footprint, h: Vec3) -> f32;

    /// The filtered distribution of normals `D_A(h)`, per solid angle: `R` without shadowing.
    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32;

    /// The mean of [`Method::ndf`] over the rectangle `[low, high]` of the projected disk (half vectors' x and
    /// y), the range query of Deng et al. 2022 (Eq. 7):
    ///
    /// ```text
    /// 1 / |[low, high]|  integral over [low, high] of  D_A(x, y, sqrt(1 - x^2 - y^2)) dx dy,
    /// ```
    ///
    /// an area mean of a density per solid angle. Outside the unit disk `D_A` counts as zero and the area still
    /// counts, so that rectangles are additive: `area * mean` of a union of disjoint ones is the sum of theirs.
    /// A rectangle without area (`low < high` does not hold in both components) answers zero. `None`: the method
    /// cannot, whatever the rectangle.
    fn ndf_over(&self, _footprint: &Footprint, _low: Vec2, _high: Vec2) -> Option<f32> {
        None
    }

    /// [`Method::ndf_over`] of several rectangles `(low, high)`, at most [`MAX_RANGES`] of them: a method may look at the
    /// footprint once for all.
    fn ndf_over_all(&self, footprint: &Footprint, rectangles: &[(Vec2, Vec2)]) -> Option<RangeMeans> {
        let ranges = rectangles.iter().take(MAX_RANGES);
        ranges
            .map(|&(low, high)| self.ndf_over(footprint, low, high))
            .collect()
    }

    /// Draws a half vector: `u[0..2]` choose the point of the footprint, `u[2..4]` the normal of the flake
    /// there. `None`: the draw failed and counts as zero.
    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3>;

    /// Columns and rows of the map.
    fn map_size(&self) -> (u32, u32);

    /// Bytes that evaluation, density and sampling need.
    fn structure_bytes(&self) -> usize;

    /// Bins per side, for the methods that have bins.
    fn bins(&self) -> Option<u32> {
        None
    }

    /// Elements per texel and side, for the methods that have elements.
    fn refinement(&self) -> Option<u32> {
        None
    }

    /// The name under which people ask for the method.
    fn name(&self) -> &'static str;
}

/// Most rectangles of one question.
pub const MAX_RANGES: usize = 64;

/// What [`Method::ndf_over_all`] answers: one mean a rectangle.
pub type RangeMeans = ArrayVec<f32, MAX_RANGES>;

/// What [`Method::evaluate`] answers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reflection {
    /// `R`, per solid angle of half vectors.
    pub value: f32,
    /// Density of the half vector, per solid angle.
    pub density: f32,
}

/// A mean over a rectangle from the integral over it; zero without area, as [`Method::ndf_over`] answers.
pub(crate) fn mean_over(low: Vec2, high: Vec2, integral: impl FnOnce() -> f64) -> f32 {
    let extent = (high - low).as_dvec2();
    if low.cmplt(high).all() {
        (integral() / (extent.x * extent.y)) as f32
    } else {
        0.0
    }
}
