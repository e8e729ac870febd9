//! The inverse bin map B^-1, its index I and its forest F (Section 5.4): where are the texels of bin j inside
//! A?
//!
//! **Layout**
//!
//! * `texels`: indices `row * width + column` of all N texels, sorted by bin (Eq. 19), and within a bin by
//!   the order in which the kd-tree below visits them, so that the texels of every tree node are consecutive.
//! * `starts`: the list of bin j is `texels[starts[j]..starts[j + 1]]`; its length is the total histogram.
//! * Kd-trees, one for each bin of more than `leaf_size` texels. All share their splitting planes: the root
//!   is the whole map, a node of `w x h` texels is split along its longer side (along x if they are equal) at
//!   `floor(side / 2)`, so neither planes nor boxes are stored. A node of at most `leaf_size` texels is a
//!   leaf.
//! * `forest`: inner nodes in preorder, `[texels of the left child]` or, where both children are inner nodes,
//!   `[texels of the left child, words to the right child]`. A node's range of `texels` follows from the
//!   counts on the way down. Words have 16 bits; a node of more than [`NARROW`] texels, of which there are
//!   few, takes two for each number.
//! * `roots` and `has_tree`: the positions of the trees' roots, ranked by a bit vector over the bins.
//!
//! **Construction** One counting sort by bin that visits the texels in kd order: every list comes out sorted,
//! whatever the number of threads. The trees are then read off the lists by binary search. Time O(N log N)
//! with a small constant, memory the result plus one counter a bin.
//!
//! **Query** All bins of a neighbourhood descend together, so each node's box meets the footprint once. A
//! node inside the footprint contributes its count; only cut leaves look at texels.

use std::ops::Range;

use arrayvec::ArrayVec;
use rayon::prelude::*;

use super::bins::{Bin, Neighbourhood, SLOTS, unpack};
use crate::footprint::{Coverage, Parallelogram};
use glam::DVec2;

pub struct InverseMap {
    size: (u32, u32),
    resolution: u32,
    leaf_size: u32,
    texels: Vec<u32>,
    starts: Vec<u32>,
    has_tree: RankedBits,
    roots: Vec<u32>,
    forest: Vec<u16>,
}

/// Most texels of a node whose numbers take one word. Its tree has at most 32 levels (sides of 16 bits), each
/// with at most half as many inner nodes as texels, of at most two words: distances stay below 2^16.
const NARROW: u32 = 2047;

/// A rectangle of texels: a node of every tree.
#[derive(Clone, Copy)]
struct Cell {
    x: u32,
    y: u32,
    width: u32,
    height: u32,
}

/// The texels of one bin inside a cell: a range of `texels`, and the position of the node if it is an inner
/// one.
#[derive(Clone, Copy)]
struct Node {
    slot: u32,
    start: u32,
    count: u32,
    position: u32,
}

/// At most one node a bin of the neighbourhood, empty ones left out.
type Nodes = ArrayVec<Node, SLOTS>;

impl InverseMap {
    /// Inverts `bin_map`, `size.0 * size.1` packed bins on a grid of `resolution^2`; `leaf_size >= 1`.
    pub fn new(bin_map: &[u32], size: (u32, u32), resolution: u32, leaf_size: u32) -> Self {
        let index = |packed: u32| {
            let (x, y) = unpack(packed);
            y as usize * resolution as usize + x as usize
        };
        let starts = list_starts(bin_map.iter().map(|&b| index(b)), resolution);
        let texels = sorted_texels(&starts, size, |texel| index(bin_map[texel as usize]));
        let mut map = Self {
            size,
            resolution,
            leaf_size,
            texels,
            starts,
            has_tree: RankedBits::default(),
            roots: Vec::new(),
            forest: Vec::new(),
        };
        map.grow_forest();
        map
    }

    /// Number of texels of a bin.
    #[inline]
    pub fn count(&self, bin: Bin) -> u32 {
        let j = self.bin_index(bin);
        self.starts[j + 1] - self.starts[j]
    }

    /// The texels of a bin: indices `row * width + column`.
    pub fn texels(&self, bin: Bin) -> &[u32] {
        let j = self.bin_index(bin);
        &self.texels[self.starts[j] as usize..self.starts[j + 1] as usize]
    }

    pub fn bytes(&self) -> usize {
        let words = [&self.texels, &self.starts, &self.roots];
        words.iter().map(|w| size_of_val(w.as_slice())).sum::<usize>()
            + size_of_val(self.forest.as_slice())
            + self.has_tree.bytes()
    }

    /// Adds to each slot the area of its bin's texels inside `region`.
    pub fn add_areas(&self, region: &Parallelogram, bins: &Neighbourhood, areas: &mut [f64; SLOTS]) {
        self.add_areas_of(region, bins.bins(), areas);
    }

    /// The area of one bin's texels inside `region`.
    pub fn area(&self, region: &Parallelogram, bin: Bin) -> f64 {
        let mut areas = [0.0; SLOTS];
        self.add_areas_of(region, std::iter::once((0, bin)), &mut areas);
        areas[0]
    }

    /// `bins`: at most [`SLOTS`] different slots with their bins.
    #[inline]
    fn add_areas_of(
        &self,
        region: &Parallelogram,
        bins: impl Iterator<Item = (usize, Bin)>,
        areas: &mut [f64; SLOTS],
    ) {
        let mut nodes = Nodes::new();
        for (slot, bin) in bins {
            let j = self.bin_index(bin);
            let count = self.starts[j + 1] - self.starts[j];
            let node = Node {
                slot: slot as u32,
                start: self.starts[j],
                count,
                position: self.root(j, count),
            };
            push(&mut nodes, node);
        }
        self.visit(region, Cell::whole(self.size), &nodes, areas);
    }

    fn bin_index(&self, (column, row): Bin) -> usize {
        row as usize * self.resolution as usize + column as usize
    }

    fn root(&self, j: usize, count: u32) -> u32 {
        if count > self.leaf_size {
            self.roots[self.has_tree.rank(j)]
        } else {
            0
        }
    }

    fn visit(&self, region: &Parallelogram, cell: Cell, nodes: &Nodes, areas: &mut [f64; SLOTS]) {
        let (low, high) = cell.bounds();
        match region.coverage(low, high) {
            Coverage::Outside => {}
            Coverage::Inside => {
                for node in nodes {
                    areas[node.slot as usize] += f64::from(node.count);
                }
            }
            Coverage::Cut => {
                let (mut left, mut right) = (Nodes::new(), Nodes::new());
                for node in nodes {
                    if node.count > self.leaf_size {
                        let (l, r) = self.children(node);
                        push(&mut left, l);
                        push(&mut right, r);
                    } else {
                        areas[node.slot as usize] += self.leaf_area(region, node);
                    }
                }
                let (first, second) = cell.halves();
                if !left.is_empty() {
                    self.visit(region, first, &left, areas);
                }
                if !right.is_empty() {
                    self.visit(region, second, &right, areas);
                }
            }
        }
    }

    fn leaf_area(&self, region: &Parallelogram, node: &Node) -> f64 {
        let list = &self.texels[node.start as usize..(node.start + node.count) as usize];
        list.iter()
            .map(|texel| region.texel_overlap(texel % self.size.0, texel / self.size.0))
            .sum()
    }

    /// A number of an inner node at a position of the forest, and the position after it.
    #[inline]
    fn number(&self, node: &Node, position: u32) -> (u32, u32) {
        let low = u32::from(self.forest[position as usize]);
        if node.count <= NARROW {
            return (low, position + 1);
        }
        let high = u32::from(self.forest[position as usize + 1]);
        (high << 16 | low, position + 2)
    }

    #[inline]
    fn children(&self, node: &Node) -> (Node, Node) {
        let (left_count, after_count) = self.number(node, node.position);
        let right_count = node.count - left_count;
        let (left_position, right_position) = if left_count > self.leaf_size && right_count > self.leaf_size {
            let (distance, after_distance) = self.number(node, after_count);
            (after_distance, node.position + distance)
        } else {
            (after_count, after_count)
        };
        let child = |start, count, position| Node {
            slot: node.slot,
            start,
            count,
            position,
        };
        (
            child(node.start, left_count, left_position),
            child(node.start + left_count, right_count, right_position),
        )
    }

    /// Builds the trees of all bins; each row of bins independently, so that the result does not depend on
    /// the threads.
    fn grow_forest(&mut self) {
        let rows: Vec<(Vec<u32>, Vec<u16>)> = (0..self.resolution)
            .into_par_iter()
            .map(|row| self.grow_row(row))
            .collect();
        let has_tree = |j: usize| self.starts[j + 1] - self.starts[j] > self.leaf_size;
        self.has_tree = RankedBits::new(self.starts.len() - 1, has_tree);
        self.roots
            .reserve_exact(rows.iter().map(|(roots, _)| roots.len()).sum());
        self.forest
            .reserve_exact(rows.iter().map(|(_, forest)| forest.len()).sum());
        for (roots, forest) in rows {
            let base = self.forest.len() as u32;
            self.roots.extend(roots.iter().map(|root| base + root));
            self.forest.extend(forest);
        }
    }

    /// The roots and the trees of one row of bins, positions relative to the row.
    fn grow_row(&self, row: u32) -> (Vec<u32>, Vec<u16>) {
        let (mut roots, mut forest) = (Vec::new(), Vec::new());
        for column in 0..self.resolution {
            let list = self.texels((column, row));
            if list.len() > self.leaf_size as usize {
                roots.push(forest.len() as u32);
                self.grow(list, Cell::whole(self.size), &mut forest);
            }
        }
        (roots, forest)
    }

    fn grow(&self, list: &[u32], cell: Cell, forest: &mut Vec<u16>) {
        let (first, second) = cell.halves();
        let in_first = |&texel: &u32| first.contains(texel % self.size.0, texel / self.size.0);
        let (left, right) = list.split_at(list.partition_point(in_first));
        let is_inner = |list: &[u32]| list.len() > self.leaf_size as usize;
        let is_wide = list.len() > NARROW as usize;
        let words = |number: usize| {
            let halves = [number as u16, (number >> 16) as u16];
            halves.into_iter().take(if is_wide { 2 } else { 1 })
        };
        let position = forest.len();
        forest.extend(words(left.len()));
        if is_inner(left) && is_inner(right) {
            let reserved = forest.len();
            forest.extend(words(0));
            self.grow(left, first, forest);
            for (place, word) in words(forest.len() - position).enumerate() {
                forest[reserved + place] = word;
            }
            self.grow(right, second, forest);
        } else if is_inner(left) {
            self.grow(left, first, forest);
        } else if is_inner(right) {
            self.grow(right, second, forest);
        }
    }
}

/// Prefix sums of the histogram: `resolution^2 + 1` entries.
fn list_starts(bins: impl Iterator<Item = usize>, resolution: u32) -> Vec<u32> {
    let mut starts = vec![0; (resolution as usize).pow(2) + 1];
    for j in bins {
        starts[j + 1] += 1;
    }
    for j in 1..starts.len() {
        starts[j] += starts[j - 1];
    }
    starts
}

/// The texels sorted by bin, and within a bin in the order of the trees. Every thread goes through all texels
/// and keeps those of its own range of bins.
fn sorted_texels(starts: &[u32], size: (u32, u32), bin_of: impl Fn(u32) -> usize + Sync) -> Vec<u32> {
    let mut texels = vec![0; *starts.last().unwrap_or(&0) as usize];
    let mut rest = texels.as_mut_slice();
    let mut tasks = Vec::new();
    for bins in balanced_ranges(starts, rayon::current_num_threads()) {
        let count = starts[bins.end] - starts[bins.start];
        let (lists, others) = std::mem::take(&mut rest).split_at_mut(count as usize);
        rest = others;
        tasks.push((bins, lists));
    }
    tasks.into_par_iter().for_each(|(bins, lists)| {
        let base = starts[bins.start];
        let mut cursors: Vec<u32> = starts[bins.clone()].iter().map(|s| s - base).collect();
        Cell::whole(size).for_each_texel(&mut |x, y| {
            let texel = y * size.0 + x;
            if let Some(cursor) = cursors.get_mut(bin_of(texel).wrapping_sub(bins.start)) {
                lists[*cursor as usize] = texel;
                *cursor += 1;
            }
        });
    });
    texels
}

/// Cuts the bins into `count` ranges of about as many texels each; some may be empty.
fn balanced_ranges(starts: &[u32], count: usize) -> Vec<Range<usize>> {
    let (bins, total) = (starts.len() - 1, u64::from(starts[starts.len() - 1]));
    let bound = |k: usize| match k {
        0 => 0,
        k if k == count => bins,
        k => starts
            .partition_point(|&s| u64::from(s) < total * k as u64 / count as u64)
            .min(bins),
    };
    (0..count).map(|k| bound(k)..bound(k + 1)).collect()
}

#[inline]
fn push(nodes: &mut Nodes, node: Node) {
    if node.count > 0 {
        nodes.push(node);
    }
}

impl Cell {
    fn whole((width, height): (u32, u32)) -> Self {
        Self {
            x: 0,
            y: 0,
            width,
            height,
        }
    }

    /// The splitting rule of every tree; a side of at least two texels is needed.
    #[inline]
    fn halves(self) -> (Self, Self) {
        let (mut first, mut second) = (self, self);
        if self.width >= self.height {
            first.width = self.width / 2;
            second.width = self.width - first.width;
            second.x += first.width;
        } else {
            first.height = self.height / 2;
            second.height = self.height - first.height;
            second.y += first.height;
        }
        (first, second)
    }

    fn contains(self, x: u32, y: u32) -> bool {
        x.wrapping_sub(self.x) < self.width && y.wrapping_sub(self.y) < self.height
    }

    fn bounds(self) -> (DVec2, DVec2) {
        let low = DVec2::new(self.x.into(), self.y.into());
        (low, low + DVec2::new(self.width.into(), self.height.into()))
    }

    /// Visits all texels in the order of the trees.
    fn for_each_texel(self, visit: &mut impl FnMut(u32, u32)) {
        if self.width == 1 && self.height == 1 {
            visit(self.x, self.y);
        } else {
            let (first, second) = self.halves();
            first.for_each_texel(visit);
            second.for_each_texel(visit);
        }
    }
}

/// Bits with the number of set bits before each word of 64.
#[derive(Default)]
struct RankedBits {
    words: Vec<u64>,
    ranks: Vec<u32>,
}

impl RankedBits {
    fn new(len: usize, is_set: impl Fn(usize) -> bool) -> Self {
        let mut bits = Self {
            words: vec![0; len.div_ceil(64)],
            ranks: Vec::with_capacity(len.div_ceil(64)),
        };
        for i in (0..len).filter(|&i| is_set(i)) {
            bits.words[i / 64] |= 1 << (i % 64);
        }
        let mut rank = 0;
        for word in &bits.words {
            bits.ranks.push(rank);
            rank += word.count_ones();
        }
        bits
    }

    /// Number of set bits before bit `i`.
    #[inline]
    fn rank(&self, i: usize) -> usize {
        let below = self.words[i / 64] & ((1 << (i % 64)) - 1);
        (self.ranks[i / 64] + below.count_ones()) as usize
    }

    fn bytes(&self) -> usize {
        size_of_val(self.words.as_slice()) + size_of_val(self.ranks.as_slice())
    }
}

#[cfg(test)]
impl InverseMap {
    /// Everything that is stored, for comparisons.
    pub fn words(&self) -> ([Vec<u32>; 3], Vec<u16>) {
        let words = [&self.texels, &self.starts, &self.roots].map(Clone::clone);
        (words, self.forest.clone())
    }
}
