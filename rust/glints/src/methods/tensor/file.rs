//! Saving and loading: a precomputation is done once, and used in place by every later run.
//!
//! A file is a [`container`](crate::container) with these fields,
//!
//! | field | |
//! |---|---|
//! | 0, 1 | columns and rows of the map |
//! | 2 | roughness of a flake, bits of an f32 |
//! | 3 | its distribution: 0 Beckmann, 1 GGX |
//! | 4 | pixels per side of an image |
//! | 5 | texels between the images of level 0 |
//! | 6 | levels |
//!
//! and sections: groups (3 u32), masks (u64), factors (i8), scales (u16), masses (u16), totals (f32), see [`super::images`]; and the
//! map's normals, x and y in 16 bits each (2 u16), from which the exact method for small footprints is built when the file is
//! loaded. So a file stands for its map.
//!
//! Whatever changes these arrays, or a constant that queries of them rely on, takes another version.

use std::fmt;
use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};

use super::images::{Group, Images, MAX_RANK, Members, PADDING, Parts};
use super::pyramid::Geometry;
use super::quantise::{LARGEST_SCALE, scale};
use super::{Options, Report, Tensor};
use crate::array::Array;
use crate::container::{Checked, Contents, Kind, Section};
use crate::error::{Error, Result};
use crate::flakes::{FlakeModel, Normalization};
use crate::hash::mix;
use crate::microfacet::{Distribution, Flake};
use crate::normal_map::{MAX_SIDE, MIN_Z, NormalMap};

/// The version that is written, and the only one that is read.
pub const VERSION: u32 = 2;

const KIND: Kind = Kind {
    magic: *b"\x89GLTNSR\n",
    version: VERSION,
    made_by: "glints precompute tensor",
};

/// Totals of images with energy.
const TOTALS: std::ops::RangeInclusive<f32> = 1e-3..=1e12;

/// What a saved precomputation is for.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// Version of the format.
    pub version: u32,
    /// Columns and rows of the map.
    pub map: (u32, u32),
    /// Roughness of a flake.
    pub alpha: f32,
    /// Distribution of a flake's microfacets.
    pub distribution: Distribution,
    /// Pixels per side of an image.
    pub resolution: u32,
    /// Texels between the images of level 0.
    pub stride: u32,
    pub levels: u32,
    /// Groups of blocks, and their mean rank.
    pub groups: usize,
    pub mean_rank: f64,
    /// Bytes of the compressed images.
    pub image_bytes: u64,
    /// Bytes of the file.
    pub file_bytes: u64,
}

impl fmt::Display for Header {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let distribution = match self.distribution {
            Distribution::Beckmann => "beckmann",
            Distribution::Ggx => "ggx",
        };
        writeln!(
            f,
            "structure         tensor-decomposed distributions of normals, file format {}",
            self.version
        )?;
        writeln!(f, "size              {} x {} texels", self.map.0, self.map.1)?;
        writeln!(f, "flakes            alpha {}, {distribution}", self.alpha)?;
        writeln!(
            f,
            "images            {0} x {0} pixels, {1} levels from a stride of {2} texels on",
            self.resolution, self.levels, self.stride
        )?;
        writeln!(
            f,
            "decomposition     {} groups, mean rank {:.1}",
            self.groups, self.mean_rank
        )?;
        write!(
            f,
            "memory            {:.2} MB: {:.2} MB of compressed images, the rest the map's normals",
            self.file_bytes as f64 / 1e6,
            self.image_bytes as f64 / 1e6
        )
    }
}

/// Whether a file begins as a saved precomputation does; whatever cannot be read does not.
pub fn is_saved(path: &Path) -> bool {
    KIND.is_of(path)
}

/// What a saved precomputation is for. All of the file is read, and checked.
///
/// # Errors
/// As [`Tensor::load`].
pub fn read_header(path: &Path) -> Result<Header> {
    let read = || {
        let contents = KIND.read(path)?;
        let file_bytes = contents.head.length;
        let saved = Saved::new(contents)?;
        let [.., resolution, stride, levels] = saved.fields;
        let ranks = saved.images.ranks();
        let groups = saved.images.ranks().count();
        Ok(Header {
            version: VERSION,
            map: saved.images.geometry.map,
            alpha: saved.model.flake.alpha(),
            distribution: saved.model.flake.kind(),
            resolution,
            stride,
            levels,
            groups,
            mean_rank: ranks.sum::<usize>() as f64 / groups.max(1) as f64,
            image_bytes: saved.images.parts().bytes() as u64,
            file_bytes,
        })
    };
    read().map_err(|reason| refused(path, reason))
}

impl Tensor {
    /// Writes the precomputation: to a temporary file in the same folder, which then takes the name `path`. `map` is what it
    /// was made from.
    ///
    /// # Errors
    /// The file cannot be written; nothing is left of it.
    pub fn save(&self, map: &NormalMap, path: &Path) -> Result<()> {
        let geometry = &self.images.geometry;
        let distribution = match self.model.flake.kind() {
            Distribution::Beckmann => 0,
            Distribution::Ggx => 1,
        };
        let fields = [
            geometry.map.0,
            geometry.map.1,
            self.model.flake.alpha().to_bits(),
            distribution,
            geometry.resolution,
            geometry.stride,
            geometry.levels.len() as u32,
        ];
        let normals = stored(map);
        let parts = self.images.parts();
        let sections = [
            Section::new(&parts.groups),
            Section::new(&parts.masks),
            Section::new(&parts.factors),
            Section::new(&parts.scales),
            Section::new(&parts.masses),
            Section::new(&parts.totals),
            Section::new(&normals),
        ];
        KIND.write(path, &fields, &sections).map_err(|e| {
            let reason =
                format!("cannot be written ({e}); check the folder, its permissions and its free space");
            refused(path, reason)
        })
    }

    /// Maps a file of [`Self::save`] into memory, and builds the exact method for small footprints. It answers bit for bit as the
    /// saved one did. With it comes the map, to 16 bits. The file may be replaced or removed later, but must not be written to or
    /// shortened in place.
    ///
    /// # Errors
    /// The file cannot be read, is no saved precomputation, has another version, is damaged, or its content is inconsistent.
    pub fn load(path: &Path) -> Result<(Self, NormalMap)> {
        let load = || {
            let saved = Saved::new(KIND.read(path)?)?;
            let map = decoded(path, saved.images.geometry.map, &saved.normals)
                .map_err(|e| KIND.inconsistent(&e.to_string()))?;
            Ok((Self::with_exact(&map, saved.model, saved.images), map))
        };
        load().map_err(|reason| refused(path, reason))
    }

    /// The precomputation of a map from a folder of such files, or, if it is not there, made and saved to it. Files are named by
    /// what they depend on: the map's normals, the flakes and the options.
    ///
    /// # Errors
    /// As [`Tensor::new`], [`Tensor::save`] and [`Tensor::load`]; the folder cannot be made.
    pub fn cached(
        map: &NormalMap,
        model: FlakeModel,
        options: &Options,
        folder: &Path,
        progress: &(dyn Fn(f64) + Sync),
    ) -> Result<(Self, Option<Report>)> {
        super::check(map, model, options)?;
        let path = cache_path(map, model, options, folder);
        if path.is_file() {
            return Ok((Self::load(&path)?.0, None));
        }
        std::fs::create_dir_all(folder).map_err(|e| Error::Parameter {
            name: "cache",
            value: folder.display().to_string(),
            reason: format!("the folder cannot be made ({e}); give another one"),
        })?;
        let (tensor, report) = Self::new(map, model, options, progress)?;
        tensor.save(map, &path)?;
        Ok((tensor, Some(report)))
    }
}

/// The name of a map's file in a folder of precomputations.
pub fn cache_path(map: &NormalMap, model: FlakeModel, options: &Options, folder: &Path) -> PathBuf {
    let mut hash = u64::from(VERSION);
    let mut add = |word: u64| hash = mix(hash ^ mix(word.wrapping_add(0x9e37_79b9_7f4a_7c15)));
    add(u64::from(map.width()) << 32 | u64::from(map.height()));
    for [x, y] in stored(map) {
        add(u64::from(x) << 16 | u64::from(y));
    }
    let what = format!("{:?} {} {options:?}", model.flake.kind(), model.flake.alpha());
    what.bytes().for_each(|byte| add(byte.into()));
    folder.join(format!("tensor-{hash:016x}.glints"))
}

/// Normals as a file holds them: x and y.
fn stored(map: &NormalMap) -> Vec<[u16; 2]> {
    let quantised = |x: f32| ((x + 1.0) * 32_767.5).round().clamp(0.0, 65_535.0) as u16;
    map.normals()
        .iter()
        .map(|n| [quantised(n.x), quantised(n.y)])
        .collect()
}

/// A map as a file holds it.
pub fn as_stored(map: &NormalMap) -> Result<NormalMap> {
    decoded(Path::new(map.name()), (map.width(), map.height()), &stored(map))
}

fn decoded(path: &Path, (width, height): (u32, u32), normals: &[[u16; 2]]) -> Result<NormalMap> {
    let normals: Vec<Vec3> = normals
        .iter()
        .map(|&[x, y]| {
            let p = Vec2::new(f32::from(x), f32::from(y)) / 32_767.5 - 1.0;
            // The steepest normals of a map, rounded, may lie outside the disk.
            let longest = (1.0 - 4.0 * MIN_Z * MIN_Z).sqrt();
            let p = p.clamp_length_max(longest);
            p.extend((1.0 - p.length_squared()).sqrt())
        })
        .collect();
    NormalMap::from_normals(path.display().to_string(), width, height, &normals)
}

/// The checked contents of a file.
struct Saved {
    fields: [u32; 7],
    model: FlakeModel,
    images: Images,
    normals: Array<[u16; 2]>,
}

impl Saved {
    fn new(mut contents: Contents) -> Checked<Self> {
        Self::checked(&mut contents).map_err(|what| KIND.inconsistent(&what))
    }

    /// What a query relies on is checked here; not what only makes answers wrong: a file with a right checksum was written as it
    /// is.
    fn checked(contents: &mut Contents) -> Checked<Self> {
        let fields = contents.head.fields.as_slice();
        let fields: [u32; 7] = fields
            .try_into()
            .map_err(|_| format!("{} fields", fields.len()))?;
        let [width, height, alpha, distribution, resolution, stride, levels] = fields;
        let fits = |side: u32| (1..=MAX_SIDE).contains(&side);
        demand(fits(width) && fits(height), "the size of the map")?;
        let distribution = match distribution {
            0 => Distribution::Beckmann,
            1 => Distribution::Ggx,
            other => return Err(format!("distribution {other}")),
        };
        let flake = Flake::new(distribution, f32::from_bits(alpha)).map_err(|e| e.to_string())?;
        let options = Options {
            resolution,
            stride,
            ..Options::default()
        };
        options.check_for((width, height)).map_err(|e| e.to_string())?;
        let geometry = Geometry::new((width, height), resolution, stride);
        demand(
            (1..=geometry.levels.len()).contains(&(levels as usize)),
            "the number of levels",
        )?;
        let geometry = geometry.coarsened(levels as usize);

        let parts = Parts {
            groups: contents.take()?,
            masks: contents.take()?,
            factors: contents.take()?,
            scales: contents.take()?,
            masses: contents.take()?,
            totals: contents.take()?,
        };
        let normals = contents.take_exactly(u64::from(width) * u64::from(height))?;
        check_parts(&geometry, &parts)?;
        Ok(Self {
            fields,
            model: FlakeModel {
                flake,
                normalization: Normalization::Projected,
            },
            images: Images::new(geometry, parts),
            normals,
        })
    }
}

fn check_parts(geometry: &Geometry, parts: &Parts) -> Checked<()> {
    let members = Members::new(geometry);
    demand(
        parts.masks.len() == parts.groups.len() * members.words,
        "the number of masks",
    )?;
    let mut rows = 0;
    let mut last = None;
    for (index, &packed) in parts.groups.iter().enumerate() {
        let group = Group::unpacked(packed);
        let place = (group.region, group.block);
        let region = members.images.get(group.region as usize);
        demand(
            last.is_none_or(|last| last < place) && u32::from(group.block) < geometry.blocks().pow(2),
            "the order of groups",
        )?;
        last = Some(place);
        let images = region.map_or(0, Vec::len);
        let mask = &parts.masks[index * members.words..][..members.words];
        let highest = mask
            .iter()
            .rposition(|&word| word != 0)
            .map_or(0, |w| 64 * w + 64 - mask[w].leading_zeros() as usize);
        demand(
            (1..=images).contains(&highest) && (1..=MAX_RANK).contains(&(group.rank as usize)),
            "a group",
        )?;
        let count: usize = mask.iter().map(|word| word.count_ones() as usize).sum();
        rows += count;
        let elements = super::images::elements(group.rank as usize, count);
        let fits = |first: u32, count: usize, length: usize| first as usize + count + PADDING <= length;
        demand(
            fits(group.factors, elements, parts.factors.len())
                && fits(
                    group.scales,
                    super::images::scales(group.rank.into()),
                    parts.scales.len(),
                ),
            "a group's place",
        )?;
    }
    demand(parts.masses.len() == rows, "the number of masses")?;
    demand(
        parts.totals.len() == geometry.images as usize,
        "the number of totals",
    )?;
    demand(
        parts.totals.iter().all(|t| *t == 0.0 || TOTALS.contains(t)),
        "a total",
    )?;
    demand(
        parts
            .scales
            .iter()
            .all(|&bits| (0.0..=LARGEST_SCALE).contains(&scale(bits))),
        "a scale",
    )
}

fn demand(holds: bool, what: &str) -> Checked<()> {
    if holds { Ok(()) } else { Err(what.into()) }
}

fn refused(path: &Path, reason: String) -> Error {
    Error::File {
        path: path.into(),
        reason,
    }
}
