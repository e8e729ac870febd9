import sys
from pathlib import Path

import mitsuba as mi
import pytest

ROOT = Path(__file__).resolve().parents[1]
# The harness and the generators of the scenes are folders of the repository, not installed packages.
sys.path[:0] = [str(ROOT / "scripts"), str(ROOT / "mitsuba_scenes")]

mi.set_variant("scalar_rgb")

import mini as mini_scene
import mitsuba_glints  # noqa: F401  (makes the plugins loadable)
import support
from glints_harness import scenes


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


@pytest.fixture(scope="session")
def mini_folder(tmp_path_factory):
    """A folder with a scene that has a glint slot, its map, and a scene without slot."""
    return mini_scene.write_scene(tmp_path_factory.mktemp("scenes"))


@pytest.fixture
def mini(mini_folder):
    """The scene with a slot."""
    (scene,) = scenes.find_scenes(mini_folder, ["all"], mini_scene.no_assets)
    return scene
