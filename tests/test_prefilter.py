"""Environment prefiltering of `glints_path`: less noise, the same light."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import bsdf, captured_log, plane_scene, random_normals

T = mi.ScalarTransform4f


def softboxes(tmp_path):
    """A dim room with two bright rectangles: the kettle's studio in small."""
    height, width = 64, 128
    pixels = np.full((height, width, 3), 0.05, dtype=np.float32)
    pixels[8:20, 20:36] = [9.0, 8.0, 7.0]
    pixels[14:22, 80:90] = [4.0, 6.0, 9.0]
    mi.Bitmap(pixels).write(str(tmp_path / "studio.exr"))
    return {"type": "envmap", "filename": str(tmp_path / "studio.exr"), "to_world": T().rotate((1, 0, 0), 90)}


def scene(material, light, prefilter, samples, resolution=8, **parameters):
    integrator = {
        "type": "glints_path",
        "max_depth": 2,
        "footprint": "pixel",
        "environment_prefilter": prefilter,
        "environment_lobes": 32,
        "environment_candidates": 2,
        **parameters,
    }
    return plane_scene(material, integrator, resolution, samples, light=light)


def rendered(scene, seeds):
    return np.array([np.array(mi.render(scene, seed=seed)) for seed in seeds])


def mean_and_error(images):
    means = images.mean(axis=(1, 2, 3))
    return means.mean(), means.std(ddof=1) / math.sqrt(len(means))


@pytest.fixture
def material(make_map):
    return bsdf("glints_direct", make_map(random_normals(32, 32, 0.2, seed=2)), alpha=0.05)


def test_constant_light_keeps_its_energy(material):
    """Furnace: the lobes' rectangles cover the half vectors evenly to 10 %, whatever the footprint shows of the NDF."""
    light = {"type": "constant", "radiance": 1.0}
    expected, _ = mean_and_error(rendered(scene(material, light, False, 16), range(4)))
    mean, error = mean_and_error(rendered(scene(material, light, True, 16), range(4)))
    print(f"constant: {mean:.4f} +- {error:.4f}, unprefiltered {expected:.4f}, bias {mean / expected - 1:+.3f}")
    assert error < 0.02 * mean
    assert mean == pytest.approx(expected, rel=0.1)


def test_a_studio_has_less_noise_and_little_bias(material, tmp_path):
    """At 64 samples per pixel; the bias against the unprefiltered image is printed, in all and in crops."""
    light = softboxes(tmp_path)
    reference = rendered(scene(material, light, False, 512), range(100, 104))
    plain = rendered(scene(material, light, False, 64), range(8))
    smooth = rendered(scene(material, light, True, 64), range(8))
    noise = smooth.var(axis=0, ddof=1).mean() / plain.var(axis=0, ddof=1).mean()
    expected, _ = mean_and_error(reference)
    mean, error = mean_and_error(smooth)
    crops = [
        smooth[:, y : y + 4, x : x + 4].mean() / reference[:, y : y + 4, x : x + 4].mean() - 1
        for y in (0, 4)
        for x in (0, 4)
    ]
    print(f"studio: variance {noise:.3f}, bias {mean / expected - 1:+.3f} +- {error / expected:.3f}, crops {crops}")
    assert noise < 0.6
    assert mean == pytest.approx(expected, rel=0.1)
    # Twin: an extent that covers far more than the lobes loses the shape of the light.
    wide = rendered(scene(material, light, True, 64, environment_epsilon=1e-30), range(2))
    truth = reference.mean(axis=0)

    def distance(images):
        return math.sqrt(((images.mean(axis=0) - truth) ** 2).mean()) / expected

    print(f"rms distance {distance(smooth):.3f}, twin {distance(wide):.3f}")
    assert distance(wide) > 2 * distance(smooth)


def test_nothing_is_counted_twice(material, tmp_path):
    """With another emitter beside the environment, its light is added, not the environment's once more."""
    lamp = {"type": "point", "position": [0.3, 0.2, 2], "intensity": 3.0}
    dark = {"type": "constant", "radiance": 0.0}
    sky = {"type": "constant", "radiance": 1.0}
    integrator = {
        "type": "glints_path",
        "max_depth": 2,
        "footprint": "pixel",
        "environment_prefilter": True,
        "environment_lobes": 16,
        "environment_candidates": 2,
    }

    def mean(light, **others):
        return mean_and_error(rendered(plane_scene(material, integrator, 4, 32, light=light, **others), range(6)))

    both, error = mean(sky, lamp=lamp)
    skylight, lamplight = mean(sky)[0], mean(dark, lamp=lamp)[0]
    tolerance = float(5 * error + 0.005 * both)
    assert both == pytest.approx(skylight + lamplight, abs=tolerance)
    # Either light alone would be told from both.
    assert min(skylight, lamplight) > 2 * tolerance


@pytest.mark.parametrize("variant", ["scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"])
def test_colours_are_kept(make_map, variant):
    """A coloured sky: the reflection has its colour, in every variant, from both sides of `twosided`."""
    mi.set_variant(variant)
    filename = make_map(random_normals(32, 32, 0.2, seed=2))
    material = {"type": "twosided", "nested": {"type": "glints_direct", "filename": filename, "alpha": 0.1}}
    light = {"type": "constant", "radiance": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
    images = {}
    for prefilter in (False, True):
        integrator = {
            "type": "glints_path",
            "max_depth": 2,
            "footprint": "pixel",
            "environment_prefilter": prefilter,
            "environment_lobes": 32,
            "environment_candidates": 1,
        }
        for side in (3, -3):
            made = plane_scene(material, integrator, 4, 32, light=light)
            view = T().look_at(origin=(0, 0, side), target=(0, 0, 0), up=(0, 1, 0))
            parameters = mi.traverse(made)
            parameters["camera.to_world"] = view
            parameters.update()
            images[prefilter, side] = np.array(mi.render(made, seed=1)).mean(axis=(0, 1))
    for side in (3, -3):
        ratio = images[True, side] / images[False, side]
        assert ratio == pytest.approx(ratio.mean(), rel=0.03)
        assert ratio.mean() == pytest.approx(1.0, abs=0.12)


def test_materials_without_range_queries_are_named_once(make_map):
    filename = make_map(random_normals(32, 32, 0.2))
    light = {"type": "constant"}
    ibm = bsdf("glints_ibm", filename, alpha=0.1)
    with captured_log() as lines:
        prefiltered = rendered(scene(ibm, light, True, 4), [1, 2])
    assert sum("environment_prefilter" in line for line in lines) == 1
    assert np.array_equal(prefiltered, rendered(scene(ibm, light, False, 4), [1, 2]))
    with captured_log() as lines:
        rendered(scene(bsdf("glints_direct", filename, alpha=0.1), light, True, 4), [1])
    assert not lines


def test_a_black_environment_is_black(material):
    assert not rendered(scene(material, {"type": "constant", "radiance": 0.0}, True, 4), [1]).any()


def test_threads_do_not_matter(material, tmp_path):
    light = softboxes(tmp_path)
    # Loaded before: with a single thread, Mitsuba waits for ever for the file of an environment map.
    scenes = {threads: scene(material, light, True, 2) for threads in (1, 3)}
    before = dr.thread_count()
    results = []
    try:
        for threads, made in scenes.items():
            dr.set_thread_count(threads)
            results.append(rendered(made, [1]))
    finally:
        dr.set_thread_count(before)
    assert results[0].any()
    assert np.array_equal(*results)
