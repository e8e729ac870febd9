"""Command line of `scripts/imagediff`: tells by its exit status whether renderings are the same."""

import argparse
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import metrics, provenance
from . import page, statistic, storage
from .text import describe

SAME, DIFFERENT, BAD_INPUT = 0, 1, 2

EPILOG = """\
A and B are OpenEXR files or folders of them, searched with their subfolders. Files named NAME-seed1.exr,
NAME-seed2.exr and so on are independent seeds of one image; folders are compared image by image, by name.

  with several seeds on one side at least, or a stored reference: a statistical test, see docs/image-tests.md
  single images on both sides: value by value, within --tolerance, and their errors

exit status: 0 the same, 1 different, 2 the input cannot be compared

  imagediff new/ stored/ --html difference.html     compare, and leave a page to look at
  imagediff seeds/ --store stored/                  keep mean and variance of seeds as a reference
"""


def parser():
    """The options."""
    result = argparse.ArgumentParser(
        prog="imagediff",
        description="Tell whether renderings are the same up to Monte Carlo noise.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = result.add_argument
    add("a", type=Path, metavar="A", help="an EXR file or a folder: what is to be judged")
    add("b", type=Path, metavar="B", nargs="?", help="an EXR file or a folder: what it should be")
    add(
        "--alpha", type=probability, default=statistic.ALPHA, help="rate of false alarms a call (default: %(default)g)"
    )
    add("--block", type=pixels, default=statistic.BLOCK, help="pixels a side of a block (default: %(default)s)")
    add("--means-only", action="store_true", help="the noise may differ: other sample counts, other methods")
    add(
        "--tolerance",
        type=fraction,
        default=statistic.ROUNDING,
        help="of single images, relative (default: %(default)g)",
    )
    add("--html", type=Path, metavar="FILE", help="write a page with images, differences and p-values")
    add("--store", type=Path, metavar="FOLDER", help="instead of comparing, write A's seeds as stored references")
    add("--quiet", action="store_true", help="print only errors")
    return result


def probability(text):
    """A number between 0 and 1, exclusive."""
    value = float(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1")
    return value


def fraction(text):
    """A number that is not negative."""
    value = float(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text} is not zero or more")
    return value


def pixels(text):
    """A positive integer."""
    value = int(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number of pixels")
    return value


def compare_all(options):
    """Compare every pair of images; returns pairs (name, comparison) and remarks."""
    found, remarks = [], []
    for name, files_a, files_b in storage.pairs(options.a, options.b):
        try:
            comparison, unused = compare_pair(files_a, files_b, options)
        except statistic.BadInput as error:
            raise statistic.BadInput(f"{name}: {error}") from error
        found.append((name, comparison))
        if unused:
            remarks.append(f"{name}: not compared are the channels {', '.join(unused)}")
    statistical = [(name, item) for name, item in found if isinstance(item, statistic.Comparison)]
    corrected = statistic.together([item for _, item in statistical])
    replaced = dict(zip((name for name, _ in statistical), corrected))
    return [(name, replaced.get(name, item)) for name, item in found], remarks


def compare_pair(files_a, files_b, options):
    """One comparison, and the names of channels that it leaves out."""
    (a, unused_a), (b, unused_b) = storage.read_side(files_a), storage.read_side(files_b)
    unused = tuple(dict.fromkeys((*unused_a, *unused_b)))
    if max(a.count, b.count) == 1:
        return statistic.compare_exactly(a, b, options.tolerance), unused
    return statistic.compare(a, b, options.block, options.means_only, options.alpha), unused


def lines(name, comparison):
    """What the terminal shows of one comparison."""
    yield f"{name}: {describe(comparison)}"
    if isinstance(comparison, statistic.ExactComparison) and comparison.different:
        a, b = comparison.a.mean, comparison.b.mean
        a, b = (np.broadcast_to(image, (*image.shape[:2], 3)) for image in (a, b))
        with np.errstate(invalid="ignore"):
            errors = metrics.errors(a, b)
        yield "  errors of A against B: " + ", ".join(f"{key} {value:.4g}" for key, value in errors.items())


def store(options):
    """Write A's seeds as references; returns the files."""
    written = []
    for name, files in storage.entries(options.a).items():
        side, _ = storage.read_side(files)
        if not isinstance(side, statistic.Seeds) or side.count < 2:
            raise statistic.BadInput(
                f"{name}: a reference needs two seeds or more, NAME-seed1.exr, NAME-seed2.exr ..."
            )
        if side.nonfinite:
            raise statistic.BadInput(f"{name}: {side.nonfinite} pixels are infinite or undefined; nothing is stored")
        path = options.store / f"{name}.exr"
        origin = {"date": provenance.now(), "files": [file.name for file in files]}
        storage.write_moments(path, side.moments(statistic.compression_scale(side.mean.mean())), origin)
        written.append(path)
    return written


def run(options, say):
    """Do what the options ask for; returns the exit status."""
    if options.store:
        if options.b:
            raise statistic.BadInput("--store takes one path of seeds; leave B off")
        for path in store(options):
            say(f"stored {path}")
        return SAME
    if not options.b:
        raise statistic.BadInput("B is missing; give what A should be compared with, or --store FOLDER")
    results, remarks = compare_all(options)
    for name, comparison in results:
        for line in lines(name, comparison):
            say(line)
    for remark in remarks:
        say(remark)
    different = sum(comparison.different for _, comparison in results)
    say(f"{different} of {len(results)} images differ" if different else f"the same: {len(results)} of {len(results)}")
    if options.html:
        page.write(options.html, results, {"A": options.a, "B": options.b})
        say(f"page: {options.html.resolve()}")
    return DIFFERENT if different else SAME


def main(arguments=None):
    """Compare; returns the exit status."""
    options = parser().parse_args(arguments)
    try:
        mi.set_variant("scalar_rgb")
        return run(options, (lambda _: None) if options.quiet else print)
    except (statistic.BadInput, OSError) as error:
        print(f"imagediff: {error}", file=sys.stderr)
        return BAD_INPUT
    except Exception as error:  # noqa: BLE001 (an exit status of 1 would mean that images differ)
        print(f"imagediff: unexpected {type(error).__name__}: {error}", file=sys.stderr)
        return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
