//! A decoded, validated normal map: the input of every method.
//!
//! A map is `width * height` unit normals in the local shading frame (x along u, y along v, z up), row by
//! row, row 0 at v = 0. The texel with column `i` and row `j` covers `[i, i+1) x [j, j+1)` of texel space,
//! and the map repeats in both directions. The surface is piecewise flat, one mirror (or rough flake) per
//! texel, as in Atanasov et al. 2021, Section 3.2; methods for smooth surfaces ask for
//! [`NormalMap::interpolated`] normals.
//!
//! Validation happens here, once: components are finite, lengths are not zero, and every normal points out of
//! the surface (`z >= MIN_Z`). Methods rely on it and check nothing again.
//!
//! A map takes 12 bytes a texel, and loading it 24 for a moment: the decoded image, and the normals.

use std::path::Path;

use glam::{DVec2, Vec2, Vec3};
use image::{DynamicImage, ImageReader, Limits};
use rayon::prelude::*;

use crate::error::{Error, Result};

/// Smallest z of a unit normal. Steeper texels (slopes beyond 1000) carry no projected area that single
/// precision could resolve, and the projected normalization divides by z.
pub const MIN_Z: f32 = 1e-3;

/// Most texels per side; texel indices must fit into 32 bits.
pub const MAX_SIDE: u32 = 65_535;

/// Most bytes of a decoded image: 32K x 32K texels of three floats.
const MAX_DECODED_BYTES: u64 = 12 << 30;

/// How a file stores a normal's components c.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Encoding {
    /// `Unsigned` for integer formats and for floating-point ones without negative components, else `Signed`.
    #[default]
    Automatic,
    /// n = 2 c - 1, with c in [0, 1].
    Unsigned,
    /// n = c.
    Signed,
}

/// Unit normals on a grid of texels; see the module for layout and guarantees.
#[derive(Clone, Debug)]
pub struct NormalMap {
    name: String,
    width: u32,
    height: u32,
    encoding: Encoding,
    normals: Vec<Vec3>,
}

/// Covariance of the map's slopes (-x/z, -y/z), every texel weighted alike.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SlopeCovariance {
    pub xx: f64,
    pub xy: f64,
    pub yy: f64,
}

impl NormalMap {
    /// Reads an EXR, PNG, JPEG or TIFF file; the format is recognised by content. `flip_y` negates the y
    /// component.
    pub fn load(path: impl AsRef<Path>, encoding: Encoding, flip_y: bool) -> Result<Self> {
        let path = path.as_ref();
        let image = decode(path)?;
        let (width, height) = (image.width(), image.height());
        let is_float = matches!(
            image,
            DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_)
        );
        if image.color().channel_count() < 3 {
            return Err(Error::File {
                path: path.into(),
                reason: "has fewer than three channels; a normal map needs red, green and blue".into(),
            });
        }
        let components = image.into_rgb32f().into_raw();
        let encoding = match encoding {
            Encoding::Automatic if is_float && components.iter().any(|&c| c < 0.0) => Encoding::Signed,
            Encoding::Automatic => Encoding::Unsigned,
            given => given,
        };
        let signed = encoding == Encoding::Signed;
        let flip = if flip_y { -1.0 } else { 1.0 };
        let decode_component = |c: f32| if signed { c } else { 2.0 * c - 1.0 };
        let vectors = components.chunks_exact(3).map(|c| {
            Vec3::new(
                decode_component(c[0]),
                flip * decode_component(c[1]),
                decode_component(c[2]),
            )
        });
        // Of known length, so that it does not grow; the decoded image goes before normals are made, in place.
        let vectors: Vec<Vec3> = vectors.collect();
        drop(components);
        // An 8-bit "no normal" (128, 128, 128) decodes to length 0.007, not to zero.
        let min_length = if signed { 1e-6 } else { 1e-2 };
        let mut map = Self::from_vectors(path.display().to_string(), width, height, vectors, min_length)?;
        map.encoding = encoding;
        Ok(map)
    }

    /// Takes `width * height` vectors of any positive length; `name` stands for the file in errors.
    pub fn from_normals(name: impl Into<String>, width: u32, height: u32, normals: &[Vec3]) -> Result<Self> {
        let name = name.into();
        if normals.len() as u64 != u64::from(width) * u64::from(height) {
            let reason = format!(
                "has {} normals, but {width} x {height} texels need {}",
                normals.len(),
                u64::from(width) * u64::from(height)
            );
            return Err(Error::Map { map: name, reason });
        }
        Self::from_vectors(name, width, height, normals.to_vec(), 1e-6)
    }

    /// Normalises `normals` in place.
    fn from_vectors(
        name: String,
        width: u32,
        height: u32,
        mut normals: Vec<Vec3>,
        min_length: f32,
    ) -> Result<Self> {
        let invalid = |reason: String| Error::Map {
            map: name.clone(),
            reason,
        };
        if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
            return Err(invalid(format!(
                "is {width} x {height} texels; a side must have 1 to {MAX_SIDE}"
            )));
        }
        for (index, normal) in normals.iter_mut().enumerate() {
            *normal = unit_normal(*normal, min_length).map_err(|problem| {
                let (column, row) = (index % width as usize, index / width as usize);
                invalid(format!(
                    "texel (column {column}, row {row}) decodes to ({}, {}, {}), {problem}",
                    normal.x, normal.y, normal.z
                ))
            })?;
        }
        Ok(Self {
            name,
            width,
            height,
            encoding: Encoding::Signed,
            normals,
        })
    }

    /// Where the map came from; used in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    pub fn width(&self) -> u32 {
        self.width
    }

    pub fn height(&self) -> u32 {
        self.height
    }

    /// How the file stored its normals, never `Automatic`; `Signed` for a map that was not read from a file.
    pub fn encoding(&self) -> Encoding {
        self.encoding
    }

    /// Unit normals, row by row; `width * height` of them.
    pub fn normals(&self) -> &[Vec3] {
        &self.normals
    }

    /// The unit normal of the texel at `column < width`, `row < height`.
    pub fn normal(&self, column: u32, row: u32) -> Vec3 {
        self.normals[row as usize * self.width as usize + column as usize]
    }

    /// The projected normal (x, y) at a position in texels, interpolated bilinearly between the centres of
    /// texels, with repetition. It lies inside the unit disk, as the disk is convex.
    pub fn interpolated(&self, position: DVec2) -> Vec2 {
        let p = position - 0.5;
        let corner = p.floor();
        let t = (p - corner).as_vec2();
        let wrap = |i: f64, side: u32| i.rem_euclid(f64::from(side)) as u32 % side;
        let projected = |dx: f64, dy: f64| {
            let n = self.normal(wrap(corner.x + dx, self.width), wrap(corner.y + dy, self.height));
            Vec2::new(n.x, n.y)
        };
        let low = projected(0.0, 0.0).lerp(projected(1.0, 0.0), t.x);
        let high = projected(0.0, 1.0).lerp(projected(1.0, 1.0), t.x);
        low.lerp(high, t.y)
    }

    /// The unit normal of [`NormalMap::interpolated`] at a position in texels.
    pub fn interpolated_normal(&self, position: DVec2) -> Vec3 {
        unprojected(self.interpolated(position))
    }

    /// The interpolated surface in `refinement` x `refinement` texels for each texel of this map, each with
    /// the normal of [`NormalMap::interpolated`] at its centre; this map itself for 1.
    ///
    /// The result has the name and the encoding of this map. It takes `12 refinement^2` bytes a texel, and
    /// nothing else but one row for each thread is needed to make it. A side beyond [`MAX_SIDE`] is an error.
    pub fn refined(&self, refinement: u32) -> Result<Self> {
        let sides = [self.width, self.height].map(|side| side.checked_mul(refinement));
        let [Some(width @ 1..=MAX_SIDE), Some(height @ 1..=MAX_SIDE)] = sides else {
            let reason = format!(
                "makes more than {MAX_SIDE} texels of a side, or none, of \"{}\" with {} x {}; take another one",
                self.name, self.width, self.height
            );
            return Err(Error::parameter("refinement", refinement, reason));
        };
        let mut refined = Self {
            name: self.name.clone(),
            width,
            height,
            encoding: self.encoding,
            normals: Vec::new(),
        };
        if refinement == 1 {
            refined.normals = self.normals.clone();
            return Ok(refined);
        }
        refined.normals = vec![Vec3::ZERO; width as usize * height as usize];
        let rows = refined.normals.par_chunks_exact_mut(width as usize).enumerate();
        rows.for_each_init(
            || vec![Vec2::ZERO; self.width as usize],
            |blend, (row, normals)| self.refine_row(refinement, row as u32, blend, normals),
        );
        Ok(refined)
    }

    /// Row `row` of the refined map, into `normals`. `blend` has room for a row of this map.
    fn refine_row(&self, refinement: u32, row: u32, blend: &mut [Vec2], normals: &mut [Vec3]) {
        let line = |row: u32| &self.normals[row as usize * self.width as usize..][..self.width as usize];
        let (below, above, t) = between_centers(row, refinement, self.height);
        for ((blend, low), high) in blend.iter_mut().zip(line(below)).zip(line(above)) {
            *blend = low.truncate().lerp(high.truncate(), t);
        }
        for (column, normal) in normals.iter_mut().enumerate() {
            let (left, right, t) = between_centers(column as u32, refinement, self.width);
            *normal = unprojected(blend[left as usize].lerp(blend[right as usize], t));
        }
    }

    /// Covariance of the slopes over all texels, in double precision.
    pub fn slope_covariance(&self) -> SlopeCovariance {
        slope_covariance(&self.normals)
    }

    /// CRC-32 of the unit normals, row by row: x, y and z of each as single-precision numbers, little-endian. It tells maps
    /// of one size apart, bit for bit.
    pub fn checksum(&self) -> u32 {
        let mut sum = crc32fast::Hasher::new();
        let mut row = Vec::new();
        for normals in self.normals.chunks_exact(self.width as usize) {
            row.clear();
            row.extend(normals.iter().map(|n| n.to_array().map(|c| c.to_bits().to_le())));
            sum.update(bytemuck::cast_slice(&row));
        }
        sum.finalize()
    }
}

/// The unit normal over a point of the unit disk.
fn unprojected(s: Vec2) -> Vec3 {
    s.extend((1.0 - s.length_squared()).max(MIN_Z * MIN_Z).sqrt())
}

/// The two texels, of `side` that repeat, between whose centres that of refined texel `index` lies, and its
/// distance from the first centre in texels.
#[inline]
fn between_centers(index: u32, refinement: u32, side: u32) -> (u32, u32, f32) {
    // Twice the distance from the centre of texel -1, in refined texels.
    let twice = 2 * u64::from(index) + 1 + u64::from(refinement);
    let period = 2 * u64::from(refinement);
    let next = (twice / period) as u32;
    let t = (twice % period) as f32 / period as f32;
    ((next + side - 1) % side, next % side, t)
}

/// Covariance of the slopes of unit normals, at least one, in double precision.
pub(crate) fn slope_covariance(normals: &[Vec3]) -> SlopeCovariance {
    let slope = |n: &Vec3| DVec2::new(f64::from(-n.x), f64::from(-n.y)) / f64::from(n.z);
    let count = normals.len() as f64;
    let mean = normals.iter().map(slope).sum::<DVec2>() / count;
    let mut sum = SlopeCovariance {
        xx: 0.0,
        xy: 0.0,
        yy: 0.0,
    };
    for normal in normals {
        let d = slope(normal) - mean;
        sum.xx += d.x * d.x;
        sum.xy += d.x * d.y;
        sum.yy += d.y * d.y;
    }
    SlopeCovariance {
        xx: sum.xx / count,
        xy: sum.xy / count,
        yy: sum.yy / count,
    }
}

pub(crate) fn decode(path: &Path) -> Result<DynamicImage> {
    let failed = |reason: String| Error::File {
        path: path.into(),
        reason,
    };
    let open = || ImageReader::open(path)?.with_guessed_format();
    let mut reader = open().map_err(|e| {
        failed(format!(
            "cannot be opened ({e}); check the path and the permissions"
        ))
    })?;
    // Maps of 16K x 16K texels are legitimate, but a broken header must not ask for all the memory there is.
    let mut limits = Limits::no_limits();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODED_BYTES);
    reader.limits(limits);
    reader.decode().map_err(|e| {
        failed(format!(
            "cannot be decoded ({e}); an EXR, PNG, JPEG or TIFF file with red, green and blue is needed"
        ))
    })
}

fn unit_normal(vector: Vec3, min_length: f32) -> std::result::Result<Vec3, &'static str> {
    if !vector.is_finite() {
        return Err("which is not finite; repair the file");
    }
    let length = vector.as_dvec3().length();
    if length < f64::from(min_length) {
        return Err("which has no length; repair the file or check the parameter \"encoding\"");
    }
    let normal = (vector.as_dvec3() / length).as_vec3();
    if normal.z < MIN_Z {
        return Err(
            "which does not point out of the surface; repair the file or check the parameter \"encoding\"",
        );
    }
    Ok(normal)
}

#[cfg(test)]
mod tests {
    use super::*;
    use approx::assert_relative_eq;
    use image::{ImageBuffer, Rgb};
    use std::path::PathBuf;

    /// A file in the temporary folder that is removed again.
    struct TemporaryFile(PathBuf);

    impl TemporaryFile {
        fn new(name: &str) -> Self {
            Self(std::env::temp_dir().join(format!("glints-{}-{name}", std::process::id())))
        }
    }

    impl Drop for TemporaryFile {
        fn drop(&mut self) {
            let _ = std::fs::remove_file(&self.0);
        }
    }

    fn write_floats(name: &str, texels: [[f32; 3]; 2]) -> TemporaryFile {
        let file = TemporaryFile::new(name);
        let image = ImageBuffer::from_fn(2, 1, |x, _| Rgb(texels[x as usize]));
        DynamicImage::ImageRgb32F(image).save(&file.0).unwrap();
        file
    }

    fn load_error(name: &str, texels: [[f32; 3]; 2]) -> String {
        let file = write_floats(name, texels);
        NormalMap::load(&file.0, Encoding::Automatic, false)
            .unwrap_err()
            .to_string()
    }

    #[test]
    fn integer_formats_are_unsigned() {
        for name in ["unsigned.png", "unsigned.tiff"] {
            let file = TemporaryFile::new(name);
            let texel = Rgb([255_u8, 0, 255]);
            ImageBuffer::from_pixel(3, 2, texel).save(&file.0).unwrap();
            let map = NormalMap::load(&file.0, Encoding::Automatic, false).unwrap();
            assert_eq!((map.width(), map.height()), (3, 2));
            assert_eq!(map.encoding(), Encoding::Unsigned);
            assert!(
                map.normal(2, 1)
                    .abs_diff_eq(Vec3::new(1.0, -1.0, 1.0).normalize(), 1e-6)
            );
            let flipped = NormalMap::load(&file.0, Encoding::Automatic, true).unwrap();
            assert!(flipped.normal(0, 0).abs_diff_eq(Vec3::ONE.normalize(), 1e-6));
        }
    }

    #[test]
    fn floating_point_formats_are_signed_when_a_component_is_negative() {
        let file = write_floats("signed.exr", [[-0.6, 0.0, 0.8], [0.0, 0.0, 1.0]]);
        let map = NormalMap::load(&file.0, Encoding::Automatic, false).unwrap();
        assert!(map.normal(0, 0).abs_diff_eq(Vec3::new(-0.6, 0.0, 0.8), 1e-6));
        assert_eq!(map.encoding(), Encoding::Signed);
        let file = write_floats("positive.exr", [[0.2, 0.5, 0.9], [0.5, 0.5, 1.0]]);
        let map = NormalMap::load(&file.0, Encoding::Automatic, false).unwrap();
        assert!(map.normal(0, 0).abs_diff_eq(Vec3::new(-0.6, 0.0, 0.8), 1e-6));
        let map = NormalMap::load(&file.0, Encoding::Signed, false).unwrap();
        assert!(
            map.normal(0, 0)
                .abs_diff_eq(Vec3::new(0.2, 0.5, 0.9).normalize(), 1e-6)
        );
    }

    #[test]
    fn errors_name_the_file_the_texel_and_the_remedy() {
        let up = [0.0, 0.0, 1.0];
        let message = load_error("nan.exr", [up, [f32::NAN, 0.0, 1.0]]);
        assert!(
            message.contains("nan.exr") && message.contains("column 1, row 0"),
            "{message}"
        );
        assert!(load_error("zero.exr", [up, [-0.0, 0.0, 0.0]]).contains("zero.exr"));
        assert!(load_error("down.exr", [[0.6, 0.0, -0.8], up]).contains("out of the surface"));
        let missing = NormalMap::load("no/such.exr", Encoding::Automatic, false).unwrap_err();
        assert!(missing.to_string().contains("no/such.exr"));
    }

    #[test]
    fn grey_and_broken_files_are_refused() {
        let grey = TemporaryFile::new("grey.png");
        ImageBuffer::from_pixel(2, 2, image::Luma([128_u8]))
            .save(&grey.0)
            .unwrap();
        let error = |path| {
            NormalMap::load(path, Encoding::Automatic, false)
                .unwrap_err()
                .to_string()
        };
        assert!(error(&grey.0).contains("three channels"));
        let broken = TemporaryFile::new("broken.png");
        std::fs::write(&broken.0, b"\x89PNG\r\n\x1a\nnothing more").unwrap();
        assert!(error(&broken.0).contains("cannot be decoded"));
    }

    #[test]
    fn slope_covariance_is_that_of_the_slopes() {
        let normals =
            [(0.3, 0.1), (-0.3, -0.1), (0.1, -0.2), (-0.1, 0.2)].map(|(x, y)| Vec3::new(-x, -y, 1.0));
        let map = NormalMap::from_normals("four", 2, 2, &normals).unwrap();
        let covariance = map.slope_covariance();
        assert_relative_eq!(covariance.xx, 0.05, epsilon = 1e-6);
        assert_relative_eq!(covariance.yy, 0.025, epsilon = 1e-6);
        assert_relative_eq!(covariance.xy, 0.005, epsilon = 1e-6);
    }
}
