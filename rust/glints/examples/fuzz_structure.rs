//! Mutates saved structures for as long as wanted, and tells which mutations made a load or a query fail:
//!
//! ```bash
//! cargo run --release -p glints --example fuzz_structure -- --seconds 600 --folder /tmp/fuzz
//! ```
//!
//! Exit status 1 if there was a failure. The files that led to failures stay in the folder; after an abort, that is
//! `mutated.glints`.

#[path = "../tests/fuzz/mod.rs"]
mod fuzz;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Parser;

#[derive(Parser)]
struct Arguments {
    /// How long to go on
    #[arg(long, default_value_t = 60)]
    seconds: u64,

    /// Runs of the same seed try the same mutations
    #[arg(long, default_value_t = 0)]
    seed: u64,

    /// Folder for files, made if it does not exist
    #[arg(long)]
    folder: PathBuf,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    if let Err(error) = std::fs::create_dir_all(&arguments.folder) {
        eprintln!(
            "folder \"{}\": cannot be made ({error})",
            arguments.folder.display()
        );
        return ExitCode::from(2);
    }
    let outcome = fuzz::run(
        arguments.seed,
        Duration::from_secs(arguments.seconds),
        &arguments.folder,
    );
    println!(
        "{} executions, {} of them loaded and queried, {} failures {:?}",
        outcome.executions,
        outcome.loaded,
        outcome.failures.len(),
        outcome.failures
    );
    ExitCode::from(u8::from(!outcome.failures.is_empty()))
}
