"""`distribution`: the microfacets of a flake, Beckmann or GGX, through the loaded plugins.

Integrals run over the cells of half vectors of `test_distribution`.
"""

import mitsuba as mi
import numpy as np
import pytest
import support
from test_distribution import CONTEXT, albedo, bins_per_side, chi_square, draw_cells, integrate_cells, vertex
from test_errors import assert_mentions, message_of

SIDE = 24
WITH_FLAKES = ("glints_ibm", "glints_direct", "glints_unfiltered")
ALPHA = 0.12


@pytest.fixture(scope="module")
def flakes_map(tmp_path_factory):
    normals = support.random_normals(SIDE, SIDE, 0.25, seed=6)
    return support.write_exr(tmp_path_factory.mktemp("maps") / "flakes.exr", normals)


def ggx_term(alpha, wi, wo, t):
    """D(h, t) G1(i, t) G1(o, t) of Walter et al. 2007, Eq. 33 and 34, in double precision."""
    cos = support.unit(wi + wo) @ t
    d = 1 / (np.pi * alpha**2 * (cos**2 + (1 - cos**2) / alpha**2) ** 2)
    cosines = np.array([wi @ t, wo @ t])
    if min(cosines.min(), cos) <= 0:
        return 0.0
    return d * np.prod(2 / (1 + np.sqrt(1 + alpha**2 * (1 / cosines**2 - 1))))


def test_direct_sum_of_ggx_flakes(make_map):
    """Over whole periods every texel has the same weight; also half vectors far from all normals have their share."""
    normals = support.random_normals(6, 5, 0.2, seed=9)
    path = make_map(normals)
    ggx, beckmann = (
        support.bsdf("glints_direct", path, alpha=0.1, masking="none", distribution=name)
        for name in ("ggx", "beckmann")
    )
    rng = np.random.default_rng(3)
    for _ in range(30):
        wi, wo = support.random_direction(rng), support.random_direction(rng)
        si = support.interaction((0.4, 0.6), wi, (2, 0), (0, 3))
        terms = [ggx_term(0.1, wi, wo, t) / t[2] for t in normals.reshape(-1, 3).astype(float)]
        expected = np.mean(terms) / (4 * wi[2])
        assert support.value(ggx, si, wo) == pytest.approx(expected, rel=1e-3)
        assert support.value(beckmann, si, wo) != pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("plugin", WITH_FLAKES)
def test_samples_of_ggx_flakes_have_the_density_of_pdf(flakes_map, plugin):
    ggx, beckmann = (support.bsdf(plugin, flakes_map, alpha=ALPHA, distribution=name) for name in ("ggx", "beckmann"))
    si, bins = vertex("texels", "steep"), bins_per_side(ALPHA)
    probabilities = integrate_cells(si, bins, lambda wo: ggx.pdf(CONTEXT, si, mi.Vector3f(*wo)))
    probabilities = np.append(probabilities, max(0.0, 1 - probabilities.sum()))
    counts, weights = draw_cells(ggx, si, bins, 30_000, np.random.default_rng(1))
    assert chi_square(counts, probabilities) > 1e-4 / len(WITH_FLAKES)
    # The broken twin: samples of Beckmann flakes.
    others, _ = draw_cells(beckmann, si, bins, 30_000, np.random.default_rng(1))
    assert chi_square(others, probabilities) < 1e-12
    # What sampling estimates is the integral of eval.
    integral = albedo(ggx, si, bins)
    assert abs(weights.mean() - integral) < 5 * weights.std() / np.sqrt(len(weights)) + 1e-3


@pytest.mark.parametrize("plugin", ["glints_ibm", "glints_direct"])
def test_white_furnace_of_ggx_flakes(flakes_map, plugin):
    """Nothing is gained; what the bins cut off of the tails, a sixth of the energy, is put back."""
    bsdf = support.bsdf(plugin, flakes_map, alpha=ALPHA, distribution="ggx")
    for direction, least in (("steep", 0.95), ("oblique", 0.85)):
        si = vertex("tiles", direction)
        found = albedo(bsdf, si, bins_per_side(ALPHA))
        assert least < found < 1.005, f"{direction}: {found}"


@pytest.mark.parametrize("plugin", support.BSDFS)
def test_beckmann_is_the_default(flakes_map, plugin):
    default = support.bsdf(plugin, flakes_map, alpha=0.1)
    explicit = support.bsdf(plugin, flakes_map, alpha=0.1, distribution="beckmann")
    assert "distribution = beckmann" in str(default)
    si, wo = vertex("texels", "steep"), support.unit((0.1, -0.2, 1))
    assert support.value(default, si, wo) == support.value(explicit, si, wo) > 0


@pytest.mark.parametrize("plugin", WITH_FLAKES)
def test_the_distribution_is_shown(flakes_map, plugin):
    assert "distribution = ggx" in str(support.bsdf(plugin, flakes_map, distribution="ggx"))


@pytest.mark.parametrize("plugin", support.BSDFS)
def test_unknown_distributions_are_refused(flakes_map, plugin):
    message = message_of(lambda: support.bsdf(plugin, flakes_map, distribution="phong"))
    assert_mentions(message, plugin, "distribution", "phong", "beckmann", "ggx")


def test_gaussian_elements_refuse_ggx(flakes_map):
    message = message_of(lambda: support.bsdf("glints_yan16", flakes_map, distribution="ggx"))
    assert_mentions(message, "glints_yan16", "distribution", "ggx", "Gaussian", "beckmann")
