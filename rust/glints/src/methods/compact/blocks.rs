//! Quantised normals sorted by direction, block by block: for roughnesses so low that few texels of a footprint matter.
//!
//! **Layout** The map is cut into blocks of `2^s x 2^s` texels (s = 6 to 9; smaller at the map's far sides). The
//! [`Grid`] of quantised normals is grouped into cells of `2^r x 2^r`; the texels of a block are sorted by cell, row of
//! cells by row. Of a texel only what its cell does not say is stored, in one word:
//!
//! | bits | |
//! |---|---|
//! | `2 s` | where the texel lies in its block, row by row |
//! | `r`, `r` | where its normal lies in its cell, x and y |
//!
//! `offsets` says where a cell begins, from the beginning of its row of cells, `rows` where the rows of cells begin. Only
//! cells between the first and the last one that the map has anywhere in a row of cells are kept.
//!
//! The bin map B is not stored a second time: the texel at a given place is found by inverting the sort, a permutation pi
//! from the sorted order to places. Munro, Raman, Raman, Rao: *Succinct representations of permutations and functions*
//! (2012), Section 2: following pi around its cycle from any place leads back to it in the end; one in [`STRIDE`]
//! elements has a pointer to the previous such one on its cycle, which shortens the way to about `2 STRIDE` steps for one
//! bit a texel. A pointer is the number of another element that has one, so that 16 bits suffice.
//!
//! **Query** Of every block that meets the footprint, the words of the few cells within reach of the half vector, eight at a
//! time.

use rayon::prelude::*;
use wide::{CmpGe, f32x8, u32x8};

use super::border::{Touched, Weight};
use super::cover::Rect;
use super::grid::Grid;
use super::lanes::{LANES, lane_mask};
use super::lobes::{Near, Sums};
use super::packing::{GROUP, Packed, pack, prefetch, to_float, units_per_group};
use crate::array::Array;
use crate::normal_map::NormalMap;

/// One in so many elements of the permutation has a pointer.
pub const STRIDE: usize = 16;

/// Least and greatest s. A pointer of 16 bits tells `2^(2 s) / STRIDE` elements apart.
pub const SIDE_BITS: [u32; 2] = [6, 9];

/// Spreads the elements that have pointers, whatever pattern a permutation follows; any odd number would do.
const SPREAD: u32 = 40_503;

/// Its inverse modulo 2^32, and so modulo any smaller power of two.
const INV_SPREAD: u32 = inverse(SPREAD);

/// Newton's iteration doubles the number of right bits, of which an odd number is its own inverse for three.
const fn inverse(odd: u32) -> u32 {
    let (mut inverse, mut k) = (odd, 0);
    while k < 4 {
        inverse = inverse.wrapping_mul(2_u32.wrapping_sub(odd.wrapping_mul(inverse)));
        k += 1;
    }
    inverse
}

/// Sizes that follow from the map and the roughness.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geometry {
    /// Columns and rows of the map.
    pub map: (u32, u32),
    /// s.
    pub side_bits: u32,
    /// r.
    pub cell_bits: u32,
    pub grid: Grid,
}

/// The texels of one block.
#[derive(Clone, Copy)]
pub struct Block {
    /// Corner, columns and rows.
    x: u32,
    y: u32,
    width: u32,
    height: u32,
    index: usize,
}

/// See the module.
pub struct Blocks {
    geometry: Geometry,
    pub words: Packed,
    /// First group of each block, and of what would come after the last.
    starts: Array<u32>,
    /// For each row of cells, the first cell, the number of cells, and the number of cells in the rows before.
    pub extents: Array<[u32; 3]>,
    /// For each block, where its rows of cells begin, and its number of texels.
    pub rows: Array<u32>,
    pub offsets: Offsets,
    /// For each block, the pointers of its permutation.
    pub pointers: Array<u16>,
}

/// Beginnings of cells; 16 bits suffice where no row of cells of a block holds 2^16 texels.
pub enum Offsets {
    Narrow(Array<u16>),
    Wide(Array<u32>),
}

impl Offsets {
    #[inline]
    pub fn get(&self, index: usize) -> usize {
        match self {
            Self::Narrow(offsets) => offsets[index] as usize,
            Self::Wide(offsets) => offsets[index] as usize,
        }
    }

    pub fn bytes(&self) -> usize {
        match self {
            Self::Narrow(offsets) => offsets.bytes(),
            Self::Wide(offsets) => offsets.bytes(),
        }
    }

    #[inline]
    fn prefetch(&self, index: usize) {
        match self {
            Self::Narrow(offsets) => prefetch(offsets, index..index + 1),
            Self::Wide(offsets) => prefetch(offsets, index..index + 1),
        }
    }
}

/// The arrays of [`Blocks`], as they are stored.
pub struct Parts {
    pub words: Array<u32>,
    pub starts: Array<u32>,
    pub extents: Array<[u32; 3]>,
    pub rows: Array<u32>,
    pub offsets: Offsets,
    pub pointers: Array<u16>,
}

impl Geometry {
    /// Bits of a word.
    pub fn bits(&self) -> u32 {
        2 * (self.side_bits + self.cell_bits)
    }

    fn side(&self) -> u32 {
        1 << self.side_bits
    }

    /// Columns and rows of blocks.
    fn blocks(&self) -> (u32, u32) {
        (self.map.0.div_ceil(self.side()), self.map.1.div_ceil(self.side()))
    }

    pub fn block_count(&self) -> usize {
        self.blocks().0 as usize * self.blocks().1 as usize
    }

    pub fn block(&self, index: usize) -> Block {
        let columns = self.blocks().0 as usize;
        let (x, y) = (
            (index % columns) as u32 * self.side(),
            (index / columns) as u32 * self.side(),
        );
        Block {
            x,
            y,
            width: self.side().min(self.map.0 - x),
            height: self.side().min(self.map.1 - y),
            index,
        }
    }

    fn block_at(&self, column: u32, row: u32) -> Block {
        let index =
            (row >> self.side_bits) as usize * self.blocks().0 as usize + (column >> self.side_bits) as usize;
        self.block(index)
    }

    /// Rows of cells.
    pub fn cell_rows(&self) -> usize {
        (self.grid.size[1] as usize).div_ceil(1 << self.cell_bits)
    }

    /// Pointers of a block.
    pub fn pointers(&self) -> usize {
        self.places() / STRIDE
    }

    /// Texels of a block of full size.
    pub fn places(&self) -> usize {
        1 << (2 * self.side_bits)
    }

    /// First group of each block, and of what would come after the last.
    pub fn starts(&self) -> Vec<u32> {
        let mut starts = vec![0_u32];
        for index in 0..self.block_count() {
            starts.push(starts[index] + self.block(index).texels().div_ceil(GROUP) as u32);
        }
        starts
    }

    /// 32-bit units of all words.
    pub fn units(&self) -> usize {
        let groups = |index| self.block(index).texels().div_ceil(GROUP);
        (0..self.block_count()).map(groups).sum::<usize>() * units_per_group(self.bits())
    }

    /// The pointer of an element of a block's permutation, if it has one.
    #[inline]
    fn pointer(&self, element: u32) -> Option<usize> {
        let spread = element.wrapping_mul(SPREAD) & ((1 << (2 * self.side_bits)) - 1);
        ((spread as usize) < self.pointers()).then_some(spread as usize)
    }

    /// The element that has a pointer: the inverse of [`Self::pointer`].
    #[inline]
    pub fn pointed(&self, pointer: u16) -> u32 {
        u32::from(pointer).wrapping_mul(INV_SPREAD) & ((1 << (2 * self.side_bits)) - 1)
    }
}

impl Block {
    pub fn texels(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

impl Blocks {
    pub fn new(map: &NormalMap, geometry: Geometry) -> Self {
        let (extents, is_wide) = survey(map, &geometry);
        let units = units_per_group(geometry.bits());
        let starts = geometry.starts();
        let cells = extents.last().map_or(0, |row| (row[1] + row[2]) as usize);
        let blocks = geometry.block_count();
        let mut words = vec![0; starts[blocks] as usize * units];
        let mut rows = vec![0; blocks * (geometry.cell_rows() + 1)];
        let mut pointers = vec![0; blocks * geometry.pointers()];
        let mut narrow = vec![0_u16; if is_wide { 0 } else { blocks * cells }];
        let mut wide = vec![0_u32; if is_wide { blocks * cells } else { 0 }];

        let mut tasks = Vec::with_capacity(blocks);
        {
            let (mut words, mut rows) = (words.as_mut_slice(), rows.as_mut_slice());
            let (mut pointers, mut narrow, mut wide) = (
                pointers.as_mut_slice(),
                narrow.as_mut_slice(),
                wide.as_mut_slice(),
            );
            for index in 0..blocks {
                let groups = (starts[index + 1] - starts[index]) as usize;
                tasks.push(Task {
                    words: take(&mut words, groups * units),
                    rows: take(&mut rows, geometry.cell_rows() + 1),
                    pointers: take(&mut pointers, geometry.pointers()),
                    narrow: take(&mut narrow, if is_wide { 0 } else { cells }),
                    wide: take(&mut wide, if is_wide { cells } else { 0 }),
                    block: geometry.block(index),
                });
            }
        }
        tasks
            .into_par_iter()
            .for_each(|task| task.fill(map, &geometry, &extents));
        Self::from_parts(
            geometry,
            Parts {
                words: words.into(),
                starts: starts.into(),
                extents: extents.into(),
                rows: rows.into(),
                offsets: if is_wide {
                    Offsets::Wide(wide.into())
                } else {
                    Offsets::Narrow(narrow.into())
                },
                pointers: pointers.into(),
            },
        )
    }

    pub fn from_parts(geometry: Geometry, parts: Parts) -> Self {
        Self {
            geometry,
            words: Packed::new(parts.words, geometry.bits()),
            starts: parts.starts,
            extents: parts.extents,
            rows: parts.rows,
            offsets: parts.offsets,
            pointers: parts.pointers,
        }
    }

    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    pub fn bytes(&self) -> usize {
        self.words.units().bytes()
            + self.starts.bytes()
            + self.extents.bytes()
            + self.rows.bytes()
            + self.offsets.bytes()
            + self.pointers.bytes()
    }

    /// The cell of a texel's normal.
    pub fn cell(&self, column: u32, row: u32) -> [u32; 2] {
        let block = self.geometry.block_at(column, row);
        let place = (row - block.y) * block.width + column - block.x;
        let entry = self.find(&block, place);
        self.grid_cell(&block, entry)
    }

    #[inline]
    fn place_mask(&self) -> u32 {
        ((1_u64 << (2 * self.geometry.side_bits)) - 1) as u32
    }

    /// Where the rows of cells of a block begin, and its number of texels.
    pub fn rows_of(&self, block: &Block) -> &[u32] {
        let count = self.geometry.cell_rows() + 1;
        &self.rows[block.index * count..][..count]
    }

    pub fn pointers_of(&self, block: &Block) -> &[u16] {
        let count = self.geometry.pointers();
        &self.pointers[block.index * count..][..count]
    }

    /// Place of an element of the sorted order.
    pub fn place(&self, block: &Block, element: u32) -> u32 {
        let first = self.starts[block.index] as usize * GROUP;
        self.words.word(first + element as usize) & self.place_mask()
    }

    /// Position in the sorted order of the texel at a place: inverse of the permutation.
    fn find(&self, block: &Block, place: u32) -> u32 {
        let first = self.starts[block.index] as usize * GROUP;
        let pointers = self.pointers_of(block);
        let (mut element, mut shortened) = (place, false);
        // The bound is for damaged files only.
        for _ in 0..=2 * block.texels() {
            let next = self.words.word(first + element as usize) & self.place_mask();
            if next == place {
                break;
            }
            match self.geometry.pointer(element) {
                Some(pointer) if !shortened => {
                    element = self.geometry.pointed(pointers[pointer]);
                    shortened = true;
                }
                _ => element = next,
            }
        }
        element
    }

    /// Steps that [`Self::find`] takes to a place of the first block.
    #[cfg(test)]
    pub fn steps(&self, place: u32) -> usize {
        let block = self.geometry.block(0);
        let end = self.find(&block, place);
        let pointers = &self.pointers[..self.geometry.pointers()];
        let (mut element, mut shortened, mut steps) = (place, false, 0);
        while element != end {
            element = match self.geometry.pointer(element) {
                Some(pointer) if !shortened => {
                    shortened = true;
                    self.geometry.pointed(pointers[pointer])
                }
                _ => self.words.word(element as usize) & self.place_mask(),
            };
            steps += 1;
        }
        steps
    }

    /// The cell on the fine grid of an entry of the sorted order.
    fn grid_cell(&self, block: &Block, entry: u32) -> [u32; 2] {
        let count = self.geometry.cell_rows();
        let rows = &self.rows[block.index * (count + 1)..][..count];
        let row = rows.partition_point(|&start| start <= entry).max(1) - 1;
        let [first, cells, before] = self.extents[row];
        let base = self.cell_base(block) + before as usize;
        let offset = (entry - rows[row]) as usize;
        // The last cell that begins at or before the entry: cells that begin later do not hold it.
        let (mut low, mut high) = (0, cells as usize);
        while high - low > 1 {
            let middle = (low + high) / 2;
            if self.offsets.get(base + middle) <= offset {
                low = middle;
            } else {
                high = middle;
            }
        }
        let word = self
            .words
            .word(self.starts[block.index] as usize * GROUP + entry as usize)
            >> (2 * self.geometry.side_bits);
        let bits = self.geometry.cell_bits;
        let rest = (1 << bits) - 1;
        [
            (first + low as u32) << bits | word & rest,
            (row as u32) << bits | word >> bits & rest,
        ]
    }

    /// Index of the first offset of a block.
    pub fn cell_base(&self, block: &Block) -> usize {
        let [_, cells, before] = self.extents[self.extents.len() - 1];
        block.index * (cells + before) as usize
    }
}

/// Blocks of which the texels near a half vector are to be added.
///
/// What a block holds lies in three places far apart, each known from the one before. Blocks wait for each other here, and
/// ask for what they will read before the first is read.
pub struct Reader<'a> {
    blocks: &'a Blocks,
    /// The half vector's projection and the reach, in cells.
    center: [f32; 2],
    reach: f32,
    asked: [Asked<'a>; BATCH],
    asked_len: usize,
    runs: [Run; RUNS],
    runs_len: usize,
    touched: Touched,
}

const BATCH: usize = 16;
const RUNS: usize = 32;

/// Most cells of a run.
const RUN_CELLS: usize = 16;

/// A block, and what its texels weigh.
#[derive(Clone, Copy)]
struct Asked<'a> {
    block: Block,
    weight: Weight<'a>,
}

/// Neighbouring cells of one row of cells in a block: their texels lie one behind the other.
#[derive(Clone, Copy, Default)]
struct Run {
    asked: u32,
    /// Texels in the sorted order of the block.
    begin: u32,
    end: u32,
    /// First texel of the row of cells; indices of the offsets of the cells behind the first, and of the one behind the
    /// last.
    row: u32,
    next: u32,
    last: u32,
    /// Corner of the first cell, in cells of the grid.
    x0: f32,
    y0: f32,
}

impl<'a> Reader<'a> {
    pub fn new(blocks: &'a Blocks, sums: &Sums) -> Self {
        let grid = &blocks.geometry.grid;
        let cell = grid.pitch * (1 << blocks.geometry.cell_bits) as f32;
        let center = (sums.query.half.truncate() - grid.low) / cell;
        Self {
            blocks,
            center: center.to_array(),
            reach: sums.reach() / cell,
            asked: [Asked {
                block: blocks.geometry.block(0),
                weight: Weight::alike(0.0),
            }; BATCH],
            asked_len: 0,
            runs: [Run::default(); RUNS],
            runs_len: 0,
            touched: Touched::new(),
        }
    }

    /// Adds the texels of the block at a corner.
    pub fn add(&mut self, rect: &Rect, weight: Weight<'a>, sums: &mut Sums) {
        let block = self.blocks.geometry.block_at(rect.low.0, rect.low.1);
        let base = self.blocks.cell_base(&block);
        let rows = block.index * (self.blocks.geometry.cell_rows() + 1);
        for row in self.rows() {
            let [first, cells, before] = self.blocks.extents[row];
            let (start, _) = self.columns(row, first, cells);
            self.blocks.offsets.prefetch(base + (before + start) as usize);
        }
        prefetch(
            &self.blocks.rows,
            rows + self.rows().start..rows + self.rows().end + 1,
        );
        self.asked[self.asked_len] = Asked { block, weight };
        self.asked_len += 1;
        if self.asked_len == BATCH {
            self.flush(sums);
        }
    }

    /// Adds what waits.
    pub fn flush(&mut self, sums: &mut Sums) {
        for index in 0..self.asked_len {
            for row in self.rows() {
                self.find_runs(index, row, sums);
            }
        }
        self.read(sums);
        self.asked_len = 0;
    }

    /// Rows of cells within reach.
    #[inline]
    fn rows(&self) -> std::ops::Range<usize> {
        let (y, reach) = (self.center[1], self.reach);
        let first = (y - reach).max(0.0) as usize;
        let end = ((y + reach).max(-1.0) + 1.0) as usize;
        first..end.min(self.blocks.geometry.cell_rows())
    }

    /// Of the cells that a row of cells has, `cells` from `first` on, those within reach: from the first one on.
    #[inline]
    fn columns(&self, row: usize, first: u32, cells: u32) -> (u32, u32) {
        let [x, y] = self.center;
        // Nearest distance of the row of cells to the centre, and what is left of the reach along it.
        let dy = (row as f32 - y).max(y - row as f32 - 1.0).max(0.0);
        let half = (self.reach * self.reach - dy * dy).max(0.0).sqrt();
        let start = ((x - half).max(0.0) as u32).clamp(first, first + cells) - first;
        let end =
            ((x + half).max(-1.0) as i32 + 1).clamp(first as i32, (first + cells) as i32) as u32 - first;
        (start, end)
    }

    #[inline]
    fn find_runs(&mut self, asked: usize, row: usize, sums: &mut Sums) {
        let [first, cells, _] = self.blocks.extents[row];
        let (start, end) = self.columns(row, first, cells);
        for start in (start..end).step_by(RUN_CELLS) {
            self.find_run(asked, row, (start, end.min(start + RUN_CELLS as u32)));
            if self.runs_len == RUNS {
                self.read(sums);
            }
        }
    }

    /// The run of the cells from `start` to `end` of a row of cells.
    #[inline]
    fn find_run(&mut self, asked: usize, row: usize, (start, end): (u32, u32)) {
        let blocks = self.blocks;
        let block = &self.asked[asked].block;
        let [first, cells, before] = blocks.extents[row];
        let rows = blocks.rows_of(block);
        let next = blocks.cell_base(block) + (before + start) as usize + 1;
        let offset = |cell: u32| {
            if cell < cells {
                rows[row] + blocks.offsets.get(next + (cell - start) as usize - 1) as u32
            } else {
                rows[row + 1]
            }
        };
        let bits = blocks.geometry.cell_bits;
        let run = Run {
            asked: asked as u32,
            begin: offset(start),
            end: offset(end),
            row: rows[row],
            next: next as u32,
            last: next as u32 + (end - start) - 1,
            x0: ((first + start) << bits) as f32,
            y0: ((row as u32) << bits) as f32,
        };
        if run.begin >= run.end {
            return;
        }
        let groups = blocks.starts[block.index] as usize;
        blocks
            .words
            .prefetch(groups + run.begin as usize / GROUP..groups + (run.end as usize).div_ceil(GROUP));
        self.runs[self.runs_len] = run;
        self.runs_len += 1;
    }

    /// Reads all runs.
    fn read(&mut self, sums: &mut Sums) {
        let Self { touched, .. } = self;
        for runs in self.runs[..self.runs_len].chunk_by(|a, b| a.asked == b.asked) {
            let Asked { block, weight } = &self.asked[runs[0].asked as usize];
            for run in runs {
                if weight.cuts.is_empty() {
                    self.blocks.for_each_near(block, run, sums, |sums, near, _| {
                        sums.add_alike(near.lanes, near.x, near.y, weight.base);
                    });
                } else {
                    self.blocks.for_each_near(block, run, sums, |sums, near, words| {
                        touched.add(near, self.blocks.positions(block, words), weight, sums);
                    });
                }
            }
            touched.flush(weight, sums);
        }
        self.runs_len = 0;
    }
}

impl Blocks {
    /// Columns and rows of texels.
    #[inline(always)]
    fn positions(&self, block: &Block, words: u32x8) -> [f32x8; 2] {
        let places = to_float(words & u32x8::splat(self.place_mask()));
        let rows = ((places + 0.5) * (1.0 / block.width as f32)).floor();
        let columns = places - rows * block.width as f32;
        [columns + block.x as f32, rows + block.y as f32]
    }

    /// Calls `visit` with the texels of a run, eight at a time, and their words.
    #[inline(always)]
    fn for_each_near(
        &self,
        block: &Block,
        run: &Run,
        sums: &mut Sums,
        mut visit: impl FnMut(&mut Sums, &Near, u32x8),
    ) {
        let bits = self.geometry.cell_bits;
        let (rest, shift) = (u32x8::splat((1 << bits) - 1), 2 * self.geometry.side_bits);
        let cell = (1 << bits) as f32;
        let start = self.starts[block.index] as usize;
        let (begin, end) = (run.begin as usize, run.end as usize);
        let (x0, y0) = (f32x8::splat(run.x0), f32x8::splat(run.y0));
        // Where the cells behind the first begin. Every group is compared with all of them: a loop that goes on with the
        // next one only when it begins takes a wrong guess for each.
        let mut bounds = [0.0; RUN_CELLS];
        let bounds = &mut bounds[..(run.last - run.next) as usize];
        for (bound, next) in bounds.iter_mut().zip(run.next..run.last) {
            *bound = (run.row as usize + self.offsets.get(next as usize)) as f32;
        }
        for group in begin / GROUP..end.div_ceil(GROUP) {
            let first = group * GROUP;
            let words = self.words.group(start + group);
            let elements = LANES + first as f32;
            let mut lanes_x0 = x0;
            for &bound in bounds.iter() {
                lanes_x0 += elements.cmp_ge(f32x8::splat(bound)) & f32x8::splat(cell);
            }
            let x = to_float(words >> shift & rest) + lanes_x0;
            let y = to_float(words >> (shift + bits) & rest) + y0;
            let lanes = sums.near(x, y) & lane_mask((begin as i64, end as i64), first as i64);
            visit(sums, &Near { lanes, x, y }, words);
        }
    }
}

/// Where one block is written.
struct Task<'a> {
    block: Block,
    words: &'a mut [u32],
    rows: &'a mut [u32],
    narrow: &'a mut [u16],
    wide: &'a mut [u32],
    pointers: &'a mut [u16],
}

impl Task<'_> {
    fn fill(self, map: &NormalMap, geometry: &Geometry, extents: &[[u32; 3]]) {
        let block = self.block;
        let bits = geometry.cell_bits;
        let cell_of = |[x, y]: [u32; 2]| {
            let [first, _, before] = extents[(y >> bits) as usize];
            (before + (x >> bits) - first) as usize
        };
        let fine: Vec<[u32; 2]> = (0..block.texels() as u32)
            .map(|place| {
                geometry
                    .grid
                    .cell(map.normal(block.x + place % block.width, block.y + place / block.width))
            })
            .collect();
        let cells = extents.last().map_or(0, |row| (row[1] + row[2]) as usize);
        let mut next = vec![0_u32; cells + 1];
        for &cell in &fine {
            next[cell_of(cell) + 1] += 1;
        }
        for cell in 0..cells {
            next[cell + 1] += next[cell];
        }
        for (row, &[_, count, before]) in extents.iter().enumerate() {
            let start = next[before as usize];
            self.rows[row] = start;
            let range = before as usize..(before + count) as usize;
            for (cell, &begin) in range.clone().zip(&next[range]) {
                let offset = begin - start;
                match self.narrow.get_mut(cell) {
                    Some(narrow) => *narrow = offset as u16,
                    None => self.wide[cell] = offset,
                }
            }
        }
        self.rows[extents.len()] = block.texels() as u32;

        let rest = (1 << bits) - 1;
        let shift = 2 * geometry.side_bits;
        let mut sorted = vec![0_u32; block.texels().next_multiple_of(GROUP)];
        for (place, &[x, y]) in fine.iter().enumerate() {
            let slot = &mut next[cell_of([x, y])];
            sorted[*slot as usize] =
                (u64::from((x & rest) | (y & rest) << bits) << shift) as u32 | place as u32;
            *slot += 1;
        }
        let units = units_per_group(geometry.bits());
        for (words, group) in sorted.chunks_exact(GROUP).zip(self.words.chunks_exact_mut(units)) {
            pack(words.try_into().expect("a group"), geometry.bits(), group);
        }
        let place_mask = ((1_u64 << shift) - 1) as u32;
        sorted.truncate(block.texels());
        link(geometry, &sorted, place_mask, self.pointers);
    }
}

/// Sets the pointers of a permutation, `sorted & mask`: each to the previous element on its cycle that has one.
fn link(geometry: &Geometry, sorted: &[u32], mask: u32, pointers: &mut [u16]) {
    let mut visited = vec![false; sorted.len()];
    for start in 0..sorted.len() {
        if visited[start] {
            continue;
        }
        let (mut first, mut previous) = (None, None);
        let mut element = start;
        loop {
            visited[element] = true;
            if let Some(pointer) = geometry.pointer(element as u32) {
                match previous {
                    Some(previous) => pointers[pointer] = previous,
                    None => first = Some(pointer),
                }
                previous = Some(pointer as u16);
            }
            element = (sorted[element] & mask) as usize;
            if element == start {
                break;
            }
        }
        if let (Some(first), Some(last)) = (first, previous) {
            pointers[first] = last;
        }
    }
}

/// Which cells each row of cells needs, and whether some row of cells of some block holds 2^16 texels.
fn survey(map: &NormalMap, geometry: &Geometry) -> (Vec<[u32; 3]>, bool) {
    let rows = geometry.cell_rows();
    let bits = geometry.cell_bits;
    let (ranges, is_wide) = (0..geometry.block_count())
        .into_par_iter()
        .map(|index| {
            let block = geometry.block(index);
            let mut ranges = vec![(u32::MAX, 0); rows];
            let mut counts = vec![0_u32; rows];
            for row in block.y..block.y + block.height {
                for column in block.x..block.x + block.width {
                    let [x, y] = geometry.grid.cell(map.normal(column, row)).map(|c| c >> bits);
                    let range = &mut ranges[y as usize];
                    *range = (range.0.min(x), range.1.max(x + 1));
                    counts[y as usize] += 1;
                }
            }
            (ranges, counts.iter().any(|&count| count > u32::from(u16::MAX)))
        })
        .reduce(
            || (vec![(u32::MAX, 0); rows], false),
            |(mut a, wide_a), (b, wide_b)| {
                for (a, b) in a.iter_mut().zip(b) {
                    *a = (a.0.min(b.0), a.1.max(b.1));
                }
                (a, wide_a || wide_b)
            },
        );
    let mut before = 0;
    let extents = ranges
        .into_iter()
        .map(|(first, end)| {
            let first = first.min(end);
            let extent = [first, end - first, before];
            before += end - first;
            extent
        })
        .collect();
    (extents, is_wide)
}

/// The first `count` elements of a slice, which is shortened by them.
fn take<'a, T>(rest: &mut &'a mut [T], count: usize) -> &'a mut [T] {
    let (taken, others) = std::mem::take(rest).split_at_mut(count);
    *rest = others;
    taken
}
