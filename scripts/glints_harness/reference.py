"""References: large-sample renderings with unfiltered normal mapping, kept with their provenance.

A reference has the reflectance model of the filters but neither footprint nor data structure, so a filter's bias stays
visible. It is the mean of many independent renderings (batches) with seeds of their own; their spread gives the
standard error of every pixel. A kept reference is reused when everything that it depends on is the same, and refined
when more samples are asked for.
"""

import json
import zipfile
from dataclasses import asdict, dataclass, field

import numpy as np

from . import provenance
from .files import Damaged, digest_text, replacing, write_json

BATCH_SAMPLES = 50_000
"""Samples of one batch over the whole view: a tenth of a second."""

FIRST_SEED = 100_000
"""Seeds of the batches count up from here, far from those of measured runs, so that their noise is independent."""

FEWEST_BATCHES = 4
"""Fewer could not tell how far off they are."""


@dataclass
class Reference:
    """Mean of batches and what it takes to add more. Arrays have shape (height, width, 3), linear radiance."""

    batch_spp: int
    """Samples per pixel of one batch."""
    mean: np.ndarray
    squares: np.ndarray
    """Sum over batches of the squared distance to the mean (Welford's algorithm)."""
    batches: int = 0
    seconds: float = 0.0
    provenance: dict = field(default_factory=dict)
    noise: dict = field(default_factory=dict)
    """`metrics.noise_of` this reference, once measured."""

    @classmethod
    def empty(cls, view):
        """A reference without samples."""
        shape = (view.crop[3], view.crop[2], 3)
        return cls(batch_spp(view), np.zeros(shape), np.zeros(shape))

    @property
    def spp(self):
        return self.batches * self.batch_spp

    @property
    def next_seed(self):
        """Of the batch to come."""
        return FIRST_SEED + self.batches

    @property
    def standard_error(self):
        """Standard error of the mean, per pixel and channel."""
        return np.sqrt(self.squares / (self.batches * (self.batches - 1)))

    def add(self, rendering):
        """Add one batch."""
        self.batches += 1
        difference = rendering.image.astype(np.float64) - self.mean
        self.mean = self.mean + difference / self.batches
        self.squares = self.squares + difference * (rendering.image - self.mean)
        self.seconds += rendering.seconds

    def enough(self, seconds, spp):
        """Whether it has the samples that were asked for: a number per pixel, or else a rendering time."""
        if self.batches < FEWEST_BATCHES:
            return False
        return self.spp >= spp if spp is not None else self.seconds >= seconds


def batch_spp(view):
    """Samples per pixel of one batch; a sample of an unfiltered rendering does not depend on their number."""
    return max(1, BATCH_SAMPLES // view.pixels)


class ReferenceStore:
    """A folder of references, one pair of files (data, provenance for people to read) each."""

    def __init__(self, folder):
        self.folder = folder

    def describe(self, key, lighting, digest):
        """Everything a reference depends on; its digest names the file.

        `key` is a `plan.ReferenceKey`, `digest` that of the resolved scene.
        """
        described = {
            **asdict(key),
            "scene_digest": digest,
            "integrator": lighting.integrator,
            "max_depth": lighting.max_depth,
            "batch_spp": batch_spp(key.view),
            "first_seed": FIRST_SEED,
            "mitsuba": provenance.version("mitsuba"),
            "plugins": provenance.plugin_digest(),
        }
        return json.loads(json.dumps(described))

    def path(self, described):
        """Where a reference's data lie."""
        view, digest = described["view"], digest_text(json.dumps(described))[:16]
        frame = "" if view["frame"] is None else f"frame{view['frame']:03d}-"
        name = f"{described['scene']}-x{described['tiling']:g}-{view['name']}-{frame}{described['surface']}-{digest}"
        return self.folder / f"{name}.npz"

    def find(self, described):
        """The reference as far as it has come, or None."""
        return read(self.path(described), described)

    def keep(self, described, reference):
        """Write a reference as far as it has come."""
        reference.provenance = {**described, **history(reference)}
        write(self.path(described), reference)


def history(reference):
    """How a reference came about."""
    return {
        "batches": reference.batches,
        "spp": reference.spp,
        "seeds": [FIRST_SEED, FIRST_SEED + reference.batches - 1],
        "seconds": reference.seconds,
        "date": provenance.now(),
        "machine": provenance.machine(),
    }


def write(path, reference):
    """Write a reference, whole or not at all."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            mean=reference.mean,
            squares=reference.squares,
            batches=reference.batches,
            seconds=reference.seconds,
            provenance=json.dumps(reference.provenance),
        )
    write_json(path.with_suffix(".json"), reference.provenance)


def read(path, described):
    """Read a reference, or None if there is none; raises `Damaged` if the file is not this reference."""
    if not path.is_file():
        return None
    try:
        with np.load(path) as data:
            kept = json.loads(str(data["provenance"]))
            found = Reference(
                described["batch_spp"],
                data["mean"],
                data["squares"],
                int(data["batches"]),
                float(data["seconds"]),
                kept,
            )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise Damaged(f"{path}: {error}") from error
    if any(kept.get(key) != value for key, value in described.items()):
        raise Damaged(f"{path}: it is another reference's")
    return found
