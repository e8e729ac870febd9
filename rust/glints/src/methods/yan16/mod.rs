//! Position-normal distributions as mixtures of 4D Gaussians, filtered with a Gaussian footprint.
//!
//! **Source** Yan, Hašan, Marschner, Ramamoorthi: *Position-Normal Distributions for Efficient Rendering of
//! Specular Microstructure*, SIGGRAPH 2016, written from the mathematics, which Xing et al. 2024 restate in
//! their Eq. 2 to 6 and Deng et al. 2022 in their Eq. 2.
//!
//! **Computes** The P-NDF `D_P(s) = integral of G_P(u) N(u, s) du` over the Gaussian footprint `G_P = N(c,
//! S_P)` ([`crate::gaussian_footprint`]), where `u` is a position in texels, `s` a normal projected to the
//! unit disk, and the position-normal distribution a sum of elements on a square grid of spacing `H`,
//!
//! ```text
//! N(u, s) = sum_i H^2 N(u; u_i, sigma_h^2 I) N(s; s_i + J_i (u - u_i), sigma_r^2 I),   sigma_h = H / sqrt(8 ln 2).
//! ```
//!
//! `sigma_r` is the intrinsic roughness: that of a Beckmann flake with `alpha = sqrt(2) sigma_r`. `J_i` is
//! the derivative of the normal by the position, zero for *flat* elements. The exponent is that of Xing's
//! Eq. 5. Completing the square in u gives each element's share in closed form,
//!
//! ```text
//! integral of G_P G_i du = w_i N(s; m_i, C_i),
//!   w_i = H^2 N(u_i; c, Q),                       Q = S_P + sigma_h^2 I,
//!   m_i = s_i - sigma_h^2 J_i Q^-1 (u_i - c),     C_i = sigma_r^2 I + J_i L J_i^T,   L = sigma_h^2 I - sigma_h^4 Q^-1,
//! ```
//!
//! which stays well conditioned when the footprint shrinks to a point. `D_P` is a density over the projected
//! disk: per solid angle it integrates to one against the cosine, like [`Normalization::Projected`]
//! everywhere else here.
//!
//! **Where it departs from the publication**
//!
//! * *Truncation.* An element counts where its share's exponent is at most [`LARGEST_EXPONENT`]; position and
//!   normal are cut together, in four dimensions. What is lost is the tail of a chi-square distribution of
//!   four degrees of freedom, 0.7 %, and a gain puts it back into `D_P`. The query's range is not clamped
//!   otherwise: the published implementation caps the footprint's standard deviation at 42.7 texels and then
//!   no longer filters the whole pixel. A Gaussian that covers the repeated map evenly is treated as such.
//! * *Normalization.* A grid of Gaussians is not quite constant. The weights are divided by their sum, which
//!   Poisson's formula gives in closed form ([`kernel::lattice_sum`]): D_P integrates to one also under a point.
//! * *Sampling.* A point of `G_P`, an element with probability proportional to its Gaussian there, and a
//!   normal of the element's lobe at that point: exactly the density `D_P(h) (h . n)`, in constant time.
//!   Where the truncation excludes the element from the density at the drawn normal, the draw fails.
//! * *Lobes* are round in the projected disk, where Beckmann's are round about their normals: at a tilt theta
//!   they are wider by 1 / cos theta across, of the same energy, and lower at their peak.
//! * *Shadowing.* The flakes' own Smith term is one, as the half vector lies within the lobe; the whole
//!   map's `G_x` is the same as everywhere ([`crate::brdf`]).
//!
//! **Elements** *Flat* ones have the texels' normals: a piecewise flat surface, blurred by `sigma_h`. *Curved*
//! ones follow the map interpolated bilinearly in the projected disk; `refinement` r puts r x r of them on a
//! texel, and with it the mixture tends to the interpolated surface ([`NormalMap::interpolated`]). One a texel
//! is enough for a map that is smooth at the scale of texels; over noise it misses what interpolation does to
//! the variance of normals, and two a side are needed ([`resolving_refinement`]).
//!
//! **Layout** A [`tree::Tree`]: 14 bytes a texel for flat elements, 30 r^2 for curved ones.
//!
//! **Bounds** A query costs O(blocks met + elements near the normal), which grows with the footprint's area.
//! Flat elements near the normal are few; curved ones overlap as far as the map bends.
//!
//! [`Normalization::Projected`]: crate::flakes::Normalization::Projected

mod kernel;
mod tree;

use std::f64::consts::TAU;

use glam::{DVec2, Vec2, Vec3};
use rayon::prelude::*;

use super::{Method, Reflection};
use crate::error::{Error, Result};
use crate::footprint::Footprint;
use crate::gaussian_footprint::{GaussianFootprint, Reach, checked_deviation};
use crate::half_vector::DirectionPair;
use crate::hash::mix;
use crate::normal_map::NormalMap;
use kernel::{Kernel, apply};
use tree::{Element, Tree};

/// Exponent beyond which an element's share counts as zero: 3.7 standard deviations.
const LARGEST_EXPONENT: f32 = 7.0;

/// Elements per side of a block of the tree: flat ones are narrow in normals, so that wide blocks leave most
/// of them out; curved ones are wide in normals and narrow in positions.
const FLAT_SIDE: u32 = 64;
const CURVED_SIDE: u32 = 8;

/// Radius of the ellipse of positions that may count, in standard deviations: `sqrt(2 LARGEST_EXPONENT)`.
const RADIUS: f64 = 3.741_657_386_773_941_4;

/// `sigma_h / H`: neighbouring Gaussians cross at half their height (Yan et al. 2016, Section 4).
const SEED_DEVIATION: f64 = 0.424_660_900_144_009_5;

/// Largest value of a row of seeds `sum_k N(x; k, SEED_DEVIATION^2)`, at a seed; rounded up.
const LARGEST_ROW: f64 = 1.057;

/// Draws of a point before sampling gives up; each succeeds with a probability of at least 0.79.
const MOST_DRAWS: usize = 24;

/// What stands for the surface between the samples of the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Elements {
    /// Constant normals, one element a texel.
    #[default]
    Flat,
    /// Normals that follow the interpolated map, `refinement` x `refinement` elements a texel.
    Curved { refinement: u32 },
}

/// Parameters of the method.
#[derive(Clone, Copy, Debug)]
pub struct Options {
    pub elements: Elements,
    /// `sigma_r`, in [7e-5, 0.71]: standard deviation of an element's lobe in the projected disk.
    pub intrinsic: f32,
    /// Standard deviation of the Gaussian footprint in units of the pixel, in [0.05, 4].
    pub footprint_sigma: f32,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            elements: Elements::Flat,
            intrinsic: 0.005,
            footprint_sigma: 0.5,
        }
    }
}

/// See the module.
pub struct Yan16 {
    tree: Tree,
    options: Options,
    size: (u32, u32),
    /// H in texels.
    spacing: f64,
}

impl Options {
    fn check(&self, map: &NormalMap) -> Result<()> {
        let Self {
            elements,
            intrinsic,
            footprint_sigma,
        } = *self;
        if !(7e-5..=0.7072).contains(&intrinsic) {
            let reason = "must be an intrinsic roughness in [0.00007, 0.707]: alpha / sqrt(2)";
            return Err(Error::parameter("intrinsic", intrinsic, reason));
        }
        checked_deviation(footprint_sigma)?;
        if let Elements::Curved { refinement } = elements {
            let texels = u64::from(map.width()) * u64::from(map.height());
            let fits = refinement <= 16 && texels * u64::from(refinement).pow(2) <= 1 << 30;
            if refinement == 0 || !fits {
                let reason = "must be 1 to 16 elements a texel and side, and 2^30 in all at most (32 GB)";
                return Err(Error::parameter("refinement", refinement, reason));
            }
        }
        Ok(())
    }
}

impl Yan16 {
    pub fn new(map: &NormalMap, options: Options) -> Result<Self> {
        options.check(map)?;
        let (refinement, curved) = match options.elements {
            Elements::Flat => (1, false),
            Elements::Curved { refinement } => (refinement, true),
        };
        let spacing = 1.0 / f64::from(refinement);
        let (columns, rows) = (map.width() * refinement, map.height() * refinement);
        let side = if curved { CURVED_SIDE } else { FLAT_SIDE };
        let tree = Tree::new((columns, rows), side, curved, |column, row| {
            if curved {
                curved_element(map, &options, spacing, column, row)
            } else {
                flat_element(map, &options, column, row)
            }
        });
        Ok(Self {
            tree,
            options,
            size: (map.width(), map.height()),
            spacing,
        })
    }

    fn kernel(&self, footprint: &Footprint) -> Kernel {
        let gaussian = GaussianFootprint::new(footprint, self.options.footprint_sigma.into());
        Kernel::new(gaussian, self.spacing, self.options.intrinsic.into())
    }

    /// `D_P(s)` as far as it is not truncated: the density of sampled normals over the projected disk.
    fn truncated(&self, kernel: &Kernel, s: Vec2) -> f32 {
        let side = f64::from(self.tree.side()) * self.spacing;
        let mut sum = 0.0;
        match kernel.reach {
            Reach::Local => kernel
                .gaussian
                .for_each_block(&kernel.q, RADIUS, side, |column, row, corner| {
                    sum += f64::from(self.sum_block(kernel, s, column, row, corner.as_vec2()));
                }),
            Reach::Whole => {
                let blocks = |side: u32| ((f64::from(side) / self.spacing) as u32).div_ceil(self.tree.side());
                for row in 0..blocks(self.size.1) {
                    for column in 0..blocks(self.size.0) {
                        sum += f64::from(self.sum_block(kernel, s, column, row, Vec2::ZERO));
                    }
                }
            }
        }
        (sum * kernel.scale) as f32
    }

    /// Sum of the shares of a block's elements, without the kernel's scale. `corner` is the block's, relative
    /// to the footprint's centre.
    fn sum_block(&self, kernel: &Kernel, s: Vec2, column: u32, row: u32, corner: Vec2) -> f32 {
        let block = self.tree.block(column, row);
        let mut sum = 0.0;
        self.tree.for_each_leaf(&block, s, |range| {
            let leaf = self.tree.leaf(range.clone());
            sum += match self.options.elements {
                Elements::Flat => kernel.sum_flat(s, corner, leaf),
                Elements::Curved { .. } => kernel.sum_curved(s, corner, leaf, self.tree.jacobians(range)),
            };
        });
        sum
    }

    /// Draws a position, in unwrapped texels, and the column and row of a seed in the unwrapped grid, from
    /// the density `G_P(u) G_i(u)`, up to a constant.
    fn draw_seed(&self, kernel: &Kernel, u: [f32; 2]) -> Option<(DVec2, DVec2)> {
        let mut random = Hash::new(u);
        let mut pair = DVec2::new(u[0].into(), u[1].into());
        for _ in 0..MOST_DRAWS {
            let position = match kernel.reach {
                Reach::Local => kernel.gaussian.point(standard_normals(pair)),
                Reach::Whole => pair * kernel.gaussian.map_size(),
            };
            let p = position / self.spacing - 0.5;
            if let (Some(column), Some(row)) = (
                draw_neighbour(p.x, random.uniform()),
                draw_neighbour(p.y, random.uniform()),
            ) {
                return Some((position, DVec2::new(column, row)));
            }
            pair = DVec2::new(random.uniform(), random.uniform());
        }
        None
    }
}

impl Method for Yan16 {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        let kernel = self.kernel(footprint);
        let truncated = self.truncated(&kernel, projected(pair.half));
        Reflection {
            value: kernel.gain * truncated,
            density: truncated * pair.half.z,
        }
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.truncated(&self.kernel(footprint), projected(h)) * h.z
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        let kernel = self.kernel(footprint);
        kernel.gain * self.truncated(&kernel, projected(h))
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let kernel = self.kernel(footprint);
        let (position, seed) = self.draw_seed(&kernel, [u[0], u[1]])?;
        let seed_position = (seed + 0.5) * self.spacing;
        let grid = kernel.gaussian.map_size() / self.spacing;
        let wrapped = seed.rem_euclid(grid);
        let (normal, jacobian) = self.tree.element_at(wrapped.x as u32, wrapped.y as u32);
        let lobe = standard_normals(DVec2::new(u[2].into(), u[3].into())).as_vec2();
        let s =
            normal + apply(&jacobian, (position - seed_position).as_vec2()) + self.options.intrinsic * lobe;
        let offset = (seed_position - kernel.gaussian.center()).as_vec2();
        let (exponent, _) = kernel.exponent(offset, s - normal, &jacobian);
        let z2 = 1.0 - s.length_squared();
        (z2 > 0.0 && exponent <= LARGEST_EXPONENT).then(|| s.extend(z2.sqrt()))
    }

    fn map_size(&self) -> (u32, u32) {
        self.size
    }

    fn structure_bytes(&self) -> usize {
        self.tree.bytes()
    }

    fn refinement(&self) -> Option<u32> {
        Some(match self.options.elements {
            Elements::Flat => 1,
            Elements::Curved { refinement } => refinement,
        })
    }

    fn name(&self) -> &'static str {
        match self.options.elements {
            Elements::Flat => "yan16 flat",
            Elements::Curved { .. } => "yan16 curved",
        }
    }
}

/// Curved elements per texel and side that a map needs: one where first differences of its normals outweigh
/// the second ones, else two, which have bilinear interpolation's exact derivatives.
pub fn resolving_refinement(map: &NormalMap) -> u32 {
    let (width, height) = (map.width(), map.height());
    let row_sums = |row: u32| {
        let mut sums = DVec2::ZERO;
        for column in 0..width {
            let at = |dx: u32, dy: u32| projected(map.normal((column + dx) % width, (row + dy) % height));
            let center = at(0, 0);
            for (before, after) in [(at(width - 1, 0), at(1, 0)), (at(0, height - 1), at(0, 1))] {
                let first = (after - before).length_squared();
                let second = (after - 2.0 * center + before).length_squared();
                sums += DVec2::new(first.into(), second.into());
            }
        }
        sums
    };
    // Summed in the order of rows, so that the answer does not depend on the number of threads.
    let rows: Vec<DVec2> = (0..height).into_par_iter().map(row_sums).collect();
    let sums: DVec2 = rows.into_iter().sum();
    if sums.y > sums.x { 2 } else { 1 }
}

fn projected(h: Vec3) -> Vec2 {
    Vec2::new(h.x, h.y)
}

fn flat_element(map: &NormalMap, options: &Options, column: u32, row: u32) -> Element {
    Element {
        normal: projected(map.normal(column, row)),
        jacobian: [0.0; 4],
        extent: extent(options, 0.0, &[0.0; 4]),
    }
}

/// The interpolated map about a seed: its normal, and its mean slope over the seed's cell.
fn curved_element(map: &NormalMap, options: &Options, spacing: f64, column: u32, row: u32) -> Element {
    let center = (DVec2::new(f64::from(column), f64::from(row)) + 0.5) * spacing;
    let slope = |step: DVec2| {
        let half = 0.5 * spacing * step;
        (map.interpolated(center + half) - map.interpolated(center - half)) / spacing as f32
    };
    let (du, dv) = (slope(DVec2::X), slope(DVec2::Y));
    let jacobian = [du.x, dv.x, du.y, dv.y];
    Element {
        normal: map.interpolated(center),
        jacobian,
        extent: extent(options, SEED_DEVIATION * spacing, &jacobian),
    }
}

/// Distance from an element's normal beyond which its share is truncated under every footprint: the exponent
/// is at least that of the normal's marginal, whose covariance is `sigma_r^2 I + sigma_h^2 J J^T`.
fn extent(options: &Options, seed_deviation: f64, jacobian: &[f32; 4]) -> Vec2 {
    let variance = |a: f32, b: f32| {
        f64::from(options.intrinsic).powi(2) + seed_deviation.powi(2) * f64::from(a * a + b * b)
    };
    let [xu, xv, yu, yv] = *jacobian;
    let radius = f64::from(2.0 * LARGEST_EXPONENT).sqrt();
    DVec2::new(variance(xu, xv).sqrt(), variance(yu, yv).sqrt()).as_vec2() * (radius * 1.0001) as f32
}

/// The seed of a row of seeds at the integers, drawn with the probability `N(x; k, SEED_DEVIATION^2) /
/// LARGEST_ROW`; `None` with what is left.
fn draw_neighbour(x: f64, u: f64) -> Option<f64> {
    let nearest = x.round();
    let mut left = u * LARGEST_ROW;
    for step in [0.0, -1.0, 1.0, -2.0, 2.0] {
        let z = (nearest + step - x) / SEED_DEVIATION;
        left -= (-0.5 * z * z).exp() / (SEED_DEVIATION * TAU.sqrt());
        if left < 0.0 {
            return Some(nearest + step);
        }
    }
    None
}

/// Two independent standard normal numbers from two uniform ones (Box and Muller 1958).
fn standard_normals(u: DVec2) -> DVec2 {
    DVec2::from_angle(TAU * u.y) * (-2.0 * (1.0 - u.x).ln()).sqrt()
}

/// Further uniform numbers from two: SplitMix64, started from all their bits.
struct Hash(u64);

impl Hash {
    fn new(u: [f32; 2]) -> Self {
        Self(u64::from(u[0].to_bits()) << 32 | u64::from(u[1].to_bits()))
    }

    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        (mix(self.0) >> 11) as f64 * (1.0 / (1_u64 << 53) as f64)
    }
}

#[cfg(test)]
mod tests;
