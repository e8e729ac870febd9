use super::kernel::lattice_sum;
use super::*;
use crate::flakes::{FlakeModel, Normalization};
use crate::gaussian_footprint::Symmetric;
use crate::methods::direct::Direct;
use crate::microfacet::{Distribution, Flake};
use approx::assert_relative_eq;

const FLAT: Elements = Elements::Flat;
const CURVED: Elements = Elements::Curved { refinement: 1 };

/// A map that bends by `bend` slopes a texel, not square and no multiple of a block.
fn wavy_map(bend: f32) -> NormalMap {
    let (width, height) = (80, 70);
    let wave = |column: u32, row: u32| {
        let (u, v) = (column as f32 / width as f32, row as f32 / height as f32);
        let phase = std::f32::consts::TAU;
        Vec3::new(
            bend * 9.0 * (3.0 * phase * u + 0.4 * (phase * v).sin()).sin(),
            bend * 7.0 * (2.0 * phase * v + 0.3 * (phase * u).cos()).cos(),
            1.0,
        )
    };
    let normals: Vec<Vec3> = (0..width * height).map(|i| wave(i % width, i / width)).collect();
    NormalMap::from_normals("wavy", width, height, &normals).unwrap()
}

fn build(map: &NormalMap, elements: Elements, intrinsic: f32) -> Yan16 {
    let options = Options {
        elements,
        intrinsic,
        ..Options::default()
    };
    Yan16::new(map, options).unwrap()
}

fn footprint(map: &NormalMap, center: DVec2, width: f64) -> Footprint {
    let a = DVec2::from_angle(0.4) * width;
    Footprint::in_texels(map.width(), map.height(), center, a, 0.6 * a.perp() + 0.2 * a)
}

/// Integral over u on a fine grid of `G_P(u) N(u, s)`, straight from the definition; the map repeats.
fn integrated(map: &NormalMap, yan: &Yan16, footprint: &Footprint, s: Vec2) -> f64 {
    let q = GaussianFootprint::new(footprint, 0.5);
    let p = q.covariance(0.0);
    let (inverse, step) = (p.inverse(), 0.1);
    let sigma_h = SEED_DEVIATION * yan.spacing;
    let sigma_r = f64::from(yan.options.intrinsic);
    let reach = (6.0 * p.xx.max(p.yy).sqrt() / step).ceil() as i64;
    let mut sum = 0.0;
    for iy in -reach..=reach {
        for ix in -reach..=reach {
            let d = DVec2::new(ix as f64, iy as f64) * step;
            let g = (-0.5 * inverse.form(d)).exp() / (TAU * p.determinant().sqrt());
            if g < 1e-9 {
                continue;
            }
            let u = q.center() + d;
            let near = (u / yan.spacing - 0.5).round();
            for k in 0..49 {
                let seed = near + DVec2::new((k % 7 - 3) as f64, (k / 7 - 3) as f64);
                let v = u - (seed + 0.5) * yan.spacing;
                let place = (-0.5 * v.length_squared() / sigma_h.powi(2)).exp() / (TAU * sigma_h.powi(2));
                let grid = DVec2::new(map.width().into(), map.height().into()) / yan.spacing;
                let cell = seed.rem_euclid(grid);
                let (normal, jacobian) = yan.tree.element_at(cell.x as u32, cell.y as u32);
                let mean = normal + apply(&jacobian, v.as_vec2());
                let r = (s - mean).as_dvec2().length_squared() / sigma_r.powi(2);
                sum += g * yan.spacing.powi(2) * place * (-0.5 * r).exp() / (TAU * sigma_r.powi(2));
            }
        }
    }
    sum * step * step
}

#[test]
fn closed_form_equals_the_integral() {
    let map = wavy_map(0.02);
    for elements in [FLAT, CURVED, Elements::Curved { refinement: 2 }] {
        let yan = build(&map, elements, 0.02);
        for (center, width) in [(DVec2::new(30.3, 22.8), 2.5), (DVec2::new(79.6, 0.7), 7.0)] {
            let footprint = footprint(&map, center, width);
            for offset in [Vec2::ZERO, Vec2::new(0.015, -0.02)] {
                let (column, row) = footprint.texel();
                let s = projected(map.normal(column, row)) + offset;
                let h = s.extend((1.0 - s.length_squared()).sqrt());
                let expected = integrated(&map, &yan, &footprint, s);
                assert!(expected > 1.0, "{expected}");
                let found = f64::from(yan.ndf(&footprint, h));
                // The seeds are normalized (up to 12 % under a point, nothing here), and tails are cut.
                assert_relative_eq!(found, expected, max_relative = 0.01);
            }
        }
    }
}

#[test]
fn elements_under_no_footprint_sum_to_one() {
    let q = Symmetric {
        xx: SEED_DEVIATION.powi(2),
        xy: 0.0,
        yy: SEED_DEVIATION.powi(2),
    };
    for center in [DVec2::ZERO, DVec2::new(0.5, 0.5), DVec2::new(0.2, 0.9)] {
        let naive: f64 = (0..400)
            .map(|i| {
                let d = DVec2::new((i % 20 - 10) as f64 + 0.5, (i / 20 - 10) as f64 + 0.5) - center;
                (-0.5 * q.inverse().form(d)).exp() / (TAU * q.determinant().sqrt())
            })
            .sum();
        assert_relative_eq!(lattice_sum(&q, center, 1.0), naive, max_relative = 1e-5);
    }
}

#[test]
fn the_largest_row_bounds_every_row() {
    for i in 0..1000 {
        let x = f64::from(i) / 1000.0;
        let row: f64 = (-5..=6)
            .map(|k| {
                (-0.5 * ((f64::from(k) - x) / SEED_DEVIATION).powi(2)).exp() / (SEED_DEVIATION * TAU.sqrt())
            })
            .sum();
        assert!(row <= LARGEST_ROW && row > 0.94, "{x}: {row}");
    }
}

#[test]
fn flat_elements_under_a_wide_footprint_agree_with_the_direct_sum() {
    let map = wavy_map(0.03);
    let intrinsic = 0.03;
    let yan = build(&map, FLAT, intrinsic);
    let model = FlakeModel {
        flake: Flake::new(Distribution::default(), intrinsic * std::f32::consts::SQRT_2).unwrap(),
        normalization: Normalization::Projected,
    };
    let direct = Direct::new(map.clone(), model);
    let a = DVec2::new(80.0 * 14.0, 0.0);
    let whole = Footprint::in_texels(80, 70, DVec2::splat(3.0), a, a.perp());
    assert_eq!(yan.kernel(&whole).reach, Reach::Whole);
    for h in [
        Vec3::Z,
        Vec3::new(0.1, -0.05, 1.0).normalize(),
        Vec3::new(-0.2, 0.1, 1.0).normalize(),
    ] {
        assert_relative_eq!(yan.ndf(&whole, h), direct.ndf(&whole, h), max_relative = 0.03);
    }
}

#[test]
fn refined_curved_elements_tend_to_the_interpolated_map() {
    // Under a point, the lobe of the interpolated normal: what is left is the seeds' blur, H^2 at a time.
    let map = wavy_map(0.02);
    let intrinsic = 0.02_f32;
    let center = DVec2::new(31.2, 40.9);
    let point = Footprint::in_texels(80, 70, center, DVec2::ZERO, DVec2::ZERO);
    let s = map.interpolated(center) + Vec2::new(0.01, 0.015);
    let h = s.extend((1.0 - s.length_squared()).sqrt());
    let exact = (-0.5 * (0.01_f32.powi(2) + 0.015_f32.powi(2)) / intrinsic.powi(2)).exp()
        / (std::f32::consts::TAU * intrinsic.powi(2));
    let error = |elements| (build(&map, elements, intrinsic).ndf(&point, h) / exact - 1.0).abs();
    assert!(error(FLAT) > 0.05, "{}", error(FLAT));
    assert!(error(Elements::Curved { refinement: 4 }) < 0.01);
}

#[test]
fn noise_asks_for_more_elements_than_a_smooth_map() {
    assert_eq!(resolving_refinement(&wavy_map(0.02)), 1);
    let noise: Vec<Vec3> = (0..4096_u64)
        .map(|i| {
            let mut hash = Hash(i);
            Vec3::new(hash.uniform() as f32 - 0.5, hash.uniform() as f32 - 0.5, 1.0)
        })
        .collect();
    let noise = NormalMap::from_normals("noise", 64, 64, &noise).unwrap();
    assert_eq!(resolving_refinement(&noise), 2);
}

#[test]
fn parameters_outside_their_domain_are_refused() {
    let map = wavy_map(0.02);
    let message = |options: Options| Yan16::new(&map, options).map(|_| ()).unwrap_err().to_string();
    for intrinsic in [0.0, -1.0, f32::NAN, 0.8] {
        assert!(
            message(Options {
                intrinsic,
                ..Options::default()
            })
            .contains("\"intrinsic\"")
        );
    }
    for footprint_sigma in [0.0, f32::INFINITY, f32::NAN] {
        assert!(
            message(Options {
                footprint_sigma,
                ..Options::default()
            })
            .contains("\"footprint_sigma\"")
        );
    }
    for refinement in [0, 17] {
        let elements = Elements::Curved { refinement };
        assert!(
            message(Options {
                elements,
                ..Options::default()
            })
            .contains("\"refinement\"")
        );
    }
}

#[test]
fn memory_is_as_documented() {
    let map = wavy_map(0.02);
    let texels = (map.width() * map.height()) as usize;
    for (elements, bytes) in [
        (FLAT, 14),
        (CURVED, 30),
        (Elements::Curved { refinement: 2 }, 120),
    ] {
        let found = build(&map, elements, 0.005).structure_bytes() as f64 / (bytes * texels) as f64;
        // Partial blocks of a small map have fuller boxes.
        assert!((0.98..1.2).contains(&found), "{elements:?}: {found}");
    }
}
