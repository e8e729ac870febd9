//! `glints precompute`: structures that are built once and loaded by renderers.

use std::borrow::Cow;
use std::path::PathBuf;

use clap::{Args, Subcommand};

use crate::arguments::{FlakeArguments, InterpolationArguments, MapArguments, refined};
use crate::failure::Result;
use crate::output::{self, Destination};
use crate::progress::Progress;
use crate::structures;

/// Builds a structure from a normal map and saves it
#[derive(Subcommand)]
pub enum Command {
    Ibm(IbmArguments),
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

pub fn run(command: &Command) -> Result<()> {
    let Command::Ibm(arguments) = command;
    let destination = Destination::new(&arguments.output, arguments.force, &[&arguments.map.map])?;
    let model = arguments.flake.model()?;
    arguments.interpolation.check()?;
    let map = arguments.map.load()?;
    let refinement = arguments.interpolation.refinement(&map, model)?;
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
        structures::save(&structure, &files[0])
    })?;
    let bytes = std::fs::metadata(destination.path()).map_or(0, |file| file.len());
    output::print(&format!(
        "{}: {:.1} MB\n",
        destination.path().display(),
        bytes as f64 / 1e6
    ))
}
