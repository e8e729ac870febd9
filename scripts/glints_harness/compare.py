"""The comparison: every method on every scene, tiling and view, each image measured against the reference."""

import math
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import mitsuba as mi

from . import metrics
from .files import replacing, write_json
from .methods import REFERENCE, Method
from .reference import ReferenceStore, batch_spp
from .render import Lighting, LoadedScene, Run

FIRST_SEED = 1
"""Seeds of measured runs count up from here; those of the reference lie far away."""

GUESSED_SAMPLE_SECONDS = 1.5e-6
"""Wall-clock time of one sample, for the progress display until the real one is known."""

LARGEST_FRAME_SHARE = 1 / 8
"""A frame that is predicted to take a larger share of the whole limit is left out."""


@dataclass(frozen=True)
class Settings:
    """What to compare. Sizes in pixels, times in seconds."""

    scenes: tuple
    methods: tuple
    tilings: tuple = (1, 8)
    spps: tuple = (1, 4, 16, 64)
    times: tuple = ()
    seeds: int = 3
    size: int = 800
    """Width and height of the frame that the crops are cut from."""
    frame_size: int = 400
    frame_spp: int = 16
    lighting: Lighting = field(default_factory=Lighting)
    """Of the crops: direct light, which is what the methods filter, unless asked for otherwise."""
    frame_depth: int = 3
    """Longest path of the frames, which are there to be looked at."""
    reference_seconds: float = 8.0
    """Least rendering time of a crop's reference; a frame's has a third."""
    reference_spp: int = None
    reference_method: Method = REFERENCE
    limit: float = None
    """Seconds for the whole comparison; None: no limit. A method gets its share of what is left; runs that are
    predicted to exceed it get fewer seeds, or are left out."""
    out: Path = Path("out/compare")
    cache: Path = Path(".cache/references")

    def lighting_of(self, view):
        """The integrator of a view."""
        return replace(self.lighting, max_depth=self.frame_depth) if is_frame(view) else self.lighting


def is_frame(view):
    """Whether a view is the whole film."""
    return view.name == "frame"


class Comparison:
    """Carries out a comparison, and writes its records after every method."""

    def __init__(self, settings, progress):
        """`progress` has `expect(seconds)`, `advance(seconds)` and `say(text)`."""
        self.settings = settings
        self.progress = progress
        self.store = ReferenceStore(settings.cache, settings.reference_method)
        self.records = []
        self.left_out = []
        self.references = {}
        self.case_reference_seconds = 0.0
        self.start = time.perf_counter()

    def run(self):
        """Do everything; returns the records."""
        cases = [(scene, tiling) for scene in self.settings.scenes for tiling in self.settings.tilings]
        self.progress.expect(len(cases) * self.expected_seconds())
        waiting = len(cases) * len(self.settings.methods)
        for scene, tiling in cases:
            views = scene.views(self.settings.size, self.settings.frame_size)
            self.obtain_references(scene, tiling, views.values())
            for method in self.settings.methods:
                self.progress.say(f"{scene.name} x{tiling:g}: {method.name}")
                MethodRuns(self, scene, tiling, method, views, self.share(waiting)).run()
                self.write_records()
                waiting -= 1
        return self.records

    def obtain_references(self, scene, tiling, views):
        """The references of one scene at one tiling, and how long it took to get them."""
        start = time.perf_counter()
        for view in views:
            self.progress.say(f"{scene.name} x{tiling:g}: reference of {view.name}")
            self.references[scene.name, tiling, view.name] = self.reference(scene, tiling, view)
        self.case_reference_seconds = time.perf_counter() - start

    def reference(self, scene, tiling, view):
        """The reference of one view."""
        settings = self.settings
        seconds = settings.reference_seconds / (3 if is_frame(view) else 1)
        step = view.pixels * batch_spp(view) * GUESSED_SAMPLE_SECONDS
        lighting, spp = settings.lighting_of(view), settings.reference_spp
        return self.store.obtain(scene, tiling, view, lighting, seconds, spp, lambda: self.progress.advance(step))

    def share(self, waiting):
        """Seconds for the next of `waiting` methods, so that the rest fits the limit, too, if it is alike."""
        settings = self.settings
        if settings.limit is None:
            return math.inf
        later_cases = (waiting - 1) // len(settings.methods)
        left = settings.limit - (time.perf_counter() - self.start) - later_cases * self.case_reference_seconds
        return max(0.0, left / waiting)

    def expected_seconds(self):
        """A guess at the time of one scene and tiling, for the progress display."""
        settings = self.settings
        crop_pixels, frame_pixels = 2 * (settings.size / 10) ** 2, settings.frame_size**2
        samples = settings.seeds * sum(settings.spps) * crop_pixels + settings.frame_spp * frame_pixels
        timed = 2 * settings.seeds * sum(settings.times)
        references = (2 + 1 / 3) * settings.reference_seconds
        if settings.reference_spp is not None:
            references = settings.reference_spp * (crop_pixels + frame_pixels) * GUESSED_SAMPLE_SECONDS
        return len(settings.methods) * (samples * GUESSED_SAMPLE_SECONDS + timed) + references

    def write_records(self):
        """Write results.json as far as it has come."""
        write_json(self.settings.out / "results.json", self.records)


class MethodRuns:
    """All runs of one method on one scene at one tiling: the scene is loaded once."""

    def __init__(self, comparison, scene, tiling, method, views, seconds):
        """`seconds` is the time that loading and all runs together may take; half of it belongs to the crops."""
        self.seconds = seconds
        self.end = time.perf_counter() + seconds
        self.comparison = comparison
        self.settings = comparison.settings
        self.scene, self.tiling, self.method = scene, tiling, method
        self.frame = views["frame"]
        self.crops = [view for view in views.values() if not is_frame(view)]
        self.loaded = LoadedScene(scene.text(method, tiling))
        self.sample_seconds = self.pilots()

    def run(self):
        """The frame, then the crops: one seed after the other, from few to many samples, then the time budgets."""
        self.once(self.frame, self.settings.frame_spp, FIRST_SEED)
        self.end = max(self.end, time.perf_counter() + self.seconds / 2)
        seeds = range(FIRST_SEED, FIRST_SEED + self.settings.seeds)
        for seed in seeds:
            for spp in self.settings.spps:
                for crop in self.crops:
                    self.once(crop, spp, seed)
        for budget in self.settings.times:
            for crop in self.crops:
                spp = self.fitting_spp(crop, budget)
                for seed in seeds:
                    self.once(crop, spp, seed, budget)

    def pilots(self):
        """Wall-clock seconds per sample by view, from short renderings that also warm everything up."""
        settings = self.settings
        found = {crop.name: self.pilot(crop, settings.lighting, 1) for crop in self.crops}
        part = self.scene.views(settings.frame_size, settings.frame_size)[self.crops[0].name]
        found[self.frame.name] = self.pilot(part, settings.lighting_of(self.frame), settings.frame_spp)
        return found

    def pilot(self, view, lighting, spp):
        """Wall-clock seconds per sample at a sample count."""
        return self.loaded.render(view, lighting, spp, seed=0).seconds / (view.pixels * spp)

    def fitting_spp(self, view, budget):
        """Samples per pixel that fill `budget` seconds. The cost of a sample depends on their number, so try once."""
        spp = self.samples_in(view, budget / 4)
        seconds = self.loaded.render(view, self.settings.lighting_of(view), spp, seed=0).seconds
        self.sample_seconds[view.name] = seconds / (spp * view.pixels)
        return self.samples_in(view, budget)

    def samples_in(self, view, seconds):
        """Samples per pixel in some seconds at the last known speed; at least one."""
        return max(1, int(seconds / (self.sample_seconds[view.name] * view.pixels)))

    def once(self, view, spp, seed, budget=None):
        """Carry out one run if there is time for it. Equal-time runs always take place."""
        samples = view.pixels * spp
        predicted = self.sample_seconds[view.name] * samples
        if budget is not None or self.affordable(view, predicted):
            lighting = self.settings.lighting_of(view)
            run = Run(self.scene.name, self.tiling, self.method.name, view, lighting, spp, seed, budget)
            rendering = self.loaded.render(view, lighting, spp, seed)
            self.sample_seconds[view.name] = rendering.seconds / samples
            self.keep(run, rendering)
        elif seed == FIRST_SEED:
            self.leave_out(view, spp, predicted)
        self.comparison.progress.advance(budget or samples * GUESSED_SAMPLE_SECONDS)

    def affordable(self, view, predicted):
        """Whether a run of `predicted` seconds fits the time that is left; a frame has to fit the whole limit."""
        if is_frame(view) and self.settings.limit is not None:
            return predicted < LARGEST_FRAME_SHARE * self.settings.limit
        return predicted < self.end - time.perf_counter()

    def keep(self, run, rendering):
        """Write a run's image and keep its record."""
        image = Path("runs") / run.file_name
        with replacing(self.settings.out / image) as temporary:
            mi.Bitmap(rendering.image).write(str(temporary))
        reference = self.comparison.references[run.scene, run.tiling, run.view.name]
        self.comparison.records.append(
            {
                **run.record(),
                "label": self.method.label,
                "model": self.method.model,
                "seconds": rendering.seconds,
                "cpu_seconds": rendering.cpu_seconds,
                "us_per_sample": 1e6 * rendering.seconds / (run.view.pixels * run.spp),
                **metrics.errors(rendering.image, reference),
                "reference_spp": reference.spp,
                "image": image,
                "load_seconds": self.loaded.load_seconds,
                **{key: self.loaded.structure.get(key) for key in ("structure_bytes", "build_seconds", "bins")},
            }
        )

    def leave_out(self, view, spp, predicted):
        """Note a run that would take too long."""
        self.comparison.left_out.append(
            {
                "scene": self.scene.name,
                "tiling": self.tiling,
                "method": self.method.name,
                "view": view.name,
                "spp": spp,
                "predicted_seconds": predicted,
            }
        )
