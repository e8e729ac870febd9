//! The pixel footprint A in texel space, and exact areas of its intersections (Eq. 12 of Atanasov et al.
//! 2021).
//!
//! A footprint is the parallelogram of the ray differentials, `A = { c + s a + t b : |s|, |t| <= 1/2 }`, with
//! the centre `c` and the edges `a`, `b` in texels. Its indicator is the product of two slab tests,
//!
//! ```text
//! s(p) = (p - c) x b / (a x b),    t(p) = a x (p - c) / (a x b),    p in A  <=>  |s(p)| <= 1/2 and |t(p)| <= 1/2,
//! ```
//!
//! so that an axis-aligned box with half extents `e` is outside, inside or cut by comparing `|s|`, `|t|` at
//! its centre with `1/2 +- (|ds/dx| e.x + |ds/dy| e.y)`. A box cut by one slab only, by far the most frequent
//! case, has a closed form for its area; the rest is clipped as a polygon. Both are exact up to double
//! precision.
//!
//! Everything that a footprint can be is decided here and nowhere else:
//!
//! * **Tiling.** The map repeats. [`Footprint::for_each_part`] cuts A into the parts that fall into one tile
//!   each, moved to the map's own coordinates, and counts the tiles that lie inside A entirely, so that a
//!   method answers for those from its total histogram.
//! * **Very large footprints.** An edge longer than [`MAX_TILES`] periods is shortened to that length: cost
//!   stays bounded, and a box filter over that many periods of a periodic function is within 1/`MAX_TILES` of
//!   its mean.
//! * **Degenerate footprints.** Two zero edges make a point: the texel under the centre has weight one.
//!   Parallel edges, or one zero edge, make a parallelogram that is [`MIN_THICKNESS`] texels thick (a
//!   thousandth of its length, if that is less), practically its limit.
//! * **Invalid differentials** (infinite or NaN) count as zero edges.

use std::ops::Range;

use glam::DVec2;

/// Longest edge of a footprint, in periods of the map.
pub const MAX_TILES: f64 = 16.0;

/// Thickness in texels below which a parallelogram is thickened. Areas stay accurate to about 1e-6 relative:
/// double precision resolves 1e-12 texels at map coordinates of 16K.
pub const MIN_THICKNESS: f64 = 1e-6;

/// Length in texels below which a footprint is a point: map coordinates do not resolve it.
const POINT_LENGTH: f64 = 1e-9;

/// The footprint of one shading point over a map of a given size.
#[derive(Clone, Copy, Debug)]
pub struct Footprint {
    size: DVec2,
    center: DVec2,
    texel: (u32, u32),
    region: Option<Parallelogram>,
}

/// One part of a footprint, in the coordinates of the map: `[0, width) x [0, height)`.
#[derive(Clone, Copy, Debug)]
pub enum Part {
    /// The texel under a footprint without extent; its weight is one.
    Texel { column: u32, row: u32 },
    /// The intersection of this parallelogram with the map.
    Cut(Parallelogram),
    /// This many whole periods of the map.
    Whole(u64),
}

/// A parallelogram with non-zero area; see the module for s and t.
#[derive(Clone, Copy, Debug)]
pub struct Parallelogram {
    center: DVec2,
    edges: [DVec2; 2],
    /// Gradients of s and t per texel.
    gradients: [DVec2; 2],
    area: f64,
}

/// How an axis-aligned box lies to a parallelogram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Coverage {
    Outside,
    Inside,
    Cut,
}

/// Cells of one row of a grid: those that may touch a parallelogram, and those that lie inside it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Span {
    pub row: i64,
    /// `touched.0 <= inside.0 <= inside.1 <= touched.1`, all half open.
    pub touched: (i64, i64),
    pub inside: (i64, i64),
}

impl Footprint {
    /// The footprint at texture coordinates `uv` (in periods, any finite value) with the partial derivatives
    /// of `uv` along the pixel's two axes, over a map of `width x height` texels.
    ///
    /// The texel under `uv` is found in single precision exactly as nearest lookup with repetition finds it
    /// in renderers: `floor(u * width) mod width`.
    pub fn new(width: u32, height: u32, uv: [f32; 2], duv_dx: [f32; 2], duv_dy: [f32; 2]) -> Self {
        let size = DVec2::new(f64::from(width), f64::from(height));
        let position = |x: f32, side: u32| {
            let p = x * side as f32;
            f64::from(if p.is_finite() { p } else { 0.0 }).rem_euclid(f64::from(side))
        };
        let center = DVec2::new(position(uv[0], width), position(uv[1], height));
        // rem_euclid of a tiny negative number rounds up to the side itself.
        let texel = (
            (center.x as u32).min(width - 1),
            (center.y as u32).min(height - 1),
        );
        let edge = |d: [f32; 2]| {
            let e = DVec2::new(f64::from(d[0]), f64::from(d[1]));
            let periods = e.length();
            if !periods.is_finite() {
                return DVec2::ZERO;
            }
            e * size * (MAX_TILES / periods.max(MAX_TILES))
        };
        let region = Parallelogram::spanned(center, edge(duv_dx), edge(duv_dy));
        Self {
            size,
            center,
            texel,
            region,
        }
    }

    /// A footprint given in texels: centre and edges.
    pub fn in_texels(width: u32, height: u32, center: DVec2, a: DVec2, b: DVec2) -> Self {
        let scale = |v: DVec2| [(v.x / f64::from(width)) as f32, (v.y / f64::from(height)) as f32];
        Self::new(width, height, scale(center), scale(a), scale(b))
    }

    /// The footprint with the same centre and edges of `factor` times the length.
    pub fn widened(&self, factor: f64) -> Self {
        let region = self
            .region
            .and_then(|r| Parallelogram::spanned(self.center, r.edges[0] * factor, r.edges[1] * factor));
        Self { region, ..*self }
    }

    /// Columns and rows of the map.
    pub fn map_size(&self) -> DVec2 {
        self.size
    }

    /// Centre in texels, inside the map.
    pub fn center(&self) -> DVec2 {
        self.center
    }

    /// Edges of the parallelogram in texels; zero for a point.
    pub fn edges(&self) -> [DVec2; 2] {
        self.region.map_or([DVec2::ZERO; 2], |region| region.edges)
    }

    /// Column and row of the texel under the centre.
    pub fn texel(&self) -> (u32, u32) {
        self.texel
    }

    /// The parallelogram around the centre, in unwrapped texel coordinates; `None` for a point.
    pub fn region(&self) -> Option<&Parallelogram> {
        self.region.as_ref()
    }

    /// The parallelogram, if it lies inside one period of the map.
    pub fn single_part(&self) -> Option<&Parallelogram> {
        self.region
            .as_ref()
            .filter(|region| region.is_within(DVec2::ZERO, self.size))
    }

    /// Calls `visit` with every part of the footprint. Weights of texels are areas divided by
    /// [`Footprint::area`].
    pub fn for_each_part(&self, mut visit: impl FnMut(Part)) {
        let Some(region) = &self.region else {
            let (column, row) = self.texel;
            return visit(Part::Texel { column, row });
        };
        if region.is_within(DVec2::ZERO, self.size) {
            return visit(Part::Cut(*region));
        }
        let mut whole = 0;
        for span in region.spans(self.size) {
            whole += (span.inside.1 - span.inside.0) as u64;
            let cut = (span.touched.0..span.inside.0).chain(span.inside.1..span.touched.1);
            for column in cut {
                let tile = DVec2::new(column as f64, span.row as f64) * self.size;
                if region.coverage(tile, tile + self.size) != Coverage::Outside {
                    visit(Part::Cut(region.moved(-tile)));
                }
            }
        }
        if whole > 0 {
            visit(Part::Whole(whole));
        }
    }

    /// Area in texels; one for a point, whose one texel has weight one.
    pub fn area(&self) -> f64 {
        self.region.map_or(1.0, |r| r.area)
    }

    /// The texel at a uniformly distributed point of the footprint: it is drawn with its weight as
    /// probability.
    pub fn sample_texel(&self, u: [f64; 2]) -> (u32, u32) {
        self.sample_part(u).0
    }

    /// The same, and the part of the footprint that the texel lies in, in the coordinates of the map; `None` for
    /// a point.
    pub fn sample_part(&self, u: [f64; 2]) -> ((u32, u32), Option<Parallelogram>) {
        let Some(region) = &self.region else {
            return (self.texel, None);
        };
        let p = region.point(DVec2::from(u) - 0.5);
        let tile = (p / self.size).floor();
        (self.texel_at(p), Some(region.moved(-tile * self.size)))
    }

    /// Column and row of the texel at a point in unwrapped texel coordinates.
    pub fn texel_at(&self, point: DVec2) -> (u32, u32) {
        let texel = |x: f64, side: f64| (x.rem_euclid(side) as u32).min(side as u32 - 1);
        (texel(point.x, self.size.x), texel(point.y, self.size.y))
    }
}

impl Parallelogram {
    /// The parallelogram spanned by `a` and `b` around `center`; `None` if both are zero.
    fn spanned(center: DVec2, mut a: DVec2, mut b: DVec2) -> Option<Self> {
        if b.length_squared() > a.length_squared() {
            std::mem::swap(&mut a, &mut b);
        }
        let longest = a.length();
        if longest < POINT_LENGTH {
            return None;
        }
        let thickness = a.perp_dot(b).abs() / longest;
        let minimum = MIN_THICKNESS.min(1e-3 * longest);
        if thickness < minimum {
            b += a.perp() * ((minimum - thickness) / longest).copysign(a.perp_dot(b));
        }
        let determinant = a.perp_dot(b);
        Some(Self {
            center,
            edges: [a, b],
            gradients: [-b.perp() / determinant, a.perp() / determinant],
            area: determinant.abs(),
        })
    }

    pub(crate) fn moved(&self, by: DVec2) -> Self {
        Self {
            center: self.center + by,
            ..*self
        }
    }

    /// The parallelogram with edges that are so many times as long; factors are positive.
    pub(crate) fn scaled(&self, factors: [f64; 2]) -> Self {
        let [a, b] = self.edges;
        let [s, t] = self.gradients;
        Self {
            center: self.center,
            edges: [a * factors[0], b * factors[1]],
            gradients: [s / factors[0], t / factors[1]],
            area: self.area * factors[0] * factors[1],
        }
    }

    /// Calls `visit` with the parallelogram in the coordinates of every tile of `size` that it meets.
    pub(crate) fn for_each_tile(&self, size: DVec2, mut visit: impl FnMut(Self)) {
        for span in self.spans(size) {
            for column in span.touched.0..span.touched.1 {
                let tile = DVec2::new(column as f64, span.row as f64) * size;
                if self.coverage(tile, tile + size) != Coverage::Outside {
                    visit(self.moved(-tile));
                }
            }
        }
    }

    /// The point with the given s and t.
    pub(crate) fn point(&self, st: DVec2) -> DVec2 {
        self.center + st.x * self.edges[0] + st.y * self.edges[1]
    }

    /// Area in texels.
    pub fn area(&self) -> f64 {
        self.area
    }

    /// Centre in texels.
    pub fn center(&self) -> DVec2 {
        self.center
    }

    /// Edges in texels.
    pub fn edges(&self) -> [DVec2; 2] {
        self.edges
    }

    /// Corner points in order around the parallelogram.
    pub fn corners(&self) -> [DVec2; 4] {
        self.corners_from_center().map(|p| self.center + p)
    }

    fn corners_from_center(&self) -> [DVec2; 4] {
        let [a, b] = self.edges.map(|e| 0.5 * e);
        [-a - b, a - b, a + b, b - a]
    }

    /// Half extents of the axis-aligned bounding box.
    pub(crate) fn half_extents(&self) -> DVec2 {
        0.5 * (self.edges[0].abs() + self.edges[1].abs())
    }

    pub(crate) fn is_within(&self, low: DVec2, high: DVec2) -> bool {
        let e = self.half_extents();
        (self.center - e).cmpge(low).all() && (self.center + e).cmple(high).all()
    }

    /// s and t at the centre of a box, and by how much they vary from there to its sides.
    #[inline]
    fn slabs(&self, low: DVec2, high: DVec2) -> [(f64, f64); 2] {
        let d = 0.5 * (low + high) - self.center;
        let e = 0.5 * (high - low);
        let [s, t] = &self.gradients;
        [(s.dot(d), s.abs().dot(e)), (t.dot(d), t.abs().dot(e))]
    }

    /// Gradients per texel of s and t, and their values at `point`.
    pub fn slabs_at(&self, point: DVec2) -> [(DVec2, f64); 2] {
        self.gradients.map(|g| (g, g.dot(point - self.center)))
    }

    /// How the box `[low, high]` lies to the parallelogram. `Cut` may be answered for a box that is just
    /// outside one of the acute corners; its overlap is then zero.
    pub fn coverage(&self, low: DVec2, high: DVec2) -> Coverage {
        let slabs = self.slabs(low, high);
        if slabs.iter().all(|(s, r)| s.abs() + r <= 0.5) {
            return Coverage::Inside;
        }
        if slabs.iter().any(|(s, r)| s.abs() - r >= 0.5) || self.misses_bounds(low, high) {
            return Coverage::Outside;
        }
        Coverage::Cut
    }

    fn misses_bounds(&self, low: DVec2, high: DVec2) -> bool {
        let e = self.half_extents();
        (self.center + e).cmple(low).any() || (self.center - e).cmpge(high).any()
    }

    /// Exact area of the intersection with the box `[low, high]`.
    pub fn overlap(&self, low: DVec2, high: DVec2) -> f64 {
        let slabs = self.slabs(low, high);
        if slabs.iter().any(|(s, r)| s.abs() - r >= 0.5) || self.misses_bounds(low, high) {
            return 0.0;
        }
        let extent = high - low;
        let box_area = extent.x * extent.y;
        let is_cut = |i: usize| slabs[i].0.abs() + slabs[i].1 > 0.5;
        match (is_cut(0), is_cut(1)) {
            (false, false) => box_area,
            (true, false) => box_area * slab_fraction(self.gradients[0] * extent, slabs[0].0),
            (false, true) => box_area * slab_fraction(self.gradients[1] * extent, slabs[1].0),
            (true, true) => self.clipped_area(low, high),
        }
    }

    /// Area of the texel `(column, row)` inside the parallelogram.
    pub fn texel_overlap(&self, column: u32, row: u32) -> f64 {
        let low = DVec2::new(f64::from(column), f64::from(row));
        self.overlap(low, low + 1.0)
    }

    fn clipped_area(&self, low: DVec2, high: DVec2) -> f64 {
        // Relative to the centre, so that a tiny parallelogram keeps its shape at large coordinates.
        let (low, high) = (low - self.center, high - self.center);
        let mut polygon = Polygon::new(&self.corners_from_center());
        polygon.clip(|p| p.x - low.x);
        polygon.clip(|p| high.x - p.x);
        polygon.clip(|p| p.y - low.y);
        polygon.clip(|p| high.y - p.y);
        polygon.area()
    }

    /// Rows of height `height` that the parallelogram touches, of those in `rows`.
    pub fn rows(&self, height: f64, rows: Range<i64>) -> Range<i64> {
        let e = self.half_extents().y;
        let first = ((self.center.y - e) / height).floor().max(rows.start as f64) as i64;
        let end = ((self.center.y + e) / height).ceil().min(rows.end as f64) as i64;
        first..end
    }

    /// Rows of the grid with cells of size `cell` that the parallelogram touches, in increasing order.
    pub fn spans(&self, cell: DVec2) -> impl Iterator<Item = Span> + use<> {
        self.spans_of_rows(cell, i64::MIN..i64::MAX)
    }

    /// Those of [`Parallelogram::spans`] whose rows are in `rows`.
    fn spans_of_rows(&self, cell: DVec2, rows: Range<i64>) -> impl Iterator<Item = Span> + use<> {
        let spans = Rows::new(self, cell);
        self.rows(cell.y, rows).map(move |row| spans.span(row))
    }

    /// [`Parallelogram::spans`] over texels, cut to the map's `[0, width) x [0, height)`.
    pub fn texel_spans(&self, width: u32, height: u32) -> impl Iterator<Item = Span> + use<> {
        let cut = move |(x0, x1): (i64, i64)| (x0.clamp(0, width.into()), x1.clamp(0, width.into()));
        self.spans_of_rows(DVec2::ONE, 0..height.into())
            .map(move |span| Span {
                row: span.row,
                touched: cut(span.touched),
                inside: cut(span.inside),
            })
    }

    /// About how many texels the parallelogram touches.
    pub fn texel_count(&self) -> f64 {
        let e = self.half_extents();
        self.area + 2.0 * (e.x + e.y) + 1.0
    }
}

/// The cells of each row of a grid that a parallelogram touches or holds. Along a row, a slab `|s| <= bound`
/// is an interval of the cells' centres whose middle moves linearly from row to row.
struct Rows {
    center: DVec2,
    half_width: f64,
    cell_height: f64,
    inv_cell_width: f64,
    slabs: [RowSlab; 2],
}

/// Interval `shift * y +- half` of x from the parallelogram's centre, in the row whose middle is y above it.
struct RowSlab {
    shift: f64,
    /// Half of the interval in which a cell may touch the slab, and in which it lies inside; negative:
    /// nowhere.
    touched: f64,
    inside: f64,
}

impl Rows {
    fn new(region: &Parallelogram, cell: DVec2) -> Self {
        let slabs = region.gradients.map(|g| {
            // A slab along the rows holds all of a row or nothing: so does one that is tilted by next to
            // nothing.
            let gx = if g.x == 0.0 { 1e-100 } else { g.x };
            let variation = 0.5 * (g.x.abs() * cell.x + g.y.abs() * cell.y);
            RowSlab {
                shift: -g.y / gx,
                touched: (0.5 + variation) / gx.abs(),
                inside: (0.5 - variation) / gx.abs(),
            }
        });
        Self {
            center: region.center,
            half_width: region.half_extents().x + 0.5 * cell.x,
            cell_height: cell.y,
            inv_cell_width: 1.0 / cell.x,
            slabs,
        }
    }

    #[inline]
    fn span(&self, row: i64) -> Span {
        let y = (row as f64 + 0.5) * self.cell_height - self.center.y;
        let mut touched = (-self.half_width, self.half_width);
        let mut inside = touched;
        for slab in &self.slabs {
            let middle = slab.shift * y;
            touched.0 = touched.0.max(middle - slab.touched);
            touched.1 = touched.1.min(middle + slab.touched);
            inside.0 = inside.0.max(middle - slab.inside);
            inside.1 = inside.1.min(middle + slab.inside);
        }
        // Cell k has its centre at (k + 1/2) cell widths. A cell within rounding error of the boundary is
        // left to the exact overlap.
        let cell_at = |x: f64| (self.center.x + x) * self.inv_cell_width - 0.5;
        let start = cell_at(touched.0).floor() as i64;
        let end = (cell_at(touched.1).ceil() as i64 + 1).max(start);
        let inside_start = ((cell_at(inside.0) + 1e-9).ceil() as i64).clamp(start, end);
        let inside_end = ((cell_at(inside.1) - 1e-9).floor() as i64 + 1).clamp(inside_start, end);
        Span {
            row,
            touched: (start, end),
            inside: (inside_start, inside_end),
        }
    }
}

/// Fraction of a box inside the slab |s| <= 1/2, with s = `center` at the box's centre and `range` its change
/// over the box's width and height.
fn slab_fraction(range: DVec2, center: f64) -> f64 {
    let below = |bound: f64| fraction_below(range.abs() * 0.5, bound - center);
    below(0.5) - below(-0.5)
}

/// Fraction of the points (x, y) in [-1, 1]^2 with `e.x x + e.y y <= bound`, for `e >= 0`.
fn fraction_below(e: DVec2, bound: f64) -> f64 {
    let (long, short) = (e.max_element(), e.min_element());
    let total = long + short;
    if bound <= -total {
        0.0
    } else if bound >= total {
        1.0
    } else if bound < short - long {
        (bound + total).powi(2) / (8.0 * long * short)
    } else if bound <= long - short {
        0.5 + 0.5 * bound / long
    } else {
        1.0 - (total - bound).powi(2) / (8.0 * long * short)
    }
}

/// A convex polygon of at most eight corners: a parallelogram after four cuts.
pub(crate) struct Polygon {
    points: [DVec2; 8],
    len: usize,
}

impl Polygon {
    pub(crate) fn new(corners: &[DVec2; 4]) -> Self {
        let mut points = [DVec2::ZERO; 8];
        points[..4].copy_from_slice(corners);
        Self { points, len: 4 }
    }

    /// Keeps the part where the linear function `distance` is not negative (Sutherland and Hodgman 1974).
    pub(crate) fn clip(&mut self, distance: impl Fn(DVec2) -> f64) {
        let mut kept = Self {
            points: [DVec2::ZERO; 8],
            len: 0,
        };
        for i in 0..self.len {
            let (p, q) = (self.points[i], self.points[(i + 1) % self.len]);
            let (dp, dq) = (distance(p), distance(q));
            if dp >= 0.0 {
                kept.push(p);
            }
            if (dp >= 0.0) != (dq >= 0.0) {
                kept.push(p + (q - p) * (dp / (dp - dq)));
            }
        }
        *self = kept;
    }

    fn push(&mut self, p: DVec2) {
        // Rounding can split a corner in two; a ninth point would be one of those and has no area.
        if self.len < self.points.len() {
            self.points[self.len] = p;
            self.len += 1;
        }
    }

    /// The sides, each from one corner to the next.
    pub(crate) fn sides(&self) -> impl Iterator<Item = (DVec2, DVec2)> + use<'_> {
        (0..self.len).map(|i| (self.points[i], self.points[(i + 1) % self.len]))
    }

    fn area(&self) -> f64 {
        if self.len < 3 {
            return 0.0;
        }
        let origin = self.points[0];
        let double: f64 = (1..self.len - 1)
            .map(|i| (self.points[i] - origin).perp_dot(self.points[i + 1] - origin))
            .sum();
        0.5 * double.abs()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use proptest::prelude::*;

    /// Area of the box `[low, high]` inside the parallelogram, clipped the other way round: the box by the
    /// slabs.
    fn reference_overlap(region: &Parallelogram, low: DVec2, high: DVec2) -> f64 {
        let [a, b] = region.edges;
        let c = region.center;
        let corners = [low, DVec2::new(high.x, low.y), high, DVec2::new(low.x, high.y)];
        let mut polygon = Polygon::new(&corners.map(|p| p - c));
        let determinant = a.perp_dot(b);
        let s = |p: DVec2| p.perp_dot(b) / determinant;
        let t = |p: DVec2| a.perp_dot(p) / determinant;
        polygon.clip(|p| 0.5 - s(p));
        polygon.clip(|p| 0.5 + s(p));
        polygon.clip(|p| 0.5 - t(p));
        polygon.clip(|p| 0.5 + t(p));
        polygon.area()
    }

    fn vector(range: f64) -> impl Strategy<Value = DVec2> {
        (-range..range, -range..range).prop_map(|(x, y)| DVec2::new(x, y))
    }

    /// Total weight of all texels, from the parts.
    fn total_weight(footprint: &Footprint, (width, height): (u32, u32)) -> f64 {
        let mut sum = 0.0;
        footprint.for_each_part(|part| {
            sum += match part {
                Part::Texel { .. } => 1.0,
                Part::Whole(count) => count as f64 * f64::from(width) * f64::from(height),
                Part::Cut(region) => region
                    .texel_spans(width, height)
                    .flat_map(|span| {
                        (span.touched.0..span.touched.1).map(move |x| (x as u32, span.row as u32))
                    })
                    .map(|(x, y)| region.texel_overlap(x, y))
                    .sum(),
            }
        });
        sum / footprint.area()
    }

    proptest! {
        #[test]
        fn overlap_is_exact(
            c in vector(4.0), a in vector(6.0), b in vector(6.0), low in vector(8.0), extent in vector(3.0),
        ) {
            let region = Parallelogram::spanned(c, a, b).unwrap();
            let (low, high) = (low, low + extent.abs() + 0.01);
            let expected = reference_overlap(&region, low, high);
            prop_assert!((region.overlap(low, high) - expected).abs() < 1e-9 * (1.0 + expected));
        }

        #[test]
        fn coverage_agrees_with_overlap(
            c in vector(4.0), a in vector(6.0), b in vector(6.0), low in vector(8.0), side in 0.01..3.0_f64,
        ) {
            let region = Parallelogram::spanned(c, a, b).unwrap();
            let high = low + side;
            let overlap = reference_overlap(&region, low, high);
            match region.coverage(low, high) {
                Coverage::Outside => prop_assert!(overlap < 1e-9),
                Coverage::Inside => prop_assert!((overlap - side * side).abs() < 1e-9),
                Coverage::Cut => prop_assert!(overlap < side * side + 1e-9),
            }
        }

        #[test]
        fn spans_hold_exactly_the_touched_cells(c in vector(9.0), a in vector(6.0), b in vector(6.0)) {
            let region = Parallelogram::spanned(c, a, b).unwrap();
            for span in region.spans(DVec2::ONE) {
                for x in span.touched.0 - 3..span.touched.1 + 3 {
                    let low = DVec2::new(x as f64, span.row as f64);
                    let overlap = reference_overlap(&region, low, low + 1.0);
                    if !(span.touched.0..span.touched.1).contains(&x) {
                        prop_assert!(overlap < 1e-9);
                    }
                    if (span.inside.0..span.inside.1).contains(&x) {
                        prop_assert!((overlap - 1.0).abs() < 1e-9);
                    }
                }
            }
        }

        #[test]
        fn weights_sum_to_one(
            c in vector(50.0), a in vector(30.0), b in vector(30.0), scale in 0.0001..3.0,
            width in 1..40u32, height in 1..40u32,
        ) {
            let footprint = Footprint::in_texels(width, height, c, a * scale, b * scale);
            prop_assert!((total_weight(&footprint, (width, height)) - 1.0).abs() < 1e-6);
        }

        #[test]
        fn thin_footprints_have_weights_too(c in vector(50.0), a in vector(60.0), factor in -1.0..1.0) {
            for b in [DVec2::ZERO, a * factor, a] {
                let footprint = Footprint::in_texels(16, 24, c, a, b);
                prop_assert!((total_weight(&footprint, (16, 24)) - 1.0).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn zero_edges_are_the_texel_under_the_point() {
        let footprint = Footprint::new(8, 4, [-0.1, 1.3], [0.0; 2], [0.0; 2]);
        assert!(footprint.region().is_none());
        assert_eq!(footprint.texel(), (7, 1));
        assert_eq!(footprint.sample_texel([0.9, 0.1]), (7, 1));
    }

    #[test]
    fn invalid_differentials_count_as_zero() {
        let footprint = Footprint::new(8, 8, [0.5, f32::NAN], [f32::NAN, 0.0], [f32::INFINITY, 1.0]);
        assert!(footprint.region().is_none());
        assert_eq!(footprint.texel(), (4, 0));
    }

    #[test]
    fn whole_tiles_are_counted() {
        let size = 10;
        let footprint = Footprint::in_texels(
            size,
            size,
            DVec2::splat(5.0),
            DVec2::new(50.0, 0.0),
            DVec2::new(0.0, 50.0),
        );
        let mut whole = 0;
        footprint.for_each_part(|part| {
            if let Part::Whole(count) = part {
                whole += count;
            }
        });
        // Five tiles each way fit exactly; single precision may leave the outermost ones cut.
        assert!((9..=25).contains(&whole));
        assert_relative_eq!(total_weight(&footprint, (size, size)), 1.0, epsilon = 1e-6);
    }

    #[test]
    fn huge_footprints_are_bounded() {
        let footprint = Footprint::new(64, 64, [0.3, 0.3], [1e9, 1e7], [-1e8, 1e9]);
        let mut parts = 0;
        footprint.for_each_part(|_| parts += 1);
        assert!(parts < 4 * (2 * MAX_TILES as usize + 2));
        assert_relative_eq!(total_weight(&footprint, (64, 64)), 1.0, epsilon = 1e-6);
    }

    #[test]
    fn sampled_texels_follow_the_weights() {
        let footprint = Footprint::in_texels(
            4,
            4,
            DVec2::new(1.3, 3.9),
            DVec2::new(2.5, 0.7),
            DVec2::new(-0.4, 1.6),
        );
        const SIDE: usize = 1000;
        let mut counts = [[0.0_f64; 4]; 4];
        for i in 0..SIDE * SIDE {
            let u = [i % SIDE, i / SIDE].map(|k| (k as f64 + 0.5) / SIDE as f64);
            let (x, y) = footprint.sample_texel(u);
            counts[y as usize][x as usize] += 1.0 / (SIDE * SIDE) as f64;
        }
        let mut weights = [[0.0; 4]; 4];
        footprint.for_each_part(|part| {
            let Part::Cut(region) = part else { panic!() };
            for (y, row) in weights.iter_mut().enumerate() {
                for (x, weight) in row.iter_mut().enumerate() {
                    *weight += region.texel_overlap(x as u32, y as u32) / footprint.area();
                }
            }
        });
        for (count, weight) in counts.iter().flatten().zip(weights.iter().flatten()) {
            assert_relative_eq!(count, weight, epsilon = 2e-3);
        }
    }
}
