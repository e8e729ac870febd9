//! What mutations of saved files know about their format; see the module `container` of the library.

/// Where the fixed numbers are.
pub const HEADER_SUM: usize = 16;
pub const BODY_SUM: usize = 20;
pub const LENGTH: usize = 24;
/// Numbers of fields and of sections.
pub const COUNTS: usize = 32;
pub const FIELDS: usize = 40;

/// Bytes of a section in the table.
pub const ENTRY: usize = 24;

/// SplitMix64, Steele et al. 2014.
pub struct Random(pub u64);

impl Random {
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Below `count`; zero if that is zero.
    pub fn below(&mut self, count: usize) -> usize {
        (self.bits() % count.max(1) as u64) as usize
    }

    /// In `[0, 1)`.
    pub fn real(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1 << 24) as f32
    }
}

/// The number at a place of the file; zero behind its end.
pub fn u32_at(bytes: &[u8], at: usize) -> u32 {
    bytes
        .get(at..at + 4)
        .map_or(0, |b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))
}

/// Where the table of sections begins and ends, inside the file if that is as long as the fixed numbers.
pub fn table(bytes: &[u8]) -> [usize; 2] {
    let [fields, sections] = [COUNTS, COUNTS + 4].map(|at| u32_at(bytes, at) as usize);
    let inside = |at: usize| at.clamp(FIELDS, bytes.len().max(FIELDS));
    [
        inside(FIELDS + 4 * fields),
        inside(FIELDS + 4 * fields + ENTRY * sections),
    ]
}

/// Makes both checksums right, where a file is long enough to have them, so that the checks behind them are what is tested.
pub fn seal(bytes: &mut [u8]) {
    if bytes.len() < FIELDS {
        return;
    }
    let [_, end] = table(bytes);
    let body = crc32fast::hash(&bytes[end..]).to_le_bytes();
    bytes[BODY_SUM..BODY_SUM + 4].copy_from_slice(&body);
    let head = crc32fast::hash(&bytes[BODY_SUM..end]).to_le_bytes();
    bytes[HEADER_SUM..HEADER_SUM + 4].copy_from_slice(&head);
}
