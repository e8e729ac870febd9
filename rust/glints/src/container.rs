//! Files of a few numbers and some large arrays, which are used in place.
//!
//! **Format** Numbers are little-endian.
//!
//! | offset | type | |
//! |---|---|---|
//! | 0 | 8 bytes | what kind of file it is |
//! | 8 | u32 | byte-order mark, `0x0a0b0c0d` |
//! | 12 | u32 | version, of the kind |
//! | 16 | u32 | CRC-32 of the bytes from 20 to the end of the table |
//! | 20 | u32 | CRC-32 of what follows the table |
//! | 24 | u64 | bytes of the file |
//! | 32 | 2 u32 | number of fields and of sections |
//! | 40 | u32 each | fields |
//!
//! Then the table, 24 bytes for each section: number (u32), bytes of an element (u32), offset (u64) and number of elements
//! (u64). Sections stand in order, each at the next multiple of 64 bytes; the file ends with the last.
//!
//! Reading maps the file into memory and reads all of it once, for its checksums; the head alone, all that stands before the
//! first section, is read without the rest. What fields and elements mean is the caller's to check.
//!
//! Writing goes once through the sections: their checksum is known at the end, and the head is written then.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use bytemuck::Pod;
use memmap2::Mmap;

use crate::array::Array;

const BYTE_ORDER: u32 = 0x0a0b_0c0d;
const CHECKED: usize = 20;
const FIELDS: usize = 40;
const ENTRY: usize = 24;
const ALIGNMENT: usize = 64;

/// Most fields, and sections, of any kind of file.
const MOST: u32 = 64;

/// The longest head.
const LONGEST_HEAD: usize = head_bytes(MOST as usize, MOST as usize);

/// Bytes that are summed and written at a time, so that they come from memory once.
const CHUNK: usize = 1 << 18;

/// Bytes before the sections: of the fixed numbers, the fields and the table.
const fn head_bytes(fields: usize, sections: usize) -> usize {
    FIELDS + 4 * fields + ENTRY * sections
}

/// A kind of file.
pub struct Kind {
    pub magic: [u8; 8],
    pub version: u32,
    /// How people make such a file, for messages.
    pub made_by: &'static str,
}

/// Why a file is refused: what is wrong, and what to do.
pub type Checked<T> = std::result::Result<T, String>;

/// An array to be written.
pub struct Section<'a> {
    width: usize,
    bytes: &'a [u8],
}

impl<'a> Section<'a> {
    pub fn new<T: Pod>(array: &'a [T]) -> Self {
        Self {
            width: size_of::<T>(),
            bytes: bytemuck::cast_slice(array),
        }
    }
}

/// What stands before the sections.
pub struct Head {
    pub fields: Vec<u32>,
    /// Bytes of the file.
    pub length: u64,
    table: Vec<Entry>,
    /// Where the table ends.
    end: usize,
    body_sum: u32,
}

/// Head and sections of a file.
pub struct Contents {
    pub head: Head,
    file: Arc<Mmap>,
    taken: usize,
}

#[derive(Clone, Copy)]
struct Entry {
    width: u64,
    offset: u64,
    count: u64,
}

impl Kind {
    /// Whether a file begins as this kind does; whatever cannot be read does not.
    pub fn is_of(&self, path: &Path) -> bool {
        let mut magic = [0; 8];
        path.is_file()
            && File::open(path).is_ok_and(|mut file| file.read_exact(&mut magic).is_ok())
            && magic == self.magic
    }

    /// Writes a temporary file in the same folder, which then takes the name `path`; who has a file of that name mapped
    /// keeps what was in it.
    ///
    /// # Errors
    /// The file cannot be written; nothing is left of it.
    pub fn write(&self, path: &Path, fields: &[u32], sections: &[Section]) -> io::Result<()> {
        let mut file = temporary_beside(path)?;
        let mut end = head_bytes(fields.len(), sections.len());
        file.seek(SeekFrom::Start(end as u64))?;
        let mut sum = crc32fast::Hasher::new();
        for section in sections {
            let padding = &[0; ALIGNMENT][..end.next_multiple_of(ALIGNMENT) - end];
            for chunk in [padding].into_iter().chain(section.bytes.chunks(CHUNK)) {
                sum.update(chunk);
                file.write_all(chunk)?;
            }
            end += padding.len() + section.bytes.len();
        }
        file.rewind()?;
        file.write_all(&self.head(fields, sections, sum.finalize()))?;
        file.as_file().sync_all()?;
        file.persist(path).map_err(|e| e.error)?;
        Ok(())
    }

    fn head(&self, fields: &[u32], sections: &[Section], body_sum: u32) -> Vec<u8> {
        let mut table = Vec::new();
        let mut end = head_bytes(fields.len(), sections.len());
        for (number, section) in sections.iter().enumerate() {
            let offset = end.next_multiple_of(ALIGNMENT);
            table.extend((number as u32).to_le_bytes());
            table.extend((section.width as u32).to_le_bytes());
            table.extend((offset as u64).to_le_bytes());
            table.extend(((section.bytes.len() / section.width) as u64).to_le_bytes());
            end = offset + section.bytes.len();
        }
        let mut checked = body_sum.to_le_bytes().to_vec();
        checked.extend((end as u64).to_le_bytes());
        checked.extend((fields.len() as u32).to_le_bytes());
        checked.extend((sections.len() as u32).to_le_bytes());
        checked.extend(fields.iter().flat_map(|field| field.to_le_bytes()));
        checked.extend(table);
        let mut bytes = self.magic.to_vec();
        for number in [BYTE_ORDER, self.version, crc32fast::hash(&checked)] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(checked);
        bytes
    }

    /// Reads what stands before the sections; the rest is not looked at.
    ///
    /// # Errors
    /// The file cannot be read, is of another kind or version, has another length, its head is damaged, or its sections are
    /// not where they should be.
    pub fn read_head(&self, path: &Path) -> Checked<Head> {
        let (file, length) = self.open(path)?;
        let mut start = Vec::new();
        file.take(LONGEST_HEAD as u64)
            .read_to_end(&mut start)
            .map_err(unreadable)?;
        self.parse(&start, length)
    }

    /// Maps a file into memory. It may be replaced or removed later, but must not be written to or shortened in place.
    ///
    /// # Errors
    /// As [`Self::read_head`]; a section is damaged.
    pub fn read(&self, path: &Path) -> Checked<Contents> {
        let (file, length) = self.open(path)?;
        // SAFETY: all values of the mapped types are valid, so that only a change of the bytes while they are borrowed
        // could do harm. `write` never writes to a file that has its final name; others are told not to.
        let file = Arc::new(unsafe { Mmap::map(&file) }.map_err(unreadable)?);
        let head = self.parse(&file, length)?;
        if crc32fast::hash(&file[head.end..]) != head.body_sum {
            return Err(self.again("is damaged: its content has another checksum"));
        }
        Ok(Contents { head, file, taken: 0 })
    }

    /// A regular file and its length; opening a pipe would wait for its other end.
    fn open(&self, path: &Path) -> Checked<(File, u64)> {
        if !std::fs::metadata(path).map_err(unreadable)?.is_file() {
            return Err(format!(
                "is not a regular file; give a file that `{}` made",
                self.made_by
            ));
        }
        let file = File::open(path).map_err(unreadable)?;
        let length = file.metadata().map_err(unreadable)?.len();
        if length == 0 {
            return Err(self.again("is empty"));
        }
        Ok((file, length))
    }

    /// Reads the head of a file of `length` bytes, of which `start` are the first.
    fn parse(&self, start: &[u8], length: u64) -> Checked<Head> {
        if !start.starts_with(&self.magic) {
            return Err(format!(
                "is not a saved structure of this kind; give a file that `{}` made",
                self.made_by
            ));
        }
        let cut_off = || self.again("is cut off in its header");
        let u32_at = |at: usize| -> Checked<u32> {
            let bytes = start.get(at..at + 4).ok_or_else(cut_off)?;
            Ok(u32::from_le_bytes(bytes.try_into().unwrap_or_default()))
        };
        let u64_at =
            |at: usize| -> Checked<u64> { Ok(u64::from(u32_at(at)?) | u64::from(u32_at(at + 4)?) << 32) };
        if u32_at(8)? != BYTE_ORDER || cfg!(target_endian = "big") {
            return Err(self.again("was made for another byte order"));
        }
        // The first thing that differs between versions: a file of an older one is no damaged one.
        let version = u32_at(12)?;
        if version != self.version {
            return Err(self.again(&format!(
                "has version {version} of the format, this program reads version {}",
                self.version
            )));
        }
        let expected = u64_at(24)?;
        if expected != length {
            return Err(self.again(&format!("has {length} bytes instead of {expected}")));
        }
        let (fields, sections) = (u32_at(32)?, u32_at(36)?);
        if fields > MOST || sections > MOST {
            return Err(self.inconsistent("too many fields or sections"));
        }
        let end = head_bytes(fields as usize, sections as usize);
        let checked = start.get(CHECKED..end).ok_or_else(cut_off)?;
        if crc32fast::hash(checked) != u32_at(16)? {
            return Err(self.again("is damaged: its header has another checksum"));
        }
        let table = (0..sections)
            .map(|number| {
                let at = end - ENTRY * (sections - number) as usize;
                let entry = Entry {
                    width: u32_at(at + 4)?.into(),
                    offset: u64_at(at + 8)?,
                    count: u64_at(at + 16)?,
                };
                Ok((u32_at(at)?, entry))
            })
            .collect::<Checked<Vec<_>>>()?;
        self.check_places(&table, end as u64, length)?;
        Ok(Head {
            fields: (0..fields as usize)
                .map(|i| u32_at(FIELDS + 4 * i))
                .collect::<Checked<_>>()?,
            length,
            table: table.into_iter().map(|(_, entry)| entry).collect(),
            end,
            body_sum: u32_at(20)?,
        })
    }

    /// Numbered sections stand one after the other, and end with the file.
    fn check_places(&self, table: &[(u32, Entry)], head: u64, length: u64) -> Checked<()> {
        let mut end = head;
        for (expected, (number, entry)) in (0..).zip(table) {
            let bytes = entry.count.checked_mul(entry.width);
            let next = bytes.and_then(|bytes| entry.offset.checked_add(bytes));
            let starts = entry.offset == end.next_multiple_of(ALIGNMENT as u64);
            match next {
                Some(next) if *number == expected && starts && next <= length => end = next,
                _ => return Err(self.inconsistent("a section is not where it should be")),
            }
        }
        match end == length {
            true => Ok(()),
            false => Err(self.inconsistent("it does not end with its last section")),
        }
    }

    /// `what` is wrong with a file, and what to do.
    pub fn again(&self, what: &str) -> String {
        format!("{what}; make it again with `{}`", self.made_by)
    }

    pub fn inconsistent(&self, what: &str) -> String {
        self.again(&format!("is inconsistent: {what}"))
    }
}

impl Head {
    /// Number of sections.
    pub fn sections(&self) -> usize {
        self.table.len()
    }

    /// Bytes of some of the sections, which exist, without what lies between them.
    pub fn section_bytes(&self, sections: Range<usize>) -> u64 {
        self.table[sections]
            .iter()
            .map(|entry| entry.count * entry.width)
            .sum()
    }
}

impl Contents {
    /// Bytes of an element of the next section; `None` after the last one.
    pub fn next_width(&self) -> Option<u64> {
        Some(self.head.table.get(self.taken)?.width)
    }

    /// The next section, however many elements it has.
    ///
    /// # Errors
    /// What is wrong, for [`Kind::inconsistent`]: there is none, or its elements are not of the size of `T`.
    pub fn take<T: Pod>(&mut self) -> Checked<Array<T>> {
        let number = self.taken;
        self.taken += 1;
        let wrong = || format!("section {number} is missing, or has other elements");
        let entry = self.head.table.get(number).ok_or_else(wrong)?;
        if entry.width as usize != size_of::<T>() {
            return Err(wrong());
        }
        let start = entry.offset as usize;
        Array::mapped(&self.file, start..start + (entry.width * entry.count) as usize).ok_or_else(wrong)
    }

    /// The next section, which must have `count` elements.
    ///
    /// # Errors
    /// As [`Self::take`]; it has another number of elements.
    pub fn take_exactly<T: Pod>(&mut self, count: u64) -> Checked<Array<T>> {
        let number = self.taken;
        let section = self.take()?;
        match section.len() as u64 == count {
            true => Ok(section),
            false => Err(format!(
                "section {number} has {} elements instead of {count}",
                section.len()
            )),
        }
    }
}

fn unreadable(error: io::Error) -> String {
    format!("cannot be read ({error}); check its name and its permissions")
}

/// An empty temporary file in the folder of `path`, to be written and then given that name.
///
/// # Errors
/// The file cannot be made, or the machine's byte order is not that of saved structures.
pub(crate) fn temporary_beside(path: &Path) -> io::Result<tempfile::NamedTempFile> {
    if cfg!(target_endian = "big") {
        return Err(io::Error::other("only little-endian machines save structures"));
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".glints-");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}
