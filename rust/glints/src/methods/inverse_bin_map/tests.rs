use super::*;
use crate::flakes::Normalization;
use crate::methods::direct::Direct;
use crate::microfacet::{Distribution, Flake};
use glam::DVec2;
use proptest::prelude::*;

/// A reproducible map of random normals with slopes up to `steepness`.
pub(super) fn random_map(width: u32, height: u32, steepness: f32, seed: u64) -> NormalMap {
    let mut state = seed;
    let mut uniform = || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    let normals: Vec<Vec3> = (0..width * height)
        .map(|_| {
            let slope = |u: f32| steepness * (2.0 * u - 1.0);
            Vec3::new(slope(uniform()), slope(uniform()), 1.0)
        })
        .collect();
    NormalMap::from_normals("random", width, height, &normals).unwrap()
}

fn model(alpha: f32) -> FlakeModel {
    FlakeModel {
        flake: Flake::new(Distribution::default(), alpha).unwrap(),
        normalization: Normalization::Projected,
    }
}

fn build(map: &NormalMap, alpha: f32, bins: u32, leaf_size: u32) -> InverseBinMap {
    let options = Options {
        bins: Some(bins),
        leaf_size: Some(leaf_size),
    };
    InverseBinMap::new(map, model(alpha), options).unwrap()
}

/// Bin weights from the direct sum's exact texel weights.
fn direct_weights(map: &NormalMap, ibm: &InverseBinMap, footprint: &Footprint, h: Vec3) -> [f64; SLOTS] {
    let neighbourhood = ibm.grid.neighbourhood(h);
    let mut weights = [0.0; SLOTS];
    Direct::new(map.clone(), ibm.model).for_each_texel(footprint, |t, weight| {
        if let Some(slot) = neighbourhood.slot(ibm.grid.packed_bin(t)) {
            weights[slot] += f64::from(weight);
        }
    });
    weights
}

/// Bin weights from the forest, however small the footprint.
fn forest_weights(ibm: &InverseBinMap, footprint: &Footprint, h: Vec3) -> [f64; SLOTS] {
    let neighbourhood = ibm.grid.neighbourhood(h);
    let mut areas = [0.0; SLOTS];
    footprint.for_each_part(|part| match part {
        Part::Cut(region) => ibm.inverse.add_areas(&region, &neighbourhood, &mut areas),
        Part::Whole(count) => {
            for (slot, bin) in neighbourhood.bins() {
                areas[slot] += count as f64 * f64::from(ibm.inverse.count(bin));
            }
        }
        Part::Texel { .. } => {}
    });
    areas.map(|area| area / footprint.area())
}

fn vector(range: f64) -> impl Strategy<Value = DVec2> {
    (-range..range, -range..range).prop_map(|(x, y)| DVec2::new(x, y))
}

#[test]
fn derived_resolution_reproduces_table_4() {
    let resolutions = [0.0025, 0.01, 0.04, 0.16].map(bins::derived_resolution);
    assert_eq!(resolutions, [942, 235, 59, 15]);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn bin_weights_are_the_sums_of_texel_weights(
        width in 1..40u32, height in 1..40u32, seed: u64, bins in 1..24u32, leaf_size in 1..12u32,
        c in vector(90.0), a in vector(60.0), b in vector(60.0), scale in 0.001..2.0, h in vector(0.7),
    ) {
        let map = random_map(width, height, 1.5, seed);
        let ibm = build(&map, 0.05, bins, leaf_size);
        let footprint = Footprint::in_texels(width, height, c, a * scale, b * scale);
        let h = Vec3::new(h.x as f32, h.y as f32, (1.0 - h.length_squared()).max(0.01).sqrt() as f32).normalize();
        let expected = direct_weights(&map, &ibm, &footprint, h);
        let (_, scanned) = ibm.bin_weights(&footprint, h);
        let walked = forest_weights(&ibm, &footprint, h);
        for slot in 0..SLOTS {
            prop_assert!((f64::from(scanned[slot]) - expected[slot]).abs() < 1e-5);
            prop_assert!((walked[slot] - expected[slot]).abs() < 1e-5);
        }
    }

    #[test]
    fn all_bin_weights_sum_to_one(
        width in 1..40u32, height in 1..40u32, seed: u64, c in vector(90.0), a in vector(60.0), b in vector(60.0),
    ) {
        let map = random_map(width, height, 1.5, seed);
        let ibm = build(&map, 0.05, 13, 3);
        let footprint = Footprint::in_texels(width, height, c, a, b);
        // The central slot of every bin's own neighbourhood.
        let mut sum = 0.0;
        for row in 0..13 {
            for column in 0..13 {
                let h = ibm.grid.representative((column, row));
                let center = ibm.grid.bin(h);
                let (neighbourhood, weights) = ibm.bin_weights(&footprint, h);
                if center == (column, row) {
                    sum += f64::from(weights[neighbourhood.slot(bins::pack(center)).unwrap()]);
                }
            }
        }
        prop_assert!((sum - 1.0).abs() < 1e-4, "sum {sum}");
    }
}

#[test]
fn large_footprints_walk_the_forest() {
    // Bins of some thousand texels, and of tens of thousands, whose tree nodes have wide numbers.
    for steepness in [0.3, 0.1] {
        let map = random_map(600, 400, steepness, 7);
        let ibm = build(&map, 0.05, 40, 10);
        let (a, b) = (DVec2::new(260.0, 80.0), DVec2::new(-60.0, 300.0));
        let footprint = Footprint::in_texels(600, 400, DVec2::new(590.0, 10.0), a, b);
        assert!(footprint.area() > SCAN_FACTOR * 240_000_f64.powf(0.25));
        let h = Vec3::new(0.05, -0.05, 1.0).normalize();
        let (_, weights) = ibm.bin_weights(&footprint, h);
        let expected = direct_weights(&map, &ibm, &footprint, h);
        assert!(expected.iter().sum::<f64>() > 0.01);
        for slot in 0..SLOTS {
            assert!((f64::from(weights[slot]) - expected[slot]).abs() < 1e-6);
        }
    }
}

#[test]
fn the_inverse_lists_every_texel_once_in_its_bin() {
    let map = random_map(37, 23, 1.0, 3);
    let ibm = build(&map, 0.1, 11, 4);
    let mut seen = vec![false; 37 * 23];
    for row in 0..11 {
        for column in 0..11 {
            let list = ibm.inverse.texels((column, row));
            assert_eq!(list.len(), ibm.inverse.count((column, row)) as usize);
            for &texel in list {
                assert_eq!(bins::unpack(ibm.bin_map[texel as usize]), (column, row));
                assert!(!std::mem::replace(&mut seen[texel as usize], true));
            }
        }
    }
    assert!(seen.into_iter().all(|s| s));
}

#[test]
fn structure_does_not_depend_on_the_number_of_threads() {
    let map = random_map(130, 70, 0.4, 5);
    let in_pool = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let ibm = pool.install(|| build(&map, 0.05, 50, 5));
        (ibm.bin_map, ibm.inverse.words())
    };
    assert_eq!(in_pool(1), in_pool(5));
}

#[test]
fn neighbourhood_matches_are_the_21_bins() {
    let grid = BinGrid::new(40).unwrap();
    for h in [
        Vec3::Z,
        Vec3::new(-0.99, 0.05, 0.13),
        Vec3::new(0.02, 0.999, 0.04),
    ] {
        let neighbourhood = grid.neighbourhood(h.normalize());
        let all: Vec<u32> = (0..40 * 40).map(|i| bins::pack((i % 40, i / 40))).collect();
        let mut found = Vec::new();
        neighbourhood.for_each_match(&all, |slot, offset| found.push((slot, bins::unpack(all[offset]))));
        assert_eq!(found, neighbourhood.bins().collect::<Vec<_>>());
    }
    assert_eq!(grid.neighbourhood(Vec3::Z).bins().count(), 21);
    assert_eq!(bins::offsets().count(), 21);
}

#[test]
fn representatives_lie_on_the_hemisphere_and_in_their_bins() {
    for resolution in [1, 2, 15, 59, 942] {
        let grid = BinGrid::new(resolution).unwrap();
        for row in 0..resolution {
            for column in 0..resolution {
                let normal = grid.representative((column, row));
                let on_disk =
                    |c: u32| ((c as f32 + 0.5) * grid.width() as f32 - 1.0).abs() - 0.5 * grid.width() as f32;
                if on_disk(column).max(0.0).hypot(on_disk(row).max(0.0)) < 0.999 {
                    assert!((normal.length() - 1.0).abs() < 1e-5 && normal.z > 0.0);
                    assert_eq!(grid.bin(normal), (column, row), "resolution {resolution}");
                }
            }
        }
    }
}

#[test]
fn bad_parameters_are_named() {
    let map = random_map(4, 4, 0.1, 1);
    let error = |options| {
        InverseBinMap::new(&map, model(0.1), options)
            .err()
            .unwrap()
            .to_string()
    };
    let with_bins = |bins| Options {
        bins: Some(bins),
        ..Options::default()
    };
    assert!(error(with_bins(0)).contains("\"bins\" = 0"));
    assert!(error(with_bins(20_000)).contains("16384"));
    assert!(
        error(Options {
            leaf_size: Some(0),
            ..Options::default()
        })
        .contains("\"leaf_size\"")
    );
}
