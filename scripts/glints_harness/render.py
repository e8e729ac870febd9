"""Carries out runs in Mitsuba: one loaded scene per method, any number of views, sample counts and seeds."""

from __future__ import annotations

import re
import time
from dataclasses import asdict, dataclass, replace

import mitsuba as mi
import numpy as np

from .scenes import View

VARIANT = "scalar_rgb"


@dataclass(frozen=True)
class Lighting:
    """The integrator and its settings."""

    integrator: str = "glints_path"
    max_depth: int = 2
    """Longest path in segments, as in Mitsuba: 2 is direct light."""
    footprint: str = "sample"
    """`sample`: ray differentials shrink with the square root of the sample count; `pixel`; a number of pixels; or
    `none` where the method doesn't look at it."""
    environment_prefilter: bool = False
    """Whether samples of environment light stand for a range of directions. For `glints_path` only."""

    def load(self):
        """The Mitsuba integrator. Only `glints_path` knows the footprint rule, and only `direct` knows no depth."""
        described = {"type": self.integrator}
        if self.integrator != "direct":
            described["max_depth"] = self.max_depth
        if self.integrator == "glints_path" and self.footprint != "none":
            described["footprint"] = self.footprint
        if self.environment_prefilter:
            described["environment_prefilter"] = True
        return mi.load_dict(described)


@dataclass(frozen=True)
class Run:
    """One rendering: everything that tells it from another."""

    scene: str
    tiling: float
    method: str
    view: View
    lighting: Lighting
    spp: int | None
    """Samples per pixel; None where a time budget decides."""
    seed: int
    time_budget: float | None = None
    """Seconds that the rendering is to fill, in an equal-time comparison."""
    budget_includes_build: bool = False
    """Whether building the data structure is paid from the time budget."""

    @property
    def point(self):
        """What runs that are taken together share: all but the seed and, in a sequence, the frame."""
        view = self.view if self.view.frame is None else replace(self.view, frame=0, turn=0.0)
        return replace(self, seed=0, view=view)

    def record(self):
        """The run's parameters, flat, as they stand in results.json."""
        view = asdict(self.view)
        record = {key: value for key, value in asdict(self).items() if key not in ("view", "lighting")}
        return {**record, **asdict(self.lighting), **view, "view": view.pop("name"), "crop": list(self.view.crop)}

    @property
    def file_name(self):
        """The name of the run's image, which is as unique as the run among those of one comparison."""
        frame = "" if self.view.frame is None else f"frame{self.view.frame:03d}-"
        return self.file_of(f"{frame}seed{self.seed}")

    def file_of(self, which):
        """The name of an image of this run's point: of a seed, of the mean over them, of the excess over time."""
        amount = f"{self.spp}spp"
        if self.time_budget is not None:
            amount = f"{self.time_budget:g}s" + ("-with-build" if self.budget_includes_build else "")
        method = self.method if self.lighting.footprint == "none" else f"{self.method}-{self.lighting.footprint}"
        return f"{self.scene}-x{self.tiling:g}/{self.view.folder}/{method}-{amount}-{which}.exr"


@dataclass(frozen=True)
class Rendering:
    """What a run gave."""

    image: np.ndarray
    """Shape (height, width, 3), float32, linear radiance."""
    seconds: float
    """Wall-clock seconds of the rendering alone, without loading."""
    cpu_seconds: float
    """Processor seconds over all threads."""


def by_point(runs):
    """{`Run.point`: its runs}, in the order of the first run of each."""
    groups = {}
    for run in runs:
        groups.setdefault(run.point, []).append(run)
    return groups


class LoadedScene:
    """A scene in Mitsuba's memory, and what its glint BSDF says about its data structure."""

    def __init__(self, text):
        """Load a resolved scene file's text."""
        start = time.perf_counter()
        self.scene = mi.load_string(text)
        self.load_seconds = time.perf_counter() - start
        self.structure = structure(self.scene)
        to_world = mi.traverse(self.scene.sensors()[0])["to_world"]
        self.to_world = type(to_world)(to_world)
        self.pivots = {}
        self.integrators = {}

    def render(self, view, lighting, spp, seed):
        """Render a `View`; returns a `Rendering`."""
        self.point_at(view)
        integrator = self.integrator(lighting)
        wall, processor = time.perf_counter(), time.process_time()
        image = np.array(mi.render(self.scene, integrator=integrator, spp=spp, seed=seed), dtype=np.float32)
        return Rendering(image[..., :3], time.perf_counter() - wall, time.process_time() - processor)

    def integrator(self, lighting):
        """The integrator of a `Lighting`, or of what loads one as it does, made once and ready: with prefiltered light it fits
        the scene's environment at its first sample, which takes seconds and is no rendering."""
        if lighting not in self.integrators:
            made = self.integrators[lighting] = lighting.load()
            if isinstance(lighting, Lighting) and lighting.environment_prefilter:
                mi.render(self.scene, integrator=made, spp=1)
        return self.integrators[lighting]

    def point_at(self, view):
        """Set the sensor to a view. The footprint of a crop stays that of its full frame."""
        self._set_sensor(view, self.to_world)
        if view.turn:
            self._set_sensor(view, self._turned(view))

    def _set_sensor(self, view, to_world):
        """Set film, crop and place of the camera."""
        # Mitsuba takes the crop of a film whose size changes to be the whole film unless the crop changes, too: so
        # first the whole film, then the crop.
        whole = (0, 0, view.width, view.height)
        for crop in (whole, view.crop):
            sensor = mi.traverse(self.scene.sensors()[0])
            sensor["film.size"] = [view.width, view.height]
            sensor["film.crop_offset"] = list(crop[:2])
            sensor["film.crop_size"] = list(crop[2:])
            sensor["to_world"] = to_world
            sensor.update()

    def _turned(self, view):
        """The camera's place, turned by `view.turn` degrees about the surface point in the middle of the view."""
        pivot = self._pivot(view)
        turn = type(self.to_world)
        axis = self.to_world @ mi.ScalarVector3f(0, 1, 0)
        return turn().translate(pivot) @ turn().rotate(axis, view.turn) @ turn().translate(-pivot) @ self.to_world

    def _pivot(self, view):
        """The surface point that the unturned camera sees in the middle of a view."""
        key = (view.width, view.height, view.crop)
        if key not in self.pivots:
            ray, _ = self.scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
            hit = self.scene.ray_intersect(ray)
            if not hit.is_valid():
                raise ValueError(f"the middle of {view.name} shows no surface for the camera to turn about")
            self.pivots[key] = mi.ScalarVector3f(hit.p)
        return self.pivots[key]

    def glinting_pixels(self, identity, view, side=128):
        """Footprints of the pixels of a view that show the BSDF `identity`, on a grid of `side` by `side` pixels.

        Returns an array of their widths in uv (square roots of the areas), one for each such pixel of the grid: its
        length by the square of `side` is the share of the view that glints.
        """
        self.point_at(view)
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


STRUCTURE = {"structure_bytes": int, "build_seconds": float, "bins": int, "refinement": int}
"""What glint BSDFs say about their data structures."""


def structure(scene):
    """The values of `STRUCTURE` of the scene's glint BSDFs, each counted once; absent if none has it."""
    return structure_of("\n".join(str(shape.bsdf()) for shape in scene.shapes()))


def structure_of(text):
    """The same of descriptions of BSDFs: bytes and seconds add up, of bins and refinements the largest counts.

    Descriptions with the same values, the time to the microsecond among them, are of one BSDF, which several shapes, or
    both sides of one, may have. A method without bins or elements prints 0 of them.
    """
    described = {tuple(printed(part, name) for name in STRUCTURE) for part in text.split("GlintBSDF[")}
    found = {}
    for (name, kind), column in zip(STRUCTURE.items(), zip(*described)):
        counts = name in ("bins", "refinement")
        values = [value for value in column if value is not None and (value or not counts)]
        if values:
            found[name] = kind(max(values) if counts else sum(values))
    return found


def printed(text, name):
    """The number that a description gives for a name, or None."""
    match = re.search(rf"\b{name}\s*[=:]\s*([0-9.eE+-]+)", text)
    return match and float(match.group(1))


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
    prepare_thread()
    return collect_warnings()


def prepare_thread():
    """Choose the variant in this thread, which may be one of a pool, and make this project's plugins known."""
    if mi.variant() != VARIANT:
        mi.set_variant(VARIANT)
    try:
        import mitsuba_glints  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "mitsuba_glints":
            raise
