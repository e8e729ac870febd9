//! A fit of spherical Gaussians to an environment, saved as text: JSON that other programs and people read, too.
//!
//! **Layout**, version 1:
//!
//! ```text
//! {
//!   "format": "mitsuba-glints environment", "version": 1,
//!   "frame": what the axes' coordinates are,
//!   "map": { "name": file name, "crc32": checksum of its bytes, "width": pixels, "height": pixels },
//!   "residual": share of the light that the mixture has elsewhere,
//!   "lobes": [ { "axis": [x, y, z], "sharpness": lambda, "weight": pi, "energy": [r, g, b] }, ... ]
//! }
//! ```
//!
//! `energy` is radiance integrated over directions: the lobe shows the radiance `energy v(x)`, `v` of
//! [`crate::spherical_gaussians`]. `weight` is the lobe's share in the mixture, of luminance. Axis, sharpness and weight are
//! written with all the digits that single precision has, so that a mixture is the same after loading.

use std::io::Write;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::container::temporary_beside;
use crate::environment_map::{EnvironmentFit, EnvironmentMap};
use crate::error::{Error, Result};
use crate::spherical_gaussians::{SphericalGaussian, SphericalGaussians};

/// The version that is written, and the only one that is read.
pub const VERSION: u64 = 1;

const FORMAT: &str = "mitsuba-glints environment";

const FRAME: &str = "that of Mitsuba's envmap before to_world: +y in the picture's first row, +z in its middle, +x a quarter \
                     of the width from the left";

const REMEDY: &str = "make it again with `glints environment`";

/// Most bytes of a file: far more than 1024 lobes take.
const MAX_BYTES: u64 = 4 << 20;

/// The picture that a fit was made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapName {
    /// Without folder.
    pub name: String,
    /// Checksum of the file's bytes, eight hexadecimal digits.
    pub crc32: String,
    pub width: u32,
    pub height: u32,
}

impl MapName {
    /// Of a picture that was read from the file `path`.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn of(path: &Path, map: &EnvironmentMap) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|e| file_error(path, unreadable(&e)))?;
        let name = path.file_name().unwrap_or(path.as_os_str());
        Ok(Self {
            name: name.to_string_lossy().into_owned(),
            crc32: format!("{:08x}", crc32fast::hash(&bytes)),
            width: map.width(),
            height: map.height(),
        })
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct SavedLobe {
    axis: [f32; 3],
    sharpness: f32,
    weight: f32,
    energy: [f64; 3],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Saved {
    format: String,
    version: u64,
    frame: String,
    map: MapName,
    residual: f64,
    lobes: Vec<SavedLobe>,
}

/// Writes a fit; the file appears when it is complete.
///
/// # Errors
/// The file cannot be written.
pub fn save(fit: &EnvironmentFit, map: &MapName, path: &Path) -> Result<()> {
    let mixture = &fit.mixture;
    let lobes = mixture.lobes().iter().zip(mixture.weights()).zip(&fit.energies);
    let saved = Saved {
        format: FORMAT.into(),
        version: VERSION,
        frame: FRAME.into(),
        map: map.clone(),
        residual: fit.residual,
        lobes: lobes
            .map(|((lobe, &weight), &energy)| SavedLobe {
                axis: lobe.axis.to_array(),
                sharpness: lobe.sharpness,
                weight,
                energy,
            })
            .collect(),
    };
    let write = || -> std::io::Result<()> {
        let mut file = temporary_beside(path)?;
        serde_json::to_writer_pretty(&mut file, &saved)?;
        file.write_all(b"\n")?;
        file.as_file().sync_all()?;
        file.persist(path).map_err(|e| e.error)?;
        Ok(())
    };
    write().map_err(|e| {
        let reason = format!("cannot be written ({e}); check the folder, its permissions and its space");
        file_error(path, reason)
    })
}

/// Reads a fit.
///
/// # Errors
/// The file cannot be read; is no saved fit, or one of another version; holds what no fit has.
pub fn load(path: &Path) -> Result<(EnvironmentFit, MapName)> {
    let refuse = |reason: String| file_error(path, reason);
    let broken = |what: String| refuse(format!("is broken: {what}; {REMEDY}"));
    let size = std::fs::metadata(path).map_err(|e| refuse(unreadable(&e)))?;
    if !size.is_file() || size.len() > MAX_BYTES {
        return Err(refuse(format!("is not a saved fit of an environment; {REMEDY}")));
    }
    let bytes = std::fs::read(path).map_err(|e| refuse(unreadable(&e)))?;
    let value: Value = serde_json::from_slice(&bytes).map_err(|e| {
        refuse(format!(
            "is not a saved fit of an environment, or not all of one ({e}); {REMEDY}"
        ))
    })?;
    if value["format"] != FORMAT {
        return Err(refuse(format!("is not a saved fit of an environment; {REMEDY}")));
    }
    if value["version"] != VERSION {
        let found = &value["version"];
        return Err(refuse(format!(
            "has version {found}, and {VERSION} is needed; {REMEDY}"
        )));
    }
    let saved: Saved = serde_json::from_value(value).map_err(|e| broken(e.to_string()))?;
    if !(0.0..=1.0).contains(&saved.residual) {
        return Err(broken(format!("\"residual\" is {}", saved.residual)));
    }
    fit_of(saved).map_err(|e| broken(e.to_string()))
}

fn fit_of(saved: Saved) -> Result<(EnvironmentFit, MapName)> {
    let energies: Vec<[f64; 3]> = saved.lobes.iter().map(|lobe| lobe.energy).collect();
    if let Some(energy) = energies.iter().flatten().find(|e| !(e.is_finite() && **e >= 0.0)) {
        return Err(Error::parameter(
            "energy",
            energy,
            "must be finite and not negative",
        ));
    }
    let weights = saved.lobes.iter().map(|lobe| lobe.weight).collect();
    let lobes = saved.lobes.iter().map(|lobe| SphericalGaussian {
        axis: lobe.axis.into(),
        sharpness: lobe.sharpness,
    });
    let fit = EnvironmentFit {
        mixture: SphericalGaussians::from_lobes(lobes.collect(), weights)?,
        energies,
        residual: saved.residual,
    };
    Ok((fit, saved.map))
}

fn file_error(path: &Path, reason: String) -> Error {
    Error::File {
        path: path.into(),
        reason,
    }
}

fn unreadable(error: &std::io::Error) -> String {
    format!("cannot be read ({error}); check its name and its permissions")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fitted() -> EnvironmentFit {
        let pixels = (0..32 * 17).map(|i| [1.0 + (i % 32) as f32, (i / 32) as f32, 0.3]);
        let map = EnvironmentMap::new(32, 17, pixels.collect()).unwrap();
        map.fit(16).unwrap()
    }

    fn name() -> MapName {
        MapName {
            name: "studio.exr".into(),
            crc32: "0123abcd".into(),
            width: 32,
            height: 17,
        }
    }

    #[test]
    fn a_fit_is_the_same_after_loading() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fit.json");
        let fit = fitted();
        save(&fit, &name(), &path).unwrap();
        let (found, map) = load(&path).unwrap();
        assert_eq!(map, name());
        assert_eq!(found, fit);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn broken_files_are_refused_with_a_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fit.json");
        save(&fitted(), &name(), &path).unwrap();
        let whole = std::fs::read_to_string(&path).unwrap();
        let message = |text: &str| {
            std::fs::write(&path, text).unwrap();
            load(&path).unwrap_err().to_string()
        };
        let mut cases = vec![
            ("not all of one", whole[..whole.len() / 2].to_string()),
            ("not a saved fit", "{}".into()),
            ("not a saved fit", "[1, 2]".into()),
            (
                "version 2, and 1 is needed",
                whole.replace("\"version\": 1", "\"version\": 2"),
            ),
            (
                "sharpness",
                whole.replacen("\"sharpness\": ", "\"sharpness\": -", 1),
            ),
            ("unknown field", whole.replacen("\"sharpness\"", "\"sharp\"", 1)),
            (
                "residual",
                whole.replacen("\"residual\": 0", "\"residual\": 7", 1),
            ),
        ];
        let value: Value = serde_json::from_str(&whole).unwrap();
        let mut changed = |what: &'static str, change: &dyn Fn(&mut Value)| {
            let mut value = value.clone();
            change(&mut value);
            cases.push((what, value.to_string()));
        };
        changed("unit vector", &|v| v["lobes"][3]["axis"][0] = 7.into());
        changed("not negative", &|v| v["lobes"][2]["energy"][1] = (-1.0).into());
        changed("positive", &|v| v["lobes"][2]["weight"] = 0.into());
        changed("sum to one", &|v| v["lobes"][2]["weight"] = 0.9.into());
        changed("lobes", &|v| v["lobes"] = Value::Array(vec![]));
        changed("null", &|v| v["lobes"][0]["energy"][0] = Value::Null);
        for (what, text) in cases {
            assert_ne!(text, whole, "{what}");
            let message = message(&text);
            assert!(
                message.contains(what) && message.contains("fit.json"),
                "{what}: {message}"
            );
            assert!(message.contains("glints environment"), "{what}: {message}");
        }
        let missing = load(&folder.path().join("none.json")).unwrap_err().to_string();
        assert!(missing.contains("cannot be read"), "{missing}");
    }
}
