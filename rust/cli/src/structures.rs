//! The one place that knows which structure stands behind `ibm`, and how structures are saved and loaded.

use std::path::Path;

use glints::flakes::FlakeModel;
use glints::methods::Method;
use glints::methods::compact::{self, CompactBinMap, Header, Origin};
use glints::methods::inverse_bin_map::{InverseBinMap, Options};
use glints::methods::tensor::{self, Tensor};
use glints::normal_map::NormalMap;
use glints::saved::{Flakes, SavedMap};

use crate::failure::Result;
use crate::progress::Progress;

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

/// Tensor-decomposed distributions.
pub fn tensor(
    map: &NormalMap,
    model: FlakeModel,
    options: &tensor::Options,
) -> Result<(Tensor, tensor::Report)> {
    const STEPS: u64 = 1000;
    let progress = Progress::bar("precomputing distributions", STEPS);
    let shown = |share: f64| progress.reach((share * STEPS as f64) as u64);
    Ok(Tensor::new(map, model, options, &shown)?)
}

/// Writes a structure to a file, with what it was made from.
pub fn save(structure: &Structure, origin: &Origin, path: &Path) -> Result<()> {
    Ok(structure.save(origin, path)?)
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
