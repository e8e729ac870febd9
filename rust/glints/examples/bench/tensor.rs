//! Tensor-decomposed distributions of normals: precomputation, memory, error and cost.
//!
//! * `tensor/precompute` wall-clock seconds on all cores; in `params` the thread seconds of its two parts, which tell what a
//!   machine with nothing else to do takes, and the most memory that was alive (`peak_bytes`).
//! * `tensor/storage` bytes of the compressed images with their summed-area tables; `tensor/exact_storage` those of the structure
//!   that answers for small footprints.
//! * `tensor/ndf_error` relative L1 errors of distributions: of the finest level's images against the uncompressed pyramid
//!   (`against` = `pyramid`; `params` has the mean squared error of a pixel), and over footprints on the map against the direct sum
//!   under a Gaussian (`direct`).
//! * `tensor/highlight_error` what of the latter is whose, at the same points: against the same queries of the uncompressed images
//!   (`compression`), and these against the direct sum (`blend`). A flat surface under a distant light shows, pixel by pixel, the
//!   distribution at one half vector each: the relative L1 error of its highlight is this one.
//! * `tensor/eval`, `tensor/sample` processor time of a query, against one of a plain Beckmann microfacet BRDF;
//!   `tensor/eval/growth` the worst over the first, of all footprints, from 61 texels to 1000 periods of the map.

use std::time::Instant;

use glam::Vec3;
use glints::brdf::{Brdf, Masking};
use glints::error::Result;
use glints::flakes::FlakeModel;
use glints::footprint::Footprint;
use glints::footprint_filter::FootprintFilter;
use glints::half_vector::DirectionPair;
use glints::methods::Method;
use glints::methods::direct::Direct;
use glints::methods::tensor::{Options, Tensor, Uncompressed};
use glints::microfacet::Flake;
use glints::normal_map::NormalMap;
use serde_json::{Value, json};

use crate::cost::{self, Cell, Query};
use crate::report::{print, with};
use crate::{Arguments, COUNTED, model};

/// Footprints in texels whose error against the direct sum is measured.
const WIDTHS: [f64; 3] = [48.0, 96.0, 192.0];

/// Footprints in periods of a map of 2048 texels: of a tiling, seen from where the whole map is as large as a pixel.
const TILINGS: [f64; 7] = [0.03, 0.1, 0.3, 1.0, 10.0, 100.0, 1000.0];

pub fn measure(arguments: &Arguments, map: &NormalMap) -> Result<()> {
    for &alpha in &arguments.alpha {
        let model = model(alpha)?;
        let uncompressed = Uncompressed::new(map, model, &Options::default())?;
        for &rank in &arguments.ranks {
            let own = match arguments.published {
                true => Options::published(),
                false => Options::default(),
            };
            let options = Options { rank, ..own };
            let params = json!({
                "map": arguments.label, "side": map.width(), "alpha": alpha, "rank": rank, "published": arguments.published,
            });
            let tensor = precompute(map, model, &options, &params)?;
            against_direct(map, model, &tensor, &uncompressed, &params)?;
            if Some(&rank) == arguments.ranks.last() {
                costs(arguments, map, model.flake, tensor, &params)?;
            }
        }
    }
    Ok(())
}

fn precompute(map: &NormalMap, model: FlakeModel, options: &Options, params: &Value) -> Result<Tensor> {
    let before = COUNTED.current_usage();
    COUNTED.reset_peak_usage();
    let start = Instant::now();
    let (tensor, report) = Tensor::new(map, model, options, &|_| ())?;
    let seconds = start.elapsed().as_secs_f64();
    let facts = with(
        params,
        &[
            ("threads", json!(rayon::current_num_threads())),
            ("pyramid_thread_seconds", json!(report.pyramid_seconds)),
            ("solver_thread_seconds", json!(report.solver_seconds)),
            ("peak_bytes", json!(COUNTED.peak_usage() - before)),
            ("groups", json!(report.groups)),
            ("iterations", json!(report.iterations)),
        ],
    );
    let (minutes, megabytes) = published(params);
    let paper = "2022 paper, Table 2";
    print(
        "tensor/precompute",
        seconds,
        "seconds",
        (paper, 60.0 * minutes),
        &facts,
    );
    let (images, exact) = tensor.bytes();
    print(
        "tensor/storage",
        images as f64,
        "bytes",
        (paper, 1e6 * megabytes),
        params,
    );
    print(
        "tensor/exact_storage",
        exact as f64,
        "bytes",
        ("tensor/storage", images as f64),
        params,
    );
    let levels = with(
        params,
        &[
            ("against", json!("pyramid")),
            ("mse", json!(report.errors[0].1)),
            ("relative_l2", json!(report.relative_error)),
        ],
    );
    let error = report.errors[0].0;
    print(
        "tensor/ndf_error",
        error,
        "relative L1",
        ("all of it", 1.0),
        &levels,
    );
    Ok(tensor)
}

/// Minutes and megabytes of the paper's map and rank; its machine has 40 cores. NaN, null in a row, where it has none.
fn published(params: &Value) -> (f64, f64) {
    let map = params["map"].as_str().unwrap_or_default();
    match (map, params["side"].as_u64(), params["rank"].as_u64()) {
        ("brushed", Some(2048), Some(16)) => (47.4, 15.2),
        ("brushed", Some(1024), Some(16)) => (14.9, 7.2),
        ("flakes", Some(2048), Some(32)) => (102.8, 107.0),
        _ => (f64::NAN, f64::NAN),
    }
}

fn against_direct(
    map: &NormalMap,
    model: FlakeModel,
    tensor: &Tensor,
    uncompressed: &Uncompressed,
    params: &Value,
) -> Result<()> {
    let direct = Direct::with_filter(map.clone(), model, FootprintFilter::gaussian(0.5)?);
    for width in WIDTHS {
        let cell: Cell = width
            .to_string()
            .parse()
            .unwrap_or_else(|_| unreachable!("a number"));
        let [total, compression, blend] = crate::error::of_tensor(tensor, uncompressed, &direct, &cell);
        for (name, against, error) in [
            ("tensor/ndf_error", "direct", total),
            ("tensor/highlight_error", "compression", compression),
            ("tensor/highlight_error", "blend", blend),
        ] {
            let params = with(
                params,
                &[("against", json!(against)), ("footprint", json!(width))],
            );
            print(name, error, "relative L1", ("all of it", 1.0), &params);
        }
    }
    Ok(())
}

fn costs(arguments: &Arguments, map: &NormalMap, flake: Flake, tensor: Tensor, params: &Value) -> Result<()> {
    let brdf = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(tensor)))?;
    let plain = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(Plain(flake))))?;
    let mut evals = Vec::new();
    for tiling in TILINGS {
        let width = (2048.0 * tiling).to_string();
        let cell: Cell = width.parse().unwrap_or_else(|_| unreachable!("a number"));
        let queries = cost::queries(&brdf, &cell, 4096);
        let of = |brdf: &Brdf, call: fn(&Brdf, &Query) -> f32| {
            cost::nanoseconds(&queries, arguments.seconds, |query| call(brdf, query))
        };
        let params = with(params, &[("tiling", json!(tiling))]);
        let eval = of(&brdf, cost::eval);
        evals.push(eval);
        print(
            "tensor/eval",
            eval,
            "nanoseconds",
            ("plain Beckmann", of(&plain, cost::eval)),
            &params,
        );
        let sample = (of(&brdf, cost::sample), of(&plain, cost::sample));
        print(
            "tensor/sample",
            sample.0,
            "nanoseconds",
            ("plain Beckmann", sample.1),
            &params,
        );
    }
    let worst = evals.iter().copied().fold(0.0, f64::max);
    let first = evals[0];
    print(
        "tensor/eval/growth",
        worst / first,
        "ratio",
        ("constant", 1.0),
        params,
    );
    Ok(())
}

/// A Beckmann surface without a map.
struct Plain(Flake);

impl Method for Plain {
    fn evaluate(&self, _: &Footprint, pair: &DirectionPair) -> glints::methods::Reflection {
        let (distribution, cos) = self.0.distribution(pair.half, Vec3::Z);
        let shadowing = self.0.smith_g1(pair.wi.z) * self.0.smith_g1(pair.wo.z);
        glints::methods::Reflection {
            value: distribution * shadowing,
            density: distribution * cos,
        }
    }

    fn density(&self, _: &Footprint, h: Vec3) -> f32 {
        self.0.distribution(h, Vec3::Z).0 * h.z
    }

    fn ndf(&self, _: &Footprint, h: Vec3) -> f32 {
        self.0.distribution(h, Vec3::Z).0
    }

    fn sample(&self, _: &Footprint, u: [f32; 4]) -> Option<Vec3> {
        Some(self.0.sample(Vec3::Z, [u[2], u[3]]))
    }

    fn map_size(&self) -> (u32, u32) {
        (2048, 2048)
    }

    fn structure_bytes(&self) -> usize {
        0
    }

    fn name(&self) -> &'static str {
        "plain"
    }
}
