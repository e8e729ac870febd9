"""`footprint_filter` and `footprint_sigma`: Gaussian footprints through the loaded plugins.

Weights of texels under all kinds of footprints are tested in Rust (`footprint_filter.rs`).
"""

import itertools

import mitsuba as mi
import numpy as np
import pytest
import support
from scipy import special
from test_distribution import CONTEXT, chi_square, draw_cells, integrate_cells, naive_term, vertex
from test_errors import assert_mentions, message_of

SIDE = 24
GAUSSIAN = {"footprint_filter": "gaussian"}


@pytest.fixture(scope="module")
def flakes_map(tmp_path_factory):
    normals = support.random_normals(SIDE, SIDE, 0.25, seed=4)
    return support.write_exr(tmp_path_factory.mktemp("maps") / "flakes.exr", normals)


def gaussian_shares(center, deviation, count):
    """Mass of a Gaussian over each of `count` texels that repeat."""
    edges = np.arange(-20 * count, 21 * count + 1)
    mass = np.diff(special.ndtr((edges - center) / deviation))
    return mass.reshape(-1, count).sum(axis=0)


@pytest.mark.parametrize("sigma", [0.5, 0.288675])
def test_axis_aligned_footprints_have_products_of_error_functions(make_map, sigma):
    """A footprint of 2.5 x 1.25 texels: weights are products that one can write down."""
    normals = support.random_normals(8, 4, 0.2, seed=9)
    alpha, path = 0.25, make_map(normals)
    gaussian = support.bsdf("glints_direct", path, alpha=alpha, masking="none", footprint_sigma=sigma, **GAUSSIAN)
    box = support.bsdf("glints_direct", path, alpha=alpha, masking="none")
    columns, rows = gaussian_shares(3, 2.5 * sigma, 8), gaussian_shares(3.875, 1.25 * sigma, 4)
    wi, wo = support.unit([0.3, -0.4, 0.8]), support.unit([-0.1, 0.2, 0.9])
    si = support.interaction((3 / 8, 3.875 / 4), wi, (2.5 / 8, 0), (0, 1.25 / 4))
    expected = 0.0
    for row, column in itertools.product(range(4), range(8)):
        t = normals[row, column].astype(float)
        expected += rows[row] * columns[column] / t[2] * naive_term(alpha, wi, wo, t) / (4 * wi[2])
    # The truncation at 3.74 standard deviations moves 0.04 % of the weight.
    assert support.value(gaussian, si, wo) == pytest.approx(expected, rel=1e-3)
    assert support.value(box, si, wo) != pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize("plugin", ["glints_direct", "glints_ibm"])
@pytest.mark.parametrize("footprint", ["subtexel", "texels"])
def test_samples_have_the_density_of_pdf(flakes_map, footprint, plugin):
    gaussian = support.bsdf(plugin, flakes_map, alpha=0.1, **GAUSSIAN)
    si, bins = vertex(footprint, "oblique"), 24
    probabilities = integrate_cells(si, bins, lambda wo: gaussian.pdf(CONTEXT, si, mi.Vector3f(*wo)))
    probabilities = np.append(probabilities, max(0.0, 1 - probabilities.sum()))
    counts, _ = draw_cells(gaussian, si, bins, 10_000, np.random.default_rng(1))
    assert chi_square(counts, probabilities) > 1e-4 / 2
    if footprint == "texels":
        # The broken twin: texels drawn with the box's weights.
        box = support.bsdf(plugin, flakes_map, alpha=0.1)
        others, _ = draw_cells(box, si, bins, 10_000, np.random.default_rng(1))
        assert chi_square(others, probabilities) < 1e-12


def test_the_compact_structure_has_the_gaussian_of_the_direct_sum(flakes_map):
    si = vertex("texels", "oblique")
    wos = [support.unit((0.1 * x - 0.3, 0.1 * y - 0.3, 1)) for x, y in itertools.product(range(7), range(7))]
    values = {}
    for plugin, sigma in itertools.product(("glints_direct", "glints_ibm"), (0.5, 0.2)):
        gaussian = support.bsdf(plugin, flakes_map, alpha=0.1, footprint_sigma=sigma, **GAUSSIAN)
        values[plugin, sigma] = np.array([support.value(gaussian, si, wo) for wo in wos])

    def distance(a, b):
        return np.abs(values[a] - values[b]).sum() / values[b].sum()

    for sigma in (0.5, 0.2):
        assert distance(("glints_ibm", sigma), ("glints_direct", sigma)) < 0.03
    assert distance(("glints_ibm", 0.2), ("glints_direct", 0.5)) > 0.1


def test_the_box_is_the_default(flakes_map):
    default = support.bsdf("glints_direct", flakes_map, alpha=0.1)
    si, wo = vertex("texels", "steep"), support.unit((0.1, -0.2, 1))
    for plugin in ("glints_direct", "glints_ibm"):
        box = support.bsdf(plugin, flakes_map, alpha=0.1, footprint_filter="box")
        assert support.value(box, si, wo) == pytest.approx(support.value(default, si, wo), rel=0.05)
    gaussian = support.bsdf("glints_direct", flakes_map, alpha=0.1, **GAUSSIAN)
    half = support.bsdf("glints_direct", flakes_map, alpha=0.1, footprint_sigma=0.5, **GAUSSIAN)
    assert support.value(half, si, wo) == support.value(gaussian, si, wo) != support.value(default, si, wo)


@pytest.mark.parametrize(
    "plugin, parameters, fragments",
    [
        ("glints_direct", {"footprint_filter": "tent"}, ["footprint_filter", "tent", "box", "gaussian"]),
        ("glints_direct", {"footprint_sigma": 0.3}, ["footprint_sigma", 'footprint_filter="gaussian"']),
        ("glints_direct", {"footprint_sigma": 5.0, **GAUSSIAN}, ["footprint_sigma", "[0.05, 4]"]),
        ("glints_direct", {"footprint_sigma": float("nan"), **GAUSSIAN}, ["footprint_sigma", "[0.05, 4]"]),
        ("glints_ibm", {"structure": "paper", **GAUSSIAN}, ["footprint_filter", "equal weight", "glints_direct"]),
        ("glints_ibm", {"bins": 63, **GAUSSIAN}, ["footprint_filter", "equal weight", "compact"]),
        ("glints_ibm", {"alpha": 0.0, "bins": 63, **GAUSSIAN}, ["footprint_filter", "equal weight", "glints_direct"]),
        ("glints_ibm", {"footprint_sigma": 5.0, **GAUSSIAN}, ["footprint_sigma", "[0.05, 4]"]),
        ("glints_unfiltered", GAUSSIAN, ["footprint_filter"]),
        ("glints_unfiltered", {"footprint_sigma": 0.5}, ["footprint_sigma"]),
        ("glints_yan16", GAUSSIAN, ["footprint_filter"]),
        ("glints_carpaint", GAUSSIAN, ["footprint_filter"]),
    ],
    ids=str,
)
def test_bad_filters(flakes_map, plugin, parameters, fragments):
    assert_mentions(message_of(lambda: support.bsdf(plugin, flakes_map, **parameters)), plugin, *fragments)
