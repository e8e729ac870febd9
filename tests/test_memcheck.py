"""`scripts/memcheck --quick`: planted errors are found, and the C++ API has none."""

import pathlib
import shutil
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]


def memcheck(*arguments, **options):
    command = [sys.executable, "-m", "glints_harness.memcheck", *arguments]
    return subprocess.run(
        command, cwd=ROOT / "scripts", capture_output=True, text=True, timeout=300, check=False, **options
    )


@pytest.mark.skipif(not shutil.which("valgrind"), reason="valgrind is not installed (apt-get install valgrind)")
def test_planted_errors_are_found_and_others_are_not():
    result = memcheck("--quick")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.count("found: planted error") == 2
    assert result.stdout.count("passed") == 2


def test_what_is_missing_is_said(tmp_path):
    result = memcheck("--quick", env={"PATH": str(tmp_path)})
    assert result.returncode == 2
    assert "valgrind is missing" in result.stderr and "apt-get install valgrind" in result.stderr
