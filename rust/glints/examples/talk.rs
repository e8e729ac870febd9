//! Memory and build time of specular bin maps of the sizes in Figure 1 of the 2020 talk, one JSON object a line:
//! `{"name", "value", "unit", "baseline", "baseline_value", "ratio", "params"}` in bytes and seconds.
//!
//! The talk's maps are not published. These have the same sizes and the same kind of normals: metallic flakes for
//! car paint (127^2 bins), and scratched metal (63^2 and 255^2). The 8K map takes 3 GB of working memory.
//!
//! ```text
//! cargo run --release -p glints --example talk
//! ```

use std::time::Instant;

use clap::Parser;
use glam::Vec3;
use glints::error::Result;
use glints::flakes::Normalization;
use glints::methods::Method;
use glints::methods::inverse_bin_map::{Binning, SpecularBinMap, SpecularOptions};
use glints::normal_map::NormalMap;
use serde_json::json;

#[derive(Parser)]
struct Arguments {
    /// Divides the sides of the maps, for a quick look; the talk's figures are then divided by its square.
    #[arg(long, default_value_t = 1)]
    reduction: u32,
}

/// One picture of Figure 1.
struct Picture {
    surface: &'static str,
    side: u32,
    bins: u32,
    megabytes: f64,
    normals: fn(u32) -> Vec<Vec3>,
}

const PICTURES: [Picture; 3] = [
    Picture {
        surface: "car paint",
        side: 4096,
        bins: 127,
        megabytes: 144.0,
        normals: car_paint,
    },
    Picture {
        surface: "scratches",
        side: 4096,
        bins: 63,
        megabytes: 144.0,
        normals: scratches,
    },
    Picture {
        surface: "scratches",
        side: 8192,
        bins: 255,
        megabytes: 576.0,
        normals: scratches,
    },
];

fn main() -> Result<()> {
    let Arguments { reduction } = Arguments::parse();
    for picture in &PICTURES {
        measure(picture, reduction.max(1))?;
    }
    Ok(())
}

fn measure(picture: &Picture, reduction: u32) -> Result<()> {
    let side = picture.side / reduction;
    let map = NormalMap::from_normals(picture.surface, side, side, &(picture.normals)(side))?;
    let options = SpecularOptions {
        bins: picture.bins,
        binning: Binning::EqualSolidAngle,
        leaf_size: None,
        normalization: Normalization::Projected,
    };
    let start = Instant::now();
    let method = SpecularBinMap::new(&map, options)?;
    let seconds = start.elapsed().as_secs_f64();
    let row = |name, value: f64, unit, baseline_value: f64| {
        let params = json!({ "map": picture.surface, "side": side, "bins": picture.bins });
        println!(
            "{}",
            json!({
                "name": name, "value": value, "unit": unit, "baseline": "2020 talk, Figure 1",
                "baseline_value": baseline_value, "ratio": value / baseline_value, "params": params,
            })
        );
    };
    let published = 1e6 * picture.megabytes / f64::from(reduction).powi(2);
    row(
        "specular/memory",
        method.structure_bytes() as f64,
        "bytes",
        published,
    );
    // The talk's times are those of whole renderings.
    row("specular/build", seconds, "seconds", f64::NAN);
    Ok(())
}

/// Flakes of about 3 x 3 texels, each a jittered cell with one normal; slopes of standard deviation 0.2.
fn car_paint(side: u32) -> Vec<Vec3> {
    const PITCH: u32 = 3;
    (0..side * side)
        .map(|i| {
            let jitter = hash(i, 1);
            let (x, y) = (i % side + (jitter & 1), i / side + (jitter >> 1 & 1));
            tilted(0.2, hash(x / PITCH, y / PITCH))
        })
        .collect()
}

/// A nearly flat ground with straight scratches, `side^2 / 2000` of them: 3 texels wide grooves whose normal turns
/// from one flank to the other.
fn scratches(side: u32) -> Vec<Vec3> {
    let mut normals: Vec<Vec3> = (0..side * side).map(|i| tilted(0.01, hash(i, 2))).collect();
    let uniform = |word: u32| f64::from(word) / 4_294_967_296.0;
    for scratch in 0..side * side / 2000 {
        let draw = |k: u32| uniform(hash(scratch, 3 + k));
        let (sin, cos) = (std::f64::consts::TAU * draw(0)).sin_cos();
        let start = [draw(1) * f64::from(side), draw(2) * f64::from(side)];
        let depth = 0.2 + 0.6 * draw(3);
        let length = 60.0 + 200.0 * draw(4);
        for step in 0..length as u32 {
            for across in -1..=1_i32 {
                let (along, across) = (f64::from(step), f64::from(across));
                let wrap = |p: f64| p.rem_euclid(f64::from(side)) as u32 % side;
                let column = wrap(start[0] + along * cos - across * sin);
                let row = wrap(start[1] + along * sin + across * cos);
                let slope = depth * across;
                normals[(row * side + column) as usize] =
                    Vec3::new((-slope * sin) as f32, (slope * cos) as f32, 1.0).normalize();
            }
        }
    }
    normals
}

/// A normal with Gaussian slopes of the given standard deviation.
fn tilted(sigma: f32, seed: u32) -> Vec3 {
    let uniform = |word: u32| (word >> 8) as f32 / (1 << 24) as f32;
    let radius = sigma * (-2.0 * (1.0 - uniform(hash(seed, 5))).ln()).sqrt();
    let (sin, cos) = (std::f32::consts::TAU * uniform(hash(seed, 6))).sin_cos();
    Vec3::new(radius * cos, radius * sin, 1.0).normalize()
}

/// The finaliser of MurmurHash3 over two words.
fn hash(a: u32, b: u32) -> u32 {
    let mut h = a.wrapping_mul(0x9e37_79b1) ^ b.wrapping_mul(0x85eb_ca77).rotate_left(13);
    h = (h ^ h >> 16).wrapping_mul(0x85eb_ca6b);
    h = (h ^ h >> 13).wrapping_mul(0xc2b2_ae35);
    h ^ h >> 16
}
