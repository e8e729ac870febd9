//! Files that appear whole or not at all, and text on standard output.
//!
//! A file is written under its own name in a temporary folder beside its destination and then renamed: no
//! reader ever sees half of it. An interruption removes the folder.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use crate::failure::{Failure, Result};

/// Exit status after SIGINT: 128 + 2, as shells have it.
const INTERRUPTED: i32 = 130;

/// Temporary folders that hold unfinished files.
static UNFINISHED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// From here on SIGINT, SIGTERM and SIGHUP remove unfinished files and end the program.
pub fn remove_partial_files_when_interrupted() -> Result<()> {
    let handler = || {
        // Never released: nothing may be renamed any more.
        let folders = UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner);
        for folder in folders.iter() {
            // The writing thread may add a file between the listing and the removal.
            for _ in 0..3 {
                if std::fs::remove_dir_all(folder).is_ok() {
                    break;
                }
            }
        }
        std::process::exit(INTERRUPTED);
    };
    ctrlc::set_handler(handler).map_err(|e| Failure::failed(format!("cannot watch for signals ({e})")))
}

/// Writes to standard output. A reader that has gone away, like `head`, is no failure.
pub fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::failed(format!("cannot write to standard output ({e})")))
        }
        _ => Ok(()),
    }
}

/// Where a command writes one file.
pub struct Destination {
    path: PathBuf,
    folder: PathBuf,
    force: bool,
}

impl Destination {
    /// Checks, before any long work, that the file may be written.
    ///
    /// # Errors
    /// The file exists and `force` is not set; it is one of `inputs`; its folder does not exist.
    pub fn new(path: &Path, force: bool, inputs: &[&Path]) -> Result<Self> {
        if path.file_name().is_none() || path.is_dir() {
            return Err(Failure::file(path, "is a folder; name a file"));
        }
        let folder = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_path_buf(),
            _ => PathBuf::from("."),
        };
        if !folder.is_dir() {
            let reason = format!(
                "the folder \"{}\" does not exist; make it first",
                folder.display()
            );
            return Err(Failure::file(path, reason));
        }
        let destination = Self {
            path: path.to_path_buf(),
            folder,
            force,
        };
        destination.check_absent()?;
        let same = |input: &&Path| match (input.canonicalize(), path.canonicalize()) {
            (Ok(a), Ok(b)) => a == b,
            _ => false,
        };
        if inputs.iter().any(same) {
            return Err(Failure::file(path, "is the file to be read; choose another name"));
        }
        Ok(destination)
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    fn check_absent(&self) -> Result<()> {
        if !self.force && self.path.symlink_metadata().is_ok() {
            let reason = "exists already; choose another name, or overwrite it with --force";
            return Err(Failure::file(&self.path, reason));
        }
        Ok(())
    }
}

/// Lets `write` fill temporary files, one for each destination and of the same name, and moves them there.
pub fn write_files(
    destinations: &[&Destination],
    write: impl FnOnce(&[PathBuf]) -> Result<()>,
) -> Result<()> {
    let (folders, files): (Vec<_>, Vec<_>) = destinations
        .iter()
        .map(|destination| staging(destination))
        .collect::<Result<Vec<_>>>()?
        .into_iter()
        .unzip();
    let written = write(&files).and_then(|()| publish(destinations, &files));
    drop(folders);
    unfinished().clear();
    written
}

fn publish(destinations: &[&Destination], files: &[PathBuf]) -> Result<()> {
    // An interruption waits until all are moved.
    let _unfinished = unfinished();
    for destination in destinations {
        destination.check_absent()?;
    }
    for (destination, file) in destinations.iter().zip(files) {
        std::fs::rename(file, &destination.path)
            .map_err(|e| Failure::file(&destination.path, format!("cannot be written ({e})")))?;
    }
    Ok(())
}

/// A temporary folder beside the destination, and a path of the same file name in it.
fn staging(destination: &Destination) -> Result<(tempfile::TempDir, PathBuf)> {
    let mut unfinished = unfinished();
    let folder = tempfile::Builder::new()
        .prefix(".glints-")
        .tempdir_in(&destination.folder)
        .map_err(|e| {
            let reason = format!("cannot be written ({e}); check the folder's permissions");
            Failure::file(&destination.path, reason)
        })?;
    unfinished.push(folder.path().to_path_buf());
    let file = folder
        .path()
        .join(destination.path.file_name().unwrap_or_default());
    Ok((folder, file))
}

fn unfinished() -> std::sync::MutexGuard<'static, Vec<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}
