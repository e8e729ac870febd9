"""The decomposition of tensors (`glints::methods::tensor::cp`) against TensorLy's `parafac`, on the same tensors."""

import json
import os
import pathlib
import shutil
import subprocess
import time

import numpy as np
import pytest
from tensorly.decomposition import parafac

ROOT = pathlib.Path(__file__).resolve().parents[1]

RANK = 16
SHAPES = [(64, 12), (64, 3), (32, 20), (4, 6)]

pytestmark = pytest.mark.skipif(shutil.which("cargo") is None, reason="needs cargo")


def blocks(length, spots, seed):
    """`length` images of 16 x 16 directions: a ridge and spots that come and go, then means of four images each."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:16, :16]
    centres, tilt = rng.uniform(0, 16, size=(spots, 2)), rng.uniform(-0.5, 0.5)
    images = []
    for _ in range(length):
        ridge = np.exp(-((x - 8 - tilt * y - rng.normal()) ** 2) / 3) * rng.random()
        spot = [
            np.exp(-((x - u) ** 2 + (y - v) ** 2) / 2) for u, v in centres + rng.normal(scale=0.4, size=(spots, 2))
        ]
        images.append(ridge + np.tensordot(rng.exponential(size=spots) ** 2, spot, axes=1))
    images += [np.mean(images[k : k + 4], axis=0) for k in range(0, length, 4)]
    return np.asarray(images, dtype=np.float32)


@pytest.fixture(scope="module")
def tensors():
    """In C order, the third mode first: 16 x 16 x 80, 80, 40 and 5, two of each."""
    return [blocks(length, spots, seed + spots) for seed in (1, 2) for length, spots in SHAPES]


@pytest.fixture(scope="module")
def tensorly(tensors):
    """For each tensor, TensorLy's relative error and its time in milliseconds."""
    results = []
    for tensor in tensors:
        start = time.perf_counter()
        # As many sweeps as in Deng et al. 2022, Section 4.2. TensorLy's tolerance is one of the error's change.
        weights, factors = parafac(
            tensor.astype(np.float64), RANK, n_iter_max=500, init="random", tol=1e-7, random_state=0
        )
        elapsed = 1e3 * (time.perf_counter() - start)
        results.append((error(tensor, [factors[0] * weights, *factors[1:]]), elapsed))
    return results


def decompose(folder, tensors, rank, *options):
    """The records of the example program, and the factors as TensorLy has them: rows x rank, third mode first."""
    source, target = folder / "tensors.bin", folder / "factors.bin"
    with source.open("wb") as file:
        for tensor in tensors:
            file.write(np.array(tensor.shape[::-1], dtype="<u4").tobytes() + tensor.astype("<f4").tobytes())
    command = ["cargo", "run", "--release", "--locked", "--quiet", "--package", "glints", "--example", "cp", "--"]
    command += [source, "--rank", str(rank), "--factors", target, *options]
    # The flags and the folder of the build, see scripts/test.
    flags = {"RUSTFLAGS": "-C target-cpu=x86-64-v3", "CARGO_TARGET_DIR": str(ROOT / "build" / "cargo")}
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **flags}, stdout=subprocess.PIPE, text=True, check=True
    )
    records = [json.loads(line) for line in done.stdout.splitlines()]
    values = np.fromfile(target, dtype="<f4").reshape(-1, rank)
    rows = [n for record in records for n in record["dims"]]
    parts = np.split(values, np.cumsum(rows)[:-1])
    return records, [parts[k : k + 3][::-1] for k in range(0, len(parts), 3)]


def error(tensor, factors):
    z, y, x = (factor.astype(np.float64) for factor in factors)
    return np.linalg.norm(tensor - np.einsum("kr,jr,ir->kji", z, y, x)) / np.linalg.norm(tensor)


def is_as_good(errors, expected):
    """The starts are random, and so are the local minima that they lead to: within 1 % of the norm, on every tensor."""
    return max(np.subtract(errors, expected)) < 0.01


@pytest.mark.parametrize("options", [(), ("--published",)])
def test_fit_is_that_of_tensorly(tmp_path, tensors, tensorly, options):
    records, factors = decompose(tmp_path, tensors, RANK, *options)
    for tensor, record, factor, (theirs, milliseconds) in zip(tensors, records, factors, tensorly):
        ours = record["relative_error"]
        assert ours == pytest.approx(error(tensor, factor), abs=1e-4)
        print(
            f"16 x 16 x {len(tensor)}, rank {RANK}: error {ours:.4f}, TensorLy {theirs:.4f}; "
            f"{record['milliseconds']:.1f} ms, TensorLy {milliseconds:.0f} ms: "
            f"{milliseconds / record['milliseconds']:.0f} times as long"
        )
    assert is_as_good([record["relative_error"] for record in records], [theirs for theirs, _ in tensorly])


def test_three_quarters_of_the_rank_do_not_fit(tmp_path, tensors, tensorly):
    records, _ = decompose(tmp_path, tensors, 3 * RANK // 4)
    assert not is_as_good([record["relative_error"] for record in records], [theirs for theirs, _ in tensorly])
