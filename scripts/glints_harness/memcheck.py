"""Runs the C++ API and the plugins under valgrind's memory checker.

    scripts/memcheck            # everything, three minutes
    scripts/memcheck --quick    # the C++ API alone, and the planted errors

A report counts if a frame of its stack is in this project's libraries or programs: reads and writes out of bounds or
of freed memory, decisions on bytes that were never written, and memory that nobody can free any more. What Python,
Mitsuba and the C library do among themselves does not. That errors are found is proved in the same run, by a program
with planted ones.

Needs valgrind (apt-get install valgrind); says so where it is missing.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build"
PLANTED = ("uninitialised", "leak")


class Problem(Exception):
    """What keeps the check from running; its text says what to do."""


def find(program, package):
    beside = Path(sys.executable).parent
    path = shutil.which(program, path=os.pathsep.join([str(beside), os.environ["PATH"]]))
    if path is None:
        raise Problem(f"{program} is missing; install it ({package})")
    return path


def package_folder():
    """The installed package, without importing it: that would load Mitsuba."""
    command = "import importlib.util as u; print(*u.find_spec('mitsuba_glints').submodule_search_locations)"
    found = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=False)
    if found.returncode != 0:
        raise Problem("the package mitsuba-glints is not installed in .venv; run scripts/setup")
    return Path(found.stdout.strip())


def build(source, name, package):
    """An ordinary build of a small program against the installed package; returns its path."""
    folder = BUILD / f"memcheck-{name}"
    cmake = find("cmake", "run scripts/setup")
    for command in ([cmake, "-S", source, "-B", folder, f"-DGLINTS_ROOT={package}"], [cmake, "--build", folder]):
        made = subprocess.run(command, capture_output=True, text=True, check=False)
        if made.returncode != 0:
            raise Problem(f"{source} does not build:\n{made.stdout}{made.stderr}")
    return folder / name


def write_inputs(folder):
    """A normal map of random slopes, 64 x 64 texels, and a mask with gaps."""
    script = (
        "import sys, numpy as np, mitsuba as mi; mi.set_variant('scalar_rgb');"
        "rng = np.random.default_rng(1);"
        "n = np.concatenate([rng.normal(scale=0.15, size=(64, 64, 2)), np.ones((64, 64, 1))], -1);"
        "mi.Bitmap((n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)).write(sys.argv[1]);"
        "mi.Bitmap((rng.random((64, 64, 1)) < 0.7).astype(np.uint8) * 255).write(sys.argv[2])"
    )
    normal_map, mask = folder / "map.exr", folder / "mask.png"
    subprocess.run([sys.executable, "-c", script, normal_map, mask], check=True)
    return normal_map, mask


def reports(command, ours):
    """Runs a command under valgrind; the reports with a frame in one of the folders `ours`, as texts."""
    with tempfile.TemporaryDirectory() as folder:
        xml = Path(folder) / "reports.xml"
        valgrind = [
            find("valgrind", "apt-get install valgrind"),
            "--tool=memcheck",
            "--leak-check=full",
            "--show-leak-kinds=definite",
            "--errors-for-leak-kinds=definite",
            "--error-limit=no",
            "--num-callers=40",
            "--xml=yes",
            f"--xml-file={xml}",
        ]
        # Python's own allocator hides what it hands out.
        environment = {**os.environ, "PYTHONMALLOC": "malloc", "OMP_NUM_THREADS": "1"}
        run = subprocess.run(
            [*valgrind, *map(str, command)], capture_output=True, text=True, env=environment, check=False
        )
        if run.returncode != 0:
            raise Problem(f"{command[0]} fails under valgrind, status {run.returncode}:\n{run.stdout}{run.stderr}")
        errors = ElementTree.parse(xml).getroot().findall("error")
    return [text for error in errors if (text := describe(error, ours))]


def describe(error, ours):
    """A report in words; empty if none of its frames is in one of the folders."""
    frames = error.findall("stack/frame")
    objects = [Path(frame.findtext("obj", "")) for frame in frames]
    if not any(folder in object.parents for object in objects for folder in ours):
        return ""
    what = error.findtext("what") or error.findtext("xwhat/text")
    lines = [f"    {frame.findtext('fn', '?')} ({object.name})" for frame, object in zip(frames, objects, strict=True)]
    return "\n".join([f"{error.findtext('kind')}: {what}", *lines])


def check(name, command, ours):
    """Whether nothing is reported; prints what is."""
    start = time.monotonic()
    found = reports(command, ours)
    verdict = "passed" if not found else f"FAILED, {len(found)} reports"
    print(f"{verdict} ({time.monotonic() - start:.0f} s)  {name}", *found, sep="\n", flush=True)
    return not found


def check_planted(program, normal_map, ours):
    """Whether the planted errors are reported, and nothing is without them."""
    passed = check("no planted error", [program, normal_map, "none"], ours)
    for error in PLANTED:
        found = reports([program, normal_map, error], ours)
        through_library = [text for text in found if "(libglints.so)" in text]
        print(f"{'found' if through_library else 'FAILED, not found'}: planted error, {error}", flush=True)
        passed &= bool(through_library)
    return passed


def main():
    parser = argparse.ArgumentParser(
        prog="scripts/memcheck", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="the C++ API alone, in less than half a minute")
    arguments = parser.parse_args()
    try:
        sys.exit(0 if run(arguments.quick) else 1)
    except Problem as problem:
        print(f"memcheck: {problem}", file=sys.stderr)
        sys.exit(2)


def run(quick):
    find("valgrind", "apt-get install valgrind")
    package = package_folder()
    host = build(ROOT / "cpp" / "example_host", "example_host", package)
    planted = build(ROOT / "tests" / "memcheck", "planted", package)
    ours = [package, host.parent, planted.parent]
    with tempfile.TemporaryDirectory() as folder:
        normal_map, mask = write_inputs(Path(folder))
        passed = check_planted(planted, normal_map, ours)
        # Rough flakes and few samples: the same code, sooner.
        passed &= check("cpp/example_host", [host, normal_map, 0.4, 8, 2000], ours)
        if not quick:
            structure = Path(folder) / "map.glints"
            precompute = [ROOT / "scripts" / "glints", "precompute", "ibm", normal_map, "-o", structure]
            subprocess.run(precompute, check=True, stdout=subprocess.DEVNULL)
            scene = [sys.executable, Path(__file__).with_name("memcheck_scene.py"), normal_map, mask, structure]
            passed &= check("Mitsuba with every plugin", scene, ours)
    return passed


if __name__ == "__main__":
    main()
