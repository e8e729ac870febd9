//! `glints precompute`: structures that are built once and loaded by renderers.

use std::borrow::Cow;
use std::path::PathBuf;
use std::time::Instant;

use clap::{Args, Subcommand};
use glints::methods::compact::Origin;
use serde_json::json;

use crate::arguments::{FlakeArguments, InterpolationArguments, MapArguments, TensorOptions, refined};
use crate::failure::Result;
use crate::output::{self, Destination};
use crate::progress::Progress;
use crate::structures;

/// Builds a structure from a normal map and saves it
#[derive(Subcommand)]
pub enum Command {
    Ibm(IbmArguments),
    Tensor(TensorArguments),
}

/// The inverse bin map of a normal map for flakes of one roughness
///
/// The file stands for the map, --interpolation, --alpha and --distribution: it is mapped into memory and used in place, without
/// building anything. It is read by the version of this program that wrote it, and by all with the same file format.
/// `glints info FILE` tells what it holds, `glints ndf FILE` shows it, and `structure_file` of the plugin glints_ibm loads it.
/// The file appears when it is complete; nothing is left of an interrupted build.
///
/// Example: glints precompute ibm flakes.exr --alpha 0.005 -o flakes.glints
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct IbmArguments {
    #[command(flatten)]
    map: MapArguments,

    #[command(flatten)]
    flake: FlakeArguments,

    #[command(flatten)]
    interpolation: InterpolationArguments,

    /// File to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,

    /// Overwrite the file if it exists
    #[arg(long)]
    force: bool,
}

/// Tensor-decomposed distributions of normals of a normal map (Deng et al. 2022), for flakes of one roughness
///
/// Distributions for footprints of all places and sizes, as images of the hemisphere, compressed. The file stands for the map,
/// --alpha and --distribution: `glints_tensor` takes it as `ndf_file`. It takes minutes for a large map, on all cores.
/// `glints info FILE` tells what it holds. The file appears when it is complete; nothing is left of an interrupted
/// computation.
///
/// Example: glints precompute tensor flakes.exr --alpha 0.01 --rank 32 -o flakes.glints
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct TensorArguments {
    #[command(flatten)]
    map: MapArguments,

    #[command(flatten)]
    flake: FlakeArguments,

    #[command(flatten)]
    tensor: TensorOptions,

    /// File to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,

    /// Overwrite the file if it exists
    #[arg(long)]
    force: bool,

    /// Print one line of JSON
    #[arg(long)]
    json: bool,
}

pub fn run(command: &Command) -> Result<()> {
    match command {
        Command::Ibm(arguments) => ibm(arguments),
        Command::Tensor(arguments) => tensor(arguments),
    }
}

fn tensor(arguments: &TensorArguments) -> Result<()> {
    let destination = Destination::new(&arguments.output, arguments.force, &[&arguments.map.map])?;
    let model = arguments.flake.model()?;
    let options = arguments.tensor.options()?;
    let map = arguments.map.load()?;
    let start = Instant::now();
    let (structure, report) = structures::tensor(&map, model, &options)?;
    let seconds = start.elapsed().as_secs_f64();
    output::write_files(&[&destination], |files| Ok(structure.save(&map, &files[0])?))?;
    let (image_bytes, exact_bytes) = structure.bytes();
    let facts = json!({
        "output": destination.path().display().to_string(),
        "seconds": seconds,
        "pyramid_thread_seconds": report.pyramid_seconds,
        "solver_thread_seconds": report.solver_seconds,
        "levels": report.levels.1,
        "agreement": report.agreement,
        "groups": report.groups,
        "blocks": report.blocks,
        "mean_rank": structure.mean_rank(),
        "iterations": report.iterations,
        "relative_error": report.relative_error,
        "level_errors": report.errors.iter().map(|error| error.0).collect::<Vec<_>>(),
        "image_bytes": image_bytes,
        "exact_bytes": exact_bytes,
    });
    output::print(&if arguments.json {
        format!("{facts}\n")
    } else {
        format!(
            "{}: {:.2} MB of compressed images in {seconds:.1} s\n{} levels, {} groups of mean rank {:.1}, relative L2 error \
             {:.4}\nsmall footprints take {:.1} MB more when the file is loaded\n",
            destination.path().display(),
            image_bytes as f64 / 1e6,
            report.levels.1,
            report.groups,
            structure.mean_rank(),
            report.relative_error,
            exact_bytes as f64 / 1e6,
        )
    })
}

fn ibm(arguments: &IbmArguments) -> Result<()> {
    let destination = Destination::new(&arguments.output, arguments.force, &[&arguments.map.map])?;
    let model = arguments.flake.model()?;
    arguments.interpolation.check()?;
    let map = arguments.map.load()?;
    let refinement = arguments.interpolation.refinement(&map, model)?;
    let origin = Origin::new(&map, refinement);
    let map = match refined(&map, refinement)? {
        Cow::Owned(refined) => refined,
        Cow::Borrowed(_) => map,
    };
    let structure = {
        let _progress = Progress::spinner("building the structure");
        structures::ibm(&map, model)
    };
    drop(map);
    output::write_files(&[&destination], |files| {
        let _progress = Progress::spinner("saving the structure");
        structures::save(&structure, &origin, &files[0])
    })?;
    let bytes = std::fs::metadata(destination.path()).map_or(0, |file| file.len());
    output::print(&format!(
        "{}: {:.1} MB\n",
        destination.path().display(),
        bytes as f64 / 1e6
    ))
}
