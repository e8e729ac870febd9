//! Areas of the texels that the border of a footprint cuts.
//!
//! Of the texels of a square that the border cuts, few are near the half vector. Those wait here ([`Touched`]) until there
//! are several; then the share of their squares inside the footprint is computed for eight at once. A footprint that wraps
//! around the map has several borders there, which are added one by one.
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
//! **Under a Gaussian** ([`crate::footprint_filter`]) the border is that at which it is cut, and no texel inside weighs
//! the same as its neighbour: all wait. Texels are taken in equal parts ([`Parts`]), eight texels at once, of which each has the
//! weight of the Taylor series of `footprint_filter`: as many parts as make them small against the deviation. Where the border
//! cuts a texel, parts are at most [`FINE`] deviations wide, and count by their areas inside, which moves less than 1e-5 of the
//! footprint's weight. Where that would take more than [`MOST_PARTS`] a side, texels are integrated one by one
//! ([`Window::texel_weight`]).
//!
//! **Bounds** Positions count from the footprint's middle, in single precision: weights are within 1e-4 of the exact area,
//! and of a Gaussian within 1e-5 of its weight.

use std::ops::Range;

use glam::DVec2;
use wide::{CmpGe, CmpGt, CmpLe, CmpLt, f32x8, u32x8};

use super::lanes::{LANES, bits, compress, eight, mask};
use super::lobes::{Near, Sums};
use crate::footprint::Parallelogram;
use crate::footprint_filter::{KEPT, LONGEST_SMALL, Window};

/// Thickness in texels below which single precision does not tell the two sides of a footprint apart.
const THIN: f64 = 0.05;

/// Deviations of a Gaussian up to whose width parts of texels at its border weigh as in their middle.
const FINE: f64 = 0.1;

/// Most parts along a side of a texel: more take longer than exact integration.
const MOST_PARTS: f64 = 8.0;

/// The border of a footprint in one period of the map.
pub struct Border<'a> {
    pub region: &'a Parallelogram,
    /// The texel that positions count from, and of it the middle less the footprint's.
    origin: [f32; 2],
    offset: [f32; 2],
    slabs: [Slab; 2],
    /// Of the footprint, along x.
    half_extent: f32,
    is_thin: bool,
    /// `None`: all texels inside weigh one.
    gaussian: Option<Gaussian<'a>>,
}

/// The squares of a row of squares that a footprint may touch, and some of them that lie inside it.
pub struct Squares {
    pub touched: Range<u32>,
    pub inside: Range<u32>,
}

/// The weights of texels under a Gaussian.
struct Gaussian<'a> {
    window: &'a Window,
    /// Of texels inside the border, and of those that it cuts; `None`: exact integration.
    inside: Option<Parts>,
    cut: Option<Parts>,
}

/// Texels in equal squares, whose sides are the unit of length here.
struct Parts {
    side: u32,
    series: Series,
    slabs: [Slab; 2],
}

/// The Taylor series of `footprint_filter`, of eight squares at once.
struct Series {
    /// By how much z changes over a texel's width and over its height.
    u: [f32; 2],
    v: [f32; 2],
    uu: f32,
    vv: f32,
    uv: f32,
    peak: f32,
}

/// Texels that may be within reach and that the border may cut. They wait until there are several groups.
pub struct Touched {
    x: [f32; QUEUE],
    y: [f32; QUEUE],
    columns: [f32; QUEUE],
    rows: [f32; QUEUE],
    len: usize,
}

/// Room for whole groups of eight.
const QUEUE: usize = 64;

impl Touched {
    pub fn new() -> Self {
        Self {
            x: [0.0; QUEUE],
            y: [0.0; QUEUE],
            columns: [0.0; QUEUE],
            rows: [0.0; QUEUE],
            len: 0,
        }
    }

    /// Adds texels at `columns` and `rows`. Of those that weigh the same inside the border, most lie inside, or outside: they
    /// need not wait.
    #[inline(always)]
    pub fn add(&mut self, near: &Near, [columns, rows]: [f32x8; 2], border: &Border, sums: &mut Sums) {
        let mut lanes = near.lanes;
        if border.is_even() {
            let (touched, inside) = border.sides(columns, rows);
            sums.add_alike(lanes & inside, near.x, near.y, 1.0);
            lanes &= touched & !inside;
        }
        if lanes == 0 {
            return;
        }
        compress(lanes, near.x, &mut self.x, self.len);
        compress(lanes, near.y, &mut self.y, self.len);
        compress(lanes, columns, &mut self.columns, self.len);
        compress(lanes, rows, &mut self.rows, self.len);
        self.len += lanes.count_ones() as usize;
        if self.len > QUEUE - 8 {
            self.flush(border, sums);
        }
    }

    /// Adds what waits. To be called before the border changes.
    #[inline(never)]
    pub fn flush(&mut self, border: &Border, sums: &mut Sums) {
        for start in (0..self.len).step_by(8) {
            let lanes = (1 << (self.len - start).min(8)) - 1;
            let weights = border.weights(lanes, eight(&self.columns, start), eight(&self.rows, start));
            sums.add(lanes, eight(&self.x, start), eight(&self.y, start), weights);
        }
        self.len = 0;
    }
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
    /// In a row at y, the slab is what lies within `half_width` of `x = shift y`.
    shift: f32,
    half_width: f32,
    /// Half of how far texels along the row differ in s, as a length.
    half_texel: f32,
}

impl Slab {
    fn new(gradient: DVec2) -> Self {
        let (long, short) = (gradient.abs().max_element(), gradient.abs().min_element());
        let inv_product = if short > 1e-5 * long {
            0.5 / (long * short)
        } else {
            0.0
        };
        // Along the rows, a slab holds all of a row or nothing.
        let gx = if gradient.x.abs() > 1e-9 * long {
            gradient.x
        } else {
            1e-9 * long
        };
        Self {
            shift: (-gradient.y / gx) as f32,
            half_width: (0.5 / gx.abs()) as f32,
            half_texel: (0.5 * (long + short) / gx.abs()) as f32,
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

impl<'a> Gaussian<'a> {
    /// `gradients`: of s and t, per texel; `edges`: of a texel in deviations.
    fn new(window: &'a Window, gradients: [DVec2; 2], edges: [DVec2; 2]) -> Self {
        let longest = edges[0].length().max(edges[1].length());
        let parts = |width: f64| {
            let side = (longest / width).ceil();
            (side <= MOST_PARTS).then(|| Parts::new(side, gradients, edges))
        };
        Self {
            window,
            inside: parts(LONGEST_SMALL),
            cut: parts(FINE),
        }
    }
}

impl Parts {
    fn new(side: f64, gradients: [DVec2; 2], edges: [DVec2; 2]) -> Self {
        let [u, v] = edges.map(|edge| edge / side);
        Self {
            side: side as u32,
            series: Series {
                u: u.as_vec2().to_array(),
                v: v.as_vec2().to_array(),
                uu: u.length_squared() as f32,
                vv: v.length_squared() as f32,
                uv: u.dot(v) as f32,
                peak: (u.perp_dot(v).abs() / (std::f64::consts::TAU * KEPT)) as f32,
            },
            slabs: gradients.map(|gradient| Slab::new(gradient / side)),
        }
    }

    /// Sums over the parts of texels whose middles are at `(x, y)` from the Gaussian's, in texels.
    #[inline]
    fn sum(&self, x: f32x8, y: f32x8, weight: impl Fn(f32x8, f32x8) -> f32x8) -> f32x8 {
        let first = |middle: f32x8| middle * self.side as f32 - 0.5 * (self.side as f32 - 1.0);
        let (x, y) = (first(x), first(y));
        let mut sum = f32x8::ZERO;
        for row in 0..self.side {
            for column in 0..self.side {
                sum += weight(x + column as f32, y + row as f32);
            }
        }
        sum
    }

    /// Weights of whole texels.
    #[inline]
    fn whole(&self, x: f32x8, y: f32x8) -> f32x8 {
        self.sum(x, y, |x, y| self.series.at(x, y))
    }

    /// Weights of what lies inside the border.
    #[inline]
    fn inside(&self, x: f32x8, y: f32x8) -> f32x8 {
        self.sum(x, y, |x, y| self.series.at(x, y) * shares(&self.slabs, x, y).0)
    }
}

/// Shares of squares that lie inside both slabs, and which of them are cut by both. Those shares are products, which is right
/// where a parallelogram's corners are right angles.
#[inline(always)]
fn shares(slabs: &[Slab; 2], x: f32x8, y: f32x8) -> (f32x8, u32) {
    let [s, t] = slabs.each_ref().map(|slab| {
        let distance = slab.distance(x, y);
        let is_cut = distance.cmp_gt(f32x8::splat(0.5 - slab.variation()));
        let touches = distance.cmp_lt(f32x8::splat(0.5 + slab.variation()));
        (is_cut.blend(slab.share(distance), f32x8::ONE), is_cut, touches)
    });
    let touched = s.2 & t.2;
    let both = touched & s.1 & t.1;
    (
        (s.0 * t.0).fast_max(f32x8::ZERO) & touched,
        both.move_mask() as u32,
    )
}

impl Series {
    /// Weights of texels whose middles are at `(x, y)` from the Gaussian's.
    #[inline]
    fn at(&self, x: f32x8, y: f32x8) -> f32x8 {
        let dot = |[a, b]: [f32; 2], x: f32x8, y: f32x8| x.mul_add(f32x8::splat(a), y * b);
        let z = [0, 1].map(|axis| dot([self.u[axis], self.v[axis]], x, y));
        let (a, b) = (dot(self.u, z[0], z[1]), dot(self.v, z[0], z[1]));
        let (a2, b2, ab) = (a * a, b * b, a * b);
        let Self { uu, vv, uv, .. } = *self;
        let second = (a2 - uu) + (b2 - vv);
        let fourth = |x2: f32x8, xx: f32| x2 * x2 - x2 * (6.0 * xx) + 3.0 * xx * xx;
        let mixed = a2 * b2 - a2 * vv - b2 * uu - ab * (4.0 * uv) + (uu * vv + 2.0 * uv * uv);
        let factor = 1.0
            + second * (1.0 / 24.0)
            + (fourth(a2, uu) + fourth(b2, vv)) * (1.0 / 1920.0)
            + mixed * (1.0 / 576.0);
        let z2 = z[0].mul_add(z[0], z[1] * z[1]);
        factor * self.peak * (z2 * -0.5).exp()
    }
}

impl<'a> Border<'a> {
    pub fn new(window: &'a Window) -> Self {
        let region = window.region();
        let center = region.center();
        let origin = center.floor();
        let gradients = region.slabs_at(DVec2::ZERO).map(|(gradient, _)| gradient);
        let thickness = gradients.map(|gradient| 1.0 / gradient.length());
        Self {
            region,
            origin: origin.as_vec2().to_array(),
            offset: (origin + 0.5 - center).as_vec2().to_array(),
            slabs: gradients.map(Slab::new),
            half_extent: region.half_extents().x as f32,
            is_thin: thickness[0].min(thickness[1]) < THIN,
            gaussian: window
                .texel_in_deviations()
                .map(|edges| Gaussian::new(window, gradients, edges)),
        }
    }

    /// Whether all texels inside weigh one.
    #[inline(always)]
    pub fn is_even(&self) -> bool {
        self.gaussian.is_none()
    }

    /// Weights of the texels in `lanes`.
    #[inline]
    fn weights(&self, lanes: u32, columns: f32x8, rows: f32x8) -> f32x8 {
        match &self.gaussian {
            None => self.areas(lanes, columns, rows),
            Some(gaussian) => self.gaussian_weights(gaussian, lanes, columns, rows),
        }
    }

    #[inline(never)]
    fn gaussian_weights(&self, gaussian: &Gaussian, lanes: u32, columns: f32x8, rows: f32x8) -> f32x8 {
        let (x, y) = self.relative(columns, rows);
        let (touched, inside) = self.sides(columns, rows);
        let (inside, cut) = (touched & lanes & inside, touched & lanes & !inside);
        let (mut weights, mut exact) = (f32x8::ZERO, 0);
        let mut add = |lanes: u32, found: Option<f32x8>| match found {
            Some(found) => weights |= found & mask(lanes),
            None => exact |= lanes,
        };
        if inside != 0 {
            add(inside, gaussian.inside.as_ref().map(|parts| parts.whole(x, y)));
        }
        if cut != 0 {
            add(cut, gaussian.cut.as_ref().map(|parts| parts.inside(x, y)));
        }
        for k in bits(exact) {
            let (column, row) = (columns.as_array_ref()[k] as u32, rows.as_array_ref()[k] as u32);
            weights.as_array_mut()[k] = gaussian.window.texel_weight(column, row) as f32;
        }
        weights
    }

    /// Positions of the middles of texels from the footprint's; columns and rows are whole, and their difference exact.
    #[inline(always)]
    fn relative(&self, columns: f32x8, rows: f32x8) -> (f32x8, f32x8) {
        (
            columns - self.origin[0] + self.offset[0],
            rows - self.origin[1] + self.offset[1],
        )
    }

    /// Which of eight texels are not outside, and which are inside.
    #[inline(always)]
    fn sides(&self, columns: f32x8, rows: f32x8) -> (u32, u32) {
        let (x, y) = self.relative(columns, rows);
        let (mut outside, mut inside) = (f32x8::ZERO, f32x8::ONE.cmp_gt(f32x8::ZERO));
        for slab in &self.slabs {
            let s = slab.distance(x, y);
            let variation = slab.variation();
            outside |= s.cmp_ge(f32x8::splat(0.5 + variation));
            inside &= s.cmp_le(f32x8::splat(0.5 - variation));
        }
        (!outside.move_mask() as u32 & 0xff, inside.move_mask() as u32)
    }

    /// Areas of texels inside the footprint, of those in `lanes`.
    #[inline]
    fn areas(&self, lanes: u32, columns: f32x8, rows: f32x8) -> f32x8 {
        let (x, y) = self.relative(columns, rows);
        let (mut areas, both) = shares(&self.slabs, x, y);
        let exact = if self.is_thin {
            self.sides(columns, rows).0
        } else {
            both
        };
        for k in bits(lanes & exact) {
            let corner = DVec2::new(
                f64::from(columns.as_array_ref()[k]),
                f64::from(rows.as_array_ref()[k]),
            );
            areas.as_array_mut()[k] = self.region.overlap(corner, corner + 1.0) as f32;
        }
        areas
    }

    /// The squares of `side` texels in eight rows of squares, of those in `columns`.
    #[inline]
    pub fn squares(&self, side: u32, row: u32, columns: &Range<u32>) -> [Squares; 8] {
        let size = side as f32;
        // Numbers count from the square that holds the footprint's middle: they stay small, and single precision tells them apart.
        let origin = self.origin.map(|origin| (origin / size).floor());
        let first = [0, 1].map(|axis| {
            let corner = origin[axis] * size - self.origin[axis];
            corner + 0.5 * (size - 1.0) + self.offset[axis]
        });
        let y = (LANES + (row as f32 - origin[1])).mul_add(f32x8::splat(size), f32x8::splat(first[1]));
        let widest = f32x8::splat(self.half_extent + 0.5 * size + 0.01);
        let (mut touched, mut inside) = ((-widest, widest), (-widest, widest));
        for slab in &self.slabs {
            let middle = y * slab.shift;
            let half = f32x8::splat(slab.half_width);
            let variation = f32x8::splat(slab.half_texel) * size;
            let rounding = rounding(middle, half + variation);
            let narrow = |(low, high): (f32x8, f32x8), reach: f32x8| {
                (low.fast_max(middle - reach), high.fast_min(middle + reach))
            };
            touched = narrow(touched, half + variation + rounding);
            inside = narrow(inside, half - variation - rounding);
        }
        let [start, end] = [columns.start, columns.end].map(|column| f32x8::splat(column as f32 - origin[0]));
        let range = |(low, high): (f32x8, f32x8), start: f32x8, end: f32x8| {
            let square = |x: f32x8| (x - first[0]) * (1.0 / size);
            let low = square(low).ceil().fast_max(start).fast_min(end);
            (low, (square(high).floor() + 1.0).fast_max(low).fast_min(end))
        };
        let touched = range(touched, start, end);
        let inside = range(inside, touched.0, touched.1);
        let column = |x: f32x8| (x + origin[0]).trunc_int().to_array();
        let [a, b, c, d] = [touched.0, touched.1, inside.0, inside.1].map(column);
        std::array::from_fn(|k| Squares {
            touched: a[k] as u32..b[k] as u32,
            inside: c[k] as u32..d[k] as u32,
        })
    }

    /// Bit `8 y + x`: the footprint may touch this one of the 8 x 8 texels from `(column, row)` on. It touches no other.
    #[inline]
    pub fn touched(&self, column: u32, row: u32) -> u64 {
        let (x, y) = self.relative(f32x8::splat(column as f32), LANES + row as f32);
        let (mut first, mut last) = (f32x8::splat(-1.0), f32x8::splat(8.0));
        for slab in &self.slabs {
            let middle = y * slab.shift - x;
            let reach = f32x8::splat(slab.half_width + slab.half_texel);
            let reach = reach + rounding(middle, reach);
            first = first.fast_max(middle - reach);
            last = last.fast_min(middle + reach);
        }
        let count = |x: f32x8| -> u32x8 {
            let clamped = x.fast_max(f32x8::ZERO).fast_min(f32x8::splat(8.0));
            bytemuck::cast(clamped.trunc_int())
        };
        // Texels from the first on, and up to the last.
        let from = u32x8::splat(0xff) << count(first.ceil());
        let to = u32x8::splat(0xff) >> (u32x8::splat(8) - count(last.floor() + 1.0));
        let rows = (from & to).to_array();
        rows.into_iter()
            .rev()
            .fold(0, |mask, row| mask << 8 | u64::from(row & 0xff))
    }
}

/// What rounding may move the ends of an interval `middle +- half` by: it grows with the numbers that are subtracted.
#[inline(always)]
fn rounding(middle: f32x8, half: f32x8) -> f32x8 {
    0.01 + (middle.abs() + half) * 4e-6
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::footprint::{Footprint, Span};
    use crate::footprint_filter::{FilteredPart, FootprintFilter};
    use crate::methods::compact::lanes::LANES;
    use proptest::prelude::*;

    /// Edges of a parallelogram: a length, the other's ratio to it, and where each turns.
    fn edges(length: f64, ratio: f64, angles: (f64, f64)) -> [DVec2; 2] {
        [
            DVec2::from_angle(angles.0) * length,
            DVec2::from_angle(angles.0 + angles.1) * length * ratio,
        ]
    }

    proptest! {
        #[test]
        fn squares_of_rows_are_those_of_the_footprint(
            center in (0.0..4096.0_f64, 0.0..4096.0_f64),
            length in 1.0..900.0_f64,
            ratio in 0.001..1.0_f64,
            turns in (0..9_u32, -1e-6..1e-6_f64, 0.0..6.3_f64, 0.01..3.1_f64),
        ) {
            // Some along the rows and columns, or nearly so.
            let turn = if turns.0 < 5 { f64::from(turns.0) * std::f64::consts::FRAC_PI_2 + turns.1 } else { turns.2 };
            let [a, b] = edges(length, ratio, (turn, turns.3));
            let footprint = Footprint::in_texels(4096, 4096, center.into(), a, b);
            // In every period that it reaches into.
            let mut windows = Vec::new();
            FootprintFilter::Box.over(&footprint).for_each_part(|part| {
                if let FilteredPart::Cut(window) = part {
                    windows.push(window);
                }
            });
            let in_map = |span: &Span| (0..512).contains(&span.row);
            for (window, span) in windows.iter().flat_map(|window| {
                let spans = window.region().spans(DVec2::splat(8.0)).filter(in_map);
                spans.map(move |span| (window, span))
            }) {
                let (region, border) = (window.region(), Border::new(window));
                let row = span.row as u32;
                let Squares { touched, inside } = &border.squares(8, row / 8 * 8, &(0..512))[row as usize % 8];
                prop_assert!(inside.is_empty() || touched.start <= inside.start && inside.end <= touched.end);
                for column in (span.touched.0 - 2).max(0)..(span.touched.1 + 2).min(512) {
                    let column = column as u32;
                    let corner = 8.0 * DVec2::new(column.into(), row.into());
                    let area = region.overlap(corner, corner + 8.0);
                    prop_assert!(area < 1e-6 || touched.contains(&column), "{area} of {column} {row} outside");
                    prop_assert!(area > 64.0 - 1e-6 || !inside.contains(&column), "{area} of {column} {row} inside");
                    // Not much more than needed, unless an edge is along the rows, nearly, and rounding decides.
                    if turns.0 < 5 {
                        continue;
                    }
                    let is_near = (span.touched.0 - 1..span.touched.1 + 1).contains(&column.into());
                    prop_assert!(is_near || !touched.contains(&column), "{column} {row} is far away");
                    let is_deep = (span.inside.0 + 1..span.inside.1 - 1).contains(&column.into());
                    prop_assert!(!is_deep || inside.contains(&column), "{column} {row} is deep inside");
                }
            }
        }

        #[test]
        fn weights_are_areas(
            center in (13.0..20.0_f64, 13.0..20.0_f64),
            length in 0.02..12.0_f64,
            ratio in 0.01..1.0_f64,
            angles in (0.0..6.3_f64, 0.3..2.8_f64),
            first in (0..30_u32, 0..30_u32),
        ) {
            let [a, b] = edges(length, ratio, angles);
            let footprint = Footprint::in_texels(40, 40, center.into(), a, b);
            let region = footprint.region().unwrap();
            let window = FootprintFilter::Box.over(&footprint).single_window().unwrap();
            let border = Border::new(&window);
            let touched = border.touched(first.0, first.1);
            let (columns, rows) = (LANES + first.0 as f32, f32x8::splat(first.1 as f32));
            let areas = border.areas(0xff, columns, rows).to_array();
            for (k, &found) in areas.iter().enumerate() {
                let area = region.texel_overlap(first.0 + k as u32, first.1) as f32;
                prop_assert!((found - area).abs() < 1e-4, "{found} for {area} in lane {k}");
            }
            for k in 0..64 {
                let area = region.texel_overlap(first.0 + k % 8, first.1 + k / 8);
                prop_assert!(area < 1e-6 || touched >> k & 1 == 1, "texel {k} of area {area}");
            }
        }

        #[test]
        fn weights_are_masses_of_the_gaussian(
            center in (10.0..90.0_f64, 10.0..90.0_f64),
            length in 0.02..60.0_f64,
            ratio in 0.01..1.0_f64,
            angles in (0.0..6.3_f64, 0.3..2.8_f64),
            deviation in 0.1..1.0_f32,
        ) {
            let [a, b] = edges(length, ratio, angles);
            let footprint = Footprint::in_texels(96, 96, center.into(), a, b);
            let filtered = FootprintFilter::gaussian(deviation).unwrap().over(&footprint);
            let (mut distance, mut missed) = (0.0, 0.0);
            filtered.for_each_part(|part| {
                let FilteredPart::Cut(window) = part else { return };
                let border = Border::new(&window);
                for (row, column) in (0..96).flat_map(|row| (0..12).map(move |k| (row, 8 * k))) {
                    let columns = LANES + column as f32;
                    let found = border.weights(0xff, columns, f32x8::splat(row as f32)).to_array();
                    let touched = border.touched(column, row);
                    for (k, &found) in found.iter().enumerate() {
                        let weight = window.texel_weight(column + k as u32, row);
                        distance += (f64::from(found) - weight).abs();
                        missed += if touched >> k & 1 == 0 { weight } else { 0.0 };
                    }
                }
            });
            prop_assert!(distance < 2e-5 && missed < 1e-6, "off by {distance}, missed {missed}");
        }
    }
}
