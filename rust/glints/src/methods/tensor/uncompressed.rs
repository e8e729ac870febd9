//! The images as they are before compression: what tells its error from that of blending images.

use glam::{DVec2, Vec3};
use rayon::prelude::*;

use super::lobe::Lobes;
use super::pyramid::{Geometry, Pyramid};
use super::select::select;
use super::{BLOCK, DEVIATION, Options, PIXELS, check};
use crate::error::Result;
use crate::flakes::FlakeModel;
use crate::footprint::Footprint;
use crate::normal_map::NormalMap;

/// Distributions of normals as [`super::Tensor`] blends and interpolates them, of all levels, from images in single precision:
/// 1 KB for each block of each image, hundreds of megabytes for a map of 2048 x 2048 texels.
pub struct Uncompressed {
    geometry: Geometry,
    /// Of every direction, the block of all images, if any lobe touches it.
    blocks: Vec<Option<Vec<f32>>>,
}

impl Uncompressed {
    /// # Errors
    /// As [`super::Tensor::new`].
    pub fn new(map: &NormalMap, model: FlakeModel, options: &Options) -> Result<Self> {
        check(map, model, options)?;
        let geometry = Geometry::new((map.width(), map.height()), options.resolution, options.stride);
        let lobes = Lobes::new(&model.flake, options.resolution);
        let pyramid = Pyramid::new(map, &geometry, lobes);
        let mut blocks: Vec<Option<Vec<f32>>> = (0..geometry.blocks().pow(2))
            .into_par_iter()
            .map(|block| pyramid.block(block))
            .collect();
        // Images integrate to one.
        let pixel = f64::from(geometry.pixel());
        for image in 0..geometry.images as usize {
            let pixels = image * PIXELS..(image + 1) * PIXELS;
            let own = |values: &Vec<f32>| values[pixels.clone()].iter().map(|&v| f64::from(v)).sum::<f64>();
            let total: f64 = blocks.iter().flatten().map(own).sum();
            let scale = (1.0 / (total * pixel * pixel).max(f64::MIN_POSITIVE)) as f32;
            for values in blocks.iter_mut().flatten() {
                values[pixels.clone()]
                    .iter_mut()
                    .for_each(|value| *value *= scale);
            }
        }
        Ok(Self { geometry, blocks })
    }

    /// What the images say of the distribution at a half vector, a density per projected area; zero for a footprint that the exact
    /// method answers alone.
    pub fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        let blend = select(&self.geometry, footprint, DEVIATION).images;
        let place = (h.truncate().as_dvec2() + 1.0) / f64::from(self.geometry.pixel()) - 0.5;
        let (first, fraction) = (place.floor(), place - place.floor());
        let mut sum = 0.0;
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
            let offset = DVec2::new(dx, dy);
            let weights = DVec2::ONE - (fraction - offset).abs();
            let pixel = first + offset;
            let values = blend
                .iter()
                .map(|&(image, weight)| weight * self.pixel(image, pixel));
            sum += (weights.x * weights.y) as f32 * values.sum::<f32>();
        }
        sum
    }

    fn pixel(&self, image: u32, place: DVec2) -> f32 {
        let side = f64::from(self.geometry.resolution);
        if place.min_element() < 0.0 || place.max_element() >= side {
            return 0.0;
        }
        let (column, row) = (place.x as usize, place.y as usize);
        let block = row / BLOCK * self.geometry.blocks() as usize + column / BLOCK;
        let pixel = image as usize * PIXELS + row % BLOCK * BLOCK + column % BLOCK;
        self.blocks[block].as_ref().map_or(0.0, |values| values[pixel])
    }
}
