"""`interpolation` and `refinement` of `glints_ibm` and `glints_direct`: the surface of curved elements, through the loaded plugins.

Their error over single footprints is tested in Rust (`refinement.rs`).
"""

import mitsuba as mi
import numpy as np
import pytest
import support
from test_distribution import CONTEXT, chi_square, draw_cells, integrate_cells, vertex
from test_errors import assert_mentions, message_of

INTERPOLATED = ("glints_ibm", "glints_direct")
BILINEAR = {"interpolation": "bilinear"}


@pytest.fixture(scope="module")
def bent_map(tmp_path_factory):
    """One period of waves over 24 texels: the normal turns by about 0.1 from texel to texel."""
    side = 24
    u, v = 2 * np.pi * np.stack(np.meshgrid(np.arange(side), np.arange(side))) / side
    slopes = [0.35 * np.sin(u + 0.7 * np.sin(v)), 0.3 * np.cos(2 * v + 0.5 * np.cos(u))]
    normals = support.unit(np.stack([*slopes, np.ones_like(u)], -1))
    return support.write_exr(tmp_path_factory.mktemp("maps") / "bent.exr", normals)


def shown(bsdf, name):
    """A number of the BSDF's description."""
    (line,) = (line for line in str(bsdf).splitlines() if line.strip().startswith(f"{name} ="))
    return float(line.split("=")[1].strip(" ,"))


# ---- the same surface -----------------------------------------------------------------------------------------------


def rendered(filename, plugin, **parameters):
    """A plane with a texel a pixel under a light that a tenth of the map mirrors."""
    material = {"type": plugin, "filename": filename, "alpha": 0.06, "masking": "none", **parameters}
    light = {"type": "directional", "direction": [0.2, -0.1, -1], "irradiance": 1.0}
    path = {"type": "glints_path", "footprint": "pixel", "max_depth": 2}
    scene = support.plane_scene(material, path, resolution=24, samples=64, light=light)
    return np.array(mi.render(scene, seed=1)).mean(axis=-1)


def distance(a, b):
    return np.abs(a - b).sum() / b.sum()


@pytest.mark.parametrize("plugin", INTERPOLATED)
def test_images_are_those_of_curved_elements(bent_map, plugin):
    """Yan's Gaussian footprint has the variance of the pixel's box here. Its shape and noise are what is left, 0.07."""
    curved = rendered(bent_map, "glints_yan16", elements="curved", refinement=4, footprint_sigma=0.29)
    assert distance(rendered(bent_map, plugin, **BILINEAR), curved) < 0.1
    # The twin: flat texels, at 0.36.
    assert distance(rendered(bent_map, plugin), curved) > 0.25


# ---- sampling -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin", INTERPOLATED)
def test_samples_of_an_interpolated_map_have_the_density_of_pdf(bent_map, plugin):
    bsdf = support.bsdf(plugin, bent_map, alpha=0.07, **BILINEAR)
    si, bins = vertex("texels", "steep"), 32
    probabilities = integrate_cells(si, bins, lambda wo: bsdf.pdf(CONTEXT, si, mi.Vector3f(*wo)))
    probabilities = np.append(probabilities, max(0.0, 1 - probabilities.sum()))
    counts, _ = draw_cells(bsdf, si, bins, 15_000, np.random.default_rng(1))
    assert chi_square(counts, probabilities) > 1e-4 / len(INTERPOLATED)
    # Flat texels are another distribution: the twin that has to fail.
    flat = support.bsdf(plugin, bent_map, alpha=0.07)
    others, _ = draw_cells(flat, si, bins, 15_000, np.random.default_rng(1))
    assert chi_square(others, probabilities) < 1e-12


@pytest.mark.parametrize("plugin", INTERPOLATED)
def test_white_furnace_of_an_interpolated_map(bent_map, plugin):
    """Over the whole map nothing is gained, and near the normal next to nothing is lost."""
    bsdf = support.bsdf(plugin, bent_map, alpha=0.12, **BILINEAR)
    _, weights = draw_cells(bsdf, vertex("tiles", "steep"), 24, 1500, np.random.default_rng(2))
    assert 0.95 < weights.mean() < 1.005


# ---- parameters -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin", INTERPOLATED)
def test_a_refinement_of_one_changes_nothing(bent_map, plugin):
    flat = support.bsdf(plugin, bent_map, alpha=0.1, interpolation="nearest")
    same = support.bsdf(plugin, bent_map, alpha=0.1, refinement=1, **BILINEAR)
    si, wo = vertex("texels", "steep"), support.unit((0.1, -0.2, 1))
    assert support.value(flat, si, wo) == support.value(same, si, wo) > 0
    assert (shown(flat, "refinement"), shown(same, "refinement")) == (0, 1)


@pytest.mark.parametrize("plugin", INTERPOLATED)
def test_the_automatic_refinement_follows_the_roughness(bent_map, plugin):
    with support.captured_log() as lines:
        bsdfs = [support.bsdf(plugin, bent_map, alpha=alpha, **BILINEAR) for alpha in (0.12, 0.06, 0.03)]
    assert [shown(bsdf, "refinement") for bsdf in bsdfs] == [2, 2, 4] and not lines
    assert all(0.5 < shown(bsdf, "refinement_step") <= 1.5 for bsdf in bsdfs)


@pytest.mark.parametrize("plugin", INTERPOLATED)
def test_facets_are_told(bent_map, plugin):
    with support.captured_log() as lines:
        support.bsdf(plugin, bent_map, alpha=0.002, **BILINEAR)
        support.bsdf(plugin, bent_map, alpha=0.002, refinement=8, **BILINEAR)
    (line,) = [line for line in lines if "faceted" in line]
    assert_mentions(line, plugin, bent_map, "refinement = 8", "standard deviations", "larger alpha")


def test_mirrors_and_the_published_structure_can_be_interpolated(bent_map):
    for parameters in ({"alpha": 0.0, "bins": 31}, {"alpha": 0.1, "structure": "paper"}):
        bsdf = support.bsdf("glints_ibm", bent_map, refinement=2, **parameters, **BILINEAR)
        assert shown(bsdf, "refinement") == 2
        assert support.value(bsdf, vertex("tiles", "steep"), (0, 0, 1)) > 0


@pytest.mark.parametrize("plugin", INTERPOLATED)
@pytest.mark.parametrize(
    "parameters, fragments",
    [
        ({"interpolation": "cubic"}, ["interpolation", "cubic", "nearest", "bilinear"]),
        ({"interpolation": True}, ["interpolation", "string"]),
        ({"refinement": 2}, ["refinement", "interpolation = bilinear"]),
        ({"refinement": 9, **BILINEAR}, ["refinement", "1 to 8"]),
        ({"refinement": -1, **BILINEAR}, ["refinement", "-1"]),
        ({"refinement": 1.5, **BILINEAR}, ["refinement"]),
    ],
    ids=str,
)
def test_bad_interpolation(bent_map, plugin, parameters, fragments):
    assert_mentions(message_of(lambda: support.bsdf(plugin, bent_map, **parameters)), plugin, *fragments)


def test_mirrors_have_no_automatic_refinement(bent_map):
    message = message_of(lambda: support.bsdf("glints_ibm", bent_map, alpha=0.0, bins=31, **BILINEAR))
    assert_mentions(message, "glints_ibm", "refinement", "mirrors", "1 to 8")


@pytest.mark.parametrize("plugin", ["glints_unfiltered", "glints_carpaint"])
def test_refinement_belongs_to_filters_of_one_surface(bent_map, plugin):
    assert_mentions(message_of(lambda: support.bsdf(plugin, bent_map, refinement=2)), plugin, "refinement")
