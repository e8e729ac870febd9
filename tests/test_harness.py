"""The comparison harness: its metrics, its scenes, its references, its files, and a tiny comparison from end to end."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np
import pytest
import support
from glints_harness import bench, compare, files, images, metrics, reference, render, scenes
from glints_harness.methods import GLINTS, METHODS, choose

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"

MINI_SCENE = """<scene version="3.0.0">
    <default name="tiles" value="2"/>
    <default name="folder" value="maps"/>
    <default name="normalmap" value="$folder/flakes.exr"/>
    <default name="alpha" value="0.1"/>
    <bsdf type="normalmap" id="metal">
        <texture name="normalmap" type="bitmap">
            <string name="filename" value="$normalmap"/>
            <boolean name="raw" value="true"/>
            <string name="filter_type" value="nearest"/>
            <transform name="to_uv"><scale x="$tiles" y="$tiles" z="1"/></transform>
        </texture>
        <bsdf type="roughconductor">
            <string name="distribution" value="beckmann"/>
            <string name="material" value="none"/>
            <float name="alpha" value="$alpha"/>
            <rgb name="specular_reflectance" value="0.9, 0.8, 0.7"/>
        </bsdf>
    </bsdf>
    <shape type="rectangle"><ref id="metal"/></shape>
    <emitter type="constant"><float name="radiance" value="0.2"/></emitter>
    <emitter type="point">
        <point name="position" x="1" y="1" z="3"/>
        <float name="intensity" value="10"/>
    </emitter>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, -2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="64"/>
            <integer name="height" value="64"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>
    </sensor>
</scene>
"""


def no_assets():
    raise AssertionError("nothing is to be generated here")


@pytest.fixture(scope="session")
def mini_folder(tmp_path_factory):
    """A folder with a scene that has a glint slot, its map, and a scene without slot."""
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "maps").mkdir()
    normals = support.random_normals(16, 16, 0.2)
    support.write_exr(folder / "maps" / "flakes.exr", (normals + 1) / 2)
    (folder / "mini.xml").write_text(MINI_SCENE, encoding="utf-8")
    (folder / "plain.xml").write_text('<scene version="3.0.0"/>', encoding="utf-8")
    return folder


@pytest.fixture
def mini(mini_folder):
    """The scene with a slot."""
    (scene,) = scenes.find_scenes(mini_folder, ["all"], no_assets)
    return scene


def a_reference(mean, standard_error):
    """A reference of two batches with a given mean and standard error, both arrays."""
    return reference.Reference(1, mean, 2 * standard_error**2, batches=2)


# ---- metrics ---------------------------------------------------------------------------------------------------------


def test_metrics_by_hand():
    truth = np.zeros((1, 2, 3))
    truth[0, 1] = 2
    image = truth + [[[1, 1, 1], [-2, -2, -2]]]
    assert metrics.rmse(image, truth) == pytest.approx(math.sqrt((1 + 4) / 2))
    assert metrics.relmse(image, truth) == pytest.approx((1 / 0.01 + 4 / 4.01) / 2)
    assert metrics.mean_error(image, truth) == pytest.approx(-0.5)
    assert metrics.root_mean_square([1, 7]) == pytest.approx(5)
    assert metrics.standard_error([1, 3]) == pytest.approx(1)
    assert metrics.standard_error([1]) is None


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_bad_pixels_are_counted_and_not_replaced(bad):
    truth = np.ones((2, 2, 3))
    image = truth.copy()
    image[0, 0, 1] = bad
    found = metrics.errors(image, a_reference(truth, np.full_like(truth, 0.1)))
    assert found["nonfinite"] == 1
    assert not math.isfinite(found["rmse"]) and not math.isfinite(found["relmse"])
    assert not math.isfinite(found["mean_error"])
    assert not found["at_reference_noise"]
    assert tuple(images.tone_map(image)[0, 0]) == images.INVALID_COLOUR


def test_noise_of_the_reference():
    truth = np.ones((4, 4, 3))
    kept = a_reference(truth, np.full_like(truth, 0.1))
    noise = metrics.reference_noise(kept)
    assert noise["reference_rmse"] == pytest.approx(0.1)
    assert noise["reference_relmse"] == pytest.approx(0.01 / 1.01)
    assert noise["reference_mean_error"] == pytest.approx(0.1 / 4)
    assert metrics.errors(truth + 0.13, kept)["at_reference_noise"]
    assert not metrics.errors(truth + 0.15, kept)["at_reference_noise"]


def test_batches_give_mean_and_standard_error():
    view = scenes.View("crop1", 2, 2, (0, 0, 2, 2))
    batches = np.random.default_rng(1).random((5, 2, 2, 3)).astype(np.float32)
    kept = reference.Reference.empty(view)
    for batch in batches:
        kept.add(render.Rendering(batch, 1.0, 1.0))
    np.testing.assert_allclose(kept.mean, batches.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(kept.standard_error, batches.std(axis=0, ddof=1) / math.sqrt(5), rtol=1e-5)


# ---- scenes and methods ----------------------------------------------------------------------------------------------


def test_only_scenes_with_a_slot_are_found(mini_folder):
    assert [scene.name for scene in scenes.find_scenes(mini_folder, ["all"], no_assets)] == ["mini"]
    with pytest.raises(ValueError, match="no scene plain .* there are: mini"):
        scenes.find_scenes(mini_folder, ["plain"], no_assets)


def test_the_scenes_of_the_project_have_slots():
    folder = SCRIPTS.parent / "mitsuba_scenes"
    here = {"assets": folder, "maps": {"isotropic": folder / "i.exr", "brushed": folder / "b.exr"}}
    found = {scene.name: scene for scene in scenes.find_scenes(folder, ["all"], lambda: here)}
    assert list(found) == ["shoes", "kettle"]
    assert found["kettle"].normal_map.name == "b.exr"
    assert all(len(scene.crops) == 2 and scene.alpha > 0 for scene in found.values())


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


# ---- references ------------------------------------------------------------------------------------------------------


def obtain(folder, scene, **wanted):
    """The reference of a small crop with a store in `folder`, and how many batches were rendered for it."""
    view = scenes.View("crop1", 64, 64, (24, 24, 16, 16))
    rendered = []
    store = reference.ReferenceStore(folder, METHODS["glints_unfiltered"])
    found = store.obtain(scene, 1, view, render.Lighting("direct"), 0.01, tick=lambda: rendered.append(1), **wanted)
    return found, len(rendered)


def test_a_reference_is_kept_refined_and_bound_to_its_scene(mini, tmp_path, monkeypatch):
    monkeypatch.setattr(reference, "BATCH_SAMPLES", 1000)
    first, rendered = obtain(tmp_path, mini)
    assert rendered == first.batches >= reference.FEWEST_BATCHES
    again, rendered = obtain(tmp_path, mini)
    assert rendered == 0
    np.testing.assert_array_equal(again.mean, first.mean)
    np.testing.assert_array_equal(again.standard_error, first.standard_error)
    finer, rendered = obtain(tmp_path, mini, spp=first.spp + 1)
    assert (rendered, finer.batches) == (1, first.batches + 1)
    support.write_exr(mini.normal_map, (support.random_normals(16, 16, 0.2, seed=2) + 1) / 2)
    try:
        assert obtain(tmp_path, mini)[1] >= reference.FEWEST_BATCHES
    finally:
        support.write_exr(mini.normal_map, (support.random_normals(16, 16, 0.2) + 1) / 2)


def test_an_interrupted_reference_goes_on_where_it_stopped(mini, tmp_path, monkeypatch):
    monkeypatch.setattr(reference, "BATCH_SAMPLES", 1000)
    whole, _ = obtain(tmp_path / "whole", mini, spp=30)
    calls = []

    def interrupt(*arguments):
        calls.append(arguments)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return plain(*arguments)

    plain = render.LoadedScene.render
    monkeypatch.setattr(render.LoadedScene, "render", interrupt)
    with pytest.raises(KeyboardInterrupt):
        obtain(tmp_path / "parts", mini, spp=30)
    monkeypatch.setattr(render.LoadedScene, "render", plain)
    resumed, rendered = obtain(tmp_path / "parts", mini, spp=30)
    assert rendered == whole.batches - 3
    np.testing.assert_allclose(resumed.mean, whole.mean, rtol=1e-12)


# ---- end to end ------------------------------------------------------------------------------------------------------


def run_compare(folder, out, cache, *options):
    """Run `scripts/compare` without its set-up, in a process of its own; returns what it printed."""
    command = [sys.executable, "-m", "glints_harness.cli", "--scene-dir", str(folder), "--res", "32"]
    command += ["--out", str(out), "--cache", str(cache), *options]
    environment = {**os.environ, "PYTHONPATH": str(SCRIPTS)}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="session")
def comparison(mini_folder, tmp_path_factory):
    """A tiny comparison of all methods: its folder, its cache, its records."""
    out, cache = tmp_path_factory.mktemp("out"), tmp_path_factory.mktemp("cache")
    options = ("--tiling", "2", "--spp", "1,4", "--seeds", "2", "--reference-spp", "100")
    done = run_compare(mini_folder, out, cache, *options)
    assert done.returncode == 0, done.stderr
    assert str(out / "index.html") in done.stdout.replace("\n", "")
    return out, cache, json.loads((out / "results.json").read_text(encoding="utf-8"))


def test_results_list_every_run(comparison):
    out, _, records = comparison
    crops = [record for record in records if record["view"] != "frame"]
    frames = [record for record in records if record["view"] == "frame"]
    runs = {(record["method"], record["view"], record["spp"], record["seed"]) for record in crops}
    assert runs == {
        (m, v, spp, seed) for m in METHODS for v in ("crop1", "crop2") for spp in (1, 4) for seed in (1, 2)
    }
    assert sorted(record["method"] for record in frames) == sorted(METHODS)
    for record in records:
        assert (record["scene"], record["tiling"], record["footprint"]) == ("mini", 2, "sample")
        assert all(record[key] > 0 for key in ("seconds", "cpu_seconds", "rmse", "relmse", "reference_rmse"))
        assert math.isfinite(record["mean_error"]) and record["nonfinite"] == 0
        assert (out / record["image"]).is_file()
    sizes = {record["method"]: record["structure_bytes"] for record in records}
    assert sizes["glints_ibm"] > 0 and sizes["normalmap"] is None


def test_an_image_on_disk_gives_the_listed_error(comparison):
    out, cache, records = comparison
    record = next(item for item in records if item["view"] == "crop1" and item["method"] == "glints_direct")
    (path,) = (cache / "references").glob("mini-x2-crop1-*.npz")
    kept = np.load(path)
    assert json.loads(str(kept["provenance"]))["method"] == "glints_unfiltered"
    assert metrics.rmse(images.read_exr(out / record["image"]), kept["mean"]) == pytest.approx(record["rmse"])


def test_methods_of_one_model_have_the_mean_of_the_reference(comparison):
    _, _, records = comparison
    relative = {
        record["method"]: abs(record["mean_error"]) / record["mean_reference"]
        for record in records
        if record["view"] == "frame"
    }
    # 16 samples in each of 1024 pixels give about 1 %; without the map it is 41 %.
    assert all(relative[name] < 0.05 for name, method in METHODS.items() if method.model == GLINTS), relative
    assert relative["roughconductor"] > 0.2


def test_the_report_shows_every_method_and_needs_no_other_file(comparison):
    out, _, _ = comparison
    page = (out / "index.html").read_text(encoding="utf-8")
    assert all(name in page for name in METHODS)
    assert "data:image/png;base64," in page and "data:image/svg+xml;base64," in page
    assert 'src="http' not in page and 'src="runs' not in page
    assert not [name for name in out.rglob(".unfinished-*")]


def test_a_second_comparison_reuses_the_references(comparison, mini_folder, tmp_path):
    _, cache, _ = comparison
    kept = {path: path.stat().st_mtime_ns for path in (cache / "references").iterdir()}
    options = ("--tiling", "2", "--time", "0.05", "--seeds", "1", "--reference-spp", "100", "--methods", "normalmap")
    done = run_compare(mini_folder, tmp_path, cache, *options)
    assert done.returncode == 0, done.stderr
    assert kept == {path: path.stat().st_mtime_ns for path in (cache / "references").iterdir()}
    timed = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert {record["time_budget"] for record in timed if record["view"] != "frame"} == {0.05}


def test_mistakes_on_the_command_line_are_named(mini_folder, tmp_path):
    done = run_compare(mini_folder, tmp_path, tmp_path, "--scene", "teapot")
    assert done.returncode != 0
    assert "no scene teapot" in done.stderr and "Traceback" not in done.stderr


def test_slow_runs_are_left_out_and_said_so(mini, tmp_path):
    said = []

    class Quiet:
        expect = advance = staticmethod(lambda seconds: None)
        say = staticmethod(said.append)

    settings = compare.Settings(
        scenes=(mini,),
        methods=(METHODS["roughconductor"],),
        tilings=(1,),
        spps=(1, 10**9),
        seeds=2,
        size=32,
        frame_size=16,
        lighting=render.Lighting("direct"),
        reference_spp=1,
        reference_method=METHODS["normalmap"],
        limit=20.0,
        out=tmp_path,
        cache=tmp_path,
    )
    comparison = compare.Comparison(settings, Quiet)
    comparison.run()
    assert {(item["view"], item["spp"]) for item in comparison.left_out} == {("crop1", 10**9), ("crop2", 10**9)}
    assert {record["spp"] for record in comparison.records if record["view"] != "frame"} == {1}
    assert "mini x1: roughconductor" in said


# ---- benchmarks ------------------------------------------------------------------------------------------------------


def test_benchmark_records_and_targets():
    memory = bench.make_record("ibm/memory", 37e6, "bytes", "2021 paper", 36e6, {"map": "isotropic"})
    assert list(memory) == ["name", "value", "unit", "baseline", "baseline_value", "ratio", "params"]
    assert bench.target(memory) == ("≤ the paper's", False)
    frame = {"method": "glints_ibm", "resolution": 800}
    assert bench.target(bench.make_record("frame", 3.0, "seconds", "normalmap x1", 2.0, frame)) == ("≤ 2×", True)
    assert bench.target(bench.make_record("frame", 3.0, "seconds", "roughconductor", 2.0, frame)) is None
