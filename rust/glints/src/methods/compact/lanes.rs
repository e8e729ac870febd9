//! Eight lanes of which some count: masks as bits, and queues of those that do.

use wide::{f32x8, u32x8};

/// The numbers of the lanes.
pub const LANES: f32x8 = f32x8::new([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);

/// For every mask, its lanes in order, a byte each.
static ORDER: [u64; 256] = orders();

const fn orders() -> [u64; 256] {
    let mut table = [0; 256];
    let mut mask = 0;
    while mask < 256 {
        let (mut lane, mut count) = (0, 0);
        while lane < 8 {
            if mask >> lane & 1 == 1 {
                table[mask] |= (lane as u64) << (8 * count);
                count += 1;
            }
            lane += 1;
        }
        mask += 1;
    }
    table
}

/// The lanes of `mask` in order, a byte each.
#[inline(always)]
pub fn order(mask: u32) -> u64 {
    ORDER[mask as usize & 0xff]
}

/// Writes the lanes of `mask`, one behind the other, to `queue` from `at` on; seven places behind them may be overwritten.
///
/// No branch depends on the mask: those that count come without pattern, and a wrong guess costs more than eight lanes.
#[inline(always)]
pub fn compress<const N: usize>(mask: u32, values: f32x8, queue: &mut [f32; N], at: usize) {
    *places(queue, at) = permuted(values, order(mask)).to_array();
}

#[cfg(all(target_arch = "x86_64", target_feature = "avx2"))]
#[inline(always)]
fn permuted(values: f32x8, order: u64) -> f32x8 {
    use std::arch::x86_64::{_mm_cvtsi64_si128, _mm256_cvtepu8_epi32, _mm256_permutevar8x32_epi32};
    // SAFETY: the features are those that this is compiled for; a permutation reads registers only.
    let permuted = unsafe {
        let order = _mm256_cvtepu8_epi32(_mm_cvtsi64_si128(order as i64));
        _mm256_permutevar8x32_epi32(bytemuck::cast(values), order)
    };
    bytemuck::cast(permuted)
}

#[cfg(not(all(target_arch = "x86_64", target_feature = "avx2")))]
#[inline(always)]
fn permuted(values: f32x8, order: u64) -> f32x8 {
    let values = values.to_array();
    f32x8::new(std::array::from_fn(|k| values[(order >> (8 * k)) as usize & 7]))
}

/// Eight places of a queue.
#[inline(always)]
pub fn places<const N: usize>(queue: &mut [f32; N], start: usize) -> &mut [f32; 8] {
    (&mut queue[start..start + 8]).try_into().expect("eight places")
}

/// Eight values of a queue.
#[inline(always)]
pub fn eight<const N: usize>(queue: &[f32; N], start: usize) -> f32x8 {
    let values: [f32; 8] = queue[start..start + 8].try_into().expect("eight values");
    f32x8::new(values)
}

/// The lanes of a bit mask, as a mask of floats.
#[inline(always)]
pub fn mask(lanes: u32) -> f32x8 {
    let bits = u32x8::new([1, 2, 4, 8, 16, 32, 64, 128]);
    bytemuck::cast((u32x8::splat(lanes) & bits).cmp_eq(bits))
}

/// The positions of the set bits.
#[inline]
pub fn bits(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let k = mask.trailing_zeros() as usize;
        mask &= mask.wrapping_sub(1);
        (k < 32).then_some(k)
    })
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

    #[test]
    fn lanes_of_every_mask_come_in_order() {
        for mask in 0..256 {
            let mut queue = [-1.0; 16];
            compress(mask, LANES, &mut queue, 3);
            let expected: Vec<f32> = bits(mask).map(|k| k as f32).collect();
            assert_eq!(queue[3..3 + expected.len()], expected);
        }
    }
}
