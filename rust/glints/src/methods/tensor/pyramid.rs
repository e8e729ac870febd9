//! The pyramid of images of the distribution of normals, before compression (Deng et al. 2022, Section 4.1).
//!
//! **Geometry** Level 0 has a node every `stride` texels, at its multiples (a map that is no multiple of it has nodes a little
//! closer), and at each an image: the distribution of normals under a Gaussian footprint of standard deviation `sigma_0 =
//! 1.5 stride / sqrt(12)`. Every further level is half as dense and twice as wide. Positions wrap, as the map does. An axis with
//! one node has no footprint any more but the map's mean; the last level has one image, the mean over the map.
//!
//! **Level 0** scatters: the lobe of a texel is evaluated once and added to every image whose footprint holds the texel.
//!
//! **Level l + 1 from level l** A Gaussian of deviation `2 sigma` is one of deviation `sigma` blurred by another one of `sqrt(3)
//! sigma`. The blur is a sum over nodes, and such a sum has ripples: on nodes a spacing `d` apart, its Fourier transform at the
//! frequency f has beside `exp(-2 pi^2 (3 sigma^2 + sigma^2) f^2)` the replica `exp(-2 pi^2 (3 sigma^2 (f - 1/d)^2 + sigma^2
//! f^2))`, largest at `f = 3/4d`, `exp(-2 pi^2 (3/4) sigma^2 / d^2)`. At the nodes that are kept, `sigma / d = 0.43`, that is 6 %;
//! at half the spacing 1.5e-5. So every level is computed at twice the density that is kept ([`Axis::dense`]).
//!
//! **Memory** Everything above is linear and acts on each pixel alone: it is done for one block of 16 x 16 pixels at a time, which
//! takes 1 KB for each node. Nothing ever holds the whole pyramid.

use glam::Vec2;
use wide::f64x4;

use super::lobe::{Lobes, Stamp};
use super::{BLOCK, PIXELS, REGIONS};
use crate::normal_map::NormalMap;

/// A Gaussian ends at this many standard deviations.
const REACH: f64 = 4.0;

/// Nodes along one axis of a level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Axis {
    /// Texels.
    pub size: u32,
    /// Nodes with an image that is kept.
    pub kept: u32,
    /// Nodes with an image while the pyramid is computed: twice as many, or the one.
    pub dense: u32,
}

impl Axis {
    fn new(size: u32, stride: f64) -> Self {
        let kept = (f64::from(size) / stride).ceil().max(1.0) as u32;
        Self {
            size,
            kept,
            dense: if kept == 1 { 1 } else { 2 * kept },
        }
    }

    /// Texels between nodes that are kept.
    pub fn spacing(&self) -> f64 {
        f64::from(self.size) / f64::from(self.kept)
    }

    fn step(&self) -> u32 {
        self.dense / self.kept
    }

    /// The kept nodes on both sides of four positions in texels, with the weights of linear interpolation.
    pub fn neighbours(&self, positions: f64x4) -> [([u32; 4], [f64; 4]); 2] {
        if self.kept == 1 {
            return [([0; 4], [1.0; 4]), ([0; 4], [0.0; 4])];
        }
        let kept = f64::from(self.kept);
        let p = positions * (kept / f64::from(self.size));
        let first = p.floor();
        let fraction = p - first;
        // Remainders of floating-point numbers are slow, and these are asked for in every query.
        let first = (first - (first * (1.0 / kept)).floor() * kept).to_array();
        let first = first.map(|k| (k.max(0.0) as u32).min(self.kept - 1));
        let second = first.map(|k| if k + 1 == self.kept { 0 } else { k + 1 });
        [
            (first, (1.0 - fraction).to_array()),
            (second, fraction.to_array()),
        ]
    }

    /// Gaussian weights of `count` evenly spaced points, the first at `offset` texels, for every dense node, each node's sum
    /// being one.
    fn weights(&self, deviation: f64, count: u32, offset: f64) -> Windows {
        let period = f64::from(self.size);
        let gap = period / f64::from(self.dense);
        let reach = if self.dense == 1 {
            f64::INFINITY
        } else {
            REACH * deviation
        };
        let width = (2.0 * reach / gap).floor() + 1.0;
        let width = width.min(f64::from(self.dense)) as u32;
        let mut windows = Windows {
            width: width as usize,
            nodes: self.dense,
            first: Vec::new(),
            weights: vec![0.0; count as usize * width as usize],
        };
        let mut sums = vec![0.0; self.dense as usize];
        for point in 0..count {
            let position = offset + f64::from(point) * period / f64::from(count);
            let first = if width == self.dense {
                0
            } else {
                ((position - reach) / gap).ceil() as i64
            };
            windows.first.push(first.rem_euclid(self.dense.into()) as u32);
            for k in 0..i64::from(width) {
                let distance = position - (first + k) as f64 * gap;
                let weight = if self.dense == 1 {
                    1.0
                } else {
                    periodic_gaussian(distance, deviation, period)
                };
                windows.weights[point as usize * width as usize + k as usize] = weight;
                sums[(first + k).rem_euclid(self.dense.into()) as usize] += weight;
            }
        }
        for point in 0..count as usize {
            for (node, weight) in windows.of_mut(point) {
                *weight /= sums[node];
            }
        }
        windows
    }
}

/// Sum of a Gaussian over all periods, up to a factor.
fn periodic_gaussian(distance: f64, deviation: f64, period: f64) -> f64 {
    let nearest = distance - (distance / period).round() * period;
    let periods = (REACH * deviation / period).ceil() as i64 + 1;
    (-periods..=periods)
        .map(|k| {
            let x = (nearest + k as f64 * period) / deviation;
            (-0.5 * x * x).exp()
        })
        .sum()
}

/// For every point of an axis, a window of nodes with their weights.
struct Windows {
    width: usize,
    nodes: u32,
    first: Vec<u32>,
    weights: Vec<f64>,
}

impl Windows {
    fn of(&self, point: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let (first, nodes) = (self.first[point], self.nodes);
        self.weights[point * self.width..][..self.width]
            .iter()
            .enumerate()
            .map(move |(k, &w)| (((first + k as u32) % nodes) as usize, w))
    }

    fn of_mut(&mut self, point: usize) -> impl Iterator<Item = (usize, &mut f64)> + '_ {
        let (first, nodes) = (self.first[point], self.nodes);
        self.weights[point * self.width..][..self.width]
            .iter_mut()
            .enumerate()
            .map(move |(k, w)| (((first + k as u32) % nodes) as usize, w))
    }
}

/// One level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Level {
    /// Standard deviation of the footprint in texels.
    pub sigma: f64,
    /// Along columns and rows.
    pub axes: [Axis; 2],
    /// Number of the first image.
    pub first: u32,
}

impl Level {
    /// Number of the image at a node.
    pub fn image(&self, column: u32, row: u32) -> u32 {
        self.first + row * self.axes[0].kept + column
    }

    /// Images of the level.
    pub fn images(&self) -> u32 {
        self.axes[0].kept * self.axes[1].kept
    }

    fn dense(&self) -> usize {
        self.axes[0].dense as usize * self.axes[1].dense as usize
    }
}

/// Which images there are, and where.
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    pub map: (u32, u32),
    /// Pixels per side of an image, a multiple of [`BLOCK`].
    pub resolution: u32,
    /// Texels between nodes of level 0, as asked for.
    pub stride: u32,
    pub levels: Vec<Level>,
    /// Images of all levels.
    pub images: u32,
}

impl Geometry {
    /// `stride`: texels between the nodes of level 0.
    pub fn new(map: (u32, u32), resolution: u32, stride: u32) -> Self {
        let mut levels: Vec<Level> = Vec::new();
        let mut images = 0;
        let mut spacing = f64::from(stride);
        loop {
            let level = Level {
                sigma: 1.5 * spacing / 12_f64.sqrt(),
                axes: [Axis::new(map.0, spacing), Axis::new(map.1, spacing)],
                first: images,
            };
            levels.push(level);
            images += level.images();
            if level.images() == 1 {
                break;
            }
            spacing *= 2.0;
        }
        Self {
            map,
            resolution,
            stride,
            levels,
            images,
        }
    }

    /// The first `levels` of the levels.
    pub fn coarsened(mut self, levels: usize) -> Self {
        self.levels.truncate(levels);
        self.images = self.levels.iter().map(Level::images).sum();
        self
    }

    /// Blocks per side of an image.
    pub fn blocks(&self) -> u32 {
        self.resolution / BLOCK as u32
    }

    /// Side of a pixel in the disk.
    pub fn pixel(&self) -> f32 {
        2.0 / self.resolution as f32
    }

    /// The corner of least x and y of a block.
    pub fn corner(&self, block: u32) -> Vec2 {
        let side = self.pixel() * BLOCK as f32;
        let (row, column) = (block / self.blocks(), block % self.blocks());
        Vec2::new(column as f32, row as f32) * side - 1.0
    }

    /// The region of the map that each image belongs to, a cell of a grid of [`REGIONS`] x [`REGIONS`] cells.
    pub fn regions(&self) -> Vec<u8> {
        let mut regions = Vec::with_capacity(self.images as usize);
        for level in &self.levels {
            let cell = |node: u32, axis: Axis| (node * REGIONS / axis.kept) as u8;
            for row in 0..level.axes[1].kept {
                for column in 0..level.axes[0].kept {
                    let [x, y] = level.axes;
                    regions.push(cell(row, y) * REGIONS as u8 + cell(column, x));
                }
            }
        }
        regions
    }
}

/// The pyramid of a map, a block at a time.
pub struct Pyramid<'a> {
    map: &'a NormalMap,
    geometry: &'a Geometry,
    lobes: Lobes,
    columns: Windows,
    rows: Windows,
}

impl<'a> Pyramid<'a> {
    pub fn new(map: &'a NormalMap, geometry: &'a Geometry, lobes: Lobes) -> Self {
        let level = geometry.levels[0];
        let texels = |axis: Axis| axis.weights(level.sigma, axis.size, 0.5);
        Self {
            map,
            geometry,
            lobes,
            columns: texels(level.axes[0]),
            rows: texels(level.axes[1]),
        }
    }

    /// One block of all images, 256 pixels each: densities per projected area. `None`: no lobe touches it.
    pub fn block(&self, block: u32) -> Option<Vec<f32>> {
        let mut dense = self.scatter(self.geometry.corner(block))?;
        let mut kept = Vec::with_capacity(self.geometry.images as usize * PIXELS);
        for (index, level) in self.geometry.levels.iter().enumerate() {
            if index > 0 {
                dense = coarser(&dense, &self.geometry.levels[index - 1], level);
            }
            let [x, y] = level.axes;
            for row in 0..y.kept {
                for column in 0..x.kept {
                    let node = (row * y.step() * x.dense + column * x.step()) as usize;
                    kept.extend_from_slice(&dense[node * PIXELS..][..PIXELS]);
                }
            }
        }
        Some(kept)
    }

    /// The block at `low` of level 0, at all dense nodes.
    fn scatter(&self, low: Vec2) -> Option<Vec<f32>> {
        let level = &self.geometry.levels[0];
        let nodes = level.axes[0].dense as usize;
        let mut images: Option<Vec<f32>> = None;
        let mut stamp = Stamp::default();
        let width = self.map.width() as usize;
        for (row, normals) in self.map.normals().chunks_exact(width).enumerate() {
            for (column, &t) in normals.iter().enumerate() {
                if !self.lobes.touches(t, low) || !self.lobes.stamp(t, low, &mut stamp) {
                    continue;
                }
                let images = images.get_or_insert_with(|| vec![0.0; level.dense() * PIXELS]);
                for (y, weight_y) in self.rows.of(row) {
                    for (x, weight_x) in self.columns.of(column) {
                        let image = &mut images[(y * nodes + x) * PIXELS..][..PIXELS];
                        add(image, &stamp, (weight_x * weight_y) as f32);
                    }
                }
            }
        }
        images
    }
}

/// Adds a weighted stamp.
#[inline]
fn add(image: &mut [f32], stamp: &Stamp, weight: f32) {
    let rows = stamp.rows.0 * BLOCK..stamp.rows.1 * BLOCK;
    let (image, pixels) = (&mut image[rows.clone()], &stamp.pixels[rows]);
    for (to, from) in image.chunks_exact_mut(BLOCK).zip(pixels.chunks_exact(BLOCK)) {
        for half in 0..2 {
            if stamp.halves[half] {
                let (to, from) = (&mut to[8 * half..8 * half + 8], &from[8 * half..8 * half + 8]);
                to.iter_mut()
                    .zip(from)
                    .for_each(|(to, from)| *to += weight * from);
            }
        }
    }
}

/// A level at its dense nodes from the next finer one at its dense nodes.
fn coarser(images: &[f32], from: &Level, to: &Level) -> Vec<f32> {
    let deviation = (to.sigma * to.sigma - from.sigma * from.sigma).sqrt();
    let windows = |axis: usize| to.axes[axis].weights(deviation, from.axes[axis].dense, 0.0);
    let (columns, rows) = (windows(0), windows(1));
    let [from_x, from_y] = from.axes.map(|axis| axis.dense as usize);
    let [to_x, to_y] = to.axes.map(|axis| axis.dense as usize);
    let mut across = vec![0.0; to_x * from_y * PIXELS];
    for row in 0..from_y {
        for column in 0..from_x {
            let source = &images[(row * from_x + column) * PIXELS..][..PIXELS];
            if source.iter().all(|&value| value == 0.0) {
                continue;
            }
            for (x, weight) in columns.of(column) {
                add_scaled(&mut across[(row * to_x + x) * PIXELS..][..PIXELS], source, weight);
            }
        }
    }
    let mut result = vec![0.0; to_x * to_y * PIXELS];
    for row in 0..from_y {
        for column in 0..to_x {
            let source = &across[(row * to_x + column) * PIXELS..][..PIXELS];
            for (y, weight) in rows.of(row) {
                add_scaled(
                    &mut result[(y * to_x + column) * PIXELS..][..PIXELS],
                    source,
                    weight,
                );
            }
        }
    }
    result
}

fn add_scaled(to: &mut [f32], from: &[f32], weight: f64) {
    let weight = weight as f32;
    to.iter_mut()
        .zip(from)
        .for_each(|(to, from)| *to += weight * from);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::tensor::tests::{model, noisy_map};
    use approx::assert_relative_eq;

    /// The image under a Gaussian footprint of the infinite, repeated map, by summing over all texels of all repetitions.
    fn brute_force(map: &NormalMap, geometry: &Geometry, level: usize, node: (u32, u32)) -> Vec<f64> {
        let Level { sigma, axes, .. } = geometry.levels[level];
        let weights = |axis: Axis, node: u32| -> Vec<f64> {
            let center = f64::from(node) * axis.spacing();
            let sum_at = |x: f64| -> f64 {
                if axis.kept == 1 {
                    return 1.0;
                }
                (-40..=40)
                    .map(|k| (-0.5 * ((x + f64::from(k * axis.size as i32)) / sigma).powi(2)).exp())
                    .sum()
            };
            let weights: Vec<f64> = (0..axis.size)
                .map(|i| sum_at(f64::from(i) + 0.5 - center))
                .collect();
            let sum: f64 = weights.iter().sum();
            weights.into_iter().map(|w| w / sum).collect()
        };
        let (columns, rows) = (weights(axes[0], node.0), weights(axes[1], node.1));
        let lobes = Lobes::new(&model().flake, geometry.resolution);
        let side = geometry.resolution as usize;
        let mut image = vec![0.0; side * side];
        let mut stamp = Stamp::default();
        for (i, &t) in map.normals().iter().enumerate() {
            let weight = columns[i % columns.len()] * rows[i / columns.len()];
            for block in 0..geometry.blocks().pow(2) {
                if !lobes.stamp(t, geometry.corner(block), &mut stamp) {
                    continue;
                }
                let (x, y) = (
                    (block % geometry.blocks()) as usize * BLOCK,
                    (block / geometry.blocks()) as usize * BLOCK,
                );
                for row in stamp.rows.0..stamp.rows.1 {
                    for column in 0..BLOCK {
                        if stamp.halves[column / 8] {
                            image[(y + row) * side + x + column] +=
                                weight * f64::from(stamp.pixels[row * BLOCK + column]);
                        }
                    }
                }
            }
        }
        image
    }

    /// Relative L1 difference of a level's image from brute force.
    fn difference(map: &NormalMap, geometry: &Geometry, level: usize, node: (u32, u32)) -> f64 {
        let expected = brute_force(map, geometry, level, node);
        let lobes = Lobes::new(&model().flake, geometry.resolution);
        let pyramid = Pyramid::new(map, geometry, lobes);
        let image = geometry.levels[level].image(node.0, node.1) as usize;
        let side = geometry.resolution as usize;
        let mut difference = 0.0;
        for block in 0..geometry.blocks().pow(2) {
            let images = pyramid.block(block);
            let (x, y) = (
                (block % geometry.blocks()) as usize * BLOCK,
                (block / geometry.blocks()) as usize * BLOCK,
            );
            for pixel in 0..PIXELS {
                let expected = expected[(y + pixel / BLOCK) * side + x + pixel % BLOCK];
                let value = images
                    .as_ref()
                    .map_or(0.0, |images| images[image * PIXELS + pixel]);
                difference += (f64::from(value) - expected).abs();
            }
        }
        difference / expected.iter().sum::<f64>()
    }

    #[test]
    fn every_level_is_a_gaussian_sum_over_the_repeated_map() {
        // Neither square nor a multiple of the stride; and smaller than it.
        for (size, stride, nodes) in [
            (
                (75, 52),
                8,
                &[(0, (3, 2)), (1, (4, 3)), (2, (1, 0)), (3, (1, 0))][..],
            ),
            ((16, 64), 8, &[(0, (1, 7)), (1, (0, 3)), (2, (0, 1)), (3, (0, 0))]),
            ((9, 5), 32, &[(0, (0, 0))]),
        ] {
            let map = noisy_map(size.0, size.1);
            let geometry = Geometry::new(size, 64, stride);
            for &(level, node) in nodes {
                let difference = difference(&map, &geometry, level, node);
                assert!(difference < 2e-3, "{size:?} level {level}: {difference}");
            }
        }
    }

    #[test]
    fn levels_end_with_the_mean_over_the_map() {
        let geometry = Geometry::new((2048, 2048), 256, 32);
        let counts: Vec<u32> = geometry.levels.iter().map(Level::images).collect();
        assert_eq!(counts, [4096, 1024, 256, 64, 16, 4, 1]);
        assert_relative_eq!(geometry.levels[0].sigma, 13.856, max_relative = 1e-4);
        assert_eq!(geometry.images, 5461);
        let mut members = [0; 64];
        geometry.regions().iter().for_each(|&r| members[r as usize] += 1);
        assert_eq!((members[0], members[63]), (64 + 16 + 4 + 1 + 1 + 1 + 1, 85));
    }
}
