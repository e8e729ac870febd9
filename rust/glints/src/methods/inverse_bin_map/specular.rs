//! Inverse bin maps for specular flakes: a constant filter over the bin of the half vector.
//!
//! **Source** Atanasov, Křivánek, Koylazov, Wilkie: *Efficient Multiscale Rendering of Specular Microstructure*,
//! SIGGRAPH 2020 Talks, Section 2: the inverse bin map before flakes had a roughness.
//!
//! **Computes** The distribution of normals averaged over the footprint A and over the solid angle of the one
//! bin `H_j` that holds the half vector,
//!
//! ```text
//! D(h) = W_j / |H_j|,   W_j = sum_{t_k in H_j} |A n T_k| / |A|,   j = beta(h),
//! ```
//!
//! and `R = D`: a mirror does not shadow itself, only the whole map's `G_x` remains.
//!
//! *Normalization.* The above is [`Normalization::Paper`]. With [`Normalization::Projected`] the texels' shares are
//! divided by the mean cosine of their bin, that is, `D(h) = W_j / integral of (h . n) over H_j`: it integrates to
//! one against the cosine exactly, whatever the size of the bins.
//!
//! *Sampling.* The texel at a random point of the footprint, then a direction uniform over its bin's solid angle:
//! exactly the density `W_j / |H_j|`.
//!
//! **Where it departs from the publication** The talk's "equiangular" bins all have the solid angle `2 pi / B`; how
//! they are laid out it does not say. Here they are those of [`Binning::EqualSolidAngle`]. The index of bins
//! is an array instead of a hash map: 4 b^2 bytes, 0.3 MB for the talk's 255^2.
//!
//! **Layout** as in the [parent](super), with the talk's 16 texels in a leaf: about 8.5 bytes a texel.

use glam::Vec3;
use rayon::prelude::*;

use super::SCAN_FACTOR;
use super::bins::{self, Bin};
use super::cells::{Binning, Cells};
use super::inverse::InverseMap;
use crate::error::{Error, Result};
use crate::flakes::Normalization;
use crate::footprint::{Footprint, Parallelogram, Part};
use crate::half_vector::DirectionPair;
use crate::methods::{Method, Reflection};
use crate::normal_map::NormalMap;

/// The talk's leaf size (Section 2.3).
pub const LEAF_SIZE: u32 = 16;

/// Parameters of a [`SpecularBinMap`].
#[derive(Clone, Copy, Debug)]
pub struct SpecularOptions {
    /// Bins per side, in `[1, 16384]`; the talk's pictures have 63, 127 and 255.
    pub bins: u32,
    pub binning: Binning,
    /// Most texels in a leaf of the forest; `None`: [`LEAF_SIZE`].
    pub leaf_size: Option<u32>,
    pub normalization: Normalization,
}

/// See the module.
pub struct SpecularBinMap {
    width: u32,
    height: u32,
    normalization: Normalization,
    cells: Cells,
    bin_map: Vec<u32>,
    inverse: InverseMap,
}

impl SpecularBinMap {
    /// Bins the map and inverts it. The map is not kept.
    ///
    /// # Errors
    /// `bins` outside `[1, 16384]` or `leaf_size` of zero.
    pub fn new(map: &NormalMap, options: SpecularOptions) -> Result<Self> {
        let cells = Cells::new(options.binning, options.bins)?;
        let leaf_size = options.leaf_size.unwrap_or(LEAF_SIZE);
        if leaf_size == 0 {
            return Err(Error::parameter("leaf_size", leaf_size, "must be at least 1"));
        }
        let bin_map: Vec<u32> = map
            .normals()
            .par_iter()
            .with_min_len(1 << 14)
            .map(|&normal| cells.packed_bin(normal))
            .collect();
        let size = (map.width(), map.height());
        let inverse = InverseMap::new(&bin_map, size, options.bins, leaf_size);
        Ok(Self {
            width: map.width(),
            height: map.height(),
            normalization: options.normalization,
            cells,
            bin_map,
            inverse,
        })
    }

    /// The partition of the hemisphere.
    pub fn cells(&self) -> &Cells {
        &self.cells
    }

    /// The weight `W_j` of a bin in a footprint, at most one.
    pub fn bin_weight(&self, footprint: &Footprint, bin: Bin) -> f64 {
        let count = self.inverse.count(bin);
        if count == 0 {
            return 0.0;
        }
        let packed = bins::pack(bin);
        let mut area = 0.0;
        footprint.for_each_part(|part| {
            area += match part {
                Part::Texel { column, row } => {
                    f64::from(self.bin_map[(row * self.width + column) as usize] == packed)
                }
                Part::Whole(periods) => periods as f64 * f64::from(count),
                // The same crossover as with 21 bins.
                Part::Cut(region) => {
                    if region.texel_count() < SCAN_FACTOR * f64::from(count).sqrt().sqrt() {
                        self.scan(&region, packed)
                    } else {
                        self.inverse.area(&region, bin)
                    }
                }
            }
        });
        area / footprint.area()
    }

    /// The area of a bin's texels in `region`, from the bin map.
    fn scan(&self, region: &Parallelogram, packed: u32) -> f64 {
        let mut area = 0.0;
        for span in region.texel_spans(self.width, self.height) {
            let row = &self.bin_map[span.row as usize * self.width as usize..][..self.width as usize];
            let inside = &row[span.inside.0 as usize..span.inside.1 as usize];
            let count: u32 = inside.iter().map(|&bin| u32::from(bin == packed)).sum();
            area += f64::from(count);
            for column in (span.touched.0..span.inside.0).chain(span.inside.1..span.touched.1) {
                if row[column as usize] == packed {
                    area += region.texel_overlap(column as u32, span.row as u32);
                }
            }
        }
        area
    }

    /// Distribution of normals and density of `h`. The sliver of a bin that counts as empty has neither: it is
    /// not sampled.
    fn look_up(&self, footprint: &Footprint, h: Vec3) -> Reflection {
        let bin = self.cells.bin(h);
        let weight = self.bin_weight(footprint, bin);
        if weight == 0.0 {
            return Reflection::default();
        }
        let solid_angle = self.cells.solid_angle(bin);
        if solid_angle == 0.0 {
            return Reflection::default();
        }
        let measure = match self.normalization {
            Normalization::Projected => self.cells.projected_solid_angle(bin),
            Normalization::Paper => solid_angle,
        };
        Reflection {
            value: (weight / measure) as f32,
            density: (weight / solid_angle) as f32,
        }
    }
}

impl Method for SpecularBinMap {
    fn evaluate(&self, footprint: &Footprint, pair: &DirectionPair) -> Reflection {
        self.look_up(footprint, pair.half)
    }

    fn density(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.look_up(footprint, h).density
    }

    fn ndf(&self, footprint: &Footprint, h: Vec3) -> f32 {
        self.look_up(footprint, h).value
    }

    fn sample(&self, footprint: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        let (column, row) = footprint.sample_texel([u[0].into(), u[1].into()]);
        let bin = self.bin_map[row as usize * self.width as usize + column as usize];
        self.cells.sample(bins::unpack(bin), [u[2], u[3]])
    }

    fn map_size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    fn structure_bytes(&self) -> usize {
        size_of_val(self.bin_map.as_slice()) + self.inverse.bytes()
    }

    fn bins(&self) -> Option<u32> {
        Some(self.cells.resolution())
    }

    fn name(&self) -> &'static str {
        "specular bin map"
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::random_map;
    use super::*;
    use crate::flakes::FlakeModel;
    use crate::methods::direct::Direct;
    use crate::microfacet::{Distribution, Flake};
    use glam::DVec2;
    use proptest::prelude::*;

    fn build(map: &NormalMap, bins: u32, binning: Binning, leaf_size: u32) -> SpecularBinMap {
        let options = SpecularOptions {
            bins,
            binning,
            leaf_size: Some(leaf_size),
            normalization: Normalization::Projected,
        };
        SpecularBinMap::new(map, options).unwrap()
    }

    fn binning() -> impl Strategy<Value = Binning> {
        prop_oneof![Just(Binning::Projected), Just(Binning::EqualSolidAngle)]
    }

    fn vector(range: f64) -> impl Strategy<Value = DVec2> {
        (-range..range, -range..range).prop_map(|(x, y)| DVec2::new(x, y))
    }

    /// The share of the footprint whose texels' normals lie in each bin, texel by texel.
    fn naive_weights(map: &NormalMap, method: &SpecularBinMap, footprint: &Footprint) -> Vec<f64> {
        let flake = Flake::new(Distribution::Beckmann, 0.1).unwrap();
        let normalization = Normalization::Paper;
        let side = method.cells.resolution();
        let mut weights = vec![0.0; (side * side) as usize];
        Direct::new(map.clone(), FlakeModel { flake, normalization }).for_each_texel(
            footprint,
            |t, weight| {
                let (column, row) = method.cells.bin(t);
                weights[(row * side + column) as usize] += f64::from(weight);
            },
        );
        weights
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(100))]

        #[test]
        fn bin_weights_are_naive_counts(
            width in 1..40u32, height in 1..40u32, seed: u64, bins in 1..16u32, leaf_size in 1..12u32,
            binning in binning(), c in vector(90.0), a in vector(60.0), b in vector(60.0), scale in 0.001..2.0,
        ) {
            let map = random_map(width, height, 1.5, seed);
            let method = build(&map, bins, binning, leaf_size);
            let footprint = Footprint::in_texels(width, height, c, a * scale, b * scale);
            let expected = naive_weights(&map, &method, &footprint);
            let packed = |i: u32| (i % bins, i / bins);
            for (i, &weight) in expected.iter().enumerate() {
                let found = method.bin_weight(&footprint, packed(i as u32));
                prop_assert!((found - weight).abs() < 1e-5, "bin {i}: {found} against {weight}");
            }
        }
    }

    #[test]
    fn large_footprints_walk_the_forest() {
        let map = random_map(400, 300, 0.3, 7);
        let method = build(&map, 12, Binning::EqualSolidAngle, 16);
        let (a, b) = (DVec2::new(260.0, 80.0), DVec2::new(-60.0, 200.0));
        let footprint = Footprint::in_texels(400, 300, DVec2::new(390.0, 10.0), a, b);
        for (i, expected) in naive_weights(&map, &method, &footprint).into_iter().enumerate() {
            let bin = (i as u32 % 12, i as u32 / 12);
            let mut walked = 0.0;
            footprint.for_each_part(|part| {
                if let Part::Cut(region) = part {
                    walked += method.inverse.area(&region, bin);
                }
            });
            assert!((walked / footprint.area() - expected).abs() < 1e-6);
            assert!((method.bin_weight(&footprint, bin) - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn bad_parameters_are_named() {
        let map = random_map(4, 4, 0.1, 1);
        let error = |bins, leaf_size| {
            let options = SpecularOptions {
                bins,
                binning: Binning::default(),
                leaf_size,
                normalization: Normalization::default(),
            };
            SpecularBinMap::new(&map, options).err().unwrap().to_string()
        };
        assert!(error(0, None).contains("\"bins\" = 0"));
        assert!(error(20_000, None).contains("16384"));
        assert!(error(63, Some(0)).contains("\"leaf_size\""));
    }
}
