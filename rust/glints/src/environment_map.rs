//! The light of an environment as a latitude-longitude picture, and the spherical Gaussians fitted to it.
//!
//! **Computes** from a picture of `w` x `h` pixels, as Mitsuba's `envmap` takes it, weighted directions for
//! [`SphericalGaussians::fit`], and the light of every lobe in red, green and blue.
//!
//! **Orientation** that of `envmap`, in the emitter's own frame (before its `to_world`). The pixel in column `c` and row
//! `r` is the radiance from the direction
//!
//! ```text
//! (sin phi sin theta, cos theta, -cos phi sin theta),   phi = 2 pi (c + 1/2) / w,   theta = pi r / (h - 1):
//! ```
//!
//! the first and the last row are the poles, +y and -y; the middle of the picture is +z, a quarter of the width from
//! the left is +x. In between, radiance is interpolated linearly in `phi` and `theta`.
//!
//! **Solid angles** are the exact integrals of this interpolation. With `d = pi / (h - 1)`, a pixel stands for
//!
//! ```text
//! 2 pi / w  sin theta  2 (1 - cos d) / d,   in the first and the last row   2 pi / w  (1 - sin d / d),
//! ```
//!
//! which sum to 4 pi: the picture's light is the integral of what `envmap` shows.
//!
//! **Patches** A picture has millions of pixels. It is cut into at most [`PATCHES`] rectangles: that of most light times
//! squared extent is halved next. A patch stands at the centre of gravity of its light; bright and small lights have
//! patches of single pixels. No light is lost, in no colour.

use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::f64::consts::{PI, TAU};
use std::path::Path;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::normal_map::decode;
use crate::spherical_gaussians::{Light, SphericalGaussian, SphericalGaussians};

/// Most patches that lobes are fitted to.
pub const PATCHES: usize = 16_384;

/// Start of the fit's random numbers.
const SEED: u64 = 0;

/// Red, green and blue.
pub type Rgb = [f64; 3];

/// Luminance of linear sRGB, with Mitsuba's coefficients.
pub fn luminance(rgb: Rgb) -> f64 {
    0.212_671 * rgb[0] + 0.715_160 * rgb[1] + 0.072_169 * rgb[2]
}

/// See the module.
#[derive(Clone, Debug)]
pub struct EnvironmentMap {
    width: u32,
    height: u32,
    pixels: Vec<[f32; 3]>,
}

/// A mixture, and the light of its lobes.
#[derive(Clone, Debug, PartialEq)]
pub struct EnvironmentFit {
    /// In the picture's frame.
    pub mixture: SphericalGaussians,
    /// Radiance of each lobe, integrated over directions.
    pub energies: Vec<Rgb>,
    /// Share of the luminance that the mixture has elsewhere, in [0, 1]; see [`SphericalGaussians::residual`].
    pub residual: f64,
}

/// Part of a picture that stands for one direction.
struct Patch {
    direction: Vec3,
    light: f64,
    colour: Rgb,
}

impl EnvironmentMap {
    /// Reads a picture of radiances.
    ///
    /// # Errors
    /// The file is no picture of floating-point numbers with red, green and blue; see also [`Self::new`].
    pub fn load(path: &Path) -> Result<Self> {
        let refuse = |reason: String| Error::File {
            path: path.into(),
            reason,
        };
        let image = decode(path)?;
        let color = image.color();
        if color.bytes_per_pixel() / color.channel_count() != 4 || color.channel_count() < 3 {
            return Err(refuse(
                "has no floating-point red, green and blue; an environment's light needs an EXR file".into(),
            ));
        }
        let image = image.into_rgb32f();
        let (width, height) = image.dimensions();
        let pixels = image.pixels().map(|pixel| pixel.0).collect();
        Self::new(width, height, pixels).map_err(|error| match error {
            Error::Map { reason, .. } => refuse(reason),
            other => other,
        })
    }

    /// Takes `width * height` radiances, row by row.
    ///
    /// # Errors
    /// Other numbers of pixels; fewer than 2 x 3, the least that `envmap` takes; radiances that are negative or
    /// not finite.
    pub fn new(width: u32, height: u32, pixels: Vec<[f32; 3]>) -> Result<Self> {
        let refuse = |reason: String| Error::Map {
            map: "environment".into(),
            reason,
        };
        if pixels.len() as u64 != u64::from(width) * u64::from(height) {
            return Err(refuse(format!(
                "has {} pixels, but its size is {width} x {height}",
                pixels.len()
            )));
        }
        if width < 2 || height < 3 {
            return Err(refuse(format!(
                "is {width} x {height} pixels; an environment map has 2 x 3 or more"
            )));
        }
        let bad = |pixel: &[f32; 3]| pixel.iter().any(|c| !c.is_finite() || *c < 0.0);
        if let Some(index) = pixels.iter().position(bad) {
            return Err(refuse(format!(
                "pixel (column {}, row {}) is {:?}; radiance must be finite and not negative, repair the file",
                index as u32 % width,
                index as u32 / width,
                pixels[index]
            )));
        }
        Ok(Self {
            width,
            height,
            pixels,
        })
    }

    pub fn width(&self) -> u32 {
        self.width
    }

    pub fn height(&self) -> u32 {
        self.height
    }

    /// Radiance in column and row.
    pub fn pixel(&self, column: u32, row: u32) -> Rgb {
        self.pixels[row as usize * self.width as usize + column as usize].map(f64::from)
    }

    /// The direction that a pixel is seen in.
    pub fn direction(&self, column: u32, row: u32) -> DVec3 {
        let phi = TAU * (f64::from(column) + 0.5) / f64::from(self.width);
        let theta = PI * f64::from(row) / f64::from(self.height - 1);
        let ((sin_phi, cos_phi), (sin, cos)) = (phi.sin_cos(), theta.sin_cos());
        DVec3::new(sin_phi * sin, cos, -cos_phi * sin)
    }

    /// The solid angle that each pixel of a row stands for.
    pub fn solid_angle(&self, row: u32) -> f64 {
        let step = PI / f64::from(self.height - 1);
        let ring = if row == 0 || row + 1 == self.height {
            1.0 - step.sin() / step
        } else {
            (step * f64::from(row)).sin() * 4.0 * (0.5 * step).sin().powi(2) / step
        };
        TAU / f64::from(self.width) * ring
    }

    /// Fits at most `lobes` spherical Gaussians.
    ///
    /// # Errors
    /// `lobes` outside its domain; no light at all.
    pub fn fit(&self, lobes: usize) -> Result<EnvironmentFit> {
        let patches = self.patches(PATCHES);
        let directions: Vec<Vec3> = patches.iter().map(|patch| patch.direction).collect();
        let weights: Vec<f32> = patches.iter().map(|patch| patch.light as f32).collect();
        let light = Light {
            directions: &directions,
            weights: &weights,
        };
        let mixture = SphericalGaussians::fit(light, lobes, SEED)?;
        let colours: Vec<f32> = patches
            .iter()
            .flat_map(|patch| patch.colour.map(|c| c as f32))
            .collect();
        let energies = mixture.energies(&directions, &colours, 3);
        let energies = energies.chunks_exact(3).map(|e| [e[0], e[1], e[2]]).collect();
        let residual = self.residual(&mixture);
        Ok(EnvironmentFit {
            mixture,
            energies,
            residual,
        })
    }

    /// [`SphericalGaussians::residual`] over all pixels.
    fn residual(&self, mixture: &SphericalGaussians) -> f64 {
        let light_of_row = |row: u32| -> f64 {
            let pixels = (0..self.width).map(|column| luminance(self.pixel(column, row)));
            pixels.sum::<f64>() * self.solid_angle(row)
        };
        let total: f64 = (0..self.height).map(light_of_row).sum();
        let excess_of_row = |row: u32| -> f64 {
            let excess = (0..self.width).map(|column| {
                let radiance = luminance(self.pixel(column, row));
                // A pixel without light has none elsewhere.
                let is_lit = radiance > 0.0;
                let shown = || f64::from(mixture.density(self.direction(column, row).as_vec3()));
                if is_lit {
                    (radiance / total - shown()).max(0.0)
                } else {
                    0.0
                }
            });
            excess.sum::<f64>() * self.solid_angle(row)
        };
        // Collected before they are summed: the same sum on any number of threads.
        let rows: Vec<f64> = (0..self.height).into_par_iter().map(excess_of_row).collect();
        rows.iter().sum()
    }

    /// At most `count` patches.
    fn patches(&self, count: usize) -> Vec<Patch> {
        let whole = Rectangle {
            columns: (0, self.width),
            rows: (0, self.height),
        };
        let mut open = BinaryHeap::from([self.weighted(whole)]);
        let mut closed = Vec::new();
        while open.len() + closed.len() < count {
            let Some(next) = open.pop() else { break };
            match self.halves(&next.rectangle) {
                Some(halves) => open.extend(halves.map(|half| self.weighted(half))),
                None => closed.push(next),
            }
        }
        let mut rectangles: Vec<Rectangle> = open.into_iter().chain(closed).map(|w| w.rectangle).collect();
        rectangles.sort_unstable_by_key(|r| (r.rows, r.columns));
        rectangles.iter().map(|rectangle| self.patch(rectangle)).collect()
    }

    fn weighted(&self, rectangle: Rectangle) -> Weighted {
        let rows = rectangle.row_range().map(|row| {
            let pixels = rectangle
                .column_range()
                .map(|column| luminance(self.pixel(column, row)));
            pixels.sum::<f64>() * self.solid_angle(row)
        });
        let light: f64 = rows.sum();
        let [across, along] = self.extent(&rectangle);
        Weighted {
            priority: light * (across * across + along * along),
            rectangle,
        }
    }

    /// Angles across columns, where they are widest, and along rows.
    fn extent(&self, rectangle: &Rectangle) -> [f64; 2] {
        let step = PI / f64::from(self.height - 1);
        let (first, last) = (rectangle.rows.0, rectangle.rows.1 - 1);
        let nearest_to_equator = (0.5 * PI).clamp(step * f64::from(first), step * f64::from(last));
        let columns = f64::from(rectangle.columns.1 - rectangle.columns.0);
        [
            columns * TAU / f64::from(self.width) * nearest_to_equator.sin(),
            f64::from(rectangle.rows.1 - rectangle.rows.0) * step,
        ]
    }

    /// Cut across the longer side; `None` for a single pixel.
    fn halves(&self, rectangle: &Rectangle) -> Option<[Rectangle; 2]> {
        let [across, along] = self.extent(rectangle);
        let ((c0, c1), (r0, r1)) = (rectangle.columns, rectangle.rows);
        let by_columns = c1 - c0 > 1 && (across >= along || r1 - r0 == 1);
        if by_columns {
            let middle = c0 + (c1 - c0) / 2;
            let rows = rectangle.rows;
            return Some([(c0, middle), (middle, c1)].map(|columns| Rectangle { columns, rows }));
        }
        let middle = r0 + (r1 - r0) / 2;
        let columns = rectangle.columns;
        (r1 - r0 > 1).then(|| [(r0, middle), (middle, r1)].map(|rows| Rectangle { columns, rows }))
    }

    fn patch(&self, rectangle: &Rectangle) -> Patch {
        let (mut light, mut colour, mut centre) = (0.0, [0.0; 3], DVec3::ZERO);
        for row in rectangle.row_range() {
            let solid_angle = self.solid_angle(row);
            for column in rectangle.column_range() {
                let pixel = self.pixel(column, row).map(|c| c * solid_angle);
                let weight = luminance(pixel);
                light += weight;
                centre += weight * self.direction(column, row);
                for (sum, c) in colour.iter_mut().zip(pixel) {
                    *sum += c;
                }
            }
        }
        let corner = self.direction(rectangle.columns.0, rectangle.rows.0);
        Patch {
            direction: centre.try_normalize().unwrap_or(corner).as_vec3(),
            light,
            colour,
        }
    }
}

impl EnvironmentFit {
    /// The picture's light: radiance integrated over directions.
    pub fn total(&self) -> Rgb {
        let add = |sum: Rgb, energy: &Rgb| [0, 1, 2].map(|i| sum[i] + energy[i]);
        self.energies.iter().fold([0.0; 3], add)
    }

    /// Radiance of the mixture from the unit vector `x`.
    pub fn radiance(&self, x: Vec3) -> Rgb {
        let lobes = self.mixture.lobes().iter().zip(&self.energies);
        let terms = lobes.map(|(lobe, energy): (&SphericalGaussian, _)| (f64::from(lobe.density(x)), energy));
        terms.fold([0.0; 3], |sum, (density, energy)| {
            [0, 1, 2].map(|i| sum[i] + density * energy[i])
        })
    }
}

/// Pixels of half-open ranges of columns and rows.
struct Rectangle {
    columns: (u32, u32),
    rows: (u32, u32),
}

impl Rectangle {
    fn column_range(&self) -> std::ops::Range<u32> {
        self.columns.0..self.columns.1
    }

    fn row_range(&self) -> std::ops::Range<u32> {
        self.rows.0..self.rows.1
    }
}

/// A rectangle in the order in which they are halved; equal ones from the top, from the left.
struct Weighted {
    priority: f64,
    rectangle: Rectangle,
}

impl Ord for Weighted {
    fn cmp(&self, other: &Self) -> Ordering {
        let place = |w: &Self| (w.rectangle.rows, w.rectangle.columns);
        let by_priority = self.priority.total_cmp(&other.priority);
        by_priority.then_with(|| place(other).cmp(&place(self)))
    }
}

impl PartialOrd for Weighted {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Weighted {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Weighted {}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;

    fn map(width: u32, height: u32, radiance: impl Fn(DVec3) -> [f32; 3]) -> EnvironmentMap {
        let black = vec![[0.0; 3]; (width * height) as usize];
        let grid = EnvironmentMap::new(width, height, black).unwrap();
        let places = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        let pixels = places.map(|(c, r)| radiance(grid.direction(c, r))).collect();
        EnvironmentMap::new(width, height, pixels).unwrap()
    }

    /// A coloured sky and two lamps of a few pixels.
    fn studio(x: DVec3) -> [f32; 3] {
        let lamp = |axis: DVec3| {
            if x.dot(axis.normalize()) > 0.998 {
                50.0
            } else {
                0.0
            }
        };
        let (red, blue) = (lamp(DVec3::new(1.0, 1.0, 0.2)), lamp(DVec3::new(-0.3, 0.5, -1.0)));
        [0.1 + red, 0.1 + 0.1 * x.y.max(0.0) as f32, 0.2 + blue]
    }

    /// As the manual of `envmap` shows it, and as tests/test_environment.py measures it.
    #[test]
    fn pixels_lie_where_mitsuba_has_them() {
        let grid = map(8, 5, |_| [1.0; 3]);
        let is = |column, row, x: [f64; 3]| {
            let found = grid.direction(column, row);
            assert!(
                (found - DVec3::from(x)).length() < 1e-12,
                "{column} {row} {found}"
            );
        };
        let (sin, cos) = (TAU / 16.0).sin_cos();
        is(3, 0, [0.0, 1.0, 0.0]);
        is(3, 4, [0.0, -1.0, 0.0]);
        is(0, 2, [sin, 0.0, -cos]);
        is(2, 2, [cos, 0.0, sin]);
        is(4, 2, [-sin, 0.0, cos]);
    }

    #[test]
    fn solid_angles_sum_to_the_sphere() {
        for (width, height) in [(2, 3), (7, 4), (64, 33)] {
            let grid = map(width, height, |_| [1.0; 3]);
            let sum: f64 = (0..height)
                .map(|row| grid.solid_angle(row) * f64::from(width))
                .sum();
            assert_relative_eq!(sum, 2.0 * TAU, max_relative = 1e-12);
        }
    }

    #[test]
    fn patches_keep_light_colour_and_centre_of_gravity() {
        let map = map(128, 65, studio);
        let patches = map.patches(500);
        assert_eq!(patches.len(), 500);
        let all = map.patches(usize::MAX);
        // Those of the poles are all there, too.
        assert_eq!(all.len(), 128 * 65);
        let light = |patches: &[Patch]| patches.iter().map(|p| p.light).sum::<f64>();
        assert_relative_eq!(light(&patches), light(&all), max_relative = 1e-12);
        for channel in 0..3 {
            let sum = |patches: &[Patch]| patches.iter().map(|p| p.colour[channel]).sum::<f64>();
            assert_relative_eq!(sum(&patches), sum(&all), max_relative = 1e-12);
        }
        let gravity = |patches: &[Patch]| {
            let terms = patches.iter().map(|p| p.direction.as_dvec3() * p.light);
            terms.sum::<DVec3>() / light(patches)
        };
        assert!((gravity(&patches) - gravity(&all)).length() < 2e-3);
        // A lamp of 50 times the sky has patches far smaller than the sky's.
        let axis = Vec3::new(1.0, 1.0, 0.2).normalize();
        let on_lamp = patches.iter().filter(|p| p.direction.dot(axis) > 0.998).count();
        assert!(on_lamp >= 5, "{on_lamp}");
    }

    #[test]
    fn a_fit_keeps_light_and_finds_lamps() {
        let map = map(128, 65, studio);
        let fit = map.fit(32).unwrap();
        let places = (0..65).flat_map(|row| (0..128).map(move |column| (column, row)));
        let expected = places.fold([0.0; 3], |sum: Rgb, (c, r)| {
            let (pixel, solid_angle) = (map.pixel(c, r), map.solid_angle(r));
            [0, 1, 2].map(|i| sum[i] + pixel[i] * solid_angle)
        });
        for (found, expected) in fit.total().into_iter().zip(expected) {
            assert_relative_eq!(found, expected, max_relative = 1e-6);
        }
        // The red lamp is one lobe, or several; the blue one is elsewhere.
        let [red, blue] = [DVec3::new(1.0, 1.0, 0.2), DVec3::new(-0.3, 0.5, -1.0)].map(|x| {
            let [r, _, b] = fit.radiance(x.normalize().as_vec3());
            [r, b]
        });
        assert!(
            red[0] > 10.0 * red[1] && blue[1] > 10.0 * blue[0],
            "{red:?} {blue:?}"
        );
        assert!((0.01..0.25).contains(&fit.residual), "{}", fit.residual);
        // Twin: the same lobes, turned by a right angle.
        let quarter = glam::Mat3::from_rotation_y(std::f32::consts::FRAC_PI_2);
        let turned = map.residual(&fit.mixture.turned(&quarter));
        assert!(turned > 2.0 * fit.residual, "{turned} {}", fit.residual);
    }

    #[test]
    fn a_picture_of_few_pixels_is_enough() {
        let fit = map(2, 3, |_| [1.0, 2.0, 3.0]).fit(4).unwrap();
        assert_relative_eq!(fit.total()[1], 4.0 * TAU, max_relative = 1e-6);
    }

    #[test]
    fn bad_pictures_are_refused() {
        let message = |width, height, pixels| {
            EnvironmentMap::new(width, height, pixels)
                .unwrap_err()
                .to_string()
        };
        assert!(message(2, 3, vec![[1.0; 3]; 5]).contains("5 pixels"));
        assert!(message(2, 2, vec![[1.0; 3]; 4]).contains("2 x 3"));
        let mut pixels = vec![[1.0; 3]; 6];
        pixels[3][1] = f32::NAN;
        assert!(message(2, 3, pixels.clone()).contains("column 1, row 1"));
        pixels[3][1] = -1.0;
        assert!(message(2, 3, pixels).contains("not negative"));
        let black = map(4, 4, |_| [0.0; 3]).fit(4).unwrap_err().to_string();
        assert!(black.contains("black"), "{black}");
    }
}
