//! No file, whatever is in it, makes loading or a query of tensor-decomposed distributions panic.

#[path = "fuzz/container.rs"]
mod container;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use container::{COUNTS, LENGTH, Random, seal, table, u32_at};
use glam::{DVec2, Vec2, Vec3};
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint::Footprint;
use glints::half_vector::DirectionPair;
use glints::methods::Method;
use glints::methods::tensor::{Options, Tensor, read_header};
use glints::microfacet::{Distribution, Flake};
use glints::normal_map::NormalMap;

fn mutate(bytes: &mut Vec<u8>, random: &mut Random) {
    for _ in 0..1 + random.below(3) {
        let [_, end] = table(bytes);
        match random.below(6) {
            // A number of the header or the table.
            0 | 1 => {
                let at = COUNTS + 4 * random.below((end - COUNTS) / 4);
                let value = match random.below(4) {
                    0 => random.bits() as u32,
                    1 => random.below(300) as u32,
                    2 => u32::MAX - random.below(3) as u32,
                    _ => u32_at(bytes, at)
                        .wrapping_add(random.below(5) as u32)
                        .wrapping_sub(2),
                };
                if at + 4 <= bytes.len() {
                    bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
                }
            }
            // Bytes of the arrays, mostly of the first ones.
            2..=4 => {
                let span = bytes.len().saturating_sub(end);
                let reach = if random.below(2) == 0 {
                    span
                } else {
                    span.min(4096)
                };
                let at = end + random.below(reach);
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = random.bits() as u8;
                }
            }
            _ => {
                let length = random.below(bytes.len() + 1);
                bytes.truncate(length);
            }
        }
    }
    let length = (bytes.len() as u64).to_le_bytes();
    if let Some(place) = bytes.get_mut(LENGTH..LENGTH + 8) {
        place.copy_from_slice(&length);
    }
    seal(bytes);
}

/// `None`: refused; else whether all answers are numbers.
fn attempt(path: &Path, random: &mut Random) -> Option<bool> {
    if let Ok(header) = read_header(path) {
        assert!(!header.to_string().is_empty());
    }
    let tensor = match Tensor::load(path) {
        Ok((tensor, _)) => tensor,
        Err(error) => {
            assert!(error.to_string().contains("mutated.glints"), "{error}");
            return None;
        }
    };
    let (width, height) = tensor.map_size();
    let mut answers = Vec::new();
    for _ in 0..24 {
        let edge = |random: &mut Random| [random.real() * 3.0 - 1.5, random.real() * 3.0 - 1.5];
        let footprint = Footprint::new(width, height, edge(random), edge(random), edge(random));
        let u = [(); 4].map(|()| random.real());
        let wi = Vec3::new(random.real() - 0.5, random.real() - 0.5, 0.3 + random.real()).normalize();
        let h = tensor.sample(&footprint, u).unwrap_or(wi);
        answers.extend([tensor.ndf(&footprint, h), tensor.density(&footprint, wi)]);
        let low = Vec2::new(random.real() - 0.8, random.real() - 0.8);
        answers.extend(tensor.ndf_over(&footprint, low, low + random.real()));
        if let Some(pair) = DirectionPair::reflected(wi, h) {
            let reflection = tensor.evaluate(&footprint, &pair);
            answers.extend([reflection.value, reflection.density]);
        }
    }
    Some(answers.iter().all(|answer| answer.is_finite()))
}

#[test]
fn mutated_files_are_refused_or_answer() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mutated.glints");
    let mut random = Random(5);
    let normals: Vec<Vec3> = (0..20 * 12)
        .map(|_| Vec3::new(random.real() - 0.5, random.real() - 0.5, 1.0))
        .collect();
    let map = NormalMap::from_normals("random", 20, 12, &normals).unwrap();
    let model = FlakeModel {
        flake: Flake::new(Distribution::Ggx, 0.02).unwrap(),
        normalization: Normalization::Projected,
    };
    let options = Options {
        resolution: 32,
        stride: 4,
        rank: 5,
        agreement: 0.0,
        ..Options::default()
    };
    let (tensor, _) = Tensor::new(&map, model, &options, &|_| ()).unwrap();
    tensor.save(&map, &path).unwrap();
    let valid = std::fs::read(&path).unwrap();
    assert_eq!(attempt(&path, &mut random), Some(true));

    let (mut refused, mut answered) = (0, 0);
    for execution in 0..3000 {
        let mut random = Random(execution);
        let mut bytes = valid.clone();
        mutate(&mut bytes, &mut random);
        std::fs::write(&path, &bytes).unwrap();
        let outcome = catch_unwind(AssertUnwindSafe(|| attempt(&path, &mut random)));
        match outcome {
            Ok(None) => refused += 1,
            Ok(Some(true)) => answered += 1,
            other => panic!("execution {execution}: {other:?}"),
        }
    }
    // Both what refuses and what queries rely on has been met.
    assert!(refused > 300 && answered > 300, "{refused} {answered}");
    let far = Footprint::in_texels(20, 12, DVec2::ZERO, DVec2::X, DVec2::Y);
    assert!(tensor.ndf(&far, Vec3::Z).is_finite());
}
