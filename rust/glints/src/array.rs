//! Arrays that are either owned or part of a memory-mapped file.

use std::ops::{Deref, Range};
use std::sync::Arc;

use bytemuck::Pod;
use memmap2::Mmap;

/// An immutable array of plain values.
pub enum Array<T> {
    Owned(Vec<T>),
    /// Bytes of a file; their alignment and length were checked by [`Array::mapped`].
    Mapped(Arc<Mmap>, Range<usize>),
}

impl<T: Pod> Array<T> {
    /// The values at `range` of a mapped file; `None` unless it lies inside the file, is aligned and holds whole
    /// values.
    pub fn mapped(file: &Arc<Mmap>, range: Range<usize>) -> Option<Self> {
        bytemuck::try_cast_slice::<u8, T>(file.get(range.clone())?).ok()?;
        Some(Self::Mapped(Arc::clone(file), range))
    }

    pub fn bytes(&self) -> usize {
        size_of_val::<[T]>(self)
    }
}

impl<T: Pod> Deref for Array<T> {
    type Target = [T];

    #[inline]
    fn deref(&self) -> &[T] {
        match self {
            Self::Owned(values) => values,
            Self::Mapped(file, range) => bytemuck::cast_slice(&file[range.clone()]),
        }
    }
}

impl<T> From<Vec<T>> for Array<T> {
    fn from(values: Vec<T>) -> Self {
        Self::Owned(values)
    }
}

impl<T> Default for Array<T> {
    fn default() -> Self {
        Self::Owned(Vec::new())
    }
}
