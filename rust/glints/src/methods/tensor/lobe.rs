//! Lobes of texels, averaged over the pixels of an image of the distribution of normals.
//!
//! An image is read with bilinear interpolation between the centres of its pixels. Pixel average and interpolation
//! together blur what the image holds, by a variance of 1/12 + 1/6 = 1/4 of a squared pixel along each axis. A lobe gives
//! that up beforehand: it is drawn in towards its normal by the ratio of the standard deviations, radially and
//! tangentially, so that what is read has the lobe's own width again (as far as the lobe is wider than a pixel's blur:
//! [`LEAST_VARIANCE`]).

use glam::{Vec2, Vec3};
use wide::{CmpGt, CmpLt, f32x8};

use super::BLOCK;
use crate::microfacet::{Distribution, Flake};

/// Variance that pixel average and interpolation add, in squared pixels.
const BLUR: f32 = 0.25;

/// Least variance of a lobe in an image, in squared pixels: what is narrower lies in one pixel.
const LEAST_VARIANCE: f32 = 0.02;

/// A Beckmann lobe ends where its exponent is this large, 1e-4 of its energy beyond.
const LARGEST_EXPONENT: f32 = 9.0;

/// A GGX lobe ends at this many roughnesses, 0.25 % of its energy beyond; images are normalised, which puts it back.
const LARGEST_TANGENT: f32 = 20.0;

/// Points of a pixel average are at most this many standard deviations of the lobe apart.
const SPACING: f32 = 0.75;

/// Most points of a pixel average along an axis.
const MOST_POINTS: f32 = 8.0;

/// Lobes of one kind of flake in images of one resolution.
#[derive(Clone, Copy, Debug)]
pub struct Lobes {
    kind: Distribution,
    inv_alpha2: f32,
    /// Of the slopes, in the disk's units: `alpha^2 / 2`. GGX has none; its core is as wide.
    variance: f32,
    /// Largest squared tangent.
    max_tan2: f32,
    /// Largest distance of a point of a lobe from its normal in the disk.
    reach: f32,
    /// Side of a pixel.
    pixel: f32,
}

/// One block of one lobe.
pub struct Stamp {
    /// Density per projected area of every pixel of the block, row by row.
    pub pixels: [f32; BLOCK * BLOCK],
    /// Rows that the lobe touches, half open, and whether it touches the left and right halves of the columns.
    pub rows: (usize, usize),
    pub halves: [bool; 2],
}

impl Default for Stamp {
    fn default() -> Self {
        Self {
            pixels: [0.0; BLOCK * BLOCK],
            rows: (0, 0),
            halves: [false; 2],
        }
    }
}

impl Lobes {
    /// `resolution`: pixels per side of an image.
    pub fn new(flake: &Flake, resolution: u32) -> Self {
        let alpha2 = flake.alpha().powi(2);
        let max_tan2 = match flake.kind() {
            Distribution::Beckmann => LARGEST_EXPONENT * alpha2,
            Distribution::Ggx => LARGEST_TANGENT.powi(2) * alpha2,
        };
        Self {
            kind: flake.kind(),
            inv_alpha2: 1.0 / alpha2,
            variance: 0.5 * alpha2,
            max_tan2,
            reach: (max_tan2 / (1.0 + max_tan2)).sqrt(),
            pixel: 2.0 / resolution as f32,
        }
    }

    /// Largest distance of a point of a lobe from its normal in the disk.
    pub fn reach(&self) -> f32 {
        self.reach
    }

    /// Whether the lobe about `t` may touch the block whose corner of least x and y is `low`.
    #[inline]
    pub fn touches(&self, t: Vec3, low: Vec2) -> bool {
        let side = self.pixel * BLOCK as f32;
        let reach = self.reach + self.pixel;
        t.x > low.x - reach && t.x < low.x + side + reach && t.y > low.y - reach && t.y < low.y + side + reach
    }

    /// What the lobe about `t` leaves in the block at `low`, as a density per projected area; false if nothing.
    pub fn stamp(&self, t: Vec3, low: Vec2, stamp: &mut Stamp) -> bool {
        let pixel_of = |x: f32| (x / self.pixel).floor().clamp(-1.0, BLOCK as f32) as i32;
        let range = |center: f32, low: f32| {
            let first = pixel_of(center - self.reach - low).max(0);
            let last = pixel_of(center + self.reach - low).min(BLOCK as i32 - 1);
            (first as usize, (last + 1) as usize)
        };
        let ((x0, x1), (y0, y1)) = (range(t.x, low.x), range(t.y, low.y));
        stamp.rows = (y0, y1);
        stamp.halves = [x0 < 8 && x1 > x0, x1 > 8 && x1 > x0];
        if y0 >= y1 || x0 >= x1 {
            return false;
        }
        stamp.pixels[y0 * BLOCK..y1 * BLOCK].fill(0.0);

        let shape = Shape::new(self, t);
        let points = (self.pixel / (SPACING * shape.least_deviation))
            .ceil()
            .clamp(1.0, MOST_POINTS);
        let step = self.pixel / points;
        let lanes = f32x8::from([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]) * f32x8::splat(self.pixel);
        let scale = f32x8::splat(shape.height / (points * points));
        for row in y0..y1 {
            for half in (0..2).filter(|&half| stamp.halves[half]) {
                let mut sum = f32x8::ZERO;
                let first = low.x + self.pixel * (8 * half) as f32;
                for j in 0..points as u32 {
                    let y = low.y + self.pixel * row as f32 + (j as f32 + 0.5) * step;
                    for i in 0..points as u32 {
                        let x = lanes + f32x8::splat(first + (i as f32 + 0.5) * step - t.x);
                        sum += self.density(&shape, x, y - t.y);
                    }
                }
                let pixels: [f32; 8] = (sum * scale).to_array();
                stamp.pixels[row * BLOCK + 8 * half..][..8].copy_from_slice(&pixels);
            }
        }
        true
    }

    /// The lobe at offsets `x`, `y` from its normal in the disk, without its height.
    #[inline]
    fn density(&self, shape: &Shape, x: f32x8, y: f32) -> f32x8 {
        let one = f32x8::ONE;
        // The offset, stretched along and across the tilt.
        let [xx, xy, yy] = shape.stretch;
        let dx = x * xx + f32x8::splat(y * xy);
        let dy = x * xy + f32x8::splat(y * yy);
        let (px, py) = (dx + shape.normal.x, dy + shape.normal.y);
        let pz2 = one - px * px - py * py;
        let dz = pz2.max(f32x8::ZERO).sqrt() - f32x8::splat(shape.normal.z);
        let chord2 = dx * dx + dy * dy + dz * dz;
        let cos = one - chord2 * 0.5;
        let cos2 = cos * cos;
        let sin2 = chord2 * (one - chord2 * 0.25);
        let inside = pz2.cmp_gt(f32x8::ZERO) & cos.cmp_gt(f32x8::splat(1e-3));
        let tan2 = sin2 / cos2.max(f32x8::splat(1e-6));
        let inside = inside & tan2.cmp_lt(f32x8::splat(self.max_tan2));
        let value = match self.kind {
            Distribution::Beckmann => (tan2 * -self.inv_alpha2).exp() / (cos2 * cos2),
            Distribution::Ggx => {
                let form = cos2 + sin2 * self.inv_alpha2;
                one / (form * form)
            }
        };
        inside.blend(value, f32x8::ZERO)
    }
}

/// One lobe as an image holds it.
struct Shape {
    normal: Vec3,
    /// From offsets in the image to those of the true lobe: a symmetric matrix.
    stretch: [f32; 3],
    height: f32,
    /// Smaller standard deviation in the image.
    least_deviation: f32,
}

impl Shape {
    fn new(lobes: &Lobes, t: Vec3) -> Self {
        let pixel2 = lobes.pixel * lobes.pixel;
        let drawn_in = |variance: f32| {
            let least = variance.min(LEAST_VARIANCE * pixel2);
            (variance - BLUR * pixel2).max(least)
        };
        // The disk foreshortens the lobe along its tilt.
        let variances = [lobes.variance * t.z * t.z, lobes.variance];
        let [radial, tangential] = variances.map(drawn_in);
        let [along, across] = [radial / variances[0], tangential / variances[1]].map(|r| 1.0 / r.sqrt());
        let e = t.truncate().normalize_or(Vec2::X);
        let stretch = [
            along * e.x * e.x + across * e.y * e.y,
            (along - across) * e.x * e.y,
            along * e.y * e.y + across * e.x * e.x,
        ];
        Self {
            normal: t,
            stretch,
            height: along * across * lobes.inv_alpha2 * std::f32::consts::FRAC_1_PI / t.z,
            least_deviation: radial.min(tangential).sqrt(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    /// Energy, mean and variance of a lobe in the whole image, the latter along x, in squared pixels.
    fn moments(kind: Distribution, alpha: f32, t: Vec3) -> (f64, f64, f64) {
        let lobes = Lobes::new(&Flake::new(kind, alpha).unwrap(), 256);
        let (mut sum, mut first, mut second) = (0.0, 0.0, 0.0);
        let mut stamp = Stamp::default();
        for block in 0..256 {
            let low = Vec2::new((block % 16) as f32, (block / 16) as f32) * 0.125 - 1.0;
            if !lobes.touches(t, low) || !lobes.stamp(t, low, &mut stamp) {
                continue;
            }
            for row in stamp.rows.0..stamp.rows.1 {
                for column in 0..BLOCK {
                    if !stamp.halves[column / 8] {
                        continue;
                    }
                    let mass = f64::from(stamp.pixels[row * BLOCK + column]) / (128.0 * 128.0);
                    let x = f64::from(low.x) * 128.0 + column as f64 + 0.5 - f64::from(t.x) * 128.0;
                    sum += mass;
                    first += mass * x;
                    second += mass * x * x;
                }
            }
        }
        (sum, first / sum, second / sum - (first / sum).powi(2))
    }

    #[test]
    fn lobes_keep_their_energy_and_read_as_wide_as_they_are() {
        for alpha in [0.001, 0.004, 0.01, 0.03] {
            for t in [Vec3::Z, Vec3::new(0.013, 0.3, 0.95), Vec3::new(0.4, -0.52, 0.75)] {
                // A mean over places in a pixel.
                let mut read = 0.0;
                for i in 0..16 {
                    let t = (t.normalize() + Vec3::X * (i as f32 / (16.0 * 128.0))).normalize();
                    let (energy, mean, variance) = moments(Distribution::Beckmann, alpha, t);
                    assert_relative_eq!(energy, 1.0, max_relative = 5e-3);
                    // What is narrow lies in the pixel that its normal is in.
                    read += (variance + mean * mean) / 16.0;
                }
                // The image holds the pixel average's twelfth; interpolation adds a sixth.
                let read = read + 1.0 / 6.0;
                let alpha = f64::from(alpha) * 128.0;
                let own = 0.5 * alpha * alpha * (1.0 - f64::from(t.normalize().x).powi(2));
                let expected = own.max(0.25);
                assert!(
                    (read / expected - 1.0).abs() < 0.12,
                    "alpha {alpha} at {t}: {read} {expected}"
                );
            }
        }
        let (energy, ..) = moments(Distribution::Ggx, 0.01, Vec3::new(0.1, 0.2, 0.97).normalize());
        assert_relative_eq!(energy, 400.0 / 401.0, max_relative = 5e-3);
    }
}
