//! Memory, build time, query cost and error of the methods on one map, one JSON object a line: `{"name",
//! "value", "unit", "baseline", "baseline_value", "ratio", "params"}` in bytes, seconds and nanoseconds.
//!
//! ```text
//! cargo run --release -p glints --example bench -- --map isotropic.exr --label isotropic --alpha 0.00707
//! ```

use std::path::PathBuf;
use std::time::Instant;

use clap::Parser;
use glam::{DVec2, Vec3};
use glints::brdf::{Brdf, Masking};
use glints::error::Result;
use glints::flakes::{FlakeModel, Normalization};
use glints::footprint::Footprint;
use glints::methods::Method;
use glints::methods::direct::Direct;
use glints::methods::inverse_bin_map::{InverseBinMap, Options};
use glints::methods::yan16::{self, Elements, Yan16};
use glints::microfacet::Flake;
use glints::normal_map::{Encoding, NormalMap};
use serde_json::{Value, json};

#[derive(Parser)]
struct Arguments {
    /// Normal map to measure on.
    #[arg(long)]
    map: PathBuf,
    /// Name of the map in the results.
    #[arg(long)]
    label: String,
    /// Flake roughnesses.
    #[arg(long, value_delimiter = ',', default_values_t = [0.0025, 0.00707, 0.04, 0.16])]
    alpha: Vec<f32>,
    /// Footprint widths in texels.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 4.0, 16.0, 64.0, 256.0, 1024.0])]
    width: Vec<f64>,
    /// Methods to measure, besides the direct sum: ibm, yan16.
    #[arg(long, value_delimiter = ',', default_values_t = ["ibm".to_string(), "yan16".to_string()])]
    methods: Vec<String>,
    /// Least time in seconds that a query cost is averaged over.
    #[arg(long, default_value_t = 0.05)]
    seconds: f64,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let map = NormalMap::load(&arguments.map, Encoding::Automatic, false)?;
    for &alpha in &arguments.alpha {
        measure(&arguments, &map, alpha)?;
    }
    Ok(())
}

fn measure(arguments: &Arguments, map: &NormalMap, alpha: f32) -> Result<()> {
    let model = FlakeModel {
        flake: Flake::new(alpha)?,
        normalization: Normalization::Projected,
    };
    let params = json!({ "map": arguments.label, "side": map.width(), "alpha": alpha });
    let direct = Direct::new(map.clone(), model);
    let (ibm, build_seconds) = timed(5, || InverseBinMap::new(map, model, Options::default()))?;
    let bytes = ibm.structure_bytes() as f64;
    print("ibm/memory", bytes, "bytes", paper_memory(alpha), &params);
    print("ibm/build", build_seconds, "seconds", paper_build(), &params);
    if arguments.methods.iter().any(|name| name == "yan16") {
        measure_yan16(arguments, map, model, (bytes, build_seconds), &params)?;
    }
    for &width in &arguments.width {
        let params = with(&params, &[("footprint", json!(width))]);
        let error = ndf_error(&ibm, &direct, width);
        print(
            "ibm/ndf_error",
            error,
            "relative L1",
            ("direct sum", f64::NAN),
            &params,
        );
    }
    let direct = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(direct)))?;
    let ibm = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(ibm)))?;
    for &width in &arguments.width {
        measure_queries(arguments, &ibm, &direct, width, &params);
    }
    Ok(())
}

/// A structure and the median of its construction times.
fn timed<T>(repetitions: usize, construct: impl Fn() -> Result<T>) -> Result<(T, f64)> {
    let mut times = Vec::new();
    loop {
        let start = Instant::now();
        let structure = construct()?;
        times.push(start.elapsed().as_secs_f64());
        if times.len() == repetitions {
            times.sort_by(f64::total_cmp);
            return Ok((structure, times[repetitions / 2]));
        }
    }
}

/// Widest footprint in texels of the position-normal mixtures, whose cost grows with the area.
const WIDEST_YAN16: f64 = 256.0;

/// Memory, build time and evaluation of the position-normal mixtures, beside the inverse bin map's.
fn measure_yan16(
    arguments: &Arguments,
    map: &NormalMap,
    model: FlakeModel,
    (ibm_bytes, ibm_seconds): (f64, f64),
    params: &Value,
) -> Result<()> {
    let refinement = yan16::resolving_refinement(map);
    let ibm = InverseBinMap::new(map, model, Options::default())?;
    let ibm = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(ibm)))?;
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
        let (method, seconds) = timed(3, || Yan16::new(map, options))?;
        let bytes = method.structure_bytes() as f64;
        print("yan16/memory", bytes, "bytes", ("ibm", ibm_bytes), &params);
        print("yan16/build", seconds, "seconds", ("ibm", ibm_seconds), &params);
        let brdf = Brdf::new(map, Masking::Beckmann, || Ok(Box::new(method)))?;
        for &width in arguments.width.iter().filter(|&&width| width <= WIDEST_YAN16) {
            let params = with(&params, &[("footprint", json!(width))]);
            let queries = queries(&brdf, width, 256);
            let eval = |brdf: &Brdf| {
                nanoseconds(&queries, arguments.seconds, |q| {
                    brdf.evaluate(&q.footprint, q.wi, q.wo).value
                })
            };
            print(
                "yan16/eval",
                eval(&brdf),
                "nanoseconds",
                ("ibm", eval(&ibm)),
                &params,
            );
        }
    }
    Ok(())
}

fn measure_queries(arguments: &Arguments, ibm: &Brdf, direct: &Brdf, width: f64, params: &Value) {
    let params = with(params, &[("footprint", json!(width))]);
    let queries = queries(ibm, width, 256);
    let eval = |brdf: &Brdf, q: &Query| brdf.evaluate(&q.footprint, q.wi, q.wo).value;
    let pdf = |brdf: &Brdf, q: &Query| brdf.pdf(&q.footprint, q.wi, q.wo);
    let sample = |brdf: &Brdf, q: &Query| {
        brdf.sample(&q.footprint, q.wi, q.u)
            .map_or(0.0, |s| s.evaluation.value)
    };
    let calls: [(&str, Call); 3] = [("ibm/eval", &eval), ("ibm/pdf", &pdf), ("ibm/sample", &sample)];
    for (name, call) in calls {
        let ours = nanoseconds(&queries, arguments.seconds, |q| call(ibm, q));
        let exact = nanoseconds(&queries, arguments.seconds, |q| call(direct, q));
        print(name, ours, "nanoseconds", ("direct sum", exact), &params);
        if name == "ibm/eval" {
            print("direct/eval", exact, "nanoseconds", ("ibm", ours), &params);
        }
    }
    let together = |brdf: &Brdf| {
        let all = |q: &Query| eval(brdf, q) + pdf(brdf, q) + sample(brdf, q);
        nanoseconds(&queries, arguments.seconds, all)
    };
    print(
        "ibm/three_calls",
        together(ibm),
        "nanoseconds",
        ("direct sum", together(direct)),
        &params,
    );
}

/// One of the three questions.
type Call<'a> = &'a dyn Fn(&Brdf, &Query) -> f32;

struct Query {
    footprint: Footprint,
    wi: Vec3,
    wo: Vec3,
    u: [f32; 3],
}

/// Footprints of `width x width` texels, turned, all over the map, with directions drawn from the BRDF, so
/// that glints are hit.
fn queries(brdf: &Brdf, width: f64, count: usize) -> Vec<Query> {
    let mut random = Random(7);
    let mut queries = Vec::with_capacity(count);
    while queries.len() < count {
        let footprint = random_footprint(&mut random, brdf.method().map_size(), width);
        let (sin, cos) = (std::f32::consts::TAU * random.uniform()).sin_cos();
        let z = 0.4 + 0.6 * random.uniform();
        let r = (1.0 - z * z).sqrt();
        let wi = Vec3::new(r * cos, r * sin, z);
        let mut uniforms = || std::array::from_fn(|_| random.uniform());
        if let Some(sample) = brdf.sample(&footprint, wi, uniforms()) {
            queries.push(Query {
                footprint,
                wi,
                wo: sample.wo,
                u: uniforms(),
            });
        }
    }
    queries
}

fn random_footprint(random: &mut Random, (columns, rows): (u32, u32), width: f64) -> Footprint {
    let center = DVec2::new(
        f64::from(random.uniform()) * f64::from(columns),
        f64::from(random.uniform()) * f64::from(rows),
    );
    let a = DVec2::from_angle(std::f64::consts::TAU * f64::from(random.uniform())) * width;
    Footprint::in_texels(columns, rows, center, a, a.perp())
}

/// Mean time of a call over whole rounds of all queries, the least of nine measurements.
fn nanoseconds(queries: &[Query], seconds: f64, call: impl Fn(&Query) -> f32) -> f64 {
    let round = |queries: &[Query]| {
        let start = Instant::now();
        for query in queries {
            std::hint::black_box(call(query));
        }
        start.elapsed().as_secs_f64()
    };
    // Slow calls get by with fewer queries.
    let first = round(&queries[..8]) / 8.0;
    let used = ((seconds / first.max(1e-9)) as usize).clamp(8, queries.len());
    let mut least = f64::INFINITY;
    for _ in 0..9 {
        let (mut total, mut rounds) = (0.0, 0);
        while total < seconds / 9.0 {
            total += round(&queries[..used]);
            rounds += 1;
        }
        least = f64::min(least, total / f64::from(rounds) / used as f64);
    }
    1e9 * least
}

/// Relative L1 error of the distribution of normals, the integral of `|D - D_direct| cos` (that of `D_direct
/// cos` being one), averaged over footprints. Half the points are drawn from each of the two: what only one
/// of them covers must count, too.
fn ndf_error(method: &dyn Method, direct: &Direct, width: f64) -> f64 {
    const FOOTPRINTS: usize = 16;
    let points = (4096.0 / (width * width)).clamp(2.0, 64.0) as usize;
    let mut random = Random(11);
    let (mut sum, mut count) = (0.0, 0);
    for _ in 0..FOOTPRINTS {
        let footprint = random_footprint(&mut random, method.map_size(), width);
        for _ in 0..points {
            let u = std::array::from_fn(|_| random.uniform());
            let source: &dyn Method = if count % 2 == 0 { direct } else { method };
            count += 1;
            if let Some(h) = source.sample(&footprint, u) {
                let drawn_with = 0.5 * (method.density(&footprint, h) + direct.density(&footprint, h));
                let difference = (method.ndf(&footprint, h) - direct.ndf(&footprint, h)).abs();
                sum += f64::from(difference * h.z / drawn_with);
            }
        }
    }
    sum / count as f64
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

fn with(params: &Value, entries: &[(&str, Value)]) -> Value {
    let mut params = params.clone();
    for (name, value) in entries {
        params[name] = value.clone();
    }
    params
}

fn print(name: &str, value: f64, unit: &str, (baseline, baseline_value): (&str, f64), params: &Value) {
    let row = json!({
        "name": name, "value": value, "unit": unit, "baseline": baseline, "baseline_value": baseline_value,
        "ratio": value / baseline_value, "params": params,
    });
    println!("{row}");
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 40) as f32 / (1 << 24) as f32
    }
}
