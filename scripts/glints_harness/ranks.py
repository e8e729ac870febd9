"""What the rank of a tensor decomposition costs and gives: Figures 18 to 20 of Deng et al. 2022, for `scripts/bench`.

Every rank is precomputed anew by the tool `glints`, and rendered on the bent strip of `bent_quad` under its point light,
with the footprint of a pixel. What is not compressed is the direct sum under the same Gaussian footprint. All of it is written to a folder that `scripts/compare` finds again: its report has the plots.
"""

from __future__ import annotations

import json
import math
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import maps as map_files
from . import provenance
from .files import write_exr, write_json
from .methods import METHODS, Method, add_property, plugin
from .records import make_record
from .render import Lighting, LoadedScene
from .scenes import FULL_SIZE, View

SCENE = "bent_quad"
MAPS = ("isotropic", "brushed", "flakes")
ALPHA = 0.00707
"""Flake roughness; images of 256 pixels a side resolve it."""

RANKS, QUICK_RANKS = (2, 4, 8, 16, 32, 64), (2, 16, 64)

DEFAULT_RANK = 32
"""Of `glints_tensor`: in eight bits, it takes what the paper's 16 take in sixteen."""

SIDE, QUICK_SIDE = 512, 128
"""Texels a side of the maps, which are cut from the scenes' ones."""

TILING = 8
"""Repetitions of the map over a tile of the scene: footprints of the pictures then are 40 texels and more wide."""

STRIDE = 32
"""Texels between images of the finest level, the default of `glints_tensor`."""

RESOLUTION = 256
"""Pixels a side of an image, the default of `glints_tensor`."""

PICTURE_SIDE, PICTURE_SPP = 256, 2
"""Pixels a side of the pictures, and the samples per pixel of each of two independent renderings."""

TIMED_SPP = 16

FURTHER_TILINGS = (100, 1000)
"""At these frames are timed, too, with the default rank: footprints of some 600 and 6000 texels are wholly the images', those of
`TILING` mostly the exact method's."""

UNCOMPRESSED = "uncompressed"
"""What stands for a rank where nothing is compressed."""

NOT_COMPRESSED = replace(METHODS["glints_direct"], parameters={"footprint_filter": "gaussian"})

FILE = "ranks.json"


@dataclass(frozen=True)
class OneTechnique:
    """Stock `direct` with one way of sampling: an integrator as `Lighting`."""

    name: str
    """eval (samples of the light only) or sample (of the BSDF only)."""

    def load(self):
        """The Mitsuba integrator."""
        samples = {"emitter_samples": int(self.name == "eval"), "bsdf_samples": int(self.name == "sample")}
        return mi.load_dict({"type": "direct", **samples})


def from_file(slot, parameters):
    """`glints_tensor` over a saved precomputation, which stands for map and roughness."""
    element = plugin("glints_tensor")(slot, {})
    for name in ("filename", "encoding", "alpha"):
        element.remove(element.find(f"*[@name='{name}']"))
    for name, value in parameters.items():
        add_property(element, name, value)
    return element


def method(file):
    """The method that renders with a saved precomputation."""
    return Method("tensor", "Tensor decomposition", METHODS["glints_tensor"].model, from_file, {"ndf_file": str(file)})


def precompute(tool, path, rank, file):
    """Run the tool; returns what it says: seconds, bytes and relative error among it."""
    command = [str(tool), "precompute", "tensor", str(path), "--alpha", str(ALPHA), "--rank", str(rank)]
    command += ["--stride", str(STRIDE), "--resolution", str(RESOLUTION), "-o", str(file), "--force", "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def image_count(texels, levels):
    """Images of the distribution of normals of a square map of so many texels in so many levels."""
    side = math.isqrt(texels)
    return sum(math.ceil(side / (STRIDE * 2**level)) ** 2 for level in range(levels))


def measure(scene, maps, ranks, tool, folder, repeats, say):
    """Measure all ranks on maps {label: path}, and write `FILE` and the pictures to `folder`; returns the records."""
    folder.mkdir(parents=True, exist_ok=True)
    records, pictures = [], []
    for label, path in maps.items():
        on_map = replace(scene, values={**scene.values, "normalmap": str(path), "alpha": str(ALPHA)})
        facts, made, loaded = {}, {}, {}
        for rank in ranks:
            say(f"{label}: rank {rank}")
            file = folder / "precomputed" / f"{label}-{rank}.glints"
            file.parent.mkdir(exist_ok=True)
            facts[rank] = precompute(tool, path, rank, file)
            made[rank] = method(file)
            loaded[rank] = LoadedScene(on_map.text(made[rank], TILING))
        loaded[UNCOMPRESSED] = LoadedScene(on_map.text(NOT_COMPRESSED, TILING))
        plain = LoadedScene(on_map.text(METHODS["roughconductor"], TILING))
        say(f"{label}: pictures and times")
        shots = {rank: render(item) for rank, item in loaded.items()}
        for rank, shot in shots.items():
            file = folder / "pictures" / f"{label}-{rank}.exr"
            write_exr(file, np.mean(shot, axis=0))
            pictures.append({"map": label, "rank": rank, "file": file.relative_to(folder).as_posix()})
        times = {TILING: frame_times(scene, plain, {rank: loaded[rank] for rank in ranks}, repeats)}
        for tiling in FURTHER_TILINGS if DEFAULT_RANK in ranks else ():
            say(f"{label}: times at x{tiling}")
            item = {DEFAULT_RANK: LoadedScene(on_map.text(made[DEFAULT_RANK], tiling))}
            times[tiling] = frame_times(scene, plain, item, repeats)
        records += map_records(label, path, facts, shots, times)
    write_json(folder / FILE, {"records": records, "pictures": pictures, "provenance": provenance.provenance()})
    return records


def render(loaded):
    """Two independent pictures of the strip."""
    view = View("frame", PICTURE_SIDE, PICTURE_SIDE, (0, 0, PICTURE_SIDE, PICTURE_SIDE))
    lighting = Lighting(footprint="pixel")
    return [loaded.render(view, lighting, PICTURE_SPP, seed).image.astype(np.float64) for seed in (1, 2)]


def squared_error(shots, truth):
    """Mean squared difference of what two pairs of independent renderings converge to: free of their noise, so that it may
    come out negative where there is next to no difference."""
    return float(np.mean((shots[0] - truth[0]) * (shots[1] - truth[1])))


def frame_times(scene, plain, loaded, repeats):
    """{technique: {rank: processor time over that of stock `roughconductor`}} of a crop that shows nothing but metal.

    Times are the least of interleaved repeats: a busy machine only ever adds.
    """
    crop = scene.views(FULL_SIZE, FULL_SIZE)["crop1"]
    found = {}
    for technique in ("eval", "sample"):
        best = {}
        for repeat in range(repeats):
            for rank, item in {None: plain, **loaded}.items():
                seconds = item.render(crop, OneTechnique(technique), TIMED_SPP, repeat).cpu_seconds
                best[rank] = min(seconds, best.get(rank, math.inf))
        found[technique] = {rank: best[rank] / best[None] for rank in loaded}
    return found


def map_records(label, path, facts, shots, times):
    """The records of one map, as lines of bench.json; `times`: {tiling: what `frame_times` found}."""
    texels = map_files.texels(path)
    truth = shots[UNCOMPRESSED]
    least = min(facts)
    records = []
    for rank, fact in facts.items():
        params = {"map": label, "side": math.isqrt(texels), "alpha": ALPHA, "rank": rank, "scene": SCENE}
        images = image_count(texels, fact["levels"]) * RESOLUTION**2
        error = squared_error(shots[rank], truth)
        rows = (
            ("precompute", fact["seconds"], "seconds", f"rank {least}", facts[least]["seconds"]),
            ("storage", fact["image_bytes"], "bytes", "images of one byte a pixel", images),
            ("ndf_error", fact["level_errors"][0], "relative L1", f"rank {least}", facts[least]["level_errors"][0]),
            (
                "frame_error",
                error,
                "radiance²",
                "mean square of the uncompressed",
                float(np.mean(truth[0] * truth[1])),
            ),
        )
        records += [make_record(f"tensor/{name}", *row, params) for name, *row in rows]
        records += [
            make_record(
                f"tensor/frame_{technique}_ratio",
                ratios[rank],
                "ratio",
                "roughconductor",
                1.0,
                {**params, "tiling": tiling},
            )
            for tiling, techniques in times.items()
            for technique, ratios in techniques.items()
            if rank in ratios
        ]
    return records


@dataclass(frozen=True)
class Ranks:
    """What the last benchmark of ranks wrote."""

    folder: Path
    records: list
    pictures: list
    """{"map", "rank", "file"}, `file` relative to `folder`."""
    provenance: dict


def read(folder):
    """The `Ranks` in a folder, or None if there are none; raises ValueError, naming the file, if it is another thing."""
    file = Path(folder) / FILE
    if not file.is_file():
        return None
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
        ranks = Ranks(Path(folder), kept["records"], kept["pictures"], kept["provenance"])
        gone = [item["file"] for item in ranks.pictures if not (ranks.folder / item["file"]).is_file()]
        wrong = not all({"name", "value", "ratio", "params"} <= set(record) for record in ranks.records)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file}: {error}; run scripts/bench --only tensor again") from error
    if gone or wrong:
        raise ValueError(f"{file}: {', '.join(gone) or 'a record'} is missing; run scripts/bench --only tensor again")
    return ranks
