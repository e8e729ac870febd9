//! `glints environment`: an environment's light as spherical Gaussians.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use glints::environment_file::{self, MapName};
use glints::environment_map::{EnvironmentFit, EnvironmentMap};
use serde_json::{Value, json};

use crate::environment_picture;
use crate::failure::{Failure, Result};
use crate::output::{self, Destination};
use crate::picture::Format;
use crate::progress::Progress;

/// Fits spherical Gaussians to an environment map, for environment prefiltering (Deng et al. 2022, Section 5.4)
///
/// The map is a latitude-longitude picture, as Mitsuba's emitter `envmap` takes it: EXR, floating-point numbers, not
/// negative. Its first row is +y, its last row -y, its middle +z, a quarter of the width from the left +x, in the emitter's
/// own frame: turn emitter and fit together with the emitter's `to_world`.
///
/// The .json file holds axis, sharpness and light (RGB, radiance integrated over directions) of every Gaussian. `glints_path`
/// takes it as `environment_file`, instead of fitting at the first sample.
///
/// The share of the light that is elsewhere says how well the Gaussians follow the map: 0 is perfect. Look at a picture
/// before you trust a fit: .png shows the map above the fit, .exr holds the fit's radiances as an environment map.
///
/// Example: glints environment studio.exr --lobes 256 -o studio.json --picture studio.png
#[derive(Args)]
#[command(verbatim_doc_comment)]
#[command(group(clap::ArgGroup::new("written").args(["output", "picture"]).required(true).multiple(true)))]
pub struct Arguments {
    /// Environment map to read: .exr
    map: PathBuf,

    /// Fit to write: .json
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,

    /// Picture of the fit to write: .png (colours) or .exr (radiances)
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,

    /// Number of spherical Gaussians, in 1 to 1024; more follow the shapes of lights better, and take more time
    #[arg(long, default_value_t = 128)]
    lobes: usize,

    /// Print one line of JSON
    #[arg(long)]
    json: bool,

    /// Overwrite the files if they exist
    #[arg(long)]
    force: bool,
}

/// A file to write, and as what.
enum Target {
    Fit(Destination),
    Picture(Destination, Format),
}

impl Target {
    fn destination(&self) -> &Destination {
        match self {
            Self::Fit(destination) | Self::Picture(destination, _) => destination,
        }
    }
}

impl Arguments {
    fn targets(&self) -> Result<Vec<Target>> {
        let destination = |path: &Path| Destination::new(path, self.force, &[&self.map]);
        let mut targets = Vec::new();
        if let Some(path) = &self.output {
            if path.extension().is_none_or(|e| !e.eq_ignore_ascii_case("json")) {
                return Err(Failure::usage(format!(
                    "\"{}\": a fit is written as .json; end the name so, or write a picture of it with --picture",
                    path.display()
                )));
            }
            targets.push(Target::Fit(destination(path)?));
        }
        if let Some(path) = &self.picture {
            let format = Format::of(path)?;
            targets.push(Target::Picture(destination(path)?, format));
        }
        Ok(targets)
    }
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let targets = arguments.targets()?;
    let map = {
        let _progress = Progress::spinner("reading the map");
        EnvironmentMap::load(&arguments.map)?
    };
    let name = MapName::of(&arguments.map, &map)?;
    let start = Instant::now();
    let fit = {
        let _progress = Progress::spinner("fitting spherical Gaussians");
        map.fit(arguments.lobes)?
    };
    let seconds = start.elapsed().as_secs_f64();
    let destinations: Vec<&Destination> = targets.iter().map(Target::destination).collect();
    output::write_files(&destinations, |files| {
        let _progress = Progress::spinner("writing");
        for (target, file) in targets.iter().zip(files) {
            match target {
                Target::Fit(_) => environment_file::save(&fit, &name, file)?,
                Target::Picture(_, format) => environment_picture::write(file, *format, &map, &fit)?,
            }
        }
        Ok(())
    })?;
    let files = destinations.iter().map(|d| d.path().display().to_string());
    let report = describe(&fit, &name, seconds, files.collect());
    output::print(&if arguments.json {
        format!("{report}\n")
    } else {
        text(&report)
    })
}

fn describe(fit: &EnvironmentFit, map: &MapName, seconds: f64, files: Vec<String>) -> Value {
    json!({
        "map": map.name,
        "crc32": map.crc32,
        "width": map.width,
        "height": map.height,
        "lobes": fit.mixture.lobes().len(),
        "seconds": seconds,
        "residual": fit.residual,
        "light": fit.total(),
        "files": files,
    })
}

fn text(report: &Value) -> String {
    let number = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
    let [r, g, b] = [0, 1, 2].map(|i| number(&report["light"][i]));
    let mut text = format!(
        "map        {} x {} pixels, checksum {}\n\
         lobes      {}, fitted in {:.2} s\n\
         light      {r:.4}, {g:.4}, {b:.4} (red, green, blue; radiance integrated over directions)\n\
         elsewhere  {:.2} % of the light is not where the map has it\n",
        report["width"],
        report["height"],
        report["crc32"].as_str().unwrap_or_default(),
        report["lobes"],
        number(&report["seconds"]),
        100.0 * number(&report["residual"]),
    );
    for file in report["files"].as_array().into_iter().flatten() {
        text += &format!("written    {}\n", file.as_str().unwrap_or_default());
    }
    text
}
