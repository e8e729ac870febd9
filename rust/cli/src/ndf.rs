//! `glints ndf`: pictures of filtered distributions of normals.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use glam::DVec2;
use glints::flakes::FlakeModel;
use glints::footprint::Footprint;
use glints::footprint_filter::FootprintFilter;
use glints::methods::Method;
use glints::methods::compact::Header;
use glints::methods::direct::Direct;
use glints::methods::tensor;
use glints::methods::unfiltered::{Interpolation, Unfiltered};
use glints::methods::yan16::{self, Elements, Yan16};
use glints::microfacet;
use glints::normal_map::NormalMap;
use glints::refinement::Refinement;
use serde_json::{Value, json};

use crate::arguments::{
    self, Distribution, FlakeArguments, InterpolationArguments, MapArguments, decimal, refined,
    refinement_json, refinement_text,
};
use crate::failure::{Failure, Result};
use crate::output::{self, Destination};
use crate::picture::{self, DECADES, Format};
use crate::progress::Progress;
use crate::quadrature::{Estimate, Problem};
use crate::structures;

/// Picture of the distribution of normals that a pixel sees, filtered over its footprint
///
/// The disk is the hemisphere seen from above: its centre is the shading normal, its rim the horizon, x points
/// right along u and y up along v. The brightness at a point is the density of flakes that mirror there, per
/// steradian: where the half vector of eye and light falls on a bright spot, the pixel glints. Every pixel of
/// the picture is an average over its area.
///
/// PNG pictures have colours on a logarithmic scale of five powers of ten that ends at the peak (the bar at the
/// right has a notch at each); EXR pictures have the values. What is printed tells peak, mean and integral.
///
/// In the place of the map, a structure that `precompute` saved can be given: its own distribution is shown, for its
/// flakes and its interpolation, and the footprint is in texels of its map. There is no other method to compare it
/// with: those need the map.
///
/// Example: glints ndf flakes.exr --at 0.3,0.6 --footprint 32 --method ibm --compare direct -o ndf.png
#[derive(Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    #[command(flatten)]
    map: MapArguments,

    /// Where on the map the footprint's centre is, in periods of the map
    #[arg(long, value_name = "U,V", value_parser = parse_numbers::<2>, default_value = "0.5,0.5", allow_hyphen_values = true)]
    at: [f64; 2],

    /// Footprint of the pixel, in texels: one width, `DU,DV` of a box along the axes, or the two edges
    /// `AU,AV,BU,BV` of a parallelogram; 0 is a point
    #[arg(long, value_name = "TEXELS", value_parser = parse_footprint, allow_hyphen_values = true)]
    footprint: [DVec2; 2],

    /// How the footprint is filtered [default: direct; of a saved structure: ibm]
    #[arg(long, value_enum)]
    method: Option<MethodName>,

    #[command(flatten)]
    flake: FlakeArguments,

    #[command(flatten)]
    interpolation: InterpolationArguments,

    #[command(flatten)]
    filter: FilterArguments,

    /// Pixels per side of the picture, in 16 to 4096
    #[arg(long, value_name = "PIXELS", default_value_t = 512, value_parser = clap::value_parser!(u32).range(16..=4096))]
    size: u32,

    /// Put this method's picture to the right, and tell the difference
    #[arg(long, value_enum, value_name = "METHOD")]
    compare: Option<MethodName>,

    /// Most points at which the distribution is evaluated: a grid where it resolves the lobes, else draws
    #[arg(long, default_value_t = 16_000_000, value_parser = clap::value_parser!(u64).range(65_536..=100_000_000_000))]
    points: u64,

    /// Picture to write: .png (colours) or .exr (values)
    #[arg(short, long, value_name = "PICTURE")]
    output: PathBuf,

    /// Overwrite the picture if it exists
    #[arg(long)]
    force: bool,

    /// Print one line of JSON
    #[arg(long)]
    json: bool,
}

/// How the pixel weights what it covers.
#[derive(Args)]
struct FilterArguments {
    /// How the pixel weights what it covers: `box`, evenly, or `gaussian`, which direct, yan16 and yan16_curved have
    #[arg(long, value_enum, default_value_t)]
    footprint_filter: FilterName,

    /// Standard deviation of the Gaussian footprint in units of the footprint's edges, in 0.05 to 4: 0.5 as Yan et
    /// al. published it, 0.288675 with the variance of the box [default: 0.5]
    #[arg(long, value_name = "EDGES")]
    footprint_sigma: Option<f32>,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum FilterName {
    #[default]
    Box,
    Gaussian,
}

impl FilterArguments {
    fn sigma(&self) -> f32 {
        self.footprint_sigma
            .unwrap_or(yan16::Options::default().footprint_sigma)
    }

    fn filter(&self) -> Result<FootprintFilter> {
        Ok(match self.footprint_filter {
            FilterName::Box => FootprintFilter::Box,
            FilterName::Gaussian => FootprintFilter::gaussian(self.sigma())?,
        })
    }

    /// Refuses a Gaussian for a method that has none, and a deviation that no method would see.
    fn check(&self, methods: &[MethodName]) -> Result<()> {
        let is_mixture = |name: &MethodName| matches!(name, MethodName::Yan16 | MethodName::Yan16Curved);
        if self.footprint_filter == FilterName::Gaussian {
            let without = |name: &&MethodName| **name != MethodName::Direct && !is_mixture(name);
            if let Some(&name) = methods.iter().find(without) {
                return Err(Failure::usage(format!(
                    "parameter \"footprint_filter\" = gaussian: {} has no such filter; take direct, yan16 or \
                     yan16_curved, or leave the parameter out",
                    name_of(name)
                )));
            }
        } else if let (Some(sigma), false) = (self.footprint_sigma, methods.iter().any(is_mixture)) {
            return Err(Failure::usage(format!(
                "parameter \"footprint_sigma\" = {sigma}: is for Gaussian footprints; add --footprint-filter \
                 gaussian, or leave it out"
            )));
        }
        Ok(())
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum MethodName {
    /// The exact sum over the texels
    Direct,
    /// Inverse bin map, in the structure of this project
    Ibm,
    /// Inverse bin map, in the structure as published
    IbmPaper,
    /// Position-normal mixture of flat elements (Yan et al. 2016)
    Yan16,
    /// The same with curved elements: the interpolated map
    Yan16Curved,
    /// Tensor-decomposed distributions, of the default rank (Deng et al. 2022); takes minutes for a large map
    Tensor,
    /// The one texel under the point
    Unfiltered,
}

impl MethodName {
    /// `refinement`: that of an interpolated map.
    fn build(
        self,
        map: &NormalMap,
        model: FlakeModel,
        refinement: Option<Refinement>,
        filter: &FilterArguments,
    ) -> Result<Box<dyn Method>> {
        if self.is_resampled() {
            return self.build_from(&*refined(map, refinement)?, model, refinement.is_some(), filter);
        }
        self.build_from(map, model, refinement.is_some(), filter)
    }

    /// Whether an interpolated map is resampled for the method; others interpolate it themselves.
    fn is_resampled(self) -> bool {
        matches!(self, Self::Direct | Self::Ibm | Self::IbmPaper)
    }

    fn build_from(
        self,
        map: &NormalMap,
        model: FlakeModel,
        bilinear: bool,
        filter: &FilterArguments,
    ) -> Result<Box<dyn Method>> {
        let _progress = (self != Self::Tensor).then(|| Progress::spinner("building the structure"));
        let mixture = |elements| -> Result<Box<dyn Method>> {
            let options = yan16::Options {
                elements,
                intrinsic: model.flake.alpha() / std::f32::consts::SQRT_2,
                footprint_sigma: filter.sigma(),
            };
            Ok(Box::new(Yan16::new(map, options)?))
        };
        Ok(match self {
            Self::Direct => Box::new(Direct::with_filter(map.clone(), model, filter.filter()?)),
            Self::Ibm => Box::new(structures::ibm(map, model)),
            Self::IbmPaper => structures::ibm_paper(map, model)?,
            Self::Yan16 => mixture(Elements::Flat)?,
            Self::Yan16Curved => mixture(Elements::Curved {
                refinement: yan16::resolving_refinement(map),
            })?,
            Self::Tensor => Box::new(structures::tensor(map, model, &tensor::Options::default())?.0),
            Self::Unfiltered => {
                let interpolation = match bilinear {
                    true => Interpolation::Bilinear,
                    false => Interpolation::Nearest,
                };
                Box::new(Unfiltered::new(map.clone(), model, interpolation))
            }
        })
    }

    /// Methods whose elements are Gaussians have no other flakes, and flat ones are not interpolated.
    fn check(self, distribution: Distribution, interpolation: arguments::Interpolation) -> Result<()> {
        if self == Self::Yan16 && interpolation == arguments::Interpolation::Bilinear {
            return Err(Failure::usage(
                "parameter \"interpolation\" = bilinear: the elements of yan16 are flat; take yan16_curved",
            ));
        }
        if self == Self::Tensor && interpolation == arguments::Interpolation::Bilinear {
            return Err(Failure::usage(
                "parameter \"interpolation\" = bilinear: tensor is made from flat texels; leave the parameter out",
            ));
        }
        if matches!(self, Self::Yan16 | Self::Yan16Curved) && distribution != Distribution::Beckmann {
            return Err(Failure::usage(format!(
                "parameter \"distribution\" = {}: {} is a mixture of Gaussians; leave the parameter out or take \
                 another method",
                name_of(distribution),
                name_of(self)
            )));
        }
        Ok(())
    }
}

/// The name under which a value is given.
fn name_of(value: impl ValueEnum) -> String {
    value
        .to_possible_value()
        .map_or_else(String::new, |v| v.get_name().to_string())
}

/// `COUNT` finite numbers, separated by commas.
fn parse_numbers<const COUNT: usize>(text: &str) -> std::result::Result<[f64; COUNT], String> {
    let numbers = numbers(text)?;
    numbers
        .try_into()
        .map_err(|_| format!("{COUNT} numbers with commas between them are needed"))
}

fn numbers(text: &str) -> std::result::Result<Vec<f64>, String> {
    let number = |part: &str| match part.trim().parse::<f64>() {
        Ok(number) if number.is_finite() => Ok(number),
        _ => Err(format!("\"{part}\" is not a finite number")),
    };
    text.split(',').map(number).collect()
}

/// Edges of the parallelogram, in texels.
fn parse_footprint(text: &str) -> std::result::Result<[DVec2; 2], String> {
    let numbers = numbers(text)?;
    if numbers.len() < 3 && numbers.iter().any(|&width| width < 0.0) {
        return Err("a width must not be negative".into());
    }
    match numbers[..] {
        [width] => Ok([DVec2::new(width, 0.0), DVec2::new(0.0, width)]),
        [du, dv] => Ok([DVec2::new(du, 0.0), DVec2::new(0.0, dv)]),
        [au, av, bu, bv] => Ok([DVec2::new(au, av), DVec2::new(bu, bv)]),
        _ => Err("one width, the two of a box, or the four numbers of a parallelogram are needed".into()),
    }
}

/// What is shown: methods by name, the flakes they are for, and the size of the map in whose texels footprints are given.
struct Shown {
    methods: Vec<(MethodName, Box<dyn Method>)>,
    model: FlakeModel,
    size: (u32, u32),
    refinement: Option<Refinement>,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let format = Format::of(&arguments.output)?;
    let destination = |input| Destination::new(&arguments.output, arguments.force, &[input]);
    let destination = destination(arguments.map.map.as_path())?;
    let shown = match structures::header(&arguments.map.map)? {
        Some(header) => saved(arguments, &header)?,
        None => built(arguments)?,
    };
    let over = |method: &dyn Method| footprint(arguments, shown.size, method.map_size());
    let with_footprint = |(_, method): &'_ (MethodName, Box<dyn Method>)| over(method.as_ref());
    let problem = Problem {
        method: (shown.methods[0].1.as_ref(), with_footprint(&shown.methods[0])),
        compare: shown
            .methods
            .get(1)
            .map(|other| (other.1.as_ref(), with_footprint(other))),
        lobe: f64::from(shown.model.flake.alpha()) / std::f64::consts::SQRT_2,
        size: arguments.size,
        points: arguments.points,
    };
    let estimate = problem.solve();
    let peak = write(&destination, format, arguments.size, &estimate)?;
    let report = report(arguments, &shown, &estimate, peak);
    output::print(&if arguments.json {
        format!("{report}\n")
    } else {
        text(&report)
    })
}

/// Reads the map and builds the methods.
fn built(arguments: &Arguments) -> Result<Shown> {
    let names = [
        Some(arguments.method.unwrap_or(MethodName::Direct)),
        arguments.compare,
    ];
    let names: Vec<MethodName> = names.into_iter().flatten().collect();
    for name in &names {
        name.check(
            arguments.flake.distribution.unwrap_or_default(),
            arguments.interpolation.interpolation,
        )?;
    }
    arguments.interpolation.check()?;
    arguments.filter.check(&names)?;
    let model = arguments.flake.model()?;
    let map = arguments.map.load()?;
    let refinement = arguments.interpolation.refinement(&map, model)?;
    let build = |name: MethodName| {
        let method = name.build(&map, model, refinement, &arguments.filter)?;
        Ok((name, method))
    };
    Ok(Shown {
        methods: names.into_iter().map(build).collect::<Result<_>>()?,
        model,
        size: (map.width(), map.height()),
        refinement,
    })
}

/// Loads a saved structure.
fn saved(arguments: &Arguments, header: &Header) -> Result<Shown> {
    let path = &arguments.map.map;
    let needs_map = |parameter: &str, name: MethodName| {
        Err(Failure::usage(format!(
            "parameter \"{parameter}\" = {}: needs the normal map, and \"{}\" holds an inverse bin map alone; leave the \
             parameter out, or give the map that it was made from",
            name_of(name),
            path.display()
        )))
    };
    match (arguments.method, arguments.compare) {
        (Some(name), _) if name != MethodName::Ibm => return needs_map("method", name),
        (_, Some(name)) => return needs_map("compare", name),
        _ => {}
    }
    arguments.filter.check(&[MethodName::Ibm])?;
    arguments.map.check_saved()?;
    arguments.interpolation.check_saved(path)?;
    let (flakes, model) = arguments.flake.of_saved(path, header)?;
    let _progress = Progress::spinner("loading the structure");
    let structure = structures::load(path, &flakes)?;
    Ok(Shown {
        methods: vec![(MethodName::Ibm, Box::new(structure))],
        model,
        size: header.origin.size,
        refinement: header.origin.refinement,
    })
}

/// The footprint over the map as resampled to `size` texels; its edges are given in those of the map, of `map` texels.
fn footprint(arguments: &Arguments, map: (u32, u32), size: (u32, u32)) -> Footprint {
    let vector = |(x, y): (u32, u32)| DVec2::new(f64::from(x), f64::from(y));
    let refinement = vector(size) / vector(map);
    // Whole periods go in double precision: they change nothing.
    let center = DVec2::from(arguments.at.map(|x| x.rem_euclid(1.0))) * vector(size);
    let [a, b] = arguments.footprint.map(|edge| edge * refinement);
    Footprint::in_texels(size.0, size.1, center, a, b)
}

/// The common peak of the scale.
fn write(destination: &Destination, format: Format, size: u32, estimate: &Estimate) -> Result<f32> {
    let panels: Vec<&[f32]> = estimate.pictures.iter().map(|p| p.pixels.as_slice()).collect();
    let peak = estimate.pictures.iter().map(|p| p.peak()).fold(0.0, f32::max);
    if peak <= 0.0 {
        let reason = "nothing to show: no flake of the footprint has a lobe on the disk that the points met; \
                      give more --points";
        return Err(Failure::file(destination.path(), reason));
    }
    output::write_files(&[destination], |files| {
        picture::write(&files[0], format, &panels, size, peak)
    })?;
    Ok(peak)
}

fn report(arguments: &Arguments, shown: &Shown, estimate: &Estimate, peak: f32) -> Value {
    let footprint = footprint(arguments, shown.size, shown.size);
    let pictures: Vec<Value> = shown
        .methods
        .iter()
        .map(|&(name, _)| name)
        .zip(&estimate.pictures)
        .map(|(name, picture)| {
            json!({
                "method": name_of(name),
                "peak": picture.peak(),
                "mean": picture.mean(),
                "integral": picture.integral,
                "error": picture.error,
            })
        })
        .collect();
    json!({
        "output": arguments.output.display().to_string(),
        "center_texels": footprint.center().to_array(),
        "footprint_texels": footprint.edges().map(|edge| edge.to_array()),
        "alpha": decimal(shown.model.flake.alpha()),
        "distribution": match shown.model.flake.kind() {
            microfacet::Distribution::Beckmann => "beckmann",
            microfacet::Distribution::Ggx => "ggx",
        },
        "footprint_filter": name_of(arguments.filter.footprint_filter),
        "refinement": refinement_json(shown.refinement),
        "size": arguments.size,
        "scale": [peak / 10_f32.powf(DECADES), peak],
        "strategy": estimate.strategy,
        "points": estimate.points,
        "pictures": pictures,
        "relative_l1_difference": estimate.difference,
    })
}

fn text(report: &Value) -> String {
    let number = |value: &Value| format!("{:.4}", value.as_f64().unwrap_or(f64::NAN));
    let scientific = |value: &Value| format!("{:.3e}", value.as_f64().unwrap_or(f64::NAN));
    let mut text = format!(
        "scale of colours  {} to {} per steradian, logarithmic\npoints            {} ({})\n",
        scientific(&report["scale"][0]),
        scientific(&report["scale"][1]),
        report["points"],
        report["strategy"].as_str().unwrap_or_default()
    );
    if !report["refinement"].is_null() {
        text += &format!("map               {}\n", refinement_text(&report["refinement"]));
    }
    for picture in report["pictures"].as_array().into_iter().flatten() {
        text += &format!(
            "{:<17} peak {}, mean {}, integral against the cosine {}, relative L1 error of the pixels below {}\n",
            picture["method"].as_str().unwrap_or_default(),
            scientific(&picture["peak"]),
            number(&picture["mean"]),
            number(&picture["integral"]),
            scientific(&picture["error"]),
        );
    }
    if !report["relative_l1_difference"].is_null() {
        text += &format!(
            "difference        {} relative L1, point by point\n",
            number(&report["relative_l1_difference"])
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn footprints_have_one_two_or_four_numbers() {
        let edges = |text| parse_footprint(text).map(|[a, b]| [a.to_array(), b.to_array()]);
        assert_eq!(edges("3"), Ok([[3.0, 0.0], [0.0, 3.0]]));
        assert_eq!(edges("3, 4"), Ok([[3.0, 0.0], [0.0, 4.0]]));
        assert_eq!(edges("1,-2,3,4"), Ok([[1.0, -2.0], [3.0, 4.0]]));
        for wrong in ["", "a", "1,2,3", "-1", "inf", "nan", "1,2,3,4,5"] {
            assert!(edges(wrong).is_err(), "{wrong}");
        }
    }
}
