//! Quantised normals in the map's own order: for roughnesses so high that most texels of a footprint matter.
//!
//! **Layout** Tiles of 8 x 8 texels, row by row; a tile is eight groups of [`super::packing`], one a row, so that
//! footprints along either axis touch few cache lines. A word is `x | y << x_bits`, the cell of the normal on the
//! [`Grid`].

use glam::Vec3;
use rayon::prelude::*;
use wide::{f32x8, u32x8};

use super::cover::Rect;
use super::grid::Grid;
use super::lobes::{Sums, bits, lifted};
use super::packing::{GROUP, Packed, WIDTHS, pack, to_float, units_per_group};
use crate::footprint::{Parallelogram, Span};
use crate::normal_map::NormalMap;

const SIDE: usize = GROUP;

/// See the module.
pub struct Rows {
    width: u32,
    grid: Grid,
    x_bits: u32,
    words: Packed,
}

impl Rows {
    /// Quantises the map; `grid` has at most 2^32 cells.
    pub fn new(map: &NormalMap, grid: Grid) -> Self {
        let [x_bits, y_bits] = grid.size.map(bits_for);
        let bits = narrowest(x_bits + y_bits);
        let (width, height) = (map.width() as usize, map.height() as usize);
        let tiles = width.div_ceil(SIDE);
        let units = units_per_group(bits);
        let mut data = vec![0; height.div_ceil(SIDE) * tiles * SIDE * units];
        data.par_chunks_mut(tiles * SIDE * units)
            .enumerate()
            .for_each(|(tile_row, data)| {
                for (index, group) in data.chunks_exact_mut(units).enumerate() {
                    let row = (tile_row * SIDE + index % SIDE).min(height - 1) as u32;
                    let words = std::array::from_fn(|k| {
                        let column = (index / SIDE * SIDE + k).min(width - 1) as u32;
                        let [x, y] = grid.cell(map.normal(column, row));
                        x | y << x_bits
                    });
                    pack(&words, bits, group);
                }
            });
        Self::from_words(map.width(), grid, Packed::new(data.into(), bits))
    }

    /// The same from words that exist; see [`Rows::layout`] and [`fits`].
    pub fn from_words(width: u32, grid: Grid, words: Packed) -> Self {
        Self {
            width,
            grid,
            x_bits: bits_for(grid.size[0]),
            words,
        }
    }

    /// Bits of a word on a grid, and 32-bit units of all words of a map.
    pub fn layout(grid: &Grid, (width, height): (u32, u32)) -> (u32, usize) {
        let bits = narrowest(bits_for(grid.size[0]) + bits_for(grid.size[1]));
        let tiles = (width as usize).div_ceil(SIDE) * (height as usize).div_ceil(SIDE);
        (bits, tiles * SIDE * units_per_group(bits))
    }

    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    pub fn words(&self) -> &Packed {
        &self.words
    }

    /// The normal of a texel, quantised.
    #[inline]
    pub fn normal(&self, column: u32, row: u32) -> Vec3 {
        let word = self
            .words
            .word(self.group(row, column / SIDE as u32) * GROUP + column as usize % GROUP);
        let p = self.grid.point([word & self.x_mask(), word >> self.x_bits]);
        lifted(p.x, p.y)
    }

    /// Adds the texels of `region` inside `rect`, each with its area in the region.
    pub fn add(&self, region: &Parallelogram, rect: &Rect, sums: &mut Sums) {
        let mut asked = None;
        for span in region.spans_within(rect.low, rect.high) {
            let tile_row = span.row / SIDE as i64;
            if asked != Some(tile_row) {
                if asked.is_none() {
                    self.prefetch(tile_row, span.touched);
                }
                self.prefetch(tile_row + 1, span.touched);
                asked = Some(tile_row);
            }
            self.add_span(region, &span, sums);
        }
    }

    /// Asks for a row of tiles, from a tile before to a tile after the columns that one of its neighbours needs.
    fn prefetch(&self, tile_row: i64, columns: (i64, i64)) {
        let tiles = (self.width as usize).div_ceil(SIDE);
        let first = (columns.0 as usize / SIDE).saturating_sub(1);
        let end = ((columns.1 as usize).div_ceil(SIDE) + 1).min(tiles);
        let row = tile_row as usize * tiles;
        self.words.prefetch((row + first) * SIDE..(row + end) * SIDE);
    }

    /// Adds all texels of `rect`, each with the weight `weight`.
    pub fn add_all(&self, rect: &Rect, weight: f32, sums: &mut Sums) {
        let columns = (i64::from(rect.low.0), i64::from(rect.high.0));
        for row in rect.low.1..rect.high.1 {
            for index in rect.low.0 / GROUP as u32..rect.high.0.div_ceil(GROUP as u32) {
                let (x, y) = self.projected(row, index);
                let lanes = sums.near(x, y) & lane_mask(columns, i64::from(index) * GROUP as i64);
                sums.add(lanes, x, y, f32x8::splat(weight));
            }
        }
    }

    fn add_span(&self, region: &Parallelogram, span: &Span, sums: &mut Sums) {
        let groups = span.touched.0 as usize / GROUP..(span.touched.1 as usize).div_ceil(GROUP);
        for index in groups {
            let (x, y) = self.projected(span.row as u32, index as u32);
            let first = (index * GROUP) as i64;
            let lanes = sums.near(x, y) & lane_mask(span.touched, first);
            if lanes == 0 {
                continue;
            }
            let mut weights = f32x8::ONE;
            for k in bits(lanes & !lane_mask(span.inside, first)) {
                let area = region.texel_overlap(first as u32 + k as u32, span.row as u32);
                weights.as_array_mut()[k] = area as f32;
            }
            sums.add(lanes, x, y, weights);
        }
    }

    /// Projections of eight normals.
    #[inline(always)]
    fn projected(&self, row: u32, column_group: u32) -> (f32x8, f32x8) {
        let words = self.words.group(self.group(row, column_group));
        let x = to_float(words & u32x8::splat(self.x_mask()));
        let y = to_float(words >> self.x_bits);
        (self.grid.middle(0, x), self.grid.middle(1, y))
    }

    #[inline]
    fn group(&self, row: u32, column_group: u32) -> usize {
        let tiles = (self.width as usize).div_ceil(SIDE);
        (row as usize / SIDE * tiles + column_group as usize) * SIDE + row as usize % SIDE
    }

    #[inline]
    fn x_mask(&self) -> u32 {
        (1 << self.x_bits) - 1
    }
}

/// Bits of a number below `count`; at least one, at most 16 for what fits a word.
fn bits_for(count: u32) -> u32 {
    (32 - (count - 1).leading_zeros()).max(1)
}

/// Whether the cells of a grid can be told apart by the widest words.
pub fn fits(grid: &Grid) -> bool {
    bits_for(grid.size[0]) + bits_for(grid.size[1]) <= 32
}

fn narrowest(bits: u32) -> u32 {
    *WIDTHS.iter().find(|&&width| width >= bits).unwrap_or(&32)
}

/// Bit k: `first + k` is in the half-open interval.
#[inline]
pub fn lane_mask((start, end): (i64, i64), first: i64) -> u32 {
    let below = |bound: i64| (1_u32 << (bound - first).clamp(0, GROUP as i64)) - 1;
    below(end) & !below(start)
}
