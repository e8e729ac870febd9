//! The Gaussian pixel footprint `G_P`, and which texels it reaches.
//!
//! Yan et al. 2014 and 2016 weight texels by a Gaussian instead of the pixel's box (after Heckbert 1989). Of
//! the footprint's parallelogram with centre `c` and edges `a`, `b` (texels, see [`crate::footprint`]) it has
//! the axes: `G_P = N(c, S_P)` with `S_P = deviation^2 (a a^T + b b^T)`. The published implementation has
//! `deviation = 1/2`, half a pixel; the box's own moments would ask for `1 / sqrt(12) = 0.29`.
//!
//! The map repeats. An ellipse of `G_P` is cut into tiles as the parallelogram is, and where the Gaussian is
//! so wide that its sum over all repetitions is constant, it covers the map evenly: [`Reach::Whole`].

use glam::DVec2;

use crate::error::{Error, Result};
use crate::footprint::Footprint;

/// Largest relative deviation from the mean at which a repeated Gaussian counts as constant.
const EVEN: f64 = 1e-3;

/// A Gaussian over the map's plane, in texels.
#[derive(Clone, Copy, Debug)]
pub struct GaussianFootprint {
    size: DVec2,
    center: DVec2,
    /// Half axes of one standard deviation; conjugate, not orthogonal.
    axes: [DVec2; 2],
}

/// A symmetric 2x2 matrix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Symmetric {
    pub xx: f64,
    pub xy: f64,
    pub yy: f64,
}

/// What a Gaussian covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reach {
    /// Texels near its centre.
    Local,
    /// All texels of the repeated map evenly.
    Whole,
}

/// Standard deviation of a Gaussian footprint in units of its edges, in [0.05, 4].
///
/// # Errors
/// A number outside of that, as parameter `footprint_sigma`.
pub fn checked_deviation(deviation: f32) -> Result<f64> {
    if (0.05..=4.0).contains(&deviation) {
        return Ok(deviation.into());
    }
    let reason = "must be a standard deviation in pixels in [0.05, 4]";
    Err(Error::parameter("footprint_sigma", deviation, reason))
}

impl Symmetric {
    pub fn determinant(&self) -> f64 {
        self.xx * self.yy - self.xy * self.xy
    }

    pub fn inverse(&self) -> Self {
        let d = self.determinant();
        Self {
            xx: self.yy / d,
            xy: -self.xy / d,
            yy: self.xx / d,
        }
    }

    /// Least `k^T M k` over integer vectors k other than zero, of a positive definite M: reduction of binary
    /// quadratic forms (Gauss 1801, Article 171).
    pub fn shortest(&self) -> f64 {
        let (mut a, mut b, mut c) = (self.xx, self.xy, self.yy);
        // Each round but the last at least halves c; rounding must not keep it going.
        for _ in 0..128 {
            if a > c {
                (a, c) = (c, a);
            }
            let m = (b / a).round();
            if m == 0.0 {
                break;
            }
            c += m * (m * a - 2.0 * b);
            b -= m * a;
        }
        a.min(c)
    }

    /// `v^T M v`.
    pub fn form(&self, v: DVec2) -> f64 {
        self.xx * v.x * v.x + 2.0 * self.xy * v.x * v.y + self.yy * v.y * v.y
    }
}

impl GaussianFootprint {
    /// `deviation`: standard deviation in units of the footprint's edges.
    pub fn new(footprint: &Footprint, deviation: f64) -> Self {
        Self {
            size: footprint.map_size(),
            center: footprint.center(),
            axes: footprint.edges().map(|edge| edge * deviation),
        }
    }

    /// Centre in texels, inside the map.
    pub fn center(&self) -> DVec2 {
        self.center
    }

    /// Columns and rows of the map.
    pub fn map_size(&self) -> DVec2 {
        self.size
    }

    /// Covariance in texels squared, of the Gaussian convolved with another one of variance `blur` per axis.
    pub fn covariance(&self, blur: f64) -> Symmetric {
        let [a, b] = self.axes;
        Symmetric {
            xx: a.x * a.x + b.x * b.x + blur,
            xy: a.x * a.y + b.x * b.y,
            yy: a.y * a.y + b.y * b.y + blur,
        }
    }

    /// A point of the Gaussian, in unwrapped texels, from two independent standard normal numbers.
    pub fn point(&self, normal: DVec2) -> DVec2 {
        self.center + normal.x * self.axes[0] + normal.y * self.axes[1]
    }

    /// Whether the Gaussian, convolved as in [`Self::covariance`] and summed over the repetitions of the map,
    /// is constant: its Fourier coefficients `2 exp(-2 pi^2 k^T Q k)`, with Q in periods, say so. The largest
    /// belongs to the shortest wave vector k; along a thin footprint that closes on itself it is a long one.
    pub fn reach(&self, blur: f64) -> Reach {
        let q = self.covariance(blur);
        let size = self.size;
        let in_periods = Symmetric {
            xx: q.xx / (size.x * size.x),
            xy: q.xy / (size.x * size.y),
            yy: q.yy / (size.y * size.y),
        };
        let largest = 2.0 * (-2.0 * std::f64::consts::PI.powi(2) * in_periods.shortest()).exp();
        if largest < EVEN {
            Reach::Whole
        } else {
            Reach::Local
        }
    }

    /// Calls `visit` with every square block of `side` texels that meets the ellipse `d^T Q^-1 d <= radius^2`,
    /// tile by tile: the block's column and row in the map, and its corner relative to the centre.
    pub fn for_each_block(
        &self,
        q: &Symmetric,
        radius: f64,
        side: f64,
        mut visit: impl FnMut(u32, u32, DVec2),
    ) {
        let extent = radius * DVec2::new(q.xx.sqrt(), q.yy.sqrt());
        let first = ((self.center - extent) / self.size).floor();
        let last = ((self.center + extent) / self.size).floor();
        for tile_y in first.y as i64..=last.y as i64 {
            for tile_x in first.x as i64..=last.x as i64 {
                let tile = DVec2::new(tile_x as f64, tile_y as f64) * self.size;
                self.for_each_block_of(tile - self.center, q, radius, side, &mut visit);
            }
        }
    }

    /// The blocks of one tile, whose corner lies at `origin` relative to the centre.
    fn for_each_block_of(
        &self,
        origin: DVec2,
        q: &Symmetric,
        radius: f64,
        side: f64,
        visit: &mut impl FnMut(u32, u32, DVec2),
    ) {
        let reach = radius * q.yy.sqrt();
        let (rows, columns) = ((self.size.y / side).ceil(), (self.size.x / side).ceil());
        let first = ((-reach - origin.y) / side).floor().max(0.0);
        let last = ((reach - origin.y) / side).ceil().min(rows);
        for row in first as u32..last.max(0.0) as u32 {
            let y = origin.y + f64::from(row) * side;
            let (left, right) = extent_within(q, radius, y, y + side);
            let start = ((left - origin.x) / side).floor().clamp(0.0, columns);
            let end = ((right - origin.x) / side).ceil().clamp(0.0, columns);
            for column in start as u32..end as u32 {
                visit(column, row, DVec2::new(origin.x + f64::from(column) * side, y));
            }
        }
    }
}

/// Least and greatest x of the ellipse `d^T Q^-1 d <= radius^2` where y is in `[low, high]`; left > right if
/// there is none.
fn extent_within(q: &Symmetric, radius: f64, low: f64, high: f64) -> (f64, f64) {
    // Along the row y, x is the regression Q_xy / Q_yy y plus or minus what is left of the radius.
    let deviation = (q.determinant() / q.yy).sqrt();
    let reach = radius * q.yy.sqrt();
    if low > reach || high < -reach {
        return (1.0, 0.0);
    }
    let half_width = |y: f64| deviation * (radius * radius - y * y / q.yy).max(0.0).sqrt();
    let regression = q.xy / q.yy;
    // The rightmost point of the whole ellipse lies at this y; the leftmost one opposite.
    let extreme = radius * q.xy / q.xx.sqrt();
    let right = extreme.clamp(low.max(-reach), high.min(reach));
    let left = (-extreme).clamp(low.max(-reach), high.min(reach));
    (
        regression * left - half_width(left),
        regression * right + half_width(right),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn blocks_hold_every_point_of_the_ellipse(
            cx in 0.0..60.0, cy in 0.0..44.0, ax in -30.0..30.0, ay in -30.0..30.0, bx in -9.0..9.0, by in -9.0..9.0,
            turn in 0.0..std::f64::consts::TAU, length in 0.0..1.0,
        ) {
            let (a, b) = (DVec2::new(ax, ay), DVec2::new(bx, by));
            let footprint = Footprint::in_texels(60, 44, DVec2::new(cx, cy), a, b);
            let gaussian = GaussianFootprint::new(&footprint, 0.5);
            let (blur, radius, side) = (0.2, 4.0, 16.0);
            let q = gaussian.covariance(blur);
            // A point of the ellipse: the image of the unit disk under a square root of Q.
            let root = DVec2::new(q.xx.sqrt(), q.xy / q.xx.sqrt());
            let rest = (q.yy - root.y * root.y).sqrt();
            let unit: DVec2 = DVec2::from_angle(turn) * length * (radius - 1e-9);
            let offset = DVec2::new(root.x * unit.x, root.y * unit.x + rest * unit.y);
            let point = (gaussian.center() + offset).rem_euclid(DVec2::new(60.0, 44.0));
            let mut found = 0;
            gaussian.for_each_block(&q, radius, side, |column, row, corner| {
                let inside = (offset - corner).cmpge(DVec2::ZERO).all() && (offset - corner).cmplt(DVec2::splat(side)).all();
                let same = (f64::from(column), f64::from(row)) == ((point.x / side).floor(), (point.y / side).floor());
                found += usize::from(inside && same);
            });
            prop_assert_eq!(found, 1);
        }
    }

    proptest! {
        #[test]
        fn the_shortest_wave_is_found(
            length in 0.05..3.0, ratio in 0.02..1.0, turn in 0.0..std::f64::consts::PI,
        ) {
            let a: DVec2 = DVec2::from_angle(turn) * length;
            let b: DVec2 = a.perp() * ratio;
            let m = Symmetric {
                xx: a.x * a.x + b.x * b.x,
                xy: a.x * a.y + b.x * b.y,
                yy: a.y * a.y + b.y * b.y,
            };
            let naive = (-60..=60)
                .flat_map(|x| (-60..=60).map(move |y| DVec2::new(f64::from(x), f64::from(y))))
                .filter(|k| *k != DVec2::ZERO)
                .map(|k| m.form(k))
                .fold(f64::INFINITY, f64::min);
            prop_assert!((m.shortest() - naive).abs() <= 1e-9 * naive, "{} {naive}", m.shortest());
        }
    }

    #[test]
    fn a_thin_footprint_that_closes_on_itself_does_not_cover_the_map() {
        // Three periods along (1, 2): a closed line on the torus, which most waves cancel on.
        let a = DVec2::new(1.0, 2.0).normalize() * 3.0 * 2048.0;
        let footprint = Footprint::in_texels(2048, 2048, DVec2::splat(20.0), a, a.perp() / 300.0);
        assert_eq!(GaussianFootprint::new(&footprint, 0.5).reach(0.2), Reach::Local);
    }

    #[test]
    fn blocks_are_not_visited_without_need() {
        // A thin ellipse along the diagonal of 64 x 64 blocks meets about two blocks a row.
        let footprint =
            Footprint::in_texels(1024, 1024, DVec2::splat(512.0), DVec2::splat(100.0), DVec2::ZERO);
        let gaussian = GaussianFootprint::new(&footprint, 0.5);
        let mut count = 0;
        gaussian.for_each_block(&gaussian.covariance(0.2), 4.0, 16.0, |_, _, _| count += 1);
        let rows = 2 * 200 / 16 + 1;
        assert!((rows..4 * rows).contains(&count), "{count} blocks in {rows} rows");
    }

    #[test]
    fn wide_gaussians_cover_the_map_evenly() {
        let reach = |width: f64| {
            let a = DVec2::new(width, 0.0);
            let footprint = Footprint::in_texels(64, 64, DVec2::splat(20.0), a, a.perp());
            GaussianFootprint::new(&footprint, 0.5).reach(0.2)
        };
        assert_eq!(reach(64.0), Reach::Local);
        assert_eq!(reach(96.0), Reach::Whole);
    }
}
