//! Errors of refined maps against the interpolated surface: the table of `glints::refinement`.
//!
//! A line for each map, roughness and refinement, with the step x of the table, and for footprints of one and of four
//! texels' width the relative L1 errors of the distribution of normals of
//!
//! * `direct`, the direct sum over the refined map,
//! * `ibm`, the compact inverse bin map of it,
//! * `widened`, the direct sum with lobes widened by the variance of normals inside the texels, averaged over the map.
//!
//! ```text
//! cargo run --release -p glints --example interpolation
//! ```

use std::f64::consts::{SQRT_2, TAU};

use glam::{DVec2, Vec3};
use glints::error::Result;
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint::Footprint;
use glints::methods::Method;
use glints::methods::compact::CompactBinMap;
use glints::methods::direct::Direct;
use glints::microfacet::{Distribution, Flake};
use glints::normal_map::NormalMap;
use glints::refinement::steps;
use rayon::prelude::*;

/// Texels of the maps' sides.
const SIDE: u32 = 64;

/// What stands for the interpolated surface: so many texels for each texel and side.
const FINEST: u32 = 16;

const FOOTPRINTS: u64 = 32;
const POINTS: u32 = 64;

/// SplitMix64.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn point(&mut self) -> DVec2 {
        DVec2::new(self.uniform(), self.uniform())
    }
}

fn main() -> Result<()> {
    println!(
        "map        alpha   k     x |  1 texel: direct    ibm  widened |  4 texels: direct    ibm  widened"
    );
    for (name, map) in [
        ("smooth", waves(16.0, DVec2::splat(0.1), 0.0)?),
        ("bumpy", waves(6.0, DVec2::splat(0.1), 0.0)?),
        ("noise", waves(16.0, DVec2::ZERO, 0.3)?),
        ("brushed", waves(16.0, DVec2::new(0.003, 0.1), 0.02)?),
        ("scratches", scratches()?),
    ] {
        for alpha in [0.015, 0.04, 0.1] {
            let truth = Direct::new(map.refined(FINEST)?, model(alpha)?);
            for refinement in [1, 2, 3, 4, 8] {
                line(name, &map, alpha, refinement, &truth)?;
            }
        }
    }
    Ok(())
}

fn line(name: &str, map: &NormalMap, alpha: f64, refinement: u32, truth: &Direct) -> Result<()> {
    let [u, v] = steps(map).map(|step| step / f64::from(refinement));
    // Normals inside a texel have a twelfth of the squared step as variance, along each of its axes.
    let widened = (alpha * alpha + (u * u + v * v) / 12.0).sqrt();
    let refined = map.refined(refinement)?;
    let methods: [Box<dyn Method>; 3] = [
        Box::new(Direct::new(refined.clone(), model(alpha)?)),
        Box::new(CompactBinMap::new(&refined, model(alpha)?)),
        Box::new(Direct::new(refined, model(widened)?)),
    ];
    let [near, far] = [1.0, 4.0].map(|width| {
        methods
            .each_ref()
            .map(|method| error(method.as_ref(), truth, width))
    });
    println!(
        "{name:<9} {alpha:>6} {refinement:>3} {:>5.2} | {:>16.3} {:>6.3} {:>8.3} | {:>17.3} {:>6.3} {:>8.3}",
        u.max(v) * SQRT_2 / alpha,
        near[0],
        near[1],
        near[2],
        far[0],
        far[1],
        far[2]
    );
    Ok(())
}

fn model(alpha: f64) -> Result<FlakeModel> {
    Ok(FlakeModel {
        flake: Flake::new(Distribution::Beckmann, alpha as f32)?,
        normalization: Normalization::Projected,
    })
}

/// The integral of `|D - D_truth| cos`, that of `D_truth cos` being one, averaged over square footprints of a width in
/// texels, at random places and turned at random. Half the points are drawn from each of the two.
fn error(method: &dyn Method, truth: &dyn Method, width: f64) -> f64 {
    let of_footprint = |index: u64| {
        let mut random = Random(index * 7919 + 1);
        let (center, edge) = (random.point(), DVec2::from_angle(TAU * random.uniform()) * width);
        let footprint = |method: &dyn Method| {
            let (columns, rows) = method.map_size();
            let side = f64::from(columns);
            let a = edge * (side / f64::from(SIDE));
            Footprint::in_texels(columns, rows, center * side, a, a.perp())
        };
        let both = [(method, footprint(method)), (truth, footprint(truth))];
        let mut sum = 0.0;
        for point in 0..POINTS {
            let u = std::array::from_fn(|_| random.uniform() as f32);
            let (source, footprint) = &both[point as usize % 2];
            if let Some(h) = source.sample(footprint, u) {
                let density = both.iter().map(|(m, f)| 0.5 * m.density(f, h)).sum::<f32>();
                let [found, expected] = both.each_ref().map(|(m, f)| m.ndf(f, h));
                sum += f64::from((found - expected).abs() * h.z / density);
            }
        }
        sum / f64::from(POINTS)
    };
    let errors: Vec<f64> = (0..FOOTPRINTS).into_par_iter().map(of_footprint).collect();
    errors.iter().sum::<f64>() / FOOTPRINTS as f64
}

/// A Gaussian random surface from plane waves that repeat with the map: wavelengths in texels, standard deviations of
/// the slopes, and the width of uniform noise on them.
fn waves(wavelength: f64, deviations: DVec2, noise: f64) -> Result<NormalMap> {
    let mut random = Random(3);
    let waves: Vec<(DVec2, f64)> = (0..200)
        .map(|_| {
            let frequency = (-(1.0 - random.uniform()).ln()).sqrt() * f64::from(SIDE) / wavelength;
            let wave = (DVec2::from_angle(TAU * random.uniform()) * frequency).round();
            (wave, TAU * random.uniform())
        })
        .collect();
    let slope = |p: DVec2| -> DVec2 {
        let terms = waves.iter().map(|(k, phase)| *k * (TAU * k.dot(p) + phase).cos());
        terms.sum()
    };
    let slopes: Vec<DVec2> = positions().map(|p| slope(p / f64::from(SIDE))).collect();
    let variance = slopes.iter().map(|s| *s * *s).sum::<DVec2>() / slopes.len() as f64;
    let scale = deviations / DVec2::new(variance.x.sqrt(), variance.y.sqrt());
    let normals = slopes
        .into_iter()
        .map(|s| s * scale + noise * (random.point() - 0.5));
    map("waves", normals)
}

/// Straight grooves of four texels' width.
fn scratches() -> Result<NormalMap> {
    let mut random = Random(5);
    let lines: Vec<(DVec2, DVec2)> = (0..12)
        .map(|_| {
            (
                DVec2::from_angle(TAU * random.uniform()),
                random.point() * f64::from(SIDE),
            )
        })
        .collect();
    let slope = |p: DVec2| -> DVec2 {
        let slopes = lines.iter().map(|(direction, start)| {
            let across = direction.perp_dot(p - *start);
            let groove = if across.abs() < 2.0 {
                (0.25 * TAU * across).sin()
            } else {
                0.0
            };
            direction.perp() * (0.25 * groove)
        });
        slopes.sum()
    };
    map("scratches", positions().map(slope))
}

fn positions() -> impl Iterator<Item = DVec2> {
    (0..SIDE * SIDE).map(|i| DVec2::new((i % SIDE).into(), (i / SIDE).into()))
}

fn map(name: &str, slopes: impl Iterator<Item = DVec2>) -> Result<NormalMap> {
    let normals: Vec<Vec3> = slopes.map(|s| (-s).as_vec2().extend(1.0)).collect();
    NormalMap::from_normals(name, SIDE, SIDE, &normals)
}
