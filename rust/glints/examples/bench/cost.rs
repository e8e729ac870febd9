//! What queries cost.

use std::str::FromStr;
use std::time::Duration;

use glam::{DVec2, Vec3};
use glints::brdf::Brdf;
use glints::footprint::Footprint;
use rustix::time::{ClockId, clock_gettime};
use serde_json::{Value, json};

/// Texels of the largest footprint that the direct sum is asked over, some ten milliseconds a query.
pub const LARGEST_DIRECT: f64 = 2048.0 * 2048.0;

/// Texels that a Gaussian of half a pixel reaches, for each of the pixel's.
pub const GAUSSIAN_REACH: f64 = 14.0;

/// The same under a Gaussian, which weights each texel by itself: some ten milliseconds, too.
pub const LARGEST_DIRECT_GAUSSIAN: f64 = 64.0 * 64.0;

/// Length and thickness of a footprint in texels.
#[derive(Clone, Copy)]
pub struct Cell {
    pub length: f64,
    thickness: f64,
}

impl FromStr for Cell {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |text: &str| match text.parse::<f64>() {
            Ok(value) if value > 0.0 && value.is_finite() => Ok(value),
            _ => Err(format!(
                "{text} is no positive number of texels; give a width or LENGTHxTHICKNESS"
            )),
        };
        let (length, thickness) = text.split_once('x').unwrap_or((text, text));
        Ok(Self {
            length: number(length)?,
            thickness: number(thickness)?,
        })
    }
}

impl Cell {
    pub fn is_square(&self) -> bool {
        self.length == self.thickness
    }

    /// Whether the direct sum is affordable.
    pub fn is_direct(&self) -> bool {
        self.texels() <= LARGEST_DIRECT
    }

    /// Whether it is under a Gaussian.
    pub fn is_direct_gaussian(&self) -> bool {
        self.texels() <= LARGEST_DIRECT_GAUSSIAN
    }

    pub fn texels(&self) -> f64 {
        self.length * self.thickness
    }

    pub fn params(&self) -> [(&'static str, Value); 2] {
        [
            ("footprint", json!(self.length)),
            ("thickness", json!(self.thickness)),
        ]
    }

    /// A footprint of this size, turned, anywhere on a map.
    pub fn random_footprint(&self, random: &mut Random, (columns, rows): (u32, u32)) -> Footprint {
        let center = DVec2::new(
            f64::from(random.uniform()) * f64::from(columns),
            f64::from(random.uniform()) * f64::from(rows),
        );
        let axis = DVec2::from_angle(std::f64::consts::TAU * f64::from(random.uniform()));
        let (a, b) = (axis * self.length, axis.perp() * self.thickness);
        Footprint::in_texels(columns, rows, center, a, b)
    }
}

/// One of the questions, or all three as a path tracer asks them.
pub type Call = fn(&Brdf, &Query) -> f32;

pub const CALLS: [(&str, Call); 4] = [
    ("eval", eval),
    ("pdf", pdf),
    ("sample", sample),
    ("three_calls", three_calls),
];

pub fn eval(brdf: &Brdf, q: &Query) -> f32 {
    brdf.evaluate(&q.footprint, q.wi, q.wo).value
}

fn pdf(brdf: &Brdf, q: &Query) -> f32 {
    brdf.pdf(&q.footprint, q.wi, q.wo)
}

pub fn sample(brdf: &Brdf, q: &Query) -> f32 {
    brdf.sample(&q.footprint, q.wi, q.u)
        .map_or(0.0, |s| s.evaluation.value)
}

fn three_calls(brdf: &Brdf, q: &Query) -> f32 {
    eval(brdf, q) + pdf(brdf, q) + sample(brdf, q)
}

pub struct Query {
    footprint: Footprint,
    wi: Vec3,
    wo: Vec3,
    u: [f32; 3],
}

/// Footprints of a cell, turned, all over the map, with directions drawn from the BRDF, so that glints are hit.
pub fn queries(brdf: &Brdf, cell: &Cell, count: usize) -> Vec<Query> {
    let mut random = Random(7);
    let mut queries = Vec::with_capacity(count);
    while queries.len() < count {
        let footprint = cell.random_footprint(&mut random, brdf.method().map_size());
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

/// Measurements that the least is taken of.
const MEASUREMENTS: u32 = 9;

/// Mean processor time of a call over whole rounds of all queries, the least of several measurements.
pub fn nanoseconds(queries: &[Query], seconds: f64, call: impl Fn(&Query) -> f32) -> f64 {
    let round = |queries: &[Query]| {
        let start = clock(ClockId::ThreadCPUTime);
        for query in queries {
            std::hint::black_box(call(query));
        }
        clock(ClockId::ThreadCPUTime).saturating_sub(start).as_secs_f64()
    };
    // Slow calls get by with fewer queries.
    let first = round(&queries[..8]) / 8.0;
    let used = ((seconds / first.max(1e-9)) as usize).clamp(8, queries.len());
    let mut least = f64::INFINITY;
    for _ in 0..MEASUREMENTS {
        let (mut total, mut rounds) = (0.0, 0);
        while total < seconds / f64::from(MEASUREMENTS) {
            total += round(&queries[..used]);
            rounds += 1;
        }
        least = f64::min(least, total / f64::from(rounds) / used as f64);
    }
    1e9 * least
}

/// What a clock says.
pub fn clock(id: ClockId) -> Duration {
    let time = clock_gettime(id);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// SplitMix64.
pub struct Random(pub u64);

impl Random {
    pub fn uniform(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 40) as f32 / (1 << 24) as f32
    }
}
