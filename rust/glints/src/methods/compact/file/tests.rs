use super::super::tests::{model, random_map, tailed_map};
use super::super::tiles::Upper;
use super::*;
use crate::footprint::Footprint;
use crate::half_vector::DirectionPair;
use crate::methods::Method;
use crate::normal_map::NormalMap;
use bytemuck::Zeroable;
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

/// Some map that the structure could be made from.
fn origin(structure: &CompactBinMap) -> Origin {
    Origin {
        size: structure.map_size(),
        refinement: None,
        slopes: SlopeCovariance {
            xx: 0.1 / 3.0,
            xy: -1e-9,
            yy: 0.7,
        },
        checksum: 0xfedc_ba98,
    }
}

/// A saved structure, and where.
fn saved(structure: &CompactBinMap) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.glints");
    structure.save(&origin(structure), &path).unwrap();
    (folder, path)
}

fn assert_comes_back(structure: &CompactBinMap) {
    let (folder, path) = saved(structure);
    let (loaded, header) = CompactBinMap::load(&path).unwrap();
    assert_eq!(answers(structure), answers(&loaded));
    assert_eq!(structure.bytes(), loaded.bytes());
    assert_eq!(header, read_header(&path).unwrap());
    assert_eq!(header.map, structure.map_size());
    assert_eq!(header.origin, origin(structure));
    assert_eq!(header.file_bytes, std::fs::metadata(&path).unwrap().len());
    let (texels, counts) = structure.bytes();
    assert!(header.texel_bytes <= texels as u64 && header.count_bytes == counts as u64);
    // A loaded structure is saved as the same file, and no other file is left.
    let bytes = std::fs::read(&path).unwrap();
    loaded.save(&header.origin, &path).unwrap();
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
fn flat_maps_with_few_steep_texels_come_back_at_the_least_roughness() {
    // On the finest grid over the whole disk.
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
    let of_version = |version: u32| {
        let mut other = bytes.clone();
        other[12..16].copy_from_slice(&version.to_le_bytes());
        other
    };
    // As version 3 begins, which had the map's size behind the length.
    let mut old = of_version(3)[..24].to_vec();
    old.extend([112_u64.to_le_bytes(), (30_u64 << 32 | 20).to_le_bytes()].concat());
    old.resize(112, 0);
    let mut damaged = bytes.clone();
    *damaged.last_mut().unwrap() ^= 1;
    for (message, word) in [
        (
            refusal_of(&of_version(VERSION + 1)),
            "version 7 of the format, this program reads version 6",
        ),
        (
            refusal_of(&old),
            "version 3 of the format, this program reads version 6",
        ),
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
    // A header is read without the rest.
    assert!(refusal_of(&damaged).contains("checksum") && read_header(&path).is_ok());
    assert!(refusal(&folder.path().join("missing")).contains("cannot be read"));
    let origin = origin(&structure);
    assert!(structure.save(&origin, &folder.path().join("no/folder")).is_err());
    let turned = Origin {
        size: (30, 20),
        ..origin
    };
    let refused = structure.save(&turned, &path).unwrap_err().to_string();
    assert!(
        refused.contains("30 x 20") && refused.contains("20 x 30"),
        "{refused}"
    );
    assert!(!is_saved(folder.path()) && !is_saved(&folder.path().join("missing")));
}

#[test]
fn what_it_was_made_from_comes_back() {
    let map = random_map(24, 17, 0.8, 5);
    let model = model(0.05);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.glints");
    for asked in [None, Some(1), Some(3), Some(8)] {
        let refinement = asked.map(|r| Refinement::new(&map, Some(model.flake), r).unwrap());
        let refined = map.refined(asked.unwrap_or(1)).unwrap();
        let origin = Origin::new(&map, refinement);
        CompactBinMap::new(&refined, model).save(&origin, &path).unwrap();
        let found = read_header(&path).unwrap().origin;
        assert_eq!((found.size, found.checksum), ((24, 17), map.checksum()));
        assert_eq!(found.slopes, map.slope_covariance());
        let words = |r: Refinement| (r.refinement, r.step as f32);
        assert_eq!(found.refinement.map(words), refinement.map(words));
        assert_eq!(found.refinement.map(|r| r.refinement), asked);
        let text = read_header(&path).unwrap().to_string();
        for word in [
            "24 x 17 texels",
            &format!("{:08x}", map.checksum()),
            "slope covariance",
        ] {
            assert!(text.contains(word), "{word:?} is not in {text}");
        }
        assert_eq!(text.contains("interpolated"), asked.is_some());
    }
}

/// The file of a structure with other fields; its checksums are right.
fn with_fields(fields: &[u32], structure: &CompactBinMap, path: &Path) -> String {
    KIND.write(path, fields, &structure.sections()).unwrap();
    let message = refusal(path);
    let header = read_header(path).unwrap_err().to_string();
    assert_eq!(message, header);
    message
}

#[test]
fn hostile_fields_are_refused() {
    let structure = CompactBinMap::new(&random_map(20, 30, 0.5, 1), model(0.1));
    let (_folder, path) = saved(&structure);
    let fields = structure.fields(&origin(&structure));
    let high = |value: f64| (value.to_bits() >> 32) as u32;
    let nan = f32::NAN.to_bits();
    let all_of = |field: usize, word: &'static str, values: &[u32]| {
        for &value in values {
            let mut fields = fields.clone();
            fields[field] = value;
            let message = with_fields(&fields, &structure, &path);
            assert!(
                message.contains("is inconsistent") && message.contains(word),
                "{field}: {message}"
            );
            assert!(message.contains("glints precompute ibm"), "{message}");
        }
    };
    all_of(16, "interpolation", &[2, u32::MAX, nan]);
    // Without interpolation there is one texel for each, and no step.
    all_of(17, "interpolation", &[0, 2, 9, u32::MAX]);
    all_of(
        18,
        "interpolation",
        &[nan, 1.5_f32.to_bits(), f32::INFINITY.to_bits()],
    );
    let variances = [-1.0, f64::NAN, f64::INFINITY, 2e6].map(high);
    all_of(20, "slope covariance", &variances);
    all_of(24, "slope covariance", &variances);
    // More than the variances allow.
    all_of(
        22,
        "slope covariance",
        &[0.2, -0.2, f64::NAN, f64::INFINITY].map(high),
    );
    all_of(15, "level", &[1000]);

    let mut interpolated = fields.clone();
    interpolated[16] = 1;
    interpolated[18] = 1.5_f32.to_bits();
    for (refinement, step) in [
        (0, 1.5_f32),
        // Not a divisor of 20 and of 30 texels.
        (3, 1.5),
        (4, 1.5),
        (10, 1.5),
        (2, f32::NAN),
        (2, f32::INFINITY),
        (2, -1e-6),
    ] {
        (interpolated[17], interpolated[18]) = (refinement, step.to_bits());
        let message = with_fields(&interpolated, &structure, &path);
        assert!(
            message.contains("interpolation"),
            "{refinement} {step}: {message}"
        );
    }
    // The twin: of these nothing is hostile.
    for refinement in [1, 2, 5] {
        (interpolated[17], interpolated[18]) = (refinement, 1.5_f32.to_bits());
        KIND.write(&path, &interpolated, &structure.sections()).unwrap();
        let (_, header) = CompactBinMap::load(&path).unwrap();
        assert_eq!(header.origin.size, (20 / refinement, 30 / refinement));
    }

    for fields in [&fields[..fields.len() - 1], &[&fields[..], &[0]].concat(), &[]] {
        let message = with_fields(fields, &structure, &path);
        assert!(message.contains("fields"), "{message}");
    }
}

#[test]
fn sections_are_those_that_fields_ask_for() {
    let structure = CompactBinMap::new(&random_map(150, 70, 0.5, 1), model(0.004));
    let (_folder, path) = saved(&structure);
    let fields = structure.fields(&origin(&structure));
    let without = |index: usize| {
        let mut sections = structure.sections();
        sections.remove(index);
        sections
    };
    let mut more = structure.sections();
    more.push(Section::new(&[0_u8; 3]));
    let mut other = structure.sections();
    other[1] = Section::new(&[0_u64; 3]);
    let mut longer = structure.sections();
    let tiles = [Upper::zeroed(); 3];
    longer[0] = Section::new(&tiles);
    for (sections, word) in [
        (without(0), "sections instead of"),
        (without(3), "sections instead of"),
        (more, "sections instead of"),
        (other, "section 1"),
        (longer, "section 0 has 3 elements"),
    ] {
        KIND.write(&path, &fields, &sections).unwrap();
        let message = refusal(&path);
        assert!(
            message.contains("is inconsistent") && message.contains(word),
            "{message}"
        );
    }
}

#[test]
fn strays_come_back_and_hostile_ones_are_refused() {
    let structure = CompactBinMap::new(&tailed_map(256), model(0.02));
    assert!(!structure.strays.is_empty());
    assert_comes_back(&structure);
    let (_folder, path) = saved(&structure);
    let fields = structure.fields(&origin(&structure));
    let [side, columns, rows] = structure.strays.squares;
    let refused = |fields: &[u32], offsets: &[u32], strays: &[[u32; 3]], word: &str| {
        let mut sections = structure.sections();
        let first = sections.len() - 2;
        sections.truncate(first);
        sections.extend([Section::new(offsets), Section::new(strays)]);
        KIND.write(&path, fields, &sections).unwrap();
        let message = refusal(&path);
        assert!(
            message.contains("is inconsistent") && message.contains(word),
            "{message}"
        );
    };
    let Strays { offsets, strays, .. } = &structure.strays;
    for squares in [
        [0, columns, rows],
        [side, columns + 1, rows],
        [side, 0, rows],
        [side, 1 << 31, 1 << 31],
    ] {
        let changed = [&fields[..26], &squares].concat();
        refused(&changed, offsets, strays, "squares of strays");
    }
    let mut unsorted = offsets.to_vec();
    unsorted[1] = u32::MAX;
    refused(&fields, &unsorted, strays, "follow each other");
    refused(&fields, offsets, &strays[1..], "follow each other");
    let mut outside = strays.to_vec();
    outside[0][2] = 256 * 256;
    refused(&fields, offsets, &outside, "outside the map");
}
