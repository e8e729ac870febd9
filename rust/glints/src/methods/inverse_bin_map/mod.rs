//! Inverse bin maps: filtering a normal map with flake roughness at a cost that does not grow with the
//! footprint's area.
//!
//! **Source** Atanasov, Wilkie, Koylazov, Křivánek: *A Multiscale Microfacet Model Based on Inverse Bin
//! Mapping*, Eurographics 2021, Sections 4.2 and 5.
//!
//! **Computes** The binned BRDF of Eq. 15. The projected hemisphere is cut into `b x b` square bins; all
//! texels whose normal falls into bin j share the bin's representative normal `b_j`, and the sum over texels
//! becomes a sum over the 21 bins around the half vector,
//!
//! ```text
//! R(i, o) = sum_{j in N(beta(h))} W_j g_j D^alpha(h, b_j) G1(i, b_j) G1(o, b_j) [/ (b_j . n)],   W_j = sum_{t_k in H_j} w_k.
//! ```
//!
//! **Where it departs from the printed paper**
//!
//! * *Bins per side.* `b = floor(5 / sin theta_0)`, `theta_0 = atan(3 alpha / sqrt 2)`: Eq. 16 prints a
//!   ceiling, Table 4 (942, 235, 59, 15) was made with the floor.
//! * *Density.* Eq. 18 lacks the cosine of the sampled microfacet and the truncation. Here a sample whose
//!   normal `m`, drawn about `b_j`, leaves the neighbourhood (`j` not in `N(beta(m))`) fails, and `p(h) =
//!   sum_{j in N(beta(h))} W_j D^alpha(h, b_j) (h . b_j)`: exact partners, the density integrating to one
//!   minus the probability of failure (about 1 %).
//! * *Gain.* The truncation would darken the image by that percent. `g_j = 1 / (mass of the lobe inside its
//!   21 bins)` puts the energy back, so that the distribution of normals integrates to one ([`LobeGain`]).
//! * *GGX flakes.* The paper's bins are made for Beckmann's bounded lobe; of a GGX lobe the 21 bins hold 83 %
//!   (tilted by 60 degrees 88 %). The 17 % beyond are moved into the bins by the gain, so energy is kept, but
//!   the glow that a heavy tail spreads around a glint is not; as many samples fail. Wider bins (a smaller
//!   `bins`) hold more of the tail: half as many a side 95 %, a quarter 99 %.
//! * *Rim.* A bin whose centre lies outside the unit disk, or within an eighth of a bin of its rim, is
//!   represented by a point between its innermost corner and the rim.
//!
//! [`SpecularBinMap`] is the talk of 2020 that it grew out of: the same structure for flakes without roughness.
//!
//! The footprint is the pixel's box. A Gaussian one ([`crate::footprint_filter`], the paper's future work) has no
//! use for the forest as it is: a node answers by its number of texels where all of them weigh the same, and under
//! a Gaussian no two do. Nodes whose weights are even to 1e-3 of the peak are a thousandth of a standard deviation
//! wide: the query would be a sum over single texels. The compact structure ([`super::compact`]) has one, by weighting
//! texels one by one, and nodes by their mean where they are small against the Gaussian.
//!
//! **Layout**, for N texels and b^2 bins:
//!
//! | part | symbol | size |
//! |---|---|---|
//! | bin map, `by << 16 \| bx` per texel, row by row | B | 4 N |
//! | inverse bin map and its index ([`inverse::InverseMap`]) | B^-1, I | 4 N + 4.2 b^2 |
//! | forest | F | about 3 bytes per leaf of at most `leaf_size` texels |
//!
//! The index takes over at tiny roughness: `alpha = 0.0001` derives 16384 bins a side and 1.1 GB, whatever
//! the map; give `bins` then.
//!
//! **Bounds** A query costs O(perimeter) in the forest. A small footprint is answered by scanning the bin map
//! instead ([`SCAN_FACTOR`]), which yields the same weights at about a nanosecond a texel.

pub mod bins;
pub mod cells;
mod gain;
pub mod inverse;
pub mod specular;

use glam::Vec3;
use rayon::prelude::*;

use super::{Method, Reflection};
use crate::error::{Error, Result};
use crate::flakes::FlakeModel;
use crate::footprint::{Footprint, Parallelogram, Part};
use crate::half_vector::DirectionPair;
use crate::normal_map::NormalMap;
pub use cells::Binning;
pub use specular::{SpecularBinMap, SpecularOptions};

use bins::{BinGrid, Neighbourhood, SLOTS};
use gain::LobeGain;
use inverse::InverseMap;

/// The paper's leaf size L (Section 5.4).
pub const LEAF_SIZE: u32 = 10;

/// A footprint of fewer than `SCAN_FACTOR n^(1/4)` texels is answered from the bin map, where n is the number
/// of texels in the 21 bins: the measured crossover with the forest on 2K maps, isotropic and brushed, for
/// alpha from 0.0025 (1000 texels) to 0.16 (10 000 texels).
const SCAN_FACTOR: f64 = 375.0;

/// Parameters with the paper's defaults.
#[derive(Clone, Copy, Debug, Default)]
pub struct Options {
    /// Bins per side; `None`: [`bins::derived_resolution`] of the flake's roughness.
    pub bins: Option<u32>,
    /// Most texels in a leaf of the forest; `None`: [`LEAF_SIZE`].
    pub leaf_size: Option<u32>,
}

/// The structure of the module's header.
pub struct InverseBinMap {
    width: u32,
    height: u32,
    model: FlakeModel,
    grid: BinGrid,
    gain: LobeGain,
    bin_map: Vec<u32>,
    inverse: InverseMap,
}

impl InverseBinMap {
    /// Bins the map and inverts it. The map is not kept.
    ///
    /// # Errors
    /// `bins` outside `[1, 16384]` or `leaf_size` of zero.
    pub fn new(map: &NormalMap, model: FlakeModel, options: Options) -> Result<Self> {
        let resolution = options
            .bins
            .unwrap_or_else(|| bins::derived_resolution(model.flake.alpha()));
        let grid = BinGrid::new(resolution)?;
        let leaf_size = options.leaf_size.unwrap_or(LEAF_SIZE);
        if leaf_size == 0 {
            return Err(Error::parameter("leaf_size", leaf_size, "must be at least 1"));
        }
        let bin_map: Vec<u32> = map
            .normals()
            .par_iter()
            .with_min_len(1 << 14)
            .map(|&normal| grid.packed_bin(normal))
            .collect();
        let inverse = InverseMap::new(&bin_map, (map.width(), map.height()), resolution, leaf_size);
        Ok(Self {
            width: map.width(),
            height: map.height(),
            model,
            grid,
            gain: LobeGain::new(grid, model.flake),
            bin_map,
            inverse,
        })
    }

    /// The partition of the hemisphere.
    pub fn grid(&self) -> &BinGrid {
        &self.grid
    }

    /// The weights `W_j` of the bins around `h`, summing to at most one; zero for bins outside the
    /// neighbourhood.
    pub fn bin_weights(&self, footprint: &Footprint, h: Vec3) -> (Neighbourhood, [f32; SLOTS]) {
        let neighbourhood = self.grid.neighbourhood(h);
        let mut areas = [0.0; SLOTS];
        footprint.for_each_part(|part| match part {
            Part::Texel { column, row } => {
                let bin = self.bin_map[(row * self.width + column) as usize];
                if let Some(slot) = neighbourhood.slot(bin) {
                    areas[slot] += 1.0;
                }
            }
            Part::Cut(region) => self.add_areas(&region, &neighbourhood, &mut areas),
            Part::Whole(count) => {
                for (slot, bin) in neighbourhood.bins() {
                    areas[slot] += count as f64 * f64::from(self.inverse.count(bin));
                }
            }
        });
        let inv_area = 1.0 / footprint.area();
        (neighbourhood, areas.map(|area| (area * inv_area) as f32))
    }

    /// Adds the areas of the texels in `region` to the slots of their bins, in the way that is faster.
    fn add_areas(&self, region: &Parallelogram, bins: &Neighbourhood, areas: &mut [f64; SLOTS]) {
        let touched = region.texel_count();
        let scan_pays = || {
            let listed: u32 = bins.bins().map(|(_, bin)| self.inverse.count(bin)).sum();
            touched < SCAN_FACTOR * f64::from(listed).sqrt().sqrt()
        };
        // Bins of a single texel each would already justify a scan of this size.
        if touched < SCAN_FACTOR || scan_pays() {
            self.scan(region, bins, areas);
        } else {
            self.inverse.add_areas(region, bins, areas);
        }
    }

    /// Adds the areas of the texels in `region` to the slots of their bins, from the bin map.
    fn scan(&self, region: &Parallelogram, bins: &Neighbourhood, areas: &mut [f64; SLOTS]) {
        for span in region.texel_spans(self.width, self.height) {
            let start = span.row as usize * self.width as usize;
            let row = &self.bin_map[start..start + self.width as usize];
            bins.for_each_match(
                &row[span.touched.0 as usize..span.touched.1 as usize],
                |slot, offset| {
                    let column = span.touched.0 + offset as i64;
                    areas[slot] += if (span.inside.0..span.inside.1).contains(&column) {
                        1.0
                    } else {
                        region.texel_overlap(column as u32, span.row as u32)
                    };
                },
            );
        }
    }

    /// Calls `visit` with the representative normal, the weight and the gain of every bin around `h` that the
    /// footprint holds.
    #[inline]
    fn for_each_lobe(&self, footprint: &Footprint, h: Vec3, mut visit: impl FnMut(Vec3, f32, f32)) {
        let (neighbourhood, weights) = self.bin_weights(footprint, h);
        for (slot, bin) in neighbourhood.bins() {
            if weights[slot] > 0.0 {
                let normal = self.grid.representative(bin);
                visit(normal, weights[slot], self.gain.at(normal));
            }
        }
    }
}

impl Method for InverseBinMap {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        let mut sum = Reflection::default();
        self.for_each_lobe(footprint, pair.half, |t, weight, gain| {
            let term = self.model.reflection(pair, t, weight);
            sum.value += gain * term.value;
            sum.density += term.density;
        });
        sum
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        let mut sum = 0.0;
        self.for_each_lobe(footprint, h, |t, weight, _| {
            sum += self.model.density(h, t, weight);
        });
        sum
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        let mut sum = 0.0;
        self.for_each_lobe(footprint, h, |t, weight, gain| {
            sum += gain * self.model.ndf(h, t, weight);
        });
        sum
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let (column, row) = footprint.sample_texel([u[0].into(), u[1].into()]);
        let bin = self.bin_map[row as usize * self.width as usize + column as usize];
        let normal = self.grid.representative(bins::unpack(bin));
        let m = self.model.sample(normal, [u[2], u[3]])?;
        self.grid.neighbourhood(m).slot(bin).map(|_| m)
    }

    fn map_size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    fn structure_bytes(&self) -> usize {
        size_of_val(self.bin_map.as_slice()) + self.inverse.bytes() + self.gain.bytes()
    }

    fn bins(&self) -> Option<u32> {
        Some(self.grid.resolution())
    }

    fn name(&self) -> &'static str {
        "inverse bin map"
    }
}

#[cfg(test)]
mod tests;
