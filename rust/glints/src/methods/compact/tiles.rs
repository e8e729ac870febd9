//! Quantised normals in the map's own order.
//!
//! **Layout** Tiles of 8 x 8 texels, row by row. A cell of the [`Grid`] has `8 + k` bits for x and `8 + l` for y. One array holds, tile
//! by tile, the upper 8 of x of all texels and the upper 8 of y: neighbouring tiles are read in one go. Another holds the lower k of x
//! and l of y as one number of 4, 6, 8 to 16 bits; its bits come in parts of 8, 4 and 2, from the lowest on, each for all texels of
//! a tile, so that those of a row of texels unpack in a few vector instructions.
//!
//! **Query** The upper bytes of a tile are compared with the square around the half vector that holds all within reach: 64
//! texels in some sixteen vector instructions, or in the time that memory takes for them, about 10 ns. Of the rows of eight that
//! have any inside, the cells are put together, and only of those within reach the place is looked at. So it matters little how
//! the footprint's border runs through a tile, and a thin footprint costs as much as the tiles that it meets.
//!
//! **Tried** Signatures of tiles, a bit for each of 128 parts of the directions in two to four partitions: for 3 to 4 MB they let a
//! third to a fifth of the tiles pass at a roughness of 0.007, and reading those in no order takes as long as reading all. Least and
//! greatest normals of squares of 4 x 4 texels, 1 MB, let 14 % pass on the isotropic map, whose normals vary slowly, but 60 to 75 % on
//! brushed and scratched ones and 90 % on flakes: they were not built.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::{DVec2, Vec2, Vec3};
use rayon::prelude::*;
use wide::{CmpGt, f32x8, i8x32, u32x8};

use super::border::{Border, Squares, Touched};
use super::cover::Rect;
use super::grid::Grid;
use super::lanes::{LANES, order, to_float, widened};
use super::lobes::{Near, Sums};
use crate::array::{Array, prefetch};
use crate::normal_map::NormalMap;

/// Columns and rows of a tile.
const SIDE: u32 = 8;

/// Texels of a tile.
const TEXELS: usize = 64;

/// The upper bytes of a tile, of x and of y: a cache line each.
#[repr(C, align(64))]
#[derive(Clone, Copy)]
pub struct Upper([[u8; TEXELS]; 2]);

// SAFETY: bytes without padding, of which any are valid.
unsafe impl Zeroable for Upper {}
unsafe impl Pod for Upper {}

/// The numbers of lower bits of a texel, of x and y together, that a layout may have.
const LOWER_BITS: [u32; 7] = [4, 6, 8, 10, 12, 14, 16];

/// Tiles that wait for each other.
const BATCH: usize = 16;

/// See the module.
pub struct Tiles {
    map: (u32, u32),
    grid: Grid,
    /// k and l.
    lower_bits: [u32; 2],
    upper: Array<Upper>,
    lower: Array<u32>,
}

/// Lower bits of x and y for a grid; more than [`LOWER_BITS`] has, and there is no layout for it.
pub fn lower_bits(grid: &Grid) -> [u32; 2] {
    grid.size
        .map(|cells| cells.next_power_of_two().trailing_zeros().saturating_sub(8))
}

/// Whether there is a layout for a grid.
pub fn has_layout(grid: &Grid) -> bool {
    lower_bits(grid).iter().sum::<u32>() <= LOWER_BITS[LOWER_BITS.len() - 1]
}

/// The grid over some bounds whose pitch is at most `pitch`, or the finest that cells can tell apart; the finest for as many
/// bits as that takes.
pub fn grid(bounds: (Vec2, Vec2), pitch: f64) -> Grid {
    let extent = (bounds.1 - bounds.0).as_dvec2().max(DVec2::splat(1e-6));
    // Of all ways to share out the bits.
    let finest = |bits: u32| {
        let side = |extent: f64, bits: u32| extent * (1.0 + 1e-6) / f64::from((1_u32 << (8 + bits)) - 1);
        let pitches = (0..=bits).map(|k| side(extent.x, k).max(side(extent.y, bits - k)));
        pitches.fold(f64::INFINITY, f64::min)
    };
    let [.., most] = LOWER_BITS;
    let fitting = LOWER_BITS.into_iter().map(finest).find(|&finest| finest <= pitch);
    Grid::covering(bounds, fitting.unwrap_or(finest(most)))
}

/// Upper bytes of cells that may be within reach.
struct Window {
    /// Of x and y, 128 more than the first byte, and 128 less than how far the last one is ahead of it: so that signed
    /// numbers compare.
    first: [i8x32; 2],
    extent: [i8x32; 2],
}

impl Window {
    /// `None`: no cell of the grid is within reach.
    fn new(sums: &Sums, grid: &Grid, lower_bits: [u32; 2]) -> Option<Self> {
        let (center, radius) = sums.window();
        let mut window = Self {
            first: [i8x32::ZERO; 2],
            extent: [i8x32::ZERO; 2],
        };
        for (axis, &center) in center.iter().enumerate() {
            let first = (center - radius).ceil().max(0.0);
            let last = (center + radius).floor().min((grid.size[axis] - 1) as f32);
            if first > last {
                return None;
            }
            let [first, last] = [first, last].map(|cell| (cell as u32 >> lower_bits[axis]) as u8);
            let splat = |byte: u8| i8x32::splat(byte.wrapping_add(128) as i8);
            window.first[axis] = splat(first);
            window.extent[axis] = splat(last - first);
        }
        Some(window)
    }

    /// Half of the texels of a tile: not zero for those that are out of reach.
    #[inline(always)]
    fn outside(&self, upper: &Upper, half: usize) -> i8x32 {
        let beyond = |axis: usize| {
            let bytes: [u8; 32] = upper.0[axis][32 * half..][..32].try_into().expect("32 bytes");
            // Differences wrap: what is below the first is far ahead.
            (i8x32::new(bytemuck::cast(bytes)) - self.first[axis]).cmp_gt(self.extent[axis])
        };
        beyond(0) | beyond(1)
    }

    /// Whether any texel may be within reach.
    #[inline(always)]
    fn finds(&self, upper: &Upper) -> bool {
        (self.outside(upper, 0) & self.outside(upper, 1)).move_mask() != -1
    }

    /// Bit `8 y + x`: the texel may be within reach.
    #[inline(always)]
    fn find(&self, upper: &Upper) -> u64 {
        let [low, high] = [0, 1].map(|half| u64::from(self.outside(upper, half).move_mask() as u32));
        !(low | high << 32)
    }
}

/// A tile to be read.
#[derive(Clone, Copy, Default)]
struct Asked {
    column: u32,
    row: u32,
    /// The border does not touch it.
    inside: bool,
}

/// Tiles on their way from memory.
struct Batch<'a> {
    asked: [Asked; BATCH],
    len: usize,
    touched: Touched,
    weight: Weight<'a>,
}

/// What the texels of tiles weigh.
#[derive(Clone, Copy)]
enum Weight<'a> {
    Alike(f32),
    Inside(&'a Border<'a>),
}

impl<'a> Batch<'a> {
    fn new(weight: Weight<'a>) -> Self {
        Self {
            asked: [Asked::default(); BATCH],
            len: 0,
            touched: Touched::new(),
            weight,
        }
    }
}

impl Tiles {
    /// Quantises the map; `grid` is one that has a layout.
    pub fn new(map: &NormalMap, grid: Grid) -> Self {
        let size = (map.width(), map.height());
        let mut tiles = Self::from_parts(size, grid, Default::default());
        let (upper, lower) = tiles.lengths();
        let (mut upper, mut lower) = (vec![Upper::zeroed(); upper], vec![0; lower]);
        let columns = tiles.size().0 as usize;
        let units = tiles.units_per_tile();
        let rows = upper
            .par_chunks_mut(columns)
            .zip(lower.par_chunks_mut(columns * units));
        rows.enumerate().for_each(|(row, (upper, lower))| {
            let tile = upper.iter_mut().zip(lower.chunks_exact_mut(units));
            for (column, (upper, lower)) in tile.enumerate() {
                for k in 0..SIDE * SIDE {
                    let column = (column as u32 * SIDE + k % SIDE).min(size.0 - 1);
                    let row = (row as u32 * SIDE + k / SIDE).min(size.1 - 1);
                    tiles.put(upper, lower, k as usize, grid.cell(map.normal(column, row)));
                }
            }
        });
        tiles.upper = upper.into();
        tiles.lower = lower.into();
        tiles
    }

    /// The same from arrays that exist; see [`Self::lengths`].
    pub fn from_parts(map: (u32, u32), grid: Grid, (upper, lower): (Array<Upper>, Array<u32>)) -> Self {
        Self {
            map,
            grid,
            lower_bits: lower_bits(&grid),
            upper,
            lower,
        }
    }

    /// Columns and rows of tiles.
    fn size(&self) -> (u32, u32) {
        (self.map.0.div_ceil(SIDE), self.map.1.div_ceil(SIDE))
    }

    /// How many upper bytes of tiles and 32-bit units of lower bits there are.
    pub fn lengths(&self) -> (usize, usize) {
        let (columns, rows) = self.size();
        let tiles = columns as usize * rows as usize;
        (tiles, tiles * self.units_per_tile())
    }

    /// Bits of a texel's lower part.
    #[inline(always)]
    fn lower_width(&self) -> u32 {
        (self.lower_bits[0] + self.lower_bits[1])
            .next_multiple_of(2)
            .max(LOWER_BITS[0])
    }

    /// 32-bit units of a tile's lower bits.
    #[inline(always)]
    fn units_per_tile(&self) -> usize {
        TEXELS / 32 * self.lower_width() as usize
    }

    pub fn bytes(&self) -> usize {
        self.upper.bytes() + self.lower.bytes()
    }

    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Upper bytes and lower bits.
    pub fn parts(&self) -> (&Array<Upper>, &Array<u32>) {
        (&self.upper, &self.lower)
    }

    /// The cell of a texel's normal.
    #[inline]
    pub fn cell(&self, (column, row): (u32, u32)) -> [u32; 2] {
        let (upper, tile) = (
            self.upper(column / SIDE, row / SIDE),
            self.lower(column / SIDE, row / SIDE),
        );
        let k = (row % SIDE * SIDE + column % SIDE) as usize;
        let mut lower = 0;
        for Part { unit, bits, shift } in parts(self.lower_width()) {
            let bit = k * bits as usize;
            lower |= (tile[unit + bit / 32] >> (bit % 32) & ((1 << bits) - 1)) << shift;
        }
        let [bits_x, bits_y] = self.lower_bits;
        [
            u32::from(upper.0[0][k]) << bits_x | lower & ((1 << bits_x) - 1),
            u32::from(upper.0[1][k]) << bits_y | lower >> bits_x & ((1 << bits_y) - 1),
        ]
    }

    /// The normal of a texel.
    #[inline]
    pub fn normal(&self, texel: (u32, u32)) -> Vec3 {
        self.grid.normal(self.cell(texel))
    }

    /// Writes a cell into a zeroed tile.
    fn put(&self, upper: &mut Upper, tile: &mut [u32], k: usize, [x, y]: [u32; 2]) {
        let [bits_x, bits_y] = self.lower_bits;
        upper.0[0][k] = (x >> bits_x) as u8;
        upper.0[1][k] = (y >> bits_y) as u8;
        let lower = x & ((1 << bits_x) - 1) | (y & ((1 << bits_y) - 1)) << bits_x;
        for Part { unit, bits, shift } in parts(self.lower_width()) {
            let bit = k * bits as usize;
            tile[unit + bit / 32] |= (lower >> shift & ((1 << bits) - 1)) << (bit % 32);
        }
    }

    /// Adds the texels of a footprint inside `rect`, each with its weight. A rectangle begins and ends with a tile, or with the
    /// map.
    pub fn add(&self, border: &Border, rect: &Rect, sums: &mut Sums) {
        let Some(window) = Window::new(sums, &self.grid, self.lower_bits) else {
            return;
        };
        let mut batch = Batch::new(Weight::Inside(border));
        let (columns, rows) = tiles_of(rect);
        let rows = border
            .region
            .rows(SIDE.into(), rows.start.into()..rows.end.into());
        let is_even = border.is_even();
        for eight in rows.clone().step_by(8) {
            let squares = border.squares(SIDE, eight as u32, &columns);
            for (row, squares) in (eight..rows.end).zip(squares) {
                let Squares { touched, inside } = squares;
                self.for_each_near(&window, row as u32, touched, |column| {
                    let tile = Asked {
                        column,
                        row: row as u32,
                        inside: is_even && inside.contains(&column),
                    };
                    self.ask(tile, &mut batch, &window, sums);
                });
            }
        }
        self.read(&mut batch, &window, sums);
    }

    /// Adds all texels of `rect`, which begins and ends with a tile, or with the map, each with the weight `weight`.
    pub fn add_all(&self, rect: &Rect, weight: f32, sums: &mut Sums) {
        let Some(window) = Window::new(sums, &self.grid, self.lower_bits) else {
            return;
        };
        let mut batch = Batch::new(Weight::Alike(weight));
        let (columns, rows) = tiles_of(rect);
        for row in rows {
            self.for_each_near(&window, row, columns.clone(), |column| {
                let tile = Asked {
                    column,
                    row,
                    inside: true,
                };
                self.ask(tile, &mut batch, &window, sums);
            });
        }
        self.read(&mut batch, &window, sums);
    }

    /// Calls `visit` with the columns of a row's tiles that may have a texel within reach.
    #[inline(always)]
    fn for_each_near(&self, window: &Window, row: u32, columns: Range<u32>, mut visit: impl FnMut(u32)) {
        let all: &[Upper] = &self.upper;
        // Those of a row come in one go; the first of the next row would be waited for.
        let next = self.index(columns.start, row + 1);
        let tiles = all[self.index(columns.start, row)..].iter();
        for ((column, upper), next) in columns.clone().zip(tiles).zip(next..) {
            prefetch(all, next..next + 1);
            if window.finds(upper) {
                visit(column);
            }
        }
    }

    /// Lets a tile wait that may have a texel within reach.
    #[inline(always)]
    fn ask(&self, tile: Asked, batch: &mut Batch, window: &Window, sums: &mut Sums) {
        prefetch(self.lower(tile.column, tile.row), 0..self.units_per_tile());
        batch.asked[batch.len] = tile;
        batch.len += 1;
        if batch.len == BATCH {
            self.read(batch, window, sums);
        }
    }

    /// Adds the texels of the tiles that wait.
    #[inline(never)]
    fn read(&self, batch: &mut Batch, window: &Window, sums: &mut Sums) {
        let weight = batch.weight;
        let found = Rows::new(batch, |tile| {
            let (column, row) = (tile.column, tile.row);
            let found = window.find(self.upper(column, row)) & self.within(column, row);
            match weight {
                Weight::Inside(border) if !tile.inside => found & border.touched(column * SIDE, row * SIDE),
                _ => found,
            }
        });
        let Batch { asked, touched, .. } = batch;
        for (slot, k, lanes) in found.iter() {
            let Asked {
                column, row, inside, ..
            } = asked[slot];
            let (x, y) = self.cells(column, row, k as usize);
            let lanes = lanes & sums.near(x, y);
            match weight {
                Weight::Alike(weight) => sums.add_alike(lanes, x, y, weight),
                Weight::Inside(_) if inside => sums.add_alike(lanes, x, y, 1.0),
                Weight::Inside(border) => {
                    let columns = LANES + (column * SIDE) as f32;
                    let rows = f32x8::splat((row * SIDE + k) as f32);
                    touched.add(&Near { lanes, x, y }, [columns, rows], border, sums);
                }
            }
        }
        if let Weight::Inside(border) = weight {
            touched.flush(border, sums);
        }
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
    fn cells(&self, column: u32, tile_row: u32, row: usize) -> (f32x8, f32x8) {
        let (upper, tile) = (self.upper(column, tile_row), self.lower(column, tile_row));
        let eight = |axis: usize| {
            let bytes: &[u8; 8] = upper.0[axis][8 * row..][..8].try_into().expect("eight bytes");
            widened(bytes)
        };
        let mut lower = u32x8::ZERO;
        for Part { unit, bits, shift } in parts(self.lower_width()) {
            let part = match bits {
                8 => {
                    let [a, b] = [tile[unit + 2 * row], tile[unit + 2 * row + 1]];
                    u32x8::new([a, a, a, a, b, b, b, b]) >> u32x8::new([0, 8, 16, 24, 0, 8, 16, 24])
                }
                4 => u32x8::splat(tile[unit + row]) >> u32x8::new([0, 4, 8, 12, 16, 20, 24, 28]),
                _ => {
                    let pairs = tile[unit + row / 2] >> (row % 2 * 16);
                    u32x8::splat(pairs) >> u32x8::new([0, 2, 4, 6, 8, 10, 12, 14])
                }
            };
            lower |= (part & u32x8::splat((1 << bits) - 1)) << shift;
        }
        let [bits_x, bits_y] = self.lower_bits;
        let mask = |bits: u32| u32x8::splat((1 << bits) - 1);
        let x = eight(0) << bits_x | lower & mask(bits_x);
        let y = eight(1) << bits_y | lower >> bits_x & mask(bits_y);
        (to_float(x), to_float(y))
    }

    #[inline(always)]
    fn index(&self, column: u32, row: u32) -> usize {
        row as usize * self.size().0 as usize + column as usize
    }

    /// The upper bytes of a tile.
    #[inline(always)]
    fn upper(&self, column: u32, row: u32) -> &Upper {
        &self.upper[self.index(column, row)]
    }

    /// The lower bits of a tile.
    #[inline(always)]
    fn lower(&self, column: u32, row: u32) -> &[u32] {
        let units = self.units_per_tile();
        &self.lower[self.index(column, row) * units..][..units]
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

/// Bits of the lower numbers of a tile.
struct Part {
    /// First unit.
    unit: usize,
    bits: u32,
    /// Their place in the number.
    shift: u32,
}

/// The parts of lower numbers of `width` bits.
#[inline(always)]
fn parts(width: u32) -> impl Iterator<Item = Part> {
    let (mut unit, mut shift) = (0, 0);
    std::iter::from_fn(move || {
        let bits = [8, 4, 2].into_iter().find(|&bits| bits <= width - shift)?;
        let part = Part { unit, bits, shift };
        unit += TEXELS / 32 * bits as usize;
        shift += bits;
        Some(part)
    })
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
