use std::sync::OnceLock;

use super::*;
use crate::hash::mix;
use crate::microfacet::{Distribution, Flake};
use approx::assert_relative_eq;

pub fn model() -> FlakeModel {
    FlakeModel {
        flake: Flake::new(Distribution::Beckmann, 0.03).unwrap(),
        normalization: Normalization::Projected,
    }
}

/// A number in [0, 1) for each index.
pub fn random(index: usize, which: u64) -> f32 {
    (mix((index as u64 * 0x9e37_79b9_7f4a_7c15) ^ (which << 50)) >> 40) as f32 / 16_777_216.0
}

/// Waves with noise.
pub fn noisy_map(width: u32, height: u32) -> NormalMap {
    let normals: Vec<Vec3> = (0..(width * height) as usize)
        .map(|i| {
            let (x, y) = ((i % width as usize) as f32, (i / width as usize) as f32);
            let wave = Vec2::new((0.3 * x).sin() * 0.2, (0.17 * y).cos() * 0.25);
            let noise = Vec2::new(random(i, 1), random(i, 2)) - 0.5;
            (wave + 0.25 * noise).extend(1.0)
        })
        .collect();
    NormalMap::from_normals("noisy", width, height, &normals).unwrap()
}

fn small_options() -> Options {
    Options {
        resolution: 64,
        stride: 8,
        rank: 16,
        ..Options::default()
    }
}

/// Neither square nor a multiple of the stride.
fn small() -> &'static (NormalMap, Tensor) {
    static SMALL: OnceLock<(NormalMap, Tensor)> = OnceLock::new();
    SMALL.get_or_init(|| {
        let map = noisy_map(100, 68);
        let (tensor, _) = Tensor::new(&map, model(), &small_options(), &|_| ()).unwrap();
        (map, tensor)
    })
}

fn footprint(size: f64) -> Footprint {
    let edge = glam::DVec2::new(size, 0.2 * size);
    Footprint::in_texels(100, 68, glam::DVec2::new(31.0, 17.0), edge, 0.9 * edge.perp())
}

/// Points of the disk, `count` of them.
fn points(count: usize) -> impl Iterator<Item = Vec2> {
    (0..count).map(|i| 0.6 * (2.0 * Vec2::new(random(i, 3), random(i, 4)) - 1.0))
}

fn half(p: Vec2) -> Vec3 {
    p.extend((1.0 - p.length_squared()).sqrt())
}

#[test]
fn values_are_those_of_the_factors() {
    let (_, tensor) = small();
    let images = &tensor.images;
    let mut pixels = [0.0; PIXELS];
    let mut checked = 0;
    for image in [0, 17, images.geometry.images - 1] {
        for (index, group) in images.groups().enumerate() {
            let Some(row) = images.row_of(index, image) else {
                continue;
            };
            images.reconstruct(&group, row, &mut pixels);
            for (i, &pixel) in pixels.iter().enumerate() {
                let block = u32::from(group.block);
                let column = block % 4 * 16 + i as u32 % 16;
                let row = block / 4 * 16 + i as u32 / 16;
                let value = images.raw(image, column, row).max(0.0);
                assert_relative_eq!(value, pixel, epsilon = 1e-3, max_relative = 1e-4);
                checked += 1;
            }
        }
    }
    assert!(checked > 1000);
}

#[test]
fn distributions_integrate_to_one() {
    let (_, tensor) = small();
    for size in [40.0, 60.0, 200.0] {
        let footprint = footprint(size);
        assert_eq!(tensor.select(&footprint).exact, 0.0);
        const SIDE: usize = 512;
        let sum: f64 = (0..SIDE * SIDE)
            .map(|i| (Vec2::new((i % SIDE) as f32, (i / SIDE) as f32) + 0.5) * (2.0 / SIDE as f32) - 1.0)
            .filter(|p| p.length_squared() < 1.0)
            .map(|p| f64::from(tensor.ndf(&footprint, half(p))))
            .sum();
        let integral = sum * (2.0 / SIDE as f64).powi(2);
        assert!((integral - 1.0).abs() < 2e-3, "{size}: {integral}");
    }
}

#[test]
fn means_over_rectangles_are_means_of_points() {
    let (_, tensor) = small();
    let images = &tensor.images;
    let blend = tensor.select(&footprint(50.0)).images;
    let (mut filled, mut shifted) = (0, 0);
    for (i, (low, extent)) in points(60).zip(points(120).skip(60)).enumerate() {
        // From less than a pixel to several blocks.
        let high = low + extent.abs() * [0.03, 0.2, 1.0][i % 3] + 1e-3;
        let mean = images.raw_mean(&blend, low, high);
        // Gauss-Legendre of two points in each cell between the centres of pixels is exact for the products of lines.
        let sides = [0, 1].map(|axis| nodes(low[axis], high[axis], images.geometry.pixel()));
        let mut sum = 0.0;
        for (y, wy) in &sides[1] {
            for (x, wx) in &sides[0] {
                sum += wx * wy * f64::from(images.raw_density(&blend, Vec2::new(*x as f32, *y as f32)));
            }
        }
        let area = f64::from((high - low).x) * f64::from((high - low).y);
        assert!(
            (f64::from(mean) - sum / area).abs() < 2e-4 * (1.0 + sum.abs() / area),
            "{low} {high}: {mean} {}",
            sum / area
        );
        assert_eq!(images.mean(&blend, low, high), mean.max(0.0));
        // Summed-area tables that are off by a pixel would be found.
        let pixel = images.geometry.pixel();
        let wrong = images.raw_mean(&blend, low + pixel * Vec2::X, high + pixel * Vec2::X);
        let off = (f64::from(wrong) - sum / area).abs();
        if sum / area > 0.01 {
            filled += 1;
            shifted += usize::from(off > 2e-4 * (1.0 + sum.abs() / area));
        }
    }
    assert!(filled > 20 && 10 * shifted > 9 * filled, "{shifted} of {filled}");
}

/// Also where points are the exact method's: light that is averaged over directions must not vanish there.
#[test]
fn every_footprint_has_range_queries() {
    let (_, tensor) = small();
    let over = |size: f64, low, high| tensor.ndf_over(&footprint(size), low, high).unwrap();
    for size in [0.0, 0.5, 4.0, 12.0, 30.0, 400.0] {
        // The clamped negative values are missing from sums over a rectangle.
        let whole = 4.0 * over(size, Vec2::splat(-1.0), Vec2::splat(1.0));
        assert_relative_eq!(whole, 1.0, epsilon = 0.03);
    }
    // Below the images' footprints, the mean of what single directions have, and not the images'.
    let (low, high) = (Vec2::new(-0.1, 0.0), Vec2::new(0.1, 0.2));
    const SIDE: usize = 100;
    for size in [0.0, 0.5, 4.0, 12.0] {
        let points = (0..SIDE * SIDE).map(|i| Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5));
        let sum: f64 = points
            .map(|p| {
                let h = low + p / SIDE as f32 * (high - low);
                f64::from(tensor.ndf(&footprint(size), h.extend((1.0 - h.length_squared()).sqrt())))
            })
            .sum();
        let expected = sum / (SIDE * SIDE) as f64;
        assert_relative_eq!(f64::from(over(size, low, high)), expected, max_relative = 0.04);
    }
    assert!((over(400.0, low, high) / over(0.5, low, high) - 1.0).abs() > 0.1);
}

/// Quadrature nodes with weights over [low, high], cut where the centres of pixels are.
fn nodes(low: f32, high: f32, pixel: f32) -> Vec<(f64, f64)> {
    let (low, high, pixel) = (f64::from(low), f64::from(high), f64::from(pixel));
    let mut cuts = vec![low];
    let mut center = ((low / pixel - 0.5).floor() + 1.5) * pixel;
    while center < high {
        if center > low {
            cuts.push(center);
        }
        center += pixel;
    }
    cuts.push(high);
    cuts.windows(2)
        .flat_map(|w| {
            let (middle, half) = (0.5 * (w[0] + w[1]), 0.5 * (w[1] - w[0]));
            [-1.0, 1.0].map(|s: f64| (middle + s * half / 3_f64.sqrt(), half))
        })
        .collect()
}

/// Pearson's statistic of samples against the density in cells of the disk, and the degrees of freedom. `density` may be wrong.
fn chi_square(
    tensor: &Tensor,
    footprint: &Footprint,
    count: usize,
    density: impl Fn(Vec2) -> f32,
) -> (f64, f64) {
    // Cells of half a pixel.
    const SIDE: usize = 128;
    const POINTS: usize = 4;
    let cell = 2.0 / SIDE as f32;
    let mut expected = vec![0.0; SIDE * SIDE];
    for (i, expected) in expected.iter_mut().enumerate() {
        for j in 0..POINTS * POINTS {
            let place = Vec2::new((j % POINTS) as f32, (j / POINTS) as f32) + 0.5;
            let corner = Vec2::new((i % SIDE) as f32, (i / SIDE) as f32);
            let p = (corner + place / POINTS as f32) * cell - 1.0;
            if p.length_squared() < 1.0 {
                *expected += f64::from(density(p) * cell * cell) / (POINTS * POINTS) as f64;
            }
        }
    }
    let mut counts = vec![0.0_f64; SIDE * SIDE];
    for i in 0..count {
        let u = [10, 11, 12, 13].map(|which| random(i, which));
        if let Some(h) = tensor.sample(footprint, u) {
            let cell = ((h.truncate() + 1.0) / cell).floor();
            counts[(cell.y as usize * SIDE + cell.x as usize).min(SIDE * SIDE - 1)] += 1.0;
        }
    }
    let (mut statistic, mut cells) = (0.0, 0.0);
    let (mut rest_counted, mut rest_expected) = (0.0, 0.0);
    for (counted, expected) in counts.iter().zip(expected.iter().map(|e| e * count as f64)) {
        if expected < 8.0 {
            rest_counted += counted;
            rest_expected += expected;
        } else {
            statistic += (counted - expected).powi(2) / expected;
            cells += 1.0;
        }
    }
    if rest_expected > 8.0 {
        statistic += (rest_counted - rest_expected).powi(2) / rest_expected;
        cells += 1.0;
    }
    (statistic, cells - 1.0)
}

/// Five standard deviations above the mean of the statistic.
fn agrees((statistic, degrees): (f64, f64)) -> bool {
    assert!(degrees > 200.0, "{degrees}");
    statistic < degrees + 5.0 * (2.0 * degrees).sqrt()
}

#[test]
fn the_histogram_of_samples_is_the_distribution() {
    let (_, tensor) = small();
    // One within the images, one that the exact method shares, an elongated one that wraps.
    let edge = glam::DVec2::new(75.0, 10.0);
    let elongated = Footprint::in_texels(100, 68, glam::DVec2::new(99.0, 1.0), edge, 0.5 * edge.perp());
    let count = samples();
    for footprint in [footprint(60.0), footprint(7.5), elongated] {
        let density = |p: Vec2| tensor.ndf(&footprint, half(p));
        let result = chi_square(tensor, &footprint, count, density);
        assert!(agrees(result), "{result:?}");
    }
}

/// Figure 9 has 10 million.
fn samples() -> usize {
    std::env::var("GLINTS_SAMPLES").map_or(400_000, |n| n.parse().unwrap())
}

#[test]
fn a_wrong_density_is_found() {
    let (_, tensor) = small();
    let images = &tensor.images;
    let footprint = footprint(60.0);
    let blend = tensor.select(&footprint).images;
    let count = samples();
    let right = |p: Vec2| images.density(&blend, p);
    assert!(agrees(chi_square(tensor, &footprint, count, right)));

    // Too much by a twentieth in one half of the disk, too little in the other.
    let wrong_pdf = |p: Vec2| images.density(&blend, p) * if p.x > 0.0 { 1.05 } else { 0.95 };
    // The blend of the wrong level.
    let other = tensor.select(&self::footprint(85.0)).images;
    let wrong_level = |p: Vec2| images.density(&other, p);
    // Pixels without interpolation.
    let pixel = images.geometry.pixel();
    let uninterpolated = |p: Vec2| images.density(&blend, ((p / pixel).floor() + 0.5) * pixel);
    for wrong in [&wrong_pdf as &dyn Fn(Vec2) -> f32, &wrong_level, &uninterpolated] {
        let result = chi_square(tensor, &footprint, count, wrong);
        assert!(!agrees(result), "{result:?}");
    }
}

#[test]
fn the_switch_to_the_exact_method_is_continuous() {
    let (_, tensor) = small();
    let finest = 2.0 * select::effective(&tensor.images.geometry);
    for size in [0.5 * finest, 0.75 * finest, finest, 2.0 * finest, 3.7 * finest] {
        // Footprints with equal axes, whose deviation is half their edge.
        let at = |size: f64| {
            let edge = glam::DVec2::new(size, 0.0);
            Footprint::in_texels(100, 68, glam::DVec2::new(31.0, 17.0), edge, edge.perp())
        };
        let (below, above) = (at(size * 0.9999), at(size * 1.0001));
        let (mut difference, mut sum) = (0.0, 0.0);
        for p in points(3000) {
            let values = [below, above].map(|f| tensor.ndf(&f, half(p)));
            difference += (values[0] - values[1]).abs();
            sum += values[0];
        }
        assert!(difference < 2e-3 * sum, "{size}: {difference} of {sum}");
    }
}

#[test]
fn the_result_is_the_same_with_any_number_of_threads() {
    let map = noisy_map(64, 40);
    let saved = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.glints");
        pool.install(|| {
            let (tensor, _) = Tensor::new(&map, model(), &small_options(), &|_| ()).unwrap();
            tensor.save(&map, &path).unwrap();
        });
        std::fs::read(path).unwrap()
    };
    assert!(saved(1) == saved(3));
}

#[test]
fn what_is_loaded_answers_as_what_was_saved() {
    let (map, tensor) = small();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.glints");
    tensor.save(map, &path).unwrap();
    assert!(is_saved(&path));
    let (loaded, loaded_map) = Tensor::load(&path).unwrap();
    assert_eq!(loaded.bytes(), tensor.bytes());
    assert_relative_eq!(loaded_map.normal(5, 7).x, map.normal(5, 7).x, epsilon = 2e-5);
    for size in [0.0, 3.0, 8.0, 60.0, 1000.0] {
        let footprint = footprint(size);
        for p in points(50) {
            assert_eq!(loaded.ndf(&footprint, half(p)), tensor.ndf(&footprint, half(p)));
        }
    }
    let header = read_header(&path).unwrap();
    assert_eq!((header.map, header.resolution, header.stride), ((100, 68), 64, 8));
}

#[test]
fn precomputations_are_found_again() {
    let map = noisy_map(40, 30);
    let folder = tempfile::tempdir().unwrap();
    let cached = |map: &NormalMap, options: &Options| {
        Tensor::cached(map, model(), options, folder.path(), &|_| ()).unwrap()
    };
    let options = small_options();
    let (first, report) = cached(&map, &options);
    assert!(report.is_some());
    let (second, report) = cached(&map, &options);
    assert!(report.is_none());
    assert_eq!(first.bytes(), second.bytes());
    let other = Options { rank: 4, ..options };
    assert!(cached(&map, &other).1.is_some());
    assert!(cached(&noisy_map(30, 40), &other).1.is_some());
}

#[test]
fn the_error_against_uncompressed_images_is_the_ranks() {
    let map = noisy_map(64, 48);
    let uncompressed = Uncompressed::new(&map, model(), &small_options()).unwrap();
    let difference = |rank| {
        let options = Options {
            rank,
            ..small_options()
        };
        let (tensor, _) = Tensor::new(&map, model(), &options, &|_| ()).unwrap();
        let (mut difference, mut sum) = (0.0, 0.0);
        for p in points(2000) {
            let expected = uncompressed.ndf(&footprint(40.0), half(p));
            difference += (tensor.ndf(&footprint(40.0), half(p)) - expected).abs();
            sum += expected;
        }
        difference / sum
    };
    let (low, high) = (difference(2), difference(32));
    assert!(high < 0.01 && low > 5.0 * high, "{low} {high}");
}

#[test]
fn more_images_than_can_be_numbered_are_refused() {
    let options = Options {
        stride: 4,
        ..Options::default()
    };
    // A region of the second map would have more than 65535 images.
    assert!(options.check_for((4096, 4096)).is_ok());
    let error = options.check_for((8192, 8192)).unwrap_err().to_string();
    assert!(error.contains("stride") && error.contains("larger"), "{error}");
    for size in [(4096, 4096), (65_535, 500)] {
        let geometry = pyramid::Geometry::new(size, 256, 4);
        let members = images::Members::new(&geometry);
        assert!(members.images.iter().all(|images| images.len() <= 1 << 16));
    }
}
