"""`glints_tensor` through the loaded plugin. Images, queries and sampling are tested in Rust (`methods/tensor`)."""

import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import support
from test_distribution import CONTEXT, albedo, cell_points, chi_square, draw_cells, integrate_cells
from test_errors import assert_mentions, message_of

SIDE = 96
SMALL = {"alpha": 0.12, "resolution": 32, "stride": 16}
CELLS = 64
"""Cells a side over the disk: half a pixel each, so that the density is a product of lines inside."""

FOOTPRINTS = {
    "exact and images": ((7 / SIDE, 0), (0, 7 / SIDE)),
    "elongated": ((60 / SIDE, 20 / SIDE), (-8 / SIDE, 24 / SIDE)),
    "tiles": ((1.7, 0.3), (-0.2, 1.1)),
}
ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wavy_map(tmp_path_factory):
    normals = support.random_normals(SIDE, SIDE // 2, 0.25, seed=4)
    return support.write_exr(tmp_path_factory.mktemp("maps") / "wavy.exr", normals)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def tensor(wavy_map, cache):
    return support.bsdf("glints_tensor", wavy_map, cache=str(cache), **SMALL)


def vertex(footprint, wi=(-0.4, 0.3, 0.8)):
    return support.interaction((0.31, 0.77), wi, *FOOTPRINTS[footprint])


@pytest.mark.parametrize("footprint", FOOTPRINTS)
def test_samples_have_the_density_of_pdf(tensor, footprint):
    si = vertex(footprint)
    probabilities = integrate_cells(si, CELLS, lambda wo: tensor.pdf(CONTEXT, si, mi.Vector3f(*wo)))
    probabilities = np.append(probabilities, max(0.0, 1 - probabilities.sum()))
    counts, weights = draw_cells(tensor, si, CELLS, 40_000, np.random.default_rng(1))
    assert chi_square(counts, probabilities) > 1e-4 / len(FOOTPRINTS)
    # The broken twin: a density that is off by a factor linear in the half vector.
    centers, _, _ = cell_points(CELLS)
    tilted = probabilities[:-1] * (1 + 0.7 * centers[:, 0])
    twin = np.append(tilted, max(0.0, 1 - tilted.sum()))
    assert chi_square(counts, twin / twin.sum()) < 1e-6
    # The furnace: sampling estimates the integral of eval, and no more comes out than went in.
    estimate, error = weights.mean(), weights.std() / np.sqrt(len(weights))
    integral = albedo(tensor, si, CELLS)
    assert abs(estimate - integral) < 5 * error + 1e-3
    assert 0.7 < integral < 1.005


def test_small_footprints_are_the_inverse_bin_maps(tensor, wavy_map):
    """Below half of the finest level's size, over the parallelogram with the Gaussian's covariance."""
    exact = support.bsdf("glints_ibm", wavy_map, alpha=SMALL["alpha"])
    edge, wider = 3 / SIDE, 3 / SIDE * 0.5 * np.sqrt(12)
    wo = support.unit((0.2, -0.1, 0.9))
    small = support.interaction((0.31, 0.77), (-0.4, 0.3, 0.8), (edge, 0), (0, 2 * edge))
    same = support.interaction((0.31, 0.77), (-0.4, 0.3, 0.8), (wider, 0), (0, 2 * wider))
    assert support.value(tensor, small, wo) == pytest.approx(support.value(exact, same, wo), rel=2e-3)
    assert support.value(tensor, small, wo) != pytest.approx(support.value(exact, small, wo), rel=2e-3)


def test_large_footprints_agree_with_the_direct_sum(tensor, wavy_map):
    gaussian = {"alpha": SMALL["alpha"], "footprint_filter": "gaussian"}
    direct = support.bsdf("glints_direct", wavy_map, **gaussian)
    rng = np.random.default_rng(3)
    directions = [support.unit((*rng.uniform(-0.5, 0.5, 2), 1)) for _ in range(200)]

    def difference(footprint, other):
        si, reference = vertex(footprint), vertex(other)
        found = np.array([support.value(tensor, si, wo) for wo in directions])
        expected = np.array([support.value(direct, reference, wo) for wo in directions])
        return abs(found - expected).sum() / expected.sum()

    assert difference("elongated", "elongated") < 0.08
    assert difference("tiles", "tiles") < 0.05
    # The broken twin: another footprint's.
    assert difference("tiles", "exact and images") > 0.15


def test_precomputations_are_found_again(wavy_map, tensor, cache):
    assert len(list(cache.iterdir())) == 1
    with support.captured_log(mi.LogLevel.Info) as lines:
        again = support.bsdf("glints_tensor", wavy_map, cache=str(cache), **SMALL)
    assert any("using the precomputation" in line for line in lines)
    si, wo = vertex("elongated"), support.unit((0.2, -0.1, 0.9))
    assert support.value(again, si, wo) == support.value(tensor, si, wo)
    with support.captured_log() as lines:
        support.bsdf("glints_tensor", wavy_map, cache=str(cache), **{**SMALL, "rank": 4})
    assert any("precomputing" in line and str(cache) in line for line in lines)
    assert len(list(cache.iterdir())) == 2


def test_files_of_the_tool_stand_for_the_map(wavy_map, tensor, tmp_path):
    path = tmp_path / "wavy.glints"
    options = ["--alpha", str(SMALL["alpha"]), "--resolution", "32", "--stride", "16"]
    command = [ROOT / "scripts" / "glints", "precompute", "tensor", wavy_map, *options, "-o", path]
    subprocess.run(command, check=True, capture_output=True)
    loaded = mi.load_dict({"type": "glints_tensor", "ndf_file": str(path)})
    si, wo = vertex("elongated"), support.unit((0.2, -0.1, 0.9))
    # Masking comes from the map's normals, which the file has to 16 bits.
    assert support.value(loaded, si, wo) == pytest.approx(support.value(tensor, si, wo), rel=1e-3)
    told = subprocess.run([ROOT / "scripts" / "glints", "info", path], check=True, capture_output=True, text=True)
    assert "tensor" in told.stdout and f"{SIDE} x {SIDE // 2}" in told.stdout

    def loading(**parameters):
        return message_of(lambda: mi.load_dict({"type": "glints_tensor", "ndf_file": str(path), **parameters}))

    assert_mentions(loading(filename=wavy_map), "glints_tensor", "filename", "ndf_file")
    assert_mentions(loading(alpha=0.1), "glints_tensor", "alpha", "ndf_file")
    damaged = bytearray(path.read_bytes())
    damaged[-5] ^= 1
    path.write_bytes(damaged)
    assert_mentions(loading(), "glints_tensor", str(path), "damaged", "glints precompute tensor")


@pytest.mark.parametrize(
    "parameters, fragments",
    [
        ({"rank": 65}, ["rank", "1 to 64"]),
        ({"resolution": 100}, ["resolution", "multiple of 16"]),
        ({"stride": 2}, ["stride", "4 to 1024"]),
        ({"rank_error": 1.5}, ["error", "[0, 1]"]),
        ({"normalization": "paper"}, ["normalization", "projected"]),
    ],
    ids=str,
)
def test_bad_parameters(wavy_map, cache, parameters, fragments):
    given = {"cache": str(cache), **SMALL, **parameters}
    assert_mentions(message_of(lambda: support.bsdf("glints_tensor", wavy_map, **given)), "glints_tensor", *fragments)
