//! Words of 20, 24, 28 or 32 bits, packed so that eight of them unpack in a few vector instructions.
//!
//! **Layout** Eight words make a group of `bits / 4` 32-bit units: four units hold the words' lower halves (unit k
//! those of words k and k + 4), then nibbles (one unit), bytes (two units), or both, or upper halves (four units)
//! follow. A group is never split, and a word never straddles units.

use wide::{f32x8, u32x8};

use crate::array::Array;

/// Words in a group.
pub const GROUP: usize = 8;

/// The widths that [`Packed`] knows, in bits.
pub const WIDTHS: [u32; 4] = [20, 24, 28, 32];

/// An array of groups.
pub struct Packed {
    units: Array<u32>,
    bits: u32,
}

/// 32-bit units of a group of words of `bits`.
pub fn units_per_group(bits: u32) -> usize {
    bits as usize / 4
}

impl Packed {
    /// `units`: whole groups, of words of one of [`WIDTHS`].
    pub fn new(units: Array<u32>, bits: u32) -> Self {
        debug_assert!(WIDTHS.contains(&bits) && units.len() % units_per_group(bits) == 0);
        Self { units, bits }
    }

    pub fn units(&self) -> &Array<u32> {
        &self.units
    }

    /// The eight words of a group.
    #[inline(always)]
    pub fn group(&self, index: usize) -> u32x8 {
        let units: &[u32] = &self.units;
        match self.bits {
            20 => {
                let units = chunk::<5>(units, index);
                lower_halves(units) | nibbles(units[4]) << 16
            }
            24 => {
                let units = chunk::<6>(units, index);
                lower_halves(units) | bytes([units[4], units[5]]) << 16
            }
            28 => {
                let units = chunk::<7>(units, index);
                lower_halves(units) | nibbles(units[4]) << 16 | bytes([units[5], units[6]]) << 20
            }
            _ => {
                let units = chunk::<8>(units, index);
                lower_halves(units) | lower_halves(&units[4..]) << 16
            }
        }
    }

    /// Asks for the cache lines of a range of groups, which will soon be read. A branch that depends on a word waits for
    /// memory; nothing waits here.
    #[inline]
    pub fn prefetch(&self, groups: std::ops::Range<usize>) {
        let units = units_per_group(self.bits);
        prefetch(&self.units, groups.start * units..groups.end * units);
    }

    /// One word.
    #[inline]
    pub fn word(&self, index: usize) -> u32 {
        let (group, k) = (index / GROUP, index % GROUP);
        let units = &self.units[group * units_per_group(self.bits)..];
        let low = units[k % 4] >> (16 * (k / 4)) & 0xffff;
        let nibble = |unit: u32| (unit >> (4 * k) & 0xf) << 16;
        let byte = |at: usize| (units[at + k % 2] >> (8 * (k / 2)) & 0xff) << (self.bits - 8);
        low | match self.bits {
            20 => nibble(units[4]),
            24 => byte(4),
            28 => nibble(units[4]) | byte(5),
            _ => (units[4 + k % 4] >> (16 * (k / 4))) << 16,
        }
    }
}

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

/// Packs eight words into a group of zeroed units.
pub fn pack(words: &[u32; GROUP], bits: u32, units: &mut [u32]) {
    for (k, &word) in words.iter().enumerate() {
        units[k % 4] |= (word & 0xffff) << (16 * (k / 4));
        let nibble = (word >> 16 & 0xf) << (4 * k);
        let byte = (word >> (bits - 8) & 0xff) << (8 * (k / 2));
        match bits {
            20 => units[4] |= nibble,
            24 => units[4 + k % 2] |= byte,
            28 => {
                units[4] |= nibble;
                units[5 + k % 2] |= byte;
            }
            _ => units[4 + k % 4] |= (word >> 16) << (16 * (k / 4)),
        }
    }
}

#[inline(always)]
fn chunk<const N: usize>(units: &[u32], index: usize) -> &[u32; N] {
    units[N * index..][..N].try_into().expect("N units")
}

#[inline(always)]
fn lower_halves(units: &[u32]) -> u32x8 {
    let [a, b, c, d] = [units[0], units[1], units[2], units[3]];
    u32x8::new([a, b, c, d, a, b, c, d]) >> u32x8::new([0, 0, 0, 0, 16, 16, 16, 16]) & u32x8::splat(0xffff)
}

#[inline(always)]
fn nibbles(unit: u32) -> u32x8 {
    u32x8::splat(unit) >> u32x8::new([0, 4, 8, 12, 16, 20, 24, 28]) & u32x8::splat(0xf)
}

#[inline(always)]
fn bytes([a, b]: [u32; 2]) -> u32x8 {
    u32x8::new([a, b, a, b, a, b, a, b]) >> u32x8::new([0, 0, 8, 8, 16, 16, 24, 24]) & u32x8::splat(0xff)
}

/// Eight narrower numbers. Spelled out: as a loop, it goes through memory.
#[inline(always)]
pub fn widened<T: Copy + Into<u32>>(&[a, b, c, d, e, f, g, h]: &[T; 8]) -> u32x8 {
    u32x8::new([
        a.into(),
        b.into(),
        c.into(),
        d.into(),
        e.into(),
        f.into(),
        g.into(),
        h.into(),
    ])
}

/// Whole numbers below 2^31 as floating-point ones.
#[inline(always)]
pub fn to_float(words: u32x8) -> f32x8 {
    f32x8::from_i32x8(bytemuck::cast(words))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn words_come_back(words in proptest::array::uniform16(any::<u32>()), width in 0..4_usize) {
            let bits = WIDTHS[width];
            let words = words.map(|w| (u64::from(w) & ((1 << bits) - 1)) as u32);
            let mut units = vec![0; 2 * units_per_group(bits)];
            for (half, units) in words.chunks_exact(GROUP).zip(units.chunks_exact_mut(units_per_group(bits))) {
                pack(half.try_into().unwrap(), bits, units);
            }
            let packed = Packed::new(units.into(), bits);
            for (index, &word) in words.iter().enumerate() {
                prop_assert_eq!(packed.word(index), word);
                prop_assert_eq!(packed.group(index / GROUP).to_array()[index % GROUP], word);
            }
        }
    }
}
