//! The square grid that normals are quantised to, over the bounding box of a map's projected normals.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use wide::f32x8;

use super::lobes::lifted;
use crate::normal_map::NormalMap;

/// A position on the projected hemisphere as two whole numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid {
    /// Corner of cell (0, 0).
    pub low: Vec2,
    /// Side of a cell.
    pub pitch: f32,
    /// Cells along x and y.
    pub size: [u32; 2],
}

impl Grid {
    /// The grid of `pitch` over all normals of the map.
    pub fn covering(bounds: (Vec2, Vec2), pitch: f64) -> Self {
        let (low, high) = bounds;
        let extent = (high - low).as_dvec2();
        // One more than fits, so that rounding keeps the last normal inside.
        let cells = |extent: f64| (extent / pitch) as u32 + 1;
        Self {
            low,
            pitch: pitch as f32,
            size: [cells(extent.x), cells(extent.y)],
        }
    }

    /// Column and row of the cell of a normal.
    #[inline]
    pub fn cell(&self, normal: Vec3) -> [u32; 2] {
        // Conversion saturates: what rounding puts left of the first cell stays in it.
        let index = |x: f32, low: f32, size: u32| (((x - low) / self.pitch) as u32).min(size - 1);
        [
            index(normal.x, self.low.x, self.size[0]),
            index(normal.y, self.low.y, self.size[1]),
        ]
    }

    /// The middle of cell `index` along an axis.
    #[inline]
    pub fn middle(&self, axis: usize, index: f32x8) -> f32x8 {
        (index + 0.5).mul_add(f32x8::splat(self.pitch), f32x8::splat(self.low[axis]))
    }

    /// The normal over the middle of a cell.
    pub fn normal(&self, cell: [u32; 2]) -> Vec3 {
        let p = self.point(cell);
        lifted(p.x, p.y)
    }

    /// The middle of a cell.
    #[inline]
    pub fn point(&self, [x, y]: [u32; 2]) -> Vec2 {
        let middle = |index: u32, low: f32| (index as f32 + 0.5).mul_add(self.pitch, low);
        Vec2::new(middle(x, self.low.x), middle(y, self.low.y))
    }
}

/// Least and greatest projection of a map's normals.
pub fn bounds(map: &NormalMap, project: impl Fn(Vec3) -> Vec2 + Sync) -> (Vec2, Vec2) {
    map.normals()
        .par_chunks(1 << 16)
        .map(|normals| {
            normals.iter().fold(EMPTY, |(low, high), &n| {
                let p = project(n);
                (low.min(p), high.max(p))
            })
        })
        .reduce(|| EMPTY, |a, b| (a.0.min(b.0), a.1.max(b.1)))
}

/// About 65536 of a map's normals, which tell how they are distributed; a prime number of texels apart, so that no pattern of
/// the map is met.
pub fn sparse(map: &NormalMap) -> impl Iterator<Item = Vec3> + '_ {
    let normals = map.normals();
    let step = [1, 3, 7, 17, 61, 251, 1021, 4093]
        .into_iter()
        .rfind(|step| step << 16 <= normals.len())
        .unwrap_or(1);
    normals.iter().step_by(step).copied()
}

const EMPTY: (Vec2, Vec2) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
