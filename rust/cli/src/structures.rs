//! The one place that knows which structure stands behind `ibm`, and how structures are saved and loaded.

use std::path::Path;

use glints::flakes::FlakeModel;
use glints::methods::Method;
use glints::methods::compact::{self, CompactBinMap, Header};
use glints::methods::inverse_bin_map::{InverseBinMap, Options};
use glints::normal_map::NormalMap;
use glints::saved::{Flakes, SavedMap};

use crate::failure::Result;

/// What `precompute` saves.
pub type Structure = CompactBinMap;

/// The structure of `--method ibm`, what `info` measures and `precompute` saves.
pub fn ibm(map: &NormalMap, model: FlakeModel) -> Structure {
    CompactBinMap::new(map, model)
}

/// The structure as published.
pub fn ibm_paper(map: &NormalMap, model: FlakeModel) -> Result<Box<dyn Method>> {
    Ok(Box::new(InverseBinMap::new(map, model, Options::default())?))
}

/// Writes a structure to a file.
pub fn save(structure: &Structure, path: &Path) -> Result<()> {
    Ok(structure.save(path)?)
}

/// Loads a structure that was made for these flakes.
pub fn load(path: &Path, flakes: &Flakes) -> Result<Structure> {
    Ok(SavedMap::load(path, flakes)?.into_structure())
}

/// The header of a saved structure; `None` for any other file.
pub fn header(path: &Path) -> Result<Option<Header>> {
    Ok(match compact::is_saved(path) {
        true => Some(compact::read_header(path)?),
        false => None,
    })
}
