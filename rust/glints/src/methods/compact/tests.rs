use super::counts::LARGEST_DEVIATION;
use super::*;
use crate::flakes::Normalization;
use crate::methods::direct::Direct;
use crate::microfacet::{Distribution, Flake};
use proptest::prelude::*;

pub fn model(alpha: f32) -> FlakeModel {
    FlakeModel {
        flake: Flake::new(Distribution::Beckmann, alpha).unwrap(),
        normalization: Normalization::Projected,
    }
}

/// A map of random normals with slopes up to `slope`.
pub fn random_map(width: u32, height: u32, slope: f32, seed: u32) -> NormalMap {
    let random = |i: u32| {
        let mut h = i.wrapping_mul(0x9e37_79b1) ^ seed;
        h = (h ^ h >> 15).wrapping_mul(0x85eb_ca6b);
        h = (h ^ h >> 13).wrapping_mul(0xc2b2_ae35);
        (h ^ h >> 16) as f32 / u32::MAX as f32 * 2.0 - 1.0
    };
    let normals: Vec<Vec3> = (0..width * height)
        .map(|i| Vec3::new(slope * random(2 * i), slope * random(2 * i + 1), 1.0))
        .collect();
    NormalMap::from_normals("random", width, height, &normals).unwrap()
}

/// Largest distance of a stored normal's projection from the map's, in steps of the quantisation.
fn largest_distance(map: &NormalMap, compact: &CompactBinMap) -> f32 {
    let texels = (0..map.height()).flat_map(|row| (0..map.width()).map(move |column| (column, row)));
    let distance = |(column, row)| {
        (compact.normal(column, row) - map.normal(column, row))
            .truncate()
            .abs()
            .max_element()
    };
    texels.map(distance).fold(0.0, f32::max) / compact.texels.grid().pitch
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn every_texel_is_found_again(width in 1..300_u32, height in 1..300_u32, slope in 0.0..2.0_f32, seed: u32, rough: bool) {
        let map = random_map(width, height, slope, seed);
        let compact = CompactBinMap::new(&map, model(if rough { 0.3 } else { 0.004 }));
        // Half a step, and rounding.
        prop_assert!(largest_distance(&map, &compact) < 0.51);
    }
}

#[test]
fn texels_of_every_width_are_found_again() {
    // Slopes of one axis are up to 16 times steeper than the other's, so that bits are shared out unevenly.
    let random = random_map(90, 50, 0.6, 4);
    for squeeze in [1.0_f32, 0.25, 1.0 / 16.0] {
        let normals: Vec<Vec3> = random
            .normals()
            .iter()
            .map(|n| Vec3::new(squeeze * n.x, n.y, n.z))
            .collect();
        let map = NormalMap::from_normals("uneven", 90, 50, &normals).unwrap();
        let mut widths = Vec::new();
        for alpha in [0.2, 0.05, 0.02, 0.01, 0.005, 0.0025, 0.001] {
            let compact = CompactBinMap::new(&map, model(alpha));
            assert!(largest_distance(&map, &compact) < 0.51, "alpha {alpha}");
            widths.push(compact.texels.bytes() * 8 / (96 * 56));
        }
        assert!(widths.is_sorted() && widths.first() < widths.last(), "{widths:?}");
    }
}

#[test]
fn memory_is_within_its_budget() {
    for alpha in [0.004, 0.02, 0.05, 0.16] {
        let map = random_map(1024, 1024, 0.7, 3);
        let compact = CompactBinMap::new(&map, model(alpha));
        let per_texel = compact.structure_bytes() as f64 / 1024.0_f64.powi(2);
        assert!(per_texel < 1.02 * BYTES_PER_TEXEL, "alpha {alpha}: {per_texel}");
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let map = random_map(300, 200, 0.5, 9);
    let query = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let compact = pool.install(|| CompactBinMap::new(&map, model(0.02)));
        let footprint = Footprint::new(300, 200, [0.4, 0.3], [0.3, 0.1], [-0.1, 0.4]);
        (0..50)
            .map(|i| compact.ndf(&footprint, Vec3::new(0.01 * i as f32 - 0.2, 0.1, 1.0).normalize()))
            .collect::<Vec<_>>()
    };
    assert_eq!(query(1), query(3));
}

/// A map of flakes of which most lie almost flat, and a few on edge.
pub fn tailed_map(side: u32) -> NormalMap {
    let slopes = random_map(side, side, 1.0, 11);
    let tilted: Vec<Vec3> = slopes
        .normals()
        .iter()
        .map(|n| {
            let [share, turn] = (n.truncate() / n.z).to_array();
            let direction = Vec2::from_angle(std::f32::consts::PI * turn);
            (direction * 0.01 * share.abs().max(1e-4).powf(-0.4)).extend(1.0)
        })
        .collect();
    NormalMap::from_normals("tailed", side, side, &tilted).unwrap()
}

/// Sum of the differences of the distributions at half vectors, over that of the exact values.
fn relative_error(
    compact: &CompactBinMap,
    direct: &Direct,
    footprints: &[Footprint],
    halves: &[Vec3],
) -> f32 {
    let (mut difference, mut sum) = (0.0, 0.0);
    for footprint in footprints {
        for &h in halves {
            let expected = direct.ndf(footprint, h);
            difference += (compact.ndf(footprint, h) - expected).abs();
            sum += expected;
        }
    }
    difference / sum
}

#[test]
fn strays_are_added_where_nodes_are_counted() {
    const SIDE: u32 = 256;
    let map = tailed_map(SIDE);
    let model = model(0.02);
    let direct = Direct::new(map.clone(), model);
    let mut compact = CompactBinMap::new(&map, model);
    // Covers tell the value everywhere.
    compact.mean_density = 0.0;
    let strays: Vec<Vec3> = compact
        .strays
        .texels()
        .map(|texel| map.normals()[texel as usize])
        .collect();
    assert!(
        (100..SIDE.pow(2) as usize / 25).contains(&strays.len()),
        "{}",
        strays.len()
    );
    // All of the map, once and a few times: a smaller footprint's border is blurred, which single lobes show.
    let footprints = [256.0, 1024.0].map(|width| {
        let edges = [glam::DVec2::new(width, 0.0), glam::DVec2::new(0.0, width)];
        Footprint::in_texels(SIDE, SIDE, glam::DVec2::splat(110.0), edges[0], edges[1])
    });
    let halves: Vec<Vec3> = strays.iter().step_by(strays.len() / 50).copied().collect();
    let error = |compact: &CompactBinMap| relative_error(compact, &direct, &footprints, &halves);
    let found = error(&compact);
    // Next to the core few texels are counted, with the noise of counts.
    assert!(found < 0.05, "{found}");
    // The broken twin.
    compact.strays = Strays::none();
    let twin = error(&compact);
    assert!(twin > 0.3, "{twin}");
}

#[test]
fn glints_beside_a_bright_coat_are_exact() {
    // Fifty of 51 texels lie almost flat; the others, in flakes of 4 x 4 texels, point anywhere.
    const SIDE: u32 = 1024;
    let (coat, flakes) = (
        random_map(SIDE, SIDE, 0.004, 3),
        random_map(SIDE / 4, SIDE / 4, 0.3, 8),
    );
    let texels = (0..SIDE).flat_map(|row| (0..SIDE).map(move |column| (column, row)));
    let normals: Vec<Vec3> = texels
        .map(|(column, row)| {
            let flake = row / 4 * (SIDE / 4) + column / 4;
            if flake % 51 == 0 {
                flakes.normals()[flake as usize]
            } else {
                coat.normals()[(row * SIDE + column) as usize]
            }
        })
        .collect();
    let map = NormalMap::from_normals("coat and flakes", SIDE, SIDE, &normals).unwrap();
    let model = model(0.01);
    let direct = Direct::new(map.clone(), model);
    let mut compact = CompactBinMap::new(&map, model);
    let edge = glam::DVec2::from_angle(0.4) * 600.0;
    let footprint = Footprint::in_texels(SIDE, SIDE, glam::DVec2::new(400.0, 470.0), edge, edge.perp());
    // Half vectors far from the coat's.
    let halves: Vec<Vec3> = (0..100)
        .map(|k| {
            let turn = Vec2::from_angle(2.4 * k as f32);
            ((0.08 + 0.001 * k as f32) * turn).extend(1.0).normalize()
        })
        .collect();
    let error = |compact: &CompactBinMap| relative_error(compact, &direct, &[footprint], &halves);
    let found = error(&compact);
    assert!(found < 0.04, "{found}");
    // The broken twin: the cover's value everywhere.
    compact.mean_density = 0.0;
    let twin = error(&compact);
    assert!(twin > 0.1, "{twin}");
}

#[test]
fn parts_of_a_map_deviate_by_chance_or_by_streaks() {
    let of = |map: &NormalMap| CompactBinMap::new(map, model(0.05));
    let of_some = |compact: &CompactBinMap| {
        let found = compact
            .counts
            .deviation_of_root(&compact.tree, |texel| compact.texels.normal(texel));
        found.unwrap()
    };
    // A long map, of whose root there are left and right halves only.
    let even = of(&random_map(512, 256, 0.5, 2));
    let last = *even.deviations.last().unwrap();
    assert!(last > 0.0 && last < 0.2, "{:?}", even.deviations);
    // What some texels tell is about what all counts tell.
    let sparse = of_some(&even);
    assert!(sparse > 0.6 * last && sparse < 1.7 * last, "{sparse} of {last}");
    let rows = random_map(1, 256, 0.5, 2);
    let streaks: Vec<Vec3> = (0..256 * 256).map(|k| rows.normals()[k / 256]).collect();
    let streaks = of(&NormalMap::from_normals("streaks", 256, 256, &streaks).unwrap());
    let last_of_streaks = streaks.deviations.last();
    assert_eq!(
        last_of_streaks,
        Some(&LARGEST_DEVIATION),
        "{:?}",
        streaks.deviations
    );
    let sparse = of_some(&streaks);
    assert!(sparse > 3.0 * last, "{sparse:?}");
}
