//! Texels whose normals lie outside the bins of [`super::counts`].
//!
//! Bins cover a rectangle of directions, and the normals of some maps have a core and long tails: most flakes lie almost flat, a
//! few stand on edge. Bins for all of them would be nearly all empty, and nodes with counts large. So bins cover the core; the
//! few texels outside, the *strays*, are listed here by direction and added one by one, with their own lobes, where a footprint
//! takes a node by its counts.
//!
//! **Which rectangle** [`core`] cuts off as much of the tails as pays: bins must become half as many at least, and a half
//! vector may meet no more than [`MOST_IN_REACH`] strays on average, over the half vectors that the map reflects at.
//!
//! **Layout** Column and row of the quantised normal and number of the texel, row by row of the map, for every stray; they are
//! sorted by squares of directions at least as wide as a lobe reaches, so that a query reads at most three runs of them.

use glam::{Vec2, Vec3};
use rayon::prelude::*;

use super::counts;
use super::grid::{self, Grid};
use super::lanes::eight;
use super::lobes::Sums;
use crate::array::Array;
use crate::normal_map::NormalMap;

/// Shares of a map's texels that may be cut off at each end of each axis.
const TAILS: [f64; 5] = [0.005, 0.002, 0.001, 0.0005, 0.0002];

/// Most strays within reach of a half vector, on average over those that the map's texels reflect at.
const MOST_IN_REACH: f64 = 24.0;

/// Bins must become fewer by this factor.
const LEAST_GAIN: f32 = 2.0;

/// Strays for each square of directions, on average, at least.
const STRAYS_PER_SQUARE: usize = 4;

/// See the module.
pub struct Strays {
    /// Width and height of a square in cells of the grid of quantised normals; columns and rows of squares.
    pub squares: [u32; 3],
    /// First stray of each square, row by row, and the number of strays.
    pub offsets: Array<u32>,
    /// Column, row and texel.
    pub strays: Array<[u32; 3]>,
}

/// The directions that are counted in bins.
pub struct Core {
    /// Least and greatest projection ([`counts::project`]).
    pub bounds: (Vec2, Vec2),
    /// About this share of the texels are strays.
    pub strays: f64,
}

/// The rectangle of directions for the bins of `map`; `reach`: of a lobe, as a chord.
pub fn core(map: &NormalMap, reach: f32) -> Core {
    let all = grid::bounds(map, counts::project);
    let samples: Vec<Vec2> = grid::sparse(map).map(counts::project).collect();
    let sorted = [0, 1].map(|axis| {
        let mut values: Vec<f32> = samples.iter().map(|p| p[axis]).collect();
        values.sort_unstable_by(f32::total_cmp);
        values
    });
    let area = |(low, high): (Vec2, Vec2)| (high - low).element_product();
    let core = |tail: f64| {
        let cut = (tail * samples.len() as f64) as usize;
        let corner = |k: usize| Vec2::new(sorted[0][k], sorted[1][k]);
        (corner(cut), corner(samples.len() - 1 - cut))
    };
    TAILS
        .into_iter()
        .map(core)
        .filter(|&core| LEAST_GAIN * area(core) <= area(all))
        .find_map(|bounds| {
            let outside = |p: &&Vec2| !(p.cmpge(bounds.0) & p.cmple(bounds.1)).all();
            let strays: Vec<Vec2> = samples.iter().filter(outside).copied().collect();
            let share = strays.len() as f64 / samples.len() as f64;
            let near = share_within(&samples, &strays, reach);
            let texels = f64::from(map.width()) * f64::from(map.height());
            (near * share * texels <= MOST_IN_REACH).then_some(Core {
                bounds,
                strays: share,
            })
        })
        .unwrap_or(Core {
            bounds: all,
            strays: 0.0,
        })
}

/// Share of pairs of one of `samples` and one of `others` that may be within reach of each other: nothing is further apart in
/// the projection than its chord is long.
fn share_within(samples: &[Vec2], others: &[Vec2], reach: f32) -> f64 {
    /// About so many of the samples tell.
    const PROBES: usize = 512;
    let probes: Vec<Vec2> = samples
        .iter()
        .step_by(samples.len().div_ceil(PROBES))
        .copied()
        .collect();
    let near = |probe: &Vec2| {
        others
            .iter()
            .filter(|other| other.distance_squared(*probe) <= reach * reach)
            .count()
    };
    let pairs: usize = probes.iter().map(near).sum();
    pairs as f64 / (probes.len() * others.len().max(1)) as f64
}

impl Strays {
    /// Bytes of a stray.
    pub const BYTES: f64 = size_of::<[u32; 3]>() as f64;

    /// No strays.
    pub fn none() -> Self {
        Self::new(1, 1, Vec::new())
    }

    /// The texels of `map` whose quantised normals are strays, by the grid of quantisation; `reach`: of a lobe, as a chord.
    pub fn of(map: &NormalMap, grid: &Grid, reach: f32, is_stray: impl Fn(&Vec3) -> bool + Sync) -> Self {
        let texels = map.normals().par_iter().zip(0..map.width() * map.height());
        let strays = texels.filter_map(|(&normal, texel)| {
            let cell = grid.cell(normal);
            is_stray(&grid.normal(cell)).then_some([cell[0], cell[1], texel])
        });
        let cells = grid.size[0].max(grid.size[1]);
        Self::new(cells, (reach / grid.pitch).ceil() as u32, strays.collect())
    }

    /// Sorts strays of a grid of so many cells a side; `reach`: of a lobe, in cells.
    fn new(cells: u32, reach: u32, mut strays: Vec<[u32; 3]>) -> Self {
        let most = (strays.len() / STRAYS_PER_SQUARE).isqrt().max(1) as u32;
        let side = reach.max(cells.div_ceil(most)).max(1);
        let squares = |axis: usize| strays.iter().map(|s| s[axis] / side + 1).max().unwrap_or(1);
        let (columns, rows) = (squares(0), squares(1));
        let square = |stray: &[u32; 3]| stray[1] / side * columns + stray[0] / side;
        strays.par_sort_unstable_by_key(|stray| (square(stray), stray[2]));
        let offsets: Vec<u32> = (0..=columns * rows)
            .map(|k| strays.partition_point(|stray| square(stray) < k) as u32)
            .collect();
        Self {
            squares: [side, columns, rows],
            offsets: offsets.into(),
            strays: strays.into(),
        }
    }

    pub fn bytes(&self) -> usize {
        self.offsets.bytes() + self.strays.bytes()
    }

    pub fn is_empty(&self) -> bool {
        self.strays.is_empty()
    }

    /// Numbers of the texels.
    #[cfg(test)]
    pub fn texels(&self) -> impl Iterator<Item = u32> + '_ {
        self.strays.iter().map(|stray| stray[2])
    }

    /// Adds the lobes of the strays within reach, each with the weight that `weight` tells for its texel.
    pub fn add(&self, weight: impl Fn(u32) -> f32, sums: &mut Sums) {
        if self.is_empty() {
            return;
        }
        let ([x, y], reach) = sums.window();
        let [side, columns, rows] = self.squares;
        let side = side as f32;
        // Conversion saturates: what lies below the first square is in it.
        let squares = |center: f32, count: u32| {
            let first = ((center - reach) / side) as u32;
            let end = ((center + reach) / side + 1.0) as u32;
            first..end.min(count)
        };
        let near = squares(x, columns);
        if near.is_empty() {
            return;
        }
        for row in squares(y, rows) {
            let first = row as usize * columns as usize;
            let start = self.offsets[first + near.start as usize] as usize;
            let end = self.offsets[first + near.end as usize] as usize;
            for strays in self.strays[start..end].chunks(8) {
                add_eight(strays, &weight, sums);
            }
        }
    }
}

/// Adds up to eight strays.
fn add_eight(strays: &[[u32; 3]], weight: &impl Fn(u32) -> f32, sums: &mut Sums) {
    let [mut x, mut y, mut weights] = [[0.0; 8]; 3];
    for (k, stray) in strays.iter().enumerate() {
        (x[k], y[k]) = (stray[0] as f32, stray[1] as f32);
    }
    let [x, y] = [eight(&x, 0), eight(&y, 0)];
    let lanes = sums.near(x, y) & ((1 << strays.len()) - 1);
    for (k, stray) in strays.iter().enumerate() {
        if lanes >> k & 1 == 1 {
            weights[k] = weight(stray[2]);
        }
    }
    sums.add(lanes, x, y, eight(&weights, 0));
}
