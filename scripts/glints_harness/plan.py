"""What a comparison consists of: its settings, and the runs and references that follow from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from .methods import SURFACES
from .render import Lighting, Run
from .scenes import View, scene_digest

FIRST_SEED = 1
"""Seeds of measured runs count up from here; those of the references lie far away."""

SWEEP_SPP = 1
"""Samples per pixel of the tiling sweep: footprints are widest, a pixel's own."""

SEQUENCE_SPP = 4
"""Samples per pixel of the temporal sequence."""

PREFILTERING = "prefiltering"
"""Name of the view on which environment light is compared with and without prefiltering."""

PREFILTERING_SIDE = 40
"""Pixels a side of that view, the middle of the first crop."""

PREFILTERING_SPPS = (1, 4, 16, 64)
PREFILTERING_REFERENCE_SPP = 4096
"""Samples per pixel there, up to those of Figure 11 of the 2022 paper, and of its reference."""

MINOR_SHARE = 1 / 3
SEQUENCE_SHARE = 1 / 5
"""Length of a reference relative to a crop's: that of a frame, of another surface than the texels, or of a tiling that
only the sweep visits; that of one frame of the sequence."""


@dataclass(frozen=True)
class Settings:
    """What to compare. Sizes in pixels, times in seconds."""

    scenes: Sequence
    methods: Sequence
    tilings: Sequence[float] = (1.0, 8.0)
    spps: Sequence[int] = (1, 4)
    times: Sequence[float] = ()
    """Budgets for rendering alone, in equal-time comparisons."""
    times_with_build: Sequence[float] = ()
    """Budgets that building the data structure is paid from, too."""
    footprints: Sequence[str] | None = None
    """Footprint rules for every method that filters; None: `sample`, and also `pixel` for the inverse bin map."""
    seeds: int = 8
    size: int = 800
    """Width and height of the frame that the crops are cut from."""
    frame_size: int = 400
    frame_spp: int = 4
    frame_methods: Sequence[str] | None = None
    """Names of the methods that render the frame; None: all."""
    lighting: Lighting = field(default_factory=Lighting)
    """Of the crops: direct light, which is what the methods filter, unless asked for otherwise."""
    frame_depth: int = 3
    """Longest path of the frames, which are there to be looked at and to be timed."""
    sweep: Sequence[float] = ()
    """Tilings of the sweep over texels per pixel: first crop, first scene; for time per sample of all
    methods, and for errors of those of the texels."""
    frames: int = 0
    """Length of the temporal sequence: middle of the first crop, first scene, first tiling; methods of the texels alone."""
    orbit: float = 1.0
    """Degrees that the camera turns in the whole sequence."""
    reference_seconds: float = 8.0
    """Least rendering time of a crop's reference; see `MINOR_SHARE` for others."""
    reference_spp: int | None = None
    """Least samples per pixel of every reference, instead of its time."""
    limit: float | None = None
    """Seconds for the whole comparison; None: no limit. Points that are predicted not to fit are left out."""
    fresh: bool = False
    """Whether to render again what is kept."""
    unprepared: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Name of a scene to names of methods that are left out of it, since their precomputation is not kept yet."""
    out: Path = Path("out/compare")
    cache: Path = Path(".cache")
    """Folder of finished runs and references."""

    def of(self, scene):
        """These settings as far as they hold for one scene: fewer where it is reduced."""
        reduced, unprepared = scene.reduced, self.unprepared.get(scene.name, ())
        methods = tuple(method for method in self.methods if method.name not in unprepared)
        if reduced is None:
            return replace(self, methods=methods)
        methods = tuple(method for method in methods if method.name in reduced.methods)
        return replace(
            self,
            methods=methods,
            frame_methods=reduced.frame_methods,
            tilings=self.tilings[: reduced.tilings] if methods else (),
            spps=self.spps[: reduced.spps],
            times=self.times[: reduced.times],
            times_with_build=self.times_with_build[: reduced.times],
            footprints=(self.footprints or ("sample",))[:1],
        )

    @property
    def cases(self):
        """(scene, tiling) of everything that is compared."""
        return [(scene, tiling) for scene in self.scenes for tiling in self.of(scene).tilings]

    def lighting_of(self, scene, view, method=None, rule="none"):
        """The integrator of a view of a scene, for a method (None: a reference) with a footprint rule."""
        depth = max(scene.max_depth, self.frame_depth if is_frame(view) else self.lighting.max_depth)
        prefilter = method is not None and method.environment_prefilter
        return replace(self.lighting, max_depth=depth, footprint=rule, environment_prefilter=prefilter)

    def rules(self, method):
        """The footprint rules that a method is run with."""
        if not method.filters:
            return ("none",)
        if self.footprints is not None:
            return tuple(self.footprints[:1] if method.sparse else self.footprints)
        return ("sample", "pixel") if method.name == "glints_ibm" else ("sample",)

    def views(self, scene):
        """The views of a scene: the frame, then the crops."""
        return list(scene.views(self.size, self.frame_size).values())

    def first_crop(self, scene):
        """The crop of sweep and sequence."""
        return self.views(scene)[1]

    def sequence(self, scene, tiling):
        """The views of the temporal sequence: the camera goes round evenly, the first frame is unturned.

        None outside of the first scene at the first tiling, nor if no method has the surface of their references.
        """
        wanted = (scene, tiling) == (self.scenes[0], self.tilings[0])
        if not wanted or all(method.surface != "texels" or method.sparse for method in self.of(scene).methods):
            return []
        crop = self.first_crop(scene)
        crop = crop.middle(max(1, crop.crop[2] // 2))
        step = self.orbit / max(1, self.frames - 1)
        return [replace(crop, frame=index, turn=index * step) for index in range(self.frames)]

    def prefiltering(self):
        """(scene, tiling, view, methods) of the comparison of environment light with and without prefiltering, or None.

        It takes the first scene that has such light and a method in both forms.
        """
        for scene, tiling in self.cases:
            methods = self.of(scene).methods
            pairs = [
                (plain, method)
                for method in methods
                if method.environment_prefilter
                for plain in methods
                if not plain.environment_prefilter
                and (plain.plugins, plain.parameters) == (method.plugins, method.parameters)
            ]
            if pairs and scene.has_environment:
                view = replace(self.first_crop(scene).middle(PREFILTERING_SIDE), name=PREFILTERING)
                return scene, tiling, view, pairs[0]
        return None

    def method(self, name):
        """The method of a name."""
        return next(method for method in self.methods if method.name == name)

    def scene(self, name):
        """The scene of a name."""
        return next(scene for scene in self.scenes if scene.name == name)


def is_frame(view):
    """Whether a view is the whole film."""
    return view.name == "frame"


def is_measured(view):
    """Whether images of a view are held against a reference, by `measure`: those of crops are.

    Frames are there to be looked at and to be timed; the sequence has a measure of its own (`temporal`).
    """
    return not is_frame(view) and view.frame is None


class Texts:
    """Resolved scenes and their digests; files are read once."""

    def __init__(self):
        self.kept = {}

    def of(self, scene, method, tiling):
        """(text, digest) of a scene with a method in its slot."""
        key = (scene.name, method.name, tiling)
        if key not in self.kept:
            text = scene.text(method, tiling)
            self.kept[key] = (text, scene_digest(text))
        return self.kept[key]


# ---- runs ------------------------------------------------------------------------------------------------------------


class RunPlan:
    """Every run, as lists of four purposes that may share runs; points stand by falling importance."""

    def __init__(self, settings):
        self.settings = settings
        self.main, self.sweep, self.sequence = [], [], []
        for scene, tiling in settings.cases:
            for method in settings.of(scene).methods:
                self.main += self.main_runs(scene, tiling, method)
        first = settings.scenes[0]
        methods = [method for method in settings.of(first).methods if not method.sparse]
        for method in methods:
            if method.surface == "texels":
                self.sequence += self.sequence_runs(first, method)
        self.prefiltering = self.prefiltering_runs()
        for tiling in settings.sweep:
            for method in methods:
                self.sweep += self.sweep_runs(first, tiling, method)

    @property
    def runs(self):
        """All of them, each once."""
        return list(dict.fromkeys((*self.main, *self.sequence, *self.prefiltering, *self.sweep)))

    def main_runs(self, scene, tiling, method):
        """Few samples in the crops, the frame, equal time, more samples."""
        settings = self.settings.of(scene)
        if method.sparse:
            settings = replace(settings, spps=settings.spps[:1], times_with_build=(), frame_methods=())
        frame, *crops = settings.views(scene)
        rules = settings.rules(method)

        def run(view, rule, spp, seed, **more):
            return Run(
                scene.name,
                tiling,
                method.name,
                view,
                settings.lighting_of(scene, view, method, rule),
                spp,
                seed,
                **more,
            )

        def crop_runs(spp=None, **more):
            return [run(crop, rule, spp, seed, **more) for rule in rules for crop in crops for seed in self.seeds()]

        few = [item for spp in settings.spps[:1] for item in crop_runs(spp)]
        framed = settings.frame_methods is None or method.name in settings.frame_methods
        whole = [run(frame, rule, settings.frame_spp, FIRST_SEED) for rule in rules if framed]
        more = [item for spp in settings.spps[1:] for item in crop_runs(spp)]
        timed = [item for budget in settings.times for item in crop_runs(time_budget=budget)]
        paid = [
            item
            for budget in settings.times_with_build
            for item in crop_runs(time_budget=budget, budget_includes_build=True)
        ]
        return [*few, *whole, *timed, *paid, *more]

    def seeds(self):
        """The seeds of every point."""
        return range(FIRST_SEED, FIRST_SEED + self.settings.seeds)

    def sweep_runs(self, scene, tiling, method):
        """The first crop at one sample count."""
        crop = self.settings.first_crop(scene)
        return [
            Run(
                scene.name,
                tiling,
                method.name,
                crop,
                self.settings.lighting_of(scene, crop, method, rule),
                SWEEP_SPP,
                seed,
            )
            for rule in self.settings.rules(method)
            for seed in self.seeds()
        ]

    def sequence_runs(self, scene, method):
        """One run for each frame of the sequence, each with a seed of its own."""
        settings, tiling = self.settings, self.settings.tilings[0]
        return [
            Run(
                scene.name,
                tiling,
                method.name,
                view,
                settings.lighting_of(scene, view, method, rule),
                SEQUENCE_SPP,
                FIRST_SEED + view.frame,
            )
            for rule in settings.rules(method)
            for view in settings.sequence(scene, tiling)
        ]

    def prefiltering_runs(self):
        """Both methods, with the same footprint at every sample count."""
        case = self.settings.prefiltering()
        if case is None:
            return []
        scene, tiling, view, methods = case
        return [
            Run(
                scene.name,
                tiling,
                method.name,
                view,
                self.settings.lighting_of(scene, view, method, "pixel"),
                spp,
                seed,
            )
            for method in methods
            for spp in PREFILTERING_SPPS
            for seed in self.seeds()
        ]


# ---- references ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ReferenceKey:
    """What a reference is of."""

    scene: str
    tiling: float
    surface: str
    view: View

    @property
    def file_name(self):
        """The name of the mean's image, as `Run.file_name`."""
        folder = f"{self.scene}-x{self.tiling:g}/{self.view.folder}"
        frame = "" if self.view.frame is None else f"-frame{self.view.frame:03d}"
        return f"{folder}/reference-{self.surface}{frame}.exr"


def surfaces_of(methods):
    """The surfaces that methods have, in the order of `SURFACES`."""
    return [name for name in SURFACES if any(method.surface == name for method in methods)]


def references(settings):
    """(key, share of a crop's time) of every reference, each once.

    A frame has a reference of the texels only: it is there to be looked at. So have sequence and sweep; in the sweep,
    methods of other surfaces are there to be timed.
    """
    wanted = {}
    for scene, tiling in settings.cases:
        frame, *crops = settings.views(scene)
        for surface in surfaces_of(settings.of(scene).methods):
            share = 1.0 if surface == "texels" else MINOR_SHARE
            wanted.update({ReferenceKey(scene.name, tiling, surface, crop): share for crop in crops})
        wanted[ReferenceKey(scene.name, tiling, "texels", frame)] = MINOR_SHARE
        for view in settings.sequence(scene, tiling):
            wanted[ReferenceKey(scene.name, tiling, "texels", view)] = SEQUENCE_SHARE
    if case := settings.prefiltering():
        scene, tiling, view, methods = case
        wanted[ReferenceKey(scene.name, tiling, methods[0].surface, view)] = SEQUENCE_SHARE
    first = settings.scenes[0]
    for tiling in settings.sweep if "texels" in surfaces_of(settings.of(first).methods) else ():
        wanted.setdefault(ReferenceKey(first.name, tiling, "texels", settings.first_crop(first)), MINOR_SHARE)
    return list(wanted.items())
