//! The command-line tool `glints`: looks at normal maps, at their filtered distributions of normals and at
//! environments, and writes the files that the methods read.
//!
//! Exit status: 0, 1 for a failure, 2 for wrong usage, 130 after an interruption. Messages are one line on
//! standard error; results go to standard output.

mod arguments;
mod environment;
mod environment_picture;
mod failure;
mod flakes;
mod info;
mod ndf;
mod output;
mod picture;
mod precompute;
mod progress;
mod quadrature;
mod structures;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use failure::{Failure, Result};

/// Looks at normal maps, at their filtered distributions of normals and at environments, and writes the files
/// that the methods of mitsuba-glints read.
#[derive(Parser)]
#[command(name = "glints", version, max_term_width = 110)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Info(info::Arguments),
    Ndf(ndf::Arguments),
    #[command(subcommand)]
    Precompute(precompute::Command),
    Flakes(flakes::Arguments),
    Environment(environment::Arguments),
}

fn main() -> ExitCode {
    // The one line below is the message; a broken file that gets this far is a bug of a decoder or ours.
    std::panic::set_hook(Box::new(|_| ()));
    let outcome = catch_unwind(AssertUnwindSafe(run)).unwrap_or_else(|panic| {
        let text = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied());
        Err(Failure::failed(format!(
            "an internal error occurred, please report it: {}",
            text.unwrap_or("no message")
        )))
    });
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => failure.report(),
    }
}

fn run() -> Result<()> {
    let arguments = match Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => return failure::from_clap(&error),
    };
    output::remove_partial_files_when_interrupted()?;
    match arguments.command {
        Command::Info(arguments) => info::run(&arguments),
        Command::Ndf(arguments) => ndf::run(&arguments),
        Command::Precompute(command) => precompute::run(&command),
        Command::Flakes(arguments) => flakes::run(&arguments),
        Command::Environment(arguments) => environment::run(&arguments),
    }
}
