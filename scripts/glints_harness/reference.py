"""References: large-sample renderings with unfiltered normal mapping, kept with their provenance.

A reference has the reflectance model of the filters but neither footprint nor data structure, so a filter's bias stays
visible. It is the mean of many independent renderings (batches) with seeds of their own; their spread gives the
standard error of every pixel. A kept reference is reused when everything that it depends on is the same, and refined
when more samples are asked for.
"""

import json
from dataclasses import asdict, dataclass, field

import numpy as np

from . import provenance
from .files import digest_text, replacing, write_json
from .render import LoadedScene
from .scenes import scene_digest

BATCH_SAMPLES = 200_000
"""Samples of one batch over the whole view: a fraction of a second."""

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

    @classmethod
    def empty(cls, view):
        """A reference without samples."""
        shape = (view.crop[3], view.crop[2], 3)
        return cls(batch_spp(view), np.zeros(shape), np.zeros(shape))

    @property
    def spp(self):
        return self.batches * self.batch_spp

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

    def __init__(self, folder, method):
        """`method` is what references are rendered with."""
        self.folder = folder
        self.method = method

    def obtain(self, scene, tiling, view, lighting, seconds, spp=None, tick=lambda: None):
        """The reference of a view of a scene, read, refined or rendered.

        `seconds` of rendering, or `spp` samples per pixel if given, are the least it is to have. `tick` is called after
        every batch. What was rendered before an interruption is kept.
        """
        text = scene.text(self.method, tiling)
        described = self.describe(scene, text, tiling, view, lighting)
        path = self.folder / f"{scene.name}-x{tiling:g}-{view.name}-{digest_text(json.dumps(described))[:16]}.npz"
        reference = read(path, described) or Reference.empty(view)
        if reference.enough(seconds, spp):
            return reference
        loaded = LoadedScene(text)
        try:
            while not reference.enough(seconds, spp):
                reference.add(loaded.render(view, lighting, reference.batch_spp, FIRST_SEED + reference.batches))
                tick()
        finally:
            if reference.batches:
                reference.provenance = {**described, **self.history(reference)}
                write(path, reference)
        return reference

    def describe(self, scene, text, tiling, view, lighting):
        """Everything a reference depends on; its digest names the file."""
        return {
            "scene": scene.name,
            "tiling": tiling,
            "scene_digest": scene_digest(text),
            "method": self.method.name,
            "view": asdict(view),
            "integrator": lighting.integrator,
            "max_depth": lighting.max_depth,
            "batch_spp": batch_spp(view),
            "first_seed": FIRST_SEED,
            "mitsuba": provenance.version("mitsuba"),
            "plugins": provenance.plugin_digest(),
        }

    @staticmethod
    def history(reference):
        """How the reference came about."""
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
    """Read a reference, or None if there is none with just this description."""
    if not path.is_file():
        return None
    with np.load(path) as data:
        kept = json.loads(str(data["provenance"]))
        if any(kept.get(key) != value for key, value in json.loads(json.dumps(described)).items()):
            return None
        return Reference(
            described["batch_spp"], data["mean"], data["squares"], int(data["batches"]), float(data["seconds"]), kept
        )
