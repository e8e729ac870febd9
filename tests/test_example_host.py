"""`cpp/example_host`, the program that others copy: it builds against the installed package alone, and runs."""

import os
import pathlib
import shutil
import subprocess
import sys

import mitsuba_glints
import pytest
from support import random_normals

SOURCE = pathlib.Path(__file__).parents[1] / "cpp" / "example_host"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example_host")
    scripts = pathlib.Path(sys.executable).parent
    cmake = shutil.which("cmake", path=os.pathsep.join([str(scripts), os.environ["PATH"]]))
    assert cmake, "cmake is missing; it comes with the build requirements of the package"
    configure = [cmake, "-S", SOURCE, "-B", folder, f"-DGLINTS_ROOT={mitsuba_glints.plugin_dir()}"]
    subprocess.run(configure, check=True, capture_output=True, timeout=60)
    subprocess.run([cmake, "--build", folder], check=True, capture_output=True, timeout=60)
    return folder / "example_host"


def run(program, *arguments):
    return subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("arguments", [(), (0.05,), (0.02, 4), (0.05, 0), (0.05, 70)])
def test_energy_is_right(program, make_map, arguments):
    result = run(program, make_map(random_normals(64, 48, 0.2)), *arguments)
    assert result.returncode == 0, result.stdout + result.stderr
    for fragment in (
        "64 x 48 texels",
        "sample: wo",
        "furnace, distribution of normals: ",
        "furnace, reflected energy: ",
    ):
        assert fragment in result.stdout


def test_library_does_not_know_mitsuba(program):
    linked = subprocess.run(["ldd", program], capture_output=True, text=True, check=True).stdout
    assert "libglints.so" in linked and "not found" not in linked
    assert "mitsuba" not in linked.replace("mitsuba_glints", "").replace("mitsuba-glints", "")


def test_bad_input_is_reported(program, tmp_path, make_map):
    missing = tmp_path / "nowhere.exr"
    result = run(program, missing)
    assert result.returncode == 2 and str(missing) in result.stderr
    result = run(program, make_map(random_normals(4, 4, 0.1)), 7)
    assert result.returncode == 2 and "alpha" in result.stderr
    assert run(program).returncode == 2
