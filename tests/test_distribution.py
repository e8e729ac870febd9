"""Distributions through the loaded plugins: closed forms, chi-square tests of `sample` against `pdf`, white furnaces.

All integrals run over the projected half vector (a point of the unit disk) on a grid whose cells are the bins of `glints_ibm`: its
density jumps at the borders of bins and nowhere else, so that Gauss-Legendre quadrature inside a cell is exact to many digits, where
a grid over the outgoing direction would under-integrate such spiky densities. A solid angle of outgoing directions is
`4 (wo . h) / h.z` times the area on that disk.
"""

import mitsuba as mi
import numpy as np
import pytest
import support
from scipy import stats

SIDE = 24  # texels of the test map's sides
CONTEXT = mi.BSDFContext()

# Footprints in uv: a point, smaller than a texel, some texels (turned), more than the whole map.
FOOTPRINTS = {
    "point": ((0, 0), (0, 0)),
    "subtexel": ((0.3 / SIDE, 0.1 / SIDE), (-0.1 / SIDE, 0.4 / SIDE)),
    "texels": ((4.2 / SIDE, 1.9 / SIDE), (-0.9 / SIDE, 2.3 / SIDE)),
    "tiles": ((1.7, 0.3), (-0.2, 1.1)),
}
DIRECTIONS = {"steep": (0.1, 0.05, 1), "oblique": (-0.6, 0.5, 0.6), "grazing": (0.9, -0.3, 0.25)}


def bins_per_side(alpha):
    """Table 4 of the 2021 paper: floor(5 / sin(theta_0))."""
    tan = 3 * alpha / np.sqrt(2)
    return int(5 / (tan / np.sqrt(1 + tan * tan)))


@pytest.fixture(scope="module")
def wavy_map(tmp_path_factory):
    normals = support.random_normals(SIDE, SIDE, 0.25, seed=4)
    return support.write_exr(tmp_path_factory.mktemp("maps") / "wavy.exr", normals)


@pytest.fixture(scope="module")
def smooth_map(tmp_path_factory):
    """One period of a wave along u and v: the normal turns by 0.1 from texel to texel."""
    u, v = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    slopes = [0.4 * np.sin(2 * np.pi * u / SIDE + 1), 0.4 * np.cos(2 * np.pi * (u + v) / SIDE)]
    normals = support.unit(np.stack([*slopes, np.ones_like(u)], -1))
    return support.write_exr(tmp_path_factory.mktemp("maps") / "smooth.exr", normals)


def vertex(footprint, direction):
    duv_dx, duv_dy = FOOTPRINTS[footprint]
    return support.interaction((0.31, 0.77), DIRECTIONS[direction], duv_dx, duv_dy)


def reflected(si, x, y):
    """The outgoing direction for the half vector (x, y) and the Jacobian d wo / d(x, y), or None below a horizon."""
    z2 = 1 - x * x - y * y
    if z2 <= 1e-9:
        return None
    h = np.array([x, y, np.sqrt(z2)])
    wi = np.array([si.wi.x, si.wi.y, si.wi.z])
    cos = wi @ h
    wo = 2 * cos * h - wi
    if cos <= 0 or wo[2] <= 0:
        return None
    return wo / np.linalg.norm(wo), 4 * cos / h[2]


def cell_points(bins):
    """Quadrature points of each cell: centres `(bins^2, 2)`, offsets `(points, 2)` and weights `(points,)`."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    offsets = np.stack(np.meshgrid(nodes, nodes), -1).reshape(-1, 2) / bins
    area = np.outer(weights, weights).ravel() / bins**2
    centers = (2 * (np.arange(bins) + 0.5) / bins) - 1
    return np.stack(np.meshgrid(centers, centers), -1).reshape(-1, 2), offsets, area


def integrate_cells(si, bins, density):
    """The integral of `density(wo)` over the outgoing directions of each cell of half vectors, row by row."""
    centers, offsets, area = cell_points(bins)
    integrals = np.zeros(len(centers))
    for cell, center in enumerate(centers):
        found = [reflected(si, *(center + offset)) for offset in offsets]
        if all(found):
            integrals[cell] = sum(a * f[1] * density(f[0]) for a, f in zip(area, found))
        elif any(found):
            integrals[cell] = integrate_cut_cell(si, center, bins, density)
    return integrals


def albedo(bsdf, si, bins):
    """The integral of `eval` over the hemisphere."""
    return integrate_cells(si, bins, lambda wo: bsdf.eval(CONTEXT, si, mi.Vector3f(*wo))[0]).sum()


def integrate_cut_cell(si, center, bins, density, side=24):
    """Midpoint rule for a cell that a horizon cuts."""
    steps = (2 * (np.arange(side) + 0.5) / side - 1) / bins
    found = (reflected(si, center[0] + x, center[1] + y) for x in steps for y in steps)
    return sum(f[1] * density(f[0]) for f in found if f) * (2 / bins / side) ** 2


def draw_cells(bsdf, si, bins, count, rng):
    """How many of `count` samples fall into each cell, with the failed ones last, and the samples' weights."""
    counts = np.zeros(bins * bins + 1)
    weights = np.zeros(count)
    wi = np.array([si.wi.x, si.wi.y, si.wi.z])
    uniforms = rng.random((count, 3))
    for i, (u1, u2, u3) in enumerate(uniforms):
        bs, weight = bsdf.sample(CONTEXT, si, u1, [u2, u3])
        if bs.pdf == 0:
            counts[-1] += 1
            continue
        h = support.unit(wi + np.array([bs.wo.x, bs.wo.y, bs.wo.z]))
        column, row = np.minimum((bins * (0.5 * h[:2] + 0.5)).astype(int), bins - 1)
        counts[row * bins + column] += 1
        weights[i] = weight[0]
    return counts, weights


def chi_square(counts, probabilities):
    """p-value of Pearson's test; cells of fewer than ten expected samples are pooled, for the statistic's own sake."""
    expected = probabilities * counts.sum()
    order = np.argsort(expected)
    small = np.searchsorted(np.cumsum(expected[order]), 10) + 1
    pooled = [array[order] for array in (counts, expected)]
    observed, expected = (np.append(array[small:], array[:small].sum()) for array in pooled)
    keep = expected >= 10
    observed = np.append(observed[keep], observed[~keep].sum())
    expected = np.append(expected[keep], expected[~keep].sum())
    if expected[-1] < 1e-6:
        assert observed[-1] == 0, "samples where the density is zero"
        observed, expected = observed[:-1], expected[:-1]
    return stats.chi2.sf(np.sum((observed - expected) ** 2 / expected), len(observed) - 1)


PLACES = [
    ("point", "oblique"),
    ("subtexel", "steep"),
    ("texels", "steep"),
    ("texels", "grazing"),
    ("tiles", "oblique"),
]
CASES = [(plugin, 0.16, *place) for plugin in support.FILTERED for place in PLACES]
CASES += [(plugin, 0.07, "texels", "steep") for plugin in support.BSDFS]


@pytest.mark.parametrize(("plugin", "alpha", "footprint", "direction"), CASES)
def test_sample_has_the_density_of_pdf(wavy_map, plugin, alpha, footprint, direction):
    bsdf = support.bsdf(plugin, wavy_map, alpha=alpha)
    si, bins = vertex(footprint, direction), bins_per_side(alpha)
    probabilities = integrate_cells(si, bins, lambda wo: bsdf.pdf(CONTEXT, si, mi.Vector3f(*wo)))
    probabilities = np.append(probabilities, max(0.0, 1 - probabilities.sum()))
    counts, weights = draw_cells(bsdf, si, bins, 40_000, np.random.default_rng(1))
    # One case in ten thousand fails by chance; the seed is fixed.
    assert chi_square(counts, probabilities) > 1e-4 / len(CASES)
    # The broken twin: a density that is off by a factor linear in the half vector is told apart.
    if direction == "grazing":
        centers, _, _ = cell_points(bins)
        tilted = probabilities[:-1] * (1 + 0.3 * centers[:, 0])
        twin = np.append(tilted, max(0.0, 1 - tilted.sum()))
        assert chi_square(counts, twin / twin.sum()) < 1e-12
    # The furnace: what sampling estimates is the integral of eval, and no more comes out than went in.
    estimate, error = weights.mean(), weights.std() / np.sqrt(len(weights))
    integral = albedo(bsdf, si, bins)
    assert abs(estimate - integral) < 5 * error + 1e-3
    if footprint == "tiles":
        assert 0.75 < integral < 1.005


@pytest.mark.parametrize("footprint", ["subtexel", "texels"])
def test_curved_elements_sample_the_density_of_pdf(smooth_map, footprint):
    bsdf = support.bsdf("glints_yan16", smooth_map, elements="curved", intrinsic=0.05)
    si, bins = vertex(footprint, "oblique"), 40
    probabilities = integrate_cells(si, bins, lambda wo: bsdf.pdf(CONTEXT, si, mi.Vector3f(*wo)))
    probabilities = np.append(probabilities, max(0.0, 1 - probabilities.sum()))
    counts, _ = draw_cells(bsdf, si, bins, 40_000, np.random.default_rng(2))
    assert chi_square(counts, probabilities) > 1e-4
    flat = support.bsdf("glints_yan16", smooth_map, intrinsic=0.05)
    others, _ = draw_cells(flat, si, bins, 40_000, np.random.default_rng(2))
    # Flat elements are another distribution: the twin that has to fail.
    assert chi_square(others, probabilities) < 1e-12


@pytest.mark.parametrize("plugin", support.FILTERED)
@pytest.mark.parametrize("masking", ["none", "beckmann"])
def test_white_furnace(wavy_map, plugin, masking):
    """Over the whole map nothing is gained at any angle, and near the normal next to nothing is lost."""
    bsdf = support.bsdf(plugin, wavy_map, alpha=0.1, masking=masking)
    for direction, least in (("steep", 0.97), ("oblique", 0.9), ("grazing", 0.6)):
        si = vertex("tiles", direction)
        found = albedo(bsdf, si, bins_per_side(0.1))
        # Without masking, texels that face the viewer at grazing angles show more area than there is.
        assert least < found < (1.005 if masking == "beckmann" else 1.3), f"{direction}: {found}"


@pytest.mark.parametrize("plugin", support.FILTERED)
@pytest.mark.parametrize("footprint", FOOTPRINTS)
def test_distribution_of_normals_integrates_to_one(wavy_map, plugin, footprint):
    """At normal incidence, without masking and with tiny flakes' shadowing, eval is D (wi . n) / (4 (wi . n)) up to G1."""
    bsdf = support.bsdf(plugin, wavy_map, alpha=0.08, masking="none")
    si = support.interaction((0.31, 0.77), (0, 0, 1), *FOOTPRINTS[footprint])
    # eval = D G1 G1 / 4, and d wo = 4 (wo . h) / h.z dA with wo . h = h.z at normal incidence: the sum is that of D dA, G1 being one.
    integral = albedo(bsdf, si, bins_per_side(0.08))
    assert abs(integral - 1) < 0.005


def naive_g1(alpha, cos):
    a = cos / (alpha * np.sqrt(max(1e-20, 1 - cos * cos)))
    return 1.0 if a >= 1.6 else (3.535 * a + 2.181 * a * a) / (1 + 2.276 * a + 2.577 * a * a)


def naive_term(alpha, wi, wo, t):
    """D^alpha(h, t) G1(i, t) G1(o, t) in double precision."""
    h = support.unit(wi + wo)
    cos = h @ t
    d = np.exp((1 - 1 / cos**2) / alpha**2) / (np.pi * alpha**2 * cos**4)
    return d * naive_g1(alpha, wi @ t) * naive_g1(alpha, wo @ t) if min(wi @ t, wo @ t, cos) > 0 else 0.0


@pytest.mark.parametrize("normalization", ["projected", "paper"])
def test_direct_sum_is_equation_11(make_map, normalization):
    """An axis-aligned footprint of 2.5 x 1.25 texels: weights are products of overlaps that one can write down."""
    normals = support.random_normals(8, 4, 0.2, seed=9)
    alpha = 0.25
    bsdf = support.bsdf("glints_direct", make_map(normals), alpha=alpha, masking="none", normalization=normalization)
    # Columns 1.75 to 4.25, rows 3.25 to 4.5: the lower one is row 0 of the next tile.
    columns, rows = {1: 0.25, 2: 1, 3: 1, 4: 0.25}, {3: 0.75, 0: 0.5}
    wi, wo = support.unit([0.3, -0.4, 0.8]), support.unit([-0.1, 0.2, 0.9])
    si = support.interaction((3 / 8, 3.875 / 4), wi, (2.5 / 8, 0), (0, 1.25 / 4))
    expected = 0.0
    for column, dx in columns.items():
        for row, dy in rows.items():
            t = normals[row, column].astype(float)
            share = dx * dy / 3.125 / (t[2] if normalization == "projected" else 1)
            expected += share * naive_term(alpha, wi, wo, t) / (4 * wi[2])
    assert support.value(bsdf, si, wo) == pytest.approx(expected, rel=1e-4)


def test_unfiltered_is_equation_5_at_the_texel(make_map):
    normals = support.random_normals(8, 4, 0.2, seed=10)
    bsdf = support.bsdf("glints_unfiltered", make_map(normals), alpha=0.3, masking="none")
    rng = np.random.default_rng(2)
    for _ in range(50):
        u, v = rng.uniform(-2, 2, 2)
        wi, wo = support.random_direction(rng), support.random_direction(rng)
        t = normals[int(np.floor(4 * v)) % 4, int(np.floor(8 * u)) % 8].astype(float)
        expected = naive_term(0.3, wi, wo, t) / (4 * t[2] * wi[2])
        si = support.interaction((u, v), wi, (0.4, 0), (0, 0.4))
        assert support.value(bsdf, si, wo) == pytest.approx(expected, rel=2e-4, abs=1e-6)


def test_unfiltered_agrees_with_stock_normal_mapping_on_a_gentle_map(make_map):
    """Stock `normalmap` has the cosine at the perturbed normal instead of the projected area: the same for small slopes."""
    normals = support.random_normals(16, 16, 0.003, seed=11)
    ours = support.bsdf("glints_unfiltered", make_map(normals), alpha=0.2, masking="none", material="Cu")
    encoded = make_map(0.5 * (normals + 1), "encoded.exr")
    texture = {"type": "bitmap", "filename": encoded, "raw": True, "filter_type": "nearest"}
    metal = {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.2, "material": "Cu"}
    stock = mi.load_dict(
        {
            "type": "normalmap",
            "normalmap": texture,
            "bsdf": metal,
            "use_shadowing_function": False,
            "flip_invalid_normals": False,
        }
    )
    rng = np.random.default_rng(3)
    for _ in range(100):
        wi = support.random_direction(rng, 1.0)
        h = support.unit([*rng.normal(scale=0.1, size=2), 1])
        wo = 2 * (wi @ h) * h - wi
        if wo[2] < 0.3:
            continue
        si = support.interaction(rng.random(2), wi)
        si.sh_frame.n = si.n = [0, 0, 1]
        si.dp_du, si.dp_dv = [1, 0, 0], [0, 1, 0]
        si.initialize_sh_frame()
        expected = np.array(stock.eval(CONTEXT, si, mi.Vector3f(*wo)))
        found = np.array(ours.eval(CONTEXT, si, mi.Vector3f(*wo)))
        np.testing.assert_allclose(found, expected, rtol=0.04)
