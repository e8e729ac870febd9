"""Command line of `scripts/compare`."""

import argparse
import importlib.util
import sys
import time
from pathlib import Path

from . import provenance, render, report, tables
from .compare import Comparison, Settings
from .methods import METHODS, REFERENCE, choose
from .progress import Display, console
from .render import Lighting
from .scenes import find_scenes
from .summary import common_spp, summarise

ROOT = Path(__file__).resolve().parents[2]

DEFAULT_SPPS = (1, 4, 16, 64)
DEFAULT_LIMIT = 290.0
"""Seconds; see `Settings.limit`. Keeps the default comparison under six minutes on a slow or busy machine."""


def parser():
    """The options."""
    result = argparse.ArgumentParser(
        prog="compare", description="Render and compare glint methods; writes a report to OUT/index.html."
    )
    add = result.add_argument
    add("--scene", default="all", help="name of a scene, several with commas, or all (default)")
    add("--scene-dir", type=Path, default=ROOT / "mitsuba_scenes", help="folder of scene files with a glint slot")
    add("--methods", default=",".join(METHODS), help="names with commas (default: %(default)s)")
    add("--tiling", type=numbers(float), default=(1.0, 8.0), help="factors on the scene's tiling (default: 1,8)")
    add("--spp", type=numbers(int), help="samples per pixel of the crops (default: 1,4,16,64)")
    add("--time", type=numbers(float), default=(), help="equal-time budgets in seconds a crop")
    add("--seeds", type=number(int), default=3, help="seeds a sample count (default: %(default)s)")
    add("--res", type=number(int), help="width of the frames, of which the crops are parts (default: 400, crops 800)")
    add("--frame-spp", type=number(int), default=16, help="samples per pixel of the frames (default: %(default)s)")
    add("--footprint", default="sample", help="sample (default), pixel, or a number of pixels")
    add("--max-depth", type=number(int), default=2, help="longest path in the crops (default: %(default)s, direct)")
    add("--frame-depth", type=number(int), default=3, help="longest path in the frames (default: %(default)s)")
    add("--integrator", default=Lighting.integrator, choices=("glints_path", "direct", "path"), help="for all methods")
    add("--reference-time", type=number(float), default=8.0, help="least seconds a crop (default: %(default)g)")
    add("--reference-spp", type=number(int), help="least samples per pixel of a reference, instead of its time")
    add("--reference-method", default=REFERENCE.name, choices=METHODS, help="its model (default: %(default)s)")
    add("--limit", type=number(float), help="seconds for everything; default: 290, or none with --spp or --time")
    add("--exposure", type=float, default=0.0, help="stops, for the pictures only (default: 0)")
    add("--out", type=Path, default=ROOT / "out" / "compare", help="folder of the report")
    add("--cache", type=Path, default=ROOT / ".cache", help="folder of references and generated scene files")
    return result


def number(kind):
    """Parser of a positive number."""

    def parse(text):
        value = kind(text)
        if value <= 0:
            raise argparse.ArgumentTypeError(f"{text} is not positive")
        return value

    parse.__name__ = "number"
    return parse


def numbers(kind):
    """Parser of positive numbers with commas."""

    def parse(text):
        return tuple(sorted({number(kind)(item) for item in text.split(",")}))

    parse.__name__ = "list of numbers"
    return parse


def scene_assets(cache):
    """A function that generates this project's scene files once and returns where they are."""
    kept = {}

    def assets():
        if not kept:
            kept.update(
                generator().ensure_assets(cache / "scenes", log=lambda text: console.print(text, markup=False))
            )
        return kept

    return assets


def generator():
    """The module mitsuba_scenes/generate.py."""
    path = ROOT / "mitsuba_scenes" / "generate.py"
    spec = importlib.util.spec_from_file_location("glints_scene_generator", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def settings(options):
    """The `Settings` that the options ask for."""
    return Settings(
        scenes=tuple(find_scenes(options.scene_dir, options.scene.split(","), scene_assets(options.cache))),
        methods=tuple(choose(options.methods.split(","))),
        tilings=options.tiling,
        spps=options.spp or (() if options.time else DEFAULT_SPPS),
        times=options.time,
        seeds=options.seeds,
        size=options.res or 800,
        frame_size=options.res or 400,
        frame_spp=options.frame_spp,
        lighting=Lighting(options.integrator, options.max_depth, options.footprint),
        frame_depth=options.frame_depth,
        reference_seconds=options.reference_time,
        reference_spp=options.reference_spp,
        reference_method=METHODS[options.reference_method],
        limit=options.limit or (None if options.spp or options.time else DEFAULT_LIMIT),
        out=options.out,
        cache=options.cache / "references",
    )


def main(arguments=None):
    """Compare, write the report, print the table and where the report lies."""
    options = parser().parse_args(arguments)
    start = time.perf_counter()
    warnings = render.start()
    try:
        chosen = settings(options)
    except ValueError as error:
        sys.exit(f"compare: {error}")
    with Display() as display:
        comparison = Comparison(chosen, display)
        comparison.run()
        display.say("report")
        context = report.Context(
            settings=chosen,
            records=comparison.records,
            references=comparison.references,
            left_out=comparison.left_out,
            provenance=provenance.provenance(),
            warnings=warnings,
            exposure=options.exposure,
            seconds=time.perf_counter() - start,
        )
        index = report.write(context)
    summaries = summarise(comparison.records)
    console.print(tables.cost_table(report.costs(context, summaries), common_spp(summaries)))
    console.print(f"{time.perf_counter() - start:.0f} s. Report: {index.resolve()}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("compare: interrupted; finished references are kept, results.json lists the finished methods")
