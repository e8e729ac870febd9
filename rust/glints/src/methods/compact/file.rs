//! Saving and loading: a structure is built once, and used in place by every later run.
//!
//! **Format**, version 5. A file is a [`container`](crate::container) with these fields, f32 and f64 as their bits, f64 with the
//! lower half first:
//!
//! | field | type | |
//! |---|---|---|
//! | 0 | 2 u32 | columns and rows of texels, 1 to 65535 |
//! | 2 | f32 | roughness of a flake, as [`Flake`] takes it |
//! | 3 | u32 | its distribution: 0 Beckmann, 1 GGX |
//! | 4 | u32 | normalization: 0 projected area, 1 as in the paper |
//! | 5 | 3 f32, 2 u32 | grid of the quantised normals: corner, pitch, columns and rows |
//! | 10 | 3 f32, 2 u32 | bins of the counts, likewise |
//! | 15 | u32 | finest level with counts; the number of levels if none has |
//! | 16 | u32 | interpolation of the map that it was made from: 0 none, 1 bilinear |
//! | 17 | u32 | texels for each texel and side of that map, 1 to 8; without interpolation 1 |
//! | 18 | f32 | step between their normals, see [`Refinement::step`]; without interpolation 0 |
//! | 19 | 3 f64 | covariance of that map's slopes: uu, uv, vv |
//! | 25 | u32 | [`NormalMap::checksum`] of that map |
//! | 26 | 3 u32 | of [`super::strays`]: width of a square, columns and rows of squares |
//!
//! and sections, in this order:
//!
//! | elements | |
//! |---|---|
//! | 128 u8 | [`super::tiles`]: upper bytes of a tile |
//! | u32 | tiles: lower bits |
//! | u8, u16 or u32 | for each level that has them, from the finest on: counts, with their padding |
//! | u32 | strays: where the squares begin |
//! | 3 u32 | strays |
//!
//! Whatever changes these arrays, or a constant that queries of them rely on, takes another version. Versions up to 3 had
//! a head of their own, with the number of the version at the same place, so that they are told apart and refused.
//!
//! **The map** Fields 16 to 25 are what a renderer needs of the map when it has only the file: the slopes for shadowing, the map's
//! own, not those of quantised or refined normals; and by what the map is known again.
//!
//! **Loading** maps the file into memory, and reads all of it once, at about 8 GB/s once it is in the page cache (65 MB of a
//! 4096 x 4096 map in 8 ms, where building takes 1.8 s): for the checksum, which finds damage, and for [`super::check`],
//! which makes sure that no query can leave an array, whoever wrote the file. Every size is derived from the fields and
//! compared with the table, that of the strays with where their squares begin.

use std::fmt;
use std::ops::Range;
use std::path::Path;

use glam::Vec2;

use super::check::{self, demand};
use super::counts::{self, Counts, Level};
use super::cover::Tree;
use super::grid::Grid;
use super::strays::Strays;
use super::tiles::Tiles;
use super::{CompactBinMap, LEAF_BITS};
use crate::container::{Checked, Contents, Head, Kind, Section};
use crate::error::{Error, Result};
use crate::flakes::{FlakeModel, Normalization};
use crate::microfacet::{Distribution, Flake};
use crate::normal_map::{MIN_Z, NormalMap, SlopeCovariance};
use crate::refinement::{MAX_REFINEMENT, Refinement};

/// The version that is written, and the only one that is read.
pub const VERSION: u32 = 6;

const KIND: Kind = Kind {
    magic: *b"\x89GLINTS\n",
    version: VERSION,
    made_by: "glints precompute ibm",
};

/// The map that a structure was made from, as far as a renderer needs it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Origin {
    /// Columns and rows of the map.
    pub size: (u32, u32),
    /// How it was interpolated, if it was; the structure then has as many texels for each.
    pub refinement: Option<Refinement>,
    /// Covariance of its slopes.
    pub slopes: SlopeCovariance,
    /// [`NormalMap::checksum`].
    pub checksum: u32,
}

impl Origin {
    /// `map` as it was before it was interpolated.
    pub fn new(map: &NormalMap, refinement: Option<Refinement>) -> Self {
        Self {
            size: (map.width(), map.height()),
            refinement,
            slopes: map.slope_covariance(),
            checksum: map.checksum(),
        }
    }

    /// Columns and rows of the structure.
    fn texels(&self) -> (u64, u64) {
        let refined = |side| u64::from(side) * u64::from(self.refinement.map_or(1, |r| r.refinement));
        (refined(self.size.0), refined(self.size.1))
    }
}

/// What a saved structure is for.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// Version of the format.
    pub version: u32,
    /// Columns and rows of the structure: of the map, or of its refined texels where it was interpolated.
    pub map: (u32, u32),
    /// Roughness of a flake.
    pub alpha: f32,
    /// Distribution of a flake's microfacets.
    pub distribution: Distribution,
    /// How texels are weighted.
    pub normalization: Normalization,
    /// What it was made from. The file keeps the refinement's step in single precision, and not whether it was capped: who
    /// made the file was told.
    pub origin: Origin,
    /// Bytes of the quantised normals with what finds them.
    pub texel_bytes: u64,
    /// Bytes of the counts, and of the texels that are in no bin.
    pub count_bytes: u64,
    /// Bytes of the file.
    pub file_bytes: u64,
}

impl fmt::Display for Header {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let megabytes = |bytes: u64| bytes as f64 / 1e6;
        let distribution = match self.distribution {
            Distribution::Beckmann => "beckmann",
            Distribution::Ggx => "ggx",
        };
        let normalization = match self.normalization {
            Normalization::Projected => "projected area",
            Normalization::Paper => "area of the texture",
        };
        writeln!(
            f,
            "structure         compact inverse bin map, file format {}",
            self.version
        )?;
        writeln!(f, "size              {} x {} texels", self.map.0, self.map.1)?;
        let Origin {
            size,
            refinement,
            slopes,
            checksum,
        } = self.origin;
        write!(f, "map               {} x {} texels, ", size.0, size.1)?;
        if let Some(Refinement { refinement, step, .. }) = refinement {
            write!(
                f,
                "interpolated, {refinement} x {refinement} texels for each, {step:.2} standard deviations of a lobe apart, "
            )?;
        }
        writeln!(f, "checksum {checksum:08x}")?;
        writeln!(
            f,
            "slope covariance  uu {:.3e}, uv {:.3e}, vv {:.3e}",
            slopes.xx, slopes.xy, slopes.yy
        )?;
        writeln!(
            f,
            "flakes            alpha {}, {distribution}, weighted by {normalization}",
            self.alpha
        )?;
        write!(
            f,
            "memory            {:.2} MB: {:.2} MB for normals, {:.2} MB for counts",
            megabytes(self.file_bytes),
            megabytes(self.texel_bytes),
            megabytes(self.count_bytes)
        )
    }
}

/// Whether a file begins as a saved structure does; whatever cannot be read does not.
pub fn is_saved(path: &Path) -> bool {
    KIND.is_of(path)
}

/// What a saved structure is for, from the beginning of the file; the rest is not looked at.
///
/// # Errors
/// The file cannot be read, is no saved structure, has another version, or its header is damaged.
pub fn read_header(path: &Path) -> Result<Header> {
    let read = || {
        let head = KIND.read_head(path)?;
        let fields = Fields::new(&head).map_err(|what| KIND.inconsistent(&what))?;
        Ok(fields.header(&head))
    };
    read().map_err(|reason| refused(path, reason))
}

impl CompactBinMap {
    /// Writes the structure, made from the map `origin`: to a temporary file in the same folder, which then takes the name
    /// `path`. A file of that name is replaced; who has it mapped keeps what was in it.
    ///
    /// # Errors
    /// The file cannot be written; nothing is left of it. `origin` has another number of texels.
    pub fn save(&self, origin: &Origin, path: &Path) -> Result<()> {
        if origin.texels() != (self.map.0.into(), self.map.1.into()) {
            let value = format!("{} x {} texels", origin.size.0, origin.size.1);
            let reason = format!(
                "is not the map that a structure of {} x {} was made from; give that one, and how it was interpolated",
                self.map.0, self.map.1
            );
            return Err(Error::parameter("origin", value, reason));
        }
        KIND.write(path, &self.fields(origin), &self.sections())
            .map_err(|e| {
                let reason =
                    format!("cannot be written ({e}); check the folder, its permissions and its free space");
                refused(path, reason)
            })
    }

    /// Maps a file of [`Self::save`] into memory. It answers bit for bit as the saved structure did. The file may be replaced
    /// or removed later, but must not be written to or shortened in place.
    ///
    /// # Errors
    /// The file cannot be read, is no saved structure, has another version, is damaged, or its content is inconsistent.
    pub fn load(path: &Path) -> Result<(Self, Header)> {
        let load = || {
            let mut contents = KIND.read(path)?;
            let checked = |contents: &mut Contents| {
                let fields = Fields::new(&contents.head)?;
                let header = fields.header(&contents.head);
                Ok((fields.structure(contents)?, header))
            };
            checked(&mut contents).map_err(|what: String| KIND.inconsistent(&what))
        };
        load().map_err(|reason| refused(path, reason))
    }

    fn sections(&self) -> Vec<Section<'_>> {
        let (upper, lower) = self.texels.parts();
        let mut sections = vec![Section::new(upper), Section::new(lower)];
        let levels = self.counts.levels().iter().flatten();
        sections.extend(levels.map(|level| match level {
            Level::U8(counts) => Section::new(counts),
            Level::U16(counts) => Section::new(counts),
            Level::U32(counts) => Section::new(counts),
        }));
        let Strays { offsets, strays, .. } = &self.strays;
        sections.extend([Section::new(offsets), Section::new(strays)]);
        sections
    }

    fn fields(&self, origin: &Origin) -> Vec<u32> {
        let distribution = match self.model.flake.kind() {
            Distribution::Beckmann => 0,
            Distribution::Ggx => 1,
        };
        let normalization = match self.model.normalization {
            Normalization::Projected => 0,
            Normalization::Paper => 1,
        };
        let grid_fields = |grid: &Grid| {
            let [x, y] = grid.low.to_array().map(f32::to_bits);
            [x, y, grid.pitch.to_bits(), grid.size[0], grid.size[1]]
        };
        let levels = self.counts.levels();
        let finest = levels.iter().position(Option::is_some).unwrap_or(levels.len());
        let (interpolation, refinement, step) = match origin.refinement {
            None => (0, 1, 0.0),
            Some(r) => (1, r.refinement, r.step as f32),
        };
        let SlopeCovariance { xx, xy, yy } = origin.slopes;
        let halves = |value: f64| [value.to_bits() as u32, (value.to_bits() >> 32) as u32];

        let mut fields = vec![self.map.0, self.map.1, self.model.flake.alpha().to_bits()];
        fields.extend([distribution, normalization]);
        fields.extend(grid_fields(self.texels.grid()));
        fields.extend(grid_fields(self.counts.bins()));
        fields.extend([finest as u32, interpolation, refinement, step.to_bits()]);
        fields.extend([xx, xy, yy].into_iter().flat_map(halves));
        fields.push(origin.checksum);
        fields.extend(self.strays.squares);
        fields
    }
}

/// The fields, each in its domain, of a file with as many sections as they ask for.
struct Fields {
    map: (u32, u32),
    model: FlakeModel,
    grid: Grid,
    bins: Grid,
    tree: Tree,
    finest: usize,
    origin: Origin,
    /// Of the strays.
    squares: [u32; 3],
}

impl Fields {
    fn new(head: &Head) -> Checked<Self> {
        let mut words = Words(&head.fields);
        let [width, height] = words.take()?;
        let map = (width, height);
        let [alpha, distribution, normalization] = words.take()?;
        let (grid, bins) = (words.grid()?, words.grid()?);
        let [finest] = words.take()?;
        let origin = words.origin(map)?;
        let squares = words.take()?;
        demand(words.0.is_empty(), || "too many fields".into())?;

        check::map_size(map)?;
        let distribution = match distribution {
            0 => Distribution::Beckmann,
            1 => Distribution::Ggx,
            other => return Err(format!("distribution {other}")),
        };
        let normalization = match normalization {
            0 => Normalization::Projected,
            1 => Normalization::Paper,
            other => return Err(format!("normalization {other}")),
        };
        let flake = Flake::new(distribution, f32::from_bits(alpha)).map_err(|e| e.to_string())?;
        check::tile_grid(&grid)?;
        check::bins(&bins, flake.alpha())?;
        let tree = Tree::new(map, LEAF_BITS);
        let finest = finest as usize;
        demand(finest <= tree.levels(), || {
            "counts of a level that does not exist".into()
        })?;
        let fields = Self {
            map,
            model: FlakeModel { flake, normalization },
            grid,
            bins,
            tree,
            finest,
            origin,
            squares,
        };
        let expected = fields.stray_sections().end;
        demand(head.sections() == expected, || {
            format!("{} sections instead of {expected}", head.sections())
        })?;
        Ok(fields)
    }

    fn texel_sections(&self) -> Range<usize> {
        0..2
    }

    fn count_sections(&self) -> Range<usize> {
        let first = self.texel_sections().end;
        first..first + self.tree.levels() - self.finest
    }

    fn stray_sections(&self) -> Range<usize> {
        let first = self.count_sections().end;
        first..first + 2
    }

    fn header(&self, head: &Head) -> Header {
        Header {
            version: VERSION,
            map: self.map,
            alpha: self.model.flake.alpha(),
            distribution: self.model.flake.kind(),
            normalization: self.model.normalization,
            origin: self.origin,
            texel_bytes: head.section_bytes(self.texel_sections()),
            count_bytes: head.section_bytes(self.count_sections().start..self.stray_sections().end),
            file_bytes: head.length,
        }
    }

    fn structure(self, contents: &mut Contents) -> Checked<CompactBinMap> {
        let texels = self.tiles(contents)?;
        let counts = self.counts(contents)?;
        let strays = Strays {
            squares: self.squares,
            offsets: contents.take()?,
            strays: contents.take()?,
        };
        check::strays(&strays, self.map)?;
        Ok(CompactBinMap::assemble(
            self.map, self.model, self.tree, texels, counts, strays,
        ))
    }

    fn tiles(&self, contents: &mut Contents) -> Checked<Tiles> {
        let tiles = Tiles::from_parts(self.map, self.grid, Default::default());
        let (upper, lower) = tiles.lengths();
        let (upper, lower) = (
            contents.take_exactly(upper as u64)?,
            contents.take_exactly(lower as u64)?,
        );
        Ok(Tiles::from_parts(self.map, self.grid, (upper, lower)))
    }

    fn counts(&self, contents: &mut Contents) -> Checked<Counts> {
        let stride = u64::from(self.bins.size[0]) * u64::from(self.bins.size[1]);
        let mut levels = Vec::new();
        levels.resize_with(self.finest, || None);
        for index in self.finest..self.tree.levels() {
            // Below 2^32 nodes of less than 2^49 bins could be more than 2^64 counts.
            let count = (self.tree.nodes(index) as u64)
                .checked_mul(stride)
                .and_then(|count| count.checked_add(counts::PADDING as u64))
                .ok_or("more counts than memory")?;
            levels.push(Some(match contents.next_width() {
                Some(1) => Level::U8(contents.take_exactly(count)?),
                Some(2) => Level::U16(contents.take_exactly(count)?),
                _ => Level::U32(contents.take_exactly(count)?),
            }));
        }
        Ok(Counts::from_levels(self.bins, self.model.flake.alpha(), levels))
    }
}

/// Fields that are still to be read.
struct Words<'a>(&'a [u32]);

impl Words<'_> {
    fn take<const N: usize>(&mut self) -> Checked<[u32; N]> {
        let (words, rest) = self.0.split_first_chunk().ok_or("too few fields")?;
        self.0 = rest;
        Ok(*words)
    }

    fn f64(&mut self) -> Checked<f64> {
        let [low, high] = self.take()?;
        Ok(f64::from_bits(u64::from(high) << 32 | u64::from(low)))
    }

    fn grid(&mut self) -> Checked<Grid> {
        let [x, y, pitch] = self.take()?.map(f32::from_bits);
        Ok(Grid {
            low: Vec2::new(x, y),
            pitch,
            size: self.take()?,
        })
    }

    /// Of a structure with `texels` columns and rows.
    fn origin(&mut self, texels: (u32, u32)) -> Checked<Origin> {
        let [interpolation, refinement, step] = self.take()?;
        let step = f32::from_bits(step);
        let slopes = SlopeCovariance {
            xx: self.f64()?,
            xy: self.f64()?,
            yy: self.f64()?,
        };
        let [checksum] = self.take()?;
        demand(is_covariance(&slopes), || {
            let SlopeCovariance { xx, xy, yy } = slopes;
            format!("a slope covariance of {xx}, {xy}, {yy}")
        })?;
        let possible = (1..=MAX_REFINEMENT).contains(&refinement) && step.is_finite() && step >= 0.0;
        let whole = possible && texels.0 % refinement == 0 && texels.1 % refinement == 0;
        let refinement = match interpolation {
            0 if whole && refinement == 1 && step == 0.0 => None,
            1 if whole => Some(Refinement {
                refinement,
                step: step.into(),
                capped: false,
            }),
            _ => {
                return Err(format!(
                    "interpolation {interpolation} to {refinement} texels for each, {step} apart"
                ));
            }
        };
        let side = |texels: u32| texels / refinement.map_or(1, |r| r.refinement);
        Ok(Origin {
            size: (side(texels.0), side(texels.1)),
            refinement,
            slopes,
            checksum,
        })
    }
}

/// Whether slopes of a map, which are at most `1 / MIN_Z`, can have this covariance, up to rounding.
fn is_covariance(slopes: &SlopeCovariance) -> bool {
    let SlopeCovariance { xx, xy, yy } = *slopes;
    let largest = 1.001 / f64::from(MIN_Z).powi(2);
    let variances = [xx, yy].iter().all(|v| (0.0..=largest).contains(v));
    variances && xy.is_finite() && xy * xy <= 1.000_001 * xx * yy
}

fn refused(path: &Path, reason: String) -> Error {
    Error::File {
        path: path.into(),
        reason,
    }
}

#[cfg(test)]
mod tests;
