//! A saved inverse bin map in the place of the map that it was made from.
//!
//! A renderer that is handed the file of `glints precompute ibm` maps it into memory and builds nothing. The file stands
//! for the map, the flakes and the interpolation, so whatever else a scene says about them must agree with it:
//! [`SavedMap::load`] compares the flakes, [`SavedMap::check_map`] the map.
//!
//! **Shadowing of the whole map** `G_x` needs the covariance of the map's slopes, for which the file has no field. Without
//! the map it is that of the normals in the file, quantised to a twentieth of a lobe's standard deviation; those of an
//! interpolated map are the refined texels', whose slopes vary less than the map's. With the map it is the map's own, and
//! answers are bit for bit those of a structure that was built.

use std::path::{Path, PathBuf};

use glam::DVec2;
use rayon::prelude::*;

use crate::brdf::{Brdf, Masking};
use crate::error::{Error, Result};
use crate::flakes::Normalization;
use crate::footprint_filter::FootprintFilter;
use crate::methods::compact::{CompactBinMap, Header, read_header};
use crate::microfacet::{Distribution, Flake};
use crate::normal_map::{NormalMap, SlopeCovariance};
use crate::refinement::{MAX_REFINEMENT, Refinement};

/// Name of the parameter that names the file, in messages.
const PARAMETER: &str = "structure_file";

/// Most distance on the projected hemisphere between a normal of a map and the one in a file made from it, in standard
/// deviations of a flake's lobe: twice the quantisation where 32 bits suffice.
const LARGEST_DISTANCE: f32 = 0.1;

/// The same where they do not, at the sharpest flakes.
const LEAST_DISTANCE: f32 = 5e-4;

/// What a structure was made for, besides the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flakes {
    /// Roughness of a flake.
    pub alpha: f32,
    /// Distribution of a flake's microfacets.
    pub distribution: Distribution,
    /// How texels are weighted.
    pub normalization: Normalization,
}

impl Flakes {
    /// Those of a file.
    pub fn of(header: &Header) -> Self {
        Self {
            alpha: header.alpha,
            distribution: header.distribution,
            normalization: header.normalization,
        }
    }

    /// Compares what is asked for with what the file `path` was made for.
    ///
    /// # Errors
    /// They differ; the message names the parameter, the file and what to do.
    pub fn check(&self, path: &Path, header: &Header) -> Result<()> {
        let found = Self::of(header);
        let differs = |name, asked: String, made_for: String, option: &str| {
            let reason = format!(
                "is not what {PARAMETER} \"{}\" was made for, {made_for}; leave the parameter out{option}",
                path.display()
            );
            Err(Error::parameter(name, asked, reason))
        };
        let again = |option: String| format!(", or make another file with `glints precompute ibm {option}`");
        if self.alpha != found.alpha {
            let option = match self.alpha {
                0.0 => ", or give the map as filename instead: mirrors are not saved".into(),
                alpha => again(format!("--alpha {alpha}")),
            };
            return differs("alpha", self.alpha.to_string(), found.alpha.to_string(), &option);
        }
        if self.distribution != found.distribution {
            let [asked, made_for] = [self, &found].map(|flakes| match flakes.distribution {
                Distribution::Beckmann => "beckmann",
                Distribution::Ggx => "ggx",
            });
            let option = again(format!("--distribution {asked}"));
            return differs("distribution", asked.into(), made_for.into(), &option);
        }
        if self.normalization != found.normalization {
            let [asked, made_for] = [self, &found].map(|flakes| match flakes.normalization {
                Normalization::Projected => "projected",
                Normalization::Paper => "paper",
            });
            let option = ", or give the map as filename instead";
            return differs("normalization", asked.into(), made_for.into(), option);
        }
        Ok(())
    }
}

/// The header of a saved structure; its errors name the parameter `structure_file`.
///
/// # Errors
/// Those of [`read_header`].
pub fn header(path: &Path) -> Result<Header> {
    read_header(path).map_err(named)
}

/// A loaded structure.
pub struct SavedMap {
    path: PathBuf,
    header: Header,
    structure: CompactBinMap,
}

impl SavedMap {
    /// Maps the file into memory.
    ///
    /// # Errors
    /// The file is missing, damaged, of another version or no saved structure; it was made for other `flakes`.
    pub fn load(path: &Path, flakes: &Flakes) -> Result<Self> {
        let header = header(path)?;
        flakes.check(path, &header)?;
        let structure = CompactBinMap::load(path).map_err(named)?;
        Ok(Self {
            path: path.into(),
            header,
            structure,
        })
    }

    /// How `map`, from which the structure was made, was interpolated; `None` where it was not.
    ///
    /// # Errors
    /// The sizes do not fit, or a normal in the file is not that of the map, interpolated if the file has more texels.
    pub fn check_map(&self, map: &NormalMap) -> Result<Option<Refinement>> {
        let refinement = self.refinement(map)?;
        let refined;
        let expected = match refinement {
            1 => map,
            _ => {
                refined = map.refined(refinement)?;
                &refined
            }
        };
        let limit = (LARGEST_DISTANCE * self.header.alpha / std::f32::consts::SQRT_2).max(LEAST_DISTANCE);
        let is_other = |row: u32, column: u32| {
            let [asked, found] = [expected.normal(column, row), self.structure.normal(column, row)];
            asked.truncate().distance(found.truncate()) > limit
        };
        let (columns, rows) = self.header.map;
        let other = (0..rows).into_par_iter().find_map_first(|row| {
            (0..columns)
                .find(|&column| is_other(row, column))
                .map(|column| (column, row))
        });
        match other {
            None if refinement == 1 => Ok(None),
            None => {
                let flake = Flake::new(self.header.distribution, self.header.alpha)?;
                Refinement::new(map, Some(flake), refinement).map(Some)
            }
            Some((column, row)) => Err(self.other_map(
                map,
                &format!("its normal at column {column}, row {row} is another one than in the file"),
            )),
        }
    }

    fn refinement(&self, map: &NormalMap) -> Result<u32> {
        let (columns, rows) = self.header.map;
        let refinement = columns / map.width();
        let sides = [map.width(), map.height()].map(|side| side.checked_mul(refinement));
        if (1..=MAX_REFINEMENT).contains(&refinement) && sides == [Some(columns), Some(rows)] {
            return Ok(refinement);
        }
        let sizes = format!(
            "it has {} x {} texels, the file {columns} x {rows}",
            map.width(),
            map.height()
        );
        Err(self.other_map(map, &sizes))
    }

    fn other_map(&self, map: &NormalMap, how: &str) -> Error {
        let reason = format!(
            "is not the map that {PARAMETER} \"{}\" was made from: {how}; give that map with its encoding, leave \
             filename out, or make another file with `glints precompute ibm`",
            self.path.display()
        );
        Error::parameter("filename", map.name(), reason)
    }

    /// Covariance of the slopes of the normals in the file.
    fn slope_covariance(&self) -> SlopeCovariance {
        let (columns, rows) = self.header.map;
        let slopes = |row: u32| {
            (0..columns).map(move |column| {
                let n = self.structure.normal(column, row).as_dvec3();
                -n.truncate() / n.z
            })
        };
        let count = f64::from(columns) * f64::from(rows);
        // Sums of rows are added up in their order, so that the answer does not depend on the number of threads.
        let sums: Vec<DVec2> = (0..rows).into_par_iter().map(|row| slopes(row).sum()).collect();
        let mean = sums.into_iter().sum::<DVec2>() / count;
        let squares: Vec<[f64; 3]> = (0..rows)
            .into_par_iter()
            .map(|row| {
                slopes(row).fold([0.0; 3], |[xx, xy, yy], slope| {
                    let d = slope - mean;
                    [xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y]
                })
            })
            .collect();
        let [xx, xy, yy] = [0, 1, 2].map(|k| squares.iter().map(|row| row[k]).sum::<f64>() / count);
        SlopeCovariance { xx, xy, yy }
    }

    /// What the file is for.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The BRDF over the structure; `map`, which has been checked, gives the slopes instead of the file.
    ///
    /// # Errors
    /// An explicit roughness of the masking that is none.
    pub fn into_brdf(self, masking: Masking, map: Option<&NormalMap>) -> Result<Brdf> {
        let slopes = match (masking, map) {
            (Masking::Beckmann, Some(map)) => map.slope_covariance(),
            (Masking::Beckmann, None) => self.slope_covariance(),
            // Not asked for.
            _ => SlopeCovariance::default(),
        };
        Brdf::with_slopes(|| slopes, masking, || Ok(Box::new(self.structure)))
    }

    /// The same, seen through `filter`; a file knows none, and has the pixel's box at first.
    pub fn with_filter(self, filter: FootprintFilter) -> Self {
        Self {
            structure: self.structure.with_filter(filter),
            ..self
        }
    }

    /// The structure alone.
    pub fn into_structure(self) -> CompactBinMap {
        self.structure
    }
}

/// An error about the file, with the name of its parameter.
fn named(error: Error) -> Error {
    match error {
        Error::File { path, reason } => {
            Error::parameter(PARAMETER, format!("\"{}\"", path.display()), reason)
        }
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flakes::FlakeModel;
    use approx::assert_relative_eq;
    use glam::Vec3;

    const FLAKES: Flakes = Flakes {
        alpha: 0.02,
        distribution: Distribution::Beckmann,
        normalization: Normalization::Projected,
    };

    fn wavy_map() -> NormalMap {
        let normals: Vec<Vec3> = (0..48 * 32)
            .map(|i| Vec3::new((i as f32).sin() * 0.3, (i as f32 * 1.7).cos() * 0.2, 1.0))
            .collect();
        NormalMap::from_normals("wavy", 48, 32, &normals).unwrap()
    }

    /// The structure of a map, saved and loaded; the file is gone afterwards.
    fn saved(map: &NormalMap) -> SavedMap {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.glints");
        let model = FlakeModel {
            flake: Flake::new(FLAKES.distribution, FLAKES.alpha).unwrap(),
            normalization: FLAKES.normalization,
        };
        CompactBinMap::new(map, model).save(&path).unwrap();
        let other = Flakes {
            alpha: 0.03,
            ..FLAKES
        };
        let refused = SavedMap::load(&path, &other).err().unwrap().to_string();
        assert!(
            refused.contains("\"alpha\" = 0.03") && refused.contains("0.02"),
            "{refused}"
        );
        SavedMap::load(&path, &FLAKES).unwrap()
    }

    #[test]
    fn slopes_of_the_file_are_those_of_the_map() {
        let map = wavy_map();
        let (found, expected) = (saved(&map).slope_covariance(), map.slope_covariance());
        assert_relative_eq!(found.xx, expected.xx, max_relative = 1e-3);
        assert_relative_eq!(found.yy, expected.yy, max_relative = 1e-3);
        assert!((found.xy - expected.xy).abs() < 1e-3 * expected.xx);
    }

    #[test]
    fn masking_is_that_of_the_map_where_there_is_one() {
        let map = wavy_map();
        let built = Brdf::with_slopes(
            || map.slope_covariance(),
            Masking::Beckmann,
            || Ok(Box::new(saved(&map).into_structure())),
        );
        let alphas = |map| {
            saved(&wavy_map())
                .into_brdf(Masking::Beckmann, map)
                .unwrap()
                .masking_alphas()
        };
        assert_eq!(alphas(Some(&map)), built.unwrap().masking_alphas());
        assert!(alphas(None) != alphas(Some(&map)));
        let none = saved(&map).into_brdf(Masking::None, None).unwrap();
        assert_eq!(none.masking_alphas(), (0.0, 0.0));
        assert_eq!(none.method().map_size(), (48, 32));
    }

    #[test]
    fn only_the_map_of_the_file_passes() {
        let map = wavy_map();
        assert_eq!(saved(&map).check_map(&map).unwrap(), None);
        let refined = saved(&map.refined(3).unwrap());
        assert_eq!(refined.check_map(&map).unwrap().unwrap().refinement, 3);
        let mut normals = map.normals().to_vec();
        normals[48 * 20 + 5] = Vec3::new(0.3, -0.3, 1.0);
        let other = NormalMap::from_normals("other", 48, 32, &normals).unwrap();
        let refused = saved(&map).check_map(&other).unwrap_err().to_string();
        assert!(refused.contains("column 5, row 20"), "{refused}");
        let turned = NormalMap::from_normals("turned", 32, 48, map.normals()).unwrap();
        let refused = saved(&map).check_map(&turned).unwrap_err().to_string();
        assert!(
            refused.contains("32 x 48") && refused.contains("48 x 32"),
            "{refused}"
        );
    }
}
