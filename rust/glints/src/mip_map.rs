//! A pyramid over a mask: the mean of a single-channel image over footprints.
//!
//! **Source** Williams, *Pyramidal Parametrics*, SIGGRAPH 1983; its use for the transparency of a layer of
//! flakes: Atanasov et al. 2021, Section 6.
//!
//! **Layout** One byte a texel, and one a block of `2^l x 2^l` texels on every level l, box-filtered: 4/3 bytes
//! a texel. Blocks at the right and upper border hold what the image has left for them, so every size of image
//! is filtered without padding.
//!
//! **Query** The footprint is a parallelogram of any shape. It is not replaced by a square of one level but
//! cut into blocks: those inside count with their mean, those on its border are subdivided until they are
//! small against the footprint, then count with their mean and the exact area of their intersection.
//!
//! **Error** Footprints of up to [`EXACT_TEXELS`] texels are summed texel by texel, exactly. For larger ones
//! the blocks' means are rounded to 1/255, each by at most 0.002, with errors that average out; a block on the
//! border has at most 1/256 of the footprint's area, so that the part of it inside the footprint is
//! represented by the whole block's mean. On random masks, for footprints up to ten times as long as wide, the
//! sum of both is 0.0005 in the median and stays below 0.01 (tests), for masks of single texels too.
//!
//! **Cost** Proportional to the root of the area up to [`EXACT_TEXELS`], bounded beyond, some hundred blocks.

use std::path::Path;

use glam::DVec2;

use crate::error::{Error, Result};
use crate::footprint::{Coverage, Footprint, Parallelogram, Part};
use crate::normal_map;

/// Largest area in texels of the footprints that are summed texel by texel.
pub const EXACT_TEXELS: f64 = 256.0;

/// Share of the footprint's area that a block on its border may have; a quarter of it costs twice the time.
const BORDER_SHARE: f64 = 1.0 / 256.0;

/// See the module.
pub struct MipMap {
    /// Level 0 is the image; the last level is one block.
    levels: Vec<Level>,
    /// Mean over the whole image.
    mean: f64,
}

struct Level {
    width: u32,
    height: u32,
    /// Means in 1/255, row by row.
    means: Vec<u8>,
}

impl MipMap {
    /// Takes `width * height` values, row by row, with 255 standing for one.
    ///
    /// # Errors
    /// An image without texels, or of another size than its values; `name` stands for the file.
    pub fn new(name: &str, width: u32, height: u32, values: Vec<u8>) -> Result<Self> {
        if values.is_empty() || values.len() as u64 != u64::from(width) * u64::from(height) {
            return Err(Error::Map {
                map: name.into(),
                reason: format!("has {} values for {width} x {height} texels", values.len()),
            });
        }
        let mut sums: Vec<u64> = values.iter().map(|&v| v.into()).collect();
        let mut levels = vec![Level {
            width,
            height,
            means: values,
        }];
        // From exact sums: rounding does not add up over the levels.
        for level in 1.. {
            let (w, h) = levels.last().map_or((1, 1), |l: &Level| (l.width, l.height));
            if w == 1 && h == 1 {
                break;
            }
            sums = halved(&sums, w, h);
            let mut next = Level {
                width: w.div_ceil(2),
                height: h.div_ceil(2),
                means: Vec::new(),
            };
            let area = |i: usize| {
                let (column, row) = (i as u32 % next.width, i as u32 / next.width);
                let extent = |c: u32, side: u32| u64::from((1 << level).min(side - (c << level)));
                extent(column, width) * extent(row, height)
            };
            let rounded = |(i, &sum): (usize, &u64)| ((sum + area(i) / 2) / area(i)) as u8;
            next.means = sums.iter().enumerate().map(rounded).collect();
            levels.push(next);
        }
        let mean = sums[0] as f64 / (f64::from(width) * f64::from(height) * 255.0);
        Ok(Self { levels, mean })
    }

    /// Reads a mask (EXR, PNG, JPEG or TIFF) as a binary one: 255 where the file's value, the red one of a
    /// colour image, is at least one half, else 0.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn load_binary(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let image = normal_map::decode(path)?;
        let (width, height) = (image.width(), image.height());
        let binary = |red: f32| if red >= 0.5 { 255 } else { 0 };
        let values = image.into_rgb32f().pixels().map(|p| binary(p.0[0])).collect();
        Self::new(&path.display().to_string(), width, height, values)
    }

    /// Columns and rows of the image.
    pub fn size(&self) -> (u32, u32) {
        (self.levels[0].width, self.levels[0].height)
    }

    /// The value of the texel at `column < width`, `row < height`.
    pub fn texel(&self, column: u32, row: u32) -> u8 {
        self.levels[0].at(column, row)
    }

    /// Mean over the footprint, in [0, 1]; the footprint is one over this image's size.
    pub fn mean_over(&self, footprint: &Footprint) -> f32 {
        let area = footprint.area();
        let mut sum = 0.0;
        footprint.for_each_part(|part| {
            sum += match part {
                Part::Texel { column, row } => f64::from(self.texel(column, row)) / 255.0,
                Part::Cut(region) if area <= EXACT_TEXELS => self.exact_sum(&region) / 255.0,
                Part::Cut(region) => {
                    let top = self.levels.len() - 1;
                    self.block_sum(&region, area * BORDER_SHARE, top, 0, 0) / 255.0
                }
                Part::Whole(count) => count as f64 * self.mean * self.extent().element_product(),
            }
        });
        ((sum / area) as f32).clamp(0.0, 1.0)
    }

    /// Memory of all levels.
    pub fn bytes(&self) -> usize {
        self.levels.iter().map(|l| size_of_val(l.means.as_slice())).sum()
    }

    fn extent(&self) -> DVec2 {
        DVec2::new(self.levels[0].width.into(), self.levels[0].height.into())
    }

    /// Sum of the values inside the region, each times the area of its texel in there.
    fn exact_sum(&self, region: &Parallelogram) -> f64 {
        let (width, height) = self.size();
        let mut sum = 0.0;
        for span in region.texel_spans(width, height) {
            let row = &self.levels[0].means[span.row as usize * width as usize..][..width as usize];
            let inside = &row[span.inside.0 as usize..span.inside.1 as usize];
            sum += f64::from(inside.iter().map(|&v| u32::from(v)).sum::<u32>());
            for column in (span.touched.0..span.inside.0).chain(span.inside.1..span.touched.1) {
                let value = row[column as usize];
                if value > 0 {
                    sum += f64::from(value) * region.texel_overlap(column as u32, span.row as u32);
                }
            }
        }
        sum
    }

    /// The same for one block, with blocks on the border of at most `border_area` texels taken as even.
    fn block_sum(
        &self,
        region: &Parallelogram,
        border_area: f64,
        level: usize,
        column: u32,
        row: u32,
    ) -> f64 {
        let side = f64::from(1_u32 << level);
        let low = DVec2::new(column.into(), row.into()) * side;
        let high = (low + side).min(self.extent());
        let block = &self.levels[level];
        let even = |area: f64| area * f64::from(block.at(column, row));
        match region.coverage(low, high) {
            Coverage::Outside => 0.0,
            Coverage::Inside => even((high - low).element_product()),
            Coverage::Cut if level == 0 || side * side <= border_area => even(region.overlap(low, high)),
            Coverage::Cut => {
                let below = &self.levels[level - 1];
                let (columns, rows) = (2 * column..2 * column + 2, 2 * row..2 * row + 2);
                rows.flat_map(|y| columns.clone().map(move |x| (x, y)))
                    .filter(|&(x, y)| x < below.width && y < below.height)
                    .map(|(x, y)| self.block_sum(region, border_area, level - 1, x, y))
                    .sum()
            }
        }
    }
}

impl Level {
    fn at(&self, column: u32, row: u32) -> u8 {
        self.means[row as usize * self.width as usize + column as usize]
    }
}

/// Sums of 2 x 2 entries; odd sizes leave one or two at the border.
fn halved(sums: &[u64], width: u32, height: u32) -> Vec<u64> {
    let (w, h) = (width.div_ceil(2) as usize, height.div_ceil(2) as usize);
    let mut result = vec![0; w * h];
    for (y, row) in sums.chunks_exact(width as usize).enumerate() {
        for (x, sum) in row.iter().enumerate() {
            result[y / 2 * w + x / 2] += sum;
        }
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A binary mask of square flakes of `flake` texels, half of them there.
    fn mask(width: u32, height: u32, flake: u32) -> MipMap {
        let value = |i: u32| {
            let cell = u64::from(i / width / flake * 4096 + i % width / flake);
            let bits = (cell + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
            if (bits ^ bits >> 29).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 63 == 1 {
                255
            } else {
                0
            }
        };
        MipMap::new("mask", width, height, (0..width * height).map(value).collect()).unwrap()
    }

    fn exact(map: &MipMap, footprint: &Footprint) -> f64 {
        let mut sum = 0.0;
        footprint.for_each_part(|part| {
            sum += match part {
                Part::Texel { column, row } => f64::from(map.texel(column, row)),
                Part::Cut(region) => map.exact_sum(&region),
                Part::Whole(count) => {
                    let total: u64 = map.levels[0].means.iter().map(|&v| u64::from(v)).sum();
                    count as f64 * total as f64
                }
            }
        });
        sum / footprint.area() / 255.0
    }

    #[test]
    fn levels_are_box_filtered() {
        let map = MipMap::new("five", 5, 3, (0..15).map(|i| i * 10).collect()).unwrap();
        let sizes: Vec<_> = map.levels.iter().map(|l| (l.width, l.height)).collect();
        assert_eq!(sizes, [(5, 3), (3, 2), (2, 1), (1, 1)]);
        assert_eq!(map.levels[1].means, [30, 50, 65, 105, 125, 140]);
        assert_eq!(map.levels[3].means, [70]);
        assert_eq!(map.bytes(), 15 + 6 + 2 + 1);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(96))]

        #[test]
        fn small_footprints_are_exact_and_large_ones_nearly(
            u in -1.0..2.0_f32, v in -1.0..2.0_f32, angle in 0.0..6.3_f32, log_size in -9.0..1.5_f32,
            log_aspect in 0.0..2.3_f32, flake in 1_u32..5,
        ) {
            let map = mask(301, 200, flake);
            let (sin, cos) = angle.sin_cos();
            let (long, short) = (log_size.exp(), (log_size - log_aspect).exp());
            let footprint = Footprint::new(
                301, 200, [u, v], [long * cos, long * sin], [-short * sin + 0.2 * short, short * cos]);
            let found = f64::from(map.mean_over(&footprint));
            let tolerance = if footprint.area() <= EXACT_TEXELS { 1e-5 } else { 0.01 };
            prop_assert!((found - exact(&map, &footprint)).abs() < tolerance,
                "{found} instead of {} over {} texels", exact(&map, &footprint), footprint.area());
        }
    }

    #[test]
    fn constant_masks_stay_constant() {
        let map = MipMap::new("one", 37, 11, vec![255; 37 * 11]).unwrap();
        for size in [0.0, 0.01, 0.4, 3.0, 100.0] {
            let footprint = Footprint::new(37, 11, [0.3, 0.9], [size, 0.1 * size], [0.0, size]);
            assert!((map.mean_over(&footprint) - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn values_must_fit_the_size() {
        let error = MipMap::new("wrong", 3, 3, vec![0; 8]).err().unwrap().to_string();
        assert!(error.contains("wrong") && error.contains("3 x 3"), "{error}");
    }
}
