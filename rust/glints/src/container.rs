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
//! Reading maps the file into memory and reads all of it once, for its checksums. What fields and elements mean is the caller's
//! to check.

use std::fs::File;
use std::io::{self, Read, Write};
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

/// Fields and sections of a file.
pub struct Contents {
    pub fields: Vec<u32>,
    /// Bytes of the file.
    pub length: u64,
    file: Arc<Mmap>,
    table: Vec<Entry>,
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
        file.write_all(&self.preamble(fields, sections))?;
        let mut end = FIELDS + 4 * fields.len() + ENTRY * sections.len();
        for section in sections {
            end = write_section(end, section, |bytes| file.write_all(bytes))?;
        }
        file.as_file().sync_all()?;
        file.persist(path).map_err(|e| e.error)?;
        Ok(())
    }

    fn preamble(&self, fields: &[u32], sections: &[Section]) -> Vec<u8> {
        let table_end = FIELDS + 4 * fields.len() + ENTRY * sections.len();
        let mut sum = crc32fast::Hasher::new();
        let mut table = Vec::new();
        let mut end = table_end;
        for (number, section) in sections.iter().enumerate() {
            let offset = end.next_multiple_of(ALIGNMENT);
            table.extend((number as u32).to_le_bytes());
            table.extend((section.width as u32).to_le_bytes());
            table.extend((offset as u64).to_le_bytes());
            table.extend(((section.bytes.len() / section.width) as u64).to_le_bytes());
            let Ok(next) = write_section(end, section, |bytes| {
                sum.update(bytes);
                Ok::<_, std::convert::Infallible>(())
            });
            end = next;
        }
        let mut checked = sum.finalize().to_le_bytes().to_vec();
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

    /// Maps a file into memory. It may be replaced or removed later, but must not be written to or shortened in place.
    ///
    /// # Errors
    /// The file cannot be read, is of another kind or version, is damaged, or its sections are not where they should be.
    pub fn read(&self, path: &Path) -> Checked<Contents> {
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
        // SAFETY: all values of the mapped types are valid, so that only a change of the bytes while they are borrowed
        // could do harm. `write` never writes to a file that has its final name; others are told not to.
        let file = Arc::new(unsafe { Mmap::map(&file) }.map_err(unreadable)?);
        self.parse(file, length)
    }

    fn parse(&self, file: Arc<Mmap>, length: u64) -> Checked<Contents> {
        if !file.starts_with(&self.magic) {
            return Err(format!(
                "is of another kind; give a file that `{}` made",
                self.made_by
            ));
        }
        let cut_off = || self.again("is cut off in its header");
        let u32_at = |at: usize| -> Checked<u32> {
            let bytes = file.get(at..at + 4).ok_or_else(cut_off)?;
            Ok(u32::from_le_bytes(bytes.try_into().unwrap_or_default()))
        };
        let u64_at =
            |at: usize| -> Checked<u64> { Ok(u64::from(u32_at(at)?) | u64::from(u32_at(at + 4)?) << 32) };
        if u32_at(8)? != BYTE_ORDER || cfg!(target_endian = "big") {
            return Err(self.again("was made for another byte order"));
        }
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
            return Err(self.again("is inconsistent: too many fields or sections"));
        }
        let table = FIELDS + 4 * fields as usize;
        let table_end = table + ENTRY * sections as usize;
        let (head, body) = file.split_at_checked(table_end).ok_or_else(cut_off)?;
        if crc32fast::hash(&head[CHECKED..]) != u32_at(16)? {
            return Err(self.again("is damaged: its header has another checksum"));
        }
        if crc32fast::hash(body) != u32_at(20)? {
            return Err(self.again("is damaged: its content has another checksum"));
        }
        let fields = (0..fields as usize)
            .map(|i| u32_at(FIELDS + 4 * i))
            .collect::<Checked<_>>()?;
        let mut entries = Vec::new();
        let mut end = table_end as u64;
        for number in 0..sections {
            let at = table + ENTRY * number as usize;
            let entry = Entry {
                width: u32_at(at + 4)?.into(),
                offset: u64_at(at + 8)?,
                count: u64_at(at + 16)?,
            };
            let next = entry
                .count
                .checked_mul(entry.width)
                .and_then(|bytes| entry.offset.checked_add(bytes));
            match next {
                Some(next)
                    if u32_at(at)? == number
                        && entry.offset == end.next_multiple_of(ALIGNMENT as u64)
                        && next <= length =>
                {
                    end = next;
                }
                _ => return Err(self.inconsistent("a section is not where it should be")),
            }
            entries.push(entry);
        }
        if end != length {
            return Err(self.inconsistent("it does not end with its last section"));
        }
        Ok(Contents {
            fields,
            length,
            file,
            table: entries,
            taken: 0,
        })
    }

    /// `what` is wrong with a file, and what to do.
    pub fn again(&self, what: &str) -> String {
        format!("{what}; make it again with `{}`", self.made_by)
    }

    pub fn inconsistent(&self, what: &str) -> String {
        self.again(&format!("is inconsistent: {what}"))
    }
}

impl Contents {
    /// The next section, whose elements must be of type `T`; `None` if they are not.
    pub fn take<T: Pod>(&mut self) -> Option<Array<T>> {
        let entry = self.table.get(self.taken)?;
        self.taken += 1;
        if entry.width as usize != size_of::<T>() {
            return None;
        }
        let start = entry.offset as usize;
        Array::mapped(&self.file, start..start + (entry.width * entry.count) as usize)
    }
}

/// Pads from `end` to where the section begins, and writes it; its end.
fn write_section<E>(
    end: usize,
    section: &Section,
    mut write: impl FnMut(&[u8]) -> std::result::Result<(), E>,
) -> std::result::Result<usize, E> {
    let start = end.next_multiple_of(ALIGNMENT);
    write(&[0; ALIGNMENT][..start - end])?;
    write(section.bytes)?;
    Ok(start + section.bytes.len())
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
