//! From a pixel's footprint to a blend of images.
//!
//! **Level** The Gaussian of a footprint (half a pixel of standard deviation along each axis, [`crate::gaussian_footprint`]) is
//! approximated by round ones. Trilinear interpolation widens what images hold: a blend of four nodes a spacing `s` apart has, on
//! average over positions, `s^2 / 6` more variance along each axis than its images. So the level is chosen by what a blend has,
//! `sigma_l^2 + s_l^2 / 6` ([`effective`]), 1.37 times the deviation of the images: the level that the published choice
//! takes would blur footprints by as much.
//!
//! **Elongated footprints** of standard deviations `a > b` are the sum of up to four taps along their major axis. Between
//! a / b = 1 and sqrt(2) two taps move apart; up to sqrt(6) each divides into two; all moves are continuous, and the taps'
//! variance with their distances is `a^2`. Beyond sqrt(6), at grazing angles, taps are `a / sqrt(6)` wide and blur the minor axis.
//!
//! **Ends** Below the deviation of level 0 the exact method takes over, linearly, and entirely at half of it. Above
//! the last level there is the last level.

use arrayvec::ArrayVec;
use glam::DVec2;
use wide::f64x4;

use super::images::Blend;
use super::pyramid::{Geometry, Level};
use crate::footprint::Footprint;
use crate::gaussian_footprint::GaussianFootprint;

/// Largest ratio of the axes that taps make up for: four of them at -3, -1, 1 and 3 deviations.
const LARGEST_RATIO2: f64 = 6.0;

/// What answers for a footprint.
pub struct Selection {
    /// Images with weights that sum to one.
    pub images: Blend,
    /// The exact method's share of the answer.
    pub exact: f32,
}

/// Standard deviation of what level 0 gives for a footprint, in texels: the images' own with that of interpolation.
pub fn effective(geometry: &Geometry) -> f64 {
    let stride = f64::from(geometry.stride);
    (geometry.levels[0].sigma.powi(2) + stride * stride / 6.0).sqrt()
}

/// `deviation`: of the Gaussian, in pixels.
pub fn select(geometry: &Geometry, footprint: &Footprint, deviation: f64) -> Selection {
    let finest = effective(geometry);
    let taps = Taps::new(&GaussianFootprint::new(footprint, deviation));
    let exact = ((finest - taps.sigma) / (0.5 * finest)).clamp(0.0, 1.0) as f32;
    let mut selection = Selection {
        images: Blend::new(),
        exact,
    };
    if exact < 1.0 {
        taps.blend(geometry, footprint.center(), &mut selection.images);
    }
    selection
}

/// The nodes about the first `count` of four positions with their weights, times `share`. Those of one position are all different.
#[inline]
fn add_nodes(level: &Level, positions: [f64x4; 2], count: usize, share: f64, images: &mut Blend) {
    if level.images() == 1 {
        images.push((level.image(0, 0), (count as f64 * share) as f32));
        return;
    }
    let [columns, rows] = [0, 1].map(|axis| level.axes[axis].neighbours(positions[axis]));
    // Of this level; none is another's.
    let start = images.len();
    for tap in 0..count {
        for (row, y) in &rows {
            for (column, x) in &columns {
                let weight = (share * x[tap] * y[tap]) as f32;
                if weight <= 0.0 {
                    continue;
                }
                let image = level.image(column[tap], row[tap]);
                let known = if tap == 0 { &mut [] } else { &mut images[start..] };
                match known.iter_mut().find(|(i, _)| *i == image) {
                    Some((_, sum)) => *sum += weight,
                    None => images.push((image, weight)),
                }
            }
        }
    }
}

/// Round Gaussians of equal weight.
struct Taps {
    sigma: f64,
    offsets: ArrayVec<DVec2, 4>,
}

impl Taps {
    /// The images of the taps about `center`, of the two levels about their size; weights sum to one.
    #[inline]
    fn blend(&self, geometry: &Geometry, center: DVec2, images: &mut Blend) {
        let last = (geometry.levels.len() - 1) as f64;
        let position = (self.sigma / effective(geometry)).log2().clamp(0.0, last);
        let (level, fraction) = (position.floor(), position - position.floor());
        let count = self.offsets.len();
        let weight = 1.0 / count as f64;
        let offset = |tap: usize| self.offsets.get(tap).copied().unwrap_or_default();
        let offsets: [DVec2; 4] = std::array::from_fn(offset);
        let positions = [0, 1].map(|axis| f64x4::from(offsets.map(|offset| center[axis] + offset[axis])));
        for (index, share) in [(level, 1.0 - fraction), (level + 1.0, fraction)] {
            if share > 0.0 {
                let level = &geometry.levels[index as usize];
                add_nodes(level, positions, count, weight * share, images);
            }
        }
    }

    fn new(gaussian: &GaussianFootprint) -> Self {
        let q = gaussian.covariance(0.0);
        let (mean, difference) = (0.5 * (q.xx + q.yy), 0.5 * (q.xx - q.yy));
        let root = (difference * difference + q.xy * q.xy).sqrt();
        let (major, minor) = (mean + root, (mean - root).max(0.0));
        let variance = minor.max(major / LARGEST_RATIO2);
        if variance <= 0.0 {
            return Self {
                sigma: 0.0,
                offsets: [DVec2::ZERO].into_iter().collect(),
            };
        }
        let sigma = variance.sqrt();
        // The major axis: of the two rows of the covariance less its smaller eigenvalue, the longer one.
        let (x, y) = (
            DVec2::new(difference + root, q.xy),
            DVec2::new(q.xy, root - difference),
        );
        let axis = if difference >= 0.0 { x } else { y }.normalize_or(DVec2::X) * sigma;
        // Variance that the taps' distances make up for: d1^2 + d2^2 of taps at +-d1 +-d2.
        let excess = major / variance - 1.0;
        let d2 = ((excess - 1.0).max(0.0) / (LARGEST_RATIO2 - 2.0)).min(1.0);
        let (d1, d2) = ((excess - d2).max(0.0).sqrt(), d2.sqrt());
        let offsets = if d1 == 0.0 {
            [DVec2::ZERO].into_iter().collect()
        } else if d2 == 0.0 {
            [-d1, d1].into_iter().map(|d| d * axis).collect()
        } else {
            [-d1 - d2, -d1 + d2, d1 - d2, d1 + d2]
                .into_iter()
                .map(|d| d * axis)
                .collect()
        };
        Self { sigma, offsets }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn footprint(a: DVec2, b: DVec2) -> Footprint {
        Footprint::in_texels(2048, 2048, DVec2::splat(777.0), a, b)
    }

    proptest! {
        #[test]
        fn taps_have_the_footprints_covariance(ax in -90.0..90.0, ay in -90.0..90.0, ratio in 1.0..2.44) {
            let a = DVec2::new(ax, ay);
            prop_assume!(a.length() > 1.0);
            let footprint = footprint(a, a.perp() / ratio);
            let gaussian = GaussianFootprint::new(&footprint, 0.5);
            let q = gaussian.covariance(0.0);
            let taps = Taps::new(&gaussian);
            let count = taps.offsets.len() as f64;
            let moment = |f: &dyn Fn(DVec2) -> f64| taps.offsets.iter().map(|d| f(*d)).sum::<f64>() / count;
            let variance = taps.sigma * taps.sigma;
            let scale = q.xx.max(q.yy);
            prop_assert!((moment(&|d| d.x * d.x) + variance - q.xx).abs() < 1e-6 * scale);
            prop_assert!((moment(&|d| d.y * d.y) + variance - q.yy).abs() < 1e-6 * scale);
            prop_assert!((moment(&|d| d.x * d.y) - q.xy).abs() < 1e-6 * scale);
        }

        #[test]
        fn weights_sum_to_one(ax in -3000.0..3000.0, ay in -900.0..900.0, bx in -90.0..90.0, by in -90.0..90.0) {
            let geometry = Geometry::new((2048, 600), 256, 32);
            let footprint = Footprint::in_texels(2048, 600, DVec2::new(9.0, 599.0), DVec2::new(ax, ay), DVec2::new(bx, by));
            let selection = select(&geometry, &footprint, 0.5);
            let sum: f32 = selection.images.iter().map(|(_, weight)| weight).sum();
            let expected = if selection.exact < 1.0 { 1.0 } else { 0.0 };
            prop_assert!((sum - expected).abs() < 1e-5);
        }
    }

    #[test]
    fn the_exact_method_fades_in_between_half_and_all_of_the_finest_deviation() {
        let geometry = Geometry::new((2048, 2048), 256, 32);
        let finest = effective(&geometry);
        let share = |sigma: f64| {
            let edge = 2.0 * sigma * DVec2::X;
            select(&geometry, &footprint(edge, edge.perp()), 0.5).exact
        };
        assert_eq!(share(0.0), 1.0);
        assert_eq!(share(0.49 * finest), 1.0);
        assert!((share(0.75 * finest) - 0.5).abs() < 1e-4);
        assert_eq!(share(1.01 * finest), 0.0);
        assert_eq!(share(1e4), 0.0);
    }
}
