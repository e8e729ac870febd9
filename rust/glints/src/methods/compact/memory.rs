//! What is asked of memory before it is needed.

/// Asks for the cache lines of a range of values.
#[inline]
pub fn prefetch<T>(values: &[T], range: std::ops::Range<usize>) {
    const LINE: usize = 64;
    for at in range.step_by((LINE / size_of::<T>()).max(1)) {
        let Some(value) = values.get(at) else { return };
        #[cfg(target_arch = "x86_64")]
        // SAFETY: a prefetch reads nothing and cannot fault; the address is that of a value.
        unsafe {
            use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
            _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast());
        }
        #[cfg(not(target_arch = "x86_64"))]
        let _ = value;
    }
}
