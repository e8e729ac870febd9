"""`glints environment` and `environment_file` of `glints_path`: lobes lie where Mitsuba's `envmap` has its light."""

import json
import math
import pathlib
import subprocess

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import bsdf, captured_log, plane_scene, random_normals, write_exr
from test_errors import assert_mentions, message_of

TOOL = pathlib.Path(__file__).resolve().parents[1] / "scripts" / "glints"
LOBES = 24
T = mi.ScalarTransform4f
TURN = T().rotate((1, 0, 0), 90).rotate((0, 1, 0), 40)


def fit(studio, output, lobes=LOBES):
    command = [TOOL, "environment", studio, "-o", output, "--lobes", lobes]
    subprocess.run(list(map(str, command)), check=True, capture_output=True, timeout=600)
    return output


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Maps and a fit of each: a studio without any symmetry, and the same with other lights."""
    folder = tmp_path_factory.mktemp("environments")
    write_exr(folder / "map.exr", random_normals(32, 32, 0.2, seed=2))
    for name, column in (("studio", 20), ("other", 90)):
        pixels = np.full((64, 127, 3), 0.05, dtype=np.float32)
        pixels[8:20, column : column + 16] = [9.0, 8.0, 7.0]
        pixels[14:22, (column + 60) % 115 :][:, :10] = [4.0, 6.0, 9.0]
        pixels[40:44, (column + 30) % 115 :][:, :4] = [30.0, 1.0, 1.0]
        mi.Bitmap(pixels).write(str(folder / f"{name}.exr"))
        fit(folder / f"{name}.exr", folder / f"{name}.json")
    return folder


def saved(path):
    """The version, and axes, sharpness and energies as arrays."""
    content = json.loads(pathlib.Path(path).read_text())
    return content, *(np.array([lobe[key] for lobe in content["lobes"]]) for key in ("axis", "sharpness", "energy"))


def sphere(count):
    """Directions of equal solid angle."""
    i = np.arange(count)
    z, phi = 1 - (2 * i + 1) / count, i * math.pi * (3 - math.sqrt(5))
    sin = np.sqrt(1 - z * z)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], axis=1)


def emitted(filename, directions, **parameters):
    """What the `envmap` sends from each direction."""
    emitter = mi.load_dict({"type": "envmap", "filename": str(filename), **parameters})
    si = dr.zeros(mi.SurfaceInteraction3f)
    values = []
    for direction in directions:
        si.wi = mi.ScalarVector3f(*-direction)
        values.append(np.array(emitter.eval(si)).ravel())
    return np.array(values)


def mixture(axes, sharpness, energies, directions):
    """The radiance of spherical Gaussians, from their definition."""
    drop = 1 - directions @ axes.T
    peak = sharpness / (2 * math.pi * -np.expm1(-2 * sharpness))
    return (peak * np.exp(-sharpness * drop)) @ energies


def test_lobes_point_where_the_light_comes_from(folder):
    """Integrals and shape against Mitsuba's own `envmap`; the twins are mirrored and turned lobes."""
    _, axes, sharpness, energies = saved(folder / "studio.json")
    directions = sphere(20000)
    light = emitted(folder / "studio.exr", directions)
    solid_angle = 4 * math.pi / len(directions)
    # 20000 points: the rectangles' edges make up to 0.5 %.
    assert energies.sum(axis=0) == pytest.approx(light.sum(axis=0) * solid_angle, rel=0.01)

    def elsewhere(turned):
        excess = np.maximum(light - mixture(turned, sharpness, energies, directions), 0)
        return excess.sum() / light.sum()

    found = elsewhere(axes)
    twins = [elsewhere(axes * sign) for sign in ([-1, 1, 1], [1, -1, 1], [1, 1, -1])]
    twins += [elsewhere(np.array([np.array(T().rotate((0, 1, 0), 15) @ mi.ScalarVector3f(*a)) for a in axes]))]
    print(f"light elsewhere: {found:.3f}, twins {np.round(twins, 3)}")
    assert found < 0.25
    assert min(twins) > 2 * found


def test_the_picture_of_a_fit_is_an_environment_of_the_same_orientation(folder, tmp_path):
    command = [TOOL, "environment", folder / "studio.exr", "--picture", tmp_path / "fit.exr", "--lobes", LOBES]
    subprocess.run(list(map(str, command)), check=True, capture_output=True, timeout=600)
    _, axes, sharpness, energies = saved(folder / "studio.json")
    directions = sphere(2000)
    shown = emitted(tmp_path / "fit.exr", directions)
    # Interpolated between 127 x 64 pixels.
    assert np.abs(shown - mixture(axes, sharpness, energies, directions)).sum() < 0.05 * shown.sum()


def light(folder, name="studio", **parameters):
    return {"type": "envmap", "filename": str(folder / f"{name}.exr"), "to_world": TURN, **parameters}


def image(folder, light, variant="scalar_rgb", prefilter=True, **parameters):
    mi.set_variant(variant)
    material = bsdf("glints_direct", folder / "map.exr", alpha=0.05)
    integrator = {
        "type": "glints_path",
        "max_depth": 2,
        "footprint": "pixel",
        "environment_prefilter": prefilter,
        "environment_candidates": 2,
        **parameters,
    }
    return np.array(mi.render(plane_scene(material, integrator, 8, 16, light=light), seed=1))


def from_file(folder, light, name="studio.json", **parameters):
    return image(folder, light, environment_file=str(folder / name), **parameters)


@pytest.mark.parametrize("parameters", [{}, {"scale": 3.0}, {"to_world": T().rotate((0.6, 0, 0.8), 140)}])
def test_a_saved_fit_gives_the_image_of_one_made_in_place(folder, parameters):
    """Whatever `scale` and `to_world` of the scene's environment are."""
    sky = light(folder, **parameters)
    expected = image(folder, sky, environment_lobes=LOBES)
    found = from_file(folder, sky)
    assert np.abs(found - expected).max() < 1e-4 * expected.max()
    # Other lobes would be told from these.
    twin = image(folder, sky, environment_lobes=LOBES - 1)
    assert np.abs(twin - expected).max() > 1e-2 * expected.max()


def test_scale_and_variants(folder):
    once = from_file(folder, light(folder))
    assert from_file(folder, light(folder, scale=2.5)) == pytest.approx(2.5 * once, rel=1e-4)
    for variant in ("scalar_spectral", "scalar_spectral_polarized"):
        spectral = from_file(folder, light(folder), variant=variant)
        assert spectral.mean(axis=(0, 1)) == pytest.approx(once.mean(axis=(0, 1)), rel=0.1)


def turned(folder, output, axis, degrees):
    """A copy of the studio's fit whose lobes are turned."""
    content, axes, *_ = saved(folder / "studio.json")
    for lobe, axis_of_lobe in zip(content["lobes"], axes):
        lobe["axis"] = np.array(T().rotate(axis, degrees) @ mi.ScalarVector3f(*axis_of_lobe)).tolist()
    output.write_text(json.dumps(content))
    return output.name


def test_lobes_of_another_environment_are_refused(folder):
    """Turned lobes, and those of another map: the check of the scene's own light finds both."""
    names = [turned(folder, folder / f"turned{d}.json", (0, 1, 0), d) for d in (10, 90, 180)]
    names.append(turned(folder, folder / "upside.json", (1, 0, 0), 180))
    for name in [*names, "other.json"]:
        with pytest.raises(RuntimeError, match="environment_file") as caught:
            from_file(folder, light(folder), name=name)
        assert_mentions(str(caught.value), name, "another environment", "glints environment")
    # Turned by a tenth of a degree it is the same light.
    from_file(folder, light(folder), name=turned(folder, folder / "near.json", (0, 1, 0), 0.1))


def test_to_world_has_to_be_a_rotation(folder):
    with pytest.raises(RuntimeError, match="to_world"):
        from_file(folder, light(folder, to_world=T().scale((1, 2, 1))))


def refusal(**parameters):
    """The message about an integrator's parameters."""
    described = {"type": "glints_path", "environment_prefilter": True, **parameters}
    return message_of(lambda: mi.load_dict(described))


def test_bad_files_and_conflicts_are_refused_when_the_scene_is_loaded(folder, tmp_path):
    good = (folder / "studio.json").read_text()
    cases = {
        "cut.json": (good[: len(good) // 2], "not all of one"),
        "version.json": (good.replace('"version": 1', '"version": 7'), "version 7"),
        "text.json": ("hello", "not a saved fit"),
        "sharp.json": (good.replace('"sharpness": ', '"sharpness": -', 1), "sharpness"),
    }
    for name, (text, word) in cases.items():
        (tmp_path / name).write_text(text)
        # Also where it is not used.
        for prefilter in (True, False):
            message = refusal(environment_file=str(tmp_path / name), environment_prefilter=prefilter)
            assert_mentions(message, "glints_path", "environment_file", name, word, "glints environment")
    assert_mentions(refusal(environment_file=str(tmp_path / "no.json")), "environment_file", "no.json")
    both = refusal(environment_file=str(folder / "studio.json"), environment_lobes=64)
    assert_mentions(both, "environment_file", "environment_lobes", "leave one of them out")


def test_the_log_tells_where_lobes_come_from(folder):
    with captured_log(mi.LogLevel.Info) as lines:
        from_file(folder, light(folder))
    (line,) = [line for line in lines if "spherical Gaussians" in line]
    assert_mentions(line, f"{LOBES} spherical Gaussians", "loaded and checked")
