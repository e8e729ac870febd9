//! The direct sum: every texel of the footprint, exactly.
//!
//! **Computes** Eq. 11 and 12 of Atanasov et al. 2021, `sum_k w_k C(i, o, t_k)` with `w_k = |A n T_k| / |A|`,
//! without bins and without truncation. It is the ground truth of every filtered estimator over the same
//! footprint.
//!
//! **Layout** One unit normal a texel, 12 bytes.
//!
//! **Cost** Proportional to the texels of the footprint, at most about fifty periods of the map; `sample`
//! costs O(1).

use glam::Vec3;

use super::{Method, Reflection};
use crate::flakes::FlakeModel;
use crate::footprint::{Footprint, Parallelogram, Part};
use crate::half_vector::DirectionPair;
use crate::normal_map::NormalMap;

pub struct Direct {
    map: NormalMap,
    model: FlakeModel,
}

impl Direct {
    pub fn new(map: NormalMap, model: FlakeModel) -> Self {
        Self { map, model }
    }

    /// Calls `visit` with normals and their common weight `w_k`, block by block, over all texels of the
    /// footprint; weights sum to one.
    pub fn for_each_block(&self, footprint: &Footprint, mut visit: impl FnMut(&[Vec3], f32)) {
        let inv_area = 1.0 / footprint.area();
        footprint.for_each_part(|part| match part {
            Part::Texel { column, row } => visit(&[self.map.normal(column, row)], 1.0),
            Part::Cut(region) => self.for_each_block_of(&region, inv_area, &mut visit),
            Part::Whole(count) => visit(self.map.normals(), (count as f64 * inv_area) as f32),
        });
    }

    fn for_each_block_of(&self, region: &Parallelogram, inv_area: f64, visit: &mut impl FnMut(&[Vec3], f32)) {
        let width = self.map.width() as usize;
        for span in region.texel_spans(self.map.width(), self.map.height()) {
            let row = &self.map.normals()[span.row as usize * width..][..width];
            visit(
                &row[span.inside.0 as usize..span.inside.1 as usize],
                inv_area as f32,
            );
            for column in (span.touched.0..span.inside.0).chain(span.inside.1..span.touched.1) {
                let area = region.texel_overlap(column as u32, span.row as u32);
                if area > 0.0 {
                    visit(&[row[column as usize]], (area * inv_area) as f32);
                }
            }
        }
    }

    /// Calls `visit` with the texels of the footprint whose lobe reaches `h`.
    #[inline]
    fn for_each_lobe(&self, footprint: &Footprint, h: Vec3, mut visit: impl FnMut(Vec3, f32)) {
        self.for_each_block(footprint, |normals, weight| {
            for block in normals.chunks(16) {
                if !self.model.flake.misses_all(h, block) {
                    block.iter().for_each(|&t| visit(t, weight));
                }
            }
        });
    }

    fn sum(&self, footprint: &Footprint, h: Vec3, term: impl Fn(Vec3, f32) -> f32) -> f32 {
        let mut sum = 0.0;
        self.for_each_lobe(footprint, h, |t, weight| sum += f64::from(term(t, weight)));
        sum as f32
    }
}

impl Method for Direct {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        let (mut value, mut density) = (0.0, 0.0);
        self.for_each_lobe(footprint, pair.half, |t, weight| {
            let term = self.model.reflection(pair, t, weight);
            value += f64::from(term.value);
            density += f64::from(term.density);
        });
        Reflection {
            value: value as f32,
            density: density as f32,
        }
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.sum(footprint, h, |t, weight| self.model.density(h, t, weight))
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.sum(footprint, h, |t, weight| self.model.ndf(h, t, weight))
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let (column, row) = footprint.sample_texel([u[0].into(), u[1].into()]);
        self.model.sample(self.map.normal(column, row), [u[2], u[3]])
    }

    fn map_size(&self) -> (u32, u32) {
        (self.map.width(), self.map.height())
    }

    fn structure_bytes(&self) -> usize {
        size_of_val(self.map.normals())
    }

    fn name(&self) -> &'static str {
        "direct"
    }
}
