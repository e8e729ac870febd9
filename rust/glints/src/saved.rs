//! A saved inverse bin map in the place of the map that it was made from.
//!
//! A renderer that is handed the file of `glints precompute ibm` maps it into memory and builds nothing. The file stands
//! for the map, the flakes and the interpolation, so whatever else a scene says about them must agree with it:
//! [`SavedMap::load`] compares the flakes, [`SavedMap::check_map`] the map, by a checksum of its normals. That is bit for bit:
//! the same picture in another encoding, or decoded by a library that rounds differently, is another map.
//!
//! **Shadowing of the whole map** `G_x` is made of the covariance of the map's slopes, which the file has: answers are those of a
//! structure that was built, bit for bit, with the map and without.

use std::path::{Path, PathBuf};

use crate::brdf::{Brdf, Masking};
use crate::error::{Error, Result};
use crate::flakes::Normalization;
use crate::footprint_filter::FootprintFilter;
use crate::methods::compact::{CompactBinMap, Header, read_header};
use crate::microfacet::Distribution;
use crate::normal_map::NormalMap;

/// Name of the parameter that names the file, in messages.
const PARAMETER: &str = "structure_file";

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
        let (structure, header) = CompactBinMap::load(path).map_err(named)?;
        flakes.check(path, &header)?;
        Ok(Self {
            path: path.into(),
            header,
            structure,
        })
    }

    /// Compares `map` with the one that the structure was made from.
    ///
    /// # Errors
    /// It has another size, or other normals.
    pub fn check_map(&self, map: &NormalMap) -> Result<()> {
        let origin = &self.header.origin;
        let (columns, rows) = origin.size;
        if (map.width(), map.height()) != origin.size {
            let sizes = format!(
                "it has {} x {} texels, that map {columns} x {rows}",
                map.width(),
                map.height()
            );
            return Err(self.other_map(map, &sizes));
        }
        let found = map.checksum();
        if found != origin.checksum {
            let sums = format!(
                "its normals have the checksum {found:08x}, those of that map {:08x}",
                origin.checksum
            );
            return Err(self.other_map(map, &sums));
        }
        Ok(())
    }

    fn other_map(&self, map: &NormalMap, how: &str) -> Error {
        let reason = format!(
            "is not the map that {PARAMETER} \"{}\" was made from: {how}; give that map with its encoding and flip_y, \
             leave filename out, or make another file with `glints precompute ibm`",
            self.path.display()
        );
        Error::parameter("filename", map.name(), reason)
    }

    /// What the file is for.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The BRDF over the structure.
    ///
    /// # Errors
    /// An explicit roughness of the masking that is none.
    pub fn into_brdf(self, masking: Masking) -> Result<Brdf> {
        Brdf::with_slopes(
            || self.header.origin.slopes,
            masking,
            || Ok(Box::new(self.structure)),
        )
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
    use crate::methods::compact::Origin;
    use crate::microfacet::Flake;
    use crate::refinement::Refinement;
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

    /// The structure of a map, interpolated to `refinement` texels for each if that is not 0; the file is gone afterwards.
    fn saved(map: &NormalMap, refinement: u32) -> SavedMap {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.glints");
        let flake = Flake::new(FLAKES.distribution, FLAKES.alpha).unwrap();
        let model = FlakeModel {
            flake,
            normalization: FLAKES.normalization,
        };
        let interpolated = (refinement > 0).then(|| Refinement::new(map, Some(flake), refinement).unwrap());
        CompactBinMap::new(&map.refined(refinement.max(1)).unwrap(), model)
            .save(&Origin::new(map, interpolated), &path)
            .unwrap();
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
    fn slopes_are_those_of_the_map_whatever_the_interpolation() {
        let map = wavy_map();
        let refined = map.refined(3).unwrap().slope_covariance();
        for refinement in [0, 1, 3] {
            let found = saved(&map, refinement).header().origin.slopes;
            assert_eq!(found, map.slope_covariance());
            assert!(found != refined);
        }
    }

    #[test]
    fn masking_is_that_of_the_map() {
        let map = wavy_map();
        let alphas = |brdf: Result<Brdf>| brdf.unwrap().masking_alphas();
        let expected = alphas(Brdf::new(&map, Masking::Beckmann, || {
            Ok(Box::new(saved(&map, 0).into_structure()))
        }));
        assert!(expected.0 > 0.0 && expected.1 > 0.0 && expected.0 != expected.1);
        for refinement in [0, 2] {
            assert_eq!(
                alphas(saved(&map, refinement).into_brdf(Masking::Beckmann)),
                expected
            );
        }
        let none = saved(&map, 0).into_brdf(Masking::None).unwrap();
        assert_eq!(none.masking_alphas(), (0.0, 0.0));
        assert_eq!(none.method().map_size(), (48, 32));
    }

    #[test]
    fn only_the_map_of_the_file_passes() {
        let map = wavy_map();
        for refinement in [0, 1, 3] {
            let saved = saved(&map, refinement);
            saved.check_map(&map).unwrap();
            let found = saved.header().origin.refinement;
            assert_eq!(
                found.map(|r| r.refinement),
                (refinement > 0).then_some(refinement)
            );
        }
        let refused = |map: &NormalMap| saved(&wavy_map(), 0).check_map(map).unwrap_err().to_string();
        // Of the same size, with one other texel, which moves by less than the structure keeps.
        let mut normals = map.normals().to_vec();
        normals[48 * 20 + 5].x += 1e-6;
        let other = NormalMap::from_normals("other", 48, 32, &normals).unwrap();
        let sums = [other.checksum(), map.checksum()].map(|sum| format!("{sum:08x}"));
        for words in [
            ["other", "map.glints"],
            [&sums[0], &sums[1]],
            ["encoding", "glints precompute"],
        ] {
            let refused = refused(&other);
            assert!(words.iter().all(|word| refused.contains(word)), "{refused}");
        }
        let turned = NormalMap::from_normals("turned", 32, 48, map.normals()).unwrap();
        let refused = refused(&turned);
        assert!(
            refused.contains("32 x 48") && refused.contains("48 x 32"),
            "{refused}"
        );
    }
}
