//! Parameters that several commands share.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use glints::flakes::{FlakeModel, Normalization};
use glints::methods::compact::Header;
use glints::methods::tensor;
use glints::microfacet::{self, Flake};
use glints::normal_map::{self, NormalMap};
use glints::refinement::{MAX_REFINEMENT, Refinement};
use glints::saved::Flakes;
use serde_json::{Value, json};

use crate::failure::{self, Failure, Result};
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
    /// Refuses what says how a map is read, for a saved structure.
    pub fn check_saved(&self) -> Result<()> {
        let given = match (self.encoding, self.flip_y) {
            (Encoding::Automatic, false) => return Ok(()),
            (Encoding::Automatic, true) => "flip_y",
            _ => "encoding",
        };
        Err(Failure::usage(format!(
            "parameter \"{given}\": \"{}\" is a saved structure, which was made from the map as it was read then; leave \
             the parameter out",
            self.map.display()
        )))
    }

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
    /// Roughness of a flake, in 0.0001 to 1: the artist's control between sharp glints and satin [default: 0.01]
    #[arg(long)]
    pub alpha: Option<f32>,

    /// Distribution of a flake's microfacets; `ggx` has a longer tail [default: beckmann]
    #[arg(long, value_enum)]
    pub distribution: Option<Distribution>,
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
        model(self.distribution.unwrap_or_default(), self.alpha.unwrap_or(0.01))
    }

    /// The flakes that a saved structure was made for, which must be those that are given.
    pub fn of_saved(&self, path: &Path, header: &Header) -> Result<(Flakes, FlakeModel)> {
        let found = Flakes::of(header);
        let asked = Flakes {
            alpha: self.alpha.unwrap_or(found.alpha),
            distribution: self.distribution.map_or(found.distribution, Into::into),
            ..found
        };
        asked.check(path, header)?;
        let flake = Flake::new(found.distribution, found.alpha)?;
        let normalization = found.normalization;
        Ok((found, FlakeModel { flake, normalization }))
    }
}

/// Of tensor-decomposed distributions.
#[derive(Args)]
pub struct TensorOptions {
    /// Largest rank of a group of blocks, 1 to 64: memory and time against accuracy [default: 32, with --published 16]
    #[arg(long)]
    rank: Option<u32>,

    /// Relative error of a group at which a smaller rank is taken; 0: all groups have the same
    #[arg(long, value_name = "ERROR", default_value_t = 0.0)]
    rank_error: f32,

    /// Texels between images of the finest level
    #[arg(long, value_name = "TEXELS", default_value_t = 32)]
    stride: u32,

    /// Pixels per side of an image of the hemisphere, a multiple of 16
    #[arg(long, value_name = "PIXELS", default_value_t = 256)]
    resolution: u32,

    /// Relative error of a decomposition at which the solver stops [default: 0.001, with --published 0.0001]
    #[arg(long, value_name = "ERROR")]
    tolerance: Option<f64>,

    /// Relative L1 difference of neighbouring levels below which the coarser one is left out
    #[arg(long, value_name = "DIFFERENCE", default_value_t = 0.02)]
    agreement: f32,

    /// The solver as published: random start, up to 500 iterations
    #[arg(long)]
    published: bool,
}

impl TensorOptions {
    pub fn options(&self) -> Result<tensor::Options> {
        let own = match self.published {
            true => tensor::Options::published(),
            false => tensor::Options::default(),
        };
        let options = tensor::Options {
            rank: self.rank.unwrap_or(own.rank),
            error: self.rank_error,
            stride: self.stride,
            resolution: self.resolution,
            agreement: self.agreement,
            solver: tensor::cp::Options {
                tolerance: self.tolerance.unwrap_or(own.solver.tolerance),
                ..own.solver
            },
            ..own
        };
        options.check()?;
        Ok(options)
    }
}

/// What the surface is between the centres of texels.
#[derive(Args)]
pub struct InterpolationArguments {
    /// The surface between the centres of texels: `nearest`, flat texels, or `bilinear`, the interpolated map,
    /// which is resampled to more texels
    #[arg(long, value_enum, default_value_t)]
    pub interpolation: Interpolation,

    /// Texels per texel and side of an interpolated map, 1 to 8, at the square of memory; 0: as many as its
    /// bends and the roughness ask for
    #[arg(long, value_name = "TEXELS", default_value_t = 0)]
    refinement: u32,
}

/// See [`glints::refinement`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Interpolation {
    #[default]
    Nearest,
    Bilinear,
}

impl InterpolationArguments {
    /// Refuses what can be told before a map is read.
    pub fn check(&self) -> Result<()> {
        let problem = if self.refinement > MAX_REFINEMENT {
            "must be 1 to 8, or 0 for as many as the map needs"
        } else if self.refinement > 0 && self.interpolation == Interpolation::Nearest {
            "is for interpolated maps; add --interpolation bilinear, or leave it out"
        } else {
            return Ok(());
        };
        Err(Failure::usage(format!(
            "parameter \"refinement\" = {}: {problem}",
            self.refinement
        )))
    }

    /// Refuses all of this for a saved structure.
    pub fn check_saved(&self, path: &Path) -> Result<()> {
        if self.interpolation == Interpolation::Nearest {
            return self.check();
        }
        Err(Failure::usage(format!(
            "parameter \"interpolation\" = bilinear: \"{}\" is a saved structure, of an interpolated map if `precompute` \
             was told so; leave the parameter out, or give the map",
            path.display()
        )))
    }

    /// How an interpolated map is resampled; `None` for flat texels. Warns if that leaves facets.
    pub fn refinement(&self, map: &NormalMap, model: FlakeModel) -> Result<Option<Refinement>> {
        if self.interpolation == Interpolation::Nearest {
            return Ok(None);
        }
        let refinement = Refinement::new(map, Some(model.flake), self.refinement)?;
        if let Some(warning) = refinement.warning() {
            failure::warn(&warning);
        }
        Ok(Some(refinement))
    }
}

/// The resampled map, or the map itself.
pub fn refined<'a>(map: &'a NormalMap, refinement: Option<Refinement>) -> Result<Cow<'a, NormalMap>> {
    let Some(Refinement { refinement, .. }) = refinement else {
        return Ok(Cow::Borrowed(map));
    };
    let _progress = Progress::spinner("interpolating the map");
    Ok(Cow::Owned(map.refined(refinement)?))
}

/// For reports; null for flat texels.
pub fn refinement_json(refinement: Option<Refinement>) -> Value {
    refinement.map_or(
        Value::Null,
        |r| json!({ "texels_per_side": r.refinement, "step": r.step }),
    )
}

/// The same in words.
pub fn refinement_text(refinement: &Value) -> String {
    format!(
        "interpolated, {0} x {0} texels for each, {1:.2} standard deviations of a lobe apart",
        refinement["texels_per_side"],
        refinement["step"].as_f64().unwrap_or(f64::NAN)
    )
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
