"""The project's own scenes: their maps and meshes, what their crops show, and how they are compared."""

import dataclasses
import json

import mitsuba as mi
import numpy as np
import pytest
from glints_harness import cli, plan, render, scenes, tables
from glints_harness.cli import ROOT, scene_assets
from glints_harness.methods import METHODS, choose
from glints_harness.report import text
from mini import no_assets
from scene_assets import bent_quad, car_bonnet, car_wheel, kettle, maps, shoe, wing_mirror
from scipy import stats

FOLDER = ROOT / "mitsuba_scenes"
LISTING = json.loads((FOLDER / "scenes.json").read_text(encoding="utf-8"))
GLINTING_MESHES = {
    "shoes": (shoe, "shoe_upper"),
    "kettle": (kettle, "kettle_metal"),
    "wing_mirror": (wing_mirror, "wing_mirror_paint"),
    "car_wheel": (car_wheel, "car_wheel_metal"),
    "car_bonnet": (car_bonnet, "car_bonnet_paint"),
    "bent_quad": (bent_quad, "bent_quad_metal"),
}

IN_THE_MIRROR = {"kettle_mirror": "crop1"}
"""Crops that show the glinting part in a mirror, which has this name in the scene."""


@pytest.fixture(scope="module")
def project_scenes():
    """The project's scenes in full; their files are generated where they are missing."""
    return {scene.name: scene for scene in scenes.find_scenes(FOLDER, list(LISTING), scene_assets(ROOT / ".cache"))}


# ---- maps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", maps.RECIPES)
def test_maps_have_unit_normals_above_the_surface_and_are_the_same_every_time(name):
    first, second = (maps.RECIPES[name].normals(96) for _ in range(2))
    assert first.shape == (96, 96, 3)
    assert np.allclose(np.linalg.norm(first, axis=-1), 1, atol=1e-12)
    assert first[..., 2].min() > 0.1
    assert np.array_equal(first, second)


def test_tilts_of_flakes_follow_gtr():
    """Against the integral of D(n) cos(n) over solid angle, by the midpoint rule in the tilt's logarithm."""
    recipe = maps.RECIPES["flakes"]
    tilt = np.exp(np.linspace(np.log(1e-7), np.log(np.radians(recipe.steepest)), 200_001))
    middle, step = np.sqrt(tilt[1:] * tilt[:-1]), np.diff(tilt)
    density = np.cos(middle) * np.sin(middle)
    density /= (recipe.alpha**2 * np.cos(middle) ** 2 + np.sin(middle) ** 2) ** recipe.gamma
    cumulative = np.concatenate(([0], np.cumsum(density * step)))
    cumulative /= cumulative[-1]

    def distribution(value):
        return np.interp(value, tilt, cumulative)

    drawn = np.arcsin(np.sqrt(recipe.sine_squared(np.random.default_rng(1).random(20_000))))
    assert drawn.max() <= np.radians(recipe.steepest)
    assert stats.kstest(drawn, distribution).pvalue > 1e-3
    wider = np.arcsin(
        np.sqrt(maps.FlakeRecipe(1, recipe.gamma, 1.1 * recipe.alpha, 4).sine_squared(np.random.rand(20_000)))
    )
    assert stats.kstest(wider, distribution).pvalue < 1e-3


def test_flakes_are_whole_across_the_border():
    """Moving all points by one cell moves the cells' texels with them, also round the border."""
    jitter = np.random.default_rng(2).random((8, 8, 2))
    index = np.arange(64).reshape(8, 8)
    moved = maps.nearest_points(np.roll(jitter, 1, axis=1), 64)
    expected = np.roll(index, 1, axis=1).argsort(axis=None)[maps.nearest_points(jitter, 64)]
    assert np.array_equal(np.roll(expected, 8, axis=1), moved)
    texels = np.bincount(moved.ravel(), minlength=64)
    assert texels.min() > 0 and texels.sum() == 64**2


def test_scratches_run_on_across_the_border():
    recipe = maps.RECIPES["scratches"]
    slopes = np.zeros((64, 64, 2))
    recipe._cut(slopes, np.random.default_rng(3))
    steep = np.linalg.norm(slopes, axis=-1)
    assert 0 < steep.max() <= recipe.slope[1]
    # A scratch of at least 40 texels' length; where one leaves the map on one side it comes in on the other.
    cut = steep > 0
    assert cut.sum() > 40
    across = cut[:, 0].any() and cut[:, -1].any() or cut[0].any() and cut[-1].any()
    assert across or not (cut[:, 0].any() or cut[:, -1].any() or cut[0].any() or cut[-1].any())


def test_scratches_cover_much_of_the_map_but_not_all():
    recipe = maps.RECIPES["scratches"]
    normals = recipe.normals(256)
    tilt = np.linalg.norm(normals[..., :2] / normals[..., 2:], axis=-1)
    assert 0.3 < (tilt > 4 * recipe.ground).mean() < 0.9


# ---- meshes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GLINTING_MESHES)
def test_glinting_meshes_have_outward_normals_and_good_texture_coordinates(name):
    module, part = GLINTING_MESHES[name]
    meshes = module.build()
    assert tuple(meshes) == module.PARTS
    mesh = meshes[part]
    assert all(np.isfinite(values).all() for values in (mesh.vertices, mesh.normals, mesh.uv))
    corner, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    agree = np.sum(normal * mesh.normals[mesh.faces].mean(axis=1), axis=1) > 0
    assert area[~agree].sum() < 1e-3 * area.sum()

    # Texels are of about one size everywhere, and never mirrored.
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    uv_area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    density = uv_area / area
    typical = np.median(np.abs(density))
    assert area[np.sign(density) != np.sign(np.median(density))].sum() < 0.01 * area.sum()
    even = (np.abs(density) > typical / 4) & (np.abs(density) < 4 * typical)
    assert area[even].sum() > 0.9 * area.sum()


# ---- scenes ----------------------------------------------------------------------------------------------------------


def test_the_listing_names_files_and_maps_that_exist(project_scenes):
    files = {path.relative_to(FOLDER).as_posix() for path in FOLDER.glob("*/*.xml")}
    assert {entry["file"] for entry in LISTING.values()} == files
    for name, entry in LISTING.items():
        assert project_scenes[name].normal_map.stem.split("_")[0] == entry["map"]
        assert project_scenes[name].base_tiles == entry["tiles"]
        side = maps.RECIPES[entry["map"]].full_resolution
        assert project_scenes[name].texels == side**2


@pytest.mark.parametrize("name", LISTING)
def test_scenes_load_and_their_crops_lie_on_the_glinting_part(name, project_scenes):
    scene = project_scenes[name]
    render.prepare_thread()
    loaded = render.LoadedScene(scene.text(METHODS["roughconductor"], 1))
    views = scene.views(scenes.FULL_SIZE, 64)
    for view in (views["crop1"], views["crop2"]):
        mirrored = IN_THE_MIRROR.get(name) == view.name
        identity = "mirror" if mirrored else scene.first_slot().element.get("id")
        assert len(loaded.glinting_pixels(identity, view, 16)) > 0.75 * 16**2, view
    image = loaded.render(views["frame"], render.Lighting(max_depth=max(2, scene.max_depth)), 16, 1).image
    assert np.isfinite(image).all()
    assert 0.03 < image.mean() < 1.0
    assert (image.max(axis=-1) > 1).mean() < 0.1


@pytest.mark.parametrize(
    "name, window, spp",
    [
        ("wing_mirror", (425, 300, 40, 40), 64),
        ("car_wheel", (396, 332, 24, 24), 64),
        ("bent_quad", (280, 280, 32, 32), 64),
        ("kettle_mirror", (420, 340, 24, 40), 256),
    ],
)
def test_the_map_makes_the_new_scenes_glint(name, window, spp, project_scenes):
    """Neighbouring pixels differ, and by the same in another rendering; without the map, hardly.

    The windows show nothing but metal, that of `kettle_mirror` in the mirror. Highlights are compressed, so that one bright glint does not decide.
    """
    scene = project_scenes[name]
    view = scenes.View("window", scenes.FULL_SIZE, scenes.FULL_SIZE, window)

    def structure(method):
        loaded = render.LoadedScene(scene.text(METHODS[method], 1))
        lighting = render.Lighting(max_depth=max(2, scene.max_depth), footprint="pixel")
        means = (loaded.render(view, lighting, spp, seed).image.mean(axis=-1) for seed in (1, 2))
        first, second = (np.diff(mean / (0.3 + mean), axis=1) for mean in means)
        return np.mean(first * second)

    render.prepare_thread()
    assert structure("glints_ibm") > 10 * abs(structure("roughconductor"))


def test_pixels_of_the_bonnet_cover_about_a_tile_or_many(project_scenes):
    """About 1000 tiles across the picture, so most pixels see a whole map (2022 paper, Section 6.2), and some far more."""
    scene = project_scenes["car_bonnet"]
    render.prepare_thread()
    loaded = render.LoadedScene(scene.text(METHODS["roughconductor"], 1))
    view = scene.views(scenes.FULL_SIZE, scenes.FULL_SIZE)["frame"]
    tiles = loaded.glinting_pixels("glints", view, 64)
    assert len(tiles) > 0.7 * 64**2
    assert 800 < scenes.FULL_SIZE * np.median(tiles) < 1400
    assert np.percentile(tiles, 1) > 0.5 and np.percentile(tiles, 99) > 2
    finer = render.LoadedScene(scene.text(METHODS["roughconductor"], 8)).glinting_pixels("glints", view, 8)
    assert np.allclose(finer, loaded.glinting_pixels("glints", view, 8)), "the tiling is the map's, not the mesh's"


def test_paths_are_as_long_as_a_scene_asks_for():
    chosen = settings(all_scenes())
    depths = {(run.scene, run.view.name): run.lighting.max_depth for run in plan.RunPlan(chosen).runs}
    assert (depths["kettle", "crop1"], depths["kettle", "frame"]) == (2, 3)
    assert (
        depths["kettle_mirror", "crop1"] == depths["kettle_mirror", "frame"] == LISTING["kettle_mirror"]["max_depth"]
    )
    for key, _ in plan.references(chosen):
        lighting = chosen.lighting_of(chosen.scene(key.scene), key.view)
        assert lighting.max_depth == depths[key.scene, key.view.name]


def test_a_wrong_depth_is_refused(mini_folder, tmp_path):
    for file in ("mini.xml", "maps/flakes.exr"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes((mini_folder / file).read_bytes())
    (tmp_path / "scenes.json").write_text(json.dumps({"mini": {"max_depth": "4"}}), encoding="utf-8")
    with pytest.raises(ValueError, match="scenes.json: mini: max_depth is '4'; it has to be a number"):
        scenes.find_scenes(tmp_path, ["mini"], no_assets)


# ---- reduced plans ---------------------------------------------------------------------------------------------------


def settings(found):
    return plan.Settings(
        scenes=tuple(found), methods=tuple(METHODS.values()), spps=(1, 4), times=(0.15,), sweep=(), frames=0
    )


def all_scenes():
    here = {"assets": FOLDER, "maps": {name: FOLDER / f"{name}.exr" for name in maps.RECIPES}}
    return scenes.find_scenes(FOLDER, ["all"], lambda: here)


def test_a_reduced_scene_has_fewer_runs_and_references():
    chosen = settings(all_scenes())
    runs, references = plan.RunPlan(chosen).runs, [key for key, _ in plan.references(chosen)]
    for name, entry in LISTING.items():
        mine = [run for run in runs if run.scene == name]
        keys = [key for key in references if key.scene == name]
        if "reduced" in entry:
            assert {run.method for run in mine} == set(entry["reduced"]["methods"])
            assert {run.view.name for run in mine} == {key.view.name for key in keys} == {"frame", "crop1"}
            assert {run.method for run in mine if run.view.name == "frame"} == set(entry["reduced"]["frame_methods"])
            assert {run.tiling for run in mine} == {key.tiling for key in keys} == {1.0}
            assert {run.spp for run in mine if run.view.name == "crop1"} == {1, None}
            assert {key.surface for key in keys} == {"texels"}
        else:
            assert {run.method for run in mine} == set(METHODS)
            assert {run.tiling for run in mine} == {1.0, 8.0}
            assert {run.spp for run in mine if run.view.name == "crop2"} == {1, 4, None}
    assert (chosen.scenes[0], 8.0) in chosen.cases and ("wing_mirror", 8.0) not in {
        (s.name, t) for s, t in chosen.cases
    }


def test_names_of_scenes_for_people():
    assert text.case_title("wing_mirror", 8) == "Wing mirror ×8"
    assert tables.counts_text({"shoes": 4, "kettle": 4}) == "4 spp"
    assert tables.counts_text({"shoes": 4, "kettle": 4, "car_wheel": 1}) == "4 spp (shoes, kettle), 1 spp (car_wheel)"


def test_a_precomputed_method_waits_in_the_scenes_that_have_it_alone(project_scenes, tmp_path):
    found = [scene for scene in all_scenes() if scene.name in ("wing_mirror", "bent_quad")]
    found = [dataclasses.replace(project_scenes[scene.name], reduced=scene.reduced) for scene in found]
    methods = [dataclasses.replace(METHODS["glints_tensor"], store=tmp_path), METHODS["glints_ibm"]]
    absent = cli.unprepared(found, methods)
    assert absent == {"bent_quad": ("glints_tensor",), "wing_mirror": ()}
    assert [cli.takes_part(method, found, absent) for method in methods] == [False, True]
    kept = methods[0].precomputation(found[0].first_slot())
    kept.mkdir()
    (kept / "tensor.glints").touch()
    assert cli.unprepared(found, methods) == {"bent_quad": (), "wing_mirror": ()}
    assert cli.takes_part(methods[0], found, cli.unprepared(found, methods))


def test_a_scene_that_is_named_is_compared_in_full():
    here = {"assets": FOLDER, "maps": {}}
    (scene,) = scenes.find_scenes(FOLDER, ["car_wheel"], lambda: {**here, "maps": {"scratches": FOLDER / "s.exr"}})
    assert scene.reduced is None and len(scene.crops) == 2
    assert settings([scene]).of(scene).methods == tuple(METHODS.values())


def test_a_reduced_scene_without_any_of_the_methods_is_left_out():
    chosen = settings(all_scenes())
    chosen = plan.replace(chosen, methods=tuple(choose(["glints_yan16_curved"])))
    assert {scene.name for scene, _ in chosen.cases} == {"shoes", "kettle"}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"methods": ["glints_imb"]}, "scenes.json: mini: reduced: unknown method glints_imb"),
        ({"crops": 0}, "scenes.json: mini: reduced has to give crops as numbers"),
        ({"spps": "1"}, "scenes.json: mini: reduced has to give spps as numbers"),
        (
            {"seeds": 3},
            "scenes.json: mini: reduced needs the entries methods, frame_methods, crops, tilings, spps, times, and no others",
        ),
    ],
)
def test_a_wrong_reduced_plan_is_refused(change, message, mini_folder, tmp_path):
    for file in ("mini.xml", "maps/flakes.exr"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes((mini_folder / file).read_bytes())
    entry = {"methods": ["glints_ibm"], "frame_methods": [], "crops": 1, "tilings": 1, "spps": 1, "times": 1, **change}
    (tmp_path / "scenes.json").write_text(json.dumps({"mini": {"reduced": entry}}), encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        scenes.find_scenes(tmp_path, ["all"], no_assets)
    assert scenes.find_scenes(tmp_path, ["mini"], no_assets)[0].reduced is None


def test_generated_maps_are_what_mitsuba_reads(project_scenes):
    """Stored as (n + 1) / 2, so that n = 2c - 1 is of unit length."""
    for name in ("wing_mirror", "car_wheel"):
        stored = np.array(mi.Bitmap(str(project_scenes[name].normal_map)))
        assert np.allclose(np.linalg.norm(2 * stored.astype(np.float64) - 1, axis=-1), 1, atol=1e-6)
