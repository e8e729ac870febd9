//! Counts of texels by direction, for squares of texels of several sizes: what a footprint holds entirely.
//!
//! **Computes** For a node of the [`super::cover::Tree`], how many of its texels have their normal in each bin: an integral
//! histogram, like the inverse bin map, but only where a node has about as many texels as there are bins, so that it costs
//! less than the texels. Bins are squares of equal solid angle over Lambert's projection `X = (x, y) / sqrt(1 + z)`, which
//! maps the hemisphere to the unit disk; a projected hemisphere has bins that get too long as normals tilt.
//!
//! **Two moments are exact.** Bins of width w move a normal by up to w / 2. Here a texel's bin is found after adding
//! triangular noise of +-w to its position, from a hash of the texel: over texels, the bins' centres then have the mean of
//! the normals and their covariance plus `w^2 / 4`, wherever in their bins the normals lie (a bin is drawn with the
//! probability of a quadratic B-spline, which reproduces polynomials of degree two). The bins' lobes are narrower by just
//! that variance: `alpha_b^2 = alpha^2 - 2 w^2 / (1 + z)` along the tilt, `alpha^2 - w^2 (1 + z) / 2` across it. What is left
//! is noise, about `0.5 / sqrt(n)` where n lobes overlap. Uniform noise is quieter, but what it adds to the covariance depends
//! on where in its bin a normal lies: of a map of flakes, most of whose texels share few normals, it left errors of 5 %.
//!
//! **Layout** One array a level, nodes row by row, bins of a node row by row, of the narrowest whole numbers that hold the
//! level's largest count.

use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use wide::{CmpLe, f32x8};

use super::cover::{Node, Tree};
use super::grid::Grid;
use super::lanes::{LANES, to_float, widened};
use super::lobes::{Lobe, Normals, Sums};
use crate::array::{Array, prefetch};

/// Width of a bin in standard deviations of a lobe, `alpha / sqrt 2`; the paper has 1.2 (Eq. 16 of Atanasov et al. 2021).
/// Wider ones show through the lobes that are left.
const BIN_WIDTH: f64 = 0.7;

/// The same for flakes rougher than [`CURVED`], over whose lobes the projection is not linear: what is left of that grows
/// with the square of the width.
const NARROW_BIN_WIDTH: f64 = 0.5;
const CURVED: f32 = 0.1;

/// The same where more than a share [`CONCENTRATED`] of a map's texels is within reach of each other: no other lobes hide by how
/// much a lobe's shape differs from that of its bins' lobes.
const CONCENTRATED_BIN_WIDTH: f64 = 0.6;
pub const CONCENTRATED: f64 = 0.2;

/// Least share of the squared roughness that a bin's lobe keeps.
const LEAST_SHARE: f32 = 0.2;

/// Width in bins of the margin around what is counted: one for the noise, and a little because bounds are those of normals
/// before they are quantised.
const MARGIN: f64 = 1.25;

/// A level of fewer nodes is counted by all threads, node by node.
const FEW_NODES: usize = 16;

/// Numbers after the end of a level that a query may read and ignore.
pub const PADDING: usize = 32;

/// Bins along a side of the squares over which distributions are compared.
const SQUARE: usize = 4;

/// Texels that tell how much the map's quarters deviate, if nothing else does.
const SPARSE: u32 = 1 << 17;

/// Bound of the relative deviation of a node's part from the node.
pub const LARGEST_DEVIATION: f64 = 1.0;

/// See the module.
pub struct Counts {
    bins: Grid,
    alpha2: f32,
    /// Level by level, finest first; levels below the finest kept one are absent.
    levels: Vec<Option<Level>>,
}

/// Counts of the nodes of one level.
pub enum Level {
    U8(Array<u8>),
    U16(Array<u16>),
    U32(Array<u32>),
}

impl Level {
    pub fn bytes(&self) -> usize {
        match self {
            Self::U8(counts) => counts.bytes(),
            Self::U16(counts) => counts.bytes(),
            Self::U32(counts) => counts.bytes(),
        }
    }

    #[inline]
    fn prefetch(&self, start: usize, count: usize) {
        let range = start..start + count;
        match self {
            Self::U8(counts) => prefetch(counts, range),
            Self::U16(counts) => prefetch(counts, range),
            Self::U32(counts) => prefetch(counts, range),
        }
    }

    #[inline]
    fn get(&self, index: usize) -> u32 {
        match self {
            Self::U8(counts) => counts[index].into(),
            Self::U16(counts) => counts[index].into(),
            Self::U32(counts) => counts[index],
        }
    }
}

/// Lambert's projection of the hemisphere to the unit disk; areas are half of solid angles.
#[inline]
pub fn project(normal: Vec3) -> Vec2 {
    normal.truncate() / (1.0 + normal.z).sqrt()
}

/// Where the projection of a normal lies, in bins.
#[inline]
fn position(bins: &Grid, normal: Vec3) -> Vec2 {
    (project(normal) - bins.low) / bins.pitch
}

/// Width of the bins over the projection for a map of whose texels `share` are within reach of each other.
pub fn bin_width(alpha: f32, share: f64) -> f64 {
    let width = if alpha > CURVED {
        NARROW_BIN_WIDTH
    } else if share > CONCENTRATED {
        CONCENTRATED_BIN_WIDTH
    } else {
        BIN_WIDTH
    };
    width * f64::from(alpha) / std::f64::consts::SQRT_2
}

/// Whether bins have a width that flakes of roughness `alpha` may have.
pub fn is_width(width: f32, alpha: f32) -> bool {
    [0.0, 1.0]
        .iter()
        .any(|&share| width == bin_width(alpha, share) as f32)
}

/// The bins of normals whose projections lie between two bounds: of this width, with a margin on each side.
pub fn bins(width: f64, bounds: (Vec2, Vec2)) -> Grid {
    let margin = (MARGIN * width) as f32;
    Grid::covering((bounds.0 - margin, bounds.1 + margin), width)
}

impl Counts {
    /// Counts the texels of all nodes of the levels from `finest` up; `normal` is that of a texel, as it is queried later, or
    /// `None` if it is not counted.
    pub fn new(
        tree: &Tree,
        bins: Grid,
        alpha: f32,
        finest: usize,
        normal: impl Fn(u32, u32) -> Option<Vec3> + Sync,
    ) -> Self {
        let mut counts = Self::from_levels(bins, alpha, Vec::new());
        counts.levels.resize_with(finest.min(tree.levels()), || None);
        if finest >= tree.levels() {
            return counts;
        }
        let stride = counts.stride();
        let base = level(tree, finest, stride, |node, histogram| {
            let rect = tree.rect(node);
            let count_row = |row: u32, increment: &dyn Fn(&AtomicU32)| {
                for column in rect.low.0..rect.high.0 {
                    if let Some(normal) = normal(column, row) {
                        increment(&histogram[counts.bin(normal, (column, row))]);
                    }
                }
            };
            let rows = rect.low.1..rect.high.1;
            if tree.nodes(finest) < FEW_NODES {
                rows.into_par_iter().for_each(|row| {
                    count_row(row, &|count| {
                        count.fetch_add(1, Relaxed);
                    })
                });
            } else {
                rows.for_each(|row| count_row(row, &|count| add(count, 1)));
            }
        });
        counts.levels.push(Some(base));
        for index in finest + 1..tree.levels() {
            let finer = counts.levels[index - 1].as_ref().expect("the finer level");
            let coarser = level(tree, index, stride, |node, histogram| {
                for child in tree.children(node) {
                    let start = tree.index(&child) * stride;
                    for (bin, sum) in histogram.iter().enumerate() {
                        add(sum, finer.get(start + bin));
                    }
                }
            });
            counts.levels.push(Some(coarser));
        }
        counts
    }

    pub fn from_levels(bins: Grid, alpha: f32, levels: Vec<Option<Level>>) -> Self {
        Self {
            bins,
            alpha2: alpha * alpha,
            levels,
        }
    }

    pub fn bins(&self) -> &Grid {
        &self.bins
    }

    pub fn levels(&self) -> &[Option<Level>] {
        &self.levels
    }

    /// Whether the nodes of a level have counts.
    #[inline]
    pub fn has(&self, level: usize) -> bool {
        self.levels.get(level).is_some_and(Option::is_some)
    }

    pub fn bytes(&self) -> usize {
        self.levels.iter().flatten().map(Level::bytes).sum()
    }

    /// How much the distribution of a node's part deviates from the node's, relatively, for the nodes of each level: that of
    /// its quarters, over squares of bins about as large as a lobe. Quarters that have no counts are taken to deviate twice
    /// as much as those of the next level, as by chance. Where only the root has counts, `normal`, that of a texel, tells.
    pub fn deviations(&self, tree: &Tree, normal: impl Fn((u32, u32)) -> Vec3) -> Vec<f64> {
        let mut deviations = vec![LARGEST_DEVIATION; tree.levels()];
        let mut below = LARGEST_DEVIATION;
        for (index, deviation) in deviations.iter_mut().enumerate().skip(1) {
            let measured = match (self.levels.get(index - 1), self.levels.get(index)) {
                (Some(Some(finer)), Some(Some(level))) => self.deviation(tree, index, level, finer),
                (_, Some(Some(_))) if index == tree.levels() - 1 => self.deviation_of_root(tree, &normal),
                _ => continue,
            };
            // Nodes without halves, as of a long map, deviate no more than the finer ones.
            below = measured.unwrap_or(below).min(LARGEST_DEVIATION);
            *deviation = below;
        }
        for index in (0..tree.levels() - 1)
            .rev()
            .filter(|&index| index == 0 || !self.has(index - 1))
        {
            deviations[index] = (2.0 * deviations[index + 1]).min(LARGEST_DEVIATION);
        }
        deviations
    }

    /// From the counts of some nodes of a level and of their quarters.
    fn deviation(&self, tree: &Tree, index: usize, level: &Level, finer: &Level) -> Option<f64> {
        let nodes = tree.nodes(index);
        // Few nodes tell; a prime number of nodes apart, so that no pattern of the map is met.
        let step = [1, 3, 7, 17, 61, 251]
            .into_iter()
            .rfind(|step| step * 64 <= nodes)
            .unwrap_or(1);
        let sums: Vec<[[f64; 2]; 2]> = (0..nodes.div_ceil(step))
            .into_par_iter()
            .map(|k| {
                let node = tree.node(index, k * step);
                let whole = self.squares(level, tree.index(&node));
                let children: Vec<(Node, Vec<f64>)> = tree
                    .children(&node)
                    .map(|child| (child, self.squares(finer, tree.index(&child))))
                    .collect();
                tree.halves(&node).map(|half| {
                    let Some(half) = half else { return [0.0; 2] };
                    let inside = children
                        .iter()
                        .filter(|(child, _)| half.has(tree.rect(child).low));
                    let mut part = vec![0.0; whole.len()];
                    for (_, squares) in inside {
                        part.iter_mut()
                            .zip(squares)
                            .for_each(|(sum, count)| *sum += count);
                    }
                    let apart = |(part, whole): (&f64, &f64)| (part / half.share - whole).abs();
                    let sum: f64 = part.iter().zip(&whole).map(apart).sum();
                    [sum * half.by_chance(), whole.iter().sum()]
                })
            })
            .collect();
        of_quarters([0, 1].map(|axis| {
            let total = |k: usize| sums.iter().map(|sum| sum[axis][k]).sum::<f64>();
            (total(1) > 0.0).then(|| total(0) / total(1))
        }))
    }

    /// From some of the map's texels, in no order. What they deviate more than by chance the map does too; chance is that of all texels.
    pub fn deviation_of_root(&self, tree: &Tree, normal: impl Fn((u32, u32)) -> Vec3) -> Option<f64> {
        let root = tree.root();
        let rect = tree.rect(&root);
        let halves = tree.halves(&root);
        // Of each square: its texels, and those in the left and in the upper half.
        let mut squares = vec![[0.0_f64; 3]; self.square_count()];
        for k in 0..SPARSE {
            let place = |bits: u32, side: u32| ((u64::from(bits) * u64::from(side)) >> 32) as u32;
            let texel = (place(hash(k, 0), rect.high.0), place(hash(k, 1), rect.high.1));
            let normal = normal(texel);
            if !Self::holds(&self.bins, normal) {
                continue;
            }
            let bin = position(&self.bins, normal);
            let square = &mut squares[self.square(bin.x as usize, bin.y as usize)];
            square[0] += 1.0;
            for (count, half) in square[1..].iter_mut().zip(&halves) {
                *count += f64::from(half.as_ref().is_some_and(|half| half.has(texel)));
            }
        }
        squares.retain(|square| square[0] > 0.0);
        let count: f64 = squares.iter().map(|square| square[0]).sum();
        let by_chance = squares.len() as f64 / rect.area();
        let [left, upper] = halves;
        of_quarters([(1, left), (2, upper)].map(|(axis, half)| {
            let half = half?;
            let excess = |square: &[f64; 3]| {
                let apart = (square[axis] / half.share - square[0]) * half.by_chance();
                apart * apart / square[0] - 1.0
            };
            let excess = squares.iter().map(excess).sum::<f64>() / count;
            Some((excess.max(0.0) + by_chance).sqrt())
        }))
    }

    /// Mean density of the map's normals per solid angle at the normals themselves, over squares of bins; of none, zero.
    pub fn mean_density(&self, tree: &Tree) -> f64 {
        let Some(Some(level)) = self.levels.get(tree.levels() - 1) else {
            return 0.0;
        };
        let squares = self.squares(level, 0);
        let count: f64 = squares.iter().sum();
        let squared: f64 = squares.iter().map(|count| count * count).sum();
        let solid_angle = 2.0 * (SQUARE as f64 * f64::from(self.bins.pitch)).powi(2);
        squared / (count * count).max(1.0) / solid_angle
    }

    /// Counts of a node over squares of bins.
    fn squares(&self, level: &Level, node: usize) -> Vec<f64> {
        let [columns, rows] = self.bins.size.map(|side| side as usize);
        let mut sums = vec![0.0; self.square_count()];
        for (y, x) in (0..rows).flat_map(|y| (0..columns).map(move |x| (y, x))) {
            let count = level.get(node * self.stride() + y * columns + x);
            sums[self.square(x, y)] += f64::from(count);
        }
        sums
    }

    /// The number of squares of bins.
    fn square_count(&self) -> usize {
        let [columns, rows] = self.bins.size.map(|side| (side as usize).div_ceil(SQUARE));
        columns * rows
    }

    /// The square that holds the bin in a column and row.
    #[inline]
    fn square(&self, column: usize, row: usize) -> usize {
        row / SQUARE * (self.bins.size[0] as usize).div_ceil(SQUARE) + column / SQUARE
    }

    fn stride(&self) -> usize {
        self.bins.size[0] as usize * self.bins.size[1] as usize
    }

    /// Whether noise leaves a normal inside the bins.
    #[inline]
    pub fn holds(bins: &Grid, normal: Vec3) -> bool {
        let position = position(bins, normal);
        let size = Vec2::new(bins.size[0] as f32, bins.size[1] as f32);
        position.cmpge(Vec2::ONE).all() && position.cmple(size - 1.0).all()
    }

    /// The bin of a texel.
    #[inline]
    fn bin(&self, normal: Vec3, (column, row): (u32, u32)) -> usize {
        let [x, y] = self.noisy_cell(normal, (column, row));
        y as usize * self.bins.size[0] as usize + x as usize
    }

    #[inline]
    fn noisy_cell(&self, normal: Vec3, (column, row): (u32, u32)) -> [u32; 2] {
        let hash = hash(column, row);
        let position = position(&self.bins, normal);
        let triangular = |bits: u32| ((bits & 0xff) + (bits >> 8 & 0xff)) as f32 / 256.0 - 255.0 / 256.0;
        let noise = [triangular(hash), triangular(hash >> 16)];
        std::array::from_fn(|axis| ((position[axis] + noise[axis]) as u32).min(self.bins.size[axis] - 1))
    }

    /// Draws a half vector of the lobe that stands for a texel where its node is counted.
    pub fn sample(&self, lobe: &Lobe, normal: Vec3, texel: (u32, u32), u: [f32; 2]) -> Option<Vec3> {
        let [x, y] = self.noisy_cell(normal, texel);
        let axis = |axis, cell: u32| self.bins.middle(axis, f32x8::splat(cell as f32));
        let Bins {
            t,
            along,
            across,
            shares,
        } = self.lobes(axis(0, x), axis(1, y));
        let first =
            |[x, y, z]: [f32x8; 3]| Vec3::new(x.as_array_ref()[0], y.as_array_ref()[0], z.as_array_ref()[0]);
        let root = |share: f32x8| share.as_array_ref()[0].sqrt();
        let axes = [first(along) * root(shares[0]), first(across) * root(shares[1])];
        let m = lobe.sample_along(first([t.x, t.y, t.z]), axes, u);
        (m.z > 0.0).then_some(m)
    }

    /// The lobes of bins around projections `(x, y)`. Bins across the rim are moved inside, to about the middle of what lies
    /// on the hemisphere.
    #[inline]
    fn lobes(&self, x: f32x8, y: f32x8) -> Bins {
        let limit = 1.0 - 0.3 * self.bins.pitch.min(1.0);
        let radius2 = x.mul_add(x, y * y).fast_max(f32x8::splat(1e-12));
        let radius = radius2.sqrt();
        let (cos, sin) = (x / radius, y / radius);
        let radius = radius.fast_min(f32x8::splat(limit));
        let z = 1.0 - radius * radius;
        let sine = radius * (1.0 + z).sqrt();
        let taken = 0.5 * self.bins.pitch * self.bins.pitch / self.alpha2;
        let share = |taken: f32x8| (1.0 - taken).fast_max(f32x8::splat(LEAST_SHARE));
        Bins {
            t: Normals {
                x: cos * sine,
                y: sin * sine,
                z,
            },
            along: [cos * z, sin * z, -sine],
            across: [-sin, cos, f32x8::ZERO],
            shares: [share(4.0 * taken / (1.0 + z)), share((1.0 + z) * taken)],
        }
    }
}

/// The lobes of eight bins.
struct Bins {
    t: Normals,
    /// Unit vectors across t, along and across its tilt.
    along: [f32x8; 3],
    across: [f32x8; 3],
    /// Shares of the squared roughness along these axes.
    shares: [f32x8; 2],
}

/// Weighted counts of the bins within reach of a half vector.
pub struct CountSum<'a> {
    counts: &'a Counts,
    first: (usize, usize),
    rows: usize,
    /// Groups of eight.
    columns: usize,
    /// Row by row. A Beckmann lobe reaches at most 16 rows, and one of GGX 40.
    sums: Vec<f32x8>,
    /// Nodes whose counts are on their way from memory: level, first count, weight.
    asked: [(usize, usize, f32); BATCH],
    asked_len: usize,
}

const BATCH: usize = 16;

impl<'a> CountSum<'a> {
    pub fn new(counts: &'a Counts, half: Vec3, reach: f32) -> Self {
        let bins = &counts.bins;
        let projection = project(half);
        // Across the tilt, angles are longest in the projection.
        let mut reach = reach / (1.0 + half.z - reach).max(1.0).sqrt() / bins.pitch;
        // Lobes of bins across the rim stand up to two bins further inside.
        if projection.length() / bins.pitch + reach + 1.0 > 1.0 / bins.pitch {
            reach += 2.0;
        }
        let range = |axis: usize| {
            let center = (projection[axis] - bins.low[axis]) / bins.pitch - 0.5;
            let first = (center - reach).ceil().max(0.0) as usize;
            let end = ((center + reach).floor() + 1.0).max(0.0) as usize;
            first..end.min(bins.size[axis] as usize)
        };
        let (columns, rows) = (range(0), range(1));
        let groups = columns.len().div_ceil(8);
        Self {
            counts,
            first: (columns.start, rows.start),
            rows: rows.len(),
            columns: groups,
            sums: vec![f32x8::ZERO; rows.len() * groups],
            asked: [(0, 0, 0.0); BATCH],
            asked_len: 0,
        }
    }

    /// Adds the counts of a node, each times `weight`.
    #[inline]
    pub fn add(&mut self, tree: &Tree, node: &Node, weight: f32) {
        let Some(level) = &self.counts.levels[node.level] else {
            return;
        };
        // No bin is within reach: the window may begin behind the last one.
        if self.rows == 0 || self.columns == 0 {
            return;
        }
        let stride = self.counts.bins.size[0] as usize;
        let start = tree.index(node) * self.counts.stride() + self.first.1 * stride + self.first.0;
        for row in 0..self.rows {
            level.prefetch(start + row * stride, 8 * self.columns);
        }
        self.asked[self.asked_len] = (node.level, start, weight);
        self.asked_len += 1;
        if self.asked_len == BATCH {
            self.read();
        }
    }

    fn read(&mut self) {
        let stride = self.counts.bins.size[0] as usize;
        for index in 0..self.asked_len {
            let (level, start, weight) = self.asked[index];
            let weight = f32x8::splat(weight);
            match &self.counts.levels[level] {
                Some(Level::U8(counts)) => self.add_rows(&counts[start..], stride, weight),
                Some(Level::U16(counts)) => self.add_rows(&counts[start..], stride, weight),
                Some(Level::U32(counts)) => self.add_rows(&counts[start..], stride, weight),
                None => {}
            }
        }
        self.asked_len = 0;
    }

    #[inline]
    fn add_rows<T: Copy + Into<u32>>(&mut self, counts: &[T], stride: usize, weight: f32x8) {
        for (row, sums) in self.sums.chunks_exact_mut(self.columns).enumerate() {
            for (column, sum) in sums.iter_mut().enumerate() {
                let start = row * stride + 8 * column;
                let eight: &[T; 8] = counts[start..start + 8].try_into().expect("eight counts");
                *sum = to_float(widened(eight)).mul_add(weight, *sum);
            }
        }
    }

    /// Adds the lobes of all bins.
    pub fn finish(&mut self, lobe: &Lobe, sums: &mut Sums) {
        self.read();
        let query = sums.query;
        let bins = &self.counts.bins;
        // Without columns there are no sums, but chunks must not be empty.
        for (row, weights) in self.sums.chunks_exact(self.columns.max(1)).enumerate() {
            let y = bins.middle(1, f32x8::splat((self.first.1 + row) as f32));
            for (column, &weights) in weights.iter().enumerate() {
                let columns = LANES + (self.first.0 + 8 * column) as f32;
                // Lanes beyond the last bin hold the next row's.
                let exists = columns.cmp_le(f32x8::splat(bins.size[0] as f32 - 1.0));
                let Bins {
                    t,
                    along,
                    across,
                    shares,
                } = self.counts.lobes(bins.middle(0, columns), y);
                let dot = |v: [f32x8; 3]| {
                    let h = query.half;
                    v[0].mul_add(f32x8::splat(h.x), v[1].mul_add(f32x8::splat(h.y), v[2] * h.z))
                };
                let cos = dot([t.x, t.y, t.z]).fast_max(f32x8::splat(1e-3));
                let (along, across) = (dot(along), dot(across));
                let slope2 = along * along / shares[0] + across * across / shares[1];
                let x = slope2 * lobe.sharpness();
                let weights = weights & exists & x.cmp_le(lobe.limit() * cos * cos);
                if weights == f32x8::ZERO {
                    continue;
                }
                let peak = lobe.peak() / (shares[0] * shares[1]).sqrt();
                sums.add_terms(&query.terms(x, peak, cos, &t), weights);
            }
        }
    }
}

/// How much quarters deviate, from left and upper halves, where there are any: `sqrt 3` times as much, which is right where texels
/// are independent. Where left and right halves deviate otherwise than upper and lower ones, streaks make neighbours alike: the
/// greater, times the root of its ratio to the lesser.
fn of_quarters(halves: [Option<f64>; 2]) -> Option<f64> {
    let [left, upper] = [halves[0].or(halves[1])?, halves[1].or(halves[0])?];
    let (greater, lesser) = (left.max(upper), left.min(upper));
    Some((3.0 * greater / lesser.max(1e-9)).sqrt() * greater)
}

/// Adds to a number that no other thread adds to.
#[inline(always)]
fn add(sum: &AtomicU32, number: u32) {
    sum.store(sum.load(Relaxed) + number, Relaxed);
}

/// Fills one level: `count` adds up a node's histogram.
fn level(tree: &Tree, index: usize, stride: usize, count: impl Fn(&Node, &[AtomicU32]) + Sync) -> Level {
    let nodes = tree.nodes(index);
    let histogram = |scratch: &mut Vec<AtomicU32>, k: usize| {
        scratch.clear();
        scratch.resize_with(stride, AtomicU32::default);
        count(&tree.node(index, k), scratch);
    };
    // The narrowest numbers fit as a rule: they are tried first, rather than counting twice.
    if let Some(counts) = fill(nodes, stride, &histogram) {
        Level::U8(counts.into())
    } else if let Some(counts) = fill(nodes, stride, &histogram) {
        Level::U16(counts.into())
    } else {
        let counts = fill(nodes, stride, &histogram);
        Level::U32(counts.expect("a node has less than 2^32 texels").into())
    }
}

/// The histograms of all nodes, if their numbers are wide enough.
fn fill<T: Copy + Default + Send + TryFrom<u32>>(
    nodes: usize,
    stride: usize,
    histogram: &(impl Fn(&mut Vec<AtomicU32>, usize) + Sync),
) -> Option<Vec<T>> {
    let mut counts = vec![T::default(); nodes * stride + PADDING];
    counts[..nodes * stride]
        .par_chunks_mut(stride)
        .enumerate()
        .try_for_each_init(Vec::new, |scratch, (k, counts)| {
            histogram(scratch, k);
            for (narrowed, count) in counts.iter_mut().zip(scratch.iter()) {
                *narrowed = T::try_from(count.load(Relaxed)).ok()?;
            }
            Some(())
        })?;
    Some(counts)
}

/// Bits of a texel that look random: the finaliser of MurmurHash3.
#[inline]
fn hash(column: u32, row: u32) -> u32 {
    let mut h = column ^ row.wrapping_mul(0x9e37_79b1);
    h = (h ^ h >> 16).wrapping_mul(0x85eb_ca6b);
    h = (h ^ h >> 13).wrapping_mul(0xc2b2_ae35);
    h ^ h >> 16
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flakes::{FlakeModel, Normalization};
    use crate::methods::compact::grid;
    use crate::methods::compact::lobes::Query;
    use crate::methods::compact::tests::random_map;
    use crate::microfacet::{Distribution, Flake};

    /// Over all of a map from the bins within `reach`, of so many rows: value and density at a half vector.
    fn query(
        counts: &Counts,
        tree: &Tree,
        (model, lobe): (&FlakeModel, &Lobe),
        half: Vec3,
        (reach, rows): (f32, usize),
    ) -> (f32, f32) {
        let mut sums = Sums::new(Query::distribution(model, half), *lobe, counts.bins);
        let mut sum = CountSum::new(counts, half, reach);
        sum.rows = sum.rows.min(rows);
        sum.sums.truncate(sum.rows * sum.columns);
        sum.add(tree, &tree.root(), 1.0 / tree.rect(&tree.root()).area() as f32);
        sum.finish(lobe, &mut sums);
        let found = sums.totals(1.0);
        (found.value, found.density)
    }

    const ALL: usize = usize::MAX;

    fn half_vector(cos: f32, phi: f32) -> Vec3 {
        let sin = (1.0 - cos * cos).sqrt();
        Vec3::new(sin * phi.cos(), sin * phi.sin(), cos)
    }

    #[test]
    fn no_lobe_reaches_further_than_the_window() {
        // Slopes of 20: many bins across the rim.
        for (kind, slope) in [
            (Distribution::Beckmann, 0.4),
            (Distribution::Ggx, 0.4),
            (Distribution::Ggx, 20.0),
        ] {
            let map = random_map(64, 64, slope, 5);
            for alpha in [0.03, 0.05, 0.0999, 0.1001, 0.11, 0.2, 0.4, 1.0] {
                let model = FlakeModel {
                    flake: Flake::new(kind, alpha).unwrap(),
                    normalization: Normalization::Paper,
                };
                let lobe = Lobe::new(kind, f64::from(alpha).powi(2));
                let tree = Tree::new((64, 64), 6);
                let bins = bins(bin_width(alpha, 0.0), grid::bounds(&map, project));
                let counts = Counts::new(&tree, bins, alpha, 0, |column, row| Some(map.normal(column, row)));
                let mut twin = 0.0_f32;
                for k in 0..200 {
                    let half = half_vector((k as f32 + 0.5) / 200.0, 2.4 * k as f32);
                    let (_, found) = query(&counts, &tree, (&model, &lobe), half, (lobe.reach(), ALL));
                    let (_, all) = query(&counts, &tree, (&model, &lobe), half, (4.0, ALL));
                    assert!(
                        (found - all).abs() <= 1e-5 * all,
                        "{kind:?} alpha {alpha} z {}: {found} of {all}",
                        half.z
                    );
                    let (_, cut) = query(&counts, &tree, (&model, &lobe), half, (lobe.reach(), 24));
                    twin = twin.max(if all > 1e-3 { 1.0 - cut / all } else { 0.0 });
                }
                if kind == Distribution::Ggx && slope == 20.0 && alpha == 0.11 {
                    // The broken twin: twenty-four rows of bins.
                    assert!(twin > 0.01, "{twin}");
                }
            }
        }
    }

    #[test]
    fn the_density_of_counts_integrates_to_one() {
        let map = random_map(64, 64, 0.4, 5);
        let tree = Tree::new((64, 64), 6);
        for kind in [Distribution::Beckmann, Distribution::Ggx] {
            for alpha in [0.05, 0.0999, 0.11, 0.16] {
                let model = FlakeModel {
                    flake: Flake::new(kind, alpha).unwrap(),
                    normalization: Normalization::Projected,
                };
                let lobe = Lobe::new(kind, f64::from(alpha).powi(2));
                let bins = bins(bin_width(alpha, 0.0), grid::bounds(&map, project));
                let counts = Counts::new(&tree, bins, alpha, 0, |column, row| Some(map.normal(column, row)));
                // Midpoints of squares of equal solid angle.
                const SIDE: usize = 400;
                let whole = {
                    let density = |i: usize| {
                        let at = |k: usize| (k as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0;
                        let p = Vec2::new(at(i % SIDE), at(i / SIDE));
                        let z = 1.0 - p.length_squared();
                        if z <= 0.0 {
                            return 0.0;
                        }
                        let half = (p * (1.0 + z).sqrt()).extend(z);
                        f64::from(query(&counts, &tree, (&model, &lobe), half, (lobe.reach(), ALL)).1)
                    };
                    (0..SIDE * SIDE).map(density).sum::<f64>() * 8.0 / (SIDE * SIDE) as f64
                };
                assert!((whole - 1.0).abs() < 1e-3, "{kind:?} alpha {alpha}: {whole}");
            }
        }
    }
}
