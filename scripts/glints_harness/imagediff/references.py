"""Command line of `scripts/references`: renders the image tests' references anew, or calibrates the test."""

import argparse
import fnmatch
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path

from .. import provenance, render
from ..cli import ROOT
from ..progress import console
from . import calibration, statistic, storage
from .cases import ALPHA, CONFIGURATIONS, FOLDER, REFERENCE_SEEDS, SPP, stored
from .text import describe


def origin(configuration, commit, seconds):
    """Where a reference comes from."""
    return {
        "scene": configuration.scene,
        "method": configuration.method.name,
        "integrator": asdict(configuration.integrator),
        "alpha": ALPHA,
        "crop": list(configuration.view().crop),
        "spp": SPP,
        "seeds": [REFERENCE_SEEDS[0], REFERENCE_SEEDS[-1]],
        "commit": commit,
        "seconds": round(seconds, 1),
        "date": provenance.now(),
        "versions": {name: provenance.version(name) for name in ("mitsuba", "drjit", "mitsuba-glints")},
    }


def git(*arguments):
    """Output of a git command in the repository."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.strip()


def commit_of_tree(status, head, folder, refuse):
    """The commit that references are rendered at. `status` and `head` are what git says of the working tree.

    `refuse` makes uncommitted changes an error, since nobody could render such references again; else they are noted.
    """
    if status and refuse:
        raise SystemExit(
            f"references: {folder} takes references of committed code only, and the working tree has changes:\n"
            f"{status}\nCommit or stash them, or render elsewhere with --out FOLDER for a look."
        )
    return f"{head} with uncommitted changes" if status else head


def against_old(name, moments, folder):
    """How far a new reference is from the one it replaces, in words."""
    if not (Path(folder) / f"{name}.exr").is_file():
        return "new"
    try:
        return f"against the old one: {describe(statistic.compare(moments, stored(name, folder)))}"
    except statistic.BadInput as error:
        return f"cannot be compared with the old one: {error}"


def regenerate(names, out, commit):
    """Render references and write them when all are there."""
    rendered = {}
    for name in names:
        start = time.perf_counter()
        images = CONFIGURATIONS[name].images(REFERENCE_SEEDS)
        if images.nonfinite:
            raise SystemExit(
                f"references: {name} has {images.nonfinite} infinite or undefined pixels; nothing is written"
            )
        moments = images.moments(statistic.compression_scale(images.mean.mean()))
        seconds = time.perf_counter() - start
        rendered[name] = (moments, origin(CONFIGURATIONS[name], commit, seconds))
        say(f"{name}: {seconds:.1f} s, mean {images.mean.mean():.5g}; {against_old(name, moments, out)}")
    for name, (moments, description) in rendered.items():
        storage.write_moments(Path(out) / f"{name}.exr", moments, description)
    size = sum((Path(out) / f"{name}.exr").stat().st_size for name in rendered)
    say(f"wrote {len(rendered)} references, {size / 1e6:.2f} MB, to {out}")


def say(text):
    """A line on the terminal."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def parser():
    """The options."""
    result = argparse.ArgumentParser(
        prog="references",
        description="Render the image tests' references anew. Refuses where there are uncommitted changes.",
    )
    add = result.add_argument
    add("--only", default="*", metavar="PATTERN", help="names of configurations, such as 'shoes-ibm-*' (default: all)")
    add("--out", type=Path, default=FOLDER, help="folder of the references; another one takes uncommitted code, too")
    add("--list", action="store_true", help="list the configurations and stop")
    add("--calibrate", action="store_true", help="measure false alarms and power instead, and put them into the docs")
    return result


def main(arguments=None):
    """Render references, or calibrate."""
    options = parser().parse_args(arguments)
    names = fnmatch.filter(CONFIGURATIONS, options.only)
    if not names:
        raise SystemExit(f"references: no configuration matches {options.only}; there are {', '.join(CONFIGURATIONS)}")
    if options.list:
        for name in names:
            say(name)
        return
    render.start()
    if options.calibrate:
        calibration.run(say)
        return
    refuse = options.out.resolve() == FOLDER.resolve()
    regenerate(
        names, options.out, commit_of_tree(git("status", "--porcelain"), git("rev-parse", "HEAD"), FOLDER, refuse)
    )


if __name__ == "__main__":
    sys.exit(main())
