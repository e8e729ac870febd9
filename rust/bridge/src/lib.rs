//! The whole FFI surface between the Rust library and C++; C++ programs use `cpp/include/glints/glints.h`,
//! which wraps it.
//!
//! # Invariants
//!
//! * Errors cross as `Result`, which cxx turns into exceptions. Constructors run inside [`guarded`], so that
//!   a panic does not abort the host: it becomes an error, too. (Running out of memory still aborts.)
//! * Evaluation is total and free of panics; it takes plain values and a shared reference, from any thread.
//! * This crate has no unsafe code of its own.

use std::borrow::Cow;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::Instant;

use glam::{Mat3, Vec2, Vec3};
use glints::brdf::{Brdf as Core, Masking};
use glints::environment_file;
use glints::environment_map::EnvironmentMap;
use glints::error::{Error, Result};
use glints::flake_layer::{self, LayerMasking};
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint_filter::FootprintFilter;
use glints::gtr::Gtr;
use glints::methods::Method;
use glints::methods::compact::{CompactBinMap, Origin};
use glints::methods::direct::Direct;
use glints::methods::inverse_bin_map::{self, Binning, InverseBinMap, SpecularBinMap, SpecularOptions};
use glints::methods::tensor::{self, Tensor};
use glints::methods::unfiltered::{Interpolation, Unfiltered};
use glints::methods::yan16::{self, Elements, Yan16};
use glints::microfacet::{Distribution, Flake};
use glints::mip_map::MipMap;
use glints::normal_map::{Encoding, NormalMap};
use glints::prefilter::{self, Prefilter};
use glints::refinement::Refinement;
use glints::saved::{self, Flakes, SavedMap};
use glints::spherical_gaussians::{Light, SphericalGaussians};

#[cxx::bridge(namespace = "glints::bridge")]
mod ffi {
    // ---- values -------------------------------------------------------------------------------------------------------------

    #[derive(Clone, Copy)]
    struct Vector {
        x: f32,
        y: f32,
        z: f32,
    }

    /// In uv units: centre and partial derivatives along the pixel's axes.
    #[derive(Clone, Copy)]
    struct Footprint {
        uv: [f32; 2],
        duv_dx: [f32; 2],
        duv_dy: [f32; 2],
    }

    #[derive(Clone, Copy)]
    struct Evaluation {
        value: f32,
        pdf: f32,
    }

    #[derive(Clone, Copy)]
    struct Sample {
        wo: Vector,
        value: f32,
        pdf: f32,
        valid: bool,
    }

    #[derive(Clone, Copy)]
    enum MapEncoding {
        Automatic,
        Unsigned,
        Signed,
    }

    #[derive(Clone, Copy)]
    enum MaskingKind {
        None,
        Beckmann,
        Explicit,
    }

    #[derive(Clone, Copy)]
    enum FlakeDistribution {
        Beckmann,
        Ggx,
    }

    #[derive(Clone, Copy)]
    struct Surface {
        distribution: FlakeDistribution,
        alpha: f32,
        projected: bool,
        masking: MaskingKind,
        masking_alpha_u: f32,
        masking_alpha_v: f32,
    }

    #[derive(Clone, Copy)]
    enum BinningKind {
        Automatic,
        Projected,
        EqualSolidAngle,
    }

    #[derive(Clone, Copy)]
    enum StructureKind {
        Automatic,
        Compact,
        Paper,
    }

    /// Numbers of zero: the method's own.
    #[derive(Clone, Copy)]
    struct InverseBinMapOptions {
        structure: StructureKind,
        bins: u32,
        leaf_size: u32,
        binning: BinningKind,
    }

    /// What a saved structure was made for; refinement of zero: without interpolation.
    struct SavedStructure {
        width: u32,
        height: u32,
        refinement: u32,
        refinement_step: f32,
        distribution: FlakeDistribution,
        alpha: f32,
        projected: bool,
    }

    /// Refinement of zero: as many texels as the map needs.
    #[derive(Clone, Copy)]
    struct InterpolationOptions {
        bilinear: bool,
        refinement: u32,
    }

    /// The deviation is the Gaussian's, in pixels; ignored for the box.
    #[derive(Clone, Copy)]
    struct FilterOptions {
        gaussian: bool,
        footprint_sigma: f32,
    }

    #[derive(Clone, Copy)]
    struct Yan16Options {
        curved: bool,
        refinement: u32,
        footprint_sigma: f32,
    }

    /// Numbers of zero: the method's own.
    #[derive(Clone, Copy)]
    struct TensorOptions {
        rank: u32,
        error: f32,
        resolution: u32,
        stride: u32,
        published: bool,
    }

    #[derive(Clone, Copy)]
    struct FlakeLayerOptions {
        bins: u32,
        leaf_size: u32,
        /// Zero: the masking of the surface.
        gtr_gamma: f32,
        gtr_alpha: f32,
        largest_sine: f32,
    }

    #[derive(Clone, Copy)]
    enum Drawn {
        Flake,
        Gap,
        Nothing,
    }

    #[derive(Clone, Copy)]
    struct FlakeSample {
        drawn: Drawn,
        wo: Vector,
    }

    /// The mean of a distribution over a rectangle; `known` is false where a method cannot tell.
    #[derive(Clone, Copy)]
    struct RangeMean {
        known: bool,
        mean: f32,
    }

    /// A spherical Gaussian with its share of the environment's light.
    #[derive(Clone, Copy)]
    struct Lobe {
        axis: Vector,
        sharpness: f32,
        weight: f32,
    }

    /// A lobe of an environment, drawn by a BRDF; `value` is averaged over the lobe.
    #[derive(Clone, Copy)]
    struct LobeSample {
        lobe: u32,
        probability: f32,
        wo: Vector,
        value: f32,
        valid: bool,
    }

    struct Statistics {
        method: String,
        width: u32,
        height: u32,
        alpha: f32,
        distribution: FlakeDistribution,
        structure_bytes: u64,
        build_seconds: f64,
        bins: u32,
        refinement: u32,
        refinement_step: f32,
        masking_alpha_u: f32,
        masking_alpha_v: f32,
        warning: String,
    }

    // ---- what C++ may call ------------------------------------------------------------------------------------------------

    extern "Rust" {
        type Map;
        fn load_map(filename: &str, encoding: MapEncoding, flip_y: bool) -> Result<Box<Map>>;
        fn map_from_normals(name: &str, width: u32, height: u32, xyz: &[f32]) -> Result<Box<Map>>;
        fn width(self: &Map) -> u32;
        fn height(self: &Map) -> u32;
        fn normal(self: &Map, column: i64, row: i64) -> Vector;

        type Brdf;
        fn inverse_bin_map(
            map: &Map,
            surface: Surface,
            options: InverseBinMapOptions,
            interpolation: InterpolationOptions,
            filter: FilterOptions,
        ) -> Result<Box<Brdf>>;
        fn direct(
            map: &Map,
            surface: Surface,
            interpolation: InterpolationOptions,
            filter: FilterOptions,
        ) -> Result<Box<Brdf>>;
        fn saved_structure(filename: &str) -> Result<SavedStructure>;
        fn load_inverse_bin_map(filename: &str, surface: Surface, filter: FilterOptions)
        -> Result<Box<Brdf>>;
        /// Checks that the structure is that of a map.
        fn load_inverse_bin_map_of(
            map: &Map,
            filename: &str,
            surface: Surface,
            filter: FilterOptions,
        ) -> Result<Box<Brdf>>;
        fn unfiltered(map: &Map, surface: Surface, bilinear: bool) -> Result<Box<Brdf>>;
        fn yan16(map: &Map, surface: Surface, options: Yan16Options) -> Result<Box<Brdf>>;
        /// The file of a precomputation in the folder `cache`, whether it is there or not.
        fn tensor_cache_file(
            map: &Map,
            surface: Surface,
            options: TensorOptions,
            cache: &str,
        ) -> Result<String>;
        fn tensor(map: &Map, surface: Surface, options: TensorOptions, cache: &str) -> Result<Box<Brdf>>;
        /// `surface` without the roughness and the distribution of flakes, which are the file's.
        fn tensor_from_file(filename: &str, surface: Surface) -> Result<Box<Brdf>>;
        fn evaluate(self: &Brdf, footprint: Footprint, wi: Vector, wo: Vector) -> Evaluation;
        fn pdf(self: &Brdf, footprint: Footprint, wi: Vector, wo: Vector) -> f32;
        fn sample(self: &Brdf, footprint: Footprint, wi: Vector, u: [f32; 3]) -> Sample;
        fn ndf(self: &Brdf, footprint: Footprint, h: Vector) -> f32;
        fn ndf_over(self: &Brdf, footprint: Footprint, low: [f32; 2], high: [f32; 2]) -> RangeMean;
        fn prefilters(self: &Brdf) -> bool;
        /// `axes`: the local frame's x, y and z in the environment's coordinates.
        fn sample_lobe(
            self: &Brdf,
            footprint: Footprint,
            wi: Vector,
            axes: [Vector; 3],
            environment: &Environment,
            u: [f32; 3],
        ) -> LobeSample;
        fn statistics(self: &Brdf) -> Statistics;

        type Environment;
        /// Three components for each direction, one weight.
        fn environment(
            directions: &[f32],
            weights: &[f32],
            lobes: u32,
            epsilon: f32,
            candidates: u32,
            seed: u64,
        ) -> Result<Box<Environment>>;
        /// Of a latitude-longitude picture of radiances, three numbers a pixel, in the picture's frame.
        fn environment_of_map(
            width: u32,
            height: u32,
            rgb: &[f32],
            lobes: u32,
            epsilon: f32,
            candidates: u32,
        ) -> Result<Box<Environment>>;
        /// A fit of `glints environment`, in the frame of its picture.
        fn environment_from_file(filename: &str, epsilon: f32, candidates: u32) -> Result<Box<Environment>>;
        /// The same light in another frame, where the axes x, y, z are `axes`.
        fn turned(self: &Environment, axes: [Vector; 3]) -> Result<Box<Environment>>;
        /// The residual and the map's file name that the file tells; one and empty for a fit that comes from no file.
        fn saved_residual(self: &Environment) -> f64;
        fn map_name(self: &Environment) -> String;
        fn lobe_count(self: &Environment) -> u32;
        fn lobe(self: &Environment, index: u32) -> Lobe;
        fn density(self: &Environment, direction: Vector) -> f32;
        /// `channels` values for each direction, lobe by lobe in the answer.
        fn energies(
            self: &Environment,
            directions: &[f32],
            values: &[f32],
            channels: u32,
        ) -> Result<Vec<f32>>;
        fn residual(
            self: &Environment,
            directions: &[f32],
            weights: &[f32],
            radiances: &[f32],
        ) -> Result<f64>;

        type FlakeLayer;
        /// `mask` names a file; empty: every texel holds a flake.
        fn flake_layer(
            map: &Map,
            mask: &str,
            surface: Surface,
            options: FlakeLayerOptions,
        ) -> Result<Box<FlakeLayer>>;
        fn cover(self: &FlakeLayer, footprint: Footprint) -> f32;
        #[cxx_name = "evaluate"]
        fn evaluate_flakes(self: &FlakeLayer, footprint: Footprint, wi: Vector, wo: Vector) -> Evaluation;
        #[cxx_name = "sample"]
        fn sample_flakes(self: &FlakeLayer, footprint: Footprint, wi: Vector, u: [f32; 3]) -> FlakeSample;
        #[cxx_name = "statistics"]
        fn layer_statistics(self: &FlakeLayer) -> Statistics;
    }
}

// ---- normal maps --------------------------------------------------------------------------------------------------------------

/// A shared, immutable normal map.
pub struct Map(NormalMap);

fn load_map(filename: &str, encoding: ffi::MapEncoding, flip_y: bool) -> Result<Box<Map>> {
    let encoding = match encoding {
        ffi::MapEncoding::Unsigned => Encoding::Unsigned,
        ffi::MapEncoding::Signed => Encoding::Signed,
        _ => Encoding::Automatic,
    };
    guarded("filename", filename, || {
        NormalMap::load(filename, encoding, flip_y).map(|map| Box::new(Map(map)))
    })
}

fn map_from_normals(name: &str, width: u32, height: u32, xyz: &[f32]) -> Result<Box<Map>> {
    let normals: Vec<Vec3> = xyz.chunks_exact(3).map(Vec3::from_slice).collect();
    guarded("filename", name, || {
        NormalMap::from_normals(name, width, height, &normals).map(|map| Box::new(Map(map)))
    })
}

impl Map {
    fn width(&self) -> u32 {
        self.0.width()
    }

    fn height(&self) -> u32 {
        self.0.height()
    }

    fn normal(&self, column: i64, row: i64) -> ffi::Vector {
        let wrap = |i: i64, side: u32| i.rem_euclid(i64::from(side)) as u32;
        let n = self
            .0
            .normal(wrap(column, self.0.width()), wrap(row, self.0.height()));
        to_ffi(n)
    }
}

// ---- BRDFs ----------------------------------------------------------------------------------------------------------------------

/// A method over a map, and how long it took to build or to load.
pub struct Brdf {
    core: Core,
    /// Columns and rows of the map; without it, those of the structure.
    map: (u32, u32),
    surface: ffi::Surface,
    /// For methods that answer range queries.
    prefilter: Option<Prefilter>,
    build_seconds: f64,
    refinement: Option<Refinement>,
}

/// One normal a texel, for methods that interpolate themselves or not at all.
const AS_IT_IS: ffi::InterpolationOptions = ffi::InterpolationOptions {
    bilinear: false,
    refinement: 0,
};

fn inverse_bin_map(
    map: &Map,
    surface: ffi::Surface,
    options: ffi::InverseBinMapOptions,
    interpolation: ffi::InterpolationOptions,
    filter: ffi::FilterOptions,
) -> Result<Box<Brdf>> {
    let footprint_filter = footprint_filter(filter)?;
    build(map, surface, interpolation, |map| {
        if is_compact(surface, options)? {
            let structure = CompactBinMap::new(&map, flakes(surface)?);
            return Ok(Box::new(structure.with_filter(footprint_filter)));
        }
        if filter.gaussian {
            return Err(Error::Parameter {
                name: "footprint_filter",
                value: "gaussian".into(),
                reason: "the paper's inverse bin map, which structure = paper, bins, leaf_size, binning and alpha = 0 \
                         ask for, counts texels of equal weight, which only a box has; leave the parameter out, or \
                         take structure = compact with a roughness, or glints_direct"
                    .into(),
            });
        }
        if surface.alpha == 0.0 {
            let options = specular_options(surface, options)?;
            return Ok(Box::new(SpecularBinMap::new(&map, options)?));
        }
        if options.binning == ffi::BinningKind::EqualSolidAngle {
            return Err(Error::Parameter {
                name: "binning",
                value: "equal_solid_angle".into(),
                reason: "is only for specular flakes, alpha = 0: rough ones need the neighbours of a bin at \
                         constant offsets on the projected hemisphere; leave the parameter out"
                    .into(),
            });
        }
        let options = inverse_bin_map_options(options.bins, options.leaf_size);
        Ok(Box::new(InverseBinMap::new(&map, flakes(surface)?, options)?))
    })
}

fn saved_structure(filename: &str) -> Result<ffi::SavedStructure> {
    guarded("structure_file", filename, || {
        let header = saved::header(Path::new(filename))?;
        Ok(ffi::SavedStructure {
            width: header.origin.size.0,
            height: header.origin.size.1,
            refinement: header.origin.refinement.map_or(0, |r| r.refinement),
            refinement_step: header.origin.refinement.map_or(0.0, |r| r.step as f32),
            distribution: distribution_to_ffi(header.distribution),
            alpha: header.alpha,
            projected: header.normalization == Normalization::Projected,
        })
    })
}

fn load_inverse_bin_map(
    filename: &str,
    surface: ffi::Surface,
    filter: ffi::FilterOptions,
) -> Result<Box<Brdf>> {
    load(filename, surface, filter, None)
}

fn load_inverse_bin_map_of(
    map: &Map,
    filename: &str,
    surface: ffi::Surface,
    filter: ffi::FilterOptions,
) -> Result<Box<Brdf>> {
    load(filename, surface, filter, Some(&map.0))
}

fn load(
    filename: &str,
    surface: ffi::Surface,
    filter: ffi::FilterOptions,
    map: Option<&NormalMap>,
) -> Result<Box<Brdf>> {
    let filter = footprint_filter(filter)?;
    guarded("structure_file", filename, || {
        let flakes = Flakes {
            alpha: surface.alpha,
            distribution: distribution(surface),
            normalization: normalization(surface),
        };
        let start = Instant::now();
        let saved = SavedMap::load(Path::new(filename), &flakes)?;
        if let Some(map) = map {
            saved.check_map(map)?;
        }
        let Origin { size, refinement, .. } = saved.header().origin;
        let core = saved.with_filter(filter).into_brdf(masking(surface))?;
        Ok(Box::new(Brdf {
            core,
            map: size,
            surface,
            // A bin map has no range query.
            prefilter: None,
            build_seconds: start.elapsed().as_secs_f64(),
            refinement,
        }))
    })
}

/// Which structure is meant: the paper's where a parameter asks for it that only it has, else the compact one.
fn is_compact(surface: ffi::Surface, options: ffi::InverseBinMapOptions) -> Result<bool> {
    let asks_for_paper = [
        (surface.alpha == 0.0, "alpha = 0"),
        (options.bins > 0, "bins"),
        (options.leaf_size > 0, "leaf_size"),
        (options.binning != ffi::BinningKind::Automatic, "binning"),
    ];
    let asking = asks_for_paper
        .iter()
        .find(|(asks, _)| *asks)
        .map(|(_, name)| *name);
    match (options.structure, asking) {
        (ffi::StructureKind::Paper, _) => Ok(false),
        (ffi::StructureKind::Compact, Some(name)) => Err(Error::Parameter {
            name: "structure",
            value: "compact".into(),
            reason: format!("has no {name}; leave {name} out, or take structure = paper"),
        }),
        (_, asking) => Ok(asking.is_none()),
    }
}

fn specular_options(surface: ffi::Surface, options: ffi::InverseBinMapOptions) -> Result<SpecularOptions> {
    if options.bins == 0 {
        return Err(Error::Parameter {
            name: "bins",
            value: "0".into(),
            reason: "specular flakes, alpha = 0, have no roughness to derive it from; give the bins per side, such as \
                     127, or a roughness"
                .into(),
        });
    }
    if distribution(surface) != Distribution::Beckmann {
        return Err(Error::Parameter {
            name: "distribution",
            value: "ggx".into(),
            reason: "specular flakes, alpha = 0, have no microfacets; leave the parameter out".into(),
        });
    }
    Ok(SpecularOptions {
        bins: options.bins,
        binning: match options.binning {
            ffi::BinningKind::Projected => Binning::Projected,
            _ => Binning::EqualSolidAngle,
        },
        leaf_size: (options.leaf_size > 0).then_some(options.leaf_size),
        normalization: normalization(surface),
    })
}

fn footprint_filter(filter: ffi::FilterOptions) -> Result<FootprintFilter> {
    match filter.gaussian {
        true => FootprintFilter::gaussian(filter.footprint_sigma),
        false => Ok(FootprintFilter::Box),
    }
}

fn inverse_bin_map_options(bins: u32, leaf_size: u32) -> inverse_bin_map::Options {
    inverse_bin_map::Options {
        bins: (bins > 0).then_some(bins),
        leaf_size: (leaf_size > 0).then_some(leaf_size),
    }
}

fn direct(
    map: &Map,
    surface: ffi::Surface,
    interpolation: ffi::InterpolationOptions,
    filter: ffi::FilterOptions,
) -> Result<Box<Brdf>> {
    let filter = footprint_filter(filter)?;
    build(map, surface, interpolation, |map| {
        let direct = Direct::with_filter(map.into_owned(), flakes(surface)?, filter);
        Ok(Box::new(direct))
    })
}

fn unfiltered(map: &Map, surface: ffi::Surface, bilinear: bool) -> Result<Box<Brdf>> {
    let interpolation = if bilinear {
        Interpolation::Bilinear
    } else {
        Interpolation::Nearest
    };
    build(map, surface, AS_IT_IS, |map| {
        Ok(Box::new(Unfiltered::new(
            map.into_owned(),
            flakes(surface)?,
            interpolation,
        )))
    })
}

fn yan16(map: &Map, surface: ffi::Surface, options: ffi::Yan16Options) -> Result<Box<Brdf>> {
    build(map, surface, AS_IT_IS, |map| {
        if !surface.projected {
            return Err(Error::Parameter {
                name: "normalization",
                value: "paper".into(),
                reason: "a position-normal distribution is one of projected area; leave the parameter out"
                    .into(),
            });
        }
        if flakes(surface)?.flake.kind() != Distribution::Beckmann {
            return Err(Error::Parameter {
                name: "distribution",
                value: "ggx".into(),
                reason: "the elements of this method are Gaussian, as beckmann flakes are; leave the parameter out"
                    .into(),
            });
        }
        let elements = match (options.curved, options.refinement) {
            (false, _) => Elements::Flat,
            (true, 0) => Elements::Curved {
                refinement: yan16::resolving_refinement(&map),
            },
            (true, refinement) => Elements::Curved { refinement },
        };
        let options = yan16::Options {
            elements,
            intrinsic: surface.alpha / std::f32::consts::SQRT_2,
            footprint_sigma: options.footprint_sigma,
        };
        Ok(Box::new(Yan16::new(&map, options)?))
    })
}

fn tensor_options(options: ffi::TensorOptions) -> tensor::Options {
    let own = if options.published {
        tensor::Options::published()
    } else {
        tensor::Options::default()
    };
    let or = |given: u32, own: u32| if given > 0 { given } else { own };
    tensor::Options {
        rank: or(options.rank, own.rank),
        resolution: or(options.resolution, own.resolution),
        stride: or(options.stride, own.stride),
        error: if options.error > 0.0 {
            options.error
        } else {
            own.error
        },
        ..own
    }
}

fn tensor_cache_file(
    map: &Map,
    surface: ffi::Surface,
    options: ffi::TensorOptions,
    cache: &str,
) -> Result<String> {
    guarded("filename", map.0.name(), || {
        let path = tensor::cache_path(
            &map.0,
            flakes(surface)?,
            &tensor_options(options),
            Path::new(cache),
        );
        Ok(path.display().to_string())
    })
}

fn tensor(map: &Map, surface: ffi::Surface, options: ffi::TensorOptions, cache: &str) -> Result<Box<Brdf>> {
    build(map, surface, AS_IT_IS, |map| {
        let options = tensor_options(options);
        let (tensor, _) = Tensor::cached(&map, flakes(surface)?, &options, Path::new(cache), &|_| ())?;
        Ok(Box::new(tensor))
    })
}

fn tensor_from_file(filename: &str, surface: ffi::Surface) -> Result<Box<Brdf>> {
    let start = Instant::now();
    let (tensor, map) = guarded("ndf_file", filename, || Tensor::load(Path::new(filename)))?;
    let flake = tensor.model().flake;
    let surface = ffi::Surface {
        alpha: flake.alpha(),
        distribution: distribution_to_ffi(flake.kind()),
        ..surface
    };
    let mut brdf = build(&Map(map), surface, AS_IT_IS, |_| Ok(Box::new(tensor)))?;
    brdf.build_seconds = start.elapsed().as_secs_f64();
    Ok(brdf)
}

fn flakes(surface: ffi::Surface) -> Result<FlakeModel> {
    Ok(FlakeModel {
        flake: Flake::new(distribution(surface), surface.alpha)?,
        normalization: normalization(surface),
    })
}

fn distribution(surface: ffi::Surface) -> Distribution {
    match surface.distribution {
        ffi::FlakeDistribution::Ggx => Distribution::Ggx,
        _ => Distribution::Beckmann,
    }
}

fn distribution_to_ffi(distribution: Distribution) -> ffi::FlakeDistribution {
    match distribution {
        Distribution::Beckmann => ffi::FlakeDistribution::Beckmann,
        Distribution::Ggx => ffi::FlakeDistribution::Ggx,
    }
}

fn normalization(surface: ffi::Surface) -> Normalization {
    if surface.projected {
        Normalization::Projected
    } else {
        Normalization::Paper
    }
}

/// The map that a method is built from, and how it was refined, if it is interpolated.
fn interpolated(
    map: &NormalMap,
    surface: ffi::Surface,
    interpolation: ffi::InterpolationOptions,
) -> Result<(Cow<'_, NormalMap>, Option<Refinement>)> {
    if !interpolation.bilinear {
        if interpolation.refinement != 0 {
            return Err(Error::Parameter {
                name: "refinement",
                value: interpolation.refinement.to_string(),
                reason: "is for interpolated maps; add interpolation = bilinear, or leave the parameter out"
                    .into(),
            });
        }
        return Ok((Cow::Borrowed(map), None));
    }
    let flake = match surface.alpha {
        0.0 => None,
        _ => Some(flakes(surface)?.flake),
    };
    let refinement = Refinement::new(map, flake, interpolation.refinement)?;
    Ok((Cow::Owned(map.refined(refinement.refinement)?), Some(refinement)))
}

/// `method` builds from the map as it is interpolated; masking is that of the map as it was given.
fn build(
    map: &Map,
    surface: ffi::Surface,
    interpolation: ffi::InterpolationOptions,
    method: impl FnOnce(Cow<NormalMap>) -> Result<Box<dyn Method>>,
) -> Result<Box<Brdf>> {
    let masking = masking(surface);
    guarded("filename", map.0.name(), || {
        let mut build_seconds = 0.0;
        let mut refinement = None;
        let core = Core::new(&map.0, masking, || {
            let start = Instant::now();
            let (map, refined) = interpolated(&map.0, surface, interpolation)?;
            refinement = refined;
            let method = method(map);
            build_seconds = start.elapsed().as_secs_f64();
            method
        })?;
        Ok(Box::new(Brdf {
            prefilter: prefilter(&map.0, surface, &core)?,
            core,
            map: (map.width(), map.height()),
            surface,
            build_seconds,
            refinement,
        }))
    })
}

fn masking(surface: ffi::Surface) -> Masking {
    match surface.masking {
        ffi::MaskingKind::Beckmann => Masking::Beckmann,
        ffi::MaskingKind::Explicit => Masking::Explicit {
            alpha_u: surface.masking_alpha_u,
            alpha_v: surface.masking_alpha_v,
        },
        _ => Masking::None,
    }
}

/// A mirror has no range query, whatever its method.
fn prefilter(map: &NormalMap, surface: ffi::Surface, core: &Core) -> Result<Option<Prefilter>> {
    let point = core.footprint([0.0; 2], [0.0; 2], [0.0; 2]);
    let answers = core.ndf_over(&point, Vec2::ZERO, Vec2::splat(1e-3)).is_some();
    if !answers || surface.alpha == 0.0 {
        return Ok(None);
    }
    Ok(Some(Prefilter::new(map, flakes(surface)?.flake)))
}

impl Brdf {
    fn evaluate(&self, footprint: ffi::Footprint, wi: ffi::Vector, wo: ffi::Vector) -> ffi::Evaluation {
        let e = self
            .core
            .evaluate(&self.footprint(footprint), from_ffi(wi), from_ffi(wo));
        ffi::Evaluation {
            value: e.value,
            pdf: e.pdf,
        }
    }

    fn pdf(&self, footprint: ffi::Footprint, wi: ffi::Vector, wo: ffi::Vector) -> f32 {
        self.core
            .pdf(&self.footprint(footprint), from_ffi(wi), from_ffi(wo))
    }

    fn sample(&self, footprint: ffi::Footprint, wi: ffi::Vector, u: [f32; 3]) -> ffi::Sample {
        let drawn = self.core.sample(&self.footprint(footprint), from_ffi(wi), u);
        drawn.map_or(
            ffi::Sample {
                wo: to_ffi(Vec3::ZERO),
                value: 0.0,
                pdf: 0.0,
                valid: false,
            },
            |s| ffi::Sample {
                wo: to_ffi(s.wo),
                value: s.evaluation.value,
                pdf: s.evaluation.pdf,
                valid: true,
            },
        )
    }

    fn ndf(&self, footprint: ffi::Footprint, h: ffi::Vector) -> f32 {
        self.core.ndf(&self.footprint(footprint), from_ffi(h))
    }

    fn ndf_over(&self, footprint: ffi::Footprint, low: [f32; 2], high: [f32; 2]) -> ffi::RangeMean {
        let footprint = self.footprint(footprint);
        let mean = self.core.ndf_over(&footprint, low.into(), high.into());
        ffi::RangeMean {
            known: mean.is_some(),
            mean: mean.unwrap_or(0.0),
        }
    }

    fn prefilters(&self) -> bool {
        self.prefilter.is_some()
    }

    fn sample_lobe(
        &self,
        footprint: ffi::Footprint,
        wi: ffi::Vector,
        axes: [ffi::Vector; 3],
        environment: &Environment,
        u: [f32; 3],
    ) -> ffi::LobeSample {
        let to_local = Mat3::from_cols_array_2d(&axes.map(|axis| from_ffi(axis).to_array())).transpose();
        let footprint = self.footprint(footprint);
        let draw = |prefilter: &Prefilter| {
            prefilter.sample(
                &self.core,
                &footprint,
                from_ffi(wi),
                &to_local,
                &environment.core,
                u,
            )
        };
        self.prefilter.as_ref().and_then(draw).map_or(
            ffi::LobeSample {
                lobe: 0,
                probability: 0.0,
                wo: to_ffi(Vec3::ZERO),
                value: 0.0,
                valid: false,
            },
            |s| ffi::LobeSample {
                lobe: s.lobe as u32,
                probability: s.probability,
                wo: to_ffi(s.wo),
                value: s.value,
                valid: true,
            },
        )
    }

    fn statistics(&self) -> ffi::Statistics {
        let (masking_alpha_u, masking_alpha_v) = self.core.masking_alphas();
        let method = self.core.method();
        ffi::Statistics {
            method: method.name().into(),
            width: self.map.0,
            height: self.map.1,
            alpha: self.surface.alpha,
            distribution: self.surface.distribution,
            structure_bytes: method.structure_bytes() as u64,
            build_seconds: self.build_seconds,
            bins: method.bins().unwrap_or(0),
            refinement: self
                .refinement
                .map_or(method.refinement(), |r| Some(r.refinement))
                .unwrap_or(0),
            refinement_step: self.refinement.map_or(0.0, |r| r.step as f32),
            masking_alpha_u,
            masking_alpha_v,
            warning: self.refinement.and_then(|r| r.warning()).unwrap_or_default(),
        }
    }

    fn footprint(&self, f: ffi::Footprint) -> glints::footprint::Footprint {
        self.core.footprint(f.uv, f.duv_dx, f.duv_dy)
    }
}

// ---- environments ---------------------------------------------------------------------------------------------------------------

/// A mixture of spherical Gaussians with the supports of its lobes.
pub struct Environment {
    core: prefilter::Environment,
    /// Residual and name of the map, for a fit from a file.
    saved: Option<(f64, String)>,
}

fn environment(
    directions: &[f32],
    weights: &[f32],
    lobes: u32,
    epsilon: f32,
    candidates: u32,
    seed: u64,
) -> Result<Box<Environment>> {
    guarded("lobes", &lobes.to_string(), || {
        let directions = vectors(directions);
        let light = Light {
            directions: &directions,
            weights,
        };
        let mixture = SphericalGaussians::fit(light, lobes as usize, seed)?;
        Environment::of(mixture, epsilon, candidates)
    })
}

fn environment_of_map(
    width: u32,
    height: u32,
    rgb: &[f32],
    lobes: u32,
    epsilon: f32,
    candidates: u32,
) -> Result<Box<Environment>> {
    guarded("lobes", &lobes.to_string(), || {
        let pixels = rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
        let fit = EnvironmentMap::new(width, height, pixels)?.fit(lobes as usize)?;
        Environment::of(fit.mixture, epsilon, candidates)
    })
}

fn environment_from_file(filename: &str, epsilon: f32, candidates: u32) -> Result<Box<Environment>> {
    guarded("environment_file", filename, || {
        let (fit, map) = environment_file::load(Path::new(filename))?;
        let mut environment = Environment::of(fit.mixture, epsilon, candidates)?;
        environment.saved = Some((fit.residual, map.name));
        Ok(environment)
    })
}

impl Environment {
    fn of(mixture: SphericalGaussians, epsilon: f32, candidates: u32) -> Result<Box<Self>> {
        Ok(Box::new(Self {
            core: prefilter::Environment::new(mixture, epsilon, candidates)?,
            saved: None,
        }))
    }

    fn turned(&self, axes: [ffi::Vector; 3]) -> Result<Box<Self>> {
        guarded("to_world", "", || {
            let axes = Mat3::from_cols_array_2d(&axes.map(|axis| from_ffi(axis).to_array()));
            Ok(Box::new(Self {
                core: self.core.turned(&axes),
                saved: self.saved.clone(),
            }))
        })
    }

    fn saved_residual(&self) -> f64 {
        self.saved.as_ref().map_or(1.0, |(residual, _)| *residual)
    }

    fn map_name(&self) -> String {
        self.saved
            .as_ref()
            .map_or(String::new(), |(_, name)| name.clone())
    }

    fn lobe_count(&self) -> u32 {
        self.core.mixture().lobes().len() as u32
    }

    fn lobe(&self, index: u32) -> ffi::Lobe {
        let (lobes, weights) = (self.core.mixture().lobes(), self.core.mixture().weights());
        let index = (index as usize).min(lobes.len() - 1);
        ffi::Lobe {
            axis: to_ffi(lobes[index].axis),
            sharpness: lobes[index].sharpness,
            weight: weights[index],
        }
    }

    fn density(&self, direction: ffi::Vector) -> f32 {
        self.core.mixture().density(from_ffi(direction))
    }

    fn energies(&self, directions: &[f32], values: &[f32], channels: u32) -> Result<Vec<f32>> {
        guarded("channels", &channels.to_string(), || {
            let energies = self
                .core
                .mixture()
                .energies(&vectors(directions), values, channels as usize);
            Ok(energies.into_iter().map(|energy| energy as f32).collect())
        })
    }

    fn residual(&self, directions: &[f32], weights: &[f32], radiances: &[f32]) -> Result<f64> {
        guarded("directions", "", || {
            let light = Light {
                directions: &vectors(directions),
                weights,
            };
            Ok(self.core.mixture().residual(light, radiances))
        })
    }
}

fn vectors(components: &[f32]) -> Vec<Vec3> {
    components.chunks_exact(3).map(Vec3::from_slice).collect()
}

// ---- layers of flakes -------------------------------------------------------------------------------------------------------------

/// A layer of flakes, and how long it took to build.
pub struct FlakeLayer {
    core: flake_layer::FlakeLayer,
    surface: ffi::Surface,
    build_seconds: f64,
}

fn flake_layer(
    map: &Map,
    mask: &str,
    surface: ffi::Surface,
    options: ffi::FlakeLayerOptions,
) -> Result<Box<FlakeLayer>> {
    guarded("filename", map.0.name(), || {
        let mask = if mask.is_empty() {
            None
        } else {
            Some(MipMap::load_binary(mask)?)
        };
        let bins = inverse_bin_map_options(options.bins, options.leaf_size);
        let start = Instant::now();
        let core = flake_layer::FlakeLayer::new(
            &map.0,
            mask,
            layer_masking(surface, options)?,
            options.largest_sine,
            |map| Ok(Box::new(InverseBinMap::new(map, flakes(surface)?, bins)?)),
        )?;
        Ok(Box::new(FlakeLayer {
            core,
            surface,
            build_seconds: start.elapsed().as_secs_f64(),
        }))
    })
}

fn layer_masking(surface: ffi::Surface, options: ffi::FlakeLayerOptions) -> Result<LayerMasking> {
    if options.gtr_gamma != 0.0 {
        return Ok(LayerMasking::Gtr(Gtr::new(options.gtr_gamma, options.gtr_alpha)?));
    }
    Ok(match surface.masking {
        ffi::MaskingKind::Beckmann => LayerMasking::Beckmann,
        ffi::MaskingKind::Explicit => LayerMasking::Explicit {
            alpha_u: surface.masking_alpha_u,
            alpha_v: surface.masking_alpha_v,
        },
        _ => LayerMasking::None,
    })
}

impl FlakeLayer {
    fn cover(&self, footprint: ffi::Footprint) -> f32 {
        self.core.cover(&self.footprint(footprint))
    }

    fn evaluate_flakes(
        &self,
        footprint: ffi::Footprint,
        wi: ffi::Vector,
        wo: ffi::Vector,
    ) -> ffi::Evaluation {
        let e = self
            .core
            .evaluate(&self.footprint(footprint), from_ffi(wi), from_ffi(wo));
        ffi::Evaluation {
            value: e.value,
            pdf: e.pdf,
        }
    }

    fn sample_flakes(&self, footprint: ffi::Footprint, wi: ffi::Vector, u: [f32; 3]) -> ffi::FlakeSample {
        let (drawn, wo) = match self.core.sample(&self.footprint(footprint), from_ffi(wi), u) {
            flake_layer::Drawn::Flake(wo) => (ffi::Drawn::Flake, wo),
            flake_layer::Drawn::Gap => (ffi::Drawn::Gap, Vec3::ZERO),
            flake_layer::Drawn::Nothing => (ffi::Drawn::Nothing, Vec3::ZERO),
        };
        ffi::FlakeSample {
            drawn,
            wo: to_ffi(wo),
        }
    }

    fn layer_statistics(&self) -> ffi::Statistics {
        let (masking_alpha_u, masking_alpha_v) = self.core.masking_alphas();
        let method = self.core.method();
        ffi::Statistics {
            method: method.name().into(),
            width: method.map_size().0,
            height: method.map_size().1,
            alpha: self.surface.alpha,
            distribution: self.surface.distribution,
            structure_bytes: self.core.structure_bytes() as u64,
            build_seconds: self.build_seconds,
            bins: method.bins().unwrap_or(0),
            refinement: method.refinement().unwrap_or(0),
            refinement_step: 0.0,
            masking_alpha_u,
            masking_alpha_v,
            warning: String::new(),
        }
    }

    fn footprint(&self, f: ffi::Footprint) -> glints::footprint::Footprint {
        self.core.footprint(f.uv, f.duv_dx, f.duv_dy)
    }
}

// ---- crossing -------------------------------------------------------------------------------------------------------------------

fn from_ffi(v: ffi::Vector) -> Vec3 {
    Vec3::new(v.x, v.y, v.z)
}

fn to_ffi(v: Vec3) -> ffi::Vector {
    ffi::Vector {
        x: v.x,
        y: v.y,
        z: v.z,
    }
}

/// Runs a constructor; a panic, which would abort the host on its way through C++, becomes an error about
/// `name`.
fn guarded<T>(name: &'static str, value: &str, construct: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(construct)).unwrap_or_else(|panic| {
        let text = panic
            .downcast_ref::<String>()
            .map(String::as_str)
            .or_else(|| panic.downcast_ref::<&str>().copied());
        Err(Error::Parameter {
            name,
            value: value.into(),
            reason: format!(
                "an internal error occurred, please report it: {}",
                text.unwrap_or("no message")
            ),
        })
    })
}
