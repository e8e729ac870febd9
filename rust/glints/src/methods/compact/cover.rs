//! How a footprint is covered by nodes of a quadtree over the map.
//!
//! A node inside the footprint is taken as a whole. One that its border cuts is taken apart, down to single texels, unless
//! it is small against the footprint: then it is taken as a whole, too, weighted by the share of its area inside. That
//! blurs the border; with nodes of side s, of which a footprint of area a and perimeter p cuts about p / s, and whose
//! distributions deviate from the part's inside by d, the error is about
//!
//! ```text
//! sqrt(p / s) s^2 / a * 0.25 d,
//! ```
//!
//! a random walk over the cut nodes, since each has too much as often as too little. A node is small if that is below
//! [`TOLERANCE`]. How much parts deviate is measured where there are counts ([`super::counts::Counts::deviations`]): by
//! chance, and by the map's streaks and flakes.
//!
//! **Under a Gaussian** ([`crate::footprint_filter`]) no node has even weights. One is taken as a whole, with the Gaussian's
//! mean over it, where it is small. Over a node with the edges U, V in deviations the Gaussian varies by about
//! `sqrt((z.U)^2 + (z.V)^2) / sqrt 12` of itself; summed over all nodes as a random walk, with the Gaussian's integrals, the
//! error is
//!
//! ```text
//! sqrt(|U x V| (|U|^2 + |V|^2) / (96 pi)) d,
//! ```
//!
//! and must be below [`GAUSSIAN_SHARE`] of the tolerance: then all of the footprint is counted, with the counts' own noise,
//! and not only what a box holds inside.

use glam::DVec2;

use crate::footprint::{Coverage, Footprint};
use crate::footprint_filter::Window;

/// Relative error that blurring the border may cost. Measured, it is half to one and a half of what the formula says.
const TOLERANCE: f64 = 0.016;

/// Share of that which the nodes under a Gaussian may take.
const GAUSSIAN_SHARE: f64 = 0.6;

/// Error of nodes of a side that are cut by the border of a box, per deviation.
pub fn error_of_box(footprint: &Footprint) -> impl Fn(f64) -> f64 + use<> {
    let perimeter: f64 = footprint.edges().iter().map(|edge| 2.0 * edge.length()).sum();
    let area = footprint.area();
    move |side| 0.25 * ((perimeter / side).sqrt() * side * side / area)
}

/// Error of nodes of a side under a Gaussian, per deviation; `[u, v]`: a texel's edges in deviations of the Gaussian.
pub fn error_of_gaussian([u, v]: [DVec2; 2]) -> impl Fn(f64) -> f64 {
    let squares = u.perp_dot(v).abs() * (u.length_squared() + v.length_squared());
    let per_area = (squares / (96.0 * std::f64::consts::PI)).sqrt();
    move |side| per_area * side * side / GAUSSIAN_SHARE
}

/// A rectangle of texels, half open.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    pub low: (u32, u32),
    pub high: (u32, u32),
}

/// A quadtree whose leaves have `2^leaf_bits` texels a side, over a map that its root holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tree {
    map: (u32, u32),
    leaf_bits: u32,
    levels: usize,
}

/// A node of a level, by column and row; level 0 are the leaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Node {
    pub level: usize,
    pub row: u32,
    pub column: u32,
}

impl Node {
    /// A number of 48 bits that tells nodes apart: a map has at most 2^16 columns and rows.
    pub fn key(&self) -> u64 {
        (self.level as u64) << 40 | u64::from(self.row) << 20 | u64::from(self.column)
    }
}

/// The left or the upper half of a node.
#[derive(Clone, Copy, Debug)]
pub struct Half {
    axis: usize,
    /// First column or row of the other half.
    end: u32,
    /// Of the node's texels.
    pub share: f64,
}

impl Half {
    /// Whether it holds a texel of the node.
    #[inline]
    pub fn has(&self, texel: (u32, u32)) -> bool {
        [texel.0, texel.1][self.axis] < self.end
    }

    /// What the deviation of this part by chance is to be multiplied with to be that of a half of all texels.
    pub fn by_chance(&self) -> f64 {
        (self.share / (1.0 - self.share)).sqrt()
    }
}

/// What a footprint does with a node.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Treatment {
    Nothing,
    Descend,
    /// All its texels alike, each with this weight.
    Whole(f64),
    /// A leaf's texels, each with its own weight.
    Texels,
}

/// The levels that a footprint is covered with.
#[derive(Clone, Copy, Debug)]
pub struct Scale {
    /// Side in texels up to which a cut node is taken as a whole.
    pub small: f64,
    /// Relative error of the distribution that this costs.
    pub error: f64,
    /// Level whose nodes are taken apart into texels.
    pub leaf: usize,
}

/// The part of a footprint in one period of the map, and how it treats nodes.
#[derive(Clone, Copy)]
pub struct Part<'a> {
    /// `None`: all of the map.
    window: Option<&'a Window>,
    is_even: bool,
    scale: Scale,
    /// Of s and t: gradient per texel, value at the map's corner, and variation over half a texel.
    slabs: [(DVec2, f64, f64); 2],
}

impl<'a> Part<'a> {
    pub fn new(window: Option<&'a Window>, scale: Scale) -> Self {
        let slabs = window.map_or([(DVec2::ZERO, 0.0, 0.0); 2], |window| {
            let [s, t] = window.region().slabs_at(DVec2::ZERO);
            [s, t].map(|(g, value)| (g, value, 0.5 * (g.x.abs() + g.y.abs())))
        });
        Self {
            window,
            is_even: window.is_none_or(|window| window.even_weight().is_some()),
            scale,
            slabs,
        }
    }

    /// Mean weight of the texels of a rectangle; under a box, a texel inside weighs one.
    fn mean_weight(&self, window: &Window, rect: &Rect) -> f64 {
        let (low, high) = rect.bounds();
        let sum = if self.is_even {
            window.region().overlap(low, high)
        } else {
            window.weight(low, high)
        };
        sum / rect.area()
    }

    /// How a square of `side` texels, the map's side excepted, lies to the region.
    #[inline]
    fn coverage(&self, low: DVec2, side: f64) -> Coverage {
        let center = low + 0.5 * side;
        let [(gs, s0, rs), (gt, t0, rt)] = &self.slabs;
        let (s, t) = ((gs.dot(center) + s0).abs(), (gt.dot(center) + t0).abs());
        let (rs, rt) = (rs * side, rt * side);
        if s - rs >= 0.5 || t - rt >= 0.5 {
            Coverage::Outside
        } else if s + rs <= 0.5 && t + rt <= 0.5 {
            Coverage::Inside
        } else {
            Coverage::Cut
        }
    }
}

impl Treatment {
    /// The same `count` times.
    pub fn scaled(self, count: f64) -> Self {
        match self {
            Self::Whole(weight) => Self::Whole(weight * count),
            other => other,
        }
    }
}

impl Rect {
    fn bounds(&self) -> (DVec2, DVec2) {
        let point = |(x, y): (u32, u32)| DVec2::new(f64::from(x), f64::from(y));
        (point(self.low), point(self.high))
    }

    /// Number of texels.
    pub fn area(&self) -> f64 {
        let (low, high) = self.bounds();
        (high - low).element_product()
    }
}

impl Tree {
    pub fn new(map: (u32, u32), leaf_bits: u32) -> Self {
        let side = map.0.max(map.1).next_power_of_two().trailing_zeros();
        Self {
            map,
            leaf_bits,
            levels: side.saturating_sub(leaf_bits) as usize + 1,
        }
    }

    /// Number of levels; the last one is the root.
    pub fn levels(&self) -> usize {
        self.levels
    }

    pub fn root(&self) -> Node {
        Node {
            level: self.levels - 1,
            row: 0,
            column: 0,
        }
    }

    /// Side of the nodes of a level.
    pub fn side(&self, level: usize) -> u32 {
        1 << (self.leaf_bits + level as u32)
    }

    fn columns(&self, level: usize) -> u32 {
        self.map.0.div_ceil(self.side(level))
    }

    /// Side in texels up to which a node is small against the footprint, and the relative error that such nodes cost;
    /// `deviations`: of the parts of each level's nodes; `error`: for a side, per deviation.
    pub fn small_side(&self, error: impl Fn(f64) -> f64, deviations: &[f64]) -> (f64, f64) {
        let sides = (0..self.levels).map(|level| f64::from(self.side(level)));
        sides
            .zip(deviations)
            .map(|(side, deviation)| (side, error(side) * deviation))
            .take_while(|&(_, error)| error <= TOLERANCE)
            .last()
            .unwrap_or((0.0, 0.0))
    }

    /// Number of nodes of a level.
    pub fn nodes(&self, level: usize) -> usize {
        self.columns(level) as usize * self.map.1.div_ceil(self.side(level)) as usize
    }

    /// The node of an index in its level.
    pub fn node(&self, level: usize, index: usize) -> Node {
        let columns = self.columns(level) as usize;
        Node {
            level,
            row: (index / columns) as u32,
            column: (index % columns) as u32,
        }
    }

    /// Index of a node in its level.
    #[inline]
    pub fn index(&self, node: &Node) -> usize {
        node.row as usize * self.columns(node.level) as usize + node.column as usize
    }

    /// The texels of a node.
    #[inline]
    pub fn rect(&self, node: &Node) -> Rect {
        let side = self.side(node.level);
        let low = (node.column * side, node.row * side);
        Rect {
            low,
            high: ((low.0 + side).min(self.map.0), (low.1 + side).min(self.map.1)),
        }
    }

    /// The nodes of the next finer level inside a node, which is not a leaf.
    #[inline]
    pub fn children(&self, node: &Node) -> impl Iterator<Item = Node> + use<> {
        let level = node.level - 1;
        let (side, map) = (self.side(level), self.map);
        let (row, column) = (2 * node.row, 2 * node.column);
        [(0, 0), (0, 1), (1, 0), (1, 1)]
            .into_iter()
            .map(move |(dy, dx)| Node {
                level,
                row: row + dy,
                column: column + dx,
            })
            .filter(move |child| child.column * side < map.0 && child.row * side < map.1)
    }

    /// The left and the upper half of a node, which is not a leaf: what the quarters there hold. `None`: all of the node.
    pub fn halves(&self, node: &Node) -> [Option<Half>; 2] {
        let side = self.side(node.level - 1);
        let Rect { low, high } = self.rect(node);
        let axes = [(low.0, high.0), (low.1, high.1)];
        [0, 1].map(|axis| {
            let (low, high) = axes[axis];
            (low + side < high).then(|| Half {
                axis,
                end: low + side,
                share: f64::from(side) / f64::from(high - low),
            })
        })
    }

    /// The node of a level that holds a texel.
    fn ancestor(&self, level: usize, (column, row): (u32, u32)) -> Node {
        let shift = self.leaf_bits + level as u32;
        Node {
            level,
            row: row >> shift,
            column: column >> shift,
        }
    }

    /// What `part` does with a node; `is_unit` tells whether the nodes of a level can be taken as a whole.
    #[inline]
    fn treatment(&self, part: &Part, node: &Node, is_unit: &impl Fn(usize) -> bool) -> Treatment {
        let whole = is_unit(node.level);
        let Some(window) = part.window else {
            let ends_here = whole || node.level == part.scale.leaf;
            return if ends_here {
                Treatment::Whole(1.0)
            } else {
                Treatment::Descend
            };
        };
        // A node that reaches over the map's far sides is taken as if it did not end there: what lies inside the
        // region does so anyway.
        let side = f64::from(self.side(node.level));
        let corner = DVec2::new(f64::from(node.column), f64::from(node.row)) * side;
        match part.coverage(corner, side) {
            Coverage::Outside => Treatment::Nothing,
            Coverage::Inside if whole && part.is_even => Treatment::Whole(1.0),
            _ if whole && side <= part.scale.small => {
                Treatment::Whole(part.mean_weight(window, &self.rect(node)))
            }
            _ if node.level == part.scale.leaf => Treatment::Texels,
            _ => Treatment::Descend,
        }
    }

    /// Calls `visit` with the nodes that cover `part`, and how each is treated.
    pub fn cover(
        &self,
        part: &Part,
        is_unit: &impl Fn(usize) -> bool,
        visit: &mut impl FnMut(&Node, Treatment),
    ) {
        self.cover_node(part, &self.root(), is_unit, visit);
    }

    fn cover_node(
        &self,
        part: &Part,
        node: &Node,
        is_unit: &impl Fn(usize) -> bool,
        visit: &mut impl FnMut(&Node, Treatment),
    ) {
        match self.treatment(part, node, is_unit) {
            Treatment::Nothing => {}
            Treatment::Descend => {
                for child in self.children(node) {
                    self.cover_node(part, &child, is_unit, visit);
                }
            }
            treatment => visit(node, treatment),
        }
    }

    /// The node with which [`Self::cover`] covers a texel, and how it is treated.
    pub fn covering(
        &self,
        part: &Part,
        texel: (u32, u32),
        is_unit: &impl Fn(usize) -> bool,
    ) -> (Node, Treatment) {
        for level in (part.scale.leaf + 1..self.levels).rev() {
            let node = self.ancestor(level, texel);
            match self.treatment(part, &node, is_unit) {
                Treatment::Descend => {}
                treatment => return (node, treatment),
            }
        }
        let leaf = self.ancestor(part.scale.leaf, texel);
        (leaf, self.treatment(part, &leaf, is_unit))
    }
}
