//! A generator of flake maps: the normal map of a layer of metallic flakes, and the mask of where there are
//! any.
//!
//! **Source** Atanasov et al. 2021, Section 6 and Figure 1: a car paint whose flakes' orientations are drawn
//! from a GTR distribution ([`crate::gtr`]).
//!
//! **Construction** The map is cut into the Voronoi cells of one jittered point per cell of a square grid, all
//! of it periodic, so that the map tiles. Every Voronoi cell is a polygonal flake of one constant normal, and
//! no two overlap. Cells are put in a random order, and the first ones become flakes until they cover the
//! share `density` of the map; the other texels hold no flake and have the normal +z.
//!
//! Every random number is a hash of the seed, the cell and its use: the map is the same whatever the number of
//! threads.

use std::path::{Path, PathBuf};

use glam::{DVec2, Vec3};
use image::{DynamicImage, ImageBuffer, Luma, Rgb};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::gtr::Gtr;
use crate::hash::mix;
use crate::normal_map::MIN_Z;

/// Most texels per side: a map and its mask then take 4 GB.
const MAX_SIDE: u32 = 16_384;

/// Smallest z of a flake, clear of [`MIN_Z`] also after a file's rounding. Steeper normals, one in a million
/// at `alpha = 1` and fewer below, become this steep.
const SMALLEST_Z: f32 = 1.2 * MIN_Z;

/// Parameters of [`generate`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlakeMapOptions {
    /// Texels per side, in [1, 16384].
    pub size: u32,
    /// Share of the area that flakes cover, in (0, 1]. It is met to half a flake; there is at least one flake.
    pub density: f32,
    /// Diameter in texels of the disk that has a flake's mean area, in [1, size].
    pub flake_size: f32,
    /// Exponent of the orientations' GTR distribution, in (0, 10].
    pub gamma: f32,
    /// Roughness of the orientations' GTR distribution, in [1e-4, 1].
    pub alpha: f32,
    /// Another seed makes another map of the same kind.
    pub seed: u64,
}

impl Default for FlakeMapOptions {
    /// A 2K map with the orientations of Figure 1.
    fn default() -> Self {
        Self {
            size: 2048,
            density: 0.6,
            flake_size: 3.0,
            gamma: 1.5,
            alpha: 0.002,
            seed: 0,
        }
    }
}

/// What [`generate`] makes; all texels row by row, `width * height` of them.
#[derive(Clone, Debug, PartialEq)]
pub struct FlakeMap {
    pub width: u32,
    pub height: u32,
    /// Unit normals in the local shading frame; +z where there is no flake.
    pub normals: Vec<Vec3>,
    /// 1 where a texel holds a flake, else 0.
    pub mask: Vec<f32>,
}

/// Makes a periodic flake map.
///
/// # Errors
/// A parameter outside its domain.
pub fn generate(options: &FlakeMapOptions) -> Result<FlakeMap> {
    let distribution = check(options)?;
    let cells = Cells::new(options);
    let labels = cells.rasterize(options.size);
    let normals = cells.flakes(&labels, options.density, &distribution);
    let texel = |&cell: &u32| normals[cell as usize];
    Ok(FlakeMap {
        width: options.size,
        height: options.size,
        normals: labels.par_iter().map(|l| texel(l).unwrap_or(Vec3::Z)).collect(),
        mask: labels
            .par_iter()
            .map(|l| f32::from(u8::from(texel(l).is_some())))
            .collect(),
    })
}

fn check(options: &FlakeMapOptions) -> Result<Gtr> {
    if !(1..=MAX_SIDE).contains(&options.size) {
        let reason = format!("must be 1 to {MAX_SIDE} texels per side");
        return Err(Error::parameter("size", options.size, reason));
    }
    if !(options.density > 0.0 && options.density <= 1.0) {
        let reason = "must be the share of the area that flakes cover, in (0, 1]";
        return Err(Error::parameter("density", options.density, reason));
    }
    if !(1.0..=options.size as f32).contains(&options.flake_size) {
        let reason = format!(
            "must be a diameter of 1 to {} texels, the map's side",
            options.size
        );
        return Err(Error::parameter("flake_size", options.flake_size, reason));
    }
    Gtr::new(options.gamma, options.alpha)
}

/// What a hash is used for.
#[derive(Clone, Copy)]
enum Use {
    SiteX,
    SiteY,
    Order,
    Tilt,
    Azimuth,
}

/// A grid of `side * side` cells over the map, each with one point.
struct Cells {
    seed: u64,
    side: u32,
    /// Points in units of cells, row by row.
    sites: Vec<DVec2>,
}

impl Cells {
    fn new(options: &FlakeMapOptions) -> Self {
        // A disk of diameter d has the area of a square of side d sqrt(pi) / 2.
        let spacing = f64::from(options.flake_size) * std::f64::consts::PI.sqrt() / 2.0;
        let side = (f64::from(options.size) / spacing).round().max(1.0) as u32;
        let mut cells = Self {
            seed: options.seed,
            side,
            sites: Vec::new(),
        };
        cells.sites = (0..side * side)
            .into_par_iter()
            .map(|cell| {
                let corner = DVec2::new(f64::from(cell % side), f64::from(cell / side));
                corner + DVec2::new(cells.uniform(cell, Use::SiteX), cells.uniform(cell, Use::SiteY))
            })
            .collect();
        cells
    }

    /// 64 random bits: the finaliser of SplitMix64 over the counter of this cell and use.
    fn bits(&self, cell: u32, usage: Use) -> u64 {
        let counter = u64::from(cell) * 8 + usage as u64 + 1;
        // The seed is mixed first, so that neighbouring seeds do not give shifted maps.
        mix(mix(self.seed).wrapping_add(counter.wrapping_mul(0x9e37_79b9_7f4a_7c15)))
    }

    fn uniform(&self, cell: u32, usage: Use) -> f64 {
        (self.bits(cell, usage) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// The cell whose point is nearest to each texel's centre.
    fn rasterize(&self, size: u32) -> Vec<u32> {
        let scale = f64::from(self.side) / f64::from(size);
        let center = |i: u32| (f64::from(i) + 0.5) * scale;
        (0..size)
            .into_par_iter()
            .flat_map_iter(|row| (0..size).map(move |column| DVec2::new(center(column), center(row))))
            .map(|p| self.nearest(p))
            .collect()
    }

    /// A cell's own point is within sqrt 2 cells, so two cells to either side suffice.
    fn nearest(&self, p: DVec2) -> u32 {
        let side = i64::from(self.side);
        let (column, row) = (p.x as i64, p.y as i64);
        let mut best = (f64::INFINITY, 0);
        for y in row - 2..=row + 2 {
            for x in column - 2..=column + 2 {
                let wrapped = (x.rem_euclid(side), y.rem_euclid(side));
                let cell = (wrapped.1 * side + wrapped.0) as u32;
                let shift = DVec2::new((x - wrapped.0) as f64, (y - wrapped.1) as f64);
                let distance2 = (self.sites[cell as usize] + shift).distance_squared(p);
                if distance2 < best.0 {
                    best = (distance2, cell);
                }
            }
        }
        best.1
    }

    /// The normals of the cells that are flakes.
    fn flakes(&self, labels: &[u32], density: f32, distribution: &Gtr) -> Vec<Option<Vec3>> {
        let mut areas = vec![0_u64; self.sites.len()];
        for &label in labels {
            areas[label as usize] += 1;
        }
        let mut order: Vec<u32> = (0..areas.len() as u32)
            .filter(|&c| areas[c as usize] > 0)
            .collect();
        order.par_sort_unstable_by_key(|&cell| (self.bits(cell, Use::Order), cell));

        let target = f64::from(density) * labels.len() as f64;
        let mut covered = 0;
        let mut normals = vec![None; areas.len()];
        for cell in order {
            let area = areas[cell as usize];
            // Closer to the target without this flake than with it.
            if covered > 0 && covered as f64 + 0.5 * area as f64 > target {
                break;
            }
            covered += area;
            normals[cell as usize] = Some(self.normal(cell, distribution));
        }
        normals
    }

    fn normal(&self, cell: u32, distribution: &Gtr) -> Vec3 {
        let normal = distribution.sample([self.uniform(cell, Use::Tilt), self.uniform(cell, Use::Azimuth)]);
        Vec3::new(normal.x, normal.y, normal.z.max(SMALLEST_Z)).normalize()
    }
}

impl FlakeMap {
    /// Writes the normals and the mask, each in the format of its file's extension: `exr` (32-bit floats,
    /// normals signed) or `png` (16 bits a component with n = 2 c - 1 for normals, 8 bits for the mask).
    ///
    /// A narrow distribution needs EXR: 16 bits resolve 0.00003 in the normal. Each file appears under its
    /// name when it is complete.
    ///
    /// # Errors
    /// Another extension, or a file that cannot be written.
    pub fn save(&self, normal_path: impl AsRef<Path>, mask_path: impl AsRef<Path>) -> Result<()> {
        let (normal_path, mask_path) = (normal_path.as_ref(), mask_path.as_ref());
        let formats = [Format::of(normal_path)?, Format::of(mask_path)?];
        write(normal_path, formats[0], &self.normal_image(formats[0]))?;
        write(mask_path, formats[1], &self.mask_image(formats[1]))
    }

    fn normal_image(&self, format: Format) -> DynamicImage {
        let at = |x: u32, y: u32| self.normals[(y * self.width + x) as usize];
        let code = |n: f32| ((0.5 * n + 0.5) * 65_535.0).round() as u16;
        match format {
            Format::Exr => {
                ImageBuffer::from_fn(self.width, self.height, |x, y| Rgb(at(x, y).to_array())).into()
            }
            Format::Png => {
                ImageBuffer::from_fn(self.width, self.height, |x, y| Rgb(at(x, y).to_array().map(code)))
                    .into()
            }
        }
    }

    fn mask_image(&self, format: Format) -> DynamicImage {
        let at = |x: u32, y: u32| self.mask[(y * self.width + x) as usize];
        match format {
            // The library writes colour only; all three channels are the mask.
            Format::Exr => ImageBuffer::from_fn(self.width, self.height, |x, y| Rgb([at(x, y); 3])).into(),
            Format::Png => ImageBuffer::from_fn(self.width, self.height, |x, y| {
                Luma([(at(x, y) * 255.0).round() as u8])
            })
            .into(),
        }
    }
}

#[derive(Clone, Copy)]
enum Format {
    Exr,
    Png,
}

impl Format {
    fn of(path: &Path) -> Result<Self> {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        match extension.as_deref() {
            Some("exr") => Ok(Self::Exr),
            Some("png") => Ok(Self::Png),
            _ => Err(Error::File {
                path: path.into(),
                reason: "has no extension that can be written; use .exr or .png".into(),
            }),
        }
    }
}

/// Writes beside `path`, then renames: a reader never sees half a file.
fn write(path: &Path, format: Format, image: &DynamicImage) -> Result<()> {
    let part = part_path(path);
    let format = match format {
        Format::Exr => image::ImageFormat::OpenExr,
        Format::Png => image::ImageFormat::Png,
    };
    let written = image
        .save_with_format(&part, format)
        .map_err(|e| e.to_string())
        .and_then(|()| std::fs::rename(&part, path).map_err(|e| e.to_string()));
    written.map_err(|e| {
        // Nothing can be done about a left-over that cannot be removed either.
        let _ = std::fs::remove_file(&part);
        Error::File {
            path: path.into(),
            reason: format!("cannot be written ({e}); check the folder, its permissions and the free space"),
        }
    })
}

fn part_path(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(format!(".{}.part", std::process::id()));
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mip_map::MipMap;
    use crate::normal_map::{Encoding, NormalMap};
    use proptest::prelude::*;

    fn options() -> FlakeMapOptions {
        FlakeMapOptions {
            size: 96,
            flake_size: 4.0,
            alpha: 0.1,
            ..FlakeMapOptions::default()
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn coverage_is_the_density_and_texels_without_flake_are_flat(
            size in 20_u32..120, density in 0.02_f32..1.0, flake_size in 1.0_f32..12.0, seed in any::<u64>()
        ) {
            let map = generate(&FlakeMapOptions { size, density, flake_size, seed, ..options() }).unwrap();
            let texels = (size * size) as f32;
            let covered = map.mask.iter().sum::<f32>();
            // Half of a flake; a Voronoi cell of jittered points is at most a few mean areas large.
            let tolerance = (3.0 * flake_size * flake_size).max(1.0) / texels;
            prop_assert!((covered / texels - density).abs() <= tolerance, "{} of {density}", covered / texels);
            for (&normal, &mask) in map.normals.iter().zip(&map.mask) {
                prop_assert!(mask == 0.0 || mask == 1.0);
                prop_assert!((normal.length() - 1.0).abs() < 1e-5 && normal.z >= MIN_Z);
                prop_assert!(mask == 1.0 || normal == Vec3::Z);
            }
        }
    }

    #[test]
    fn full_density_leaves_no_gap() {
        let map = generate(&FlakeMapOptions {
            density: 1.0,
            ..options()
        })
        .unwrap();
        assert!(map.mask.iter().all(|&m| m == 1.0));
    }

    /// Kolmogorov-Smirnov test of the tilts and of the azimuths, one flake a Voronoi cell.
    #[test]
    fn orientations_follow_the_distribution() {
        for (gamma, alpha) in [(1.5, 0.002), (1.0, 0.05), (2.0, 0.3), (0.6, 1.0)] {
            let options = FlakeMapOptions {
                gamma,
                alpha,
                size: 300,
                density: 1.0,
                ..options()
            };
            let map = generate(&options).unwrap();
            let mut flakes = map.normals.clone();
            flakes.sort_by_key(|n| n.to_array().map(f32::to_bits));
            flakes.dedup();
            let gtr = Gtr::new(gamma, alpha).unwrap();
            let cumulative =
                |n: &Vec3| gtr.cumulative((1.0 - n.truncate().as_dvec2().length_squared()).max(0.0).sqrt());
            let azimuth = |n: &Vec3| f64::from(n.y).atan2(n.x.into()) / std::f64::consts::TAU + 0.5;
            assert!(flakes.len() > 5000);
            assert!(kolmogorov_smirnov(flakes.iter().map(cumulative)) < 1.63);
            assert!(kolmogorov_smirnov(flakes.iter().map(azimuth)) < 1.63);
            // The broken twin: other parameters.
            let other = Gtr::new(gamma + 0.5, 0.7 * alpha).unwrap();
            let wrong = |n: &Vec3| other.cumulative(n.z.into());
            assert!(kolmogorov_smirnov(flakes.iter().map(wrong)) > 2.0);
        }
    }

    /// `sqrt(n)` times the largest distance to the uniform distribution; beyond 1.63 in 1 % of all cases.
    fn kolmogorov_smirnov(values: impl Iterator<Item = f64>) -> f64 {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let count = values.len() as f64;
        let distance = |(i, v): (usize, &f64)| (v - i as f64 / count).max((i + 1) as f64 / count - v);
        values.iter().enumerate().map(distance).fold(0.0, f64::max) * count.sqrt()
    }

    /// Flakes go on across the borders as they do inside: as many neighbours share a flake there as elsewhere.
    #[test]
    fn maps_tile() {
        let size = 256;
        let map = generate(&FlakeMapOptions {
            size,
            density: 1.0,
            flake_size: 6.0,
            ..options()
        })
        .unwrap();
        let side = size as usize;
        let same = |a: usize, b: usize| u32::from(map.normals[a] == map.normals[b]);
        let columns = |x: usize| {
            (0..side)
                .map(|y| same(y * side + x, y * side + (x + 1) % side))
                .sum::<u32>()
        };
        let rows = |y: usize| {
            (0..side)
                .map(|x| same(y * side + x, (y + 1) % side * side + x))
                .sum::<u32>()
        };
        let inside = (0..side - 1).map(columns).sum::<u32>() as f64 / (side - 1) as f64;
        for seam in [columns(side - 1), rows(side - 1)] {
            // 80 % of neighbours share a flake; independent borders would share none.
            assert!(
                (f64::from(seam) - inside).abs() < 0.1 * side as f64,
                "{seam} {inside}"
            );
        }
    }

    #[test]
    fn maps_do_not_depend_on_the_number_of_threads_and_do_on_the_seed() {
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| generate(&options()).unwrap())
        };
        let one = with(1);
        assert_eq!(one, with(4));
        let other = generate(&FlakeMapOptions { seed: 1, ..options() }).unwrap();
        assert_ne!(one.mask, other.mask);
    }

    #[test]
    fn saved_maps_load_again() {
        let folder = std::env::temp_dir().join(format!("glints-flakes-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let map = generate(&FlakeMapOptions {
            size: 32,
            ..options()
        })
        .unwrap();
        for (extension, tolerance) in [("exr", 1e-6), ("png", 4e-5)] {
            let [normals, mask] = ["n", "m"].map(|name| folder.join(format!("{name}.{extension}")));
            map.save(&normals, &mask).unwrap();
            let loaded = NormalMap::load(&normals, Encoding::Automatic, false).unwrap();
            for (a, b) in loaded.normals().iter().zip(&map.normals) {
                assert!(a.abs_diff_eq(*b, tolerance), "{a} {b}");
            }
            let mask = MipMap::load_binary(&mask).unwrap();
            let value = |i: u32| f32::from(mask.texel(i % 32, i / 32)) / 255.0;
            assert!(map.mask.iter().zip(0..).all(|(&m, i)| value(i) == m));
        }
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 4, "left-over files");
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn bad_parameters_and_files_are_refused() {
        let message = |options: FlakeMapOptions| generate(&options).unwrap_err().to_string();
        assert!(message(FlakeMapOptions { size: 0, ..options() }).contains("\"size\""));
        assert!(
            message(FlakeMapOptions {
                density: 0.0,
                ..options()
            })
            .contains("\"density\"")
        );
        assert!(
            message(FlakeMapOptions {
                density: f32::NAN,
                ..options()
            })
            .contains("\"density\"")
        );
        assert!(
            message(FlakeMapOptions {
                flake_size: 0.5,
                ..options()
            })
            .contains("\"flake_size\"")
        );
        assert!(
            message(FlakeMapOptions {
                alpha: 0.0,
                ..options()
            })
            .contains("alpha")
        );
        let map = generate(&FlakeMapOptions {
            size: 4,
            flake_size: 1.0,
            ..options()
        })
        .unwrap();
        let error = map.save("normals.jpg", "mask.png").unwrap_err().to_string();
        assert!(error.contains("normals.jpg") && error.contains(".exr"), "{error}");
        let error = map
            .save("no/such/folder/n.exr", "mask.png")
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("no/such/folder/n.exr") && error.contains("cannot be written"),
            "{error}"
        );
    }
}
