//! The distributions of normals of the methods, held against closed forms and against each other.

use glam::{DVec2, Vec3};
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint::Footprint;
use glints::half_vector::DirectionPair;
use glints::methods::Method;
use glints::methods::direct::Direct;
use glints::methods::inverse_bin_map::{InverseBinMap, Options};
use glints::methods::unfiltered::Unfiltered;
use glints::microfacet::Flake;
use glints::normal_map::NormalMap;

fn model(alpha: f32, normalization: Normalization) -> FlakeModel {
    FlakeModel {
        flake: Flake::new(alpha).unwrap(),
        normalization,
    }
}

/// SplitMix64, for reproducible tests.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 40) as f32 / (1 << 24) as f32
    }
}

/// A map of Gaussian slopes with the standard deviations `sigma`.
fn gaussian_map(side: u32, sigma: [f32; 2], seed: u64) -> NormalMap {
    let mut random = Random(seed);
    let normals: Vec<Vec3> = (0..side * side)
        .map(|_| {
            let radius = (-2.0 * (1.0 - random.uniform()).ln()).sqrt();
            let (sin, cos) = (std::f32::consts::TAU * random.uniform()).sin_cos();
            Vec3::new(-sigma[0] * radius * cos, -sigma[1] * radius * sin, 1.0)
        })
        .collect();
    NormalMap::from_normals("gaussian", side, side, &normals).unwrap()
}

fn methods(map: &NormalMap, model: FlakeModel) -> Vec<Box<dyn Method>> {
    vec![
        Box::new(Direct::new(map.clone(), model)),
        Box::new(InverseBinMap::new(map, model, Options::default()).unwrap()),
        Box::new(Unfiltered::new(map.clone(), model)),
    ]
}

/// Points of a grid over the projected hemisphere, and the projected solid angle of a cell.
fn disk(side: usize) -> (impl Iterator<Item = Vec3>, f64) {
    let center = move |i: usize| (2.0 * (i as f64 + 0.5) / side as f64 - 1.0) as f32;
    let points = (0..side * side).filter_map(move |i| {
        let (x, y) = (center(i % side), center(i / side));
        let z2 = 1.0 - x * x - y * y;
        (z2 > 0.0).then(|| Vec3::new(x, y, z2.sqrt()))
    });
    (points, (2.0 / side as f64).powi(2))
}

fn footprint(side: u32, width: f64) -> Footprint {
    let turned = DVec2::from_angle(0.4) * width;
    Footprint::in_texels(side, side, DVec2::new(20.7, 41.2), turned, turned.perp() * 0.8)
}

#[test]
fn distributions_integrate_to_one_against_the_cosine() {
    let map = gaussian_map(64, [0.4, 0.3], 1);
    for alpha in [0.03, 0.05, 0.16] {
        for method in methods(&map, model(alpha, Normalization::Projected)) {
            for width in [0.0, 0.5, 9.0, 140.0] {
                // Cells of about half the lobe's standard deviation integrate a Gaussian to 1e-4.
                let (points, cell) = disk((7.0 / f64::from(alpha)) as usize);
                let footprint = footprint(64, width);
                let integral: f64 = points.map(|h| f64::from(method.ndf(&footprint, h))).sum::<f64>() * cell;
                assert!(
                    (integral - 1.0).abs() < 0.005,
                    "{} alpha {alpha} width {width}: {integral}",
                    method.name()
                );
            }
        }
    }
}

/// Relative L1 difference of the distributions of normals over the half-vector disk, averaged over
/// footprints.
fn relative_l1(method: &dyn Method, exact: &dyn Method, width: f64, turns: usize) -> f64 {
    let (mut difference, mut total) = (0.0, 0.0);
    for turn in 0..turns {
        let a = DVec2::from_angle(turn as f64) * width;
        let center = DVec2::new(5.3, 7.9) * turn as f64;
        let footprint = Footprint::in_texels(64, 64, center, a, a.perp() * 0.8);
        for h in disk(240).0 {
            let expected = exact.ndf(&footprint, h);
            difference += f64::from((method.ndf(&footprint, h) - expected).abs());
            total += f64::from(expected);
        }
    }
    difference / total
}

#[test]
fn binned_distribution_is_near_the_direct_one() {
    let map = gaussian_map(64, [0.4, 0.3], 2);
    let model = model(0.05, Normalization::Projected);
    let direct = Direct::new(map.clone(), model);
    let ibm = InverseBinMap::new(&map, model, Options::default()).unwrap();
    let mut coarse = model;
    coarse.flake = Flake::new(0.02).unwrap();
    let shifted = Direct::new(map, coarse);
    // Separate lobes are displaced to their bins' centres, many overlapping ones blend.
    for (width, bound) in [(1.0, 0.36), (8.0, 0.33), (64.0, 0.15)] {
        let error = relative_l1(&ibm, &direct, width, 8);
        assert!(error < bound, "width {width}: {error}");
        // The bounds tell the wrong roughness from the right one.
        assert!(relative_l1(&shifted, &direct, width, 2) > bound);
    }
}

/// Pearson's statistic of `method`'s half vectors over a grid of cells on the disk, against densities
/// integrated with `oversampling^2` points a cell. Cells with fewer than ten expected hits are pooled.
fn chi_square(method: &dyn Method, footprint: &Footprint, cells: usize, oversampling: usize) -> (f64, f64) {
    const SAMPLES: usize = 1_000_000;
    let side = cells * oversampling;
    let mut expected = vec![0.0; cells * cells + 1];
    let index = |h: Vec3| {
        let cell = |x: f32| (((x + 1.0) * 0.5 * cells as f32) as usize).min(cells - 1);
        cell(h.y) * cells + cell(h.x)
    };
    let (points, area) = disk(side);
    for h in points {
        let density = f64::from(method.density(footprint, h)) / f64::from(h.z);
        expected[index(h)] += density * area * SAMPLES as f64;
    }
    let drawn: f64 = expected.iter().sum();
    *expected.last_mut().unwrap() = SAMPLES as f64 - drawn;
    let mut observed = vec![0.0; expected.len()];
    let mut random = Random(99);
    for _ in 0..SAMPLES {
        let u = std::array::from_fn(|_| random.uniform());
        let cell = method.sample(footprint, u).map_or(cells * cells, index);
        observed[cell] += 1.0;
    }
    let (mut statistic, mut freedom) = (0.0, -1.0);
    let (mut pooled_expected, mut pooled_observed) = (0.0, 0.0);
    for (&e, &o) in expected.iter().zip(&observed) {
        pooled_expected += e;
        pooled_observed += o;
        if pooled_expected >= 10.0 {
            statistic += (pooled_observed - pooled_expected).powi(2) / pooled_expected;
            freedom += 1.0;
            (pooled_expected, pooled_observed) = (0.0, 0.0);
        }
    }
    (statistic, freedom)
}

#[test]
fn samples_have_their_density() {
    let map = gaussian_map(64, [0.4, 0.3], 3);
    for alpha in [0.05, 0.16] {
        let model = model(alpha, Normalization::Projected);
        // Cells are the bins, so that the truncation at the neighbourhood's border falls on cell borders.
        let ibm = InverseBinMap::new(&map, model, Options::default()).unwrap();
        let direct = Direct::new(map.clone(), model);
        let bins = ibm.grid().resolution() as usize;
        for width in [0.0, 2.0, 30.0] {
            for method in [&ibm as &dyn Method, &direct] {
                let footprint = footprint(64, width);
                let (statistic, freedom) = chi_square(method, &footprint, bins, 24);
                // The normal approximation of the chi-square distribution, at five standard deviations.
                let bound = freedom + 5.0 * (2.0_f64 * freedom).sqrt() + 10.0;
                assert!(
                    statistic < bound,
                    "{} alpha {alpha} width {width}: {statistic} > {bound} ({freedom})",
                    method.name()
                );
            }
        }
    }
}

#[test]
fn shadowed_reflection_matches_a_naive_sum() {
    let map = gaussian_map(8, [0.3, 0.2], 4);
    let alpha = 0.3_f64;
    let wi = Vec3::new(0.5, -0.2, 0.6).normalize();
    let wo = Vec3::new(-0.3, 0.4, 0.9).normalize();
    let pair = DirectionPair::new(wi, wo).unwrap();
    let h = pair.half.as_dvec3();
    let lambda_g1 = |cos: f64| {
        let a = cos / (alpha * (1.0 - cos * cos).sqrt());
        if a >= 1.6 {
            1.0
        } else {
            (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
        }
    };
    let mut sums = [0.0; 2];
    for t in map.normals() {
        let t = t.as_dvec3();
        let cos = h.dot(t);
        let tan2 = 1.0 / (cos * cos) - 1.0;
        let d = (-tan2 / alpha.powi(2)).exp() / (std::f64::consts::PI * alpha.powi(2) * cos.powi(4));
        let term = d * lambda_g1(wi.as_dvec3().dot(t)) * lambda_g1(wo.as_dvec3().dot(t)) / 64.0;
        sums[0] += term / t.z;
        sums[1] += term;
    }
    let whole = Footprint::in_texels(8, 8, DVec2::splat(4.0), DVec2::X * 8.0, DVec2::Y * 8.0);
    for (normalization, sum) in [Normalization::Projected, Normalization::Paper]
        .into_iter()
        .zip(sums)
    {
        let direct = Direct::new(map.clone(), model(alpha as f32, normalization));
        let value = f64::from(direct.evaluate(&whole, &pair).value);
        assert!((value / sum - 1.0).abs() < 1e-4, "{value} against {sum}");
    }
}

#[test]
fn a_point_footprint_is_unfiltered() {
    let map = gaussian_map(16, [0.2, 0.2], 5);
    let model = model(0.1, Normalization::Projected);
    let point = Footprint::new(16, 16, [0.3, 0.7], [0.0; 2], [0.0; 2]);
    let (direct, unfiltered) = (Direct::new(map.clone(), model), Unfiltered::new(map, model));
    for h in disk(40).0 {
        assert_eq!(direct.ndf(&point, h), unfiltered.ndf(&point, h));
    }
}
