"""Command line of `scripts/bench`: memory and speed of the methods, against each other and stock Mitsuba, in one run.

Four sources: the Rust library's own benchmark (structures and queries), a C++ timer (the same queries through
Mitsuba's BSDF interface, beside stock `roughconductor`), whole frames, and tensor decompositions by rank (`ranks`).
"""

import argparse
import json
import os
import statistics
import subprocess
import time
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from . import provenance, ranks, render, timer
from .cli import ROOT, generator, number, numbers, scene_assets
from .files import write_json
from .methods import METHODS
from .progress import Display, console
from .records import make_record
from .render import Lighting, LoadedScene
from .scenes import FULL_SIZE, find_scenes

ALPHA = 0.00707
"""Flake roughness of the paper's Figure 7."""

MAPS = ("isotropic", "brushed")
"""The maps of Figure 7. Scenes with a reduced plan are left out here."""

WIDTHS = (1, 4, 16, 64, 256, 1024)
"""Footprint widths in texels, of the calls through Mitsuba. The Rust library's program has a list of its own."""

QUICK = ("--alpha", str(ALPHA), "--footprint", "1,16,256,64x1", "--seconds", "0.01")
"""Options of the Rust library's program with `--quick`."""

PLUGINS = (
    # plugin, its parameters, name in the records, calls
    ("glints_ibm", {}, "ibm", ("eval", "sample", "pdf")),
    ("glints_ibm", {"structure": "paper"}, "ibm_paper", ("eval", "sample", "pdf")),
    ("glints_direct", {}, "direct", ("eval",)),
)
"""What is called through Mitsuba."""

FRAME_SPP = 16

SINGLES = 3
"""Renderings with 1 sample per pixel for each one with `FRAME_SPP`."""

FRAMES = (
    # method, tiling
    ("roughconductor", 1),
    ("normalmap", 1),
    ("normalmap", 8),
    ("normalmap", 32),
    ("glints_ibm", 1),
    ("glints_ibm", 8),
    ("glints_ibm", 32),
    ("glints_ibm_paper", 1),
    ("glints_ibm_paper", 8),
    ("glints_ibm_paper", 32),
    ("glints_direct", 1),
    ("glints_direct", 8),
    ("glints_yan16_flat", 1),
    ("glints_yan16_flat", 8),
    ("glints_yan16_curved", 1),
    ("glints_yan16_curved", 8),
)

PUBLISHED_YAN16 = {
    # method, tiling: nanoseconds
    ("glints_yan16_flat", 1): 14_000,
    ("glints_yan16_flat", 8): 88_000,
    ("glints_yan16_curved", 1): 38_000,
    ("glints_yan16_curved", 8): 670_000,
}
"""Extra processor time per sample that hits the glinting surface at 1 sample per pixel, as `frame/glinting_sample`, of
the published implementation of Yan et al. 2016 inside Mitsuba 3.9.1 on 2 cores: original scenes, curved elements on the
shoes only (its kettle needs more memory than there is). It caps footprints at a deviation of 42.7 texels, ours does not."""

GRID = 128
"""Pixels a side of the grid that the share of glinting pixels is counted on."""

LONGEST_FRAME = 120.0
"""Seconds; a frame that is predicted to take longer is left out, and one of a third of this is rendered once."""


TARGETS = {
    "ibm/memory": ("≤ 18 MB", 18e6),
    "ibm/build": ("≤ 0.15 s", 0.15),
    "ibm/eval/worst": ("≤ 3 µs", 3000),
    "ibm/eval/median": ("≤ 1 µs", 1000),
    "ibm/eval/worst_over_best": ("≤ 6", 6),
    "ibm/ndf_error/worst": ("≤ 2 %", 0.02),
}
"""What the compact bin map is to reach on a map of `TARGET_SIDE` texels a side: text and largest value."""

TARGET_SIDE = 2048

TENSOR_TABLE = (
    # map, texels a side, rank; at most so many seconds on 2 cores, and bytes: half the paper's
    ("brushed", 2048, 16, 180, 7.6e6),
    ("brushed", 2048, ranks.DEFAULT_RANK, 180, 7.6e6),
    ("brushed", 1024, 16, 60, 3.6e6),
    ("flakes", 2048, 32, 360, 53.5e6),
)
"""Precomputations of Table 2 of the 2022 paper with what they are to take; a second time at the default rank."""


def tensor_target(record):
    """The target of a record of the tensor decomposition."""
    name, value, params = (record[key] for key in ("name", "value", "params"))
    for label, side, rank, seconds, size in TENSOR_TABLE:
        if (params.get("map"), params.get("side"), params.get("rank")) == (label, side, rank):
            if name == "tensor/precompute" and record["baseline"].startswith("2022 paper"):
                return f"≤ {seconds} s", value <= seconds
            if name == "tensor/storage" and record["baseline"].startswith("2022 paper"):
                return "≤ half", value <= size
    if name == "tensor/eval/growth":
        return "≤ 1.1", value <= 1.1
    if name == "tensor/highlight_error" and (params["against"], params["rank"]) == ("compression", ranks.DEFAULT_RANK):
        return "≤ 3 %", value <= 0.03
    limits = {"tensor/frame_eval_ratio": 1.1, "tensor/frame_sample_ratio": 1.5}
    if name in limits and params.get("rank") == ranks.DEFAULT_RANK:
        return f"≤ {limits[name]}", value <= limits[name]
    return None


def target(record):
    """(text, whether reached) of the target for a record, or None if there is none."""
    name, value, ratio, params = (record[key] for key in ("name", "value", "ratio", "params"))
    if name.startswith("tensor/"):
        return tensor_target(record)
    if name in ("ibm/memory", "ibm/build") and record["baseline"].startswith("2021 paper"):
        return "≤ the paper's", ratio <= 1
    if name in TARGETS and params.get("side") == TARGET_SIDE:
        limit, largest = TARGETS[name]
        return limit, value <= largest
    if name == "ibm/three_calls" and "scene" in params:
        return "≤ 3 µs", value <= 3000
    full = params.get("resolution") == FULL_SIZE
    if name == "frame/glinting_sample" and full and record["baseline"].startswith("published"):
        return "≤ the published", ratio <= 1
    if name == "frame/glinting_sample" and full and params["method"] == "glints_ibm":
        return "≤ 3 µs", value <= 3000
    if name == "frame" and full and params["method"] == "glints_ibm" and record["baseline"].startswith("normalmap"):
        return "≤ 1.3×", ratio <= 1.3
    return None


def rust_records(maps, quick, sides, say):
    """The records of the Rust library's benchmark program, on every map; memory at other sides of the maps, too."""
    options = [*(QUICK if quick else ()), *(("--sides", ",".join(map(str, sides))) if sides else ())]
    records = []
    for label, path in maps.items():
        say(f"Rust library on the {label} map")
        records += run_rust(path, label, options)
    return records


def scene_records(scenes, say):
    """The three calls of one sample at each scene's own footprint: the median pixel's, as at 1 sample per pixel."""
    records = []
    for scene in scenes:
        say(f"Rust library at the footprint of {scene.name}")
        loaded = LoadedScene(scene.text(METHODS["roughconductor"], 1))
        view = scene.views(FULL_SIZE, FULL_SIZE)["frame"]
        width = statistics.median(loaded.glinting_pixels(scene.first_slot().element.get("id"), view))
        texels = width * scene.base_tiles * timer.texels_per_side(scene.normal_map)
        for tiling in (1, 8, 32):
            options = ["--alpha", str(scene.alpha), "--footprint", f"{texels * tiling:.4g}", "--methods", "ibm"]
            for record in run_rust(scene.normal_map, scene.normal_map.stem, options):
                if record["name"] == "ibm/three_calls":
                    record["params"].update(scene=scene.name, tiling=tiling)
                    records.append(record)
    return records


def run_rust(path, label, options):
    """Run the Rust library's benchmark program on a map; returns its records."""
    command = ["cargo", "run", "--release", "--locked", "--quiet", "--package", "glints", "--example", "bench", "--"]
    command += ["--map", str(path), "--label", label, *options]
    # The flags and the folder of the build, see scripts/test.
    flags = {"RUSTFLAGS": "-C target-cpu=x86-64-v3", "CARGO_TARGET_DIR": str(ROOT / "build" / "cargo")}
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **flags}, stdout=subprocess.PIPE, text=True, check=True
    )
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def plugin_records(maps, quick, say):
    """The cost of single calls through Mitsuba's interface, against one evaluation of stock `roughconductor`."""
    import mitsuba as mi

    measure = timer.load()
    stock = mi.load_dict({"type": "roughconductor", "distribution": "beckmann", "alpha": ALPHA})
    records = []
    for label, path in maps.items():
        side = timer.texels_per_side(path)
        for plugin, parameters, short, calls in PLUGINS:
            say(f"{short} on the {label} map")
            bsdf = timer.glint_bsdf(plugin, path, ALPHA, **parameters)
            for width in WIDTHS[::2] if quick else WIDTHS:
                interactions = max(32, min(4096, 2_000_000 // width**2)) if short == "direct" else 4096
                plain = measure(stock, 0.0, 4096).eval_ns
                timings = measure(bsdf, width / side, interactions, 1 if quick else 3)
                params = {"map": label, "alpha": ALPHA, "footprint": width, "through": "Mitsuba"}
                records += [
                    make_record(
                        f"{short}/{call}",
                        getattr(timings, f"{call}_ns"),
                        "nanoseconds",
                        "roughconductor eval",
                        plain,
                        params,
                    )
                    for call in calls
                ]
    return records


class Frame:
    """Repeated renderings of one method on one scene at one tiling."""

    def __init__(self, scene, method, tiling, size, lighting):
        self.scene, self.method, self.tiling = scene, method, tiling
        self.view = scene.views(size, size)["frame"]
        self.lighting = lighting
        self.loaded = LoadedScene(scene.text(METHODS[method], tiling))
        self.renderings = []
        self.singles = []
        part = scene.views(size, size)["crop1"]
        pilot = self.loaded.render(part, lighting, FRAME_SPP, seed=0)
        # Crops show little else than glints, frames show more of other things.
        self.predicted = 0.5 * pilot.seconds * self.view.pixels / part.pixels
        self.identity = scene.first_slot().element.get("id")

    def render(self, repeat):
        """Render once more, and a few times with a single sample per pixel, unless it is slow."""
        limit = LONGEST_FRAME / (1 if repeat == 0 else 3)
        if self.predicted < limit:
            self.renderings.append(self.loaded.render(self.view, self.lighting, FRAME_SPP, seed=1 + repeat))
        if self.predicted / FRAME_SPP < limit / 2:
            for seed in range(SINGLES):
                self.singles.append(self.loaded.render(self.view, self.lighting, 1, seed=1 + SINGLES * repeat + seed))

    @property
    def seconds(self):
        """Median wall-clock seconds."""
        return statistics.median(item.seconds for item in self.renderings)

    @property
    def cpu_seconds(self):
        """Median processor seconds."""
        return statistics.median(item.cpu_seconds for item in self.renderings)

    @property
    def single_cpu_seconds(self):
        """Median processor seconds at 1 sample per pixel, where footprints are widest."""
        return statistics.median(item.cpu_seconds for item in self.singles)

    @property
    def label(self):
        """The method, and the tiling if it has a map."""
        return self.method if self.method == "roughconductor" else f"{self.method} x{self.tiling}"


def frame_records(scenes, size, repeats, lighting, display):
    """Frame times of every scene, interleaved so that a busy machine is unfair to all alike."""
    records = []
    for scene in scenes:
        frames = []
        for method, tiling in FRAMES:
            display.say(f"{scene.name}: load {method} x{tiling}")
            frames.append(Frame(scene, method, tiling, size, lighting))
        for repeat in range(repeats):
            for frame in frames:
                display.say(f"{scene.name}: {frame.label}, {repeat + 1} of {repeats}")
                frame.render(repeat)
        records += compare_frames(scene, frames)
    return records


def compare_frames(scene, frames):
    """Records of the frames of one scene: glint methods against both stock ones, and stock ones against each other."""
    plain = frames[0]
    coverage = len(plain.loaded.glinting_pixels(plain.identity, plain.view, GRID)) / GRID**2
    records = []
    for frame in frames[1:]:
        params = {
            "scene": scene.name,
            "tiling": frame.tiling,
            "method": frame.method,
            "spp": FRAME_SPP,
            "resolution": frame.view.width,
            "integrator": frame.lighting.integrator,
            "max_depth": frame.lighting.max_depth,
            "repeats": len(frame.renderings),
        }
        stock = [plain] + [other for other in frames if (other.method, other.tiling) == ("normalmap", frame.tiling)]
        for other in stock:
            if other is frame or not frame.renderings:
                continue
            processor = {"cpu_seconds": frame.cpu_seconds, "cpu_ratio": frame.cpu_seconds / other.cpu_seconds}
            records.append(
                make_record("frame", frame.seconds, "seconds", other.label, other.seconds, {**params, **processor})
            )
        if frame.method != "normalmap" and coverage > 0 and frame.singles:
            extra = 1e9 * (frame.single_cpu_seconds - plain.single_cpu_seconds) / (plain.view.pixels * coverage)
            whole = 1e9 * plain.single_cpu_seconds / plain.view.pixels
            single = {**params, "spp": 1, "repeats": len(frame.singles), "coverage": coverage}
            baselines = [("sample without glints", whole)]
            if (frame.method, frame.tiling) in PUBLISHED_YAN16:
                baselines.append(("published, original scenes", PUBLISHED_YAN16[frame.method, frame.tiling]))
            for baseline, value in baselines:
                records.append(make_record("frame/glinting_sample", extra, "nanoseconds", baseline, value, single))
    return records


def tensor_records(options, assets, say):
    """The records of tensor decompositions by rank; they and their pictures are kept in OUT/tensor for `scripts/compare`."""
    (scene,) = find_scenes(ROOT / "mitsuba_scenes", [ranks.SCENE], assets)
    side = options.tensor_side or (ranks.QUICK_SIDE if options.quick else ranks.SIDE)
    made = generator().ensure_assets(options.cache / "scenes", side, log=say)["maps"]
    maps = {label: made[label] for label in ranks.MAPS}
    chosen = ranks.QUICK_RANKS if options.quick else ranks.RANKS
    repeats = options.repeats or (1 if options.quick else 5)
    return ranks.measure(scene, maps, chosen, ROOT / "scripts" / "glints", options.out / "tensor", repeats, say)


def tensor_table_records(options, say):
    """The records of the precomputations of the 2022 paper's Table 2, by the Rust library's program."""
    records = []
    for label, side, rank, *_ in TENSOR_TABLE[1:2] if options.quick else TENSOR_TABLE:
        say(f"precomputation of the {label} map at {side} texels, rank {rank}")
        path = generator().ensure_assets(options.cache / "scenes", side, log=say)["maps"][label]
        flags = ["--methods", "tensor", "--alpha", str(ALPHA), "--ranks", str(rank)]
        records += run_rust(path, label, flags)
    return records


def readable(value, unit):
    """A value with its unit for people."""
    if value is None:
        return "–"
    if unit == "bytes":
        return f"{value / 1e6:.1f} MB"
    if unit == "nanoseconds":
        return f"{value:.0f} ns" if value < 1e4 else f"{value / 1e3:.1f} µs"
    if unit == "seconds":
        return f"{value:.3f} s"
    return f"{value:.4f}"


def print_tables(records):
    """One table for each name; parameters that are the same in all rows stand in the title."""
    for name in dict.fromkeys(record["name"] for record in records):
        mine = [record for record in records if record["name"] == name]
        keys = list(dict.fromkeys(key for record in mine for key in record["params"]))
        constant = [key for key in keys if len({record["params"].get(key) for record in mine}) == 1]
        varying = [key for key in keys if key not in constant]
        said = ", ".join(f"{key} {text(mine[0]['params'][key])}" for key in constant)
        table = Table(
            title=f"[bold]{name}[/bold]  {said}",
            title_justify="left",
            title_style="",
            box=SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
        )
        left = ("map", "scene", "method", "baseline", "through", "target")
        for heading in (*varying, "value", "baseline", "its value", "ratio", "target"):
            table.add_column(heading.replace("_", " "), justify="left" if heading in left else "right")
        for record in mine:
            table.add_row(*row(record, varying))
        console.print(table)


def row(record, keys):
    """The texts of one record."""
    goal = target(record)
    verdict = "" if goal is None else f"{goal[0]}: {'reached' if goal[1] else 'MISSED'}"
    return (
        *(text(record["params"].get(key, "")) for key in keys),
        readable(record["value"], record["unit"]),
        record["baseline"],
        readable(record["baseline_value"], record["unit"]),
        "–" if record["ratio"] is None else f"{record['ratio']:.3g}",
        verdict,
    )


def text(value):
    """A parameter for people."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def parser():
    """The options."""
    result = argparse.ArgumentParser(prog="bench", description="Measure memory and speed; writes OUT/bench.json.")
    add = result.add_argument
    add("--res", type=number(int), help="width of the frames (default: 800, with --quick 200)")
    add("--quick", action="store_true", help="fewer footprints, one repeat, small frames: minutes become seconds")
    add(
        "--sides",
        type=numbers(int),
        help="sides in texels of further maps whose memory is counted: the scenes' cropped or tiled, 16 B a texel and more "
        "while they are built (default: 1024,4096, with --quick none)",
    )
    add("--only", choices=("rust", "plugins", "frames", "tensor"), help="one of the four sources")
    add(
        "--tensor-side",
        type=number(int),
        help=f"texels a side of the maps of tensor decompositions (default: {ranks.SIDE}, with --quick {ranks.QUICK_SIDE})",
    )
    add("--scene-dir", type=Path, default=ROOT / "mitsuba_scenes", help="folder of scene files with a glint slot")
    add("--max-depth", type=number(int), default=2, help="longest path of the frames (default: %(default)s, direct)")
    add("--repeats", type=number(int), help="renderings of a frame (default: 3, with --quick 1)")
    add("--out", type=Path, default=ROOT / "out" / "bench", help="folder of bench.json")
    add("--cache", type=Path, default=ROOT / ".cache", help="folder of generated scene files")
    return result


def parts(options, maps, scenes, assets, display):
    """The records that are asked for, part by part as they are measured."""
    say = display.say
    if options.only in (None, "rust"):
        sides = options.sides or (() if options.quick else (1024, 4096))
        yield rust_records(maps, options.quick, sides, say)
        yield scene_records(scenes, say)
    if options.only in (None, "plugins"):
        yield plugin_records(maps, options.quick, say)
    if options.only in (None, "frames"):
        size = options.res or (200 if options.quick else FULL_SIZE)
        repeats = options.repeats or (1 if options.quick else 3)
        yield frame_records(scenes, size, repeats, Lighting(max_depth=options.max_depth), display)
    if options.only in (None, "tensor"):
        yield tensor_table_records(options, say)
        yield tensor_records(options, assets, say)


def main(arguments=None):
    """Measure, print tables, write bench.json."""
    options = parser().parse_args(arguments)
    start = time.perf_counter()
    render.start()
    assets = scene_assets(options.cache)
    maps = {name: assets()["maps"][name] for name in MAPS}
    scenes = [scene for scene in find_scenes(options.scene_dir, ["all"], assets) if scene.reduced is None]
    records = []
    with Display() as display:
        for part in parts(options, maps, scenes, assets, display):
            records += part
            # What is measured stays, whatever happens to the parts to come.
            write_json(options.out / "bench.json", records)
    print_tables(records)
    write_json(options.out / "provenance.json", provenance.provenance())
    verdicts = [goal[1] for goal in map(target, records) if goal is not None]
    console.print(f"{sum(verdicts)} of {len(verdicts)} targets reached. {time.perf_counter() - start:.0f} s.")
    console.print(f"Written: {(options.out / 'bench.json').resolve()}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
