//! Tensor-decomposed distributions of normals: point and range queries at a cost that no footprint changes.
//!
//! **Source** Deng, Liu, Wang, Yang: *Constant-Cost Spatio-Angular Prefiltering of Glinty Appearance Using Tensor Decomposition*,
//! ACM Transactions on Graphics 41(2), 2022, Sections 4, 5.1 and 5.2. There is no published code.
//!
//! **Computes** The distribution of normals under a Gaussian footprint (Eq. 2),
//!
//! ```text
//! D_P(h) = integral of G(u; x, sigma_p) D^alpha(h, t(u)) / (t(u) . n) du,
//! ```
//!
//! a density per projected area, from images of 256 x 256 pixels over the projected disk:
//!
//! | step | module |
//! |---|---|
//! | lobes of texels in images | [`lobe`] |
//! | images for footprints of all places and sizes, a pyramid | [`pyramid`] |
//! | groups of blocks, decomposed ([`cp`]) and rounded ([`quantise`]) | [`build`] |
//! | point queries, range queries, sampling | [`images`] |
//! | footprints as blends of images | [`select`] |
//! | files | `file` |
//!
//! **Small footprints** are the exact method's, a [`CompactBinMap`] of the same map, over the parallelogram that has the
//! Gaussian's covariance. Its share fades out linearly while the footprint grows from half to all of the finest level's size:
//! value, density, sampling and range queries are a mixture, continuous at both ends. A range query sums the exact method's part
//! texel by texel: there its cost grows with the footprint, up to the finest level's.
//!
//! **Reflection** The half vector stands for the normal of the flake, `t_k = h`, also in the shadowing of flakes:
//! `R = D_P(h) G1(i, h) G1(o, h)`. Within a lobe the two differ by its width; the pixel's normals are not kept.
//!
//! **Memory** Two parts, [`Tensor::bytes`]: images (7.6 MB for the brushed 2K map at rank 32), and the exact method (4 bytes a texel).
//!
//! **Exactness** Evaluation, density and sampling are exact partners, of whatever rank. Against the Gaussian footprint there are
//! errors of the decomposition (a rank's), of the pixels (a lobe narrower than half a pixel, alpha < 0.0055 at 256 pixels a side,
//! reads wider than it is; take a higher resolution), and of blending neighbouring images. What a query blends has a smaller error
//! of compression than a single image: errors of up to eight images partly cancel. Of the brushed 2K map at rank 32, relative L1:
//!
//! | alpha | single image, finest level | a footprint of 48 texels | 96 | 192 | of blending, 48 | 96 | 192 |
//! |---|---|---|---|---|---|---|---|
//! | 0.00707 | 14.9 % | 4.8 % | 2.1 % | 2.1 % | 10.6 % | 5.8 % | 4.5 % |
//! | 0.01 | 5.1 % | 1.7 % | 0.8 % | 0.7 % | 8.0 % | 4.4 % | 3.2 % |
//!
//! Columns 3 to 5 compare with the same blends of uncompressed images ([`Uncompressed`]), the last three these with the Gaussian
//! (`scripts/bench --only tensor`). A flat surface under a distant light shows one direction of a distribution in each pixel: this
//! is its highlight's error. Larger lights average over it.
//!
//! **Rank** In eight bits ([`quantise`]) a rank has the error that it has in sixteen (finest level at rank 16: 26.2 % for 26.3 %; of
//! flakes, whose decompositions are better, at rank 32 3.4 % for 2.0 %, in footprints of 48 texels 1.8 %), so
//! that the default is twice the published rank at half the published bytes. All groups have the same: with 16, 32 or 48 for each, chosen
//! by error per byte at equal bytes in all, the finest level's error would fall by 9 % of itself (from the errors of all groups of a
//! cut of 512 texels), for a precomputation of three to four times the length.
//!
//! **Bounds** A point query reads at most 32 images: R multiplications for each of four pixels of each. Range queries cost the same for
//! each of the blocks they overlap, and up to 16 additions for each component and axis.

mod build;
pub mod cp;
mod file;
mod images;
mod lobe;
mod pyramid;
mod quantise;
mod select;
mod uncompressed;

use glam::{Vec2, Vec3};

use super::compact::CompactBinMap;
use super::{MAX_RANGES, Method, RangeMeans, Reflection};
use crate::error::{Error, Result};
use crate::flakes::{FlakeModel, Normalization};
use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;
use crate::normal_map::NormalMap;
use images::{Images, MAX_RANK};
use lobe::Lobes;
use pyramid::Geometry;
use select::{Selection, select};

pub use build::Report;
pub use file::{Header, VERSION, cache_path, is_saved, read_header};
pub use uncompressed::Uncompressed;

/// Pixels per side of a block.
const BLOCK: usize = 16;

/// Pixels of a block.
const PIXELS: usize = BLOCK * BLOCK;

/// Regions per side of the map.
const REGIONS: u32 = 8;

/// Standard deviation of the Gaussian footprint in pixels, as in [`super::yan16`].
const DEVIATION: f64 = 0.5;

/// Most images, of all levels: those of a region, a 64th of them, are numbered with 16 bits.
const MOST_IMAGES: u32 = 1 << 21;

/// Parameters of the precomputation.
#[derive(Clone, Debug)]
pub struct Options {
    /// Pixels per side of an image, a multiple of 16 in 32 to 1024.
    pub resolution: u32,
    /// Texels between the images of the finest level, 4 to 1024.
    pub stride: u32,
    /// Largest rank of a group, 1 to 64.
    pub rank: u32,
    /// Relative error of a group at which a smaller rank is taken, in [0, 1): ranks are tried in the order 4, 8, 16, ... Zero:
    /// always the largest.
    pub error: f32,
    /// Share of an image's energy below which a block counts as blank, in [0, 0.01].
    pub blank: f32,
    /// Relative L1 difference of neighbouring levels below which the coarser one is left out, in [0, 1).
    pub agreement: f32,
    /// Of the decomposition; its rank is the one above.
    pub solver: cp::Options,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            resolution: 256,
            stride: 32,
            rank: 32,
            error: 0.0,
            blank: 3e-5,
            agreement: 0.02,
            solver: cp::Options::default(),
        }
    }
}

impl Options {
    /// The published parameters: one rank (16; 32 for flakes), the published solver.
    pub fn published() -> Self {
        Self {
            rank: 16,
            error: 0.0,
            blank: 1e-9,
            solver: cp::Options::published(),
            ..Self::default()
        }
    }

    /// # Errors
    /// A parameter is outside its domain.
    pub fn check(&self) -> Result<()> {
        if self.resolution % BLOCK as u32 != 0 || !(32..=1024).contains(&self.resolution) {
            let reason = "must be the pixels per side of an image, a multiple of 16 in 32 to 1024";
            return Err(Error::parameter("resolution", self.resolution, reason));
        }
        if !(4..=1024).contains(&self.stride) {
            let reason = "must be the texels between images of the finest level, 4 to 1024";
            return Err(Error::parameter("stride", self.stride, reason));
        }
        if !(1..=MAX_RANK as u32).contains(&self.rank) {
            return Err(Error::parameter("rank", self.rank, "must be 1 to 64"));
        }
        for (name, value, most) in [
            ("error", self.error, 1.0),
            ("blank", self.blank, 0.01),
            ("agreement", self.agreement, 1.0),
        ] {
            if !(0.0..=most).contains(&value) {
                let reason = format!("must be in [0, {most}]");
                return Err(Error::parameter(name, value, reason));
            }
        }
        Ok(())
    }

    /// # Errors
    /// As [`Self::check`]; or there would be too many images of a map of this size.
    fn check_for(&self, map: (u32, u32)) -> Result<()> {
        self.check()?;
        let images = Geometry::new(map, self.resolution, self.stride).images;
        if images > MOST_IMAGES {
            let reason = format!(
                "asks for {images} images of a map of {} x {} texels, more than {MOST_IMAGES}; take a larger one",
                map.0, map.1
            );
            return Err(Error::parameter("stride", self.stride, reason));
        }
        Ok(())
    }

    /// The ranks that are tried for a group.
    fn ranks(&self) -> Vec<usize> {
        let largest = self.rank as usize;
        let smaller = [4, 8, 16, 32]
            .into_iter()
            .filter(|&rank| rank < largest && self.error > 0.0);
        smaller.chain([largest]).collect()
    }
}

/// See the module.
pub struct Tensor {
    model: FlakeModel,
    images: Images,
    exact: CompactBinMap,
}

impl Tensor {
    /// Precomputes all images of a map: minutes for a large one. `progress` is called with the share that is done, from any
    /// thread.
    ///
    /// # Errors
    /// Parameters outside their domains; weighting of texels other than by projected area.
    pub fn new(
        map: &NormalMap,
        model: FlakeModel,
        options: &Options,
        progress: &(dyn Fn(f64) + Sync),
    ) -> Result<(Self, Report)> {
        check(map, model, options)?;
        let lobes = Lobes::new(&model.flake, options.resolution);
        let (images, report) = build::build(map, lobes, options, progress);
        // As a file holds it, so that what is loaded answers as what was saved.
        Ok((Self::with_exact(&file::as_stored(map)?, model, images), report))
    }

    fn with_exact(map: &NormalMap, model: FlakeModel, images: Images) -> Self {
        Self {
            model,
            images,
            exact: CompactBinMap::new(map, model),
        }
    }

    /// Bytes of the images, and of the exact method for small footprints.
    pub fn bytes(&self) -> (usize, usize) {
        (self.images.bytes(), self.exact.structure_bytes())
    }

    /// The flakes that it was made for.
    pub fn model(&self) -> FlakeModel {
        self.model
    }

    /// Mean rank of a group.
    pub fn mean_rank(&self) -> f64 {
        let (count, sum) = self
            .images
            .ranks()
            .fold((0, 0), |(count, sum), rank| (count + 1, sum + rank));
        sum as f64 / f64::from(count.max(1))
    }

    fn select(&self, footprint: &Footprint) -> Selection {
        select(&self.images.geometry, footprint, DEVIATION)
    }

    /// `exact` for the part of a footprint that is the exact method's, and `images` for the images' part, added by their
    /// shares.
    #[inline]
    fn mixed(
        &self,
        footprint: &Footprint,
        exact: impl Fn(&Footprint) -> f32,
        images: impl Fn(f32) -> f32,
        p: Vec2,
    ) -> f32 {
        let selection = self.select(footprint);
        let mut value = 0.0;
        if selection.exact > 0.0 {
            value += selection.exact * exact(&of_equal_covariance(footprint));
        }
        if selection.exact < 1.0 {
            value += (1.0 - selection.exact) * images(self.images.density(&selection.images, p));
        }
        value
    }
}

fn check(map: &NormalMap, model: FlakeModel, options: &Options) -> Result<()> {
    if model.normalization != Normalization::Projected {
        let reason = "a position-normal distribution is one of projected area; leave the parameter out";
        return Err(Error::parameter("normalization", "paper", reason));
    }
    options.check_for((map.width(), map.height()))
}

/// The parallelogram whose covariance is that of a footprint's Gaussian: a box of width w has a variance of `w^2 / 12`.
fn of_equal_covariance(footprint: &Footprint) -> Footprint {
    footprint.widened(DEVIATION * 12_f64.sqrt())
}

impl Method for Tensor {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        let selection = self.select(footprint);
        let mut sum = Reflection::default();
        if selection.exact > 0.0 {
            let exact = self.exact.evaluate(&of_equal_covariance(footprint), pair);
            sum.value += selection.exact * exact.value;
            sum.density += selection.exact * exact.density;
        }
        if selection.exact < 1.0 {
            let h = pair.half;
            let ndf = (1.0 - selection.exact) * self.images.density(&selection.images, h.truncate());
            let shadowing = self.model.flake.smith_g1(pair.cos).powi(2);
            sum.value += ndf * shadowing;
            sum.density += ndf * h.z;
        }
        sum
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.mixed(
            footprint,
            |f| self.exact.density(f, h),
            |ndf| ndf * h.z,
            h.truncate(),
        )
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.mixed(footprint, |f| self.exact.ndf(f, h), |ndf| ndf, h.truncate())
    }

    fn ndf_over(&self, footprint: &Footprint, low: Vec2, high: Vec2) -> Option<f32> {
        self.ndf_over_all(footprint, &[(low, high)])?.first().copied()
    }

    /// The exact method's part of a footprint is summed texel by texel.
    fn ndf_over_all(&self, footprint: &Footprint, rectangles: &[(Vec2, Vec2)]) -> Option<RangeMeans> {
        let selection = self.select(footprint);
        let mut means: RangeMeans = rectangles.iter().take(MAX_RANGES).map(|_| 0.0).collect();
        if selection.exact > 0.0 {
            let exact = self
                .exact
                .means_over_texels(&of_equal_covariance(footprint), rectangles);
            let parts = means.iter_mut().zip(exact);
            parts.for_each(|(mean, exact)| *mean += selection.exact * exact);
        }
        if selection.exact < 1.0 {
            for (mean, &(low, high)) in means.iter_mut().zip(rectangles) {
                *mean += (1.0 - selection.exact) * self.images.mean(&selection.images, low, high);
            }
        }
        Some(means)
    }

    /// `u[0]` chooses the exact method or an image, `u[1]` a block of the image, `u[2]` and `u[3]` rows and columns.
    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let selection = self.select(footprint);
        if u[0] < selection.exact {
            let u0 = u[0] / selection.exact;
            return self
                .exact
                .sample(&of_equal_covariance(footprint), [u0, u[1], u[2], u[3]]);
        }
        let mut left = (u[0] - selection.exact) / (1.0 - selection.exact);
        let mut chosen = selection.images.last()?.0;
        for &(image, weight) in &selection.images {
            if left < weight {
                chosen = image;
                break;
            }
            left -= weight;
        }
        let p = self.images.sample(chosen, [u[1], u[2], u[3]])?;
        let z2 = 1.0 - p.length_squared();
        (z2 > 0.0).then(|| p.extend(z2.sqrt()).normalize())
    }

    fn map_size(&self) -> (u32, u32) {
        self.images.geometry.map
    }

    fn structure_bytes(&self) -> usize {
        self.images.bytes() + self.exact.structure_bytes()
    }

    fn name(&self) -> &'static str {
        "tensor decomposition"
    }
}

#[cfg(test)]
mod tests;
