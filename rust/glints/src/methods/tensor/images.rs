//! Compressed images: storage, point queries, range queries and sampling (Deng et al. 2022, Sections 4.2 to 4.4 and 5.2).
//!
//! **Statement** An image is cut into blocks of 16 x 16 pixels, the map into 8 x 8 regions. The blocks of one direction of all
//! images of one region, over all levels, are a *group*, a tensor of 16 x 16 x L values; blank blocks are left out. Its
//! decomposition of rank R gives the pixel (i, j) of the block with row z as
//!
//! ```text
//! c(i, j, z) = sum_r C_r Y_r(i) X_r(j) Z_r(z)                                              (Eq. 6)
//! ```
//!
//! **Layout** of a group, 8-bit integers: 16 rows of Y, 16 of X, then L rows of Z, every row with its R components side by side;
//! `C_r` holds all scales, the upper half of an f32. Published are vectors and summed-area tables of them in floating point. Here
//! sums over rows or columns are of at most sixteen integers each, exact ones, and take no memory.
//! Which images have a row is a set of bits for each group; the row is the number of bits before the image's.
//!
//! **Values** A sum of rank R dips below zero. Every pixel counts as `max(c, 0)`, before anything is blended, and every image
//! is divided by the exact sum of what counts, its *total*. A distribution is a blend of images, hence integrates to one whatever the
//! rank; a sample comes from one image, chosen by its share, a block of it, a pixel of the block and a point of the pixel's
//! tent, all from exactly the density that [`Images::density`] answers.
//!
//! **Sampling** Published is a descent through quads with range queries, whose answers can be negative. Here the shares of an
//! image's blocks are stored, 16 bits each; they are rounded up, and the rounding is undone by rejecting a block with the
//! excess as probability (below 1e-3 for all of an image's blocks together). The block is then reconstructed, 256 R multiplications,
//! and a pixel drawn from its exact values.

use std::ops::Range;

use arrayvec::ArrayVec;
use glam::Vec2;
use wide::f32x8;

use super::pyramid::Geometry;
use super::quantise::scale;
use super::{BLOCK, PIXELS, REGIONS};
use crate::array::Array;
use crate::hash::mix;

/// Largest rank.
pub const MAX_RANK: usize = 64;

/// Elements after the last one of an array whose components are read as if there were [`MAX_RANK`].
pub const PADDING: usize = MAX_RANK;

/// Scales of a group of a rank.
pub fn scales(rank: usize) -> usize {
    rank.next_multiple_of(8)
}

/// Elements of a group of a rank with so many rows.
pub fn elements(rank: usize, rows: usize) -> usize {
    (2 * BLOCK + rows) * rank
}

/// Share of an image that has the mass 65535.
const WHOLE: f32 = 65_535.0;

/// Draws of a block before sampling gives up: each is rejected with a probability of at most 1e-2.
const MOST_DRAWS: u64 = 8;

/// Images with their weights.
pub type Blend = ArrayVec<(u32, f32), 32>;

/// Where the parts of a group are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Group {
    /// First element in [`Parts::factors`].
    pub factors: u32,
    /// First element in [`Parts::scales`].
    pub scales: u32,
    pub block: u16,
    pub region: u8,
    pub rank: u8,
}

impl Group {
    /// As a file holds it.
    pub fn packed(&self) -> [u32; 3] {
        let rest = u32::from(self.block) | u32::from(self.region) << 16 | u32::from(self.rank) << 24;
        [self.factors, self.scales, rest]
    }

    #[inline]
    pub fn unpacked([factors, scales, rest]: [u32; 3]) -> Self {
        Self {
            factors,
            scales,
            block: rest as u16,
            region: (rest >> 16) as u8,
            rank: (rest >> 24) as u8,
        }
    }
}

/// What a file holds.
#[derive(Default)]
pub struct Parts {
    /// [`Group`]s in the order of regions, then blocks.
    pub groups: Array<[u32; 3]>,
    /// Bits of the images of the region that have a row: [`Members::words`] words a group.
    pub masks: Array<u64>,
    /// Y, X and rows of Z, with padding.
    pub factors: Array<i8>,
    /// `C_r`, upper halves of f32, zero up to the next multiple of eight, with padding.
    pub scales: Array<u16>,
    /// Shares of each image's blocks, image by image, blocks in order.
    pub masses: Array<u16>,
    /// Sum of what counts of each image, in densities: times the area of a pixel, its energy.
    pub totals: Array<f32>,
}

impl Parts {
    pub fn bytes(&self) -> usize {
        self.groups.bytes()
            + self.masks.bytes()
            + self.factors.bytes()
            + self.scales.bytes()
            + self.masses.bytes()
            + self.totals.bytes()
    }
}

/// Which images belong to which region.
pub struct Members {
    /// Of each image.
    pub region: Vec<u8>,
    /// Number of each image among those of its region.
    pub local: Vec<u16>,
    /// Images of each region, in order. [`Images`] keeps none: queries do without.
    pub images: Vec<Vec<u32>>,
    /// Words of a group's mask.
    pub words: usize,
}

impl Members {
    pub fn new(geometry: &Geometry) -> Self {
        let region = geometry.regions();
        let mut images = vec![Vec::new(); (REGIONS * REGIONS) as usize];
        let mut local = Vec::with_capacity(region.len());
        for (image, &r) in region.iter().enumerate() {
            local.push(images[r as usize].len() as u16);
            images[r as usize].push(image as u32);
        }
        let most = images.iter().map(Vec::len).max().unwrap_or(0);
        Self {
            region,
            local,
            images,
            words: most.div_ceil(64),
        }
    }
}

/// See the module.
pub struct Images {
    pub geometry: Geometry,
    members: Members,
    parts: Parts,
    /// Vectors of eight components of the largest rank: 1, 2, 4 or 8.
    chunks: usize,
    /// Group of each region and block plus one, or zero.
    lookup: Vec<u32>,
    /// First group of each region, and the end.
    regions: Vec<u32>,
    /// First mass of each image, and the end.
    starts: Vec<u32>,
}

/// All components of something, in vectors of eight; C is as large as the largest rank asks for. Beyond a group's rank there is
/// whatever follows it; its scales are zero there.
type Components<const C: usize> = [f32x8; C];

/// A block's part of a point query: pixels side by side, with the weights of rows and columns.
#[derive(Clone, Copy, Debug, Default)]
struct Corner {
    block: u32,
    rows: Line,
    columns: Line,
}

impl Corner {
    /// Of its pixels; of those that are not the block's, zero.
    #[inline]
    fn weights(&self) -> [f32; 4] {
        let ([top, bottom], [left, right]) = (self.rows.weights, self.columns.weights);
        [top * left, top * right, bottom * left, bottom * right]
    }
}

/// One or two pixels of a block along an axis.
#[derive(Clone, Copy, Debug, Default)]
struct Line {
    block: u32,
    first: usize,
    count: usize,
    weights: [f32; 2],
}

/// Along one axis, which pixels of a block count how much: all of a range once, some by their weights.
#[derive(Clone, Debug, Default)]
struct Interval {
    whole: Range<usize>,
    parts: ArrayVec<(usize, f32), 6>,
}

impl Images {
    /// Parts that fit together: see [`super::check`].
    pub fn new(geometry: Geometry, parts: Parts) -> Self {
        let mut members = Members::new(&geometry);
        let blocks = geometry.blocks().pow(2) as usize;
        let groups: Vec<Group> = parts
            .groups
            .iter()
            .map(|&packed| Group::unpacked(packed))
            .collect();
        let mut lookup = vec![0; (REGIONS * REGIONS) as usize * blocks];
        let mut counts = vec![0_u32; geometry.images as usize + 1];
        for (index, group) in groups.iter().enumerate() {
            lookup[group.region as usize * blocks + group.block as usize] = index as u32 + 1;
            let mask = &parts.masks[index * members.words..][..members.words];
            for (local, &image) in members.images[group.region as usize].iter().enumerate() {
                counts[image as usize + 1] += u32::from(has(mask, local));
            }
        }
        let starts = counts
            .iter()
            .scan(0, |sum, &count| {
                *sum += count;
                Some(*sum)
            })
            .collect();
        members.images = Vec::new();
        Self {
            geometry,
            members,
            parts,
            chunks: groups
                .iter()
                .map(|group| (group.rank as usize).div_ceil(8).next_power_of_two())
                .max()
                .unwrap_or(1),
            regions: (0..=REGIONS * REGIONS)
                .map(|region| groups.partition_point(|g| u32::from(g.region) < region) as u32)
                .collect(),
            lookup,
            starts,
        }
    }

    pub fn parts(&self) -> &Parts {
        &self.parts
    }

    /// All groups, in order.
    pub fn groups(&self) -> impl Iterator<Item = Group> + '_ {
        self.parts.groups.iter().map(|&packed| Group::unpacked(packed))
    }

    fn group(&self, index: usize) -> Group {
        Group::unpacked(self.parts.groups[index])
    }

    /// The row of an image in a group, if it has one.
    #[cfg(test)]
    pub fn row_of(&self, group: usize, image: u32) -> Option<usize> {
        let local = self.members.local[image as usize] as usize;
        let same = self.members.region[image as usize] == self.group(group).region;
        (same && has(self.mask(group), local)).then(|| rank_of(self.mask(group), local))
    }

    /// Bytes that queries need.
    pub fn bytes(&self) -> usize {
        let members = &self.members;
        self.parts.bytes()
            + size_of_val(&self.lookup[..])
            + size_of_val(&self.regions[..])
            + size_of_val(&self.starts[..])
            + size_of_val(&members.region[..])
            + size_of_val(&members.local[..])
    }

    /// Ranks of all groups.
    pub fn ranks(&self) -> impl Iterator<Item = usize> + '_ {
        self.groups().map(|group| group.rank as usize)
    }

    // ---- point queries --------------------------------------------------------------------------------------------------------

    /// The blend's density per projected area at a point of the disk.
    pub fn density(&self, blend: &Blend, p: Vec2) -> f32 {
        self.blended(blend, p, |values| values.max(f32x8::ZERO))
    }

    /// The same without clamping: what range queries average.
    #[cfg(test)]
    pub fn raw_density(&self, blend: &Blend, p: Vec2) -> f32 {
        self.blended(blend, p, |values| values)
    }

    #[inline(always)]
    fn blended(&self, blend: &Blend, p: Vec2, counts: impl Fn(f32x8) -> f32x8) -> f32 {
        let corners = self.corners(p);
        let sum = match self.chunks {
            1 => self.sum_corners::<1>(blend, &corners, counts),
            2 => self.sum_corners::<2>(blend, &corners, counts),
            4 => self.sum_corners::<4>(blend, &corners, counts),
            _ => self.sum_corners::<8>(blend, &corners, counts),
        };
        sum * self.densities()
    }

    #[inline]
    fn sum_corners<const C: usize>(
        &self,
        blend: &Blend,
        corners: &[Corner],
        counts: impl Fn(f32x8) -> f32x8,
    ) -> f32 {
        let arrays = Arrays::new(&self.parts);
        let mut sum = f32x8::ZERO;
        // Two images' four pixels each, that a transposition adds up at once.
        let mut pending = [f32x8::ZERO; 8];
        let mut weights = [0.0; 8];
        let mut half = 0;
        for corner in corners {
            let mut known = usize::MAX;
            let mut products = [[f32x8::ZERO; C]; 4];
            let pixels = corner.weights();
            for &(image, weight) in blend {
                let Some((index, row)) = self.find(image, corner.block) else {
                    continue;
                };
                let group = &arrays.group(index);
                if known != index {
                    known = index;
                    arrays.multiply(group, corner, &mut products);
                }
                let z: Components<C> = arrays.line(group, 2 * BLOCK + row);
                let share = weight * arrays.inverse_total(image);
                for (i, (products, pixel)) in products.iter().zip(pixels).enumerate() {
                    pending[half + i] = product(products, &z);
                    weights[half + i] = share * pixel;
                }
                half = 4 - half;
                if half == 0 {
                    sum += counts(sums(pending)) * f32x8::from(weights);
                }
            }
        }
        if half > 0 {
            weights[4..].fill(0.0);
            sum += counts(sums(pending)) * f32x8::from(weights);
        }
        sum.reduce_add()
    }

    /// The density of one image at a pixel as reconstructed, negative values included, not normalised.
    #[cfg(test)]
    pub fn raw(&self, image: u32, column: u32, row: u32) -> f32 {
        let side = BLOCK as u32;
        let line = |i: u32| Line {
            block: i / side,
            first: (i % side) as usize,
            count: 1,
            weights: [1.0, 0.0],
        };
        let corner = Corner {
            block: row / side * self.geometry.blocks() + column / side,
            rows: line(row),
            columns: line(column),
        };
        let blend = std::iter::once((image, 1.0)).collect();
        let total = self.parts.totals[image as usize];
        total * self.sum_corners::<8>(&blend, &[corner], |values| values)
    }

    /// From shares of an image to densities: one over the area of a pixel.
    fn densities(&self) -> f32 {
        let pixel = self.geometry.pixel();
        1.0 / (pixel * pixel)
    }

    /// The four pixels around a point, block by block.
    #[inline]
    fn corners(&self, p: Vec2) -> ArrayVec<Corner, 4> {
        let u = (p + 1.0) / self.geometry.pixel() - 0.5;
        let columns = self.lines(u.x);
        let rows = self.lines(u.y);
        let mut corners = ArrayVec::new();
        for rows in &rows {
            for columns in &columns {
                corners.push(Corner {
                    block: rows.block * self.geometry.blocks() + columns.block,
                    rows: *rows,
                    columns: *columns,
                });
            }
        }
        corners
    }

    /// The two pixels around a coordinate, block by block.
    #[inline]
    fn lines(&self, u: f32) -> ArrayVec<Line, 2> {
        let first = u.floor();
        let fraction = u - first;
        let inside = 0..self.geometry.resolution as i32;
        let mut lines: ArrayVec<Line, 2> = ArrayVec::new();
        for (i, weight) in [(first as i32, 1.0 - fraction), (first as i32 + 1, fraction)] {
            if !inside.contains(&i) || weight <= 0.0 {
                continue;
            }
            let (block, i) = (i as u32 / BLOCK as u32, i as usize % BLOCK);
            match lines.last_mut() {
                Some(line) if line.block == block => {
                    line.weights[1] = weight;
                    line.count = 2;
                }
                _ => lines.push(Line {
                    block,
                    first: i,
                    count: 1,
                    weights: [weight, 0.0],
                }),
            }
        }
        lines
    }

    /// The group of an image's block and the block's row in it.
    #[inline]
    fn find(&self, image: u32, block: u32) -> Option<(usize, usize)> {
        let region = self.members.region[image as usize] as usize;
        let blocks = self.geometry.blocks().pow(2) as usize;
        let index = self.lookup[region * blocks + block as usize].checked_sub(1)? as usize;
        let local = self.members.local[image as usize] as usize;
        let mask = self.mask(index);
        has(mask, local).then(|| (index, rank_of(mask, local)))
    }

    #[inline]
    fn mask(&self, group: usize) -> &[u64] {
        &self.parts.masks[group * self.members.words..][..self.members.words]
    }

    // ---- range queries --------------------------------------------------------------------------------------------------------

    /// The blend's mean density over the rectangle `[low, high]` (Eq. 7): exactly the mean of what the pixels' tents
    /// give at its points before negative values are clamped, whatever the number of blocks it overlaps; zero if that is negative.
    pub fn mean(&self, blend: &Blend, low: Vec2, high: Vec2) -> f32 {
        self.raw_mean(blend, low, high).max(0.0)
    }

    /// The same, negative as it may be.
    pub fn raw_mean(&self, blend: &Blend, low: Vec2, high: Vec2) -> f32 {
        if !low.cmplt(high).all() {
            return 0.0;
        }
        let pixels = |p: Vec2| (p.as_dvec2() + 1.0) / f64::from(self.geometry.pixel()) - 0.5;
        let (a, b) = (pixels(low), pixels(high));
        let columns = self.intervals(a.x, b.x);
        let rows = self.intervals(a.y, b.y);
        let mut sum = 0.0;
        for (block_row, row) in &rows {
            for (block_column, column) in &columns {
                let block = block_row * self.geometry.blocks() + block_column;
                sum += self.sum_block(blend, block, row, column);
            }
        }
        let area = (b - a).x * (b - a).y;
        (sum / area) as f32 * self.densities()
    }

    fn sum_block(&self, blend: &Blend, block: u32, rows: &Interval, columns: &Interval) -> f64 {
        const C: usize = MAX_RANK / 8;
        let arrays = Arrays::new(&self.parts);
        let mut sum = 0.0;
        let mut known = usize::MAX;
        let mut products = [f32x8::ZERO; C];
        for &(image, weight) in blend {
            let Some((index, row)) = self.find(image, block) else {
                continue;
            };
            let group = &arrays.group(index);
            if known != index {
                known = index;
                let scales: Components<C> = arrays.scales(group);
                let y: Components<C> = arrays.sum(group, 0, rows);
                let x: Components<C> = arrays.sum(group, 1, columns);
                products = std::array::from_fn(|c| scales[c] * y[c] * x[c]);
            }
            let share = dot(&products, &arrays.line(group, 2 * BLOCK + row)) * arrays.inverse_total(image);
            sum += f64::from(weight * share);
        }
        sum
    }

    /// The blocks that an interval of pixel coordinates meets (0 at the centre of the first pixel), with what counts of each.
    fn intervals(&self, a: f64, b: f64) -> Vec<(u32, Interval)> {
        let last = f64::from(self.geometry.resolution) - 1.0;
        // Tents reach one pixel beyond their centres.
        let first = (a - 1.0).floor().clamp(0.0, last) as usize;
        let end = ((b + 1.0).ceil().clamp(-1.0, last) + 1.0) as usize;
        let mut intervals = Vec::new();
        for block in first / BLOCK..end.div_ceil(BLOCK) {
            let pixels = first.max(block * BLOCK)..end.min((block + 1) * BLOCK);
            intervals.push((block as u32, Interval::new(a, b, pixels, block * BLOCK)));
        }
        intervals
    }

    // ---- sampling -------------------------------------------------------------------------------------------------------------

    /// A point of the disk's square from the density of one image. `u` choose a block; a row and the place in it; a column and
    /// the place in it. `None`: the image has no energy.
    pub fn sample(&self, image: u32, u: [f32; 3]) -> Option<Vec2> {
        let groups = self.groups_of(self.members.region[image as usize]);
        let masses = &self.parts.masses
            [self.starts[image as usize] as usize..self.starts[image as usize + 1] as usize];
        let all: u32 = masses.iter().map(|&m| u32::from(m)).sum();
        let unit = self.parts.totals[image as usize] / WHOLE;
        let mut pixels = [0.0; PIXELS];
        let mut uniform = u[0];
        for draw in 1..=MOST_DRAWS {
            let mut left = ((uniform * all as f32) as u32).min(all.checked_sub(1)?);
            let local = self.members.local[image as usize] as usize;
            let present = groups.clone().filter(|&g| has(self.mask(g), local));
            let mut chosen = None;
            for (index, &mass) in present.zip(masses) {
                if left < u32::from(mass) {
                    chosen = Some((index, mass));
                    break;
                }
                left -= u32::from(mass);
            }
            let (index, mass) = chosen?;
            let group = &self.group(index);
            self.reconstruct(group, rank_of(self.mask(index), local), &mut pixels);
            let rows = row_sums(&pixels);
            let sum: f32 = rows.iter().sum();
            let z = mix(u64::from(u[1].to_bits()) << 32 | u64::from(u[2].to_bits()) ^ (draw << 16));
            let random = |bits: u64| (bits & 0xff_ffff) as f32 / 16_777_216.0;
            if random(z) * f32::from(mass) * unit < sum {
                return Some(self.point(u32::from(group.block), &pixels, &rows, [u[1], u[2]]));
            }
            uniform = random(z >> 32);
        }
        None
    }

    /// A pixel of a block by its value, and a point of its tent.
    fn point(&self, block: u32, pixels: &[f32; PIXELS], rows: &[f32; BLOCK], [u, v]: [f32; 2]) -> Vec2 {
        let (row, u) = choose(rows, u);
        let (column, v) = choose(&pixels[row * BLOCK..][..BLOCK], v);
        let place = Vec2::new(column as f32 + tent(v), row as f32 + tent(u));
        self.geometry.corner(block) + (place + 0.5) * self.geometry.pixel()
    }

    fn groups_of(&self, region: u8) -> Range<usize> {
        let [first, end] = [0, 1].map(|next| self.regions[region as usize + next] as usize);
        first..end
    }

    /// What counts of all pixels of a block.
    pub fn reconstruct(&self, group: &Group, row: usize, pixels: &mut [f32; PIXELS]) {
        match self.chunks {
            1 => self.reconstruct_components::<1>(group, row, pixels),
            2 => self.reconstruct_components::<2>(group, row, pixels),
            4 => self.reconstruct_components::<4>(group, row, pixels),
            _ => self.reconstruct_components::<8>(group, row, pixels),
        }
    }

    fn reconstruct_components<const C: usize>(&self, group: &Group, row: usize, pixels: &mut [f32; PIXELS]) {
        /// Rows at a time: with two vectors of sums each, as many as registers hold.
        const ROWS: usize = 4;
        let arrays = Arrays::new(&self.parts);
        let scales: Components<C> = arrays.scales(group);
        let z: Components<C> = arrays.line(group, 2 * BLOCK + row);
        // Sixteen columns of one component side by side.
        let mut x = [[[f32x8::ZERO; 2]; 8]; C];
        for half in 0..2 {
            let columns: [Components<C>; 8] =
                std::array::from_fn(|column| arrays.factor(group, 1, 8 * half + column));
            for (c, x) in x.iter_mut().enumerate() {
                let columns = f32x8::transpose(columns.map(|column| column[c]));
                x.iter_mut().zip(columns).for_each(|(x, values)| x[half] = values);
            }
        }
        for (block, pixels) in pixels.chunks_exact_mut(ROWS * BLOCK).enumerate() {
            let y: [[[f32; 8]; C]; ROWS] = std::array::from_fn(|i| {
                let y: Components<C> = arrays.factor(group, 0, ROWS * block + i);
                std::array::from_fn(|c| (scales[c] * z[c] * y[c]).to_array())
            });
            let mut sums = [[f32x8::ZERO; 2]; ROWS];
            for c in 0..C {
                for (lane, x) in x[c].iter().enumerate() {
                    for (sums, y) in sums.iter_mut().zip(&y) {
                        let y = f32x8::splat(y[c][lane]);
                        sums[0] = y.mul_add(x[0], sums[0]);
                        sums[1] = y.mul_add(x[1], sums[1]);
                    }
                }
            }
            for (half, sum) in sums.iter().flatten().enumerate() {
                pixels[8 * half..8 * half + 8].copy_from_slice(&sum.max(f32x8::ZERO).to_array());
            }
        }
    }

    /// Stores masses and totals, which follow from the rest.
    pub fn weigh(&mut self) {
        let images = self.geometry.images as usize;
        let mut sums = vec![Vec::new(); images];
        let mut pixels = [0.0; PIXELS];
        let members = Members::new(&self.geometry);
        for (index, group) in self.groups().enumerate() {
            let present = members.images[group.region as usize]
                .iter()
                .enumerate()
                .filter(|&(local, _)| has(self.mask(index), local));
            for (row, (_, &image)) in present.enumerate() {
                self.reconstruct(&group, row, &mut pixels);
                sums[image as usize].push(row_sums(&pixels).iter().sum::<f32>());
            }
        }
        let totals: Vec<f32> = sums
            .iter()
            .map(|sums| sums.iter().map(|&s| f64::from(s)).sum::<f64>() as f32)
            .collect();
        let masses: Vec<u16> = sums
            .iter()
            .zip(&totals)
            .flat_map(|(sums, &total)| sums.iter().map(move |&sum| mass(sum, total)))
            .collect();
        self.parts.masses = masses.into();
        self.parts.totals = totals.into();
    }
}

/// The sum of each row of a block.
fn row_sums(pixels: &[f32; PIXELS]) -> [f32; BLOCK] {
    let eight = |at: usize| f32x8::from(std::array::from_fn(|k| pixels[at + k]));
    let half = |first: usize| {
        sums(std::array::from_fn(|row| {
            let at = (first + row) * BLOCK;
            eight(at) + eight(at + 8)
        }))
    };
    let (upper, lower) = (half(0).to_array(), half(8).to_array());
    std::array::from_fn(|row| if row < 8 { upper[row] } else { lower[row - 8] })
}

/// A block's share of its image, rounded up.
fn mass(sum: f32, total: f32) -> u16 {
    if sum <= 0.0 {
        return 0;
    }
    // A little more, so that rounding never makes the product with the unit smaller than the sum.
    let exact = f64::from(sum) / f64::from(total) * f64::from(WHOLE);
    (exact * (1.0 + 1e-6)).ceil().min(f64::from(WHOLE)) as u16
}

#[inline]
fn has(mask: &[u64], bit: usize) -> bool {
    mask[bit / 64] >> (bit % 64) & 1 == 1
}

/// Bits set before `bit`.
#[inline]
fn rank_of(mask: &[u64], bit: usize) -> usize {
    let whole: u32 = mask[..bit / 64].iter().map(|word| word.count_ones()).sum();
    (whole + (mask[bit / 64] & ((1 << (bit % 64)) - 1)).count_ones()) as usize
}

/// An index drawn with its value as probability, and a uniform number of what is left of `u`.
fn choose(values: &[f32], u: f32) -> (usize, f32) {
    let sum: f32 = values.iter().sum();
    let mut left = u * sum;
    let mut last = (0, 0.5);
    for (i, &value) in values.iter().enumerate() {
        if value > 0.0 {
            if left < value {
                return (i, (left / value).clamp(0.0, 1.0));
            }
            last = (i, 1.0);
        }
        left -= value;
    }
    last
}

/// The inverse distribution function of the tent over [-1, 1].
fn tent(u: f32) -> f32 {
    if u < 0.5 {
        (2.0 * u).sqrt() - 1.0
    } else {
        1.0 - (2.0 * (1.0 - u)).max(0.0).sqrt()
    }
}

/// Integral of a tent at zero up to x.
fn tent_integral(x: f64) -> f64 {
    let x = x.clamp(-1.0, 1.0);
    if x < 0.0 {
        0.5 * (1.0 + x).powi(2)
    } else {
        1.0 - 0.5 * (1.0 - x).powi(2)
    }
}

impl Interval {
    /// What counts of `pixels`, numbered from `origin` on, over `[a, b]`.
    fn new(a: f64, b: f64, pixels: Range<usize>, origin: usize) -> Self {
        let mut interval = Self {
            whole: pixels.start - origin..pixels.start - origin,
            ..Self::default()
        };
        for pixel in pixels {
            let i = pixel as f64;
            if a <= i - 1.0 && i + 1.0 <= b {
                if interval.whole.is_empty() {
                    interval.whole.start = pixel - origin;
                }
                interval.whole.end = pixel - origin + 1;
            } else {
                let weight = tent_integral(b - i) - tent_integral(a - i);
                if weight > 0.0 && !interval.parts.is_full() {
                    interval.parts.push((pixel - origin, weight as f32));
                }
            }
        }
        interval
    }
}

#[inline]
fn dot<const C: usize>(a: &Components<C>, b: &Components<C>) -> f32 {
    product(a, b).reduce_add()
}

/// Lanes of a scalar product.
#[inline]
fn product<const C: usize>(a: &Components<C>, b: &Components<C>) -> f32x8 {
    let mut sum = f32x8::ZERO;
    for c in 0..C {
        sum = a[c].mul_add(b[c], sum);
    }
    sum
}

/// The sum of each vector.
#[inline]
fn sums(vectors: [f32x8; 8]) -> f32x8 {
    let [a, b, c, d, e, f, g, h] = f32x8::transpose(vectors);
    ((a + b) + (c + d)) + ((e + f) + (g + h))
}

/// The arrays that queries read. Where a file is mapped, every look at an array checks its alignment: once a query is enough.
#[derive(Clone, Copy)]
struct Arrays<'a> {
    groups: &'a [[u32; 3]],
    factors: &'a [i8],
    scales: &'a [u16],
    totals: &'a [f32],
}

impl<'a> Arrays<'a> {
    #[inline]
    fn new(parts: &'a Parts) -> Self {
        Self {
            groups: &parts.groups,
            factors: &parts.factors,
            scales: &parts.scales,
            totals: &parts.totals,
        }
    }

    #[inline]
    fn group(&self, index: usize) -> Group {
        Group::unpacked(self.groups[index])
    }

    /// One over an image's total; zero for one without energy.
    #[inline]
    fn inverse_total(&self, image: u32) -> f32 {
        let total = self.totals[image as usize];
        if total > 0.0 { 1.0 / total } else { 0.0 }
    }

    /// `C_r`; beyond the rank zero, as stored or here, so that no other factor has to end there.
    #[inline]
    fn scales<const C: usize>(&self, group: &Group) -> Components<C> {
        let values = &self.scales[group.scales as usize..][..8 * C];
        std::array::from_fn(|c| {
            if 8 * c >= group.rank as usize {
                return f32x8::ZERO;
            }
            f32x8::from(std::array::from_fn(|k| scale(values[8 * c + k])))
        })
    }

    /// Line `line` of a group's factors, as integers.
    #[inline]
    fn integers<const C: usize>(&self, group: &Group, line: usize) -> [[i8; 8]; C] {
        let first = group.factors as usize + line * group.rank as usize;
        let values = &self.factors[first..][..8 * C];
        std::array::from_fn(|c| std::array::from_fn(|k| values[8 * c + k]))
    }

    /// The same as numbers.
    #[inline]
    fn line<const C: usize>(&self, group: &Group, line: usize) -> Components<C> {
        self.integers(group, line)
            .map(|values: [i8; 8]| f32x8::from(values.map(f32::from)))
    }

    /// `Y(i)` (axis 0) or `X(i)` (axis 1).
    #[inline]
    fn factor<const C: usize>(&self, group: &Group, axis: usize, i: usize) -> Components<C> {
        self.line(group, axis * BLOCK + i)
    }

    /// `C_r Y_r(i) X_r(j)` for the pixels of a corner: two rows of two columns.
    #[inline]
    fn multiply<const C: usize>(&self, group: &Group, corner: &Corner, products: &mut [Components<C>; 4]) {
        let scales: Components<C> = self.scales(group);
        let mut x = [[f32x8::ZERO; C]; 2];
        for (j, x) in x.iter_mut().enumerate().take(corner.columns.count) {
            *x = self.factor(group, 1, corner.columns.first + j);
        }
        for i in 0..corner.rows.count {
            let y: Components<C> = self.factor(group, 0, corner.rows.first + i);
            for j in 0..2 {
                products[2 * i + j] = std::array::from_fn(|c| scales[c] * y[c] * x[j][c]);
            }
        }
    }

    /// The weighted sum of `Y` or `X` over an interval.
    #[inline]
    fn sum<const C: usize>(&self, group: &Group, axis: usize, interval: &Interval) -> Components<C> {
        let mut integers = [[0_i16; 8]; C];
        for i in interval.whole.clone() {
            for (sums, values) in integers
                .iter_mut()
                .zip(self.integers::<C>(group, axis * BLOCK + i))
            {
                for (sum, value) in sums.iter_mut().zip(values) {
                    *sum += i16::from(value);
                }
            }
        }
        let mut sum = integers.map(|sums| f32x8::from(sums.map(f32::from)));
        for &(i, weight) in &interval.parts {
            let factor: Components<C> = self.factor(group, axis, i);
            for c in 0..C {
                sum[c] += factor[c] * f32x8::splat(weight);
            }
        }
        sum
    }
}
