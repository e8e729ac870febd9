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

/// Asks for the cache lines of a range of values, which may reach beyond the last one.
#[inline]
pub fn prefetch<T>(values: &[T], range: Range<usize>) {
    const LINE: usize = 64;
    let bytes = range.start * size_of::<T>()..range.end * size_of::<T>();
    for at in bytes.step_by(LINE) {
        let address = values.as_ptr().cast::<u8>().wrapping_add(at);
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a prefetch reads nothing and cannot fault, whatever the address.
        unsafe {
            use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            _mm_prefetch::<_MM_HINT_T0>(address.cast());
        }
        #[cfg(not(target_arch = "x86_64"))]
        let _ = address;
    }
}
