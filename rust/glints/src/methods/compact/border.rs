//! Areas of the texels that the border of a footprint cuts.
//!
//! Most texels of a footprint lie inside it, with weight one, and of those at its border few are near the half vector. Those
//! wait here, with their places, until there are eight: then the share of their squares inside the footprint is computed for
//! all at once.
//!
//! **Computes** A footprint is `|s| <= 1/2, |t| <= 1/2` of two linear functions. A square that only `|s| = 1/2` cuts has the
//! share `f(1/2 - s) + f(1/2 + s) - 1` inside, with s at its middle, gradient `(g_x, g_y)`, `a >= b` the greater and the
//! lesser of `|g_x|, |g_y|`, and for d > 0 (`f(-d) = 1 - f(d)`)
//!
//! ```text
//! f(d) = 1/2 + d / a                           while d <= (a - b) / 2,
//!        1 - ((a + b) / 2 - d)^2 / (2 a b)     beyond, and 1 from d = (a + b) / 2 on.
//! ```
//!
//! Squares that both cut, at the corners, and all of footprints thinner than [`THIN`], are cut exactly
//! ([`Parallelogram::overlap`]).
//!
//! **Bounds** Positions count from the footprint's middle, in single precision: weights are within 1e-4 of the exact area.

use glam::DVec2;
use wide::{CmpGe, CmpGt, CmpLe, f32x8};

use super::lanes::{bits, compress, eight};
use super::lobes::Sums;
use crate::footprint::Parallelogram;

/// Thickness in texels below which single precision does not tell the two sides of a footprint apart.
const THIN: f64 = 0.05;

/// Room for whole groups of eight.
const QUEUE: usize = 64;

/// The border of one parallelogram, and texels near it that wait.
pub struct Border<'a> {
    pub region: &'a Parallelogram,
    /// The texel that positions count from, and of it the middle less the footprint's.
    origin: [i32; 2],
    offset: [f32; 2],
    slabs: [Slab; 2],
    is_thin: bool,
    x: [f32; QUEUE],
    y: [f32; QUEUE],
    columns: [f32; QUEUE],
    rows: [f32; QUEUE],
    len: usize,
}

/// One of the two linear functions, per texel.
#[derive(Clone, Copy)]
struct Slab {
    gradient: [f32; 2],
    /// `a`, `b`, `1 / a` and `1 / (2 a b)`, zero where the last piece is too short to matter.
    long: f32,
    short: f32,
    inv_long: f32,
    inv_product: f32,
}

impl Slab {
    fn new(gradient: DVec2) -> Self {
        let (long, short) = (gradient.abs().max_element(), gradient.abs().min_element());
        let inv_product = if short > 1e-5 * long {
            0.5 / (long * short)
        } else {
            0.0
        };
        Self {
            gradient: gradient.as_vec2().to_array(),
            long: long as f32,
            short: short as f32,
            inv_long: (1.0 / long) as f32,
            inv_product: inv_product as f32,
        }
    }

    /// `|s|` at the middles of texels.
    #[inline(always)]
    fn distance(&self, x: f32x8, y: f32x8) -> f32x8 {
        let [gx, gy] = self.gradient;
        x.mul_add(f32x8::splat(gx), y * gy).abs()
    }

    /// Half of the variation of s over a texel.
    #[inline(always)]
    fn variation(&self) -> f32 {
        0.5 * (self.long + self.short)
    }

    /// Share of texels inside.
    #[inline]
    fn share(&self, distance: f32x8) -> f32x8 {
        self.below(0.5 - distance) + self.below(0.5 + distance) - 1.0
    }

    #[inline]
    fn below(&self, d: f32x8) -> f32x8 {
        let m = d.abs();
        let rest = (self.variation() - m).fast_max(f32x8::ZERO);
        let middle = m.mul_add(f32x8::splat(self.inv_long), f32x8::splat(0.5));
        let end = 1.0 - rest * rest * self.inv_product;
        let middle_ends = f32x8::splat(0.5 * (self.long - self.short));
        let share = m.cmp_le(middle_ends).blend(middle, end);
        d.cmp_ge(f32x8::ZERO).blend(share, 1.0 - share)
    }
}

impl<'a> Border<'a> {
    pub fn new(region: &'a Parallelogram) -> Self {
        let center = region.center();
        let origin = center.floor();
        let slabs = region.slabs_at(DVec2::ZERO).map(|(gradient, _)| gradient);
        let thickness = slabs.map(|gradient| 1.0 / gradient.length());
        Self {
            region,
            origin: [origin.x as i32, origin.y as i32],
            offset: (origin + 0.5 - center).as_vec2().to_array(),
            slabs: slabs.map(Slab::new),
            is_thin: thickness[0].min(thickness[1]) < THIN,
            x: [0.0; QUEUE],
            y: [0.0; QUEUE],
            columns: [0.0; QUEUE],
            rows: [0.0; QUEUE],
            len: 0,
        }
    }

    /// Position of a texel relative to the footprint's origin.
    #[inline(always)]
    pub fn place(&self, column: u32, row: u32) -> (f32, f32) {
        let [x, y] = self.origin;
        ((column as i32 - x) as f32, (row as i32 - y) as f32)
    }

    /// Which of eight texels at `(columns, rows)`, as from [`Self::place`], are not outside, and which are inside.
    #[inline(always)]
    pub fn sides(&self, columns: f32x8, rows: f32x8) -> (u32, u32) {
        let (x, y) = (columns + self.offset[0], rows + self.offset[1]);
        let (mut outside, mut inside) = (f32x8::ZERO, f32x8::ONE.cmp_gt(f32x8::ZERO));
        for slab in &self.slabs {
            let s = slab.distance(x, y);
            let variation = slab.variation();
            outside |= s.cmp_ge(f32x8::splat(0.5 + variation));
            inside &= s.cmp_le(f32x8::splat(0.5 - variation));
        }
        (!outside.move_mask() as u32 & 0xff, inside.move_mask() as u32)
    }

    /// Adds cut texels in `lanes`, whose normals project to `(x, y)`.
    #[inline(always)]
    pub fn add(&mut self, lanes: u32, [x, y]: [f32x8; 2], [columns, rows]: [f32x8; 2], sums: &mut Sums) {
        compress(lanes, x, &mut self.x, self.len);
        compress(lanes, y, &mut self.y, self.len);
        compress(lanes, columns, &mut self.columns, self.len);
        compress(lanes, rows, &mut self.rows, self.len);
        self.len += lanes.count_ones() as usize;
        if self.len > QUEUE - 8 {
            self.flush(sums);
        }
    }

    /// Adds what waits. To be called before the border is left.
    #[cold]
    pub fn flush(&mut self, sums: &mut Sums) {
        for start in (0..self.len).step_by(8) {
            let lanes = (1_u32 << (self.len - start).min(8)) - 1;
            let weights = self.weights(lanes, eight(&self.columns, start), eight(&self.rows, start));
            sums.add(lanes, eight(&self.x, start), eight(&self.y, start), weights);
        }
        self.len = 0;
    }

    /// Areas of texels inside the footprint.
    fn weights(&self, lanes: u32, columns: f32x8, rows: f32x8) -> f32x8 {
        let (x, y) = (columns + self.offset[0], rows + self.offset[1]);
        let [s, t] = self.slabs.each_ref().map(|slab| {
            let distance = slab.distance(x, y);
            let is_cut = distance.cmp_gt(f32x8::splat(0.5 - slab.variation()));
            (slab.share(distance), is_cut)
        });
        let mut weights = s.1.blend(s.0, f32x8::ONE) * t.1.blend(t.0, f32x8::ONE);
        let exact = if self.is_thin {
            lanes
        } else {
            lanes & (s.1 & t.1).move_mask() as u32
        };
        for k in bits(exact) {
            let (column, row) = (columns.as_array_ref()[k] as i32, rows.as_array_ref()[k] as i32);
            let corner = DVec2::new(
                f64::from(column + self.origin[0]),
                f64::from(row + self.origin[1]),
            );
            weights.as_array_mut()[k] = self.region.overlap(corner, corner + 1.0) as f32;
        }
        weights.fast_max(f32x8::ZERO)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::footprint::Footprint;
    use crate::methods::compact::lanes::LANES;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn weights_are_areas(
            center in (10.0..20.0_f64, 10.0..20.0_f64),
            length in 0.02..12.0_f64,
            ratio in 0.01..1.0_f64,
            angles in (0.0..6.3_f64, 0.3..2.8_f64),
            first in (0..30_u32, 0..30_u32),
        ) {
            let a = DVec2::from_angle(angles.0) * length;
            let b = DVec2::from_angle(angles.0 + angles.1) * length * ratio;
            let footprint = Footprint::in_texels(40, 40, center.into(), a, b);
            let region = footprint.region().unwrap();
            let border = Border::new(region);
            let (column, row) = border.place(first.0, first.1);
            let (columns, rows) = (LANES + column, f32x8::splat(row));
            let (touched, inside) = border.sides(columns, rows);
            let weights = border.weights(0xff, columns, rows).to_array();
            for (k, &weight) in weights.iter().enumerate() {
                let area = region.texel_overlap(first.0 + k as u32, first.1) as f32;
                let expected = match (touched >> k & 1, inside >> k & 1) {
                    (0, _) => 0.0,
                    (_, 1) => 1.0,
                    _ => weight,
                };
                prop_assert!((expected - area).abs() < 1e-4, "{expected} for {area} in lane {k}");
            }
        }
    }
}
