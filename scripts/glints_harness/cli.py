"""Command line of `scripts/compare`."""

import argparse
import importlib.util
import sys
import time
from dataclasses import replace
from pathlib import Path

from . import ranks, render, tables
from .compare import Comparison
from .executors import START_WORKERS, Dask, Local
from .methods import METHODS, SURFACES, check_plugins, choose
from .plan import SEQUENCE_SPP, SWEEP_SPP, Settings
from .progress import Display, console
from .render import Lighting
from .report import page
from .scenes import find_scenes

ROOT = Path(__file__).resolve().parents[2]

DEFAULT_SPPS = (1, 4)
DEFAULT_TIMES = (0.15,)
DEFAULT_LIMIT = 450.0
"""Seconds; see `Settings.limit`. Keeps the default comparison under eight minutes, the report included."""

EPILOG = """
Everything that is rendered is kept in CACHE at once: after an interruption the same command goes on where it stopped, and
what a time limit left out is rendered when the command runs again with a longer one. Kept runs count for the same
scene, method, plugins, Mitsuba and kind of machine only.

OUT holds index.html (the report), results.json and results.csv (every run), runs/ (EXR images), plots/ and animations/.

A method filters over a footprint, or it doesn't; the footprint rule says how large the footprint is: sample (Mitsuba's
own: it shrinks with the square root of the sample count), pixel, or a fixed number of pixels.

Dask: .venv/bin/dask scheduler prints the SCHEDULER_ADDRESS. Workers are to be
    {START_WORKERS},
all of one kind of machine, with the same versions and plugins, and with the project and the scenes under the same paths.
A worker that dies loses nothing: its job starts again on another.
""".replace("{START_WORKERS}", START_WORKERS)


def parser():
    """The options."""
    result = argparse.ArgumentParser(
        prog="compare",
        description="Render and compare glint methods; writes a report to OUT/index.html.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = result.add_argument_group("what to compare").add_argument
    what(
        "--scene",
        default="all",
        help="name of a scene, several with commas, or all (default): then those that have a reduced plan in scenes.json "
        "are compared by that",
    )
    what("--scene-dir", type=Path, default=ROOT / "mitsuba_scenes", help="folder of scene files with a glint slot")
    what(
        "--methods",
        help=f"names with commas (default: {','.join(METHODS)}; without being named, "
        f"{', '.join(name for name, method in METHODS.items() if method.sparse)} at a few points only)",
    )
    what("--tiling", type=numbers(float), default=(1.0, 8.0), help="factors on the scene's tiling (default: 1,8)")
    what(
        "--footprint",
        type=rules,
        help="rules for methods that filter, with commas (default: sample, and also pixel for glints_ibm)",
    )
    size = result.add_argument_group("how much").add_argument
    size("--spp", type=numbers(int), help="samples per pixel of the crops (default: 1,4)")
    size(
        "--time",
        type=numbers(float),
        default=(),
        help=f"equal-time budgets in seconds a crop, rendering alone (default: {DEFAULT_TIMES[0]:g}; none with --spp, "
        "--time-with-build or --dask)",
    )
    size(
        "--time-with-build",
        type=numbers(float),
        default=(),
        help="equal-time budgets that building the method's data structure is paid from, too",
    )
    size("--seeds", type=number(int), default=8, help="seeds a point; intervals need 8 (default: %(default)s)")
    size("--res", type=number(int), help="width of the frames, of which the crops are parts (default: 400, crops 800)")
    size("--frame-spp", type=number(int), default=4, help="samples per pixel of the frames (default: %(default)s)")
    size(
        "--sweep",
        type=numbers_or_none(float),
        default=(1.0, 2.0, 4.0, 8.0, 16.0, 32.0),
        help=f"tilings of the sweep over texels per pixel, first scene, first crop, {SWEEP_SPP} spp; or none "
        "(default: 1,2,4,8,16,32)",
    )
    size(
        "--frames",
        type=count,
        default=24,
        help="frames of the temporal sequence, in which the camera goes round what the first crop of the first scene "
        f"shows (its middle), {SEQUENCE_SPP} spp; 0: none (default: %(default)s)",
    )
    size("--orbit", type=number(float), default=1.0, help="degrees of the whole sequence (default: %(default)g)")
    size("--reference-time", type=number(float), default=5.0, help="least seconds a crop (default: %(default)g)")
    size("--reference-spp", type=number(int), help="least samples per pixel of every reference, instead of its time")
    size(
        "--limit",
        type=number(float),
        help=f"seconds for everything, points that don't fit are left out (default: {DEFAULT_LIMIT:g}; none with --spp, "
        "--time, --time-with-build or --dask)",
    )
    light = result.add_argument_group("light transport, the same for all methods").add_argument
    light("--integrator", default=Lighting.integrator, choices=("glints_path", "direct", "path"))
    light("--max-depth", type=number(int), default=2, help="longest path in the crops (default: %(default)s, direct)")
    light("--frame-depth", type=number(int), default=3, help="longest path in the frames (default: %(default)s)")
    where = result.add_argument_group("where").add_argument
    where("--dask", metavar="SCHEDULER_ADDRESS", help="render on the workers of an existing Dask cluster")
    where("--out", type=Path, default=ROOT / "out" / "compare", help="folder of the report")
    where("--cache", type=Path, default=ROOT / ".cache", help="folder of finished runs, references, generated scenes")
    where(
        "--bench",
        type=Path,
        default=ROOT / "out" / "bench",
        help="folder of scripts/bench, whose plots over rank are shown",
    )
    where("--fresh", action="store_true", help="render again what is kept of the runs")
    where("--no-report", action="store_true", help="write results.json, results.csv and the images only")
    where("--exposure", type=float, default=0.0, help="stops, for the pictures only (default: 0)")
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


def numbers_or_none(kind):
    """Parser of positive numbers with commas, or the word none."""

    def parse(text):
        return () if text == "none" else numbers(kind)(text)

    parse.__name__ = "list of numbers"
    return parse


def count(text):
    """Parser of a number that may be zero."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def rules(text):
    """Parser of footprint rules with commas."""
    return tuple(dict.fromkeys(rule(item) for item in text.split(",")))


def rule(text):
    """A footprint rule: `sample`, `pixel`, or a number of pixels in its shortest form."""
    if text in ("sample", "pixel"):
        return text
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a footprint rule: sample, pixel, or a number of pixels")
    return f"{value:g}"


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
    check_options(options)
    methods = chosen_methods(options)
    check_plugins((*methods, *(SURFACES[method.surface] for method in methods)))
    limited = not (options.spp or options.time or options.time_with_build or options.dask)
    found = tuple(find_scenes(options.scene_dir, options.scene.split(","), scene_assets(options.cache)))
    absent = unprepared(found, methods)
    return Settings(
        scenes=found,
        methods=tuple(method for method in methods if takes_part(method, found, absent)),
        unprepared=absent,
        tilings=options.tiling,
        spps=options.spp or (() if options.time or options.time_with_build else DEFAULT_SPPS),
        times=options.time or (DEFAULT_TIMES if limited else ()),
        times_with_build=options.time_with_build,
        footprints=options.footprint,
        seeds=options.seeds,
        size=options.res or 800,
        frame_size=options.res or 400,
        frame_spp=options.frame_spp,
        lighting=Lighting(options.integrator, options.max_depth),
        frame_depth=options.frame_depth,
        sweep=options.sweep,
        frames=options.frames,
        orbit=options.orbit,
        reference_seconds=options.reference_time,
        reference_spp=options.reference_spp,
        limit=options.limit or (DEFAULT_LIMIT if limited else None),
        fresh=options.fresh,
        out=options.out,
        cache=options.cache,
    )


def chosen_methods(options):
    """The methods that the options name, or all that the integrator can render."""
    path = options.integrator == "glints_path"
    if options.methods is None:
        methods = [method for method in METHODS.values() if path or not method.environment_prefilter]
    else:
        methods = choose(options.methods.split(","))
    wrong = [method.name for method in methods if method.environment_prefilter and not path]
    if wrong:
        raise ValueError(f"{', '.join(wrong)} needs the integrator glints_path; leave out --integrator")
    return tuple(
        replace(method, store=options.cache / "precomputed") if method.precomputed else method for method in methods
    )


def unprepared(found, methods):
    """Name of a scene to the names of methods that wait for a precomputation there, as in `Settings`."""
    return {
        scene.name: tuple(
            method.name
            for method in methods
            if method.if_kept and scene.has_method(method.name) and not method.is_kept(scene.first_slot())
        )
        for scene in found
    }


def takes_part(method, found, absent):
    """Whether a method that may be left out is compared in any of the scenes."""
    if not method.if_kept:
        return True
    return any(scene.has_method(method.name) and method.name not in absent[scene.name] for scene in found)


def check_options(options):
    """Refuse combinations that would not do what they say."""
    if options.integrator != "glints_path" and options.footprint not in (None, ("sample",)):
        raise ValueError(f"--footprint needs the integrator glints_path; {options.integrator} knows only sample")
    if options.dask and options.limit:
        raise ValueError("--limit plans for one machine; leave it out with --dask")


def executor(options, chosen, warnings):
    """Where to render."""
    if options.dask is None:
        return Local()
    stock = METHODS["normalmap"]
    return Dask(options.dask, {scene.name: scene.text(stock, 1) for scene in chosen.scenes}, warnings)


def main(arguments=None):
    """Compare, write the report, print the tables and where the report lies."""
    options = parser().parse_args(arguments)
    start = time.perf_counter()
    warnings = render.start()
    try:
        chosen = settings(options)
        kept_ranks = ranks.read(options.bench / "tensor")
        place = executor(options, chosen, warnings)
    except ValueError as error:
        sys.exit(f"compare: {error}")
    try:
        with Display() as display:
            results = Comparison(chosen, place, display, warnings).run()
            results = replace(
                results, exposure=options.exposure, ranks=kept_ranks, seconds=time.perf_counter() - start
            )
            written = results.out / "results.json"
            if not options.no_report:
                display.say("report")
                written = page.write(results)
    finally:
        place.close()
    console.print(tables.cost_table(results), *tables.ratio_lines(results), sep="\n")
    if results.left_out:
        console.print(f"{len(results.left_out)} points did not fit the time and were left out; the report lists them.")
    for methods, scenes, command in tables.unprepared(chosen):
        console.print(
            f"Left out of {', '.join(scenes)}: {', '.join(methods)}, not precomputed yet (minutes): {command}"
        )
    said = f"{time.perf_counter() - start:.0f} s. {'Results' if options.no_report else 'Report'}: {written.resolve()}"
    console.print(said, soft_wrap=True, highlight=False)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("compare: interrupted; what is finished is kept, and the same command goes on from there")
