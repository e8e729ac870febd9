//! Quantised normals in the map's own order: for roughnesses so high that many texels of a footprint matter.
//!
//! **Layout** Tiles of 8 x 8 texels, row by row. A cell of the [`Grid`] has `8 + k` bits for x and as many for y, k being 2, 4
//! or 8; a tile holds, texel by texel, the upper 8 of x, the upper 8 of y, and then of both the lower k in `2 k` bits.
//!
//! **Query** The upper bytes of a tile are compared with the square around the half vector that holds all within reach: 64
//! texels in some thirty vector instructions. Of the rows of eight that have any inside, the cells are put together, and
//! only of those within reach the place is looked at. So it matters little how the footprint's border runs through a tile,
//! and a thin footprint costs as much as the tiles that it meets.

use std::ops::Range;

use glam::{DVec2, Vec2};
use rayon::prelude::*;
use wide::{f32x8, u8x16, u32x8};

use super::border::{Border, Touched, Weight};
use super::cover::Rect;
use super::grid::Grid;
use super::lanes::{LANES, order};
use super::lobes::{Near, Sums};
use super::packing::{prefetch, to_float, widened};
use crate::array::Array;
use crate::normal_map::NormalMap;

/// Columns and rows of a tile.
const SIDE: u32 = 8;

/// 32-bit units of a tile's upper bytes: those of x, then those of y.
const UPPER: usize = 32;

/// The numbers of lower bits that a layout may have.
const LOWER_BITS: [u32; 3] = [2, 4, 8];

/// Tiles that wait for each other.
const BATCH: usize = 16;

/// See the module.
pub struct Tiles {
    map: (u32, u32),
    grid: Grid,
    /// k.
    lower_bits: u32,
    units: Array<u32>,
}

/// Number of lower bits for a grid, if there is a layout for it.
pub fn lower_bits(grid: &Grid) -> Option<u32> {
    LOWER_BITS
        .into_iter()
        .find(|bits| grid.size[0].max(grid.size[1]) <= 1 << (8 + bits))
}

/// The grid over some bounds whose pitch is at most `pitch`, or the finest that cells can tell apart; the finest for as many
/// bits as that takes.
pub fn grid(bounds: (Vec2, Vec2), pitch: f64) -> Grid {
    let extent = f64::from((bounds.1 - bounds.0).max_element()).max(1e-6);
    let finest = |bits: u32| extent * (1.0 + 1e-6) / f64::from((1_u32 << (8 + bits)) - 1);
    let fitting = LOWER_BITS.into_iter().map(finest).find(|&finest| finest <= pitch);
    Grid::covering(bounds, fitting.unwrap_or(finest(8)))
}

/// Upper bytes of cells that may be within reach.
struct Window {
    first: [u8; 2],
    extent: [u8; 2],
}

impl Window {
    /// `None`: no cell of the grid is within reach.
    fn new(sums: &Sums, grid: &Grid, lower_bits: u32) -> Option<Self> {
        let (center, radius) = sums.window();
        let mut window = Self {
            first: [0; 2],
            extent: [0; 2],
        };
        for (axis, &center) in center.iter().enumerate() {
            let first = (center - radius).ceil().max(0.0);
            let last = (center + radius).floor().min((grid.size[axis] - 1) as f32);
            if first > last {
                return None;
            }
            let (first, last) = (first as u32 >> lower_bits, last as u32 >> lower_bits);
            window.first[axis] = first as u8;
            window.extent[axis] = (last - first) as u8;
        }
        Some(window)
    }

    /// Bit `8 y + x`: the texel may be within reach.
    #[inline(always)]
    fn find(&self, upper: &[u8; 4 * UPPER]) -> u64 {
        let inside = |axis: usize, at: usize| {
            let sixteen: [u8; 16] = upper[at..at + 16].try_into().expect("sixteen bytes");
            // Differences wrap: what is below the first is far above.
            let ahead = u8x16::new(sixteen) - u8x16::splat(self.first[axis]);
            ahead.min(u8x16::splat(self.extent[axis])).cmp_eq(ahead)
        };
        let mut found = 0;
        for at in [0, 16, 32, 48] {
            let both = inside(0, at) & inside(1, 64 + at);
            found |= u64::from(both.move_mask() as u16) << at;
        }
        found
    }
}

/// A tile to be read.
#[derive(Clone, Copy, Default)]
struct Asked {
    column: u32,
    row: u32,
    /// Bit `8 y + x`: the border may touch the texel, or it lies inside.
    texels: u64,
    inside: bool,
}

/// Tiles on their way from memory.
struct Batch {
    asked: [Asked; BATCH],
    len: usize,
    touched: Touched,
}

impl Batch {
    fn new() -> Self {
        Self {
            asked: [Asked::default(); BATCH],
            len: 0,
            touched: Touched::new(),
        }
    }
}

impl Tiles {
    /// Quantises the map; `grid` is one that [`lower_bits`] has a layout for.
    pub fn new(map: &NormalMap, grid: Grid) -> Self {
        let size = (map.width(), map.height());
        let (lower_bits, count) = Self::layout(&grid, size);
        let units = units(lower_bits);
        let columns = size.0.div_ceil(SIDE) as usize;
        let mut data = vec![0; count];
        data.par_chunks_mut(columns * units)
            .enumerate()
            .for_each(|(row, data)| {
                for (column, tile) in data.chunks_exact_mut(units).enumerate() {
                    for k in 0..SIDE * SIDE {
                        let column = (column as u32 * SIDE + k % SIDE).min(size.0 - 1);
                        let row = (row as u32 * SIDE + k / SIDE).min(size.1 - 1);
                        put(tile, lower_bits, k as usize, grid.cell(map.normal(column, row)));
                    }
                }
            });
        Self::from_units(size, grid, data.into())
    }

    /// The same from units that exist; see [`Tiles::layout`].
    pub fn from_units(map: (u32, u32), grid: Grid, units: Array<u32>) -> Self {
        let (lower_bits, _) = Self::layout(&grid, map);
        Self {
            map,
            grid,
            lower_bits,
            units,
        }
    }

    /// Lower bits for a grid, and 32-bit units of all tiles of a map.
    pub fn layout(grid: &Grid, (width, height): (u32, u32)) -> (u32, usize) {
        let bits = lower_bits(grid).unwrap_or(8);
        let tiles = width.div_ceil(SIDE) as usize * height.div_ceil(SIDE) as usize;
        (bits, tiles * units(bits))
    }

    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    pub fn units(&self) -> &Array<u32> {
        &self.units
    }

    /// The cell of a texel's normal.
    #[inline]
    pub fn cell(&self, column: u32, row: u32) -> [u32; 2] {
        let tile = self.tile(column / SIDE, row / SIDE);
        let k = (row % SIDE * SIDE + column % SIDE) as usize;
        let upper: &[u8] = bytemuck::cast_slice(&tile[..UPPER]);
        let bits = self.lower_bits;
        let (unit, shift) = lower_place(bits, k);
        let lower = tile[unit] >> shift;
        let mask = (1 << bits) - 1;
        [
            u32::from(upper[k]) << bits | lower & mask,
            u32::from(upper[64 + k]) << bits | lower >> bits & mask,
        ]
    }

    /// Adds the texels of a footprint inside `rect`, each with its weight. A rectangle begins and ends with a tile, or with the
    /// map.
    pub fn add(&self, border: &Border, rect: &Rect, sums: &mut Sums) {
        let Some(window) = Window::new(sums, &self.grid, self.lower_bits) else {
            return;
        };
        let weight = Weight::new(0.0, std::slice::from_ref(border), &[0]);
        let mut batch = Batch::new();
        let (columns, rows) = tiles_of(rect);
        let rows = rows.start.into()..rows.end.into();
        let is_even = border.is_even();
        for span in border.region.spans_of_rows(DVec2::splat(SIDE.into()), rows) {
            let clamp = |column: i64| column.clamp(columns.start.into(), columns.end.into()) as u32;
            for column in clamp(span.touched.0)..clamp(span.touched.1) {
                let row = span.row as u32;
                let inside = is_even && (span.inside.0..span.inside.1).contains(&i64::from(column));
                let texels = if inside {
                    u64::MAX
                } else {
                    border.touched(column * SIDE, row * SIDE)
                };
                let tile = Asked {
                    column,
                    row,
                    texels,
                    inside,
                };
                self.ask(tile, &mut batch, &window, &weight, sums);
            }
        }
        self.read(&mut batch, &window, &weight, sums);
    }

    /// Adds all texels of `rect`, which begins and ends with a tile, or with the map, each with the weight `weight`.
    pub fn add_all(&self, rect: &Rect, weight: f32, sums: &mut Sums) {
        let Some(window) = Window::new(sums, &self.grid, self.lower_bits) else {
            return;
        };
        let weight = Weight::alike(weight);
        let mut batch = Batch::new();
        let (columns, rows) = tiles_of(rect);
        for (row, column) in rows.flat_map(|row| columns.clone().map(move |column| (row, column))) {
            let tile = Asked {
                column,
                row,
                texels: u64::MAX,
                inside: true,
            };
            self.ask(tile, &mut batch, &window, &weight, sums);
        }
        self.read(&mut batch, &window, &weight, sums);
    }

    #[inline(always)]
    fn ask(&self, tile: Asked, batch: &mut Batch, window: &Window, weight: &Weight, sums: &mut Sums) {
        prefetch(self.tile(tile.column, tile.row), 0..units(self.lower_bits));
        batch.asked[batch.len] = tile;
        batch.len += 1;
        if batch.len == BATCH {
            self.read(batch, window, weight, sums);
        }
    }

    /// Adds the texels of the tiles that wait.
    #[inline(never)]
    fn read(&self, batch: &mut Batch, window: &Window, weight: &Weight, sums: &mut Sums) {
        let found = Rows::new(batch, |tile| {
            let (column, row) = (tile.column, tile.row);
            window.find(upper(self.tile(column, row))) & tile.texels & self.within(column, row)
        });
        let alike = if weight.cuts.is_empty() { weight.base } else { 1.0 };
        let Batch { asked, touched, .. } = batch;
        for (slot, k, lanes) in found.iter() {
            let Asked {
                column, row, inside, ..
            } = asked[slot];
            let tile = self.tile(column, row);
            let (x, y) = self.cells(tile, upper(tile), k as usize);
            let lanes = lanes & sums.near(x, y);
            if inside {
                sums.add_alike(lanes, x, y, alike);
            } else {
                let columns = LANES + (column * SIDE) as f32;
                let rows = f32x8::splat((row * SIDE + k) as f32);
                touched.add(&Near { lanes, x, y }, [columns, rows], weight, sums);
            }
        }
        touched.flush(weight, sums);
        batch.len = 0;
    }

    /// The texels of a tile that the map has.
    #[inline(always)]
    fn within(&self, column: u32, row: u32) -> u64 {
        let left = |side: u32, at: u32| (side - at * SIDE).min(SIDE);
        let (columns, rows) = (left(self.map.0, column), left(self.map.1, row));
        if columns == SIDE && rows == SIDE {
            return u64::MAX;
        }
        let row = (1 << columns) - 1;
        (0..rows).map(|k| row << (SIDE * k)).sum()
    }

    /// Cells of a row of a tile.
    #[inline(always)]
    fn cells(&self, tile: &[u32], upper: &[u8; 4 * UPPER], row: usize) -> (f32x8, f32x8) {
        let bits = self.lower_bits;
        let eight = |at: usize| {
            let bytes: &[u8; 8] = upper[at..at + 8].try_into().expect("eight bytes");
            widened(bytes)
        };
        let lower = match bits {
            2 => u32x8::splat(tile[UPPER + row]) >> u32x8::new([0, 4, 8, 12, 16, 20, 24, 28]),
            4 => {
                let [a, b] = [tile[UPPER + 2 * row], tile[UPPER + 2 * row + 1]];
                u32x8::new([a, a, a, a, b, b, b, b]) >> u32x8::new([0, 8, 16, 24, 0, 8, 16, 24])
            }
            _ => {
                let units: [u32; 4] = tile[UPPER + 4 * row..][..4].try_into().expect("four units");
                let [a, b, c, d] = units;
                u32x8::new([a, a, b, b, c, c, d, d]) >> u32x8::new([0, 16, 0, 16, 0, 16, 0, 16])
            }
        };
        let mask = u32x8::splat((1 << bits) - 1);
        let x = eight(8 * row) << bits | lower & mask;
        let y = eight(64 + 8 * row) << bits | lower >> bits & mask;
        (to_float(x), to_float(y))
    }

    #[inline(always)]
    fn tile(&self, column: u32, row: u32) -> &[u32] {
        let index = row as usize * self.map.0.div_ceil(SIDE) as usize + column as usize;
        let units = units(self.lower_bits);
        &self.units[index * units..][..units]
    }
}

/// Rows of a batch's tiles that have texels within reach.
///
/// They are listed first, without a branch that depends on how many a tile has: a wrong guess costs more than a row.
struct Rows {
    found: [u64; BATCH],
    /// The last eight places are for what is written beyond the end.
    slots: [u8; ROWS],
    rows: [u8; ROWS],
    count: usize,
}

const ROWS: usize = BATCH * SIDE as usize + 8;

impl Rows {
    /// `find` tells which texels of a tile count.
    #[inline(always)]
    fn new(batch: &Batch, find: impl Fn(&Asked) -> u64) -> Self {
        let mut list = Self {
            found: [0; BATCH],
            slots: [0; ROWS],
            rows: [0; ROWS],
            count: 0,
        };
        for (slot, tile) in batch.asked[..batch.len].iter().enumerate() {
            let found = find(tile);
            let rows = rows_with_any(found);
            list.found[slot] = found;
            list.slots[list.count..list.count + 8].fill(slot as u8);
            list.rows[list.count..list.count + 8].copy_from_slice(&order(rows).to_le_bytes());
            list.count += rows.count_ones() as usize;
        }
        list
    }

    /// Number of the tile in the batch, row, and which of its texels count.
    #[inline(always)]
    fn iter(&self) -> impl Iterator<Item = (usize, u32, u32)> {
        let rows = self.slots[..self.count].iter().zip(&self.rows);
        rows.map(|(&slot, &row)| {
            let (slot, row) = (usize::from(slot) % BATCH, u32::from(row));
            let lanes = (self.found[slot] >> (SIDE * row)) as u32 & 0xff;
            (slot, row, lanes)
        })
    }
}

/// Bit k: byte k is not zero.
#[inline(always)]
fn rows_with_any(found: u64) -> u32 {
    const LOW: u64 = 0x7f7f_7f7f_7f7f_7f7f;
    let any = (((found & LOW) + LOW) | found) & !LOW;
    // Bit 8 k meets bit 56 - 7 k of the factor at bit 56 + k, and no others do there.
    ((any >> 7).wrapping_mul(0x0102_0408_1020_4080) >> 56) as u32
}

/// The upper bytes of a tile.
#[inline(always)]
fn upper(tile: &[u32]) -> &[u8; 4 * UPPER] {
    bytemuck::cast_slice(&tile[..UPPER])
        .try_into()
        .expect("the upper bytes")
}

/// 32-bit units of a tile.
const fn units(lower_bits: u32) -> usize {
    UPPER + 4 * lower_bits as usize
}

/// Unit and shift of the lower bits of a texel.
#[inline]
fn lower_place(lower_bits: u32, texel: usize) -> (usize, u32) {
    let bit = texel * 2 * lower_bits as usize;
    (UPPER + bit / 32, bit as u32 % 32)
}

/// Writes a cell into a zeroed tile.
fn put(tile: &mut [u32], lower_bits: u32, texel: usize, [x, y]: [u32; 2]) {
    let upper: &mut [u8] = bytemuck::cast_slice_mut(&mut tile[..UPPER]);
    upper[texel] = (x >> lower_bits) as u8;
    upper[64 + texel] = (y >> lower_bits) as u8;
    let mask = (1 << lower_bits) - 1;
    let (unit, shift) = lower_place(lower_bits, texel);
    tile[unit] |= (x & mask | (y & mask) << lower_bits) << shift;
}

/// Columns and rows of the tiles of a rectangle.
fn tiles_of(rect: &Rect) -> (Range<u32>, Range<u32>) {
    let tiles = |low: u32, high: u32| low / SIDE..high.div_ceil(SIDE);
    (tiles(rect.low.0, rect.high.0), tiles(rect.low.1, rect.high.1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn rows_are_told_apart(found: u64, masks: [bool; 8]) {
            let kept = (0..8).filter(|&k| masks[k]).fold(0, |mask, k| mask | 0xff_u64 << (8 * k));
            let bytes = (found & kept).to_le_bytes();
            let expected = (0..8).filter(|&k| bytes[k] != 0).fold(0, |mask, k| mask | 1 << k);
            prop_assert_eq!(rows_with_any(found & kept), expected);
        }
    }
}
