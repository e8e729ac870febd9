//! Bins as regions of the hemisphere: their solid angles, and uniform directions inside them.
//!
//! Both grids are square, `b x b` cells over `[-1, 1]^2`, and numbered as in [`super::bins`].
//!
//! *Projected* (2021, Section 5.2): the square around the disk of projected normals `(h.x, h.y)`. A cell's
//! solid angle is `integral of dx dy / sqrt(1 - x^2 - y^2)` over its part inside the disk and grows as `1 / cos
//! theta`. With `S(x, y)` the solid angle over `[0, x] x [0, y]`,
//!
//! ```text
//! S(x, y) = x asin(y / sqrt(1 - x^2)) + y asin(x / sqrt(1 - y^2)) - atan(x y / sqrt(1 - x^2 - y^2))
//!         = pi / 2 (x + y - 1)    where x^2 + y^2 >= 1
//! ```
//!
//! (a point with both coordinates larger would lie outside the disk), odd in both arguments, a cell has the sum
//! of S over its corners with alternating signs. The projected solid angle, an area, has the same form.
//!
//! *Equal solid angle* (2020): the square is mapped to the disk by the concentric map (Shirley and Chiu 1997) and
//! the disk to the hemisphere by Lambert's projection, `h = (p sqrt(2 - |p|^2), 1 - |p|^2)`. Both keep areas, so
//! every cell has the solid angle `2 pi / b^2`, and none is cut by the rim.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, TAU};

use glam::{DVec2, Vec2, Vec3};

use super::bins::{Bin, BinGrid, pack};
use crate::error::Result;

/// How the hemisphere is cut into bins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Binning {
    /// Squares on the projected hemisphere.
    Projected,
    /// Cells of one solid angle.
    #[default]
    EqualSolidAngle,
}

/// Solid angle below which a cell counts as empty: the sliver of one that a rounded normal fell into.
const SMALLEST_SOLID_ANGLE: f64 = 1e-12;

/// `b x b` cells of the hemisphere.
#[derive(Clone, Copy, Debug)]
pub struct Cells {
    binning: Binning,
    grid: BinGrid,
}

impl Cells {
    /// `resolution` cells per side, in `[1, 16384]`.
    pub fn new(binning: Binning, resolution: u32) -> Result<Self> {
        Ok(Self {
            binning,
            grid: BinGrid::new(resolution)?,
        })
    }

    pub fn binning(&self) -> Binning {
        self.binning
    }

    /// Cells per side.
    pub fn resolution(&self) -> u32 {
        self.grid.resolution()
    }

    /// The cell of a unit vector with `m.z >= 0`.
    #[inline]
    pub fn bin(&self, m: Vec3) -> Bin {
        match self.binning {
            Binning::Projected => self.grid.bin(m),
            Binning::EqualSolidAngle => self
                .grid
                .bin(square_of_disk(m.truncate() / (1.0 + m.z).sqrt()).extend(0.0)),
        }
    }

    pub(super) fn packed_bin(&self, m: Vec3) -> u32 {
        pack(self.bin(m))
    }

    /// Solid angle of a cell; zero for one without (practically) a part of the hemisphere.
    pub fn solid_angle(&self, bin: Bin) -> f64 {
        match self.binning {
            Binning::Projected => {
                let angle = over_corners(self.corners(bin), solid_angle_from_pole);
                if angle < SMALLEST_SOLID_ANGLE { 0.0 } else { angle }
            }
            Binning::EqualSolidAngle => TAU / f64::from(self.resolution()).powi(2),
        }
    }

    /// The integral of `h . n` over a cell.
    pub fn projected_solid_angle(&self, bin: Bin) -> f64 {
        let (low, high) = self.corners(bin);
        match self.binning {
            Binning::Projected => over_corners((low, high), area_from_pole),
            Binning::EqualSolidAngle => self.solid_angle(bin) * (1.0 - mean_squared_radius(low, high)),
        }
    }

    /// A direction uniformly distributed over the solid angle of a cell; `None` if it is empty.
    pub fn sample(&self, bin: Bin, u: [f32; 2]) -> Option<Vec3> {
        let u = DVec2::new(u[0].into(), u[1].into());
        let (low, high) = self.corners(bin);
        let (on_disk, z2) = match self.binning {
            Binning::Projected => {
                if self.solid_angle(bin) == 0.0 {
                    return None;
                }
                let p = uniform_on_sphere(low, high, u);
                (p, 1.0 - p.length_squared())
            }
            Binning::EqualSolidAngle => {
                let p = disk_of_square(low + (high - low) * u);
                let r2 = p.length_squared();
                (p * (2.0 - r2).sqrt(), (1.0 - r2).powi(2))
            }
        };
        (z2 > 0.0).then(|| on_disk.extend(z2.sqrt()).as_vec3().normalize())
    }

    /// The cell's corners on the square.
    fn corners(&self, (column, row): Bin) -> (DVec2, DVec2) {
        let width = self.grid.width();
        let corner = |x: u32, y: u32| DVec2::new(x.into(), y.into()) * width - 1.0;
        (corner(column, row), corner(column + 1, row + 1))
    }
}

// ---- squares on the projected hemisphere ------------------------------------------------------------------

/// The part between two corners of a quantity that is given over `[0, x] x [0, y]`, odd in x and y.
fn over_corners((low, high): (DVec2, DVec2), from_pole: impl Fn(f64, f64) -> f64) -> f64 {
    let odd = |x: f64, y: f64| from_pole(x.abs().min(1.0), y.abs().min(1.0)) * x.signum() * y.signum();
    odd(high.x, high.y) - odd(low.x, high.y) - odd(high.x, low.y) + odd(low.x, low.y)
}

/// `S(x, y)` for x and y in `[0, 1]`.
fn solid_angle_from_pole(x: f64, y: f64) -> f64 {
    let z2 = 1.0 - x * x - y * y;
    if z2 <= 0.0 {
        return FRAC_PI_2 * (x + y - 1.0);
    }
    // asin(y / sqrt(1 - x^2)) = atan2(y, z), which keeps its precision near the rim.
    let z = z2.sqrt();
    x * y.atan2(z) + y * x.atan2(z) - (x * y).atan2(z)
}

/// Area of `[0, x] x [0, y]` inside the unit disk, for x and y in `[0, 1]`.
fn area_from_pole(x: f64, y: f64) -> f64 {
    if x * x + y * y <= 1.0 {
        return x * y;
    }
    let strip = |x: f64| 0.5 * (x * (1.0 - x * x).max(0.0).sqrt() + x.asin());
    strip(x) + strip(y) - FRAC_PI_4
}

/// A point of the projected hemisphere, uniform by solid angle inside a box that is not empty: x from its
/// marginal distribution by Newton's method inside a shrinking bracket, then y in closed form.
fn uniform_on_sphere(low: DVec2, high: DVec2, u: DVec2) -> DVec2 {
    // The arcs `asin(y / sqrt(1 - x^2))` that the box cuts out of the half circle at x.
    let arc = |x: f64, y: f64| {
        let z2 = 1.0 - x * x - y * y;
        if z2 > 0.0 {
            y.atan2(z2.sqrt())
        } else {
            FRAC_PI_2 * y.signum()
        }
    };
    let density = |x: f64| arc(x, high.y) - arc(x, low.y);
    let mass = |x: f64| over_corners((low, DVec2::new(x, high.y)), solid_angle_from_pole);
    let wanted = u.x * mass(high.x);
    let (mut below, mut above) = (low.x, high.x);
    let mut x = low.x + u.x * (high.x - low.x);
    for _ in 0..60 {
        let excess = mass(x) - wanted;
        if excess > 0.0 {
            above = x
        } else {
            below = x
        }
        let step = x - excess / density(x);
        let next = if step > below && step < above {
            step
        } else {
            0.5 * (below + above)
        };
        let moved = (next - x).abs();
        x = next;
        if moved < 1e-9 * (high.x - low.x) {
            break;
        }
    }
    let angle = arc(x, low.y) + u.y * density(x);
    DVec2::new(x, (1.0 - x * x).max(0.0).sqrt() * angle.sin())
}

// ---- cells of one solid angle -----------------------------------------------------------------------------

/// The concentric map from the square to the disk; circles come from squares, `|p| = max(|s.x|, |s.y|)`.
fn disk_of_square(s: DVec2) -> DVec2 {
    if s.x.abs() >= s.y.abs() {
        if s.x == 0.0 {
            return DVec2::ZERO;
        }
        DVec2::from_angle(FRAC_PI_4 * s.y / s.x) * s.x
    } else {
        let (sin, cos) = (FRAC_PI_4 * s.x / s.y).sin_cos();
        DVec2::new(sin, cos) * s.y
    }
}

/// Inverse of [`disk_of_square`].
#[inline]
fn square_of_disk(p: Vec2) -> Vec2 {
    const PER_EIGHTH: f32 = 4.0 / std::f32::consts::PI;
    let radius = p.length();
    if p.x.abs() >= p.y.abs() {
        if p.x == 0.0 {
            return Vec2::ZERO;
        }
        let side = radius.copysign(p.x);
        Vec2::new(side, side * PER_EIGHTH * (p.y / p.x).atan())
    } else {
        let side = radius.copysign(p.y);
        Vec2::new(side * PER_EIGHTH * (p.x / p.y).atan(), side)
    }
}

/// Mean of `max(x^2, y^2)` over a cell of the grid. The ranges of |x| and |y| are disjoint but for their ends,
/// and then the larger one decides, or, on a diagonal, the same.
fn mean_squared_radius(low: DVec2, high: DVec2) -> f64 {
    let range = |low: f64, high: f64| {
        let (a, b) = (low.abs().min(high.abs()), low.abs().max(high.abs()));
        // A cell around an axis: |x| is uniform from 0 on.
        if low * high < 0.0 { (0.0, b) } else { (a, b) }
    };
    let ((x0, x1), (y0, y1)) = (range(low.x, high.x), range(low.y, high.y));
    if (x1 - y1).abs() > 1e-9 {
        let (a, b) = if x1 > y1 { (x0, x1) } else { (y0, y1) };
        return (a * a + a * b + b * b) / 3.0;
    }
    // The larger of two uniform numbers has the density 2 t on [0, 1].
    let width = x1 - x0;
    x0 * x0 + x0 * width * (4.0 / 3.0) + 0.5 * width * width
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    const BINNINGS: [Binning; 2] = [Binning::Projected, Binning::EqualSolidAngle];

    fn bins(side: u32) -> impl Iterator<Item = Bin> {
        (0..side * side).map(move |i| (i % side, i / side))
    }

    #[test]
    fn cells_cover_the_hemisphere() {
        for binning in BINNINGS {
            for side in [1, 2, 5, 16, 127] {
                let cells = Cells::new(binning, side).unwrap();
                let angle: f64 = bins(side).map(|bin| cells.solid_angle(bin)).sum();
                let projected: f64 = bins(side).map(|bin| cells.projected_solid_angle(bin)).sum();
                assert_relative_eq!(angle, TAU, max_relative = 1e-9);
                assert_relative_eq!(projected, std::f64::consts::PI, max_relative = 1e-9);
            }
        }
    }

    /// Solid angles and projected solid angles by counting directions uniform over the hemisphere.
    #[test]
    fn solid_angles_are_those_of_the_binning_function() {
        const SIDE: u32 = 6;
        const STEPS: u32 = 1200;
        for binning in BINNINGS {
            let cells = Cells::new(binning, SIDE).unwrap();
            let mut found = vec![[0.0; 2]; (SIDE * SIDE) as usize];
            let share = TAU / f64::from(STEPS).powi(2);
            for i in 0..STEPS * STEPS {
                let z = (f64::from(i / STEPS) + 0.5) / f64::from(STEPS);
                let phi = TAU * (f64::from(i % STEPS) + 0.5) / f64::from(STEPS);
                let xy = DVec2::from_angle(phi) * (1.0 - z * z).sqrt();
                let (column, row) = cells.bin(xy.extend(z).as_vec3());
                let [angle, projected] = &mut found[(row * SIDE + column) as usize];
                *angle += share;
                *projected += share * z;
            }
            for (bin, [angle, projected]) in bins(SIDE).zip(found) {
                // A border of the cell's length, one step wide.
                let epsilon = 20.0 * share.sqrt() / f64::from(STEPS).sqrt();
                assert_relative_eq!(cells.solid_angle(bin), angle, epsilon = epsilon);
                assert_relative_eq!(cells.projected_solid_angle(bin), projected, epsilon = epsilon);
            }
        }
    }

    #[test]
    fn samples_stay_in_their_cell_and_are_uniform() {
        const FINE: u32 = 4;
        const COUNT: u32 = 40_000;
        for binning in BINNINGS {
            for side in [1, 3, 8, 50] {
                let cells = Cells::new(binning, side).unwrap();
                let fine = Cells::new(binning, FINE * side).unwrap();
                // A corner that may lie outside, cells at the rim, around the axes and on the diagonal.
                for bin in [
                    (0, 0),
                    (side / 8, side / 8),
                    (0, side / 2),
                    (side / 2, side / 2),
                    (side / 3, side / 6),
                ] {
                    let angle = cells.solid_angle(bin);
                    let mut counts = [0.0; (FINE * FINE) as usize];
                    let mut strays = 0;
                    for i in 0..COUNT {
                        // A rank-1 lattice.
                        let u =
                            [0.754_877_7, 0.569_840_3].map(|g: f64| (0.5 + g * f64::from(i)).fract() as f32);
                        let Some(m) = cells.sample(bin, u) else {
                            assert_eq!(angle, 0.0);
                            continue;
                        };
                        let (x, y) = fine.bin(m);
                        let place = (x.wrapping_sub(FINE * bin.0), y.wrapping_sub(FINE * bin.1));
                        if place.0 < FINE && place.1 < FINE {
                            counts[(place.1 * FINE + place.0) as usize] += 1.0;
                        } else {
                            strays += 1; // rounding at the border
                        }
                    }
                    assert!(strays < 10, "{binning:?} {side} {bin:?}: {strays}");
                    for (i, count) in counts.into_iter().enumerate().filter(|_| angle > 0.0) {
                        let place = (FINE * bin.0 + i as u32 % FINE, FINE * bin.1 + i as u32 / FINE);
                        let expected = f64::from(COUNT) * fine.solid_angle(place) / angle;
                        // A lattice is far more even than random points.
                        assert!(
                            (count - expected).abs() < 30.0,
                            "{binning:?} {side} {bin:?}: {count} {expected}"
                        );
                    }
                }
            }
        }
    }
}
