//! Memory, build time, query cost and error of the methods on one map, one JSON object a line: `{"name",
//! "value", "unit", "baseline", "baseline_value", "ratio", "params"}` in bytes, seconds and nanoseconds.
//!
//! ```text
//! cargo run --release -p glints --example bench -- --map isotropic.exr --label isotropic --alpha 0.00707
//! ```
//!
//! `ibm/...` is the compact inverse bin map, `ibm_paper/...` the published structure, built and asked in the same run:
//! every ratio of `ibm` to it is of one machine, one map and the same questions. Queries and builds are given as the
//! least of several: a busy machine only ever adds.
//!
//! * `*/memory`, `*/bytes_per_texel` what a structure says it takes; `*/memory_counted` what the allocator counts as
//!   alive after the build and was not before, the map left out; `*/build_peak` the most that was alive during it.
//! * `*/build` wall-clock time, with all cores; `*/build_cpu` processor time of the whole process.
//! * `*/eval`, `*/pdf`, `*/sample`, `*/three_calls` processor time of the thread for a query.
//! * `ibm_gaussian/eval`, `/sample` the compact inverse bin map under a Gaussian of half a pixel, against its own box;
//!   `ibm_gaussian/ndf_error` the distance to the direct sum under the same Gaussian, up to
//!   [`cost::LARGEST_DIRECT_GAUSSIAN`] texels.
//! * `direct_gaussian/eval`, `/sample` the direct sum under a Gaussian of half a pixel, against the box's.
//! * `*/ndf_error` relative L1 distance to the direct sum, where that takes no more than [`cost::LARGEST_DIRECT`] texels;
//!   larger footprints have no such row.
//! * `tensor/...` see the module `tensor`; with `--methods tensor`, alone.
//! * `*/eval/worst`, `/median`, `/worst_over_best`, `*/ndf_error/worst` over all cells (roughness and footprint) of the map;
//!   `params` names the cell that is worst, and of how many.

mod cost;
mod error;
mod memory;
mod report;
mod tensor;

use std::path::PathBuf;

use clap::Parser;
use glints::brdf::{Brdf, Masking};
use glints::error::Result;
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint_filter::FootprintFilter;
use glints::methods::Method;
use glints::methods::compact::CompactBinMap;
use glints::methods::direct::Direct;
use glints::methods::inverse_bin_map::{InverseBinMap, Options};
use glints::methods::yan16::{self, Elements, Yan16};
use glints::microfacet::{Distribution, Flake};
use glints::normal_map::{Encoding, NormalMap};
use serde_json::{Value, json};

use cost::{Call, Cell};
use memory::Built;
use report::{Summary, print, with};

#[global_allocator]
static COUNTED: peak_alloc::PeakAlloc = peak_alloc::PeakAlloc;

#[derive(Parser)]
struct Arguments {
    /// Normal map to measure on.
    #[arg(long)]
    map: PathBuf,
    /// Name of the map in the results.
    #[arg(long)]
    label: String,
    /// Flake roughnesses.
    #[arg(long, value_delimiter = ',', default_values_t = [0.0025, 0.00707, 0.05, 0.16])]
    alpha: Vec<f64>,
    /// Footprints in texels: the width of a square, or length x thickness.
    #[arg(long, value_delimiter = ',', default_value = FOOTPRINTS)]
    footprint: Vec<Cell>,
    /// Methods to measure, besides the direct sum: ibm, yan16; or tensor, alone.
    #[arg(long, value_delimiter = ',', default_values_t = ["ibm".to_string(), "yan16".to_string()])]
    methods: Vec<String>,
    /// Ranks of the tensor decomposition; costs are measured with the last.
    #[arg(long, value_delimiter = ',', default_values_t = [32])]
    ranks: Vec<u32>,
    /// Tensor decomposition with the published solver.
    #[arg(long)]
    published: bool,
    /// Sides in texels of further maps whose memory is counted: the given one cropped or tiled.
    #[arg(long, value_delimiter = ',')]
    sides: Vec<u32>,
    /// Least time in seconds that a query cost is averaged over.
    #[arg(long, default_value_t = 0.05)]
    seconds: f64,
}

/// Squares up to a 2K map and beyond, and thin footprints as of a grazing view.
const FOOTPRINTS: &str = "1,4,16,64,256,1024,2048,4096,16384,64x1,256x1,2048x1,64x8,512x16,2048x64";

/// Builds that the least time is taken of.
const BUILDS: usize = 5;

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let map = NormalMap::load(&arguments.map, Encoding::Automatic, false)?;
    if arguments.methods.iter().any(|name| name == "tensor") {
        return tensor::measure(&arguments, &map);
    }
    let mut summaries = [Summary::new("ibm"), Summary::new("ibm_paper")];
    let params = json!({ "map": arguments.label, "side": map.width() });
    for &alpha in &arguments.alpha {
        let params = with(&params, &[("alpha", json!(alpha))]);
        measure(&arguments, &map, alpha, &params, &mut summaries)?;
    }
    let [ours, published] = &summaries;
    ours.print(published, &params);
    published.print(ours, &params);
    for &side in &arguments.sides {
        let map = memory::resized(&map, side)?;
        for &alpha in &arguments.alpha {
            let params = json!({ "map": arguments.label, "side": side, "alpha": alpha });
            measure_structures(&map, model(alpha)?, 1, &params)?;
        }
    }
    Ok(())
}

fn model(alpha: f64) -> Result<FlakeModel> {
    Ok(FlakeModel {
        flake: Flake::new(Distribution::default(), alpha as f32)?,
        normalization: Normalization::Projected,
    })
}

/// Everything at one roughness.
fn measure(
    arguments: &Arguments,
    map: &NormalMap,
    alpha: f64,
    params: &Value,
    summaries: &mut [Summary; 2],
) -> Result<()> {
    let model = model(alpha)?;
    let (ours, published) = measure_structures(map, model, BUILDS, params)?;
    let costs = (ours.bytes(), ours.seconds);
    let direct = Direct::new(map.clone(), model);
    for cell in arguments.footprint.iter().filter(|cell| cell.is_direct()) {
        let params = with(params, &cell.params());
        let found = [
            error::of_distribution(&ours.method, &direct, cell, 1.0),
            error::of_distribution(&published.method, &direct, cell, 1.0),
        ];
        let baseline = ("ibm_paper", found[1]);
        print("ibm/ndf_error", found[0], "relative L1", baseline, &params);
        for (summary, error) in summaries.iter_mut().zip(found) {
            summary.errors.push((error, params.clone()));
        }
    }
    let brdf = |method: Box<dyn Method>| Brdf::new(map, Masking::Beckmann, || Ok(method));
    let ours = brdf(Box::new(ours.method))?;
    let published = brdf(Box::new(published.method))?;
    let direct = brdf(Box::new(direct))?;
    let filter = FootprintFilter::gaussian(yan16::Options::default().footprint_sigma)?;
    let gaussian = Direct::with_filter(map.clone(), model, filter);
    let ours_gaussian = CompactBinMap::new(map, model).with_filter(filter);
    for cell in arguments
        .footprint
        .iter()
        .filter(|cell| cell.is_direct_gaussian())
    {
        let error = error::of_distribution(&ours_gaussian, &gaussian, cell, cost::GAUSSIAN_REACH);
        let params = with(params, &cell.params());
        let name = "ibm_gaussian/ndf_error";
        print(name, error, "relative L1", ("bound", 0.03), &params);
    }
    let gaussian = brdf(Box::new(gaussian))?;
    let ours_gaussian = brdf(Box::new(ours_gaussian))?;
    for cell in &arguments.footprint {
        let params = with(params, &cell.params());
        let boxes = [&ours, &published, &direct];
        let eval = measure_queries(arguments, boxes, [&ours_gaussian, &gaussian], cell, &params);
        for (summary, nanoseconds) in summaries.iter_mut().zip(eval) {
            summary.evals.push((nanoseconds, params.clone()));
        }
    }
    if arguments.methods.iter().any(|name| name == "yan16") {
        measure_yan16(arguments, map, model, (&ours, costs), params)?;
    }
    Ok(())
}

/// Memory and build time of the compact and of the published structure.
fn measure_structures(
    map: &NormalMap,
    model: FlakeModel,
    builds: usize,
    params: &Value,
) -> Result<(Built<CompactBinMap>, Built<InverseBinMap>)> {
    let ours = memory::build(builds, || Ok(CompactBinMap::new(map, model)))?;
    let published = memory::build(builds, || InverseBinMap::new(map, model, Options::default()))?;
    let texels = map.normals().len() as f64;
    ours.print("ibm", texels, ("ibm_paper", &published.costs()), params);
    published.print("ibm_paper", texels, ("ibm", &ours.costs()), params);
    let alpha = model.flake.alpha();
    for (name, costs) in [("ibm", ours.costs()), ("ibm_paper", published.costs())] {
        if map.width() == 2048 && map.height() == 2048 {
            let memory = format!("{name}/memory");
            print(&memory, costs.bytes, "bytes", paper_memory(alpha), params);
            let build = format!("{name}/build");
            print(&build, costs.seconds, "seconds", paper_build(), params);
        }
    }
    Ok((ours, published))
}

/// Prints what the queries of a cell cost; returns the evaluations' of the compact and of the published structure.
fn measure_queries(
    arguments: &Arguments,
    [ours, published, direct]: [&Brdf; 3],
    [ours_gaussian, gaussian]: [&Brdf; 2],
    cell: &Cell,
    params: &Value,
) -> [f64; 2] {
    let queries = cost::queries(ours, cell, 256);
    let nanoseconds =
        |brdf: &Brdf, call: Call| cost::nanoseconds(&queries, arguments.seconds, |q| call(brdf, q));
    let mut evals = [0.0; 2];
    for (name, call) in cost::CALLS {
        let found = [nanoseconds(ours, call), nanoseconds(published, call)];
        let name = format!("ibm/{name}");
        print(&name, found[0], "nanoseconds", ("ibm_paper", found[1]), params);
        if name == "ibm/eval" {
            evals = found;
        }
    }
    let eval = nanoseconds(ours_gaussian, cost::eval);
    let name = "ibm_gaussian/eval";
    print(name, eval, "nanoseconds", ("ibm", evals[0]), params);
    let sample = [ours_gaussian, ours].map(|brdf| nanoseconds(brdf, cost::sample));
    let name = "ibm_gaussian/sample";
    print(name, sample[0], "nanoseconds", ("ibm", sample[1]), params);
    if cell.is_direct() {
        let exact = nanoseconds(direct, cost::eval);
        print("direct/eval", exact, "nanoseconds", ("ibm", evals[0]), params);
        if !cell.is_direct_gaussian() {
            return evals;
        }
        let eval = nanoseconds(gaussian, cost::eval);
        let name = "direct_gaussian/eval";
        print(name, eval, "nanoseconds", ("direct", exact), params);
        let sample = [gaussian, direct].map(|brdf| nanoseconds(brdf, cost::sample));
        let name = "direct_gaussian/sample";
        print(name, sample[0], "nanoseconds", ("direct", sample[1]), params);
    }
    evals
}

/// Widest footprint in texels of the position-normal mixtures, whose cost grows with the area.
const WIDEST_YAN16: f64 = 256.0;

/// Memory, build time and evaluation of the position-normal mixtures, beside the compact inverse bin map's.
fn measure_yan16(
    arguments: &Arguments,
    map: &NormalMap,
    model: FlakeModel,
    (ibm, (ibm_bytes, ibm_seconds)): (&Brdf, (f64, f64)),
    params: &Value,
) -> Result<()> {
    let refinement = yan16::resolving_refinement(map);
    for (kind, elements) in [
        ("flat", Elements::Flat),
        ("curved", Elements::Curved { refinement }),
    ] {
        let options = yan16::Options {
            elements,
            intrinsic: model.flake.alpha() / std::f32::consts::SQRT_2,
            ..yan16::Options::default()
        };
        let params = with(params, &[("elements", json!(kind))]);
        let built = memory::build(2, || Yan16::new(map, options))?;
        let (bytes, seconds) = (built.bytes(), built.seconds);
        print("yan16/memory", bytes, "bytes", ("ibm", ibm_bytes), &params);
        print("yan16/build", seconds, "seconds", ("ibm", ibm_seconds), &params);
        let brdf = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(built.method)))?;
        let narrow = |cell: &&Cell| cell.is_square() && cell.length <= WIDEST_YAN16;
        for cell in arguments.footprint.iter().filter(narrow) {
            let params = with(&params, &cell.params());
            let queries = cost::queries(&brdf, cell, 256);
            let eval = |brdf| cost::nanoseconds(&queries, arguments.seconds, |q| cost::eval(brdf, q));
            let baseline = ("ibm", eval(ibm));
            print("yan16/eval", eval(&brdf), "nanoseconds", baseline, &params);
        }
    }
    Ok(())
}

/// Table 4 of the 2021 paper, its shoes scene; Table 2 for the roughness 0.00707 of Figure 7.
fn paper_memory(alpha: f32) -> (&'static str, f64) {
    let megabytes = if alpha < 0.005 { 40.0 } else { 36.0 };
    ("2021 paper, Tables 2 and 4", 1e6 * megabytes)
}

/// Table 3 of the 2021 paper, both scenes rounded up; a 32-core machine.
fn paper_build() -> (&'static str, f64) {
    ("2021 paper, Table 3", 0.3)
}
