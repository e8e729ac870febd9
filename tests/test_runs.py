"""Runs: kept whole or not at all, found again by everything that decides them, resumed, timed, turned."""

import json
import math
import os
import signal
import subprocess
import time
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import support
from glints_harness import executors, files, jobs, plan, reference, render, runs, scenes, temporal
from glints_harness.compare import Comparison
from glints_harness.images import read_exr
from glints_harness.methods import METHODS, choose
from glints_harness.progress import Silent
from mini import command, run_compare

MACHINE = {"processor": "a processor", "cores": 2}
CROP = scenes.View("crop1", 64, 64, (24, 24, 16, 16))
RUN = runs.Run("mini", 1.0, "normalmap", CROP, render.Lighting("direct"), 4, 1)


@pytest.fixture(autouse=True)
def short_batches(monkeypatch):
    monkeypatch.setattr(reference, "BATCH_SAMPLES", 1000)


def finished(run=RUN, value=0.5):
    """A made-up result."""
    image = np.full((16, 16, 3), value, dtype=np.float32)
    return runs.Finished(run, image, 4, 0.1, 0.2, 0.3, "today", {}, {"versions": {}})


def settings(scene, folder, names=("normalmap",), **more):
    """A small comparison."""
    chosen = {"spps": (1,), "seeds": 2, "tilings": (1.0,), "size": 64, "frame_size": 16, "reference_spp": 8, **more}
    return plan.Settings(
        (scene,), [METHODS[name] for name in names], out=folder / "out", cache=folder / "cache", **chosen
    )


def rendered(scene, folder, names=("normalmap",), **more):
    """Such a comparison, rendered, and how many results came from rendering."""
    comparison = Comparison(settings(scene, folder, names, **more), executors.Local(), Silent(), {})
    outcomes, receive = [], comparison.receive
    comparison.receive = lambda outcome: (outcomes.append(outcome), receive(outcome))
    comparison.render()
    return comparison, outcomes


# ---- the cache -------------------------------------------------------------------------------------------------------


def test_a_kept_run_is_found_again(tmp_path):
    cache, described = runs.RunCache(tmp_path), runs.description(RUN, "scene", MACHINE)
    assert cache.find(described) is None
    kept = cache.keep(described, finished())
    assert cache.find(described) == json.loads(json.dumps(kept))
    np.testing.assert_array_equal(read_exr(cache.path(described)), finished().image)
    assert runs.RunCache(tmp_path, fresh=True).find(described) is None
    assert not list(tmp_path.rglob(".unfinished-*"))


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e30, 1e-30])
def test_images_are_kept_as_they_are(tmp_path, value):
    cache, described = runs.RunCache(tmp_path), runs.description(RUN, "scene", MACHINE)
    cache.keep(described, finished(value=value))
    np.testing.assert_array_equal(read_exr(cache.path(described)), finished(value=value).image)


def test_everything_that_decides_a_run_is_in_its_key(tmp_path, monkeypatch):
    cache = runs.RunCache(tmp_path)
    keys = [
        cache.path(runs.description(run, digest, machine))
        for run, digest, machine in (
            (RUN, "scene", MACHINE),
            (RUN, "another scene", MACHINE),
            (RUN, "scene", {**MACHINE, "processor": "another"}),
            (RUN, "scene", {**MACHINE, "cores": 3}),
            (replace(RUN, seed=2), "scene", MACHINE),
            (replace(RUN, spp=5), "scene", MACHINE),
            (replace(RUN, spp=None, time_budget=1.0), "scene", MACHINE),
            (replace(RUN, spp=None, time_budget=1.0, budget_includes_build=True), "scene", MACHINE),
            (replace(RUN, tiling=2.0), "scene", MACHINE),
            (replace(RUN, lighting=render.Lighting("direct", footprint="pixel")), "scene", MACHINE),
            (replace(RUN, lighting=render.Lighting("path")), "scene", MACHINE),
            (replace(RUN, view=CROP.middle(8)), "scene", MACHINE),
            (replace(RUN, view=scenes.View("crop1", 64, 64, CROP.crop, 1, 0.5)), "scene", MACHINE),
        )
    ]
    monkeypatch.setattr(runs.provenance, "plugin_digest", lambda: "other plugins")
    keys.append(cache.path(runs.description(RUN, "scene", MACHINE)))
    monkeypatch.setattr(runs.provenance, "version", lambda package: "9.9")
    keys.append(cache.path(runs.description(RUN, "scene", MACHINE)))
    assert len(set(keys)) == len(keys)


def cut_image(image):
    image.write_bytes(image.read_bytes()[:-10])


def lose_image(image):
    image.unlink()


def cut_listing(image):
    listing = image.with_suffix(".json")
    listing.write_text(listing.read_text(encoding="utf-8")[:40], encoding="utf-8")


def swap_listing(image):
    listing = image.with_suffix(".json")
    listing.write_text(listing.read_text(encoding="utf-8").replace('"seed": 1', '"seed": 7'), encoding="utf-8")


@pytest.mark.parametrize("damage", [cut_image, lose_image, cut_listing, swap_listing])
def test_a_damaged_run_is_reported_and_rendered_again(mini, tmp_path, damage):
    first, outcomes = rendered(mini, tmp_path)
    runs_there = [item for item in outcomes if isinstance(item, runs.Finished)]
    assert len(runs_there) == len(first.plan.runs) == 5  # two crops, two seeds, one frame
    damage(first.cache.path(first.describe(first.plan.runs[0])))
    second, outcomes = rendered(mini, tmp_path)
    assert [item.run for item in outcomes] == first.plan.runs[:1]
    assert len(second.warnings) == 1 and "damaged, rendered again" in next(iter(second.warnings))
    digests = [{run: record["image_digest"] for run, record in item.records.items()} for item in (first, second)]
    assert digests[0] == digests[1]


def test_a_damaged_reference_is_reported_and_rendered_again(mini, tmp_path):
    first, _ = rendered(mini, tmp_path)
    for path in (tmp_path / "cache" / "references").glob("*crop1*.npz"):
        cut_image(path)
    second, outcomes = rendered(mini, tmp_path)
    assert [item.key.view.name for item in outcomes] == ["crop1"]
    assert len(second.warnings) == 1
    for key, kept in first.references.items():
        np.testing.assert_array_equal(kept.mean, second.references[key].mean)


def test_fresh_renders_again_but_keeps_references(mini, tmp_path):
    first, _ = rendered(mini, tmp_path)
    _, outcomes = rendered(mini, tmp_path)
    assert outcomes == []
    _, outcomes = rendered(mini, tmp_path, fresh=True)
    assert [item.run for item in outcomes] == first.plan.runs


def test_purposes_share_runs(mini, tmp_path):
    """A tiling and sample count that both the comparison and the sweep want is rendered once."""
    chosen = settings(mini, tmp_path, spps=(plan.SWEEP_SPP,), sweep=(1.0, 2.0), frames=3)
    wanted = plan.RunPlan(chosen)
    assert len(wanted.sweep) == 4 and len(wanted.sequence) == 3
    assert len(wanted.runs) == len(set(wanted.runs)) == len(wanted.main) + 2 + 3
    names = [run.file_name for run in wanted.runs]
    assert len(set(names)) == len(names)


def test_footprint_rules_are_for_methods_that_filter(mini, tmp_path):
    chosen = settings(mini, tmp_path, ("glints_ibm", "glints_direct", "normalmap"))
    assert [chosen.rules(method) for method in chosen.methods] == [("sample", "pixel"), ("sample",), ("none",)]
    chosen = settings(mini, tmp_path, ("glints_ibm", "glints_direct", "normalmap"), footprints=("0.5",))
    assert [chosen.rules(method) for method in chosen.methods] == [("0.5",), ("0.5",), ("none",)]


def test_a_sparse_method_has_few_points_unless_it_is_named(mini, tmp_path):
    chosen = settings(mini, tmp_path, spps=(1, 4), times=(0.1,), times_with_build=(0.2,), sweep=(1.0,), frames=3)
    sparse = METHODS["glints_ibm_paper"]
    runs = plan.RunPlan(replace(chosen, methods=(*chosen.methods, sparse), footprints=("sample", "pixel"))).runs
    mine = [run for run in runs if run.method == sparse.name]
    points = {(run.spp, run.time_budget, run.budget_includes_build, run.lighting.footprint) for run in mine}
    assert points == {(1, None, False, "sample"), (None, 0.1, False, "sample")}
    assert {run.view.name for run in mine} == {"crop1", "crop2"} and all(run.view.frame is None for run in mine)
    runs = plan.RunPlan(replace(chosen, methods=tuple(choose([sparse.name])))).runs
    assert {run.spp for run in runs} >= {1, 4, None} and {run.view.name for run in runs} >= {"frame", "crop1"}
    assert any(run.view.frame is not None for run in runs)


PAIR = ("glints_tensor", "glints_tensor_prefiltered")


def test_a_method_that_waits_for_its_precomputation_is_left_out(mini, tmp_path):
    chosen = settings(mini, tmp_path, ("normalmap", "glints_tensor"))
    assert {run.method for run in plan.RunPlan(chosen).runs} == {"normalmap", "glints_tensor"}
    waiting = replace(chosen, unprepared={"mini": ("glints_tensor",), "other": ("normalmap",)})
    assert {run.method for run in plan.RunPlan(waiting).runs} == {"normalmap"}


def test_environment_light_is_compared_with_and_without_prefiltering(mini, tmp_path):
    chosen = settings(mini, tmp_path, ("normalmap", *PAIR))
    mine = plan.RunPlan(chosen).prefiltering
    assert {(run.method, run.lighting.environment_prefilter) for run in mine} == {(PAIR[0], False), (PAIR[1], True)}
    assert {(run.lighting.footprint, run.view.name) for run in mine} == {("pixel", plan.PREFILTERING)}
    assert {run.spp for run in mine} == set(plan.PREFILTERING_SPPS) and max(plan.PREFILTERING_SPPS) == 64
    main = [run for run in plan.RunPlan(chosen).main if run.method == PAIR[1]]
    assert main and all(run.lighting.environment_prefilter for run in main)
    (key,) = {key for key, _ in plan.references(chosen) if key.view.name == plan.PREFILTERING}
    assert key.view == mine[0].view and key.surface == "texels"
    comparison = Comparison(chosen, executors.Local(), Silent(), {})
    assert comparison.reference_spp(key) == 4096 > comparison.reference_spp(replace(key, view=CROP)) == 8
    assert not comparison.reference_lighting(key).environment_prefilter


@pytest.mark.parametrize("names", [PAIR[:1], PAIR[1:], ("glints_ibm", PAIR[1])])
def test_prefiltering_is_compared_with_the_same_method_alone(mini, tmp_path, names):
    chosen = settings(mini, tmp_path, names)
    assert chosen.prefiltering() is None and plan.RunPlan(chosen).prefiltering == []


def test_without_environment_light_there_is_nothing_to_prefilter(mini, tmp_path):
    dark = scenes.Scene("dark", tmp_path / "dark.xml", mini.values, mini.crops)
    text = mini.path.read_text(encoding="utf-8")
    emitter = '<emitter type="constant"><float name="radiance" value="0.2"/></emitter>'
    assert emitter in text and mini.has_environment
    dark.path.write_text(text.replace(emitter, ""), encoding="utf-8")
    assert not dark.has_environment and settings(dark, tmp_path, PAIR).prefiltering() is None
    both = replace(settings(mini, tmp_path, PAIR), scenes=(dark, mini))
    assert both.prefiltering()[0] is mini


class Once(executors.Local):
    """Leaves every point of more than one sample out in its first pass, as a time limit would, and notes all jobs."""

    def __init__(self):
        super().__init__()
        self.passes = []

    def execute(self, waiting, receive, finished, share):
        self.passes.append([run for job in waiting for run in job.runs])
        if len(self.passes) == 1:
            for job in waiting:
                spared = tuple(run for run in job.runs if run.spp == 1)
                for runs_of_point in render.by_point(run for run in job.runs if run.spp != 1).values():
                    receive(jobs.LeftOut(runs_of_point[0], "the time limit", 1.0, final=runs_of_point[0].spp == 9))
                for outcome in replace(job, runs=spared).carry_out():
                    receive(outcome)
                finished(job)
        else:
            super().execute(waiting, receive, finished, share)


@pytest.mark.parametrize("fresh", [False, True])
def test_time_that_is_left_goes_to_what_was_left_out_alone(mini, tmp_path, fresh):
    rendered(mini, tmp_path, spps=(2,))
    place = Once()
    chosen = settings(mini, tmp_path, spps=(1, 2, 3, 9), frame_spp=1, fresh=fresh, limit=1000.0)
    comparison = Comparison(chosen, place, Silent(), {})
    comparison.render()
    first, second = place.passes
    assert {run.spp for run in first} == ({1, 2, 3, 9} if fresh else {1, 3, 9})
    assert {run.spp for run in second} == ({2, 3} if fresh else {3})
    assert [item.run.spp for item in comparison.left_out] == [9, 9]
    assert {run.spp for run in comparison.records} == {1, 2, 3}


# ---- references ------------------------------------------------------------------------------------------------------


def obtained(scene, folder, monkeypatch, spp, stop_after=math.inf):
    """The reference of the first crop, and how many batches were rendered for it; interrupted on the way if asked."""
    monkeypatch.setattr(jobs, "SNAPSHOT_SECONDS", 0.0)
    plain, calls = render.LoadedScene.render, []

    def counted(*arguments):
        if len(calls) == stop_after:
            raise KeyboardInterrupt
        calls.append(arguments)
        return plain(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(render.LoadedScene, "render", counted)
        comparison = Comparison(settings(scene, folder, reference_spp=spp), executors.Local(), Silent(), {})
        job = next(iter(comparison.reference_jobs()), None)
        if job is not None:
            first = replace(job, wanted=tuple(item for item in job.wanted if item.key.view.name == "crop1"))
            comparison.carry_out([first], lambda _jobs: math.inf)
    return next(item for key, item in comparison.references.items() if key.view.name == "crop1"), len(calls)


def test_a_reference_is_kept_refined_and_bound_to_its_scene(mini, tmp_path, monkeypatch):
    first, count = obtained(mini, tmp_path, monkeypatch, 100)
    assert count == first.batches >= reference.FEWEST_BATCHES
    again, count = obtained(mini, tmp_path, monkeypatch, 100)
    assert count == 0
    np.testing.assert_array_equal(again.mean, first.mean)
    np.testing.assert_array_equal(again.standard_error, first.standard_error)
    finer, count = obtained(mini, tmp_path, monkeypatch, first.spp + 1)
    assert (count, finer.batches) == (1, first.batches + 1)
    support.write_exr(mini.normal_map, (support.random_normals(16, 16, 0.2, seed=2) + 1) / 2)
    try:
        assert obtained(mini, tmp_path, monkeypatch, 100)[1] >= reference.FEWEST_BATCHES
    finally:
        support.write_exr(mini.normal_map, (support.random_normals(16, 16, 0.2) + 1) / 2)


def test_an_interrupted_reference_goes_on_where_it_stopped(mini, tmp_path, monkeypatch):
    whole, count = obtained(mini, tmp_path / "whole", monkeypatch, 200)
    with pytest.raises(KeyboardInterrupt):
        obtained(mini, tmp_path / "parts", monkeypatch, 200, stop_after=3)
    resumed, rest = obtained(mini, tmp_path / "parts", monkeypatch, 200)
    assert rest == count - 3
    np.testing.assert_allclose(resumed.mean, whole.mean, rtol=1e-12)


# ---- interruption ----------------------------------------------------------------------------------------------------


OPTIONS = (
    "--tiling",
    "1",
    "--spp",
    "1,256",
    "--seeds",
    "4",
    "--reference-spp",
    "50",
    "--frames",
    "0",
    "--sweep",
    "none",
)
OPTIONS += ("--methods", "normalmap,roughconductor", "--no-report")


def listed(folder):
    """Name of each image in results.json to the digest of its file."""
    records = json.loads((folder / "results.json").read_text(encoding="utf-8"))["records"]
    return {record["image"]: record["image_digest"] for record in records}


@pytest.fixture(scope="module")
def uninterrupted(mini_folder, tmp_path_factory):
    """What a comparison lists that is not interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    done = run_compare(mini_folder, folder, folder / "cache", *OPTIONS)
    assert done.returncode == 0, done.stderr
    return listed(folder)


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_an_interrupted_comparison_goes_on_where_it_stopped(mini_folder, uninterrupted, tmp_path, stop):
    cache = tmp_path / "cache"
    line, environment = command(mini_folder, tmp_path, cache, *OPTIONS)
    # Who runs the tests in the background may ignore interrupts, and what they start then does, too.
    ours = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(line, env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    signal.signal(signal.SIGINT, ours)
    while process.poll() is None and len(list(cache.glob("runs/**/*.json"))) < 3:
        time.sleep(0.005)
    os.kill(process.pid, stop)
    _, said = process.communicate(timeout=60)
    assert process.returncode != 0
    if stop == signal.SIGINT:
        assert "the same command goes on from there" in said and "Traceback" not in said
    kept = {path: path.stat().st_mtime_ns for path in cache.glob("runs/**/*.json")}
    done = run_compare(mini_folder, tmp_path, cache, *OPTIONS)
    assert done.returncode == 0, done.stderr
    assert listed(tmp_path) == uninterrupted and len(uninterrupted) == 2 * (2 * 2 * 4 + 1)
    assert 3 <= len(kept) < len(uninterrupted), "it was to be interrupted on the way"
    assert kept == {path: path.stat().st_mtime_ns for path in kept}, "what was finished is not rendered again"


# ---- time ------------------------------------------------------------------------------------------------------------


def outcomes_of(mini, wanted, seconds=math.inf):
    """What a job of stock `normalmap` yields."""
    return list(jobs.RenderJob("job", mini.text(METHODS["normalmap"], 1), tuple(wanted)).carry_out(seconds))


def test_points_are_rendered_whole_or_left_out(mini):
    cheap = [replace(RUN, seed=seed) for seed in (1, 2)]
    dear = [replace(RUN, seed=seed, spp=10**7) for seed in (1, 2)]
    found = outcomes_of(mini, [*cheap, *dear], 30.0)
    assert [type(item) for item in found] == [runs.Finished, runs.Finished, jobs.LeftOut]
    assert found[-1].run == dear[0] and found[-1].predicted_seconds > 30 and found[-1].reason == "the time limit"


def test_equal_time_takes_the_same_samples_for_all_seeds(mini):
    """How well the budget is filled is tested on a stand-in below: a busy machine has no say in it."""
    found = outcomes_of(mini, [replace(RUN, spp=None, time_budget=0.3, seed=seed) for seed in (1, 2)])
    assert [item.run.seed for item in found] == [1, 2]
    assert len({item.spp for item in found}) == 1 and found[0].spp > 1


class Steady:
    """Stands for a loaded scene in which a sample takes `seconds(spp)`."""

    def __init__(self, seconds):
        self.seconds = seconds

    def render(self, view, _lighting, spp, seed):
        return render.Rendering(None, view.pixels * spp * self.seconds(spp), 0.0)


@pytest.mark.parametrize("power", [0.0, -0.1])
def test_a_budget_is_filled_whatever_a_sample_costs(power):
    """Samples that get cheaper with their number: the first guess is off, the second is not."""
    wanted = replace(RUN, spp=None, time_budget=10.0)
    scene = Steady(lambda spp: 1e-4 * spp**power)
    spp = jobs.Stopwatch(scene).fill(wanted, 10.0)
    share = scene.render(CROP, None, spp, 1).seconds / 10.0
    assert (0.99 if power == 0 else 0.75) < share <= 1


@pytest.mark.parametrize(("seconds", "spp"), [(1.2, 1), (1.3, None), (5.0, None), (0.3, 3)])
def test_a_sample_that_takes_longer_than_the_budget_is_not_taken(seconds, spp):
    """Seconds of one sample per pixel, of a budget of one second."""
    assert jobs.Stopwatch(Steady(lambda _: seconds / CROP.pixels)).fill(RUN, 1.0) == spp


def test_budgets_that_one_sample_exceeds_are_left_out_for_good(mini, tmp_path):
    comparison, outcomes = rendered(mini, tmp_path, times=(1e-6,), limit=1000.0)
    absent = [item for item in outcomes if isinstance(item, jobs.LeftOut)]
    assert [item.run.view.name for item in absent] == ["crop1", "crop2"] and absent == comparison.left_out
    assert all(item.final and item.predicted_seconds > 1e-6 for item in absent)
    assert absent[0].record()["reason"] == "one sample per pixel takes longer than the time budget"


def test_building_is_paid_from_a_budget_that_includes_it(mini, monkeypatch):
    monkeypatch.setattr(render, "structure", lambda scene: {"build_seconds": 0.29})
    base = replace(RUN, spp=None, time_budget=0.3)
    (without,) = outcomes_of(mini, [base])
    (paid,) = outcomes_of(mini, [replace(base, budget_includes_build=True)])
    assert paid.spp < without.spp / 3
    (none,) = outcomes_of(mini, [replace(base, budget_includes_build=True, time_budget=0.2)])
    assert "shorter than building" in none.reason


# ---- the temporal sequence -------------------------------------------------------------------------------------------


def test_the_camera_goes_round_what_the_crop_shows(mini, tmp_path):
    chosen = settings(mini, tmp_path, frames=3, orbit=20.0)
    views = chosen.sequence(mini, 1.0)
    assert [view.turn for view in views] == [0, 10, 20]
    loaded = render.LoadedScene(mini.text(METHODS["normalmap"], 1))
    sensor = loaded.scene.sensors()[0]
    seen, places = [], []
    for view in (*views, views[0]):
        loaded.point_at(view)
        places.append(np.array(sensor.world_transform().matrix))
        ray, _ = sensor.sample_ray(0.0, 0.5, [0.5, 0.5], [0.5, 0.5])
        seen.append(np.array(loaded.scene.ray_intersect(ray).p))
    np.testing.assert_allclose(seen[1:], [seen[0]] * 3, atol=1e-4)
    distances = [np.linalg.norm(place[:3, 3] - seen[0]) for place in places]
    np.testing.assert_allclose(distances, distances[0], rtol=1e-4)
    assert np.abs(places[2] - places[0]).max() > 0.1
    np.testing.assert_array_equal(places[3], places[0])


def test_a_sequence_is_measured_against_its_references(mini, tmp_path):
    wanted = settings(mini, tmp_path, ("glints_direct", "glints_unfiltered"), frames=4, orbit=4.0, size=160)
    comparison = Comparison(wanted, executors.Local(), Silent(), {})
    comparison.render()
    truth, *found = temporal.results(comparison)
    assert truth.method == "reference" and [item.method for item in found] == ["glints_direct", "glints_unfiltered"]
    for item in found:
        assert item.frames == len(item.max_trace) == len(item.images) == 4
        images = np.stack([read_exr(comparison.settings.out / path) for path in item.images])
        assert temporal.trace(images) == pytest.approx(item.max_trace)
        excess = read_exr(comparison.settings.out / item.excess_image)
        assert excess.mean() == pytest.approx(item.excess_variance.value, rel=1e-4)
    filtered, unfiltered = found
    assert filtered.excess_variance.value < unfiltered.excess_variance.value


GLINTS = """<bsdf type="glints_ibm" id="{name}">
    <string name="filename" value="{file}"/><float name="alpha" value="{alpha}"/></bsdf>"""


def test_structures_add_up_and_shared_ones_count_once(rough_map):
    """Three shapes: two share a BSDF, a third has another, inside of `twosided`."""
    bsdfs = "".join(GLINTS.format(name=name, file=rough_map, alpha=alpha) for name, alpha in (("a", 0.1), ("b", 0.02)))
    users = ('<ref id="a"/>', '<ref id="a"/>', '<bsdf type="twosided"><ref id="b"/></bsdf>')
    shapes = "".join(f'<shape type="rectangle">{user}</shape>' for user in users)
    found = render.structure(mi.load_string(f'<scene version="3.0.0">{bsdfs}{shapes}</scene>'))
    a, b = (
        render.structure_of(str(mi.load_dict({"type": "glints_ibm", "filename": str(rough_map), "alpha": alpha})))
        for alpha in (0.1, 0.02)
    )
    assert a["bins"] != b["bins"]
    assert found["structure_bytes"] == a["structure_bytes"] + b["structure_bytes"]
    assert found["bins"] == max(a["bins"], b["bins"])
    assert render.structure_of("GlintBSDF[build_seconds = 0.25]\nGlintBSDF[build_seconds = 1.5e-1]") == {
        "build_seconds": 0.4
    }


def test_a_change_of_size_keeps_the_crop(mini):
    """A crop as large as the film that was rendered before."""
    loaded = render.LoadedScene(mini.text(METHODS["normalmap"], 1))
    for view in (scenes.View("frame", 16, 16, (0, 0, 16, 16)), CROP, scenes.View("crop2", 64, 64, (0, 8, 16, 16))):
        assert loaded.render(view, render.Lighting("direct"), 1, 1).image.shape == (16, 16, 3)


def test_a_table_is_written_flat(tmp_path):
    files.write_csv(
        tmp_path / "a.csv", [{"a": 1, "b": [1, 2]}, {"a": {}, "b": {"d": 0.5}}, {"a": None, "c": math.inf}]
    )
    lines = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()
    assert lines == ["a,b,c", "1,1 2,", '{},"{""d"": 0.5}",', ",,inf"]
