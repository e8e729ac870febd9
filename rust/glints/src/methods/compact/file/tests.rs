use super::super::tests::{model, random_map};
use super::super::{block_geometry, counts as bin_counts, grid};
use super::*;
use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;
use crate::methods::Method;
use crate::normal_map::NormalMap;
use glam::Vec3;
use proptest::prelude::*;
use std::path::PathBuf;

/// Answers at footprints of all sizes, from a point to several periods, as bits.
fn answers(structure: &CompactBinMap) -> Vec<u32> {
    let (width, height) = structure.map_size();
    let mut answers = Vec::new();
    for i in 0..40 {
        let t = 0.37 * i as f32;
        let size = 2.2 * (i as f32 / 40.0).powi(4);
        let edges = [[size, 0.3 * size * t.sin()], [-0.2 * size, size * t.cos()]];
        let footprint = Footprint::new(width, height, [t.fract(), (1.7 * t).fract()], edges[0], edges[1]);
        let u = [0.13, 0.29, 0.41, 0.59].map(|step: f32| (t + i as f32 * step).fract());
        if let Some(h) = structure.sample(&footprint, u) {
            answers.extend(h.to_array().map(f32::to_bits));
            answers.push(structure.ndf(&footprint, h).to_bits());
        }
        let direction =
            |tilt: f32, turn: f32| Vec3::new(tilt * turn.cos(), tilt * turn.sin(), 1.0).normalize();
        let pair = DirectionPair::new(direction(0.5, t), direction(0.4, t + 2.8));
        if let Some(pair) = pair {
            let reflection = structure.evaluate(&footprint, &pair);
            answers.extend([reflection.value.to_bits(), reflection.density.to_bits()]);
        }
    }
    answers
}

/// A saved structure, and where.
fn saved(structure: &CompactBinMap) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.glints");
    structure.save(&path).unwrap();
    (folder, path)
}

fn assert_comes_back(structure: &CompactBinMap) {
    let (folder, path) = saved(structure);
    let loaded = CompactBinMap::load(&path).unwrap();
    assert_eq!(answers(structure), answers(&loaded));
    assert_eq!(structure.bytes(), loaded.bytes());
    let header = read_header(&path).unwrap();
    assert_eq!(header.map, structure.map_size());
    assert_eq!(header.file_bytes, std::fs::metadata(&path).unwrap().len());
    // A loaded structure is saved as the same file, and no other file is left.
    let bytes = std::fs::read(&path).unwrap();
    loaded.save(&path).unwrap();
    assert!(bytes == std::fs::read(&path).unwrap());
    assert_eq!(answers(structure), answers(&loaded));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

fn refusal(path: &Path) -> String {
    let Err(error) = CompactBinMap::load(path) else {
        panic!("{} was loaded", path.display())
    };
    let message = error.to_string();
    assert!(message.contains(&path.display().to_string()), "{message}");
    message
}

/// Texels in blocks, whatever the map.
fn in_blocks(map: &NormalMap, alpha: f32) -> CompactBinMap {
    let size = (map.width(), map.height());
    let geometry = block_geometry(size, alpha, 1e-4, grid::bounds(map, Vec3::truncate));
    let blocks = Blocks::new(map, geometry);
    let tree = Tree::new(size, geometry.side_bits);
    let bins = bin_counts::bins(alpha, grid::bounds(map, bin_counts::project));
    let counts = Counts::new(&tree, bins, alpha, tree.levels(), |_, _| Vec3::Z);
    CompactBinMap::assemble(size, model(alpha), tree, Texels::Blocks(blocks), counts)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn what_is_saved_comes_back(
        width in 1..400_u32,
        height in 1..400_u32,
        slope in 0.0..2.0_f32,
        alpha in prop::sample::select(vec![0.0003_f32, 0.004, 0.02, 0.05, 0.3]),
        seed: u32,
    ) {
        assert_comes_back(&CompactBinMap::new(&random_map(width, height, slope, seed), model(alpha)));
    }
}

#[test]
fn wide_offsets_come_back() {
    let steep = Vec3::new(0.4, -0.9, 1.0);
    let normals: Vec<Vec3> = (0..512 * 300)
        .map(|i| if i == 511 { steep } else { Vec3::new(0.3, 0.2, 1.0) })
        .collect();
    let map = NormalMap::from_normals("flat", 512, 300, &normals).unwrap();
    let structure = in_blocks(&map, 0.004);
    assert!(
        matches!(&structure.texels, Texels::Blocks(blocks) if matches!(blocks.offsets, Offsets::Wide(_)))
    );
    assert_comes_back(&structure);
}

#[test]
fn flat_maps_with_few_steep_texels_come_back_at_the_least_roughness() {
    // Their texels are kept in the map's order, on the finest grid over the whole disk.
    let normals: Vec<Vec3> = (0..64 * 64)
        .map(|i| match i {
            77 => Vec3::new(5.0, -4.0, 1.0),
            99 => Vec3::new(-5.0, 4.0, 1.0),
            _ => Vec3::Z,
        })
        .collect();
    let map = NormalMap::from_normals("nearly flat", 64, 64, &normals).unwrap();
    let structure = CompactBinMap::new(&map, model(1e-4));
    for (column, row) in [(0, 0), (77 % 64, 1), (99 % 64, 1)] {
        let distance = (structure.normal(column, row) - map.normal(column, row)).truncate();
        assert!(
            distance.abs().max_element() < 0.51 * structure.texels.grid().pitch,
            "{distance}"
        );
    }
    assert_comes_back(&structure);
}

#[test]
fn damage_is_found() {
    for alpha in [0.004, 0.2] {
        let structure = CompactBinMap::new(&random_map(150, 70, 0.5, 1), model(alpha));
        let (_folder, path) = saved(&structure);
        let bytes = std::fs::read(&path).unwrap();
        let step = bytes.len() / 400;
        for at in (0..200).chain((200..bytes.len()).step_by(step)) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1 << (at % 8);
            std::fs::write(&path, damaged).unwrap();
            refusal(&path);
        }
        for length in (0..200).chain((200..bytes.len()).step_by(step)) {
            std::fs::write(&path, &bytes[..length]).unwrap();
            refusal(&path);
        }
    }
}

#[test]
fn refusals_say_why() {
    let structure = CompactBinMap::new(&random_map(20, 30, 0.5, 1), model(0.1));
    let (folder, path) = saved(&structure);
    let bytes = std::fs::read(&path).unwrap();
    let refusal_of = |content: &[u8]| {
        std::fs::write(&path, content).unwrap();
        refusal(&path)
    };
    let mut newer = bytes.clone();
    newer[12] += 1;
    let mut damaged = bytes.clone();
    *damaged.last_mut().unwrap() ^= 1;
    for (message, word) in [
        (refusal_of(&newer), format!("version {VERSION}").as_str()),
        (refusal_of(&damaged), "checksum"),
        (refusal_of(&bytes[..bytes.len() - 1]), "bytes instead of"),
        (refusal_of(&bytes[..60]), "bytes instead of"),
        (refusal_of(b""), "empty"),
        (
            refusal_of(b"\x89PNG\r\n\x1a\n and so on"),
            "not a saved structure",
        ),
        (refusal(folder.path()), "not a regular file"),
    ] {
        assert!(message.contains(word), "{word:?} is not in {message}");
        assert!(message.contains("glints precompute"), "{message}");
    }
    assert!(refusal(&folder.path().join("missing")).contains("cannot be read"));
    assert!(structure.save(&folder.path().join("no/folder")).is_err());
    assert!(!is_saved(folder.path()) && !is_saved(&folder.path().join("missing")));
}
