//! Mutations of saved structures: each must be refused, or loaded and then answer every query.
//!
//! Deterministic: execution `n` of a run depends on its seed and on `n` alone. Checksums are set right after a mutation, so
//! that the checks behind them are what is tested. A panic is a failure; an abort or a signal ends the process and leaves
//! the file that led to it.

mod container;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

use container::{COUNTS, ENTRY, LENGTH, Random, seal, table, u32_at};
use glam::Vec3;
use glints::brdf::{Brdf, Masking};
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint::Footprint;
use glints::half_vector::DirectionPair;
use glints::methods::Method;
use glints::methods::compact::{CompactBinMap, Origin, read_header};
use glints::microfacet::{Distribution, Flake};
use glints::normal_map::NormalMap;
use glints::refinement::Refinement;

/// What a run did.
#[derive(Debug, Default)]
pub struct Outcome {
    pub executions: u64,
    /// Mutations that were loaded and queried.
    pub loaded: u64,
    /// The executions that panicked, or answered with something that is not a number.
    pub failures: Vec<u64>,
}

/// Mutates for `time`, in the folder `folder`, where files that led to failures stay.
pub fn run(seed: u64, time: Duration, folder: &Path) -> Outcome {
    let valid = valid_files(folder);
    let path = folder.join("mutated.glints");
    let start = Instant::now();
    let mut outcome = Outcome::default();
    while start.elapsed() < time {
        let execution = outcome.executions;
        let mut random = Random(seed ^ execution.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mut bytes = random.pick(&valid).clone();
        random.mutate(&mut bytes);
        std::fs::write(&path, &bytes).expect("the folder is writable");
        match catch_unwind(AssertUnwindSafe(|| attempt(&path, &mut random))) {
            Ok(Attempt::Refused) => (),
            Ok(Attempt::Answered) => outcome.loaded += 1,
            Ok(Attempt::NotANumber) | Err(_) => {
                let kept = folder.join(format!("failure-{execution}.glints"));
                std::fs::write(kept, &bytes).expect("the folder is writable");
                outcome.failures.push(execution);
            }
        }
        outcome.executions += 1;
    }
    outcome
}

enum Attempt {
    Refused,
    Answered,
    NotANumber,
}

/// Loads a file and queries it.
fn attempt(path: &Path, random: &mut Random) -> Attempt {
    if let Ok(header) = read_header(path) {
        assert!(!header.to_string().is_empty());
    }
    let (structure, header) = match CompactBinMap::load(path) {
        Ok(loaded) => loaded,
        Err(error) => {
            assert!(error.to_string().contains("mutated.glints"));
            return Attempt::Refused;
        }
    };
    let (width, height) = structure.map_size();
    let mut is_number = true;
    for _ in 0..24 {
        let mut near = || {
            let (x, y) = (random.real(), random.real());
            Vec3::new(2.0 * x - 1.0, 2.0 * y - 1.0, 0.3 + random.real()).normalize()
        };
        let (wi, wo) = (near(), near());
        // From points to several periods of the map.
        let size = 3.0 * random.real().powi(6);
        let mut edge = || [size * (random.real() - 0.5), size * (random.real() - 0.5)];
        let edges = [edge(), edge()];
        let uv = [random.real(), random.real()];
        let footprint = match random.below(6) {
            0 => Footprint::new(width, height, uv, [0.0; 2], [0.0; 2]),
            _ => Footprint::new(width, height, uv, edges[0], edges[1]),
        };
        let u = [(); 4].map(|()| random.real());
        // Half vectors where texels are, too.
        let h = structure.sample(&footprint, u).unwrap_or(wi);
        let mut answers = vec![structure.ndf(&footprint, h), structure.density(&footprint, wo)];
        let pairs = [DirectionPair::new(wi, wo), DirectionPair::reflected(wi, h)];
        for pair in pairs.into_iter().flatten() {
            let reflection = structure.evaluate(&footprint, &pair);
            answers.extend([reflection.value, reflection.density]);
        }
        is_number &= answers.iter().all(|answer| answer.is_finite()) && h.is_finite();
        let texel = (random.below(width as usize), random.below(height as usize));
        is_number &= structure.normal(texel.0 as u32, texel.1 as u32).is_finite();
    }
    // With shadowing by the slopes in the file.
    let slopes = || header.origin.slopes;
    let masked = Brdf::with_slopes(slopes, Masking::Beckmann, || Ok(Box::new(structure)));
    let masked = masked.expect("nothing is refused");
    for _ in 0..8 {
        let mut near =
            || Vec3::new(random.real() - 0.5, random.real() - 0.5, 0.02 + random.real()).normalize();
        let (wi, wo) = (near(), near());
        let edges = [0.1, 0.01].map(|size| [size * random.real(), size * random.real()]);
        let footprint = masked.footprint([random.real(), random.real()], edges[0], edges[1]);
        let answer = masked.evaluate(&footprint, wi, wo);
        is_number &= answer.value.is_finite() && answer.pdf.is_finite();
    }
    if is_number {
        Attempt::Answered
    } else {
        Attempt::NotANumber
    }
}

/// Saved structures of several shapes: texels of several widths, with and without counts, with incomplete tiles, of
/// interpolated maps, with texels that are in no bin.
fn valid_files(folder: &Path) -> Vec<Vec<u8>> {
    /// Most slopes are small, and a few are large.
    const LONG_TAILS: f32 = 0.0;
    // Columns and rows, roughness, slopes, and texels for each if the map is interpolated.
    let shapes = [
        (1, 1, 0.02, 0.3, None),
        (37, 23, 0.2, 0.5, Some(2)),
        (64, 64, 0.05, 1.5, None),
        (150, 70, 0.004, 0.5, None),
        (128, 128, 0.003, 0.1, None),
        (300, 40, 0.01, 1.0, Some(1)),
        (200, 300, 0.02, 0.8, None),
        (90, 260, 0.0003, 0.7, None),
        (256, 256, 0.02, LONG_TAILS, None),
    ];
    let path = folder.join("valid.glints");
    shapes
        .into_iter()
        .enumerate()
        .map(|(index, (width, height, alpha, slope, refinement))| {
            let mut random = Random(index as u64);
            let mut component = || match (slope, 2.0 * random.real() - 1.0) {
                (LONG_TAILS, real) => 0.01 * real.abs().max(1e-4).powf(-0.4) * real.signum(),
                (slope, real) => slope * real,
            };
            let normals: Vec<Vec3> = (0..width * height)
                .map(|_| Vec3::new(component(), component(), 1.0))
                .collect();
            let map = NormalMap::from_normals("random", width, height, &normals).expect("a normal map");
            let distribution = [Distribution::Beckmann, Distribution::Ggx][index % 2];
            let model = FlakeModel {
                flake: Flake::new(distribution, alpha).expect("a roughness"),
                normalization: [Normalization::Projected, Normalization::Paper][index / 2 % 2],
            };
            let refined = map.refined(refinement.unwrap_or(1)).expect("a map");
            let refinement =
                refinement.map(|r| Refinement::new(&map, Some(model.flake), r).expect("a refinement"));
            CompactBinMap::new(&refined, model)
                .save(&Origin::new(&map, refinement), &path)
                .expect("the folder is writable");
            std::fs::read(&path).expect("a saved file")
        })
        .collect()
}

impl Random {
    fn pick<'a, T>(&mut self, items: &'a [T]) -> &'a T {
        &items[self.below(items.len())]
    }

    /// One to four mutations, then right checksums, but for one file in sixteen.
    fn mutate(&mut self, bytes: &mut Vec<u8>) {
        for _ in 0..1 + self.below(4) {
            match self.below(10) {
                0 | 1 => self.set_field(bytes),
                2 => self.set_table(bytes),
                3 => self.resize(bytes),
                4 => self.copy_run(bytes),
                _ => self.set_body(bytes),
            }
            if bytes.is_empty() {
                return;
            }
        }
        if self.below(16) > 0 {
            seal(bytes);
        }
    }

    /// Numbers at which checks fail first.
    fn number(&mut self, old: u32) -> u32 {
        match self.below(8) {
            0 => 0,
            1 => u32::MAX,
            2 => old.wrapping_add(1),
            3 => old.wrapping_sub(1),
            4 => 1 << self.below(32),
            5 => self
                .pick(&[f32::NAN, f32::INFINITY, -1.0, 1e-30, 1e30, 1e-7])
                .to_bits(),
            6 => old ^ (1 << self.below(32)),
            _ => self.bits() as u32,
        }
    }

    fn set_word(&mut self, bytes: &mut [u8], at: usize) {
        if let Some(place) = bytes.get_mut(at..at + 4) {
            let old = u32::from_le_bytes([place[0], place[1], place[2], place[3]]);
            place.copy_from_slice(&self.number(old).to_le_bytes());
        }
    }

    /// Sets a field of the header.
    fn set_field(&mut self, bytes: &mut [u8]) {
        let [fields_end, _] = table(bytes);
        let at = match self.below(8) {
            0 => self.below(fields_end),
            _ => COUNTS + 4 * self.below((fields_end - COUNTS) / 4),
        };
        self.set_word(bytes, at);
    }

    /// Sets a field of the table of sections, or swaps two sections.
    fn set_table(&mut self, bytes: &mut [u8]) {
        let (a, b) = (self.entry(bytes), self.entry(bytes));
        if a != b && self.below(4) == 0 && bytes.len() >= a.max(b) + ENTRY {
            for k in 0..ENTRY {
                bytes.swap(a + k, b + k);
            }
        } else {
            let at = a + 4 * self.below(ENTRY / 4);
            self.set_word(bytes, at);
        }
    }

    /// Where an entry of the table of sections is.
    fn entry(&mut self, bytes: &[u8]) -> usize {
        let [start, end] = table(bytes);
        start + ENTRY * self.below((end - start) / ENTRY)
    }

    /// Cuts bytes off the end, or adds some.
    fn resize(&mut self, bytes: &mut Vec<u8>) {
        let length = match self.below(4) {
            0 => self.below(bytes.len() + 1),
            1 => bytes.len() + self.below(200),
            _ => bytes.len().saturating_sub(1 + self.below(200)),
        };
        bytes.resize(length, self.bits() as u8);
        // Mostly, the field for the length follows.
        if let Some(place) = bytes.get_mut(LENGTH..LENGTH + 8).filter(|_| self.below(8) > 0) {
            place.copy_from_slice(&(length as u64).to_le_bytes());
        }
    }

    /// Copies up to a kilobyte to another place.
    fn copy_run(&mut self, bytes: &mut [u8]) {
        let length = 1 + self.below(bytes.len().min(1024));
        let last = bytes.len() - length + 1;
        let (from, to) = (self.below(last), self.below(last));
        bytes.copy_within(from..from + length, to);
    }

    /// Sets a bit, a byte or a number anywhere in one of the sections, small or large alike.
    fn set_body(&mut self, bytes: &mut [u8]) {
        let entry = self.entry(bytes);
        let read = |at| u32_at(bytes, at) as usize;
        let (width, offset, count) = (read(entry + 4), read(entry + 8), read(entry + 16));
        let place = offset.wrapping_add(self.below(width.wrapping_mul(count).max(1)));
        let at = if place < bytes.len() {
            place
        } else {
            self.below(bytes.len())
        };
        match self.below(4) {
            0 => bytes[at] ^= 1 << self.below(8),
            1 => bytes[at] = *self.pick(&[0, 1, 0x7f, 0x80, 0xff]),
            2 => self.set_word(bytes, at / 4 * 4),
            _ => {
                let end = (at + 1 + self.below(64)).min(bytes.len());
                let byte = *self.pick(&[0, 0xff]);
                bytes[at..end].fill(byte);
            }
        }
    }
}
