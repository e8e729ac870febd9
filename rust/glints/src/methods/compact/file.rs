//! Saving and loading: a structure is built once, and used in place by every later run.
//!
//! **Format**, version 3. Numbers are little-endian. The fixed fields:
//!
//! | offset | type | |
//! |---|---|---|
//! | 0 | 8 bytes | `\x89GLINTS\n`: neither text nor left alone by transfers that change ends of lines |
//! | 8 | u32 | byte-order mark, `0x0a0b0c0d` |
//! | 12 | u32 | version |
//! | 16 | u32 | CRC-32 of the bytes from 20 to the end of the table |
//! | 20 | u32 | CRC-32 of what follows the table |
//! | 24 | u64 | bytes of the file |
//! | 32 | 2 u32 | columns and rows of the map, 1 to 65535 |
//! | 40 | f32 | roughness of a flake, as [`Flake`] takes it |
//! | 44 | u32 | its distribution: 0 Beckmann, 1 GGX |
//! | 48 | u32 | normalization: 0 projected area, 1 as in the paper |
//! | 52 | u32 | texels: 0 in [`super::tiles`], 1 in [`super::blocks`] |
//! | 56 | 2 u32 | of blocks, s and r; of tiles, zero |
//! | 64 | 3 f32, 2 u32 | grid of the quantised normals: corner, pitch, columns and rows |
//! | 84 | 3 f32, 2 u32 | bins of the counts, likewise |
//! | 104 | u32 | finest level with counts; the number of levels if none has |
//! | 108 | u32 | number of sections |
//!
//! The table has 24 bytes for each section: kind (u32), bytes of an element (u32), offset (u64) and number of elements
//! (u64). Sections stand in the order of their kinds, each at the next multiple of 64 bytes; the file ends with the last.
//!
//! | kind | elements | |
//! |---|---|---|
//! | 0 | u32 | packed words of blocks, or tiles |
//! | 1 | 3 u32 | blocks: extents of the rows of cells |
//! | 2 | u32 | blocks: where the rows of cells begin |
//! | 3 | u16 or u32 | blocks: where the cells begin |
//! | 4 | u16 | blocks: pointers of the permutations, each the number of another |
//! | 16 + level | u8, u16 or u32 | counts of a level, with its padding |
//!
//! Whatever changes these arrays, or a constant that queries of them rely on, takes another version.
//!
//! **Loading** maps the file into memory, and reads all of it once, at about 8 GB/s once it is in the page cache (65 MB of a
//! 4096 x 4096 map in 8 ms, where building takes 1.8 s): for the checksum, which finds damage, and for [`super::check`],
//! which makes sure that no query can leave an array, whoever wrote the file. Every size is derived from the fixed fields
//! and compared with the table.

use std::fmt;
use std::fs::File;
use std::io::{self, Read, Write};
use std::path::Path;
use std::sync::Arc;

use bytemuck::Pod;
use glam::Vec2;
use memmap2::Mmap;

use super::blocks::{Blocks, Geometry, Offsets, Parts};
use super::check;
use super::counts::{self, Counts, Level};
use super::cover::Tree;
use super::grid::Grid;
use super::tiles::Tiles;
use super::{CompactBinMap, LEAF_BITS, Texels};
use crate::array::Array;
use crate::container::temporary_beside;
use crate::error::{Error, Result};
use crate::flakes::{FlakeModel, Normalization};
use crate::microfacet::{Distribution, Flake};

/// The version that is written, and the only one that is read.
pub const VERSION: u32 = 3;

const MAGIC: [u8; 8] = *b"\x89GLINTS\n";
const BYTE_ORDER: u32 = 0x0a0b_0c0d;

/// Where the first checksum's bytes begin, and the table.
const CHECKED: usize = 20;
const TABLE: usize = 112;

/// Bytes of a section in the table, and most sections: five, and the levels of the largest map.
const ENTRY: usize = 24;
const MAX_SECTIONS: usize = 32;

const ALIGNMENT: u64 = 64;

const WORDS: u32 = 0;
const EXTENTS: u32 = 1;
const ROWS: u32 = 2;
const OFFSETS: u32 = 3;
const POINTERS: u32 = 4;
const COUNTS: u32 = 16;

/// What a saved structure is for.
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
    /// How texels are weighted.
    pub normalization: Normalization,
    /// Bytes of the quantised normals with what finds them.
    pub texel_bytes: u64,
    /// Bytes of the counts.
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
    let mut magic = [0; MAGIC.len()];
    path.is_file()
        && File::open(path).is_ok_and(|mut file| file.read_exact(&mut magic).is_ok())
        && magic == MAGIC
}

/// What a saved structure is for, from the beginning of the file; the rest is not looked at.
///
/// # Errors
/// The file cannot be read, is no saved structure, has another version, or its header is damaged.
pub fn read_header(path: &Path) -> Result<Header> {
    let read = || -> std::result::Result<Header, String> {
        let (file, length) = open(path)?;
        let mut start = Vec::new();
        file.take((TABLE + MAX_SECTIONS * ENTRY) as u64)
            .read_to_end(&mut start)
            .map_err(unreadable)?;
        Ok(Preamble::parse(&start, length)?.header(length))
    };
    read().map_err(|reason| refused(path, reason))
}

impl CompactBinMap {
    /// Writes the structure: to a temporary file in the same folder, which then takes the name `path`. A file of that name
    /// is replaced; who has it mapped keeps what was in it.
    ///
    /// # Errors
    /// The file cannot be written; nothing is left of it.
    pub fn save(&self, path: &Path) -> Result<()> {
        self.write(path).map_err(|e| {
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
    pub fn load(path: &Path) -> Result<Self> {
        let load = || {
            let (file, length) = open(path)?;
            // SAFETY: all values of the mapped types are valid, so that only a change of the bytes while they are
            // borrowed could do harm. `save` never writes to a file that has its final name; others are told not to.
            let file = Arc::new(unsafe { Mmap::map(&file) }.map_err(unreadable)?);
            let preamble = Preamble::parse(&file, length)?;
            preamble.check_sum(&file)?;
            preamble.structure(&file)
        };
        load().map_err(|reason| refused(path, reason))
    }

    fn write(&self, path: &Path) -> io::Result<()> {
        let mut file = temporary_beside(path)?;
        let sections = self.sections();
        file.write_all(&self.preamble(&sections))?;
        for_each_chunk(&sections, |bytes| file.write_all(bytes))?;
        file.as_file().sync_all()?;
        file.persist(path).map_err(|e| e.error)?;
        Ok(())
    }

    fn sections(&self) -> Vec<Section<'_>> {
        let mut sections = match &self.texels {
            Texels::Tiles(tiles) => vec![Section::new(WORDS, tiles.units())],
            Texels::Blocks(blocks) => vec![
                Section::new(WORDS, blocks.words.units()),
                Section::new(EXTENTS, &blocks.extents),
                Section::new(ROWS, &blocks.rows),
                match &blocks.offsets {
                    Offsets::Narrow(offsets) => Section::new(OFFSETS, offsets),
                    Offsets::Wide(offsets) => Section::new(OFFSETS, offsets),
                },
                Section::new(POINTERS, &blocks.pointers),
            ],
        };
        for (index, level) in self.counts.levels().iter().enumerate() {
            let kind = COUNTS + index as u32;
            sections.extend(level.as_ref().map(|level| match level {
                Level::U8(counts) => Section::new(kind, counts),
                Level::U16(counts) => Section::new(kind, counts),
                Level::U32(counts) => Section::new(kind, counts),
            }));
        }
        sections
    }

    /// The fixed fields and the table.
    fn preamble(&self, sections: &[Section]) -> Vec<u8> {
        let table_end = TABLE + ENTRY * sections.len();
        let mut table = Vec::new();
        let mut end = table_end as u64;
        for section in sections {
            let offset = end.next_multiple_of(ALIGNMENT);
            table.extend(section.kind.to_le_bytes());
            table.extend((section.width as u32).to_le_bytes());
            table.extend(offset.to_le_bytes());
            table.extend(((section.bytes.len() / section.width) as u64).to_le_bytes());
            end = offset + section.bytes.len() as u64;
        }
        let mut sum = crc32fast::Hasher::new();
        let Ok(()) = for_each_chunk(sections, |bytes| {
            sum.update(bytes);
            Ok::<_, std::convert::Infallible>(())
        });
        let mut checked = sum.finalize().to_le_bytes().to_vec();
        checked.extend(end.to_le_bytes());
        checked.extend(self.fields(sections.len()));
        checked.extend(table);

        let mut bytes = MAGIC.to_vec();
        for number in [BYTE_ORDER, VERSION, crc32fast::hash(&checked)] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(checked);
        bytes
    }

    /// The fixed fields from the map's size on.
    fn fields(&self, sections: usize) -> Vec<u8> {
        let (texels, side_bits, cell_bits, grid) = match &self.texels {
            Texels::Tiles(tiles) => (0, 0, 0, tiles.grid()),
            Texels::Blocks(blocks) => {
                let geometry = blocks.geometry();
                (1, geometry.side_bits, geometry.cell_bits, &geometry.grid)
            }
        };
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
        let mut fields = vec![self.map.0, self.map.1, self.model.flake.alpha().to_bits()];
        fields.extend([distribution, normalization, texels, side_bits, cell_bits]);
        fields.extend(grid_fields(grid));
        fields.extend(grid_fields(self.counts.bins()));
        fields.extend([finest as u32, sections as u32]);
        fields.into_iter().flat_map(u32::to_le_bytes).collect()
    }
}

/// An array to be written.
struct Section<'a> {
    kind: u32,
    /// Bytes of an element.
    width: usize,
    bytes: &'a [u8],
}

impl<'a> Section<'a> {
    fn new<T: Pod>(kind: u32, array: &'a Array<T>) -> Self {
        Self {
            kind,
            width: size_of::<T>(),
            bytes: bytemuck::cast_slice(array),
        }
    }
}

/// Calls `visit` with all that follows the table.
fn for_each_chunk<E>(
    sections: &[Section],
    mut visit: impl FnMut(&[u8]) -> std::result::Result<(), E>,
) -> std::result::Result<(), E> {
    let mut end = TABLE + ENTRY * sections.len();
    for section in sections {
        let start = end.next_multiple_of(ALIGNMENT as usize);
        visit(&[0; ALIGNMENT as usize][..start - end])?;
        visit(section.bytes)?;
        end = start + section.bytes.len();
    }
    Ok(())
}

/// A section of the table.
#[derive(Clone, Copy)]
struct Entry {
    kind: u32,
    width: u32,
    offset: u64,
    count: u64,
}

/// The fixed fields and the table, each field in its domain, the sections inside the file.
struct Preamble {
    map: (u32, u32),
    model: FlakeModel,
    layout: Layout,
    bins: Grid,
    finest: usize,
    body_sum: u32,
    table: Vec<Entry>,
}

/// How texels are stored.
enum Layout {
    Tiles(Grid),
    Blocks(Geometry),
}

/// Why a file is refused: what is wrong, and what to do.
type Checked<T> = std::result::Result<T, String>;

impl Preamble {
    /// Reads the beginning of a file of `length` bytes.
    fn parse(start: &[u8], length: u64) -> Checked<Self> {
        if !start.starts_with(&MAGIC) {
            return Err("is not a saved structure; give a file that `glints precompute` made".into());
        }
        let mut fields = Fields(&start[MAGIC.len()..]);
        if fields.u32()? != BYTE_ORDER || cfg!(target_endian = "big") {
            return Err(again("was made for another byte order"));
        }
        let version = fields.u32()?;
        if version != VERSION {
            return Err(again(&format!(
                "has version {version} of the format, this program reads version {VERSION}"
            )));
        }
        let (header_sum, body_sum) = (fields.u32()?, fields.u32()?);
        let expected_length = fields.u64()?;
        if expected_length != length {
            return Err(again(&format!("has {length} bytes instead of {expected_length}")));
        }
        let parsed = Self::parse_fields(&mut fields, body_sum);
        // A damaged number of sections is found as such, or by the checksum.
        let table_end = start.len() - fields.0.len();
        if crc32fast::hash(&start[CHECKED..table_end]) != header_sum {
            return Err(again("is damaged: its header has another checksum"));
        }
        let preamble = parsed?;
        check_places(&preamble.table, table_end as u64, length)?;
        Ok(preamble)
    }

    fn parse_fields(fields: &mut Fields, body_sum: u32) -> Checked<Self> {
        let map = (fields.u32()?, fields.u32()?);
        let alpha = fields.f32()?;
        let (distribution, normalization) = (fields.u32()?, fields.u32()?);
        let (texels, side_bits, cell_bits) = (fields.u32()?, fields.u32()?, fields.u32()?);
        let (grid, bins) = (fields.grid()?, fields.grid()?);
        let (finest, sections) = (fields.u32()?, fields.u32()? as usize);
        if sections > MAX_SECTIONS {
            return Err(again(&format!("is inconsistent: {sections} sections")));
        }
        let table = (0..sections).map(|_| fields.entry()).collect::<Checked<_>>()?;

        let distribution = match distribution {
            0 => Distribution::Beckmann,
            1 => Distribution::Ggx,
            other => return Err(again(&format!("is inconsistent: distribution {other}"))),
        };
        let normalization = match normalization {
            0 => Normalization::Projected,
            1 => Normalization::Paper,
            other => return Err(again(&format!("is inconsistent: normalization {other}"))),
        };
        let flake = Flake::new(distribution, alpha).map_err(|e| again(&format!("is inconsistent: {e}")))?;
        let layout = match texels {
            0 => Layout::Tiles(grid),
            1 => Layout::Blocks(Geometry {
                map,
                side_bits,
                cell_bits,
                grid,
            }),
            other => return Err(again(&format!("is inconsistent: layout {other}"))),
        };
        check::map_size(map).map_err(inconsistent)?;
        match &layout {
            Layout::Tiles(grid) => check::tile_grid(grid),
            Layout::Blocks(geometry) => check::geometry(geometry),
        }
        .map_err(inconsistent)?;
        check::bins(&bins, alpha).map_err(inconsistent)?;
        Ok(Self {
            map,
            model: FlakeModel { flake, normalization },
            layout,
            bins,
            finest: finest as usize,
            body_sum,
            table,
        })
    }

    fn header(&self, length: u64) -> Header {
        let bytes = |counts: bool| {
            self.table
                .iter()
                .filter(|entry| (entry.kind >= COUNTS) == counts)
                .map(|entry| entry.count * u64::from(entry.width))
                .sum()
        };
        Header {
            version: VERSION,
            map: self.map,
            alpha: self.model.flake.alpha(),
            distribution: self.model.flake.kind(),
            normalization: self.model.normalization,
            texel_bytes: bytes(false),
            count_bytes: bytes(true),
            file_bytes: length,
        }
    }

    fn check_sum(&self, file: &[u8]) -> Checked<()> {
        let table_end = TABLE + ENTRY * self.table.len();
        if crc32fast::hash(&file[table_end..]) != self.body_sum {
            return Err(again("is damaged: its content has another checksum"));
        }
        Ok(())
    }

    fn structure(&self, file: &Arc<Mmap>) -> Checked<CompactBinMap> {
        let mut sections = Sections {
            file,
            left: &self.table,
        };
        let (texels, leaf_bits) = match &self.layout {
            Layout::Tiles(grid) => (Texels::Tiles(self.tiles(grid, &mut sections)?), LEAF_BITS),
            Layout::Blocks(geometry) => (
                Texels::Blocks(blocks(geometry, &mut sections)?),
                geometry.side_bits,
            ),
        };
        let tree = Tree::new(self.map, leaf_bits);
        let counts = self.counts(&tree, &mut sections)?;
        if !sections.left.is_empty() {
            return Err(again("is inconsistent: it has more sections than it needs"));
        }
        Ok(CompactBinMap::assemble(
            self.map, self.model, tree, texels, counts,
        ))
    }

    fn tiles(&self, grid: &Grid, sections: &mut Sections) -> Checked<Tiles> {
        let (_, units) = Tiles::layout(grid, self.map);
        let units = sections.take(WORDS, units as u64)?;
        Ok(Tiles::from_units(self.map, *grid, units))
    }

    fn counts(&self, tree: &Tree, sections: &mut Sections) -> Checked<Counts> {
        if self.finest > tree.levels() {
            return Err(again("is inconsistent: counts of a level that does not exist"));
        }
        let stride = u64::from(self.bins.size[0]) * u64::from(self.bins.size[1]);
        let mut levels = Vec::new();
        levels.resize_with(self.finest, || None);
        for index in self.finest..tree.levels() {
            let kind = COUNTS + index as u32;
            // Below 2^32 nodes of less than 2^49 bins could be more than 2^64 counts.
            let count = (tree.nodes(index) as u64)
                .checked_mul(stride)
                .and_then(|count| count.checked_add(counts::PADDING as u64))
                .ok_or_else(|| again("is inconsistent: more counts than memory"))?;
            levels.push(Some(match sections.width() {
                1 => Level::U8(sections.take(kind, count)?),
                2 => Level::U16(sections.take(kind, count)?),
                _ => Level::U32(sections.take(kind, count)?),
            }));
        }
        Ok(Counts::from_levels(self.bins, self.model.flake.alpha(), levels))
    }
}

fn blocks(geometry: &Geometry, sections: &mut Sections) -> Checked<Blocks> {
    let blocks = geometry.block_count() as u64;
    let words = sections.take(WORDS, geometry.units() as u64)?;
    let extents = sections.take(EXTENTS, geometry.cell_rows() as u64)?;
    let cells = check::extents(geometry, &extents).map_err(inconsistent)? as u64;
    let rows = sections.take(ROWS, blocks * (geometry.cell_rows() as u64 + 1))?;
    let offsets = match sections.width() {
        2 => Offsets::Narrow(sections.take(OFFSETS, blocks * cells)?),
        _ => Offsets::Wide(sections.take(OFFSETS, blocks * cells)?),
    };
    let pointers = sections.take(POINTERS, blocks * geometry.pointers() as u64)?;
    let parts = Parts {
        words,
        starts: geometry.starts().into(),
        extents,
        rows,
        offsets,
        pointers,
    };
    let blocks = Blocks::from_parts(*geometry, parts);
    check::blocks(&blocks).map_err(inconsistent)?;
    Ok(blocks)
}

/// Sections of the table stand one after the other and end with the file.
fn check_places(table: &[Entry], table_end: u64, length: u64) -> Checked<()> {
    let mut end = table_end;
    for entry in table {
        let bytes = entry.count.checked_mul(entry.width.into());
        let next = bytes.and_then(|bytes| entry.offset.checked_add(bytes));
        match next {
            Some(next) if entry.offset == end.next_multiple_of(ALIGNMENT) && next <= length => end = next,
            _ => return Err(again("is inconsistent: a section is not where it should be")),
        }
    }
    if end != length {
        return Err(again("is inconsistent: it does not end with its last section"));
    }
    Ok(())
}

/// The sections that have not been taken yet.
struct Sections<'a> {
    file: &'a Arc<Mmap>,
    left: &'a [Entry],
}

impl Sections<'_> {
    /// Bytes of an element of the next section.
    fn width(&self) -> u32 {
        self.left.first().map_or(0, |entry| entry.width)
    }

    /// The next section, which must have this kind and number of elements.
    fn take<T: Pod>(&mut self, kind: u32, count: u64) -> Checked<Array<T>> {
        let wrong = || again(&format!("is inconsistent: section {kind} has another size"));
        let (entry, left) = self.left.split_first().ok_or_else(wrong)?;
        if (entry.kind, entry.width as usize, entry.count) != (kind, size_of::<T>(), count) {
            return Err(wrong());
        }
        self.left = left;
        let start = entry.offset as usize;
        let end = start + size_of::<T>() * count as usize;
        Array::mapped(self.file, start..end).ok_or_else(wrong)
    }
}

/// Bytes that are still to be read.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn bytes<const N: usize>(&mut self) -> Checked<[u8; N]> {
        let (bytes, rest) = self
            .0
            .split_first_chunk()
            .ok_or_else(|| again("is cut off in its header"))?;
        self.0 = rest;
        Ok(*bytes)
    }

    fn u32(&mut self) -> Checked<u32> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Checked<u64> {
        self.bytes().map(u64::from_le_bytes)
    }

    fn f32(&mut self) -> Checked<f32> {
        self.bytes().map(f32::from_le_bytes)
    }

    fn grid(&mut self) -> Checked<Grid> {
        Ok(Grid {
            low: Vec2::new(self.f32()?, self.f32()?),
            pitch: self.f32()?,
            size: [self.u32()?, self.u32()?],
        })
    }

    fn entry(&mut self) -> Checked<Entry> {
        Ok(Entry {
            kind: self.u32()?,
            width: self.u32()?,
            offset: self.u64()?,
            count: self.u64()?,
        })
    }
}

/// A regular file and its length; opening a pipe would wait for its other end.
fn open(path: &Path) -> Checked<(File, u64)> {
    if !std::fs::metadata(path).map_err(unreadable)?.is_file() {
        return Err("is not a regular file; give a file that `glints precompute` made".into());
    }
    let file = File::open(path).map_err(unreadable)?;
    let length = file.metadata().map_err(unreadable)?.len();
    if length == 0 {
        return Err(again("is empty"));
    }
    Ok((file, length))
}

fn unreadable(error: io::Error) -> String {
    format!("cannot be read ({error}); check its name and its permissions")
}

fn again(what: &str) -> String {
    format!("{what}; make it again with `glints precompute`")
}

fn inconsistent(what: String) -> String {
    again(&format!("is inconsistent: {what}"))
}

fn refused(path: &Path, reason: String) -> Error {
    Error::File {
        path: path.into(),
        reason,
    }
}

#[cfg(test)]
mod tests;
