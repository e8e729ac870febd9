"""`glints_path`: the paths of Mitsuba's `path`, and footprints of the promised width at the camera's vertex."""

import math

import mitsuba as mi
import numpy as np
import pytest
from support import NEEDS_DIFFERENTIALS, bsdf, captured_log, plane_scene, random_normals

# ---- the same paths as the stock integrator -------------------------------------------------------------------------


def varied_scene(integrator):
    """Every kind of vertex: diffuse, glossy, refracting, half transparent; area, point and environment lights."""
    transform = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "camera": {
                "type": "perspective",
                "fov": 40,
                "to_world": transform().look_at((0, -4, 2.5), (0, 0, 0.3), (0, 0, 1)),
                "film": {
                    "type": "hdrfilm",
                    "width": 48,
                    "height": 48,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgba",
                },
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "floor": {"type": "rectangle", "to_world": transform().scale(3), "bsdf": {"type": "diffuse"}},
            "glass": {"type": "sphere", "center": [0, 0, 0.7], "radius": 0.7, "bsdf": {"type": "dielectric"}},
            "metal": {
                "type": "sphere",
                "center": [1.2, 0.3, 0.5],
                "radius": 0.5,
                "bsdf": {"type": "roughconductor", "alpha": 0.2},
            },
            "veil": {
                "type": "rectangle",
                "to_world": transform().translate((-0.5, -1, 0.5)).rotate((1, 0, 0), 80).scale(0.4),
                "bsdf": {
                    "type": "mask",
                    "opacity": 0.5,
                    "nested": {"type": "twosided", "nested": {"type": "diffuse"}},
                },
            },
            "lamp": {
                "type": "rectangle",
                "to_world": transform().translate((-1, 0, 2)).rotate((0, 1, 0), 160).scale(0.3),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [8, 6, 4]}},
            },
            "sky": {"type": "constant", "radiance": 0.3},
            "bulb": {"type": "point", "position": [1, -1, 2], "intensity": 2.0},
        }
    )


@pytest.mark.parametrize("variant", ["scalar_rgb", "scalar_spectral", "scalar_spectral_polarized"])
@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"max_depth": 0},
        {"max_depth": 1},
        {"max_depth": 2},
        {"max_depth": 4, "rr_depth": 1},
        {"rr_depth": 2},
        {"hide_emitters": True},
        {"hide_emitters": True, "max_depth": 1},
    ],
    ids=str,
)
def test_paths_are_those_of_path(variant, parameters):
    """Both draw the same random numbers for the same decisions, so that at one sample per pixel the images are equal.

    (With more samples they are so only in expectation: a path that ends leaves the generator in another state.) A wrong
    weight of multiple importance sampling, a wrong depth or a wrong roulette would show in some of the 2304 paths. The
    tolerance is rounding, amplified by refraction through a sphere; not one path may differ by more.
    """
    mi.set_variant(variant)
    stock, ours = (
        np.array(mi.render(varied_scene({"type": name, **parameters}), seed=5)) for name in ("path", "glints_path")
    )
    assert np.abs(stock - ours).max() <= 1e-4 * max(1.0, stock.max())
    if parameters.get("max_depth") != 0 and not parameters.get("hide_emitters"):
        assert stock.max() > 0.2


def test_direct_illumination_is_that_of_direct(make_map):
    """On a glinting plane, filtered, against Mitsuba's `direct`, which keeps the differentials as well.

    Independent seeds; the means must agree within 4 standard errors of their difference, which are below 2 %.
    """
    material = bsdf("glints_direct", make_map(random_normals(64, 64, 0.2)), alpha=0.05)
    light = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate((0.5, 0, 1.5)).rotate((1, 0, 0), 180).scale(0.4),
        "emitter": {"type": "area", "radiance": 5.0},
    }

    def means(integrator, seeds):
        scene = plane_scene(
            material, integrator, resolution=12, samples=16, sky={"type": "constant", "radiance": 0.2}, light=light
        )
        return [float(np.mean(mi.render(scene, seed=seed))) for seed in seeds]

    direct, ours = means("direct", range(12)), means({"type": "glints_path", "max_depth": 2}, range(100, 112))
    difference = np.mean(ours) - np.mean(direct)
    error = math.sqrt((np.var(direct, ddof=1) + np.var(ours, ddof=1)) / 12)
    assert error < 0.02 * np.mean(direct)
    assert abs(difference) < 4 * error


# ---- the footprint --------------------------------------------------------------------------------------------------

RESOLUTION = 8
recorded = []


class FootprintRecorder(mi.BSDF):
    """A black material that notes the partials of uv it is asked with."""

    def __init__(self, props):
        mi.BSDF.__init__(self, props)
        self.m_flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | NEEDS_DIFFERENTIALS
        self.m_components = [self.m_flags]

    def sample(self, ctx, si, sample1, sample2, active):
        recorded.append((*si.duv_dx, *si.duv_dy))
        return mi.BSDFSample3f(), mi.Color3f(0)

    def eval(self, ctx, si, wo, active):
        return mi.Color3f(0)

    def pdf(self, ctx, si, wo, active):
        return 0.0

    def eval_pdf(self, ctx, si, wo, active):
        return mi.Color3f(0), 0.0

    def to_string(self):
        return "FootprintRecorder[]"


mi.register_bsdf("footprint_recorder", FootprintRecorder)


def footprints(integrator, spp=0, samples=4, **objects):
    """The partials that a material sees, in pixels, one row per camera ray: (du/dx, dv/dx, du/dy, dv/dy)."""
    recorded.clear()
    scene = plane_scene(
        {"type": "footprint_recorder"}, {"type": "glints_path", **integrator}, RESOLUTION, samples, **objects
    )
    mi.render(scene, spp=spp)
    return np.array(recorded) * RESOLUTION


def assert_squares(partials, width, count):
    assert len(partials) == count
    expected = width * np.array([1, 0, 0, 1])
    assert np.abs(partials) == pytest.approx(np.broadcast_to(expected, partials.shape), abs=1e-4 * max(width, 1))


@pytest.mark.parametrize(
    "rule, width",
    [("sample", None), ("pixel", 1.0), (1, 1.0), (2.5, 2.5), ("2.5", 2.5), (0.125, 0.125), (100, 100.0)],
    ids=str,
)
def test_width_of_the_footprint(rule, width):
    """`sample`: a pixel over the square root of the samples; otherwise exactly so many pixels, at any number of samples."""
    pixels = RESOLUTION**2
    for samples, spp in [(1, 0), (4, 0), (16, 0), (4, 16)]:
        count = spp or samples
        expected = width or 1 / math.sqrt(count)
        assert_squares(footprints({"footprint": rule}, spp, samples), expected, count * pixels)


def test_sample_is_the_default():
    assert_squares(footprints({}, samples=4), 0.5, 4 * RESOLUTION**2)


def test_samples_per_pass():
    """Mitsuba scales by the samples of one pass then, though the sampler still counts all of them."""
    for rule, width in [("sample", 0.5), ("pixel", 1.0), (3.0, 3.0)]:
        with captured_log():  # a deprecation warning
            partials = footprints({"footprint": rule, "samples_per_pass": 4}, samples=16)
        assert_squares(partials, width, 16 * RESOLUTION**2)


def test_xml():
    for value, shown in [
        ('<string name="footprint" value="pixel"/>', "1 pixels"),
        ('<float name="footprint" value="2.5"/>', "2.5 pixels"),
        ("", "sample"),
    ]:
        integrator = mi.load_string(f'<integrator version="3.0.0" type="glints_path">{value}</integrator>')
        assert f"footprint = {shown}" in str(integrator)


def test_zero_switches_filtering_off(make_map):
    assert_squares(footprints({"footprint": 0}), 0.0, 4 * RESOLUTION**2)
    with captured_log() as lines:
        material = bsdf("glints_ibm", make_map(random_normals(64, 64, 0.2)))
        mi.render(plane_scene(material, {"type": "glints_path", "footprint": 0}))
    assert not lines


def test_deeper_vertices_have_no_footprint_when_that_is_switched_off():
    """Seen in a mirror: the camera looks up into it from beside the plane's pixel grid, and it reflects the plane."""
    mirror = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate((0, 0, 1)),
        "bsdf": {"type": "twosided", "nested": {"type": "conductor"}},
    }
    ceiling = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate((0, 0, 4)).rotate((1, 0, 0), 180),
        "bsdf": {"type": "footprint_recorder"},
    }
    off = {"footprint": "pixel", "indirect_footprint": 0}
    assert_squares(footprints(off, mirror=mirror, ceiling=ceiling), 0.0, 4 * RESOLUTION**2)


def test_straight_passages_keep_the_footprint():
    """A fully transparent mask in front of the plane changes nothing."""
    veil = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate((0, 0, 1)).scale(2),
        "bsdf": {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}},
    }
    assert_squares(footprints({"footprint": "pixel"}, veil=veil), 1.0, 4 * RESOLUTION**2)
