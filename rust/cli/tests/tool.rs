//! The tool as a process: results, messages, exit status, and what it leaves on the disk.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use serde_json::Value;
use tempfile::TempDir;

fn glints(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_glints"))
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = glints(folder, arguments);
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {message}");
    assert!(message.is_empty(), "{arguments:?}: {message}");
    String::from_utf8(output.stdout).unwrap()
}

fn json(folder: &Path, arguments: &[&str]) -> Value {
    serde_json::from_str(&succeeds(folder, arguments)).unwrap()
}

/// The one line of a failure, which has all of `words`, and nothing on standard output.
fn fails(folder: &Path, arguments: &[&str], status: i32, words: &[&str]) {
    let output = glints(folder, arguments);
    let message = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(status), "{arguments:?}: {message}");
    assert_eq!(message.lines().count(), 1, "{arguments:?}: {message}");
    assert!(output.stdout.is_empty(), "{arguments:?}");
    for word in words {
        assert!(
            message.contains(word),
            "{arguments:?}: {word:?} is not in {message}"
        );
    }
}

/// A folder with a flake map of 128 x 128 texels, `flakes.exr`.
fn folder_with_map() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let options = [
        "--size",
        "128",
        "--flake-size",
        "3",
        "--gamma",
        "3",
        "--alpha",
        "0.2",
    ];
    let arguments = [
        &["flakes", "-o", "flakes.exr", "--mask", "mask.png"],
        &options[..],
    ]
    .concat();
    succeeds(folder.path(), &arguments);
    folder
}

fn files(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

fn ndf(folder: &Path, more: &[&str]) -> Value {
    let common = ["ndf", "flakes.exr", "--force", "--json"];
    json(folder, &[&common, more].concat())
}

fn number(value: &Value) -> f64 {
    value
        .as_f64()
        .unwrap_or_else(|| panic!("{value} is not a number"))
}

#[test]
fn help_teaches_every_command() {
    let folder = tempfile::tempdir().unwrap();
    let help = succeeds(folder.path(), &["--help"]);
    for command in ["info", "ndf", "precompute", "flakes", "environment"] {
        assert!(help.contains(command), "{help}");
    }
    for command in [
        &["info"][..],
        &["ndf"],
        &["precompute", "ibm"],
        &["flakes"],
        &["environment"],
    ] {
        let help = succeeds(folder.path(), &[command, &["--help"]].concat());
        assert!(help.contains("Example: glints "), "{help}");
    }
}

#[test]
fn info_tells_what_a_flake_map_holds() {
    let folder = folder_with_map();
    let report = json(
        folder.path(),
        &["info", "flakes.exr", "--alpha", "0.0025,0.16", "--json"],
    );
    assert_eq!(report["width"], 128);
    assert_eq!(report["encoding"], "signed");
    assert_eq!(report["tiling"]["tiles"], true);
    // The texels without a flake, 0.4 of the area.
    let flat = number(&report["flat_texels"]);
    assert!((0.35..0.45).contains(&flat), "{flat}");
    assert_eq!(report["structures"].as_array().unwrap().len(), 2);
    assert_eq!(report["structures"][0]["alpha"], 0.0025);
    assert!(number(&report["structures"][0]["bytes"]) > 0.0);
    let text = succeeds(folder.path(), &["info", "flakes.exr"]);
    assert!(text.contains("128 x 128 texels, signed"), "{text}");
}

#[test]
fn every_method_shows_a_distribution_that_integrates_to_one() {
    let folder = folder_with_map();
    for method in [
        "direct",
        "ibm",
        "ibm_paper",
        "yan16",
        "yan16_curved",
        "unfiltered",
    ] {
        let options = [
            "--footprint",
            "9,5",
            "--alpha",
            "0.08",
            "--size",
            "64",
            "-o",
            "ndf.exr",
        ];
        let report = ndf(folder.path(), &[&["--method", method], &options[..]].concat());
        let picture = &report["pictures"][0];
        assert_eq!(report["strategy"], "grid");
        assert_eq!(picture["method"], method);
        let integral = number(&picture["integral"]);
        assert!((integral - 1.0).abs() < 0.01, "{method}: {integral}");
    }
}

#[test]
fn lobes_far_narrower_than_a_pixel_keep_their_energy() {
    let folder = folder_with_map();
    let options = [
        "--footprint",
        "0",
        "--alpha",
        "0.0002",
        "-o",
        "ndf.exr",
        "--points",
        "65536",
    ];
    let report = ndf(folder.path(), &options);
    assert_eq!(report["strategy"], "draws");
    let picture = &report["pictures"][0];
    assert!((number(&picture["integral"]) - 1.0).abs() < 0.01, "{picture}");
    // One lobe lies in one pixel, or in four at most.
    let whole = (64.0_f64 / 2.0).powi(2);
    assert!(number(&picture["peak"]) > 0.24 * whole, "{picture}");
}

#[test]
fn grid_and_draws_agree() {
    let folder = folder_with_map();
    let options = [
        "--footprint",
        "20",
        "--alpha",
        "0.05",
        "-o",
        "ndf.exr",
        "--compare",
        "ibm_paper",
    ];
    let grid = ndf(folder.path(), &options);
    let draws = ndf(
        folder.path(),
        &[&options[..], &["--size", "256", "--points", "65536"]].concat(),
    );
    assert_eq!(
        (&grid["strategy"], &draws["strategy"]),
        (&"grid".into(), &"draws".into())
    );
    let [a, b] = [grid, draws].map(|report| number(&report["relative_l1_difference"]));
    assert!(a > 0.02 && (a / b - 1.0).abs() < 0.05, "{a} {b}");
}

#[test]
fn pictures_hold_the_values_and_their_place() {
    let folder = folder_with_map();
    // The flake under the point, as `unfiltered` sees it, is one lobe about its normal.
    let at = [
        "--at",
        "0.3,0.6",
        "--footprint",
        "0",
        "--alpha",
        "0.05",
        "--size",
        "64",
    ];
    for name in ["ndf.exr", "ndf.png"] {
        ndf(folder.path(), &[&at[..], &["-o", name]].concat());
    }
    let map = image::open(folder.path().join("flakes.exr"))
        .unwrap()
        .into_rgb32f();
    let normal = map.get_pixel((0.3 * 128.0) as u32, (0.6 * 128.0) as u32).0;
    let picture = image::open(folder.path().join("ndf.exr")).unwrap().into_rgb32f();
    assert_eq!(picture.dimensions(), (64, 64));
    let (mut sum, mut center) = (0.0, [0.0; 2]);
    for (x, y, value) in picture.enumerate_pixels() {
        let position = |i: u32| f64::from(i) / 32.0 + 1.0 / 64.0 - 1.0;
        let mass = f64::from(value.0[0]) / (32.0 * 32.0);
        sum += mass;
        center[0] += mass * position(x);
        center[1] -= mass * position(y);
    }
    assert!((sum - 1.0).abs() < 0.01, "{sum}");
    for axis in 0..2 {
        assert!(
            (center[axis] - f64::from(normal[axis])).abs() < 0.01,
            "{center:?} {normal:?}"
        );
    }
    let coloured = image::open(folder.path().join("ndf.png")).unwrap().into_rgb8();
    assert!(coloured.width() > 64 && coloured.height() > 64);
}

#[test]
fn the_same_flakes_come_from_the_same_seed() {
    let folder = folder_with_map();
    let bytes = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    for (name, seed) in [("a.exr", "1"), ("b.exr", "1"), ("c.exr", "2")] {
        succeeds(
            folder.path(),
            &["flakes", "-o", name, "--size", "64", "--seed", seed],
        );
    }
    assert!(bytes("a.exr") == bytes("b.exr"));
    assert!(bytes("a.exr") != bytes("c.exr"));
    assert_eq!(
        files(folder.path()),
        ["a.exr", "b.exr", "c.exr", "flakes.exr", "mask.png"]
    );
}

#[test]
fn a_saved_structure_tells_what_it_is() {
    let folder = folder_with_map();
    let precompute = ["precompute", "ibm", "flakes.exr", "-o", "flakes.glints"];
    let told = succeeds(
        folder.path(),
        &[&precompute[..], &["--alpha", "0.004", "--distribution", "ggx"]].concat(),
    );
    assert!(told.starts_with("flakes.glints: "), "{told}");
    assert_eq!(files(folder.path()), ["flakes.exr", "flakes.glints", "mask.png"]);
    let text = succeeds(folder.path(), &["info", "flakes.glints"]);
    for word in ["128 x 128 texels", "alpha 0.004", "ggx"] {
        assert!(text.contains(word), "{word:?} is not in {text}");
    }
    let header = json(folder.path(), &["info", "flakes.glints", "--json"]);
    assert_eq!(header["width"], 128);
    assert_eq!(header["alpha"], 0.004);
    let map = json(
        folder.path(),
        &["info", "flakes.exr", "--json", "--alpha", "0.16"],
    );
    assert_eq!(header["map"]["slope_covariance"], map["slope_covariance"]);
    assert_eq!(header["map"]["width"], 128);
    assert!(header["map"]["refinement"].is_null());
    let checksum = header["map"]["checksum"].as_str().unwrap();
    assert!(checksum.len() == 8 && text.contains(checksum), "{text}");
    let path = folder.path().join("flakes.glints");
    let bytes = std::fs::read(&path).unwrap();
    assert_eq!(header["file_bytes"], bytes.len());

    fails(folder.path(), &precompute, 1, &["exists already"]);
    succeeds(folder.path(), &[&precompute[..], &["--force"]].concat());
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let refused = ["flakes.glints", "bytes instead of", "glints precompute"];
    fails(folder.path(), &["info", "flakes.glints"], 1, &refused);
}

#[test]
fn gaussian_footprints_are_those_of_mixtures() {
    let folder = folder_with_map();
    let difference = |filter: &[&str]| {
        let options = [
            "--footprint",
            "20",
            "--alpha",
            "0.1",
            "--size",
            "32",
            "-o",
            "ndf.exr",
        ];
        let methods = ["--method", "direct", "--compare", "yan16"];
        let report = ndf(folder.path(), &[&options[..], &methods, filter].concat());
        assert_eq!(
            report["footprint_filter"],
            filter.get(1).copied().unwrap_or("box")
        );
        number(&report["relative_l1_difference"])
    };
    let gaussian = ["--footprint-filter", "gaussian"];
    let (same, other) = (difference(&gaussian), difference(&[]));
    assert!(same < 0.05 && other > 2.0 * same, "{same} {other}");
    let wide = difference(&[&gaussian[..], &["--footprint-sigma", "1"]].concat());
    assert!(wide < 0.05, "{wide}");
    let wrong = [
        "ndf",
        "flakes.exr",
        "-o",
        "a.exr",
        "--footprint",
        "4",
        "--footprint-filter",
        "gaussian",
        "--footprint-sigma",
        "5",
    ];
    fails(folder.path(), &wrong, 2, &["footprint_sigma", "0.05"]);
}

#[test]
fn a_saved_structure_is_shown_as_the_one_that_is_built() {
    let folder = folder_with_map();
    let flakes = ["--alpha", "0.05", "--distribution", "ggx"];
    let precompute = ["precompute", "ibm", "flakes.exr", "-o", "flakes.glints"];
    succeeds(folder.path(), &[&precompute[..], &flakes].concat());
    let options = ["--footprint", "20", "--size", "64", "--force", "--json"];
    let show = |input: &str, output: &str, more: &[&str]| {
        let arguments = [&["ndf", input, "-o", output], &options[..], more].concat();
        let report = json(folder.path(), &arguments);
        assert_eq!(report["pictures"][0]["method"], "ibm");
        (report, std::fs::read(folder.path().join(output)).unwrap())
    };
    let (built, expected) = show(
        "flakes.exr",
        "a.exr",
        &[&["--method", "ibm"], &flakes[..]].concat(),
    );
    let (loaded, found) = show("flakes.glints", "b.exr", &[]);
    assert!(found == expected);
    assert_eq!(loaded["pictures"], built["pictures"]);
    assert_eq!(loaded["alpha"], 0.05);
    assert_eq!(loaded["distribution"], "ggx");
    // What agrees may be said; the twin are other flakes.
    assert!(
        show(
            "flakes.glints",
            "b.exr",
            &[&["--method", "ibm"], &flakes[..]].concat()
        )
        .1 == expected
    );
    assert!(show("flakes.exr", "c.exr", &["--method", "ibm"]).1 != expected);

    let refused = |more: &[&str], words: &[&str]| {
        let arguments = [&["ndf", "flakes.glints", "-o", "d.exr"], &options[..], more].concat();
        fails(
            folder.path(),
            &arguments,
            2,
            &[&["flakes.glints"], words].concat(),
        );
    };
    refused(&["--method", "direct"], &["\"method\"", "needs the normal map"]);
    refused(&["--compare", "direct"], &["\"compare\"", "needs the normal map"]);
    refused(&["--alpha", "0.04"], &["\"alpha\"", "0.05", "--alpha 0.04"]);
    refused(&["--distribution", "beckmann"], &["\"distribution\"", "ggx"]);
    refused(&["--interpolation", "bilinear"], &["\"interpolation\"", "leave"]);
    refused(&["--flip-y"], &["\"flip_y\"", "leave"]);
    assert!(!folder.path().join("d.exr").exists());
}

#[test]
fn interpolated_maps_are_the_surface_of_curved_elements() {
    let folder = tempfile::tempdir().unwrap();
    let up = |i: u32| 0.5 + 0.1 * (f64::from(i) * std::f64::consts::TAU / 16.0).sin();
    image::Rgb32FImage::from_fn(16, 16, |u, v| image::Rgb([up(u) as f32, up(v) as f32, 1.0]))
        .save(folder.path().join("flakes.exr"))
        .unwrap();
    let difference = |compare: &str, footprint: &str, more: &[&str]| {
        let options = [
            "--footprint",
            footprint,
            "--alpha",
            "0.02",
            "--size",
            "32",
            "-o",
            "ndf.exr",
        ];
        let methods = ["--method", "ibm", "--compare", compare];
        let report = ndf(folder.path(), &[&options[..], &methods, more].concat());
        (
            number(&report["relative_l1_difference"]),
            report["refinement"].clone(),
        )
    };
    let bilinear = &["--interpolation", "bilinear"];
    let (same, refinement) = difference("direct", "6", &[&bilinear[..], &["--refinement", "3"]].concat());
    assert!(same < 0.02, "{same}");
    assert_eq!(refinement["texels_per_side"], 3);
    // Over many periods of the map, where Yan's wider footprint makes no difference; its elements are one a texel.
    let (curved, automatic) = difference("yan16_curved", "160", bilinear);
    let (flat, none) = difference("yan16_curved", "160", &[]);
    assert!(curved < 0.2 && flat > 0.4, "{curved} {flat}");
    assert!(
        number(&automatic["step"]) <= 1.5 && none.is_null(),
        "{automatic} {none}"
    );

    let told = |more: &[&str]| json(folder.path(), &[&["info", "flakes.exr", "--json"], more].concat());
    let structures = told(&[&bilinear[..], &["--alpha", "0.02,0.16", "--refinement", "4"]].concat());
    assert_eq!(structures["structures"][1]["refinement"]["texels_per_side"], 4);
    assert!(told(&["--alpha", "0.16"])["structures"][0]["refinement"].is_null());
    let precompute = [
        "precompute",
        "ibm",
        "flakes.exr",
        "-o",
        "flakes.glints",
        "--refinement",
        "4",
    ];
    succeeds(folder.path(), &[&precompute[..], bilinear].concat());
    let header = json(folder.path(), &["info", "flakes.glints", "--json"]);
    assert_eq!(header["width"], 64);
    assert_eq!(header["map"]["width"], 16);
    assert_eq!(header["map"]["refinement"]["texels_per_side"], 4);
    // Of the map, not of its refined texels.
    assert_eq!(
        header["map"]["slope_covariance"],
        told(&["--alpha", "0.16"])["slope_covariance"]
    );
    let text = succeeds(folder.path(), &["info", "flakes.glints"]);
    for word in [
        "64 x 64 texels",
        "16 x 16 texels",
        "interpolated, 4 x 4",
        "slope covariance",
    ] {
        assert!(text.contains(word), "{word:?} is not in {text}");
    }
    // It is shown as what is built, over a footprint in texels of the map.
    let show = |input: &str, output: &str, more: &[&str]| {
        let options = [
            "ndf",
            input,
            "-o",
            output,
            "--footprint",
            "3",
            "--size",
            "32",
            "--json",
        ];
        let report = json(folder.path(), &[&options[..], more].concat());
        (report, std::fs::read(folder.path().join(output)).unwrap())
    };
    let refined = [&bilinear[..], &["--refinement", "4", "--method", "ibm"]].concat();
    let (built, expected) = show("flakes.exr", "built.exr", &refined);
    let (loaded, found) = show("flakes.glints", "loaded.exr", &[]);
    assert!(found == expected);
    assert_eq!(loaded["pictures"], built["pictures"]);
    let step = |report: &Value| number(&report["refinement"]["step"]);
    assert!((step(&loaded) / step(&built) - 1.0).abs() < 1e-6);
    assert!(show("flakes.exr", "flat.exr", &["--method", "ibm"]).1 != expected);
    // A step that no refinement resolves is told, once, and the result is there.
    let output = glints(
        folder.path(),
        &[
            "info",
            "flakes.exr",
            "--alpha",
            "0.0005",
            bilinear[0],
            bilinear[1],
        ],
    );
    let message = String::from_utf8(output.stderr).unwrap();
    assert!(
        output.status.success() && message.lines().count() == 1,
        "{message}"
    );
    assert!(
        message.contains("warning") && message.contains("faceted"),
        "{message}"
    );
}

#[test]
fn nothing_is_overwritten_without_being_asked() {
    let folder = folder_with_map();
    let before = std::fs::read(folder.path().join("flakes.exr")).unwrap();
    let exists = ["flakes.exr", "exists already", "--force"];
    fails(
        folder.path(),
        &["flakes", "-o", "flakes.exr", "--size", "8"],
        1,
        &exists,
    );
    fails(
        folder.path(),
        &["precompute", "ibm", "mask.png", "-o", "flakes.exr"],
        1,
        &exists,
    );
    let onto_itself = [
        "ndf",
        "flakes.exr",
        "--footprint",
        "1",
        "-o",
        "flakes.exr",
        "--force",
    ];
    fails(folder.path(), &onto_itself, 1, &["the file to be read"]);
    assert!(std::fs::read(folder.path().join("flakes.exr")).unwrap() == before);
    succeeds(
        folder.path(),
        &["flakes", "-o", "flakes.exr", "--size", "8", "--force"],
    );
    assert!(std::fs::read(folder.path().join("flakes.exr")).unwrap() != before);
}

#[test]
fn wrong_usage_is_told_in_one_line() {
    let folder = folder_with_map();
    let run = |arguments: &[&str], words: &[&str]| fails(folder.path(), arguments, 2, words);
    run(&[], &["--help"]);
    run(&["inof"], &["inof", "info"]);
    run(&["ndf", "flakes.exr", "-o", "a.png"], &["--footprint"]);
    let ndf = |more: &[&str], words: &[&str]| {
        run(
            &[&["ndf", "flakes.exr", "-o", "a.png", "--footprint", "4"], more].concat(),
            words,
        );
    };
    ndf(&["--method", "direkt"], &["direkt", "direct"]);
    ndf(&["--alpha", "7"], &["alpha", "7"]);
    ndf(&["--at", "0.5"], &["--at", "2 numbers"]);
    ndf(&["--size", "1000000"], &["--size", "4096"]);
    ndf(
        &["--method", "yan16", "--distribution", "ggx"],
        &["distribution", "yan16"],
    );
    let bilinear = ["--interpolation", "bilinear"];
    ndf(
        &["--refinement", "2"],
        &["refinement", "--interpolation bilinear"],
    );
    ndf(&["--interpolation", "cubic"], &["cubic", "bilinear"]);
    ndf(
        &[&bilinear[..], &["--refinement", "9"]].concat(),
        &["refinement", "1 to 8"],
    );
    ndf(
        &[&bilinear[..], &["--method", "yan16"]].concat(),
        &["interpolation", "yan16_curved"],
    );
    let gaussian = ["--footprint-filter", "gaussian"];
    ndf(&["--footprint-filter", "tent"], &["tent", "box", "gaussian"]);
    ndf(
        &[&gaussian[..], &["--method", "ibm"]].concat(),
        &["footprint_filter", "ibm", "direct"],
    );
    ndf(
        &[&gaussian[..], &["--compare", "unfiltered"]].concat(),
        &["footprint_filter", "unfiltered"],
    );
    ndf(
        &["--footprint-sigma", "0.3"],
        &["footprint_sigma", "--footprint-filter gaussian"],
    );
    run(
        &["ndf", "flakes.exr", "-o", "a.png", "--footprint", "-3"],
        &["--footprint", "negative"],
    );
    run(
        &["ndf", "flakes.exr", "-o", "a.jpg", "--footprint", "3"],
        &["a.jpg", ".png", ".exr"],
    );
    run(&["info", "flakes.exr", "--alpha", "0.01,nan"], &["alpha", "NaN"]);
    run(&["flakes", "-o", "b.exr", "--density", "0"], &["density"]);
    run(&["flakes", "-o", "b.exr", "--mask", "b.exr"], &["--mask"]);
    run(
        &["precompute", "ibm", "flakes.exr", "-o", "s", "--alpha", "0"],
        &["alpha"],
    );
    assert_eq!(files(folder.path()), ["flakes.exr", "mask.png"]);
}

#[test]
fn hostile_files_are_refused_in_one_line() {
    let folder = folder_with_map();
    let good = std::fs::read(folder.path().join("flakes.exr")).unwrap();
    let mut broken: Vec<(String, Vec<u8>)> = vec![
        ("empty".into(), vec![]),
        ("text.png".into(), b"not a picture\n".to_vec()),
        (
            "header.png".into(),
            b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\xff\xff\xff\xff".to_vec(),
        ),
    ];
    for cut in [5, 40, 300, good.len() / 2, good.len() - 1] {
        broken.push((format!("cut-{cut}.exr"), good[..cut].to_vec()));
    }
    for (index, byte) in [(8, 0xff), (60, 0xff), (200, 0x80), (310, 0xff)] {
        let mut damaged = good.clone();
        for place in &mut damaged[index..index + 8] {
            *place = byte;
        }
        broken.push((format!("damaged-{index}.exr"), damaged));
    }
    for (name, bytes) in &broken {
        std::fs::write(folder.path().join(name), bytes).unwrap();
        let output = glints(folder.path(), &["info", name]);
        let message = String::from_utf8(output.stderr).unwrap();
        // Damage to a header's field may leave a readable map.
        assert!(matches!(output.status.code(), Some(0 | 1)), "{name}: {message}");
        assert!(!message.contains("internal error"), "{name}: {message}");
        if output.status.code() == Some(1) {
            assert!(
                message.contains(name.as_str()) && message.lines().count() == 1,
                "{message}"
            );
        }
    }
    fails(folder.path(), &["info", "no-such.exr"], 1, &["no-such.exr"]);
    fails(folder.path(), &["info", "."], 1, &["\".\""]);
    fails(
        folder.path(),
        &["info", "mask.png"],
        1,
        &["mask.png", "three channels"],
    );
    let nowhere = ["flakes", "-o", "no/where.exr"];
    fails(folder.path(), &nowhere, 1, &["no/where.exr", "does not exist"]);
}

/// An environment map of 64 x 33 pixels, `studio.exr`: dim grey, and a red rectangle around +x, up to 45 degrees high.
fn folder_with_studio() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let picture = image::Rgb32FImage::from_fn(64, 33, |column, row| {
        let red = (12..20).contains(&column) && (8..17).contains(&row);
        image::Rgb(if red { [20.0, 0.2, 0.2] } else { [0.2; 3] })
    });
    picture.save(folder.path().join("studio.exr")).unwrap();
    folder
}

#[test]
fn an_environment_becomes_lobes_with_its_light() {
    let folder = folder_with_studio();
    let arguments = ["environment", "studio.exr", "--lobes", "16", "-o", "fit.json"];
    let report = json(
        folder.path(),
        &[&arguments[..], &["--picture", "fit.exr", "--json"]].concat(),
    );
    assert_eq!((&report["lobes"], &report["width"]), (&16.into(), &64.into()));
    assert!((0.005..0.3).contains(&number(&report["residual"])), "{report}");
    assert_eq!(files(folder.path()), ["fit.exr", "fit.json", "studio.exr"]);
    let text = std::fs::read_to_string(folder.path().join("fit.json")).unwrap();
    let fit: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(
        (&fit["version"], &fit["map"]["name"]),
        (&1.into(), &"studio.exr".into())
    );
    assert_eq!(fit["map"]["crc32"], report["crc32"]);
    let lobes = fit["lobes"].as_array().unwrap();
    let sum = |channel: usize| {
        lobes
            .iter()
            .map(|lobe| number(&lobe["energy"][channel]))
            .sum::<f64>()
    };
    // Green is 0.2 all over the sphere; the picture of the fit has the same light as the lobes, in all colours.
    assert!(
        (sum(1) / (0.8 * std::f64::consts::PI) - 1.0).abs() < 1e-5,
        "{}",
        sum(1)
    );
    let picture = image::open(folder.path().join("fit.exr")).unwrap().into_rgb32f();
    assert_eq!(picture.dimensions(), (64, 33));
    let (mut light, mut left) = ([0.0; 3], 0.0);
    for (column, row, pixel) in picture.enumerate_pixels() {
        let theta = std::f64::consts::PI * f64::from(row) / 32.0;
        let solid_angle = theta.sin() * std::f64::consts::PI.powi(2) / (32.0 * 32.0);
        for (sum, value) in light.iter_mut().zip(pixel.0) {
            *sum += f64::from(value) * solid_angle;
        }
        left += if column < 32 {
            f64::from(pixel.0[0]) * solid_angle
        } else {
            0.0
        };
    }
    for (channel, light) in light.into_iter().enumerate() {
        assert!((light / sum(channel) - 1.0).abs() < 0.01, "{channel}: {light}");
    }
    assert!(left > 0.9 * light[0], "{left} {light:?}");
    // The brightest lobe points to the rectangle.
    let red = |lobe: &&Value| number(&lobe["energy"][0]);
    let brightest = lobes.iter().max_by(|a, b| red(a).total_cmp(&red(b))).unwrap();
    let axis = [0, 1, 2].map(|i| number(&brightest["axis"][i]));
    assert!(axis[0] > 0.7 && axis[1] > 0.0 && axis[2].abs() < 0.5, "{axis:?}");
    let text = succeeds(folder.path(), &[&arguments[..], &["--force"]].concat());
    assert!(
        text.contains("16, fitted in") && text.contains("fit.json"),
        "{text}"
    );
}

#[test]
fn a_picture_shows_the_map_above_the_fit() {
    let folder = folder_with_studio();
    let arguments = [
        "environment",
        "studio.exr",
        "--lobes",
        "32",
        "--picture",
        "fit.png",
    ];
    succeeds(folder.path(), &arguments);
    let picture = image::open(folder.path().join("fit.png")).unwrap().into_rgb8();
    assert_eq!(picture.width(), 64);
    let [gap, rows] = [picture.height() - 66, 33];
    for top in [0, rows + gap] {
        let [lamp, dim] = [
            picture.get_pixel(16, top + 12).0,
            picture.get_pixel(48, top + 12).0,
        ];
        assert!(lamp[0] > 200 && lamp[0] > 2 * lamp[1], "{lamp:?}");
        assert!(dim[0] < 160 && dim[0].abs_diff(dim[1]) < 30, "{dim:?}");
    }
}

#[test]
fn wrong_environments_are_refused() {
    let folder = folder_with_studio();
    let at = folder.path();
    let run = |status, arguments: &[&str], words: &[&str]| {
        fails(at, &[&["environment"], arguments].concat(), status, words);
    };
    run(2, &["studio.exr"], &["--output", "--picture"]);
    run(
        2,
        &["studio.exr", "-o", "fit.exr"],
        &["fit.exr", ".json", "--picture"],
    );
    run(2, &["studio.exr", "--picture", "fit.jpg"], &["fit.jpg", ".png"]);
    for lobes in ["0", "1025"] {
        let words = ["lobes", "[1, 1024]"];
        run(2, &["studio.exr", "-o", "fit.json", "--lobes", lobes], &words);
    }
    run(1, &["no.exr", "-o", "fit.json"], &["no.exr"]);
    run(
        1,
        &["studio.exr", "--picture", "studio.exr", "--force"],
        &["studio.exr", "read"],
    );
    std::fs::write(at.join("fit.json"), "mine").unwrap();
    run(1, &["studio.exr", "-o", "fit.json"], &["fit.json", "--force"]);
    image::RgbImage::new(8, 4).save(at.join("low.png")).unwrap();
    run(1, &["low.png", "-o", "a.json"], &["low.png", "EXR"]);
    let save = |name: &str, value: f32| {
        let picture = image::Rgb32FImage::from_pixel(8, 4, image::Rgb([1.0, value, 1.0]));
        picture.save(at.join(name)).unwrap();
    };
    save("nan.exr", f32::NAN);
    run(
        1,
        &["nan.exr", "-o", "a.json"],
        &["nan.exr", "column 0, row 0", "finite"],
    );
    save("negative.exr", -1.0);
    run(
        1,
        &["negative.exr", "-o", "a.json"],
        &["negative.exr", "not negative"],
    );
    image::Rgb32FImage::new(8, 4).save(at.join("black.exr")).unwrap();
    run(2, &["black.exr", "-o", "a.json"], &["black"]);
    assert_eq!(std::fs::read_to_string(at.join("fit.json")).unwrap(), "mine");
    assert!(!at.join("a.json").exists());
}

#[test]
fn a_reader_that_goes_away_is_no_failure() {
    let folder = folder_with_map();
    let mut child = Command::new(env!("CARGO_BIN_EXE_glints"))
        .args(["info", "flakes.exr"])
        .current_dir(folder.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    assert!(output.stderr.is_empty());
}

#[cfg(unix)]
#[test]
fn an_interruption_leaves_no_file() {
    use std::time::{Duration, Instant};

    let folder = tempfile::tempdir().unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_glints"))
        .args(["flakes", "-o", "big.exr", "--size", "2048", "--flake-size", "4"])
        .current_dir(folder.path())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // The temporary folder tells that writing has begun.
    let hidden = || {
        files(folder.path())
            .into_iter()
            .find(|name| name.starts_with(".glints-"))
    };
    let start = Instant::now();
    let staging = loop {
        if let Some(name) = hidden() {
            break Some(PathBuf::from(name));
        }
        if child.try_wait().unwrap().is_some() || start.elapsed() > Duration::from_secs(60) {
            break None;
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    assert!(staging.is_some(), "writing was never seen");
    let killed = Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status();
    assert!(killed.unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(files(folder.path()), [""; 0]);
}
