//! No filter: the combined BRDF of the one texel under the shading point.
//!
//! **Computes** Eq. 5 of Atanasov et al. 2021 at the footprint's centre, whatever the footprint. It converges
//! to the true image with many samples per pixel, since averaging over a pixel's samples is the integral of
//! Eq. 10; it is therefore the reference that filtered methods are held against.
//!
//! With [`Interpolation::Bilinear`] the normal is interpolated in the projected disk: the surface that curved
//! elements of Yan et al. 2016 stand for, and the reference of methods that have it.
//!
//! **Layout** One unit normal a texel, 12 bytes.
//!
//! **Cost** One texel a query; four of an interpolated map.

use glam::{Vec2, Vec3};

use super::{Method, Reflection, mean_over};
use crate::flakes::FlakeModel;
use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;
use crate::normal_map::NormalMap;

/// What the surface is between the centres of texels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Interpolation {
    /// Piecewise flat: one normal a texel.
    #[default]
    Nearest,
    /// [`NormalMap::interpolated`].
    Bilinear,
}

pub struct Unfiltered {
    map: NormalMap,
    model: FlakeModel,
    interpolation: Interpolation,
}

impl Unfiltered {
    pub fn new(map: NormalMap, model: FlakeModel, interpolation: Interpolation) -> Self {
        Self {
            map,
            model,
            interpolation,
        }
    }

    #[inline]
    fn normal(&self, footprint: &Footprint) -> Vec3 {
        match self.interpolation {
            Interpolation::Nearest => {
                let (column, row) = footprint.texel();
                self.map.normal(column, row)
            }
            Interpolation::Bilinear => self.map.interpolated_normal(footprint.center()),
        }
    }
}

impl Method for Unfiltered {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        self.model.reflection(pair, self.normal(footprint), 1.0)
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.model.density(h, self.normal(footprint), 1.0)
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.model.ndf(h, self.normal(footprint), 1.0)
    }

    fn ndf_over(&self, footprint: &Footprint, low: Vec2, high: Vec2) -> Option<f32> {
        let integral = || self.model.ndf_integral(self.normal(footprint), 1.0, low, high);
        Some(mean_over(low, high, integral))
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        self.model.sample(self.normal(footprint), [u[2], u[3]])
    }

    fn map_size(&self) -> (u32, u32) {
        (self.map.width(), self.map.height())
    }

    fn structure_bytes(&self) -> usize {
        size_of_val(self.map.normals())
    }

    fn name(&self) -> &'static str {
        "unfiltered"
    }
}
