//! The bins: a square grid over the projected hemisphere (Section 5.2), and neighbourhoods of 21 of them.

use glam::Vec3;

use crate::error::{Error, Result};

/// Most bins per side; the vectorless arithmetic of [`Neighbourhood::for_each_match`] needs two spare bits.
const MAX_RESOLUTION: u32 = 16_384;

/// Places of a neighbourhood: 5 x 5, the corners staying empty.
pub const SLOTS: usize = 25;

/// Bins per side for a flake of roughness `alpha`: `floor(5 / sin theta_0)` with `tan theta_0 = 3 alpha /
/// sqrt 2`, so that five bins span the lobe's diameter of three standard deviations either way (Eq. 16; see
/// the parent module for the floor).
pub fn derived_resolution(alpha: f32) -> u32 {
    let tan = 3.0 * f64::from(alpha) / std::f64::consts::SQRT_2;
    let sin = tan / (1.0 + tan * tan).sqrt();
    ((5.0 / sin).floor() as u32).clamp(1, MAX_RESOLUTION)
}

/// `b x b` bins over `[-1, 1]^2`, which bounds the projected hemisphere.
#[derive(Clone, Copy, Debug)]
pub struct BinGrid {
    resolution: u32,
}

/// Column and row of a bin.
pub type Bin = (u32, u32);

/// A bin in one word: `row << 16 | column`.
pub fn pack((column, row): Bin) -> u32 {
    row << 16 | column
}

/// Inverse of [`pack`].
pub fn unpack(packed: u32) -> Bin {
    (packed & 0xffff, packed >> 16)
}

impl BinGrid {
    pub fn new(resolution: u32) -> Result<Self> {
        if !(1..=MAX_RESOLUTION).contains(&resolution) {
            return Err(Error::parameter(
                "bins",
                resolution,
                format!("must be 1 to {MAX_RESOLUTION} bins per side"),
            ));
        }
        Ok(Self { resolution })
    }

    /// Bins per side.
    pub fn resolution(&self) -> u32 {
        self.resolution
    }

    /// Side of a bin on the projected hemisphere.
    pub fn width(&self) -> f64 {
        2.0 / f64::from(self.resolution)
    }

    /// The binning function beta.
    #[inline]
    pub fn bin(&self, m: Vec3) -> Bin {
        let index = |x: f32| {
            // Conversion saturates, so that x = -1 - rounding stays in the first bin.
            let i = (self.resolution as f32 * (0.5 * x + 0.5)) as u32;
            i.min(self.resolution - 1)
        };
        (index(m.x), index(m.y))
    }

    pub(super) fn packed_bin(&self, m: Vec3) -> u32 {
        pack(self.bin(m))
    }

    /// The normal `b_j` that stands for a bin: its centre, or, for a bin whose centre lies outside the disk
    /// or within an eighth of a bin of its rim, the point halfway between its corner nearest to the pole and
    /// the rim.
    #[inline]
    pub fn representative(&self, (column, row): Bin) -> Vec3 {
        let width = 2.0 / self.resolution as f32;
        let x = (column as f32 + 0.5) * width - 1.0;
        let y = (row as f32 + 0.5) * width - 1.0;
        let z2 = 1.0 - x * x - y * y;
        if z2 > 0.25 * width {
            return Vec3::new(x, y, z2.sqrt());
        }
        Self::rim_representative(x, y, width)
    }

    #[cold]
    fn rim_representative(x: f32, y: f32, width: f32) -> Vec3 {
        let inner = |c: f32| (c.abs() - 0.5 * width).max(0.0).copysign(c);
        let (x, y) = (inner(x), inner(y));
        let radius = (x * x + y * y).sqrt().min(1.0 - 1e-6);
        let halfway = 0.5 * (radius + 1.0);
        let scale = halfway / radius.max(1e-6);
        Vec3::new(x * scale, y * scale, (1.0 - halfway * halfway).sqrt())
    }

    /// The 21 bins around the bin of `h`.
    #[inline]
    pub fn neighbourhood(&self, h: Vec3) -> Neighbourhood {
        let (column, row) = self.bin(h);
        Neighbourhood {
            first: (column as i32 - 2, row as i32 - 2),
            resolution: self.resolution as i32,
        }
    }
}

/// Offsets of the 21 bins from the central one.
pub fn offsets() -> impl Iterator<Item = (i32, i32)> {
    (-2..=2_i32)
        .flat_map(|dy| (-2..=2_i32).map(move |dx| (dx, dy)))
        .filter(|&(dx, dy)| dx.abs() + dy.abs() < 4)
}

/// A square of 5 x 5 bins without its corners, numbered row by row; it may reach over the grid's sides.
#[derive(Clone, Copy, Debug)]
pub struct Neighbourhood {
    first: (i32, i32),
    resolution: i32,
}

impl Neighbourhood {
    /// Slots that belong to the neighbourhood: all but the four corners.
    const MEMBERS: u32 = 0x1ff_ffff & !(1 | 1 << 4 | 1 << 20 | 1 << 24);

    /// The bins on the grid, with their slots, in increasing order.
    #[inline]
    pub fn bins(&self) -> impl Iterator<Item = (usize, Bin)> + use<> {
        let Self { first, resolution } = *self;
        (0..SLOTS)
            .filter(|slot| Self::MEMBERS >> slot & 1 == 1)
            .map(move |slot| (slot, first.0 + slot as i32 % 5, first.1 + slot as i32 / 5))
            .filter(move |(_, x, y)| (0..resolution).contains(x) && (0..resolution).contains(y))
            .map(|(slot, x, y)| (slot, (x as u32, y as u32)))
    }

    /// The slot of a packed bin, if it is one of the 21.
    #[inline]
    pub fn slot(&self, packed: u32) -> Option<usize> {
        let (x, y) = unpack(packed);
        let (dx, dy) = (x as i32 - self.first.0, y as i32 - self.first.1);
        if !(0..5).contains(&dx) || !(0..5).contains(&dy) {
            return None;
        }
        let slot = (5 * dy + dx) as usize;
        (Self::MEMBERS >> slot & 1 == 1).then_some(slot)
    }

    /// Calls `visit(slot, offset)` for every packed bin of `row` that is one of the 21.
    ///
    /// Both coordinates of a bin are compared at once in one word: with the top bit of each half set,
    /// subtracting the first bin never borrows, and the difference of a match has nothing but its three
    /// lowest bits in each half. Whole blocks without a match, nearly all of them, cost a few vector
    /// instructions.
    #[inline]
    pub fn for_each_match(&self, row: &[u32], mut visit: impl FnMut(usize, usize)) {
        const TOP: u32 = 0x8000_8000;
        const FAR: u32 = 0xfff8_fff8;
        const BLOCK: usize = 8;
        let first = ((self.first.1 << 16) + self.first.0) as u32;
        let is_near = |bin: u32| ((bin | TOP).wrapping_sub(first) ^ TOP) & FAR == 0;
        for (index, block) in row.chunks(BLOCK).enumerate() {
            let any = match <&[u32; BLOCK]>::try_from(block) {
                Ok(block) => block.iter().fold(false, |any, &bin| any | is_near(bin)),
                Err(_) => true,
            };
            if !any {
                continue;
            }
            for (offset, &bin) in block.iter().enumerate().filter(|&(_, &bin)| is_near(bin)) {
                if let Some(slot) = self.slot(bin) {
                    visit(slot, index * BLOCK + offset);
                }
            }
        }
    }
}
