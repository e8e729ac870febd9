//! `glints flakes`: maps of metallic flakes.

use std::path::PathBuf;

use clap::Args;
use glints::flake_map::{FlakeMapOptions, generate};

use crate::failure::{Failure, Result};
use crate::output::{self, Destination};
use crate::picture::Format;
use crate::progress::Progress;

/// Makes the normal map of a layer of metallic flakes, and the mask of where there are any
///
/// Flakes are polygons that do not overlap, each with one constant normal, drawn from a GTR distribution. Texels
/// without a flake point along the shading normal. The map tiles, and the same parameters make the same map.
///
/// --alpha and --gamma say how far the flakes lean: the look from afar. The roughness of each flake, between sharp
/// glints and satin, is another parameter and belongs to the material.
///
/// .exr files hold 32-bit floats, .png files 16 bits (8 for the mask); small --alpha needs EXR.
///
/// Example: glints flakes -o flakes.exr --mask mask.png --density 0.6 --flake-size 4 --alpha 0.05
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Normal map to write: .exr or .png
    #[arg(short, long, value_name = "NORMALS")]
    output: PathBuf,

    /// Mask to write, one where a texel holds a flake, else zero: .exr or .png
    #[arg(long)]
    mask: Option<PathBuf>,

    /// Texels per side, in 1 to 16384
    #[arg(long, value_name = "TEXELS", default_value_t = FlakeMapOptions::default().size)]
    size: u32,

    /// Share of the area that flakes cover, above 0 and up to 1
    #[arg(long, value_name = "SHARE", default_value_t = FlakeMapOptions::default().density)]
    density: f32,

    /// Mean diameter of a flake in texels, in 1 to the map's side
    #[arg(long, value_name = "TEXELS", default_value_t = FlakeMapOptions::default().flake_size)]
    flake_size: f32,

    /// Exponent of the flakes' GTR distribution, above 0 and up to 10: 2 is GGX, less has a longer tail
    #[arg(long, default_value_t = FlakeMapOptions::default().gamma)]
    gamma: f32,

    /// Roughness of the flakes' GTR distribution, in 0.0001 to 1: how far they lean
    #[arg(long, default_value_t = FlakeMapOptions::default().alpha)]
    alpha: f32,

    /// Another seed makes another map of the same kind
    #[arg(long, default_value_t = 0)]
    seed: u64,

    /// Overwrite the files if they exist
    #[arg(long)]
    force: bool,
}

impl Arguments {
    fn options(&self) -> FlakeMapOptions {
        FlakeMapOptions {
            size: self.size,
            density: self.density,
            flake_size: self.flake_size,
            gamma: self.gamma,
            alpha: self.alpha,
            seed: self.seed,
        }
    }

    /// Normals and, if it is wanted, the mask.
    fn destinations(&self) -> Result<Vec<Destination>> {
        if self.mask.as_ref() == Some(&self.output) {
            return Err(Failure::usage("-o and --mask name the same file; name two"));
        }
        std::iter::once(&self.output)
            .chain(&self.mask)
            .map(|path| {
                Format::of(path)?;
                Destination::new(path, self.force, &[])
            })
            .collect()
    }
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let destinations = arguments.destinations()?;
    let map = {
        let _progress = Progress::spinner("making flakes");
        generate(&arguments.options())?
    };
    output::write_files(&destinations.iter().collect::<Vec<_>>(), |files| {
        let _progress = Progress::spinner("writing");
        // The library writes both; a mask that nobody wants stays in the temporary folder and goes with it.
        let unwanted = files[0].with_extension("mask.png");
        Ok(map.save(&files[0], files.get(1).unwrap_or(&unwanted))?)
    })?;
    let covered = map.mask.iter().map(|&m| f64::from(m)).sum::<f64>() / map.mask.len() as f64;
    output::print(&format!(
        "{}: {} x {} texels, flakes cover {:.2} %\n",
        arguments.output.display(),
        map.width,
        map.height,
        100.0 * covered
    ))
}
