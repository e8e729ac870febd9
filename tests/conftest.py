import sys
from pathlib import Path

import mitsuba as mi
import pytest

ROOT = Path(__file__).resolve().parents[1]
# The harness and the generators of the scenes are folders of the repository, not installed packages.
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "mitsuba_scenes")]

mi.set_variant("scalar_rgb")

import mitsuba_glints  # noqa: F401  (makes the plugins loadable)
import support


@pytest.fixture(autouse=True)
def scalar_rgb():
    """Every test starts in scalar_rgb, whatever the one before has chosen."""
    mi.set_variant("scalar_rgb")
    yield
    mi.set_variant("scalar_rgb")


@pytest.fixture
def make_map(tmp_path):
    """Writes normals to an EXR file and returns its path."""

    def make(normals, name="map.exr"):
        return support.write_exr(tmp_path / name, normals)

    return make


@pytest.fixture(scope="session")
def rough_map(tmp_path_factory):
    """A small non-square map of random normals, slopes of standard deviation 0.2."""
    return support.write_exr(tmp_path_factory.mktemp("maps") / "rough.exr", support.random_normals(48, 32, 0.2))
