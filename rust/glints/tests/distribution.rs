//! The distributions of normals of the methods, held against closed forms and against each other.

use std::ops::Range;

use glam::{DVec2, Vec3};
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint::Footprint;
use glints::footprint_filter::FootprintFilter;
use glints::half_vector::DirectionPair;
use glints::methods::Method;
use glints::methods::compact::CompactBinMap;
use glints::methods::direct::Direct;
use glints::methods::inverse_bin_map::cells::Cells;
use glints::methods::inverse_bin_map::{
    Binning, InverseBinMap, Options, SpecularBinMap, SpecularOptions, bins,
};
use glints::methods::unfiltered::{Interpolation, Unfiltered};
use glints::methods::yan16::{self, Elements, Yan16};
use glints::microfacet::{Distribution, Flake};
use glints::normal_map::NormalMap;

fn model(alpha: f32, normalization: Normalization) -> FlakeModel {
    FlakeModel {
        flake: Flake::new(Distribution::Beckmann, alpha).unwrap(),
        normalization,
    }
}

fn ggx_model(alpha: f32) -> FlakeModel {
    FlakeModel {
        flake: Flake::new(Distribution::Ggx, alpha).unwrap(),
        normalization: Normalization::Projected,
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
        Box::new(CompactBinMap::new(map, model)),
        Box::new(Unfiltered::new(map.clone(), model, Interpolation::Nearest)),
        Box::new(yan16(map, model.flake.alpha(), Elements::Flat)),
    ]
}

fn yan16(map: &NormalMap, alpha: f32, elements: Elements) -> Yan16 {
    let options = yan16::Options {
        elements,
        intrinsic: alpha / std::f32::consts::SQRT_2,
        ..yan16::Options::default()
    };
    Yan16::new(map, options).unwrap()
}

/// A smooth map whose normal turns by about the roughness 0.05 from texel to texel.
fn wavy_map(side: u32) -> NormalMap {
    let phase = std::f32::consts::TAU * 3.0 / side as f32;
    let normals: Vec<Vec3> = (0..side * side)
        .map(|i| {
            let (u, v) = ((i % side) as f32 * phase, (i / side) as f32 * phase);
            Vec3::new(0.3 * (u + 0.5 * v.sin()).sin(), 0.25 * (v - u.cos()).cos(), 1.0)
        })
        .collect();
    NormalMap::from_normals("wavy", side, side, &normals).unwrap()
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

/// The naive double-precision sum of `D_GGX(h, t)`, Eq. 33 of Walter et al. 2007, over a whole map.
fn naive_ggx(map: &NormalMap, alpha: f64, h: Vec3) -> f64 {
    let term = |t: &Vec3| {
        let cos = h.as_dvec3().dot(t.as_dvec3());
        let tan2 = 1.0 / (cos * cos) - 1.0;
        let d = alpha.powi(2) / (std::f64::consts::PI * cos.powi(4) * (alpha.powi(2) + tan2).powi(2));
        if cos > 0.0 { d / f64::from(t.z) } else { 0.0 }
    };
    map.normals().iter().map(term).sum::<f64>() / map.normals().len() as f64
}

#[test]
fn the_direct_sum_of_ggx_flakes_is_the_naive_one() {
    let map = gaussian_map(16, [0.4, 0.3], 7);
    let direct = Direct::new(map.clone(), ggx_model(0.02));
    let beckmann = Direct::new(map.clone(), model(0.02, Normalization::Projected));
    let whole = Footprint::in_texels(16, 16, DVec2::splat(8.0), DVec2::X * 16.0, DVec2::Y * 16.0);
    let (mut worst, mut twin) = (0.0_f64, 0.0_f64);
    for h in disk(24).0 {
        let expected = naive_ggx(&map, 0.02, h);
        worst = worst.max((f64::from(direct.ndf(&whole, h)) / expected - 1.0).abs());
        twin = twin.max((f64::from(beckmann.ndf(&whole, h)) / expected - 1.0).abs());
    }
    // Nothing of the tail is left out, however far from all normals.
    assert!(worst < 1e-3, "{worst}");
    assert!(twin > 0.9, "{twin}");
}

#[test]
fn distributions_of_ggx_flakes_integrate_to_one_against_the_cosine() {
    let map = gaussian_map(24, [0.4, 0.3], 1);
    for alpha in [0.05, 0.1] {
        let model = ggx_model(alpha);
        let ibm = InverseBinMap::new(&map, model, Options::default()).unwrap();
        let direct = Direct::new(map.clone(), model);
        for method in [&ibm as &dyn Method, &direct] {
            for width in [0.0, 9.0, 40.0] {
                let (points, cell) = disk((8.0 / f64::from(alpha)) as usize);
                let footprint = footprint(24, width);
                let integral: f64 = points.map(|h| f64::from(method.ndf(&footprint, h))).sum::<f64>() * cell;
                let name = method.name();
                assert!(
                    (integral - 1.0).abs() < 0.01,
                    "{name} alpha {alpha} width {width}: {integral}"
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
    coarse.flake = Flake::new(Distribution::Beckmann, 0.02).unwrap();
    let shifted = Direct::new(map, coarse);
    // Separate lobes are displaced to their bins' centres, many overlapping ones blend.
    for (width, bound) in [(1.0, 0.36), (8.0, 0.33), (64.0, 0.15)] {
        let error = relative_l1(&ibm, &direct, width, 8);
        assert!(error < bound, "width {width}: {error}");
        // The bounds tell the wrong roughness from the right one.
        assert!(relative_l1(&shifted, &direct, width, 2) > bound);
    }
}

#[test]
fn compact_distribution_is_the_direct_one() {
    // From 64 texels on with counts; the widest footprints meet the same nodes in several periods of the map.
    let map = gaussian_map(64, [0.4, 0.3], 2);
    for alpha in [0.02, 0.05, 0.16] {
        let model = model(alpha, Normalization::Projected);
        let direct = Direct::new(map.clone(), model);
        let compact = CompactBinMap::new(&map, model);
        for (width, bound) in [
            (0.3, 0.035),
            (8.0, 0.02),
            (64.0, 0.02),
            (130.0, 0.03),
            // Counts alone, of 4096 texels: 0.5 / sqrt(n) for the n lobes that overlap, a few hundred.
            (300.0, 0.04),
        ] {
            let error = difference(&compact, &direct, &footprint(64, width));
            assert!(error < bound, "alpha {alpha} width {width}: {error}");
        }
    }
}

/// Relative L1 difference of two distributions of normals, at half vectors drawn from each in turn.
fn difference(a: &dyn Method, b: &dyn Method, footprint: &Footprint) -> f64 {
    difference_at(a, b, footprint, 3000)
}

/// The same at so many half vectors.
fn difference_at(a: &dyn Method, b: &dyn Method, footprint: &Footprint, samples: usize) -> f64 {
    let mut random = Random(17);
    let mut sum = 0.0;
    for i in 0..samples {
        let u = std::array::from_fn(|_| random.uniform());
        if let Some(h) = [a, b][i % 2].sample(footprint, u) {
            let drawn_with = 0.5 * (a.density(footprint, h) + b.density(footprint, h));
            sum += f64::from((a.ndf(footprint, h) - b.ndf(footprint, h)).abs() * h.z / drawn_with);
        }
    }
    sum / samples as f64
}

/// Footprints of many shapes over a map of 64 x 64 texels: a point, small ones, large ones, thin ones, many periods.
fn gaussian_footprints() -> Vec<Footprint> {
    let shapes = [
        ([0.0, 0.0], [0.0, 0.0]),
        ([0.3, 0.1], [-0.1, 0.2]),
        ([1.5, 0.4], [0.3, 2.0]),
        ([7.0, 2.0], [-3.0, 6.0]),
        ([21.0, 8.0], [-5.0, 17.0]),
        ([40.0, 11.0], [0.7, 0.3]),
        ([55.0, -20.0], [13.0, 47.0]),
        ([160.0, 30.0], [4.0, 9.0]),
        ([900.0, 200.0], [-3.0, 2.0]),
        ([600.0, 100.0], [-200.0, 500.0]),
    ];
    let footprint = |(a, b): ([f64; 2], [f64; 2])| {
        Footprint::in_texels(64, 64, DVec2::new(60.2, 31.7), a.into(), b.into())
    };
    shapes.into_iter().map(footprint).collect()
}

#[test]
fn compact_distribution_under_a_gaussian_is_the_direct_one() {
    let map = gaussian_map(64, [0.4, 0.3], 2);
    for alpha in [0.02, 0.05, 0.16] {
        let model = model(alpha, Normalization::Projected);
        for &deviation in if alpha == 0.05 { &[0.5, 0.2][..] } else { &[0.5] } {
            let filter = FootprintFilter::gaussian(deviation).unwrap();
            let direct = Direct::with_filter(map.clone(), model, filter);
            let compact = CompactBinMap::new(&map, model).with_filter(filter);
            let boxed = CompactBinMap::new(&map, model);
            for (kind, footprint) in gaussian_footprints().iter().enumerate() {
                let error = difference_at(&compact, &direct, footprint, 200);
                // One lobe alone shows the quantisation most.
                let bound = if kind < 2 { 0.035 } else { 0.03 };
                assert!(
                    error < bound,
                    "alpha {alpha} deviation {deviation} footprint {kind}: {error}"
                );
                if [2, 3, 4].contains(&kind) {
                    // The broken twin: the weights of the box.
                    let twin = difference_at(&boxed, &direct, footprint, 100);
                    assert!(twin > 0.05, "alpha {alpha} footprint {kind}: {twin}");
                }
            }
        }
    }
}

#[test]
fn nodes_under_a_gaussian_are_taken_as_a_whole_where_that_is_exact_enough() {
    // Several nodes a side are small against the deviation here, and none is the whole map.
    const SIDE: u32 = 512;
    let map = gaussian_map(SIDE, [0.3, 0.2], 4);
    for alpha in [0.02, 0.05, 0.16] {
        let model = model(alpha, Normalization::Projected);
        let filter = FootprintFilter::gaussian(0.5).unwrap();
        let direct = Direct::with_filter(map.clone(), model, filter);
        let compact = CompactBinMap::new(&map, model).with_filter(filter);
        for width in [40.0, 110.0, 220.0] {
            let a = DVec2::from_angle(0.4) * width;
            let footprint = Footprint::in_texels(SIDE, SIDE, DVec2::new(200.0, 70.0), a, a.perp() * 0.8);
            let error = difference_at(&compact, &direct, &footprint, 80);
            assert!(error < 0.03, "alpha {alpha} width {width}: {error}");
        }
    }
}

#[test]
fn samples_of_the_compact_structure_have_the_density_of_a_gaussian() {
    let map = gaussian_map(100, [0.4, 0.3], 5);
    let filter = FootprintFilter::gaussian(0.5).unwrap();
    for (alpha, oversampling) in [(0.05, 5), (0.16, 3)] {
        let method = CompactBinMap::new(&map, model(alpha, Normalization::Projected)).with_filter(filter);
        let boxed = CompactBinMap::new(&map, model(alpha, Normalization::Projected));
        for (kind, footprint) in footprints_of_all_kinds(100).iter().enumerate().step_by(2) {
            let test = |density: &dyn Method| {
                let density = |h| density.density(footprint, h);
                chi_square(&method, density, footprint, (48, [0..48, 0..48]), oversampling)
            };
            let exact = test(&method);
            assert!(is_plausible(exact), "alpha {alpha} footprint {kind}: {exact:?}");
            if kind == 2 {
                // The broken twin: the density of the box.
                let twin = test(&boxed);
                assert!(!is_plausible(twin), "alpha {alpha}: {twin:?}");
            }
        }
    }
}

#[test]
fn samples_of_the_compact_structure_have_their_density() {
    let map = gaussian_map(100, [0.4, 0.3], 5);
    for (alpha, oversampling) in [(0.02, 16), (0.05, 5), (0.16, 3)] {
        let method = CompactBinMap::new(&map, model(alpha, Normalization::Projected));
        for (kind, footprint) in footprints_of_all_kinds(100).iter().enumerate() {
            if oversampling == 16 && ![0, 2, 3].contains(&kind) {
                continue;
            }
            let test = |density: &dyn Fn(Vec3) -> f32| {
                let window = [0..48, 0..48];
                chi_square(&method, density, footprint, (48, window), oversampling)
            };
            let exact = test(&|h| method.density(footprint, h));
            assert!(is_plausible(exact), "alpha {alpha} footprint {kind}: {exact:?}");
            if kind == 2 {
                // Without the cosine it is another density.
                let twin = test(&|h| method.ndf(footprint, h));
                assert!(!is_plausible(twin), "alpha {alpha}: {twin:?}");
            }
        }
    }
}

#[test]
fn samples_have_their_density_where_the_normals_have_long_tails() {
    // The core of the directions is counted in bins, the tails are not.
    let mut random = Random(3);
    let normals: Vec<Vec3> = (0..100 * 100)
        .map(|_| {
            let (sin, cos) = (std::f32::consts::TAU * random.uniform()).sin_cos();
            let slope = 0.01 * (1.0 - random.uniform()).powf(-0.4);
            Vec3::new(slope * cos, slope * sin, 1.0)
        })
        .collect();
    let map = NormalMap::from_normals("tailed", 100, 100, &normals).unwrap();
    let wider = Direct::new(map.clone(), model(0.03, Normalization::Projected));
    let method = CompactBinMap::new(&map, model(0.02, Normalization::Projected));
    let direct = Direct::new(map, model(0.02, Normalization::Projected));
    for (kind, footprint) in footprints_of_all_kinds(100).iter().enumerate().skip(2) {
        let test = |density: &dyn Fn(Vec3) -> f32| {
            let window = [0..48, 0..48];
            chi_square(&method, density, footprint, (48, window), 16)
        };
        let exact = test(&|h| method.density(footprint, h));
        assert!(is_plausible(exact), "footprint {kind}: {exact:?}");
        let error = difference(&method, &direct, footprint);
        assert!(error < 0.04, "footprint {kind}: {error}");
        if kind == 2 {
            // The broken twin: wider lobes.
            let twin = test(&|h| wider.density(footprint, h));
            assert!(!is_plausible(twin), "{twin:?}");
        }
    }
}

/// Pearson's statistic and its degrees of freedom for half vectors of `method` on the cells of a grid of
/// `cells^2` over the projected hemisphere that lie in `window` (columns and rows), all other outcomes in one
/// more cell. `density`, per solid angle, is integrated with `oversampling^2` points a cell.
fn chi_square(
    method: &dyn Method,
    density: impl Fn(Vec3) -> f32,
    footprint: &Footprint,
    (cells, window): (usize, [Range<usize>; 2]),
    oversampling: usize,
) -> (f64, f64) {
    const SAMPLES: usize = 400_000;
    let columns = window[0].len();
    let count = columns * window[1].len();
    let step = 2.0 / (cells * oversampling) as f64;
    let mut expected = vec![0.0; count + 1];
    for y in window[1].start * oversampling..window[1].end * oversampling {
        for x in window[0].start * oversampling..window[0].end * oversampling {
            let center = [x, y].map(|i| (i as f64 + 0.5) * step - 1.0);
            let z2 = 1.0 - center[0].powi(2) - center[1].powi(2);
            if z2 > 0.0 {
                let h = Vec3::new(center[0] as f32, center[1] as f32, z2.sqrt() as f32);
                let row = y / oversampling - window[1].start;
                let cell = row * columns + x / oversampling - window[0].start;
                expected[cell] += f64::from(density(h)) / z2.sqrt() * step * step * SAMPLES as f64;
            }
        }
    }
    expected[count] = SAMPLES as f64 - expected.iter().sum::<f64>();
    let mut observed = vec![0.0; count + 1];
    let mut random = Random(99);
    for _ in 0..SAMPLES {
        let u = std::array::from_fn(|_| random.uniform());
        let cell = method.sample(footprint, u).and_then(|h| {
            let [x, y] = [h.x, h.y].map(|c| ((c + 1.0) * 0.5 * cells as f32) as usize);
            let inside = window[0].contains(&x) && window[1].contains(&y);
            inside.then(|| (y - window[1].start) * columns + x - window[0].start)
        });
        observed[cell.unwrap_or(count)] += 1.0;
    }
    pooled_statistic(&expected, &observed)
}

/// Pearson's statistic with cells pooled until ten samples are expected, and the degrees of freedom.
fn pooled_statistic(expected: &[f64], observed: &[f64]) -> (f64, f64) {
    let (mut statistic, mut freedom) = (0.0, -1.0);
    let mut pooled = [0.0; 2];
    for (&e, &o) in expected.iter().zip(observed) {
        pooled[0] += e;
        pooled[1] += o;
        if pooled[0] >= 10.0 {
            statistic += (pooled[1] - pooled[0]).powi(2) / pooled[0];
            freedom += 1.0;
            pooled = [0.0; 2];
        }
    }
    (statistic, freedom)
}

/// Whether a statistic is within five standard deviations of chi-square's mean.
fn is_plausible((statistic, freedom): (f64, f64)) -> bool {
    statistic < freedom + 5.0 * (2.0 * freedom).sqrt() + 10.0
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
                let density = |h| method.density(&footprint, h);
                let result = chi_square(method, density, &footprint, (bins, [0..bins, 0..bins]), 16);
                let name = method.name();
                assert!(
                    is_plausible(result),
                    "{name} alpha {alpha} width {width}: {result:?}"
                );
            }
        }
    }
}

fn specular(map: &NormalMap, bins: u32, binning: Binning, normalization: Normalization) -> SpecularBinMap {
    let options = SpecularOptions {
        bins,
        binning,
        leaf_size: None,
        normalization,
    };
    SpecularBinMap::new(map, options).unwrap()
}

#[test]
fn distributions_of_specular_flakes_integrate_to_one_against_the_cosine() {
    // Slopes up to the horizon: bins at the rim, where the cosine varies most inside a bin.
    let map = gaussian_map(64, [2.0, 1.0], 1);
    for (binning, bins) in [(Binning::Projected, 15), (Binning::EqualSolidAngle, 16)] {
        for width in [0.0, 9.0, 140.0] {
            let footprint = footprint(64, width);
            let integral = |normalization: Normalization| {
                let method = specular(&map, bins, binning, normalization);
                let (points, cell) = disk(480); // whole points a bin of either grid
                points.map(|h| f64::from(method.ndf(&footprint, h))).sum::<f64>() * cell
            };
            let projected = integral(Normalization::Projected);
            assert!(
                (projected - 1.0).abs() < 0.01,
                "{binning:?} width {width}: {projected}"
            );
            // The literal weights see a tilted texel under its projected area.
            let paper = integral(Normalization::Paper);
            assert!(paper < 0.95, "{binning:?} width {width}: {paper}");
        }
    }
}

#[test]
fn samples_of_specular_flakes_have_their_density() {
    // Over ninths of bins, in each of which the density is constant: integrals are exact.
    const SAMPLES: usize = 400_000;
    let map = gaussian_map(64, [0.8, 0.5], 3);
    for (binning, bins) in [(Binning::Projected, 15), (Binning::EqualSolidAngle, 12)] {
        let method = specular(&map, bins, binning, Normalization::Projected);
        let fine = Cells::new(binning, 3 * bins).unwrap();
        for width in [0.0, 2.0, 30.0] {
            let footprint = footprint(64, width);
            let side = 3 * bins;
            let mut observed = vec![0.0; (side * side) as usize + 1];
            let mut random = Random(9);
            for _ in 0..SAMPLES {
                let cell = method.sample(&footprint, std::array::from_fn(|_| random.uniform()));
                let index = cell
                    .map(|h| fine.bin(h))
                    .map_or(side * side, |(x, y)| y * side + x);
                observed[index as usize] += 1.0;
            }
            let plausible = |density: &dyn Fn(Vec3) -> f32| {
                let expected = |i: u32| {
                    let bin = (i % side, i / side);
                    let center = fine.sample(bin, [0.5, 0.5]);
                    center.map_or(0.0, |h| f64::from(density(h)) * fine.solid_angle(bin))
                };
                let mut expected: Vec<f64> = (0..side * side).map(|i| SAMPLES as f64 * expected(i)).collect();
                expected.push(SAMPLES as f64 - expected.iter().sum::<f64>());
                is_plausible(pooled_statistic(&expected, &observed))
            };
            assert!(
                plausible(&|h| method.density(&footprint, h)),
                "{binning:?} {width}"
            );
            // The distribution of normals is another density.
            assert!(!plausible(&|h| method.ndf(&footprint, h)), "{binning:?} {width}");
        }
    }
}

#[test]
fn specular_reflection_is_the_distribution_without_shadowing() {
    let map = gaussian_map(16, [0.4, 0.4], 5);
    let method = specular(&map, 12, Binning::EqualSolidAngle, Normalization::Paper);
    let whole = Footprint::in_texels(16, 16, DVec2::splat(8.0), DVec2::X * 16.0, DVec2::Y * 16.0);
    let mut random = Random(5);
    for _ in 0..100 {
        let mut direction = || Vec3::new(random.uniform() - 0.5, random.uniform() - 0.5, 0.2).normalize();
        let pair = DirectionPair::new(direction(), direction()).unwrap();
        let reflection = method.evaluate(&whole, &pair);
        let bin = method.cells().bin(pair.half);
        let count = map
            .normals()
            .iter()
            .filter(|&&t| method.cells().bin(t) == bin)
            .count();
        let expected = count as f64 / 256.0 * 144.0 / std::f64::consts::TAU;
        assert!((f64::from(reflection.value) - expected).abs() <= 1e-5 * expected);
        assert_eq!(reflection.value, reflection.density);
    }
}

#[test]
fn samples_of_ggx_flakes_have_their_density() {
    let map = gaussian_map(64, [0.4, 0.3], 3);
    let model = ggx_model(0.06);
    let ibm = InverseBinMap::new(&map, model, Options::default()).unwrap();
    let direct = Direct::new(map.clone(), model);
    let twin = Direct::new(map, self::model(0.06, Normalization::Projected));
    let bins = ibm.grid().resolution() as usize;
    for width in [0.0, 6.0] {
        let footprint = footprint(64, width);
        for method in [&ibm as &dyn Method, &direct] {
            let density = |h| method.density(&footprint, h);
            let result = chi_square(method, density, &footprint, (bins, [0..bins, 0..bins]), 12);
            let name = method.name();
            assert!(is_plausible(result), "{name} width {width}: {result:?}");
        }
        let density = |h| direct.density(&footprint, h);
        let result = chi_square(&twin, density, &footprint, (bins, [0..bins, 0..bins]), 4);
        assert!(!is_plausible(result), "Beckmann flakes width {width}: {result:?}");
    }
}

#[test]
fn energy_of_ggx_flakes_is_kept_at_every_tilt() {
    let derived = bins::derived_resolution;
    for (alpha, slope, bins) in [
        (0.01, 0.0, derived(0.01)),
        (0.01, 0.7, derived(0.01)),
        (0.01, 2.0, derived(0.01)),
        (0.1, 0.5, derived(0.1)),
        (0.01, 0.3, derived(0.01) / 4),
        (0.01, 0.3, derived(0.01) * 2),
    ] {
        let options = Options {
            bins: Some(bins),
            ..Options::default()
        };
        let (ibm, footprint, window) = one_flake(ggx_model(alpha), slope, options);
        let points = (ibm.grid().width() / (0.1 * f64::from(alpha))).ceil() as usize + 8;
        let integral = integral_over_window(&ibm, &footprint, &window, points);
        assert!(
            (integral - 1.0).abs() < 0.01,
            "alpha {alpha} slope {slope} bins {bins}: {integral}"
        );
    }
}

/// A point, less than a texel, some texels, several repetitions of the map, an even cover of it, and thin
/// ones: many periods, a line, a closed line on the repeated map.
fn footprints_of_all_kinds(side: u32) -> Vec<Footprint> {
    let mut all: Vec<Footprint> = [0.0, 0.5, 9.0, 70.0, 300.0]
        .map(|width| footprint(side, width))
        .into();
    let slope = DVec2::new(1.0, 2.0).normalize();
    for (a, thickness) in [
        (DVec2::from_angle(0.3) * 900.0, 2.0),
        (DVec2::from_angle(1.1) * 40.0, 0.0),
        (slope * 300.0, 1.0),
    ] {
        let b = a.normalize().perp() * thickness;
        all.push(Footprint::in_texels(side, side, DVec2::new(20.7, 41.2), a, b));
    }
    all
}

#[test]
fn samples_of_position_normal_mixtures_have_their_density() {
    let map = wavy_map(64);
    let refined = Elements::Curved { refinement: 2 };
    for elements in [Elements::Flat, Elements::Curved { refinement: 1 }, refined] {
        let method = yan16(&map, 0.05, elements);
        for (kind, footprint) in footprints_of_all_kinds(64).iter().enumerate() {
            let grid = || (48, [0..48, 0..48]);
            let exact = chi_square(&method, |h| method.density(footprint, h), footprint, grid(), 5);
            assert!(
                is_plausible(exact),
                "{} footprint {kind}: {exact:?}",
                method.name()
            );
            if kind == 2 {
                // Without the cosine it is another density.
                let twin = chi_square(&method, |h| method.ndf(footprint, h), footprint, grid(), 5);
                assert!(!is_plausible(twin), "{}: {twin:?}", method.name());
            }
        }
    }
}

#[test]
fn position_normal_mixtures_are_normalized() {
    let map = wavy_map(64);
    for refinement in 0..4 {
        let elements = match refinement {
            0 => Elements::Flat,
            refinement => Elements::Curved { refinement },
        };
        let method = yan16(&map, 0.05, elements);
        for (kind, footprint) in footprints_of_all_kinds(64).iter().enumerate() {
            let (points, cell) = disk(160);
            let integral: f64 = points.map(|h| f64::from(method.ndf(footprint, h))).sum::<f64>() * cell;
            let name = method.name();
            assert!(
                (integral - 1.0).abs() < 0.005,
                "{name} footprint {kind}: {integral}"
            );
        }
    }
}

/// A map of one texel with the given slope, and the 7 x 7 bins around its normal.
fn one_flake(
    model: FlakeModel,
    slope: f32,
    options: Options,
) -> (InverseBinMap, Footprint, [Range<usize>; 2]) {
    let normals = [Vec3::new(-slope, 0.3 * slope, 1.0)];
    let map = NormalMap::from_normals("flake", 1, 1, &normals).unwrap();
    let ibm = InverseBinMap::new(&map, model, options).unwrap();
    let (column, row) = ibm.grid().bin(map.normal(0, 0));
    let bins = ibm.grid().resolution() as usize;
    let around = |k: u32| (k as usize).saturating_sub(3)..(k as usize + 4).min(bins);
    let point = Footprint::new(1, 1, [0.5; 2], [0.0; 2], [0.0; 2]);
    (ibm, point, [around(column), around(row)])
}

#[test]
fn samples_of_nearly_specular_flakes_have_their_density() {
    for alpha in [0.0025, 0.01] {
        for slope in [0.0, 0.7] {
            let (ibm, footprint, window) =
                one_flake(model(alpha, Normalization::Projected), slope, Options::default());
            let grid = (ibm.grid().resolution() as usize, window);
            let result = chi_square(&ibm, |h| ibm.density(&footprint, h), &footprint, grid, 24);
            assert!(is_plausible(result), "alpha {alpha} slope {slope}: {result:?}");
        }
    }
}

#[test]
fn the_test_tells_the_printed_density_from_the_exact_one() {
    // Eq. 18 as printed has no cosine of the sampled microfacet: that is the distribution itself.
    let map = NormalMap::from_normals("flake", 1, 1, &[Vec3::new(0.2, 0.1, 1.0)]).unwrap();
    let method = Unfiltered::new(map, model(0.3, Normalization::Paper), Interpolation::Nearest);
    let footprint = Footprint::new(1, 1, [0.5; 2], [0.0; 2], [0.0; 2]);
    let grid = || (15, [0..15, 0..15]);
    let exact = chi_square(&method, |h| method.density(&footprint, h), &footprint, grid(), 24);
    let printed = chi_square(&method, |h| method.ndf(&footprint, h), &footprint, grid(), 24);
    assert!(is_plausible(exact), "{exact:?}");
    assert!(!is_plausible(printed), "{printed:?}");
}

/// The integral of the distribution of normals against the cosine over a window of bins.
fn integral_over_window(
    ibm: &InverseBinMap,
    footprint: &Footprint,
    window: &[Range<usize>; 2],
    points: usize,
) -> f64 {
    let step = ibm.grid().width() / points as f64;
    let mut integral = 0.0;
    for y in window[1].start * points..window[1].end * points {
        for x in window[0].start * points..window[0].end * points {
            let [x, y] = [x, y].map(|i| (i as f64 + 0.5) * step - 1.0);
            let z2 = 1.0 - x * x - y * y;
            if z2 > 0.0 {
                let h = Vec3::new(x as f32, y as f32, z2.sqrt() as f32);
                integral += f64::from(ibm.ndf(footprint, h)) * step * step;
            }
        }
    }
    integral
}

#[test]
fn energy_is_kept_at_the_rim_and_with_coarse_or_fine_bins() {
    let derived = bins::derived_resolution;
    for (alpha, slope, resolution) in [
        (0.0025, 5.5, derived(0.0025)),
        (0.0025, 4.0, derived(0.0025)),
        (0.0025, 0.5, derived(0.0025) / 8),
        (0.0025, 0.5, derived(0.0025) / 40),
        (0.01, 0.0, 32),
        // The 21 bins hold two thirds of the lobe only, and the gain makes up for the rest.
        (0.01, 0.3, 2 * derived(0.01)),
    ] {
        let options = Options {
            bins: Some(resolution),
            ..Options::default()
        };
        let (ibm, footprint, window) = one_flake(model(alpha, Normalization::Projected), slope, options);
        // A fifth of the lobe's width on the disk, which its tilt narrows.
        let tilt = 1.0 / (1.0 + 1.1 * f64::from(slope * slope)).sqrt();
        let points = (ibm.grid().width() / (0.2 * f64::from(alpha) * tilt)).ceil() as usize + 2;
        let integral = integral_over_window(&ibm, &footprint, &window, points);
        let error = (integral - 1.0).abs();
        assert!(
            error < 0.01,
            "alpha {alpha} slope {slope} bins {resolution}: {integral}"
        );
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
    let unfiltered = Unfiltered::new(map.clone(), model, Interpolation::Nearest);
    let direct = Direct::new(map, model);
    for h in disk(40).0 {
        assert_eq!(direct.ndf(&point, h), unfiltered.ndf(&point, h));
    }
}

/// Centres and the two edges of footprints, in texels of a map of 16 x 16.
const GAUSSIAN_FOOTPRINTS: [[f64; 6]; 4] = [
    [5.3, 7.9, 0.6, 0.2, -0.3, 0.5],
    [0.4, 15.8, 3.0, 0.0, 0.0, 2.0],
    [9.1, 3.3, 4.0, 3.0, -1.0, 2.5],
    [2.2, 2.9, 9.0, 1.0, 0.2, 0.3],
];

fn gaussian_direct(map: &NormalMap, model: FlakeModel, deviation: f32) -> Direct {
    Direct::with_filter(map.clone(), model, FootprintFilter::gaussian(deviation).unwrap())
}

/// The distribution of normals under an untruncated Gaussian, from its covariance, summed over 24 x 24 points of every
/// texel of 7 x 7 periods and divided by the points' sum.
fn naive_gaussian_ndf(
    map: &NormalMap,
    model: &FlakeModel,
    [cx, cy, ax, ay, bx, by]: [f64; 6],
    deviation: f64,
    halves: &[Vec3],
) -> Vec<f64> {
    const POINTS: i64 = 24;
    let side = i64::from(map.width());
    let variance = deviation * deviation;
    let (xx, xy, yy) = (
        variance * (ax * ax + bx * bx),
        variance * (ax * ay + bx * by),
        variance * (ay * ay + by * by),
    );
    let determinant = xx * yy - xy * xy;
    let mut total = 0.0;
    let mut sums = vec![0.0; halves.len()];
    for y in -3 * side..4 * side {
        for x in -3 * side..4 * side {
            let mut weight = 0.0;
            for i in 0..POINTS * POINTS {
                let dx = x as f64 + ((i % POINTS) as f64 + 0.5) / POINTS as f64 - cx;
                let dy = y as f64 + ((i / POINTS) as f64 + 0.5) / POINTS as f64 - cy;
                weight += (-0.5 * (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / determinant).exp();
            }
            total += weight;
            let t = map.normal(x.rem_euclid(side) as u32, y.rem_euclid(side) as u32);
            for (sum, &h) in sums.iter_mut().zip(halves) {
                if weight > 1e-12 {
                    *sum += weight * f64::from(model.ndf(h, t, 1.0));
                }
            }
        }
    }
    sums.iter().map(|sum| sum / total).collect()
}

fn footprint_of([cx, cy, ax, ay, bx, by]: [f64; 6], size: u32, scale: f64) -> Footprint {
    let v = |x, y| DVec2::new(x, y) * scale;
    Footprint::in_texels(size, size, v(cx, cy), v(ax, ay), v(bx, by))
}

/// Sum of `|found - expected|` over that of `expected`.
fn relative_distance(found: impl Iterator<Item = f32>, expected: &[f64]) -> f64 {
    let difference: f64 = found
        .zip(expected)
        .map(|(found, expected)| (f64::from(found) - expected).abs())
        .sum();
    difference / expected.iter().sum::<f64>()
}

#[test]
fn the_direct_sum_under_a_gaussian_is_the_naive_one() {
    let map = gaussian_map(16, [0.3, 0.2], 5);
    let model = model(0.08, Normalization::Projected);
    let halves: Vec<Vec3> = disk(40).0.filter(|h| h.z > 0.8).collect();
    let box_filter = Direct::new(map.clone(), model);
    for deviation in [0.5_f32, 0.288_675] {
        let direct = gaussian_direct(&map, model, deviation);
        for case in GAUSSIAN_FOOTPRINTS {
            let expected = naive_gaussian_ndf(&map, &model, case, deviation.into(), &halves);
            let footprint = footprint_of(case, 16, 1.0);
            let error = |method: &Direct| {
                relative_distance(halves.iter().map(|&h| method.ndf(&footprint, h)), &expected)
            };
            let (found, twin) = (error(&direct), error(&box_filter));
            // The truncation, and the points of a texel.
            assert!(found < 3e-3, "{case:?} {deviation}: {found}");
            assert!(twin > 0.02, "{case:?} {deviation}: {twin}");
        }
    }
}

#[test]
fn the_gaussian_is_that_of_position_normal_mixtures() {
    // Each texel as 16 x 16 texels of the mixture's map, whose elements then blur by 0.03 texels; small tilts, at which
    // its lobes have the same shape.
    const FINER: u32 = 16;
    let map = gaussian_map(16, [0.06, 0.04], 6);
    let finer: Vec<Vec3> = (0..(16 * FINER).pow(2))
        .map(|i| map.normal(i % (16 * FINER) / FINER, i / (16 * FINER) / FINER))
        .collect();
    let finer = NormalMap::from_normals("finer", 16 * FINER, 16 * FINER, &finer).unwrap();
    let alpha = 0.03;
    let mixture = yan16(&finer, alpha, Elements::Flat);
    let model = model(alpha, Normalization::Projected);
    let (direct, box_filter) = (gaussian_direct(&map, model, 0.5), Direct::new(map.clone(), model));
    let halves: Vec<Vec3> = disk(160).0.filter(|h| h.z > 0.98).collect();
    for case in GAUSSIAN_FOOTPRINTS {
        let (fine, coarse) = (
            footprint_of(case, 16 * FINER, FINER.into()),
            footprint_of(case, 16, 1.0),
        );
        let expected: Vec<f64> = halves.iter().map(|&h| mixture.ndf(&fine, h).into()).collect();
        let error =
            |method: &Direct| relative_distance(halves.iter().map(|&h| method.ndf(&coarse, h)), &expected);
        let (found, twin) = (error(&direct), error(&box_filter));
        assert!(found < 0.02, "{case:?}: {found}");
        assert!(twin > 0.05, "{case:?}: {twin}");
    }
}

#[test]
fn samples_under_a_gaussian_have_their_density() {
    let map = gaussian_map(16, [0.4, 0.3], 3);
    let model = model(0.05, Normalization::Projected);
    let direct = gaussian_direct(&map, model, 0.5);
    let box_filter = Direct::new(map.clone(), model);
    for case in GAUSSIAN_FOOTPRINTS {
        let footprint = footprint_of(case, 16, 1.0);
        let test = |method: &Direct| {
            let density = |h| method.density(&footprint, h);
            chi_square(&direct, density, &footprint, (64, [0..64, 0..64]), 5)
        };
        let result = test(&direct);
        assert!(is_plausible(result), "{case:?}: {result:?}");
        if case == GAUSSIAN_FOOTPRINTS[1] {
            let twin = test(&box_filter);
            assert!(!is_plausible(twin), "{case:?}: {twin:?}");
        }
    }
    // A point has one texel, whatever the filter.
    let point = footprint(16, 0.0);
    let h = Vec3::new(0.1, 0.05, 0.99).normalize();
    assert_eq!(direct.ndf(&point, h), box_filter.ndf(&point, h));
}
