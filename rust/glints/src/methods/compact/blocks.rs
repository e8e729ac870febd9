//! Quantised normals sorted by direction, block by block: for roughnesses so low that few texels of a footprint matter.
//!
//! **Layout** The map is cut into blocks of `2^s x 2^s` texels (s = 6, 7 or 8; smaller at the map's far sides). The
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
//! bit a texel.
//!
//! **Query** Of every block that meets the footprint, the words of the few cells within reach of the half vector, eight at a
//! time.

use glam::{DVec2, Vec3};
use rayon::prelude::*;
use wide::{CmpGe, CmpLe, f32x8, u32x8};

use super::array::Array;
use super::cover::Rect;
use super::grid::Grid;
use super::lobes::{Sums, bits, lifted};
use super::packing::{GROUP, Packed, pack, to_float, units_per_group};
use super::rows::lane_mask;
use crate::footprint::Parallelogram;
use crate::normal_map::NormalMap;

/// One in so many elements of the permutation has a pointer.
pub const STRIDE: usize = 16;

/// Spreads the elements that have pointers, whatever pattern a permutation follows; any odd number would do.
const SPREAD: u32 = 40_503;

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

    /// Adds all texels of the block at a corner, each with the weight `weight`.
    pub fn add_all(&self, rect: &Rect, weight: f32, sums: &mut Sums) {
        let weights = f32x8::splat(weight);
        self.for_each_near(&self.block_of(rect), sums, |sums, near, _| {
            sums.add(near.lanes, near.x, near.y, weights);
        });
    }

    /// Adds the texels of the block at a corner, each with its area in the region.
    pub fn add(&self, region: &Parallelogram, rect: &Rect, sums: &mut Sums) {
        let block = self.block_of(rect);
        let places = Places::new(region, &block, self.place_mask());
        self.for_each_near(&block, sums, |sums, near, words| {
            let (lanes, weights) = places.weights(words, near.lanes);
            sums.add(lanes, near.x, near.y, weights);
        });
    }

    /// The normal of a texel, quantised.
    pub fn normal(&self, column: u32, row: u32) -> Vec3 {
        let block = self.geometry.block_at(column, row);
        let place = (row - block.y) * block.width + column - block.x;
        let entry = self.find(&block, place);
        let p = self.geometry.grid.point(self.grid_cell(&block, entry));
        lifted(p.x, p.y)
    }

    /// A normal, quantised.
    pub fn quantised(&self, normal: Vec3) -> Vec3 {
        let grid = &self.geometry.grid;
        let p = grid.point(grid.cell(normal));
        lifted(p.x, p.y)
    }

    fn block_of(&self, rect: &Rect) -> Block {
        self.geometry.block_at(rect.low.0, rect.low.1)
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
                    element = u32::from(pointers[pointer]);
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
                    u32::from(pointers[pointer])
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

    /// Calls `visit` with the texels of a block that may be within reach, eight at a time, and their words.
    #[inline]
    fn for_each_near(&self, block: &Block, sums: &mut Sums, mut visit: impl FnMut(&mut Sums, &Near, u32x8)) {
        let grid = &self.geometry.grid;
        let bits = self.geometry.cell_bits;
        let cell = grid.pitch * (1 << bits) as f32;
        let center = (sums.query.half.truncate() - grid.low) / cell;
        let reach = sums.reach() / cell;
        let count = self.geometry.cell_rows();
        let rows = &self.rows[block.index * (count + 1)..][..=count];
        let base = self.cell_base(block);
        let first_row = (center.y - reach).max(0.0) as usize;
        let last_row = ((center.y + reach).max(-1.0) + 1.0) as usize;
        for row in first_row..last_row.min(count) {
            // Nearest distance of the row of cells to the centre, and what is left of the reach along it.
            let dy = (row as f32 - center.y).max(center.y - row as f32 - 1.0).max(0.0);
            let half = (reach * reach - dy * dy).max(0.0).sqrt();
            let [first, cells, before] = self.extents[row];
            let start = ((center.x - half).max(0.0) as u32).clamp(first, first + cells) - first;
            let end = ((center.x + half).max(-1.0) as i32 + 1).clamp(first as i32, (first + cells) as i32)
                as u32
                - first;
            let offset = |cell: u32| {
                if cell < cells {
                    rows[row] as usize + self.offsets.get(base + (before + cell) as usize)
                } else {
                    rows[row + 1] as usize
                }
            };
            let y0 = f32x8::splat(((row as u32) << bits) as f32);
            let mut begin = if start < end { offset(start) } else { 0 };
            for cell in start..end {
                let finish = offset(cell + 1);
                let x0 = f32x8::splat(((first + cell) << bits) as f32);
                self.visit_run(block, (begin, finish), (x0, y0), sums, &mut visit);
                begin = finish;
            }
        }
    }

    #[inline]
    fn visit_run(
        &self,
        block: &Block,
        (begin, end): (usize, usize),
        (x0, y0): (f32x8, f32x8),
        sums: &mut Sums,
        visit: &mut impl FnMut(&mut Sums, &Near, u32x8),
    ) {
        let Geometry {
            side_bits,
            cell_bits,
            grid,
            ..
        } = &self.geometry;
        let rest = u32x8::splat((1 << cell_bits) - 1);
        let shift = 2 * side_bits;
        let start = self.starts[block.index] as usize;
        for group in begin / GROUP..end.div_ceil(GROUP) {
            let words = self.words.group(start + group);
            let x = to_float(words >> shift & rest) + x0;
            let y = to_float(words >> (shift + cell_bits) & rest) + y0;
            let (x, y) = (grid.middle(0, x), grid.middle(1, y));
            let lanes = sums.near(x, y) & lane_mask((begin as i64, end as i64), (group * GROUP) as i64);
            if lanes != 0 {
                visit(sums, &Near { lanes, x, y }, words);
            }
        }
    }
}

/// Projected normals of which those in `lanes` may be within reach.
struct Near {
    lanes: u32,
    x: f32x8,
    y: f32x8,
}

/// A region seen from a block: which places lie inside it.
struct Places<'a> {
    region: &'a Parallelogram,
    corner: (u32, u32),
    width: f32,
    inv_width: f32,
    place_mask: u32,
    /// Of s and t: gradient, value at the centre of the block's first texel, and half the variation over a texel.
    slabs: [(f32, f32, f32, f32); 2],
}

impl<'a> Places<'a> {
    fn new(region: &'a Parallelogram, block: &Block, place_mask: u32) -> Self {
        let first = DVec2::new(f64::from(block.x) + 0.5, f64::from(block.y) + 0.5);
        let slabs = region.slabs_at(first).map(|(gradient, value)| {
            // Single precision places a texel to 1e-4 of a texel: what is nearer to the border is left to the exact area.
            let variation = (0.5 + 2e-4) * (gradient.x.abs() + gradient.y.abs());
            (
                gradient.x as f32,
                gradient.y as f32,
                value as f32,
                variation as f32,
            )
        });
        Self {
            region,
            corner: (block.x, block.y),
            width: block.width as f32,
            inv_width: 1.0 / block.width as f32,
            place_mask,
            slabs,
        }
    }

    /// Which of the texels of eight words are not outside the region, and their areas in it.
    #[inline]
    fn weights(&self, words: u32x8, lanes: u32) -> (u32, f32x8) {
        let place = to_float(words & u32x8::splat(self.place_mask));
        let y = ((place + 0.5) * self.inv_width).floor();
        let x = place - y * self.width;
        let (mut inside, mut outside) = (u32::MAX, 0);
        for (gx, gy, value, variation) in self.slabs {
            let s = x
                .mul_add(f32x8::splat(gx), y.mul_add(f32x8::splat(gy), f32x8::splat(value)))
                .abs();
            inside &= (s + variation).cmp_le(f32x8::splat(0.5)).move_mask() as u32;
            outside |= (s - variation).cmp_ge(f32x8::splat(0.5)).move_mask() as u32;
        }
        let mut weights = f32x8::ONE;
        for k in bits(lanes & !inside & !outside) {
            let (column, row) = (
                self.corner.0 + x.as_array_ref()[k] as u32,
                self.corner.1 + y.as_array_ref()[k] as u32,
            );
            weights.as_array_mut()[k] = self.region.texel_overlap(column, row) as f32;
        }
        (lanes & !outside, weights)
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
                previous = Some(element as u16);
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
