"""`glints_ibm` with `alpha` = 0: mirrors as flakes, filtered over the bin of the half vector (the talk of 2020)."""

import mitsuba as mi
import numpy as np
import pytest
import support
from test_distribution import CONTEXT, chi_square, vertex
from test_errors import assert_mentions, message_of

SIDE = 24
BINS = 16


@pytest.fixture(scope="module")
def mirrors_map(tmp_path_factory):
    normals = support.random_normals(SIDE, SIDE, 0.35, seed=8)
    return support.write_exr(tmp_path_factory.mktemp("maps") / "mirrors.exr", normals)


def specular(path, bins=BINS, **parameters):
    return support.bsdf("glints_ibm", path, alpha=0.0, bins=bins, **parameters)


def projected_bin(normals, bins):
    return np.minimum((bins * (0.5 * normals[..., :2] + 0.5)).astype(int), bins - 1)


def projected_cell(bin, bins, steps=400):
    """Solid angle and projected solid angle of a projected bin, by the midpoint rule; for bins inside the disk."""
    x, y = ((2 * (index + (np.arange(steps) + 0.5) / steps) / bins - 1) for index in bin)
    z = np.sqrt(1 - x[:, None] ** 2 - y[None, :] ** 2)
    area = (2 / bins / steps) ** 2
    return np.sum(area / z), area * steps**2


@pytest.mark.parametrize("normalization", ["projected", "paper"])
def test_the_distribution_is_a_count_of_texels(make_map, normalization):
    """eval = D / (4 wi.z) with D = (share of the texels in the bin) / (its solid angle); no shadowing of flakes."""
    normals = support.random_normals(8, 8, 0.2, seed=2)
    path = make_map(normals)
    bsdf = specular(path, bins=10, binning="projected", masking="none", normalization=normalization)
    texel_bins = projected_bin(normals.reshape(-1, 3), 10)
    rng, found_some = np.random.default_rng(4), 0
    for _ in range(60):
        wi, wo = support.random_direction(rng, 0.9), support.random_direction(rng, 0.9)
        bin = projected_bin(support.unit(wi + wo), 10)
        solid_angle, projected = projected_cell(bin, 10)
        share = np.mean(np.all(texel_bins == bin, axis=1))
        expected = share / (projected if normalization == "projected" else solid_angle) / (4 * wi[2])
        si = support.interaction((0.4, 0.6), wi, (1, 0), (0, 2))
        assert support.value(bsdf, si, wo) == pytest.approx(expected, rel=1e-4)
        found_some += expected > 0
    assert found_some > 10


def on_square(binning, h):
    """The point of [-1, 1]^2 whose square cells are the bins, of unit vectors `(..., 3)`."""
    if binning == "projected":
        return h[..., :2]
    x, y = np.moveaxis(h[..., :2], -1, 0)
    radius, angle = np.sqrt(1 - h[..., 2]), np.arctan2(y, x)
    eighth = np.round(angle / (np.pi / 2))  # 0: along +x, 1: along +y, ...
    across = radius * (angle - eighth * np.pi / 2) * 4 / np.pi
    quarter = np.exp(0.5j * np.pi * eighth) * (radius + 1j * across)
    return np.stack([quarter.real, quarter.imag], -1)


def directions(binning, points):
    """Inverse of `on_square`, for points whose direction lies above the horizon."""
    if binning == "projected":
        return np.concatenate([points, np.sqrt(np.maximum(0, 1 - np.sum(points**2, -1, keepdims=True)))], -1)
    square = points[..., 0] + 1j * points[..., 1]
    turn = np.exp(0.5j * np.pi * np.round(np.angle(square) / (np.pi / 2)))
    straight = square / turn
    radius = straight.real
    disk = turn * radius * np.exp(0.25j * np.pi * straight.imag / np.maximum(radius, 1e-12))
    z = 1 - radius**2
    return np.stack([*(np.array([disk.real, disk.imag]) * np.sqrt(1 + z)), z], -1)


def reflections(si, h):
    wi = np.array([si.wi.x, si.wi.y, si.wi.z])
    return 2 * (h @ wi)[..., None] * h - wi, h @ wi


def integrate_bins(bsdf, si, binning, cells):
    """For each of the `cells^2` cells the integrals of `pdf` and `eval` over its half vectors; NaN for cells that a
    horizon cuts. Both are constant inside a bin up to the Jacobian, which the midpoint rule integrates."""
    steps = (np.arange(cells) + 0.5) * 2 / cells - 1
    centers = np.stack(np.meshgrid(steps, steps), -1)
    corners = [centers + np.array(offset) / cells for offset in ((-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0))]
    valid = np.ones((cells, cells), bool)
    for corner in corners:
        wo, cos = reflections(si, directions(binning, corner))
        valid &= (np.sum(corner**2, -1) < 0.999 if binning == "projected" else True) & (wo[..., 2] > 0) & (cos > 0)
    integrals = np.full((2, cells, cells), np.nan)
    for row, column in np.argwhere(valid):
        wo, cos = reflections(si, directions(binning, centers[row, column]))
        solid_angle = projected_cell((column, row), cells, 20)[0] if binning == "projected" else 2 * np.pi / cells**2
        value, pdf = bsdf.eval_pdf(CONTEXT, si, mi.Vector3f(*wo))
        integrals[:, row, column] = np.array([pdf, value[0]]) * 4 * cos * solid_angle
    return integrals


def draw_bins(bsdf, si, binning, cells, count):
    """The cells, row by row, of `count` samples' half vectors, -1 for failed ones, and the samples' weights."""
    found, weights = np.full(count, -1), np.zeros(count)
    wi = np.array([si.wi.x, si.wi.y, si.wi.z])
    for i, (u1, u2, u3) in enumerate(np.random.default_rng(1).random((count, 3))):
        bs, weight = bsdf.sample(CONTEXT, si, u1, [u2, u3])
        if bs.pdf > 0:
            h = support.unit(wi + np.array([bs.wo.x, bs.wo.y, bs.wo.z]))
            column, row = np.minimum((cells * (0.5 * on_square(binning, h) + 0.5)).astype(int), cells - 1)
            found[i], weights[i] = row * cells + column, weight[0]
    return found, weights


@pytest.mark.parametrize("binning", ["projected", "equal_solid_angle"])
@pytest.mark.parametrize(("footprint", "direction"), [("texels", "steep"), ("tiles", "oblique")])
def test_samples_have_the_density_of_pdf(mirrors_map, binning, footprint, direction):
    """Chi-square test over quarters of bins, so that samples have to be uniform inside a bin, too."""
    bsdf = specular(mirrors_map, binning=binning, masking="none")
    si, cells = vertex(footprint, direction), 2 * BINS
    pdf, value = integrate_bins(bsdf, si, binning, cells).reshape(2, -1)
    valid = np.isfinite(pdf)
    found, weights = draw_bins(bsdf, si, binning, cells, 30_000)
    inside = (found >= 0) & valid[found]

    def fits(density):
        probabilities = np.where(valid, density, 0)
        counts = np.bincount(found[inside], minlength=cells * cells)
        counts = np.append(counts, len(found) - counts.sum())
        return chi_square(counts, np.append(probabilities, 1 - probabilities.sum()))

    assert np.nansum(pdf) > 0.7
    assert fits(pdf) > 1e-4 / 4
    # The broken twin: a density that depends on the place in the square.
    tilted = pdf * (1 + 0.6 * np.tile(np.linspace(-1, 1, cells), cells))
    assert fits(tilted * np.nansum(pdf) / np.nansum(tilted)) < 1e-6
    # What sampling estimates is the integral of eval.
    estimates = weights * inside
    assert abs(estimates.mean() - np.nansum(value)) < 5 * estimates.std() / np.sqrt(len(found)) + 1e-3


@pytest.mark.parametrize("binning", ["projected", "equal_solid_angle"])
def test_white_furnace(mirrors_map, binning):
    """At normal incidence and without masking all is reflected, less what goes below the horizon; otherwise as much as
    nearly specular flakes reflect, summed up directly."""
    bsdf = specular(mirrors_map, bins=32, binning=binning, masking="none")
    si = support.interaction((0.3, 0.7), (0, 0, 1), (2, 0), (0, 3))
    below = np.mean(support.random_normals(SIDE, SIDE, 0.35, seed=8)[..., 2] ** 2 < 0.5)
    assert reflected_share(bsdf, si) == pytest.approx(1 - below, abs=0.01)
    masked = specular(mirrors_map, bins=32, binning=binning)
    rough = support.bsdf("glints_direct", mirrors_map, alpha=0.005)
    for direction in ("oblique", "grazing"):
        si = vertex("tiles", direction)
        found = reflected_share(masked, si)
        assert found == pytest.approx(reflected_share(rough, si, 5_000), abs=0.02)
        assert 0.5 < found < 1


def reflected_share(bsdf, si, count=20_000):
    return np.mean([bsdf.sample(CONTEXT, si, *u)[1][0] for u in lattice(count)])


def lattice(count):
    """Evenly spread uniform numbers, as `sample` takes them: one, and two."""
    u = (0.5 + np.arange(count)[:, None] * [0.8191725, 0.6710436, 0.5497005]) % 1
    return [(a, (b, c)) for a, b, c in u.tolist()]


def test_a_rendering_converges_to_the_unfiltered_one(mirrors_map):
    """A mirror smaller than a bin looks like the bin: under a wide light both are the same picture."""
    integrator = {"type": "glints_path", "footprint": "pixel"}
    pictures = []
    for bsdf in (
        {"type": "glints_ibm", "alpha": 0.0, "bins": 127},
        {"type": "glints_unfiltered", "alpha": 0.01},
    ):
        scene = support.plane_scene({**bsdf, "filename": mirrors_map, "masking": "none"}, integrator, 4, 256)
        pictures.append(np.array(mi.render(scene)))
    assert pictures[0].mean() == pytest.approx(pictures[1].mean(), rel=0.02)


def test_the_default_binning_is_the_talks(mirrors_map):
    default, talk, paper = (
        specular(mirrors_map, **given) for given in ({}, {"binning": "equal_solid_angle"}, {"binning": "projected"})
    )
    si, wo = vertex("tiles", "steep"), support.unit((0.2, -0.1, 1))
    values = [support.value(bsdf, si, wo) for bsdf in (default, talk, paper)]
    assert values[0] == values[1] > 0
    assert values[0] != values[2]
    assert "alpha = 0," in str(default) and f"bins = {BINS}" in str(default)


def test_projected_bins_are_the_default_of_rough_flakes(mirrors_map):
    default = support.bsdf("glints_ibm", mirrors_map, alpha=0.1, structure="paper")
    explicit = support.bsdf("glints_ibm", mirrors_map, alpha=0.1, binning="projected")
    si, wo = vertex("tiles", "steep"), support.unit((0.2, -0.1, 1))
    assert support.value(default, si, wo) == support.value(explicit, si, wo) > 0


@pytest.mark.parametrize(
    "parameters, fragments",
    [
        ({"alpha": 0.0}, ["bins", "alpha = 0", "127"]),
        ({"alpha": 0.0, "bins": 20_000}, ["bins", "16384"]),
        ({"alpha": 0.0, "bins": 31, "distribution": "ggx"}, ["distribution", "ggx", "alpha = 0"]),
        ({"alpha": 0.0, "bins": 31, "binning": "cube"}, ["binning", "cube", "projected", "equal_solid_angle"]),
        ({"alpha": 0.1, "binning": "equal_solid_angle"}, ["binning", "equal_solid_angle", "alpha = 0"]),
        ({"alpha": 1e-5}, ["alpha", "0.0001"]),
        ({"alpha": -0.1, "bins": 31}, ["alpha", "0.0001"]),
    ],
    ids=str,
)
def test_bad_parameters(mirrors_map, parameters, fragments):
    message = message_of(lambda: support.bsdf("glints_ibm", mirrors_map, **parameters))
    assert_mentions(message, "glints_ibm", *fragments)


@pytest.mark.parametrize("plugin", ["glints_yan16", "glints_direct", "glints_unfiltered"])
def test_other_methods_refuse_mirrors(mirrors_map, plugin):
    message = message_of(lambda: support.bsdf(plugin, mirrors_map, alpha=0.0))
    assert_mentions(message, plugin, "alpha", "0.0001")
