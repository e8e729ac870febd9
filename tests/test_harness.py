"""The comparison harness: its metrics, its scenes, its references, its files, and a tiny comparison from end to end."""

import argparse
import csv
import json
import math
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
import pytest
import support
import test_report
from glints_harness import bench, cli, compare, executors, files, images, maps, metrics, plan, ranks, render, scenes
from glints_harness.cli import ROOT, scene_assets
from glints_harness.images import read_exr
from glints_harness.methods import GLINTS, METHODS, check_plugins, choose
from glints_harness.progress import Silent
from glints_harness.report import text
from glints_harness.summary import METRICS
from mini import SCRIPTS, no_assets, run_compare

# ---- scenes and methods ----------------------------------------------------------------------------------------------


def test_only_scenes_with_a_slot_are_found(mini_folder):
    assert [scene.name for scene in scenes.find_scenes(mini_folder, ["all"], no_assets)] == ["mini"]
    with pytest.raises(ValueError, match="no scene plain .* there are: mini"):
        scenes.find_scenes(mini_folder, ["plain"], no_assets)


def test_the_scenes_of_the_project_have_slots():
    folder = SCRIPTS.parent / "mitsuba_scenes"
    names = ("isotropic", "brushed", "flakes", "scratches")
    here = {"assets": folder, "maps": {name: folder / f"{name[0]}.exr" for name in names}}
    found = {scene.name: scene for scene in scenes.find_scenes(folder, ["all"], lambda: here)}
    assert list(found) == ["shoes", "kettle", "bent_quad", "car_bonnet", "car_wheel", "kettle_mirror", "wing_mirror"]
    assert [scene.normal_map.name for scene in found.values()] == [f"{name}.exr" for name in "ibifsbf"]
    assert all(scene.crops and scene.alpha > 0 for scene in found.values())


def test_a_plugin_takes_over_the_slot(mini):
    root = xml.fromstring(mini.text(METHODS["glints_ibm"], 8))
    (metal,) = root.findall("bsdf")
    assert (metal.get("type"), metal.get("id")) == ("glints_ibm", "metal")
    properties = {item.get("name"): item.get("value") for item in metal}
    assert float(properties["alpha"]) == 0.1
    assert properties["filename"] == str(mini.normal_map.resolve())
    assert properties["encoding"] == "unsigned"
    assert properties["specular_reflectance"] == "0.9, 0.8, 0.7"
    assert not {"material", "distribution"} & set(properties)
    assert metal.find("transform[@name='to_uv']/scale").get("x") == "16"


def test_stock_methods_fill_the_slot(mini):
    kept = xml.fromstring(mini.text(METHODS["normalmap"], 1)).find("bsdf")
    plain = xml.fromstring(mini.text(METHODS["roughconductor"], 1)).find("bsdf")
    assert (kept.get("type"), kept.find("bsdf").get("type")) == ("normalmap", "roughconductor")
    assert (plain.get("type"), plain.get("id")) == ("roughconductor", "metal")
    # 256 slopes of standard deviation 0.2 along each axis
    for name in ("alpha_u", "alpha_v"):
        widened = float(plain.find(f"float[@name='{name}']").get("value"))
        assert widened == pytest.approx(math.sqrt(0.1**2 + 2 * 0.2**2), rel=0.1)
    assert plain.find("float[@name='alpha']") is None


def test_slopes_of_a_map(tmp_path):
    slopes = np.zeros((2, 2, 2))
    slopes[..., 0] = [[0.5, -0.5], [0.5, -0.5]]
    slopes[..., 1] = 3
    normals = support.unit(np.concatenate([-slopes, np.ones((2, 2, 1))], axis=-1))
    support.write_exr(tmp_path / "map.exr", (normals + 1) / 2)
    assert maps.slope_variances(tmp_path / "map.exr") == pytest.approx((0.25, 0), abs=1e-5)
    assert maps.texels(tmp_path / "map.exr") == 4
    support.write_exr(tmp_path / "flat.exr", np.full((2, 2, 3), 0.5, dtype=np.float32))
    with pytest.raises(ValueError, match="z = 0"):
        maps.slope_variances(tmp_path / "flat.exr")


def test_a_method_overrides_what_the_slot_says(mini):
    rough = METHODS["glints_ibm"].fill(mini.first_slot(), {"alpha": 0.5, "masking": "none", "bins": 9})
    values = {item.get("name"): (item.tag, item.get("value")) for item in rough if item.get("name") != "to_uv"}
    assert values["alpha"] == ("float", "0.5")
    assert (values["masking"], values["bins"]) == (("string", "none"), ("integer", "9"))


def test_unsuitable_slots_and_unknown_methods_are_refused(mini):
    slot = mini.first_slot()
    xml.SubElement(slot.conductor, "float", name="alpha_u", value="0.1")
    with pytest.raises(ValueError, match="alpha_u"):
        METHODS["glints_ibm"].element(slot)
    with pytest.raises(ValueError, match=r"unknown method yan; there are glints_ibm, "):
        choose(["glints_ibm", "yan"])


def test_a_scene_digest_depends_on_content_and_not_on_place(mini, tmp_path):
    moved = tmp_path / "elsewhere"
    (moved / "maps").mkdir(parents=True)
    (moved / "mini.xml").write_bytes(mini.path.read_bytes())
    (moved / "maps" / "flakes.exr").write_bytes(mini.normal_map.read_bytes())
    (other,) = scenes.find_scenes(moved, ["mini"], no_assets)
    digest = scenes.scene_digest(mini.text(METHODS["normalmap"], 1))
    assert digest == scenes.scene_digest(other.text(METHODS["normalmap"], 1))
    assert digest != scenes.scene_digest(mini.text(METHODS["normalmap"], 2))
    support.write_exr(other.normal_map, (support.random_normals(16, 16, 0.2, seed=1) + 1) / 2)
    assert digest != scenes.scene_digest(other.text(METHODS["normalmap"], 1))


def test_crops_scale_with_the_frame():
    assert scenes.scale_crop((160, 600, 80, 80), 800) == (160, 600, 80, 80)
    assert scenes.scale_crop((160, 600, 80, 80), 400) == (80, 300, 40, 40)
    assert scenes.scale_crop((790, 790, 80, 80), 8) == (7, 7, 1, 1)


def test_a_crop_is_a_part_of_its_frame(mini):
    loaded = render.LoadedScene(mini.text(METHODS["normalmap"], 1))
    lighting = render.Lighting("direct")
    whole = loaded.render(scenes.View("frame", 32, 32, (0, 0, 32, 32)), lighting, 256, 1).image
    part = loaded.render(scenes.View("crop1", 32, 32, (8, 12, 16, 8)), lighting, 256, 2).image
    assert part.shape == (8, 16, 3)
    assert np.mean(part) == pytest.approx(np.mean(whole[12:20, 8:24]), rel=0.05)


# ---- files -----------------------------------------------------------------------------------------------------------


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "results.json"
    files.write_json(path, [1])
    with pytest.raises(KeyboardInterrupt), files.replacing(path) as temporary:
        temporary.write_text("[1, 2", encoding="utf-8")
        raise KeyboardInterrupt
    assert json.loads(path.read_text(encoding="utf-8")) == [1]
    assert os.listdir(tmp_path) == ["results.json"]


def test_json_spells_out_what_json_lacks(tmp_path):
    path = tmp_path / "results.json"
    files.write_json(path, [{"rmse": math.inf, "relmse": math.nan, "mean_error": -math.inf, "image": Path("a/b")}])
    assert json.loads(path.read_text(encoding="utf-8")) == [
        {"rmse": "Infinity", "relmse": "NaN", "mean_error": "-Infinity", "image": "a/b"}
    ]


# ---- end to end ------------------------------------------------------------------------------------------------------

OPTIONS = (
    "--tiling",
    "2",
    "--spp",
    "1,4",
    "--seeds",
    "2",
    "--reference-spp",
    "100",
    "--sweep",
    "2,4",
    "--frames",
    "3",
)


@pytest.fixture(scope="session")
def comparison(mini_folder, tmp_path_factory):
    """A tiny comparison of all methods: its folder, its cache, its results."""
    out, cache = tmp_path_factory.mktemp("out"), tmp_path_factory.mktemp("cache")
    done = run_compare(mini_folder, out, cache, *OPTIONS)
    assert done.returncode == 0, done.stderr
    assert str(out / "index.html") in done.stdout.replace("\n", "")
    # Ratios of the paper stand beside the scenes of its tables alone.
    assert "glints_yan16_flat" in done.stdout and "takes" not in done.stdout
    return out, cache, json.loads((out / "results.json").read_text(encoding="utf-8"))


PRECOMPUTED = [name for name, method in METHODS.items() if method.if_kept]
"""Methods that are compared where their precomputation is kept, unless they are named: not in this scene."""


def curves():
    """Every method with its footprint rules, but for those that are rendered at few points or that are precomputed."""
    return [
        (name, rule)
        for name, method in METHODS.items()
        if not method.sparse and name not in PRECOMPUTED
        for rule in (("sample", "pixel") if name == "glints_ibm" else ("sample",) if method.filters else ("none",))
    ]


def test_results_list_every_run(comparison):
    out, _, results = comparison
    records = results["records"]
    found = {
        (record["method"], record["footprint"], record["view"], record["spp"], record["seed"])
        for record in records
        if record["tiling"] == 2 and record["frame"] is None
    }
    crops = {
        (*curve, v, spp, seed) for curve in curves() for v in ("crop1", "crop2") for spp in (1, 4) for seed in (1, 2)
    }
    few = {("glints_ibm_paper", "sample", view, 1, seed) for view in ("crop1", "crop2") for seed in (1, 2)}
    assert found == crops | few | {(*curve, "frame", 4, 1) for curve in curves()}
    texels = [curve for curve in curves() if METHODS[curve[0]].surface == "texels"]
    sequence = [
        (record["method"], record["footprint"], record["frame"]) for record in records if record["frame"] is not None
    ]
    assert sequence == [(*curve, frame) for curve in texels for frame in range(3)]
    sweep = {(item["method"], item["footprint"], item["tiling"]) for item in results["sweep"]}
    assert sweep == {(*curve, tiling) for curve in curves() for tiling in (2, 4)}
    unmeasured = {item["method"] for item in results["sweep"] if not item["errors"]}
    assert unmeasured == {name for name, method in METHODS.items() if method.surface != "texels"}
    assert results["unprepared"] == {"mini": PRECOMPUTED} and results["prefiltering"] == []
    table_4 = {(item["scene"], item["method"]) for item in results["table_4"]}
    assert table_4 == {("mini", "glints_ibm"), ("mini", "glints_ibm_paper")}
    for record in records:
        assert record["seconds"] > 0 and record["cpu_seconds"] > 0 and record["nonfinite"] == 0
        assert (out / record["image"]).is_file()
        assert results["provenances"][record["provenance"]]["plugins"] == results["provenance"]["plugins"]
        method = METHODS[record["method"]]
        assert record["alpha"] == (0.05 if record["method"] == "glints_ibm_rough" else 0.1)
        assert record["parameters"] == method.parameters
        if (
            record["view"] != "frame"
            and record["frame"] is None
            and (record["tiling"] == 2 or method.surface == "texels")
        ):
            assert all(math.isfinite(record[name]) for name in METRICS)
    sizes = {record["method"]: record["structure_bytes"] for record in records}
    assert 0 < sizes["glints_ibm"] != sizes["glints_ibm_paper"] > 0 and sizes["normalmap"] is None
    with open(out / "results.csv", encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["image"] for row in table] == [record["image"] for record in records]
    assert float(table[0]["rmse"]) == records[0]["rmse"]
    assert all(json.loads(row["parameters"]) == METHODS[row["method"]].parameters for row in table)


def test_an_image_on_disk_gives_the_listed_errors(comparison):
    out, cache, results = comparison
    for method, surface in (
        ("glints_direct", "texels"),
        ("glints_ibm_rough", "rough"),
        ("glints_yan16_curved", "interpolated"),
    ):
        mine = [item for item in results["summaries"] if item["method"] == method and item["view"] == "crop1"]
        summary = next(item for item in mine if item["spp"] == 4)
        assert summary["surface"] == surface
        (path,) = (cache / "references").glob(f"mini-x2-crop1-{surface}-*.npz")
        truth = np.load(path)["mean"]
        records = [
            record
            for record in results["records"]
            if (record["method"], record["tiling"], record["view"], record["spp"], record["frame"])
            == (method, 2, "crop1", 4, None)
        ]
        measured = [metrics.rmse(images.read_exr(out / record["image"]), truth) for record in records]
        assert measured == pytest.approx([record["rmse"] for record in records])
        assert summary["errors"]["rmse"]["total"]["value"] == pytest.approx(np.sqrt(np.mean(np.square(measured))))
        mean = np.mean([images.read_exr(out / record["image"]) for record in records], axis=0)
        np.testing.assert_allclose(images.read_exr(out / summary["mean_image"]), mean, rtol=1e-6)


def test_methods_of_one_model_have_the_mean_of_the_reference(comparison):
    out, cache, results = comparison
    (path,) = (cache / "references").glob("mini-x2-frame-texels-*.npz")
    truth = np.load(path)["mean"].mean()
    frames = [record for record in results["records"] if record["view"] == "frame"]
    means = {record["method"]: images.read_exr(out / record["image"]).mean() / truth for record in frames}
    assert not set(PRECOMPUTED) & set(means)
    alike = [name for name in means if METHODS[name].model == GLINTS and METHODS[name].surface == "texels"]
    # 4 samples in each of 1024 pixels give about 2 %. Flakes seven times as rough are another surface.
    assert all(abs(means[name] - 1) < 0.08 for name in alike), means


def test_the_report_shows_every_method(comparison):
    out, _, _ = comparison
    page = (out / "index.html").read_text(encoding="utf-8")
    assert all(method.label in page for method in METHODS.values())
    assert not [name for name in out.rglob(".unfinished-*")]


def test_the_report_of_a_comparison_opens_without_complaint(comparison):
    """In a browser; its mean errors are shares of the references' means."""
    out, _, results = comparison
    with test_report.launched() as browser, test_report.opened(browser, out / "index.html", 1000, 700) as page:
        headings = page.locator("[data-metric=mean_error] th").all_text_contents()
        column = headings.index("of the mean") % len(set(headings))
        shown = [
            row.locator("td").nth(column).text_content()
            for row in page.locator("[data-metric=mean_error] tbody tr").all()
        ]
    assert len(shown) == len([item for item in results["summaries"] if item["errors"]])
    assert all(re.fullmatch(r"[+−]\d+\.\d %", share) for share in shown), shown
    first = next(item for item in results["summaries"] if (item["view"], item["spp"]) == ("crop1", 1))
    mean = images.read_exr(out / "runs" / "mini-x2" / "crop1" / "reference-texels.exr").mean()
    assert shown[0] == text.percent(first["errors"]["mean_error"]["total"]["value"] / mean)


def test_a_precomputed_method_is_compared_once_it_has_been_named(mini_folder, tmp_path):
    """By default it waits for its precomputation, and says so; named, it makes it; from then on it takes part."""
    few = ("--tiling", "2", "--spp", "1", "--seeds", "2", "--reference-spp", "20", "--sweep", "none", "--frames", "0")
    everything = ("--no-report", *few)
    before = run_compare(mini_folder, tmp_path / "before", tmp_path, *everything)
    assert before.returncode == 0, before.stderr
    said = " ".join(before.stdout.split())
    assert f"Left out of mini: {', '.join(PRECOMPUTED)}, not precomputed yet" in said
    assert "./scripts/compare --scene mini --methods glints_tensor" in said
    methods = lambda out: {record["method"] for record in json.loads((out / "results.json").read_text())["records"]}
    assert not methods(tmp_path / "before") & set(PRECOMPUTED)
    named = run_compare(mini_folder, tmp_path / "named", tmp_path, *everything, "--methods", "glints_tensor")
    assert named.returncode == 0, named.stderr
    assert methods(tmp_path / "named") == {"glints_tensor"}
    after = run_compare(mini_folder, tmp_path / "after", tmp_path, *everything)
    assert after.returncode == 0 and "not precomputed" not in after.stdout, after.stdout
    assert methods(tmp_path / "after") == set(METHODS)


def test_a_second_comparison_reuses_what_is_kept(comparison, mini_folder, tmp_path):
    _, cache, _ = comparison
    kept = {path: path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()}
    options = (
        "--time",
        "0.02",
        "--seeds",
        "1",
        "--methods",
        "normalmap",
        "--sweep",
        "none",
        "--frames",
        "0",
        "--no-report",
    )
    done = run_compare(mini_folder, tmp_path, cache, *OPTIONS[:2], *OPTIONS[6:8], "--spp", "4", *options)
    assert done.returncode == 0, done.stderr
    now = {path: path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()}
    assert {path: now[path] for path in kept} == kept
    # an image and its description for each of two crops in equal time; all else is there
    assert len(now) - len(kept) == 4
    records = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))["records"]
    assert sorted(record["time_budget"] or 0 for record in records) == [0, 0, 0, 0.02, 0.02]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--methods", "yan"), "unknown method yan; there are"),
        (("--footprint", "pixel", "--integrator", "path"), "needs the integrator glints_path"),
        (("--dask", "tcp://127.0.0.1:9", "--limit", "9"), "leave it out with --dask"),
    ],
)
def test_options_that_contradict_each_other_are_named(mini_folder, options, message):
    with pytest.raises(ValueError, match=message):
        cli.settings(cli.parser().parse_args(["--scene-dir", str(mini_folder), *options]))


@pytest.mark.parametrize(("text", "rules"), [("sample", ("sample",)), ("pixel,0.50,2", ("pixel", "0.5", "2"))])
def test_footprint_rules(text, rules):
    assert cli.rules(text) == rules
    with pytest.raises(argparse.ArgumentTypeError, match="not a footprint rule"):
        cli.rules(text + ",wide")


def test_mistakes_end_in_one_line(mini_folder, tmp_path):
    done = run_compare(mini_folder, tmp_path, tmp_path, "--scene", "teapot")
    assert done.returncode != 0
    assert "no scene teapot" in done.stderr and "Traceback" not in done.stderr


def test_a_method_without_its_plugin_is_refused(monkeypatch):
    lacking = replace(METHODS["glints_ibm"], plugins=("glints_nowhere",))
    with pytest.raises(ValueError, match="plugin glints_nowhere is not installed; .* leave out glints_ibm"):
        check_plugins([METHODS["glints_direct"], lacking])


def test_slow_points_are_left_out_and_said_so(mini, tmp_path):
    said = []

    class Quiet(Silent):
        def say(self, text):
            said.append(text)

    settings = plan.Settings(
        scenes=(mini,),
        methods=(METHODS["roughconductor"],),
        tilings=(1,),
        spps=(1, 10**9),
        seeds=2,
        size=32,
        frame_size=16,
        lighting=render.Lighting("direct"),
        reference_spp=1,
        limit=60.0,
        out=tmp_path,
        cache=tmp_path,
    )
    results = compare.Comparison(settings, executors.Local(), Quiet(), {}).run()
    assert {(item["view"], item["spp"]) for item in results.left_out} == {("crop1", 10**9), ("crop2", 10**9)}
    assert {record["spp"] for record in results.records if record["view"] != "frame"} == {1}
    assert "mini x1: roughconductor" in said


# ---- precomputed methods and prefiltered light -----------------------------------------------------------------------


def tensor(mini_folder, **changed):
    return replace(METHODS["glints_tensor"], store=mini_folder / "store", **changed)


def test_a_precomputation_is_found_by_what_decides_it(mini, tmp_path):
    method, slot = tensor(tmp_path), mini.first_slot()
    folder = method.precomputation(slot)
    element = method.element(slot)
    assert element.find("string[@name='cache']").get("value") == str(folder)
    assert not method.is_kept(slot)
    folder.mkdir(parents=True)
    (folder / ".unfinished-tensor.glints").touch()
    assert not method.is_kept(slot)
    (folder / "tensor.glints").touch()
    assert method.is_kept(slot)
    assert tensor(tmp_path, environment_prefilter=True).is_kept(slot)
    assert not tensor(tmp_path, parameters={"rank": 32}).is_kept(slot)
    slot.conductor.find("float[@name='alpha']").set("value", "0.2")
    assert not method.is_kept(slot)


def test_where_a_precomputation_lies_does_not_decide_a_scene(mini, tmp_path):
    texts = [mini.text(tensor(tmp_path / name), 1) for name in "ab"]
    assert texts[0] != texts[1]
    assert scenes.scene_digest(texts[0]) == scenes.scene_digest(texts[1])
    assert scenes.scene_digest(texts[0]) != scenes.scene_digest(mini.text(tensor(tmp_path, parameters={"rank": 3}), 1))


def test_prefiltered_light_is_the_path_tracers(mini_folder, tmp_path):
    options = cli.parser().parse_args(["--scene-dir", str(mini_folder), "--cache", str(tmp_path)])
    names = [method.name for method in cli.chosen_methods(options)]
    assert names == list(METHODS)
    options.integrator = "direct"
    assert "glints_tensor_prefiltered" not in [method.name for method in cli.chosen_methods(options)]
    options.methods = "glints_tensor_prefiltered"
    with pytest.raises(ValueError, match="glints_tensor_prefiltered needs the integrator glints_path"):
        cli.chosen_methods(options)
    options.integrator = "glints_path"
    (method,) = cli.chosen_methods(options)
    assert method.store == tmp_path / "precomputed" and not method.if_kept


# ---- benchmarks ------------------------------------------------------------------------------------------------------


def test_benchmark_records_and_targets():
    def goal(name, value, baseline, baseline_value, **params):
        return bench.target(bench.make_record(name, value, "", baseline, baseline_value, params))

    memory = bench.make_record("ibm/memory", 37e6, "bytes", "2021 paper, Tables 2 and 4", 36e6, {"map": "isotropic"})
    assert list(memory) == ["name", "value", "unit", "baseline", "baseline_value", "ratio", "params"]
    assert bench.target(memory) == ("≤ the paper's", False)
    assert goal("ibm/memory", 17e6, "ibm_paper", 36e6, side=2048) == ("≤ 18 MB", True)
    assert goal("ibm/memory", 70e6, "ibm_paper", 140e6, side=4096) is None
    assert goal("ibm/build", 0.2, "ibm_paper", 0.1, side=2048) == ("≤ 0.15 s", False)
    assert goal("ibm/eval/worst", 3100.0, "ibm_paper", 1e6, side=2048, footprint=256.0) == ("≤ 3 µs", False)
    assert goal("ibm_paper/eval/worst", 3100.0, "ibm", 1e6, side=2048) is None
    frame = {"method": "glints_ibm", "resolution": 800}
    assert goal("frame", 2.5, "normalmap x1", 2.0, **frame) == ("≤ 1.3×", True)
    assert goal("frame", 3.0, "normalmap x32", 2.0, **frame) == ("≤ 1.3×", False)
    assert goal("frame", 3.0, "roughconductor", 2.0, **frame) is None


@pytest.mark.skipif(shutil.which("cargo") is None, reason="needs cargo")
def test_the_rust_benchmark_counts_memory_and_measures_both_structures(mini_folder):
    """Arrays and their capacity, as the allocator sees them, are what a structure says that it takes."""
    options = ["--alpha", "0.05", "--footprint", "1,64x1", "--seconds", "0.001", "--methods", "ibm", "--sides", "128"]
    records = bench.run_rust(mini_folder / "maps" / "flakes.exr", "mini", options)
    for structure in ("ibm", "ibm_paper"):
        mine = {r["name"].removeprefix(f"{structure}/"): r for r in records if r["params"]["side"] == 128}
        assert mine["memory_counted"]["value"] == pytest.approx(mine["memory"]["value"], rel=0.05)
        assert mine["build_peak"]["value"] >= mine["memory_counted"]["value"]
    cells = {
        (r["name"], r["params"]["footprint"], r["params"]["thickness"]) for r in records if r["name"] == "ibm/eval"
    }
    assert cells == {("ibm/eval", 1.0, 1.0), ("ibm/eval", 64.0, 1.0)}
    (worst,) = (r for r in records if r["name"] == "ibm/eval/worst")
    evals = [r["value"] for r in records if r["name"] == "ibm/eval"]
    assert worst["value"] == max(evals) and worst["params"]["alpha"] == 0.05


def test_images_of_a_precomputation_are_counted_by_level():
    assert ranks.image_count(512**2, 1) == 16**2
    assert ranks.image_count(512**2, 5) == 16**2 + 8**2 + 4**2 + 2**2 + 1
    assert ranks.image_count(100**2, 2) == 4**2 + 2**2


@pytest.mark.skipif(shutil.which("cargo") is None, reason="needs cargo")
def test_ranks_trade_storage_for_error(tmp_path, monkeypatch):
    small_numbers = {"PICTURE_SIDE": 64, "PICTURE_SPP": 1, "TIMED_SPP": 1, "DEFAULT_RANK": 8, "FURTHER_TILINGS": (20,)}
    for name, small in small_numbers.items():
        monkeypatch.setattr(ranks, name, small)
    render.prepare_thread()
    (scene,) = scenes.find_scenes(ROOT / "mitsuba_scenes", [ranks.SCENE], scene_assets(ROOT / ".cache"))
    path = tmp_path / "map.exr"
    support.write_exr(path, (support.random_normals(96, 96, 0.3) + 1) / 2)
    said = []
    tool = ROOT / "scripts" / "glints"
    records = ranks.measure(scene, {"rough": path}, (1, 8), tool, tmp_path / "out", 1, said.append)
    values = {(record["name"], record["params"]["rank"]): record["value"] for record in records}
    names = ("precompute", "storage", "ndf_error", "frame_error", "frame_eval_ratio", "frame_sample_ratio")
    assert set(values) == {(f"tensor/{name}", rank) for name in names for rank in (1, 8)}
    timed = [record["params"] for record in records if record["name"] == "tensor/frame_eval_ratio"]
    assert [(params["rank"], params["tiling"]) for params in timed] == [(1, ranks.TILING), (8, ranks.TILING), (8, 20)]
    assert all(math.isfinite(value) for value in values.values())
    assert all(value > 0 for (name, _), value in values.items() if name != "tensor/frame_error")
    assert values["tensor/ndf_error", 8] < values["tensor/ndf_error", 1] < 1
    assert values["tensor/storage", 8] > values["tensor/storage", 1]
    kept = ranks.read(tmp_path / "out")
    assert kept.records == records and said
    low, high, truth = (read_exr(kept.folder / item["file"]) for item in kept.pictures)
    assert [item["rank"] for item in kept.pictures] == [1, 8, ranks.UNCOMPRESSED]
    assert values["tensor/frame_error", 8] < values["tensor/frame_error", 1]
    errors = [float(np.mean((image.astype(np.float64) - truth) ** 2)) for image in (low, high)]
    assert errors[1] < errors[0], "the picture of the higher rank is nearer to the uncompressed one"


def test_squared_errors_are_free_of_noise():
    random = np.random.default_rng(4)
    truth = random.random((64, 64, 3))
    pair = lambda offset: [truth + offset + random.normal(size=truth.shape) for _ in range(2)]
    assert ranks.squared_error(pair(0.5), pair(0.0)) == pytest.approx(0.25, abs=0.08)
    assert ranks.squared_error(pair(0.0), pair(0.0)) == pytest.approx(0.0, abs=0.08)
    assert np.mean((pair(0.0)[0] - pair(0.0)[1]) ** 2) > 1.5
