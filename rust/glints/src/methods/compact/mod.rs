//! The compact inverse bin map: half the published memory, and lobes that stay where the map has them.
//!
//! **Source** Atanasov, Wilkie, Koylazov, Křivánek: *A Multiscale Microfacet Model Based on Inverse Bin Mapping*,
//! Eurographics 2021, poses the problem: find the texels of a footprint whose normals are near the half vector. The answer
//! here is this project's own; the published one is [`super::inverse_bin_map`].
//!
//! **Computes** Eq. 11 with truncated lobes ([`lobes`]) about the texels' own normals,
//!
//! ```text
//! R(i, o) = sum_k w_k D(h, t_k) G1(i, t_k) G1(o, t_k) [/ (t_k . n)],
//! ```
//!
//! and, for what a large footprint holds entirely, about the centres of bins ([`counts`]).
//!
//! **Why not bins and a tree each?** The published structure stores every texel twice, `B` and `B^-1`, and moves its lobe
//! to the centre of its bin, where it is off by a third of a standard deviation. Its query walks along the footprint's
//! border in the trees of 21 bins. But
//!
//! * a texel's normal, at a twentieth of a standard deviation, takes as many bits as both maps together need for its bin
//!   alone: what is exact costs no more memory, if it is stored once;
//! * a byte of each coordinate tells for 64 texels at a time which are near the half vector ([`tiles`]): testing a thousand is
//!   cheaper than walking a tree.
//!
//! So the texels of a footprint are simply tested, all of them, in the map's order. Footprints that hold many texels that matter are large
//! against them, and their distribution is a mean over many: above a size, [`counts`] answer for whole squares of texels, and squares at
//! the border that are small against the footprint are weighted by their area ([`cover`]). Texels that the border cuts get their
//! exact area ([`border`]). Counts are for the core of a map's directions; the few texels in long tails are listed and added
//! one by one ([`strays`]).
//!
//! **Memory** 2.5 to 4 bytes a texel for the normals, two bytes at most for the rest: counts are kept of as many levels, from the
//! whole map down, as fit into [`BYTES_PER_TEXEL`].
//!
//! **Exactness** Quantisation is at most about a twentieth of a lobe's standard deviation (for alpha >= 0.002; below, where
//! 32 bits do not suffice, a step grows to 3e-5 of the map's range), which is up to 2 % of relative L1 error for a single lobe, less for
//! several. Counts and blurred borders cost up to 2.3 % for footprints of more than a hundred texels' width on the maps of the
//! scenes. Lobes are truncated for sampling, density and evaluation alike, and `sample` treats a texel as the cover of the footprint
//! does: it has exactly the density.
//!
//! That error is one of the whole distribution, of which most may lie in one direction: of a map of flakes in the base coat, while
//! glints are elsewhere, where few texels reflect and a blurred border was up to 90 % off. So where the density tells that
//! the error of the *value* would be above [`LOCAL_TOLERANCE`], the value is summed over the texels, up to [`MOST_SUMMED`] of
//! them: some are in reach, and the others cost 0.1 ns each. The density stays that of the cover, as `sample` needs it.
//!
//! **Bounds** A footprint of up to 16 x 16 texels takes half a microsecond to one, at low roughness, `sample` the same, and so does one that
//! covers the map evenly, where there are counts. In between, evaluation grows with the number of texels, by 0.15 ns each, and with that of
//! texels within reach, by some nanoseconds each, until the border may be blurred. Most expensive are
//!
//! * footprints of hundreds of texels' width, or long and thin ones, at high roughness: thousands of lobes matter, of which any subset
//!   would be off by more than 2 %, and squares with counts are not small against the footprint;
//! * footprints of 256 to 1024 texels' width at low roughness, 10 to 200 microseconds, although few lobes matter, because all
//!   texels are tested. (A former version sorted the texels by direction, in blocks, and read the few cells around the half vector: 2 to
//!   20 microseconds there. To find the one at a given place then took 4 microseconds, a chain of cache misses along the
//!   inverse of the sort, for every sample of every footprint. Both orders together take the memory of the published structure.)
//! * footprints of one to three periods of a large map at a roughness so low that only the root has counts, which is not small
//!   against them yet: 0.4 to 1.5 milliseconds.
//!
//! **Gaussian footprints** ([`CompactBinMap::with_filter`], [`crate::footprint_filter`]) go the same ways. No two texels weigh
//! the same, so that single texels are weighted one by one where they are near the half vector, eight at a time ([`border`]),
//! and a node is taken as a whole, with the Gaussian's mean over it, where it is small against the deviation ([`cover`]); the
//! tolerance is that of blurred borders. `sample` draws a point of the Gaussian, and of a node that is taken as a whole any
//! texel. A Gaussian of half a pixel reaches 14 times the texels of the box: while nodes are not small, it costs up to that
//! much more.
//!
//! **One roughness a structure** Spatially varying roughness is not offered: each structure answers for the roughness that it
//! was built with. Tiles could answer for any roughness a that is at least the built one, alpha: their normals are
//! fine enough. Counts bind. Their bins are half a lobe wide,
//! and a lobe twice as wide reaches hundreds of them, to be summed for every node; beyond that a query would cost more than the
//! texels. The answer is a structure for each roughness, 13 to 18 MB for 2048 x 2048 texels, 67 MB for four of them, and a
//! blend of materials that picks one.
//!
//! **Files** A structure is saved with [`CompactBinMap::save`] and used in place after [`CompactBinMap::load`]; the format
//! stands at the top of the module `file`.

mod border;
mod check;
mod counts;
mod cover;
mod file;
mod grid;
mod lanes;
mod lobes;
mod strays;
mod tiles;

use arrayvec::ArrayVec;
use glam::{Vec2, Vec3};
use wide::f32x8;

use super::{MAX_RANGES, Method, RangeMeans, Reflection, mean_over};
use crate::flakes::FlakeModel;
use crate::footprint::{Footprint, Parallelogram};
use crate::footprint_filter::{FilteredFootprint, FilteredPart, FootprintFilter, Window};
use crate::half_vector::DirectionPair;
use crate::hash::mix;
use crate::normal_map::NormalMap;
use border::Border;
use counts::{CountSum, Counts};
use cover::{Node, Rect, Scale, Treatment, Tree};
use grid::Grid;
use lobes::{Lobe, Query, Sums};
use strays::Strays;
use tiles::Tiles;

pub use file::{Header, Origin, VERSION, is_saved, read_header};

/// What the whole structure may take, 18 MB for 2048 x 2048 texels.
pub const BYTES_PER_TEXEL: f64 = 18e6 / (2048.0 * 2048.0);

/// Quantisation of normals in standard deviations of a lobe.
const QUANTUM: f64 = 0.055;

/// A footprint that touches fewer texels is summed over them.
const DIRECT: f64 = 6500.0;

/// Relative error of the value at single half vectors from which on texels are summed instead, up to so many of them.
const LOCAL_TOLERANCE: f64 = 0.1;
const MOST_SUMMED: f64 = 1.2e6;

/// Side of the smallest square of texels with counts, as a power of two.
const LEAF_BITS: u32 = 4;

/// See the module.
pub struct CompactBinMap {
    map: (u32, u32),
    model: FlakeModel,
    filter: FootprintFilter,
    lobe: Lobe,
    tree: Tree,
    texels: Tiles,
    counts: Counts,
    /// Texels that are in no bin.
    strays: Strays,
    /// Finest level of the tree with counts, or its root.
    finest: usize,
    /// Relative deviation of the parts of each level's nodes.
    deviations: Vec<f64>,
    /// Of the map's half vectors, per solid angle: its mean over the map's own normals.
    mean_density: f64,
}

/// What of a [`Reflection`] is asked for.
#[derive(Clone, Copy, PartialEq)]
enum Wanted {
    Value,
    Density,
}

impl CompactBinMap {
    /// Builds the structure; the map is not kept.
    pub fn new(map: &NormalMap, model: FlakeModel) -> Self {
        let size = (map.width(), map.height());
        let alpha = model.flake.alpha();
        let bounds = grid::bounds(map, Vec3::truncate);
        let lobe = Lobe::new(model.flake.kind(), f64::from(alpha).powi(2));
        let share = share_in_reach(map, bounds, &lobe);
        let texels = Tiles::new(map, tiles::grid(bounds, QUANTUM * deviation(alpha)));
        let tree = Tree::new(size, LEAF_BITS);
        let core = strays::core(map, lobe.reach());
        let bins = counts::bins(counts::bin_width(alpha, share), core.bounds);
        let count = map.normals().len() as f64;
        let left = BYTES_PER_TEXEL * count - texels.bytes() as f64 - core.strays * Strays::BYTES * count;
        let finest = finest_counted_level(&tree, &bins, left, share);
        let grid = texels.grid();
        let quantised = |column, row| grid.normal(grid.cell(map.normal(column, row)));
        let has_strays = core.strays > 0.0 && finest < tree.levels();
        let is_counted = |normal: &Vec3| !has_strays || Counts::holds(&bins, *normal);
        let counts = Counts::new(&tree, bins, alpha, finest, |column, row| {
            Some(quantised(column, row)).filter(is_counted)
        });
        let strays = if has_strays {
            Strays::of(map, grid, lobe.reach(), |normal| !is_counted(normal))
        } else {
            Strays::none()
        };
        Self::assemble(size, model, tree, texels, counts, strays)
    }

    fn assemble(
        map: (u32, u32),
        model: FlakeModel,
        tree: Tree,
        texels: Tiles,
        counts: Counts,
        strays: Strays,
    ) -> Self {
        let alpha2 = f64::from(model.flake.alpha()).powi(2);
        // What quantisation adds to the normals' variance, a twelfth of the pitch squared along each axis, the lobe
        // gives up.
        let taken = f64::from(texels.grid().pitch).powi(2) / 6.0;
        let lobe = Lobe::new(model.flake.kind(), (alpha2 - taken).max(0.5 * alpha2));
        let finest = (0..tree.levels()).find(|&level| counts.has(level));
        Self {
            finest: finest.unwrap_or(tree.levels() - 1),
            deviations: counts.deviations(&tree, |texel| texels.normal(texel)),
            mean_density: counts.mean_density(&tree),
            map,
            model,
            filter: FootprintFilter::Box,
            lobe,
            tree,
            texels,
            counts,
            strays,
        }
    }

    /// The same structure, seen through `filter` from now on; at first it is the pixel's box.
    pub fn with_filter(self, filter: FootprintFilter) -> Self {
        Self { filter, ..self }
    }

    /// Bytes of the quantised normals with what finds them, and of the counts.
    pub fn bytes(&self) -> (usize, usize) {
        (self.texels.bytes(), self.counts.bytes() + self.strays.bytes())
    }

    /// The normal of a texel, quantised.
    pub fn normal(&self, column: u32, row: u32) -> Vec3 {
        self.texels.normal((column, row))
    }

    /// The means of the NDF over rectangles of the projected disk, as [`Method::ndf_over_all`] has them, summed over single
    /// texels: for footprints of few. Of whole lobes, not of truncated ones; within 0.02 of each lobe.
    pub fn means_over_texels(&self, footprint: &Footprint, rectangles: &[(Vec2, Vec2)]) -> RangeMeans {
        let ranges = rectangles.iter().take(MAX_RANGES);
        let mut sums: ArrayVec<f64, MAX_RANGES> = ranges.clone().map(|_| 0.0).collect();
        // A texel's normal takes longer to find than the part of a rectangle in its lobe.
        let mut add = |column, row, weight: f64| {
            let t = self.normal(column, row);
            for (sum, &(low, high)) in sums.iter_mut().zip(rectangles) {
                *sum += self.model.flat_ndf_integral(t, weight as f32, low, high);
            }
        };
        self.filter.over(footprint).for_each_part(|part| match part {
            FilteredPart::Texel { column, row } => add(column, row, 1.0),
            FilteredPart::Cut(window) => {
                for span in window.texel_spans(self.map.0, self.map.1) {
                    let row = span.row as u32;
                    for column in span.touched.0 as u32..span.touched.1 as u32 {
                        add(column, row, window.texel_weight(column, row));
                    }
                }
            }
            FilteredPart::Whole(weight) => {
                let texels = (0..self.map.1).flat_map(|row| (0..self.map.0).map(move |column| (column, row)));
                texels.for_each(|(column, row)| add(column, row, weight));
            }
        });
        let means = ranges.zip(sums);
        means
            .map(|(&(low, high), sum)| mean_over(low, high, || sum))
            .collect()
    }

    /// Whether the nodes of a level of the tree can be taken as a whole.
    fn is_unit(&self) -> impl Fn(usize) -> bool + '_ {
        |level| self.counts.has(level)
    }

    /// Whether a footprint is summed over its texels alone, without a cover: a small one, or a thin one, to which no
    /// square with counts is small; or a Gaussian evenly over a small map.
    fn is_direct(&self, filtered: &FilteredFootprint) -> bool {
        let Some(region) = filtered.region() else {
            return self.texel_count() < DIRECT;
        };
        let least = f64::from(self.tree.side(self.finest));
        let thickness = region.area()
            / region
                .edges()
                .iter()
                .map(|edge| edge.length())
                .fold(0.0, f64::max);
        region.texel_count() < DIRECT || thickness < least
    }

    fn scale(&self, footprint: &Footprint, filtered: &FilteredFootprint) -> Scale {
        let (small, error) = match (self.filter, filtered.texel_in_deviations()) {
            (FootprintFilter::Box, _) => self
                .tree
                .small_side(cover::error_of_box(footprint), &self.deviations),
            (_, Some(edges)) => self
                .tree
                .small_side(cover::error_of_gaussian(edges), &self.deviations),
            // All texels weigh the same.
            (_, None) => (f64::INFINITY, 0.0),
        };
        Scale {
            small,
            error,
            leaf: self.finest,
        }
    }

    /// Whether the value at a half vector of this density is to be summed over the texels: the error of a cover is that of
    /// the mean half vector, and where fewer texels reflect it is greater, as by chance.
    fn is_too_rough(&self, filtered: &FilteredFootprint, scale: Scale, density: f32) -> bool {
        let least = self.mean_density * (scale.error / LOCAL_TOLERANCE).powi(2);
        let is_affordable = |region: &Parallelogram| region.texel_count() <= MOST_SUMMED;
        density > 0.0 && f64::from(density) < least && filtered.region().is_some_and(is_affordable)
    }

    /// A footprint so large that a whole period of the map is small against it covers the map evenly.
    fn is_everywhere(&self, scale: Scale) -> bool {
        scale.small >= f64::from(self.tree.side(self.tree.levels() - 1))
    }

    fn texel_count(&self) -> f64 {
        f64::from(self.map.0) * f64::from(self.map.1)
    }

    /// Sum of all weights: under a box, a texel inside weighs one.
    fn total_weight(&self, footprint: &Footprint) -> f64 {
        match self.filter {
            FootprintFilter::Box => footprint.area(),
            FootprintFilter::Gaussian { .. } => 1.0,
        }
    }

    /// The weight of a texel in `part` where its node is taken by its counts; where it is not, nothing.
    fn counted(&self, part: &cover::Part, texel: u32) -> f64 {
        let texel = (texel % self.map.0, texel / self.map.0);
        match self.tree.covering(part, texel, &self.is_unit()) {
            (node, Treatment::Whole(weight)) if self.counts.has(node.level) => weight,
            _ => 0.0,
        }
    }

    /// Whether a texel is in no bin.
    fn is_stray(&self, normal: Vec3) -> bool {
        !self.strays.is_empty() && !Counts::holds(self.counts.bins(), normal)
    }

    /// Value and density over a footprint.
    fn query(&self, footprint: &Footprint, query: Query, wanted: Wanted) -> Reflection {
        let new = || Sums::new(query, self.lobe, *self.texels.grid());
        let mut sums = new();
        if footprint.region().is_none() {
            let [x, y] = self.texels.cell(footprint.texel());
            sums.add_alike(1, f32x8::splat(x as f32), f32x8::splat(y as f32), 1.0);
            return sums.totals(1.0);
        }
        let filtered = self.filter.over(footprint);
        let norm = (1.0 / self.total_weight(footprint)) as f32;
        if self.is_direct(&filtered) {
            self.add_texels(footprint, &filtered, &mut sums);
            return sums.totals(norm);
        }
        let scale = self.scale(footprint, &filtered);
        self.add_cover(footprint, &filtered, scale, &mut sums);
        let mut found = sums.totals(norm);
        if wanted == Wanted::Value && self.is_too_rough(&filtered, scale, found.density) {
            let mut sums = new();
            self.add_texels(footprint, &filtered, &mut sums);
            found.value = sums.totals(norm).value;
        }
        found
    }

    /// Adds a footprint's texels.
    fn add_texels(&self, footprint: &Footprint, filtered: &FilteredFootprint, sums: &mut Sums) {
        let everything = Rect {
            low: (0, 0),
            high: self.map,
        };
        filtered.for_each_part(|part| match part {
            FilteredPart::Cut(window) => self.texels.add(&Border::new(&window), &everything, sums),
            // Only a map of fewer texels than a small footprint lies inside one entirely.
            FilteredPart::Whole(weight) => {
                let weight = match self.filter {
                    FootprintFilter::Box => periods(weight, footprint),
                    FootprintFilter::Gaussian { .. } => weight,
                };
                self.texels.add_all(&everything, weight as f32, sums);
            }
            FilteredPart::Texel { .. } => {}
        });
    }

    /// Adds what covers a large footprint.
    fn add_cover(&self, footprint: &Footprint, filtered: &FilteredFootprint, scale: Scale, sums: &mut Sums) {
        if self.is_everywhere(scale) {
            let even = self.total_weight(footprint) / self.texel_count();
            let mut covered = Covered::new(self, &[], sums);
            self.cover(None, scale, |node, treatment| {
                covered.add(node, treatment.scaled(even), &[]);
            });
            covered.finish(&[(cover::Part::new(None, scale), even)]);
        } else if let Some(window) = filtered.single_window() {
            let border = Border::new(&window);
            let mut covered = Covered::new(self, std::slice::from_ref(&border), sums);
            self.cover(Some(&window), scale, |node, treatment| {
                covered.add(node, treatment, &[0])
            });
            covered.finish(&[(cover::Part::new(Some(&window), scale), 1.0)]);
        } else {
            self.add_parts(footprint, filtered, scale, sums);
        }
    }

    fn cover(&self, window: Option<&Window>, scale: Scale, mut visit: impl FnMut(&Node, Treatment)) {
        self.tree
            .cover(&cover::Part::new(window, scale), &self.is_unit(), &mut visit);
    }

    /// Adds what covers a footprint in several periods of the map. The same node may be covered in some of them: it is looked
    /// at once.
    fn add_parts(&self, footprint: &Footprint, filtered: &FilteredFootprint, scale: Scale, sums: &mut Sums) {
        let (mut windows, mut whole) = (Vec::new(), 0.0);
        filtered.for_each_part(|part| match part {
            FilteredPart::Cut(window) => windows.push(window),
            FilteredPart::Whole(weight) => whole = periods(weight, footprint),
            FilteredPart::Texel { .. } => {}
        });
        // Nodes, each with its weight or with the number of the border that cuts it.
        let mut nodes: Vec<(u64, Node, f64)> = Vec::new();
        let mut collect = |node: &Node, treatment, cut: u64| match treatment {
            Treatment::Whole(weight) => nodes.push((node.key() << 16, *node, weight)),
            Treatment::Texels => nodes.push((node.key() << 16 | cut, *node, 0.0)),
            Treatment::Nothing | Treatment::Descend => {}
        };
        for (window, cut) in windows.iter().zip(1..) {
            self.cover(Some(window), scale, |node, treatment| {
                collect(node, treatment, cut);
            });
        }
        if whole > 0.0 {
            self.cover(None, scale, |node, treatment| {
                collect(node, treatment.scaled(whole), 0);
            });
        }
        nodes.sort_unstable_by_key(|&(key, ..)| key);
        let cut = |&(key, ..): &(u64, Node, f64)| (key as u16).checked_sub(1);
        let cuts: Vec<u16> = nodes.iter().filter_map(cut).collect();
        let borders: Vec<Border> = windows.iter().map(Border::new).collect();
        let mut covered = Covered::new(self, &borders, sums);
        let mut rest = cuts.as_slice();
        for same in nodes.chunk_by(|a, b| a.0 >> 16 == b.0 >> 16) {
            let weight = same.iter().map(|&(.., weight)| weight).sum();
            let cuts;
            (cuts, rest) = rest.split_at(same.iter().filter_map(cut).count());
            covered.add_node(&same[0].1, weight, cuts);
        }
        let part = |window| cover::Part::new(window, scale);
        let mut parts: Vec<_> = windows.iter().map(|window| (part(Some(window)), 1.0)).collect();
        if whole > 0.0 {
            parts.push((part(None), whole));
        }
        covered.finish(&parts);
    }
}

/// Number of whole periods inside a box over which each texel has this weight.
fn periods(weight: f64, footprint: &Footprint) -> f64 {
    (weight * footprint.area()).round()
}

/// What covers a footprint: counts wait until there are several to read.
struct Covered<'a> {
    map: &'a CompactBinMap,
    /// Of the footprint, in all periods of the map.
    borders: &'a [Border<'a>],
    /// Small footprints have none.
    counts: Option<CountSum<'a>>,
    sums: &'a mut Sums,
}

impl<'a> Covered<'a> {
    fn new(map: &'a CompactBinMap, borders: &'a [Border<'a>], sums: &'a mut Sums) -> Self {
        Self {
            map,
            borders,
            counts: None,
            sums,
        }
    }

    fn add(&mut self, node: &Node, treatment: Treatment, cuts: &'a [u16]) {
        match treatment {
            Treatment::Whole(weight) => self.add_node(node, weight, &[]),
            Treatment::Texels => self.add_node(node, 0.0, cuts),
            Treatment::Nothing | Treatment::Descend => {}
        }
    }

    /// Adds the texels of a node, with a weight, and of each the area inside the borders `cuts`.
    fn add_node(&mut self, node: &Node, weight: f64, cuts: &'a [u16]) {
        let mut base = weight as f32;
        if base > 0.0 && self.map.counts.has(node.level) {
            let new = || CountSum::new(&self.map.counts, self.sums.query.half, self.sums.reach());
            self.counts
                .get_or_insert_with(new)
                .add(&self.map.tree, node, base);
            base = 0.0;
        }
        if base == 0.0 && cuts.is_empty() {
            return;
        }
        let rect = self.map.tree.rect(node);
        if base > 0.0 {
            self.map.texels.add_all(&rect, base, self.sums);
        }
        for &cut in cuts {
            self.map
                .texels
                .add(&self.borders[usize::from(cut)], &rect, self.sums);
        }
    }

    /// `parts`: that were covered, and how often each.
    fn finish(self, parts: &[(cover::Part, f64)]) {
        if let Some(mut counts) = self.counts {
            counts.finish(&self.map.lobe, self.sums);
            let (map, sums) = (self.map, self.sums);
            let in_part = |texel, (part, times): &(cover::Part, f64)| times * map.counted(part, texel);
            let weight = |texel| parts.iter().map(|part| in_part(texel, part)).sum::<f64>() as f32;
            map.strays.add(weight, sums);
        }
    }
}

impl Method for CompactBinMap {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        let query = Query::reflection(&self.model, &self.lobe, pair);
        self.query(footprint, query, Wanted::Value)
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        let query = Query::distribution(&self.model, h);
        self.query(footprint, query, Wanted::Density).density
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        let query = Query::distribution(&self.model, h);
        self.query(footprint, query, Wanted::Value).value
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let filtered = self.filter.over(footprint);
        let (texel, window) = filtered.sample_part([u[0].into(), u[1].into()]);
        let lobe = [u[2], u[3]];
        let exact = |texel| {
            let m = self.lobe.sample(self.texels.normal(texel), lobe);
            (m.z > 0.0).then_some(m)
        };
        if footprint.region().is_none() || self.is_direct(&filtered) {
            return exact(texel);
        }
        let scale = self.scale(footprint, &filtered);
        let everywhere = self.is_everywhere(scale);
        let part = cover::Part::new(window.as_ref().filter(|_| !everywhere), scale);
        let (node, treatment) = self.tree.covering(&part, texel, &self.is_unit());
        let texel = match treatment {
            Treatment::Whole(weight) if weight < 1.0 || everywhere => texel_of(&self.tree.rect(&node), u),
            Treatment::Nothing => return None,
            _ => texel,
        };
        let normal = self.texels.normal(texel);
        let is_whole = matches!(treatment, Treatment::Whole(_));
        if is_whole && self.counts.has(node.level) && !self.is_stray(normal) {
            self.counts.sample(&self.lobe, normal, texel, lobe)
        } else {
            exact(texel)
        }
    }

    fn map_size(&self) -> (u32, u32) {
        self.map
    }

    fn structure_bytes(&self) -> usize {
        self.texels.bytes() + self.counts.bytes() + self.strays.bytes()
    }

    fn bins(&self) -> Option<u32> {
        Some((2.0 / self.counts.bins().pitch) as u32)
    }

    fn name(&self) -> &'static str {
        "compact inverse bin map"
    }
}

/// A uniformly distributed texel of a rectangle, independent of where in the rectangle the point drawn with `u` lies.
fn texel_of(rect: &Rect, u: [f32; 4]) -> (u32, u32) {
    let z = mix(u64::from(u[0].to_bits()) << 32 | u64::from(u[1].to_bits()));
    let pick =
        |bits: u64, low: u32, high: u32| low + (((bits & 0xffff_ffff) * u64::from(high - low)) >> 32) as u32;
    (
        pick(z, rect.low.0, rect.high.0),
        pick(z >> 32, rect.low.1, rect.high.1),
    )
}

/// Share of the map's texels within reach of a half vector that a texel of the map reflects at: the map's concentration
/// times the lobe's area, from a histogram over `SIDE^2` cells.
fn share_in_reach(map: &NormalMap, bounds: (Vec2, Vec2), lobe: &Lobe) -> f64 {
    const SIDE: u32 = 64;
    let extent = (bounds.1 - bounds.0).max_element().max(1e-6);
    let grid = Grid::covering(bounds, f64::from(extent) / f64::from(SIDE));
    let mut histogram = vec![0.0_f64; (SIDE as usize + 2).pow(2)];
    let mut count = 0.0;
    for normal in grid::sparse(map) {
        let [x, y] = grid.cell(normal);
        histogram[(y * (SIDE + 2) + x) as usize] += 1.0;
        count += 1.0;
    }
    let concentration = histogram.iter().map(|n| n * n).sum::<f64>() / (count * count);
    let cells = std::f64::consts::PI * f64::from(lobe.reach() / grid.pitch).powi(2);
    (concentration * cells).min(1.0)
}

/// Standard deviation of a flake's slopes.
fn deviation(alpha: f32) -> f64 {
    f64::from(alpha) / std::f64::consts::SQRT_2
}

/// The finest level whose counts, with those of all above it, fit into `left` bytes; none finer than useful.
fn finest_counted_level(tree: &Tree, bins: &Grid, mut left: f64, share: f64) -> usize {
    let stride = f64::from(bins.size[0]) * f64::from(bins.size[1]);
    let mut finest = tree.levels();
    for level in (0..tree.levels()).rev() {
        left -= counts_bytes(tree, bins, level, share);
        if left < 0.0 || f64::from(tree.side(level)).powi(2) < 0.6 * stride {
            break;
        }
        finest = level;
    }
    finest
}

/// About so many bytes take the counts of a level.
fn counts_bytes(tree: &Tree, bins: &Grid, level: usize, share: f64) -> f64 {
    let texels = f64::from(tree.side(level)).powi(2);
    // About forty bins are within reach of a normal; the fullest may hold several times their mean, and more than half
    // of a direction that most texels share.
    let fullest = if share > counts::CONCENTRATED {
        0.6
    } else {
        6.0 / 40.0
    };
    let bytes_per_count = match fullest * texels * share {
        fullest if fullest < 256.0 => 1.0,
        fullest if fullest < 65_536.0 => 2.0,
        _ => 4.0,
    };
    bytes_per_count * f64::from(bins.size[0]) * f64::from(bins.size[1]) * tree.nodes(level) as f64
}

#[cfg(test)]
mod tests;
