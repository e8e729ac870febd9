//! `glints info`: what a normal map holds and asks for.

use std::path::Path;
use std::time::Instant;

use clap::Args;
use glam::{DVec3, Vec3};
use glints::flakes::{FlakeModel, Normalization};
use glints::methods::Method;
use glints::methods::compact::Header;
use glints::methods::tensor;
use glints::microfacet;
use glints::normal_map::{Encoding, NormalMap, SlopeCovariance};
use serde_json::{Value, json};

use crate::arguments::{
    Distribution, InterpolationArguments, MapArguments, decimal, model, refined, refinement_json,
    refinement_text,
};
use crate::failure::Result;
use crate::output;
use crate::progress::Progress;
use crate::structures;

/// Tells about a normal map, and what its filtering takes; or about a saved structure
///
/// * Roughness: that of a Beckmann surface with the variance of the map's slopes. It says how wide the highlight
///   is from afar, and shadowing and masking of the whole map are made from it.
/// * Tilt: angle between a texel's normal and the shading normal.
/// * Flat texels point along the shading normal up to the rounding of 8 bits; steep ones have slopes beyond 10,
///   so that a projected area counts more than ten times their own: many of either kind hint at a broken map or
///   the wrong --encoding.
/// * Tiling: root mean square difference of the normals of neighbouring texels, inside and across the borders,
///   where the map meets its repetition. A map tiles when its borders differ no more than the worst column and
///   row inside it.
/// * Structures: bins per side, memory and build time of the compact inverse bin map for flakes of each roughness; of an
///   interpolated map with its refinement, and how far apart normals of neighbouring refined texels are.
///
/// Of a saved structure, its header is told: its size, the map that it was made from, whether interpolated, with the
/// covariance of its slopes and the checksum by which it is known again, the flakes, and memory.
///
/// Example: glints info flakes.exr --alpha 0.0025,0.01
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    #[command(flatten)]
    map: MapArguments,

    /// Roughnesses of a flake, each in 0.0001 to 1, for which structures are built
    #[arg(long, value_delimiter = ',', default_values_t = [0.0025, 0.01, 0.04, 0.16])]
    alpha: Vec<f32>,

    /// Distribution of a flake's microfacets
    #[arg(long, value_enum, default_value_t)]
    distribution: Distribution,

    #[command(flatten)]
    interpolation: InterpolationArguments,

    /// Print one line of JSON
    #[arg(long)]
    json: bool,
}

/// Tilts whose sine is below this are the rounding of 8 bits: half a step of 2/255 on each axis, and a bias of
/// as much in maps that store 128 for zero.
const FLAT_SINE: f32 = 0.006;

/// Slopes beyond this are steep.
const STEEP_SLOPE: f32 = 10.0;

pub fn run(arguments: &Arguments) -> Result<()> {
    if let Some(header) = structures::header(&arguments.map.map)? {
        return output::print(&if arguments.json {
            format!("{}\n", saved(&header, &arguments.map.map))
        } else {
            format!("{header}\n")
        });
    }
    if tensor::is_saved(&arguments.map.map) {
        let header = tensor::read_header(&arguments.map.map)?;
        return output::print(&if arguments.json {
            format!("{}\n", saved_tensor(&header, &arguments.map.map))
        } else {
            format!("{header}\n")
        });
    }
    // Wrong roughnesses are told before a long read.
    let models = arguments
        .alpha
        .iter()
        .map(|&alpha| model(arguments.distribution, alpha))
        .collect::<Result<Vec<_>>>()?;
    arguments.interpolation.check()?;
    let map = arguments.map.load()?;
    let mut report = describe(&map, &arguments.map.map);
    report["structures"] = structures(&map, &models, &arguments.interpolation)?.into();
    output::print(&if arguments.json {
        format!("{report}\n")
    } else {
        text(&report)
    })
}

fn saved(header: &Header, path: &Path) -> Value {
    json!({
        "structure": path.display().to_string(),
        "file_format": header.version,
        "width": header.map.0,
        "height": header.map.1,
        "alpha": decimal(header.alpha),
        "distribution": match header.distribution {
            microfacet::Distribution::Beckmann => "beckmann",
            microfacet::Distribution::Ggx => "ggx",
        },
        "normalization": match header.normalization {
            Normalization::Projected => "projected",
            Normalization::Paper => "paper",
        },
        "map": {
            "width": header.origin.size.0,
            "height": header.origin.size.1,
            "checksum": format!("{:08x}", header.origin.checksum),
            "slope_covariance": slopes_json(header.origin.slopes),
            "refinement": refinement_json(header.origin.refinement),
        },
        "texel_bytes": header.texel_bytes,
        "count_bytes": header.count_bytes,
        "file_bytes": header.file_bytes,
    })
}

fn slopes_json(slopes: SlopeCovariance) -> Value {
    json!({ "uu": slopes.xx, "uv": slopes.xy, "vv": slopes.yy })
}

fn saved_tensor(header: &tensor::Header, path: &Path) -> Value {
    json!({
        "structure": path.display().to_string(),
        "file_format": header.version,
        "width": header.map.0,
        "height": header.map.1,
        "alpha": decimal(header.alpha),
        "distribution": match header.distribution {
            microfacet::Distribution::Beckmann => "beckmann",
            microfacet::Distribution::Ggx => "ggx",
        },
        "resolution": header.resolution,
        "stride": header.stride,
        "levels": header.levels,
        "groups": header.groups,
        "mean_rank": header.mean_rank,
        "image_bytes": header.image_bytes,
        "file_bytes": header.file_bytes,
    })
}

fn describe(map: &NormalMap, path: &Path) -> Value {
    let normals = map.normals();
    let count = normals.len() as f64;
    let mean = normals.iter().map(|n| n.as_dvec3()).sum::<DVec3>() / count;
    let slopes = map.slope_covariance();
    let share = |test: &dyn Fn(&Vec3) -> bool| normals.iter().filter(|n| test(n)).count() as f64 / count;
    let steep_z = 1.0 / (1.0 + STEEP_SLOPE * STEEP_SLOPE).sqrt();
    json!({
        "map": path.display().to_string(),
        "width": map.width(),
        "height": map.height(),
        "encoding": match map.encoding() {
            Encoding::Unsigned => "unsigned",
            _ => "signed",
        },
        "mean_normal": mean.to_array(),
        "slope_covariance": slopes_json(slopes),
        "roughness": { "u": (2.0 * slopes.xx).sqrt(), "v": (2.0 * slopes.yy).sqrt() },
        "tilt_degrees": tilts(normals),
        "flat_texels": share(&|n| n.truncate().length() < FLAT_SINE),
        "steep_texels": share(&|n| n.z < steep_z),
        "tiling": tiling(map),
    })
}

fn tilts(normals: &[Vec3]) -> Value {
    // The arc tangent keeps small angles that a cosine in single precision has lost.
    let mut tilts: Vec<f32> = normals
        .iter()
        .map(|n| n.truncate().length().atan2(n.z).to_degrees())
        .collect();
    tilts.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| tilts[(share * (tilts.len() - 1) as f64).round() as usize];
    json!({ "least": at(0.0), "median": at(0.5), "99_percent": at(0.99), "greatest": at(1.0) })
}

/// Differences between neighbouring columns (along u) and rows (along v).
fn tiling(map: &NormalMap) -> Value {
    let (width, height) = (map.width(), map.height());
    let along_u = seams(width, height, |column, row| map.normal(column, row));
    let along_v = seams(height, width, |row, column| map.normal(column, row));
    let tiles = [&along_u, &along_v].iter().all(|seams| seams.tiles());
    json!({ "u": along_u.json(), "v": along_v.json(), "tiles": tiles })
}

/// Root mean square differences of normals between neighbouring lines of texels.
struct Seams {
    border: f64,
    inside: f64,
    worst_inside: f64,
}

/// `at(line, place)`; the border lies between the last and the first line.
fn seams(lines: u32, places: u32, at: impl Fn(u32, u32) -> Vec3) -> Seams {
    let mut squares = vec![0.0; lines as usize];
    // Places outside: rows of the map are read one after the other when lines are columns.
    for place in 0..places {
        for line in 0..lines {
            let difference = at((line + 1) % lines, place) - at(line, place);
            squares[line as usize] += f64::from(difference.length_squared()) / f64::from(places);
        }
    }
    let (border, inside) = squares.split_last().map_or((0.0, &[][..]), |(b, i)| (*b, i));
    Seams {
        border: border.sqrt(),
        inside: (inside.iter().sum::<f64>() / (inside.len().max(1)) as f64).sqrt(),
        worst_inside: inside.iter().copied().fold(0.0, f64::max).sqrt(),
    }
}

impl Seams {
    fn tiles(&self) -> bool {
        self.border <= self.worst_inside * (1.0 + 1e-6)
    }

    fn json(&self) -> Value {
        json!({ "border": self.border, "inside": self.inside, "worst_inside": self.worst_inside })
    }
}

fn structures(
    map: &NormalMap,
    models: &[FlakeModel],
    interpolation: &InterpolationArguments,
) -> Result<Vec<Value>> {
    let progress = Progress::bar("building structures", models.len() as u64);
    models
        .iter()
        .map(|&model| {
            let start = Instant::now();
            let refinement = interpolation.refinement(map, model)?;
            let method = structures::ibm(&*refined(map, refinement)?, model);
            progress.advance(1);
            Ok(json!({
                "alpha": decimal(model.flake.alpha()),
                "bins": method.bins(),
                "bytes": method.structure_bytes(),
                "build_seconds": start.elapsed().as_secs_f64(),
                "refinement": refinement_json(refinement),
            }))
        })
        .collect()
}

fn text(report: &Value) -> String {
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let [x, y, z] = [0, 1, 2].map(|i| number(&report["mean_normal"][i]));
    let slopes = &report["slope_covariance"];
    let roughness = &report["roughness"];
    let tilt = &report["tilt_degrees"];
    let tiling = &report["tiling"];
    let seam = |axis: &str| {
        let seams = &tiling[axis];
        format!(
            "{:.4} across the border along {axis}, {:.4} inside, {:.4} at worst",
            number(&seams["border"]),
            number(&seams["inside"]),
            number(&seams["worst_inside"])
        )
    };
    let mut text = format!(
        "size              {} x {} texels, {} encoding\n\
         mean normal       ({x:.4}, {y:.4}, {z:.4})\n\
         slope covariance  uu {:.3e}, uv {:.3e}, vv {:.3e}\n\
         roughness         {:.4} along u, {:.4} along v (Beckmann)\n\
         tilt              {:.2}° to {:.2}°, median {:.2}°, 99 % below {:.2}°\n\
         texels            {:.3} % flat, {:.3} % steep\n\
         tiling            {}: {}\n\
         {:<18}{}\n",
        report["width"],
        report["height"],
        report["encoding"].as_str().unwrap_or_default(),
        number(&slopes["uu"]),
        number(&slopes["uv"]),
        number(&slopes["vv"]),
        number(&roughness["u"]),
        number(&roughness["v"]),
        number(&tilt["least"]),
        number(&tilt["greatest"]),
        number(&tilt["median"]),
        number(&tilt["99_percent"]),
        100.0 * number(&report["flat_texels"]),
        100.0 * number(&report["steep_texels"]),
        if tiling["tiles"] == true { "yes" } else { "no" },
        seam("u"),
        "",
        seam("v"),
    );
    for structure in report["structures"].as_array().into_iter().flatten() {
        let refinement = &structure["refinement"];
        let interpolated = match refinement {
            Value::Null => String::new(),
            refinement => format!("; {}", refinement_text(refinement)),
        };
        text += &format!(
            "{:<18}alpha {}: {} bins per side, {:.1} MB, built in {:.2} s{interpolated}\n",
            "structure",
            structure["alpha"],
            structure["bins"],
            number(&structure["bytes"]) / 1e6,
            number(&structure["build_seconds"]),
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waves(side: u32, periods: f32) -> NormalMap {
        let phase = std::f32::consts::TAU * periods / side as f32;
        let normals: Vec<Vec3> = (0..side * side)
            .map(|i| {
                let (u, v) = ((i % side) as f32 * phase, (i / side) as f32 * phase);
                Vec3::new(0.3 * u.sin(), 0.3 * v.cos(), 1.0)
            })
            .collect();
        NormalMap::from_normals("waves", side, side, &normals).unwrap()
    }

    #[test]
    fn whole_waves_tile_and_broken_ones_do_not() {
        assert_eq!(tiling(&waves(64, 3.0))["tiles"], true);
        assert_eq!(tiling(&waves(64, 3.4))["tiles"], false);
    }

    #[test]
    fn one_texel_has_everything() {
        let map = NormalMap::from_normals("one", 1, 1, &[Vec3::new(3.0, 0.0, 4.0)]).unwrap();
        let report = describe(&map, Path::new("one"));
        assert_eq!(report["tiling"]["tiles"], true);
        assert_eq!(report["flat_texels"], 0.0);
        let tilt = report["tilt_degrees"]["median"].as_f64().unwrap();
        assert!((tilt - 36.87).abs() < 0.01, "{tilt}");
    }
}
