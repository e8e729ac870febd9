"""Finished runs, kept with all that decides them: a run is rendered once, and an interrupted comparison goes on.

A run is a pair of files, the image (EXR, 32-bit floats) and a JSON file with the image's digest, the times, what the data
structure said about itself, and where all this comes from. The image is written first and the JSON file last, both by
renaming: a run is whole or it is absent. The names hold a digest of everything that decides image and times, the
kind of machine included, since seconds of another one would be comparable with nothing.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from . import metrics, provenance
from .files import Damaged, digest_file, digest_text, write_exr, write_json
from .render import Run

FORMAT = 1
"""Changes when runs of an older layout must not be read."""


@dataclass
class Finished:
    """What a run gave. Travels between processes."""

    run: Run
    image: np.ndarray
    """Shape (height, width, 3), float32, linear radiance."""
    spp: int
    """Samples per pixel, which a time budget may have decided."""
    seconds: float
    cpu_seconds: float
    load_seconds: float
    date: str
    structure: dict
    """`structure_bytes`, `build_seconds`, `bins` as far as the method has them."""
    provenance: dict


def description(run, digest, machine):
    """Everything that decides a run's image and times, as standard JSON.

    `digest` is that of the resolved scene, the method in its slot; `machine` is `provenance.machine()` of where it runs.
    """
    described = {
        "format": FORMAT,
        **asdict(run),
        "scene_digest": digest,
        "mitsuba": provenance.version("mitsuba"),
        "plugins": provenance.plugin_digest(),
        "processor": machine["processor"],
        "cores": machine["cores"],
    }
    return json.loads(json.dumps(described))


class RunCache:
    """A folder of finished runs."""

    def __init__(self, folder, fresh=False):
        """With `fresh`, nothing that lies there is read, only replaced."""
        self.folder = Path(folder)
        self.fresh = fresh

    def path(self, described):
        """Where a run's image lies."""
        name = f"{described['method']}-{digest_text(json.dumps(described, sort_keys=True))[:24]}.exr"
        return self.folder / f"{described['scene']}-x{described['tiling']:g}" / described["view"]["name"] / name

    def find(self, described):
        """The kept record of a run: {"run", "image_digest", "spp", "seconds", ...}; None if there is none.

        Raises `Damaged` if there is something else in its place.
        """
        image = self.path(described)
        listing = image.with_suffix(".json")
        if self.fresh or not listing.is_file():
            return None
        try:
            kept = json.loads(listing.read_text(encoding="utf-8"))
            whole = kept["run"] == described and kept["image_digest"] == digest_file(image)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise Damaged(f"{listing}: {error}") from error
        if not whole:
            raise Damaged(f"{listing}: the image or the description is another one's")
        return kept

    def keep(self, described, finished):
        """Write a run; returns its record, as `find` would."""
        image = self.path(described)
        write_exr(image, finished.image)
        record = {
            "run": described,
            "image_digest": digest_file(image),
            "spp": finished.spp,
            "nonfinite": metrics.nonfinite(finished.image),
            "seconds": finished.seconds,
            "cpu_seconds": finished.cpu_seconds,
            "load_seconds": finished.load_seconds,
            "structure": finished.structure,
            "date": finished.date,
            "provenance": finished.provenance,
            "provenance_digest": digest_text(json.dumps(finished.provenance, sort_keys=True))[:16],
        }
        write_json(image.with_suffix(".json"), record)
        return record
