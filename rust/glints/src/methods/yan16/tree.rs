//! The hierarchy over positions and normals: blocks of the plane, and in each a tree over normals.
//!
//! A query asks for the elements near a position *and* near a normal. Positions are cut into blocks of
//! `side` x `side` elements, whose places need not be stored. Within a block the elements are sorted by
//! their normals into a balanced binary tree (median splits along the wider axis), whose nodes hold the box
//! in which their elements have any effect. A small footprint meets few blocks and leaves each of them after
//! a few boxes; a large one visits only the elements whose normals count, whatever their number.
//!
//! **Layout**, for N elements of any kind:
//!
//! | part | size |
//! |---|---|
//! | normal, two `f32` in the order of the leaves | 8 N |
//! | Jacobian, four `f32` (curved elements only) | 16 N |
//! | place in the block by rank, rank by place, `u16` each | 4 N |
//! | boxes, four `f32` for each of about N / 8 nodes | 2 N |
//!
//! The tree is implicit: node i has the children 2 i + 1 and 2 i + 2, and a node's elements are half of its
//! parent's.

use std::ops::Range;

use glam::Vec2;
use rayon::prelude::*;

/// Most elements of a leaf.
pub const LEAF_SIZE: usize = 16;

/// Levels of a block's tree, and room for its traversal.
const LEVELS: usize = 16;

/// What the tree is built from.
pub struct Element {
    /// Projected normal.
    pub normal: Vec2,
    /// Derivatives of the normal by position per texel: `[ds_x/du, ds_x/dv, ds_y/du, ds_y/dv]`.
    pub jacobian: [f32; 4],
    /// Distance from `normal`, per axis, beyond which the element has no effect.
    pub extent: Vec2,
}

/// See the module.
pub struct Tree {
    columns: u32,
    rows: u32,
    side: u32,
    normals_x: Vec<f32>,
    normals_y: Vec<f32>,
    jacobians: [Vec<f32>; 4],
    /// `y << 8 | x` inside the block, by rank.
    places: Vec<u16>,
    /// Rank inside the block, by place, row by row.
    ranks: Vec<u16>,
    /// `[least x, greatest x, least y, greatest y]`.
    boxes: Vec<[f32; 4]>,
    /// Where a block's boxes begin.
    first_box: Vec<u32>,
}

/// Some elements of a block.
#[derive(Clone, Copy)]
pub struct Leaf<'a> {
    /// Projected normals.
    pub x: &'a [f32],
    pub y: &'a [f32],
    /// `y << 8 | x` inside the block.
    pub places: &'a [u16],
}

/// A block's elements and nodes.
#[derive(Clone, Copy)]
pub struct Block {
    first_element: usize,
    count: usize,
    width: u32,
    first_box: usize,
}

impl Tree {
    /// A tree over a grid of elements in blocks of `side` x `side`, at most 128; `element` gives the one in a
    /// column and a row. Without `curved` the Jacobians are left out.
    pub fn new(
        (columns, rows): (u32, u32),
        side: u32,
        curved: bool,
        element: impl Fn(u32, u32) -> Element + Sync,
    ) -> Self {
        let count = columns as usize * rows as usize;
        let mut tree = Self {
            columns,
            rows,
            side,
            normals_x: vec![0.0; count],
            normals_y: vec![0.0; count],
            jacobians: std::array::from_fn(|_| vec![0.0; if curved { count } else { 0 }]),
            places: vec![0; count],
            ranks: vec![0; count],
            boxes: Vec::new(),
            first_box: Vec::new(),
        };
        let mut boxes = 0;
        for row in 0..rows.div_ceil(side) {
            for column in 0..columns.div_ceil(side) {
                tree.first_box.push(boxes as u32);
                boxes += node_count(tree.geometry(column, row).2 as usize);
            }
        }
        tree.boxes = vec![[0.0; 4]; boxes];
        tree.fill(element);
        tree
    }

    fn fill(&mut self, element: impl Fn(u32, u32) -> Element + Sync) {
        let side = self.side;
        let blocks: Vec<(u32, u32, Block)> = (0..self.rows.div_ceil(self.side))
            .flat_map(|row| (0..self.columns.div_ceil(self.side)).map(move |column| (column, row)))
            .map(|(column, row)| (column, row, self.block(column, row)))
            .collect();
        let mut x = self.normals_x.as_mut_slice();
        let mut y = self.normals_y.as_mut_slice();
        let mut jacobians = self.jacobians.each_mut().map(|j| j.as_mut_slice());
        let mut places = self.places.as_mut_slice();
        let mut ranks = self.ranks.as_mut_slice();
        let mut boxes = self.boxes.as_mut_slice();
        // Blocks lie one behind the other in every array: each takes its part off the front.
        let jobs: Vec<_> = blocks
            .into_iter()
            .map(|(column, row, block)| {
                let n = block.count;
                let part = BlockMut {
                    normals_x: take(&mut x, n),
                    normals_y: take(&mut y, n),
                    jacobians: jacobians.each_mut().map(|j| take(j, n)),
                    places: take(&mut places, n),
                    ranks: take(&mut ranks, n),
                    boxes: take(&mut boxes, node_count(n)),
                };
                (column, row, block.width, part)
            })
            .collect();
        jobs.into_par_iter().for_each(|(column, row, width, mut part)| {
            let elements: Vec<Element> = (0..part.places.len() as u32)
                .map(|i| element(column * side + i % width, row * side + i / width))
                .collect();
            part.fill(&elements, width);
        });
    }

    /// First element, width and number of elements of the block in a column and a row of blocks.
    fn geometry(&self, column: u32, row: u32) -> (usize, u32, u32) {
        let width = self.side.min(self.columns - column * self.side);
        let height = self.side.min(self.rows - row * self.side);
        let above = row as usize * self.side as usize * self.columns as usize;
        let left = column as usize * self.side as usize * height as usize;
        (above + left, width, width * height)
    }

    /// Elements per side of a block.
    pub fn side(&self) -> u32 {
        self.side
    }

    /// The block in a column and a row of blocks.
    #[inline]
    pub fn block(&self, column: u32, row: u32) -> Block {
        let (first_element, width, count) = self.geometry(column, row);
        let index = row as usize * self.columns.div_ceil(self.side) as usize + column as usize;
        Block {
            first_element,
            count: count as usize,
            width,
            first_box: self.first_box[index] as usize,
        }
    }

    /// Calls `visit` with the ranges of elements of a block that may have an effect at the normal `s`.
    #[inline]
    pub fn for_each_leaf(&self, block: &Block, s: Vec2, mut visit: impl FnMut(Range<usize>)) {
        let boxes = &self.boxes[block.first_box..][..node_count(block.count)];
        if !contains(&boxes[0], s) {
            return;
        }
        let mut stack = [(0_u32, 0_u32, 0_u32); LEVELS];
        stack[0] = (0, 0, block.count as u32);
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (node, low, high) = stack[depth];
            let left = 2 * node as usize + 1;
            let Some(children) = boxes.get(left..left + 2) else {
                let first = block.first_element;
                visit(first + low as usize..first + high as usize);
                continue;
            };
            let middle = low + (high - low) / 2;
            // The second child is pushed first, so that elements come in the order of memory.
            if contains(&children[1], s) {
                stack[depth] = (left as u32 + 1, middle, high);
                depth += 1;
            }
            if contains(&children[0], s) {
                stack[depth] = (left as u32, low, middle);
                depth += 1;
            }
        }
    }

    /// Normals and places of a range of elements.
    #[inline]
    pub fn leaf(&self, range: Range<usize>) -> Leaf<'_> {
        Leaf {
            x: &self.normals_x[range.clone()],
            y: &self.normals_y[range.clone()],
            places: &self.places[range],
        }
    }

    /// Jacobians of a range of elements, component by component; see [`Element`].
    #[inline]
    pub fn jacobians(&self, range: Range<usize>) -> [&[f32]; 4] {
        self.jacobians.each_ref().map(|j| &j[range.clone()])
    }

    /// Normal and Jacobian of the element in a column and a row of the grid.
    #[inline]
    pub fn element_at(&self, column: u32, row: u32) -> (Vec2, [f32; 4]) {
        let (first, width, _) = self.geometry(column / self.side, row / self.side);
        let place = (row % self.side) * width + column % self.side;
        let element = first + self.ranks[first + place as usize] as usize;
        let jacobian = self
            .jacobians
            .each_ref()
            .map(|j| j.get(element).copied().unwrap_or(0.0));
        (
            Vec2::new(self.normals_x[element], self.normals_y[element]),
            jacobian,
        )
    }

    /// Bytes of all parts.
    pub fn bytes(&self) -> usize {
        size_of_val(self.normals_x.as_slice())
            + size_of_val(self.normals_y.as_slice())
            + self
                .jacobians
                .iter()
                .map(|j| size_of_val(j.as_slice()))
                .sum::<usize>()
            + size_of_val(self.places.as_slice())
            + size_of_val(self.ranks.as_slice())
            + size_of_val(self.boxes.as_slice())
            + size_of_val(self.first_box.as_slice())
    }
}

/// One block's part of every array.
struct BlockMut<'a> {
    normals_x: &'a mut [f32],
    normals_y: &'a mut [f32],
    jacobians: [&'a mut [f32]; 4],
    places: &'a mut [u16],
    ranks: &'a mut [u16],
    boxes: &'a mut [[f32; 4]],
}

impl BlockMut<'_> {
    fn fill(&mut self, elements: &[Element], width: u32) {
        let mut order: Vec<u16> = (0..elements.len() as u16).collect();
        self.split(0, elements, &mut order);
        for (rank, &index) in order.iter().enumerate() {
            let element = &elements[usize::from(index)];
            self.normals_x[rank] = element.normal.x;
            self.normals_y[rank] = element.normal.y;
            for (column, &slope) in self.jacobians.iter_mut().zip(&element.jacobian) {
                if let Some(stored) = column.get_mut(rank) {
                    *stored = slope;
                }
            }
            let (x, y) = (u32::from(index) % width, u32::from(index) / width);
            self.places[rank] = (y << 8 | x) as u16;
            self.ranks[usize::from(index)] = rank as u16;
        }
    }

    /// Sorts the elements of a node into its subtree and sets the boxes of that; returns the node's box.
    fn split(&mut self, node: usize, elements: &[Element], order: &mut [u16]) -> [f32; 4] {
        let is_leaf = 2 * node + 1 >= self.boxes.len();
        let bounds = if is_leaf {
            order
                .iter()
                .map(|&i| reach(&elements[usize::from(i)]))
                .fold(EMPTY, union)
        } else {
            let axis = wider_axis(elements, order);
            let middle = order.len() / 2;
            let key = |i: &u16| elements[usize::from(*i)].normal[axis];
            order.select_nth_unstable_by(middle, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
            let (low, high) = order.split_at_mut(middle);
            union(
                self.split(2 * node + 1, elements, low),
                self.split(2 * node + 2, elements, high),
            )
        };
        self.boxes[node] = bounds;
        bounds
    }
}

/// The first `count` items, or all if there are fewer; `slice` keeps the rest.
fn take<'a, T>(slice: &mut &'a mut [T], count: usize) -> &'a mut [T] {
    let whole = std::mem::take(slice);
    let (taken, rest) = whole.split_at_mut(count.min(whole.len()));
    *slice = rest;
    taken
}

const EMPTY: [f32; 4] = [f32::INFINITY, f32::NEG_INFINITY, f32::INFINITY, f32::NEG_INFINITY];

/// Nodes of a perfect binary tree whose leaves hold at most [`LEAF_SIZE`] of `count` elements.
fn node_count(count: usize) -> usize {
    2 * count.div_ceil(LEAF_SIZE).next_power_of_two() - 1
}

#[inline]
fn contains(bounds: &[f32; 4], s: Vec2) -> bool {
    (s.x >= bounds[0]) & (s.x <= bounds[1]) & (s.y >= bounds[2]) & (s.y <= bounds[3])
}

/// The box in which an element has any effect.
fn reach(element: &Element) -> [f32; 4] {
    let (low, high) = (element.normal - element.extent, element.normal + element.extent);
    [low.x, high.x, low.y, high.y]
}

fn union(a: [f32; 4], b: [f32; 4]) -> [f32; 4] {
    [a[0].min(b[0]), a[1].max(b[1]), a[2].min(b[2]), a[3].max(b[3])]
}

fn wider_axis(elements: &[Element], order: &[u16]) -> usize {
    let normals = order.iter().map(|&i| elements[usize::from(i)].normal);
    let (low, high) = normals.fold((Vec2::INFINITY, Vec2::NEG_INFINITY), |(low, high), n| {
        (low.min(n), high.max(n))
    });
    let extent = high - low;
    usize::from(extent.y > extent.x)
}
