//! Builds with their time, and memory as the allocator counts it.

use std::time::{Duration, Instant};

use glints::error::Result;
use glints::methods::Method;
use glints::normal_map::NormalMap;
use rustix::time::ClockId;
use serde_json::Value;

use crate::COUNTED;
use crate::cost::clock;
use crate::report::print;

/// A structure and what it took to build it.
pub struct Built<T> {
    pub method: T,
    /// Least wall-clock time.
    pub seconds: f64,
    /// Least processor time of the process.
    cpu_seconds: f64,
    /// Bytes that are alive after a build and were not before.
    alive: f64,
    /// Most bytes that were alive at a time during a build, beyond those before. An array that grows counts twice while
    /// it is copied.
    peak: f64,
}

/// What two structures are compared by.
pub struct Costs {
    pub bytes: f64,
    pub seconds: f64,
    cpu_seconds: f64,
}

/// Builds a structure `repetitions` times; keeps the last.
pub fn build<T>(repetitions: usize, construct: impl Fn() -> Result<T>) -> Result<Built<T>> {
    let (mut seconds, mut cpu_seconds) = (f64::INFINITY, f64::INFINITY);
    let mut repetition = 0;
    loop {
        let before = COUNTED.current_usage();
        COUNTED.reset_peak_usage();
        let (start, cpu_start) = (Instant::now(), clock(ClockId::ProcessCPUTime));
        let method = construct()?;
        seconds = f64::min(seconds, start.elapsed().as_secs_f64());
        let cpu_time: Duration = clock(ClockId::ProcessCPUTime).saturating_sub(cpu_start);
        cpu_seconds = f64::min(cpu_seconds, cpu_time.as_secs_f64());
        repetition += 1;
        if repetition >= repetitions {
            return Ok(Built {
                method,
                seconds,
                cpu_seconds,
                alive: COUNTED.current_usage() as f64 - before as f64,
                peak: COUNTED.peak_usage() as f64 - before as f64,
            });
        }
    }
}

impl<T: Method> Built<T> {
    /// What the structure says that it takes.
    pub fn bytes(&self) -> f64 {
        self.method.structure_bytes() as f64
    }

    pub fn costs(&self) -> Costs {
        Costs {
            bytes: self.bytes(),
            seconds: self.seconds,
            cpu_seconds: self.cpu_seconds,
        }
    }

    /// Prints memory and build time beside those of another structure.
    pub fn print(&self, name: &str, texels: f64, (baseline, other): (&str, &Costs), params: &Value) {
        let row = |what: &str, value: f64, unit: &str, baseline: (&str, f64)| {
            print(&format!("{name}/{what}"), value, unit, baseline, params);
        };
        let said = ("structure_bytes", self.bytes());
        row("memory", self.bytes(), "bytes", (baseline, other.bytes));
        let of_others = (baseline, other.bytes / texels);
        row(
            "bytes_per_texel",
            self.bytes() / texels,
            "bytes a texel",
            of_others,
        );
        row("memory_counted", self.alive, "bytes", said);
        row("build_peak", self.peak, "bytes", said);
        row("build", self.seconds, "seconds", (baseline, other.seconds));
        let of_others = (baseline, other.cpu_seconds);
        row("build_cpu", self.cpu_seconds, "seconds", of_others);
    }
}

/// A square map of another side: the given one from its first texel on, repeated.
pub fn resized(map: &NormalMap, side: u32) -> Result<NormalMap> {
    let texel = |index: u64| {
        let (column, row) = (index % u64::from(side), index / u64::from(side));
        map.normal(column as u32 % map.width(), row as u32 % map.height())
    };
    let normals: Vec<_> = (0..u64::from(side).pow(2)).map(texel).collect();
    NormalMap::from_normals(format!("{} at side {side}", map.name()), side, side, &normals)
}
