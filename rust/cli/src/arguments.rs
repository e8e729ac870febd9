//! Parameters that several commands share.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use glints::flakes::{FlakeModel, Normalization};
use glints::microfacet::{self, Flake};
use glints::normal_map::{self, NormalMap};

use crate::failure::Result;
use crate::progress::Progress;

/// Which file, and how it stores normals.
#[derive(Args)]
pub struct MapArguments {
    /// Normal map: EXR, PNG, JPEG or TIFF
    pub map: PathBuf,

    /// How a normal's components are stored: `unsigned` in 0 to 1, `signed` in -1 to 1; `auto` takes
    /// floating-point files with a negative component for signed ones
    #[arg(long, value_enum, default_value_t)]
    encoding: Encoding,

    /// Negate y: for maps whose green channel points down
    #[arg(long)]
    flip_y: bool,
}

#[derive(Clone, Copy, Default, ValueEnum)]
enum Encoding {
    #[default]
    #[value(name = "auto", alias = "automatic")]
    Automatic,
    Unsigned,
    Signed,
}

impl MapArguments {
    /// Reads the map.
    pub fn load(&self) -> Result<NormalMap> {
        let _progress = Progress::spinner("reading the map");
        let encoding = match self.encoding {
            Encoding::Automatic => normal_map::Encoding::Automatic,
            Encoding::Unsigned => normal_map::Encoding::Unsigned,
            Encoding::Signed => normal_map::Encoding::Signed,
        };
        Ok(NormalMap::load(&self.map, encoding, self.flip_y)?)
    }
}

/// The micro-BRDF of a flake.
#[derive(Args)]
pub struct FlakeArguments {
    /// Roughness of a flake, in 0.0001 to 1: the artist's control between sharp glints and satin
    #[arg(long, default_value_t = 0.01)]
    pub alpha: f32,

    /// Distribution of a flake's microfacets; `ggx` has a longer tail
    #[arg(long, value_enum, default_value_t)]
    pub distribution: Distribution,
}

/// See [`microfacet::Distribution`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Distribution {
    #[default]
    Beckmann,
    Ggx,
}

impl From<Distribution> for microfacet::Distribution {
    fn from(distribution: Distribution) -> Self {
        match distribution {
            Distribution::Beckmann => Self::Beckmann,
            Distribution::Ggx => Self::Ggx,
        }
    }
}

impl FlakeArguments {
    pub fn model(&self) -> Result<FlakeModel> {
        model(self.distribution, self.alpha)
    }
}

/// Flakes that share the projected area, so that the distribution of normals integrates to one.
pub fn model(distribution: Distribution, alpha: f32) -> Result<FlakeModel> {
    Ok(FlakeModel {
        flake: Flake::new(distribution.into(), alpha)?,
        normalization: Normalization::Projected,
    })
}

/// A parameter for JSON, with the digits that were given.
pub fn decimal(parameter: f32) -> f64 {
    parameter.to_string().parse().unwrap_or(parameter.into())
}
