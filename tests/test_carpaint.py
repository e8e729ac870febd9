"""The car paint: its layers against closed forms, chi-square tests, furnaces, reciprocity, memory and bad input."""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import support
from scipy import stats

CONTEXT = mi.BSDFContext()
SIDE = 24  # texels of the test map's sides
ETA = 1.5
WHITE = {"flake_reflectance": 1.0, "base_color": 1.0}
FOOTPRINTS = {
    "point": ((0, 0), (0, 0)),
    "texels": ((4.2 / SIDE, 1.9 / SIDE), (-0.9 / SIDE, 2.3 / SIDE)),
    "tiles": ((1.7, 0.3), (-0.2, 1.1)),
}
DIRECTIONS = {"steep": (0.1, 0.05, 1), "oblique": (-0.6, 0.5, 0.6), "grazing": (0.9, -0.3, 0.15)}
GAP = (2.5 / SIDE, 2.5 / SIDE)  # uv in the corner of the mask that has no flakes


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """A normal map, and a mask of half of its texels with a corner of 6 x 6 texels without flakes."""
    folder = tmp_path_factory.mktemp("maps")
    mask = (np.random.default_rng(7).random((SIDE, SIDE, 1)) < 0.5).astype(np.uint8) * 255
    mask[:6, :6] = 0
    mi.Bitmap(mask).write(str(folder / "mask.png"))
    normals = support.random_normals(SIDE, SIDE, 0.1, seed=4)
    return support.write_exr(folder / "flakes.exr", normals), str(folder / "mask.png"), mask[..., 0] > 0


def paint(maps, masked=True, **parameters):
    return support.bsdf("glints_carpaint", maps[0], **{"mask": maps[1]} if masked else {}, **parameters)


def vertex(footprint, direction, uv=(0.61, 0.77)):
    duv_dx, duv_dy = FOOTPRINTS[footprint]
    return support.interaction(uv, DIRECTIONS[direction], duv_dx, duv_dy)


def to_direction(square):
    """Points of the unit square to directions, with equal solid angles 2 pi; shape `(..., 2)` to `(..., 3)`."""
    z, phi = square[..., 0], 2 * np.pi * square[..., 1]
    sin = np.sqrt(1 - z * z)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], -1)


def integrate(function, rows=16, columns=32, order=6):
    """Integral of `function(wo)` over the solid angle of each cell of a grid over the hemisphere, `(rows * columns, ...)`."""
    nodes, weights = np.polynomial.legendre.leggauss(order)
    offset = np.stack(np.meshgrid(nodes, nodes, indexing="ij"), -1).reshape(-1, 2) / 2 + 0.5
    weight = np.outer(weights, weights).ravel() / 4 * 2 * np.pi / (rows * columns)
    cells = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1).reshape(-1, 1, 2)
    directions = to_direction((cells + offset) / [rows, columns])
    values = np.array([[function(mi.Vector3f(*wo)) for wo in cell] for cell in directions])
    return np.einsum("cp...,p->c...", values, weight)


def fresnel(cos):
    return float(mi.fresnel(float(cos), ETA)[0])


def total_reflectance(bsdf, si):
    """Everything that comes back in a furnace, first channel."""
    smooth = sum(integrate(lambda wo: bsdf.eval(CONTEXT, si, wo)[0], order=4))
    return smooth + (fresnel(si.wi.z) if is_clear(bsdf) else 0)


def is_clear(bsdf):
    return bool(bsdf.flags(0) & +mi.BSDFFlags.DeltaReflection)


LAYERS = {"diffuse": {"base_color": 0.6}, "glossy": {"base_color": 0.2, "base_specular": 0.7, "base_roughness": 0.3}}
CASES = [
    ("diffuse", 0.0, "texels", "oblique"),
    ("glossy", 0.2, "texels", "oblique"),
    ("glossy", 0.0, "tiles", "steep"),
    ("diffuse", 0.2, "tiles", "grazing"),
]


@pytest.mark.parametrize(("layers", "coat", "footprint", "direction"), CASES)
def test_sample_has_the_density_of_pdf(maps, layers, coat, footprint, direction):
    bsdf = paint(maps, alpha=0.1, coat_roughness=coat, **LAYERS[layers])
    si, rows, columns = vertex(footprint, direction), 16, 32
    # The last two: the mirror reflection of a clear coat, and draws that fail.
    pdf, value = integrate(lambda wo: (bsdf.pdf(CONTEXT, si, wo), bsdf.eval(CONTEXT, si, wo)[0])).T
    counts, weights = np.zeros(rows * columns + 1), []
    mirrored = 0
    for u in np.random.default_rng(1).random((40_000, 3)):
        bs, weight = bsdf.sample(CONTEXT, si, u[0], u[1:])
        weights.append(weight[0])
        if bs.pdf == 0:
            counts[-1] += 1
        elif bs.sampled_type == +mi.BSDFFlags.DeltaReflection:
            mirrored += 1
            assert weight[0] * bs.pdf == pytest.approx(fresnel(si.wi.z), rel=1e-4)
        else:
            row = min(int(bs.wo.z * rows), rows - 1)
            column = int(np.arctan2(bs.wo.y, bs.wo.x) / (2 * np.pi) % 1 * columns) % columns
            counts[row * columns + column] += 1
            assert bs.pdf == pytest.approx(bsdf.pdf(CONTEXT, si, bs.wo), rel=1e-4)
    assert (mirrored > 0) == is_clear(bsdf)
    total = len(weights) - mirrored
    probability = np.append(pdf, max(0.0, 1 - mirrored / len(weights) - pdf.sum())) * len(weights) / total
    assert chi_square(counts, probability) > 1e-4
    # The broken twin: a density that changes by half around the azimuth.
    tilted = probability * np.append(0.75 + 0.5 * (np.arange(rows * columns) % columns) / columns, 1)
    assert chi_square(counts, tilted / tilted.sum()) < 1e-8
    mean, error = np.mean(weights), np.std(weights) / np.sqrt(len(weights))
    expected = value.sum() + (fresnel(si.wi.z) if is_clear(bsdf) else 0)
    assert abs(mean - expected) < 4.5 * error + 2e-3


def chi_square(counts, probability):
    """p-value of Pearson's test, cells of fewer than ten expected samples pooled."""
    expected = probability / probability.sum() * counts.sum()
    small = expected < 10
    observed = np.append(counts[~small], counts[small].sum())
    expected = np.append(expected[~small], expected[small].sum())
    keep = expected > 1e-3
    return stats.chi2.sf((((observed - expected) ** 2)[keep] / expected[keep]).sum(), keep.sum() - 1)


@pytest.mark.parametrize("coat", [0.0, 0.2])
def test_a_white_base_in_a_gap_returns_everything(maps, coat):
    bsdf = paint(maps, coat_roughness=coat, **WHITE)
    for direction in DIRECTIONS:
        assert total_reflectance(bsdf, vertex("point", direction, GAP)) == pytest.approx(1, abs=0.006), direction


@pytest.mark.parametrize("base", [{}, {"base_specular": 1.0}])
def test_white_furnace(maps, base):
    for coat in (0.0, 0.2):
        for masked in (True, False):
            bsdf = paint(maps, masked, alpha=0.1, coat_roughness=coat, **WHITE, **base)
            for direction in DIRECTIONS:
                found = total_reflectance(bsdf, vertex("tiles", direction))
                assert 0.5 < found < 1.003, (coat, masked, direction, found)


def test_a_flat_flake_is_a_microfacet_under_refraction(make_map):
    """T T / eta^2 times the rough mirror at the refracted directions, written down in double precision."""
    alpha = 0.1
    flat = np.broadcast_to(np.array([0, 0, 1], np.float32), (4, 4, 3))
    # An odd number of bins: the flake's bin has its centre at the pole.
    parameters = {"encoding": "signed", "alpha": alpha, "bins": 23, "masking": "none", "flake_reflectance": 0.5}
    bsdf = support.bsdf("glints_carpaint", make_map(flat), **parameters)
    rng = np.random.default_rng(5)
    for _ in range(50):
        wi = support.random_direction(rng)
        wo = support.unit(wi * [-1, -1, 1] + rng.normal(scale=0.05, size=3))
        if wo[2] < 0.1:
            continue
        inside = [np.append(w[:2] / ETA, np.sqrt(1 - (w[:2] @ w[:2]) / ETA**2)) for w in (wi, wo)]
        cos = support.unit(inside[0] + inside[1])[2]
        d = np.exp((1 - 1 / cos**2) / alpha**2) / (np.pi * alpha**2 * cos**4)
        transmitted = (1 - fresnel(wi[2])) * (1 - fresnel(wo[2])) / ETA**2
        expected = 0.5 * transmitted * d / (4 * inside[0][2] * inside[1][2]) * wo[2]
        assert support.value(bsdf, support.interaction((0.4, 0.3), wi), wo) == pytest.approx(expected, rel=0.03)


def test_values_are_reciprocal(maps):
    bsdf = paint(maps, alpha=0.1, coat_roughness=0.2, base_specular=0.5, gtr_gamma=1.5, gtr_alpha=0.1)
    rng = np.random.default_rng(3)
    for _ in range(50):
        a, b = support.random_direction(rng, 1.4), support.random_direction(rng, 1.4)
        footprint = FOOTPRINTS["texels"]
        forward = support.value(bsdf, support.interaction((0.6, 0.7), a, *footprint), b) / b[2]
        backward = support.value(bsdf, support.interaction((0.6, 0.7), b, *footprint), a) / a[2]
        assert forward == pytest.approx(backward, rel=1e-3)


def test_components_add_up(maps):
    bsdf = paint(maps, alpha=0.1, coat_roughness=0.2, base_specular=0.5)
    assert bsdf.component_count() == 4
    assert all(bsdf.flags(i) & support.NEEDS_DIFFERENTIALS for i in range(4))
    si, wo = vertex("texels", "steep"), mi.Vector3f(*support.unit([-0.1, 0.1, 1]))
    parts = []
    for i in range(4):
        context = mi.BSDFContext()
        context.component = i
        parts.append(bsdf.eval(context, si, wo)[0])
        for u in np.random.default_rng(i).random((50, 3)):
            bs, _ = bsdf.sample(context, si, u[0], u[1:])
            assert bs.pdf == 0 or bs.sampled_component == i
            if bs.pdf > 0:
                assert bs.pdf == pytest.approx(bsdf.pdf(context, si, bs.wo), rel=1e-4)
    assert min(parts) > 0
    assert sum(parts) == pytest.approx(bsdf.eval(CONTEXT, si, wo)[0], rel=1e-5)


def test_gaps_show_the_base_alone(maps):
    """Flakes everywhere, flakes by the mask, in a gap: the cover scales the base, and a gap has no flake."""
    si, wo = vertex("point", "steep", GAP), mi.Vector3f(0, 0, 1)
    context = mi.BSDFContext()
    for component, in_gap in ((1, False), (2, True)):
        context.component = component
        assert (paint(maps, alpha=0.1).eval(context, si, wo)[0] > 0) == in_gap
        assert (paint(maps, masked=False, alpha=0.1).eval(context, si, wo)[0] > 0) != in_gap
    whole = support.interaction((0.5, 0.5), (0, 0, 1), (1, 0), (0, 1))
    context.component = 2
    bsdf = paint(maps, alpha=0.1, flake_reflectance=0.0, base_color=0.01)  # next to no light goes back and forth
    expected = (1 - maps[2].mean()) * bsdf.eval(context, si, wo)[0]
    assert bsdf.eval(context, whole, wo)[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("coat", [0.0, 0.2])
def test_emitter_sampling_and_bsdf_sampling_agree(maps, coat):
    """The same image whoever draws the direction, under a sky that is brighter on one side."""
    bright = np.full((8, 16, 3), 0.2, np.float32)
    bright[:4, 3:7] = 5
    light = {"type": "envmap", "bitmap": mi.Bitmap(bright)}
    bsdf = paint(maps, alpha=0.1, coat_roughness=coat, **LAYERS["glossy"])
    # Only BSDF sampling sees the mirror reflection of a clear coat: one sample of that, and its weight by MIS.
    extra = 1 if coat == 0.0 else 0

    def render(emitter_samples, bsdf_samples):
        integrator = {"type": "direct", "emitter_samples": emitter_samples, "bsdf_samples": bsdf_samples}
        scene = support.plane_scene(bsdf, integrator, 8, 64, light)
        means = [np.array(mi.render(scene, seed=seed)).mean() for seed in range(6)]
        return np.mean(means), np.var(means, ddof=1) / len(means)

    (a, a_variance), (b, b_variance) = render(16, extra), render(extra, 16)
    assert abs(a - b) < 5 * np.sqrt(a_variance + b_variance)
    assert np.sqrt(a_variance + b_variance) < 0.02 * b


@pytest.mark.parametrize("component", [1, 3])
def test_a_footprint_is_the_mean_of_its_points(maps, component):
    """Flakes and the base in their gaps, over a parallelogram of some 8 texels, from 60 x 60 points of it."""
    context = mi.BSDFContext()
    context.component = component
    bsdf = paint(maps, alpha=0.1, **LAYERS["glossy"])
    wo = mi.Vector3f(*support.unit([-0.1, 0.1, 1]))
    (a, b), center = np.array(FOOTPRINTS["texels"]), np.array([0.61, 0.77])
    points = (np.arange(60) + 0.5) / 60 - 0.5
    values = [
        bsdf.eval(context, support.interaction(center + s * a + t * b, DIRECTIONS["steep"]), wo)[0]
        for s in points
        for t in points
    ]
    assert np.std(values) > 0.5 * np.mean(values)
    assert bsdf.eval(context, vertex("texels", "steep"), wo)[0] == pytest.approx(np.mean(values), rel=0.02)


@pytest.mark.parametrize("variant", ["scalar_spectral", "scalar_spectral_polarized"])
def test_other_variants(maps, variant):
    def answer():
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.uv, si.duv_dx, si.duv_dy = (0.6, 0.7), (0.2, 0), (0, 0.2)
        si.wi = mi.ScalarVector3f(0, 0, 1)
        if "spectral" in mi.variant():
            si.wavelengths = [450, 500, 550, 600]
        bsdf = paint(maps, alpha=0.1)
        value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))
        return float(np.array(value).ravel()[0])

    reference = answer()
    mi.set_variant(variant)
    assert answer() == pytest.approx(reference, rel=1e-3)


def structure_bytes(bsdf):
    return int(re.search(r"structure_bytes = (\d+)", str(bsdf)).group(1))


def test_the_report_counts_the_mip_map(make_map, tmp_path):
    normals = support.random_normals(256, 256, 0.1)
    mi.Bitmap(np.full((256, 256, 1), 255, np.uint8)).write(str(tmp_path / "mask.png"))
    filename = make_map(normals)
    without = support.bsdf("glints_carpaint", filename)
    masked = support.bsdf("glints_carpaint", filename, mask=str(tmp_path / "mask.png"))
    pyramid = sum(4**level for level in range(9))
    assert structure_bytes(masked) - structure_bytes(without) == pyramid
    assert "mask.png" in str(masked)


# ---- bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "parameters, fragments",
    [
        ({"mask": "nowhere.png"}, ("nowhere.png", "check the path")),
        ({"alpha": 0.3}, ('"alpha"', "mask")),
        ({"coat_int_ior": 1.0}, ('"coat_int_ior"', "(1, 3]")),
        ({"coat_int_ior": "treacle"}, ('"coat_int_ior"',)),
        ({"coat_roughness": -0.1}, ('"coat_roughness"', "clear")),
        ({"base_roughness": 0.0}, ('"base_roughness"',)),
        ({"gtr_gamma": 1.5}, ('"gtr_gamma"', '"gtr_alpha"', "both")),
        ({"gtr_gamma": 0.0, "gtr_alpha": 0.1}, ('"gtr_gamma"', "(0, 10]")),
        ({"gtr_gamma": 1.5, "gtr_alpha": 2.0}, ('"gtr_alpha"',)),
        ({"gtr_gamma": 1.5, "gtr_alpha": 0.1, "masking": "none"}, ('"gtr_gamma"', '"masking"')),
        ({"material": "Cu"}, ('"material"', '"flake_reflectance"')),
        ({"bins": -1}, ('"bins"',)),
    ],
)
def test_bad_input_is_refused(maps, parameters, fragments):
    with pytest.raises(RuntimeError) as error:
        paint(maps, **{"masked": "mask" not in parameters, **parameters})
    for fragment in ("glints_carpaint", *fragments):
        assert fragment in str(error.value)


def test_masks_must_fit_and_hold_a_flake(maps, tmp_path):
    for mask, fragment in ((np.full((8, 8), 255), "24 x 24"), (np.zeros((SIDE, SIDE)), "no flake")):
        path = str(tmp_path / "mask.png")
        mi.Bitmap(mask.astype(np.uint8)[..., None]).write(path)
        with pytest.raises(RuntimeError) as error:
            paint(maps, masked=False, mask=path)
        assert '"mask"' in str(error.value) and fragment in str(error.value)
