"""Carries out runs in Mitsuba: one loaded scene per method, any number of views, sample counts and seeds."""

import re
import time
from dataclasses import asdict, dataclass

import mitsuba as mi
import numpy as np

from .scenes import View

VARIANT = "scalar_rgb"


@dataclass(frozen=True)
class Lighting:
    """The integrator and its settings, the same for all methods of a comparison."""

    integrator: str = "glints_path"
    max_depth: int = 2
    """Longest path in segments, as in Mitsuba: 2 is direct light."""
    footprint: str = "sample"
    """`sample`: ray differentials shrink with the square root of the sample count; `pixel`; or a number of pixels."""

    def load(self):
        """The Mitsuba integrator. Only `glints_path` knows the footprint rule, and only `direct` knows no depth."""
        described = {"type": self.integrator}
        if self.integrator != "direct":
            described["max_depth"] = self.max_depth
        if self.integrator == "glints_path":
            described["footprint"] = self.footprint
        return mi.load_dict(described)


@dataclass(frozen=True)
class Run:
    """One rendering: everything that tells it from another."""

    scene: str
    tiling: int
    method: str
    view: View
    lighting: Lighting
    spp: int
    seed: int
    time_budget: float = None
    """Seconds that `spp` was chosen to fill, in an equal-time comparison."""

    def record(self):
        """The run's parameters, flat, as they stand in results.json."""
        record = {
            "scene": self.scene,
            "tiling": self.tiling,
            "method": self.method,
            "view": self.view.name,
            "crop": list(self.view.crop),
            "width": self.view.width,
            "height": self.view.height,
            "spp": self.spp,
            "seed": self.seed,
            "time_budget": self.time_budget,
        }
        return {**record, **asdict(self.lighting)}

    @property
    def file_name(self):
        """The name of the run's image, which is as unique as the run among those of one comparison."""
        budget = "" if self.time_budget is None else f"-{self.time_budget:g}s"
        return (
            f"{self.scene}-x{self.tiling:g}/{self.view.name}/{self.method}-{self.spp}spp{budget}-seed{self.seed}.exr"
        )


@dataclass(frozen=True)
class Rendering:
    """What a run gave."""

    image: np.ndarray
    """Shape (height, width, 3), float32, linear radiance."""
    seconds: float
    """Wall-clock seconds of the rendering alone, without loading."""
    cpu_seconds: float
    """Processor seconds over all threads."""


class LoadedScene:
    """A scene in Mitsuba's memory, and what its glint BSDF says about its data structure."""

    def __init__(self, text):
        """Load a resolved scene file's text."""
        start = time.perf_counter()
        self.scene = mi.load_string(text)
        self.load_seconds = time.perf_counter() - start
        self.structure = structure(self.scene)

    def render(self, view, lighting, spp, seed):
        """Render a `View`; returns a `Rendering`."""
        self._point_at(view)
        integrator = lighting.load()
        wall, processor = time.perf_counter(), time.process_time()
        image = np.array(mi.render(self.scene, integrator=integrator, spp=spp, seed=seed), dtype=np.float32)
        return Rendering(image[..., :3], time.perf_counter() - wall, time.process_time() - processor)

    def _point_at(self, view):
        """Set the film to a view. The footprint of a crop stays that of its full frame."""
        film = mi.traverse(self.scene.sensors()[0])
        film["film.size"] = [view.width, view.height]
        film["film.crop_offset"] = list(view.crop[:2])
        film["film.crop_size"] = list(view.crop[2:])
        film.update()

    def glinting_pixels(self, identity, view, side=128):
        """Footprints of the pixels of a view that show the BSDF `identity`, on a grid of `side` by `side` pixels.

        Returns an array of their widths in uv (square roots of the areas), one for each such pixel of the grid: its
        length by the square of `side` is the share of the view that glints.
        """
        self._point_at(view)
        sensor = self.scene.sensors()[0]
        widths = []
        for index in range(side * side):
            film = mi.Point2f((index % side + 0.5) / side, (index // side + 0.5) / side)
            ray, _ = sensor.sample_ray_differential(0.0, 0.5, film, mi.Point2f(0.5))
            hit = self.scene.ray_intersect(ray)
            if hit.is_valid() and hit.bsdf(ray).id() == identity:
                hit.compute_uv_partials(ray)
                du, dv = hit.duv_dx, hit.duv_dy
                widths.append(abs(du.x * dv.y - du.y * dv.x) ** 0.5)
        return np.array(widths)


def structure(scene):
    """`structure_bytes`, `build_seconds`, `bins` as the scene's glint BSDFs print them; absent if none does."""
    text = "\n".join(str(shape.bsdf()) for shape in scene.shapes())
    found = {}
    for name, kind in (("structure_bytes", int), ("build_seconds", float), ("bins", int)):
        match = re.search(rf"\b{name}\s*[=:]\s*([0-9.eE+-]+)", text)
        if match:
            found[name] = kind(float(match.group(1)))
    return found


def collect_warnings():
    """Replace Mitsuba's console output by a counter; returns a dictionary, message to how often it came.

    A rendering with invalid samples warns once per sample, which would bury everything else.
    """
    counts = {}

    class Counter(mi.Appender):
        def append(self, level, text):
            if level >= mi.LogLevel.Warn:
                message = re.sub(r"\x1b\[\d+m|^\S+ \S+ ", "", text)
                key = re.sub(r"\[[^\]]*\]$", "[...]", message)
                counts[key] = counts.get(key, 0) + 1

        def log_progress(self, *_arguments):
            pass

    logger = mi.logger()
    logger.clear_appenders()
    logger.add_appender(Counter())
    return counts


def start():
    """Choose the variant and make this project's plugins known, if they are installed; returns the warnings' counter."""
    mi.set_variant(VARIANT)
    try:
        import mitsuba_glints  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "mitsuba_glints":
            raise
    return collect_warnings()
