"""Work that a process can do without asking back: load one scene once, and render many runs or references of it.

A job is plain data and travels to other processes; `carry_out` yields results as they come, so that whoever
receives them can keep each at once.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

from . import provenance
from .plan import ReferenceKey, is_measured
from .reference import Reference
from .render import Lighting, LoadedScene, Run, by_point
from .runs import Finished

LOAD_SECONDS = 1.0
"""Guess at the time of loading a scene, for plans."""

SAMPLE_SECONDS = 3e-6
"""Guess at the wall-clock time of a sample, for plans."""

PILOT_SIDE = 24
"""Pixels a side of the first look at a view's cost."""

TRIAL = 0.25
"""Share of a time budget that a first rendering may fill in order to find the sample count."""

PILOT_TOLERANCE, TOLERANCE = 4.0, 1.25
"""How many times a time budget one sample per pixel may take: by the first look, which is rough, and in the end."""

SNAPSHOT_SECONDS = 5.0
"""A reference is handed over this often, so that an interruption loses little."""


@dataclass
class LeftOut:
    """A point that was not rendered, and why."""

    run: Run
    """Of its first seed."""
    reason: str
    predicted_seconds: float
    final: bool = False
    """Whether it stays out however much time there is."""

    def record(self):
        """Flat, as in results.json."""
        return {**self.run.record(), "reason": self.reason, "predicted_seconds": self.predicted_seconds}


@dataclass
class Part:
    """A reference as far as it has come."""

    key: ReferenceKey
    reference: Reference


@dataclass(frozen=True)
class RenderJob:
    """Runs of one method on one scene at one tiling."""

    name: str
    text: str
    """The resolved scene, the method in its slot."""
    runs: tuple
    """`Run`s; those of one point stand together, points by falling importance."""
    image_seconds: float = 0.0
    """What it takes to measure an image later on, which comes out of the job's time."""

    @property
    def expected_seconds(self):
        """A guess, which only weighs jobs against each other."""
        samples = sum(run.view.pixels * run.spp for run in self.runs if run.spp is not None)
        return LOAD_SECONDS + samples * SAMPLE_SECONDS + sum(run.time_budget or 0.0 for run in self.runs)

    def carry_out(self, seconds=math.inf):
        """Yields a `Finished` for each run, or a `LeftOut` for each point that does not fit the `seconds` left.

        A point is rendered with all its seeds or not at all. Loading takes at most half of the time.
        """
        start = time.perf_counter()
        loaded = LoadedScene(self.text)
        stopwatch = Stopwatch(loaded)
        now = time.perf_counter()
        end = now + max(seconds - (now - start), seconds / 2)
        for runs in by_point(self.runs).values():
            budget = rendering_budget(runs[0], loaded)
            if budget is not None and budget <= 0:
                reason = "the time budget is shorter than building the data structure"
                yield LeftOut(runs[0], reason, loaded.structure["build_seconds"], final=True)
                continue
            owed = len(runs) * self.image_seconds if is_measured(runs[0].view) else 0.0
            predicted = owed + len(runs) * (stopwatch.predict(runs[0], runs[0].spp) if budget is None else budget)
            if predicted > end - time.perf_counter():
                yield LeftOut(runs[0], "the time limit", predicted)
                continue
            spp = runs[0].spp if budget is None else stopwatch.fill(runs[0], budget)
            if spp is None:
                reason = "one sample per pixel takes longer than the time budget"
                yield LeftOut(runs[0], reason, stopwatch.predict(runs[0], 1), final=True)
                continue
            for run in runs:
                yield stopwatch.finish(run, spp)
            end -= owed


def rendering_budget(run, loaded):
    """Seconds that a run of an equal-time comparison may render for; None for a run of a given sample count."""
    if run.time_budget is None or not run.budget_includes_build:
        return run.time_budget
    return run.time_budget - loaded.structure.get("build_seconds", 0.0)


class Stopwatch:
    """Renders in a loaded scene and learns from it what a sample costs, by view."""

    def __init__(self, loaded):
        self.loaded = loaded
        self.sample_seconds = {}

    def predict(self, run, spp):
        """Seconds that a run should take with `spp` samples per pixel."""
        return self.speed(run) * run.view.pixels * spp

    def speed(self, run):
        """Seconds a sample; a view that is new is looked at first, which also warms everything up.

        At one sample per pixel, where footprints are widest: dearer than with more, never cheaper.
        """
        key = (run.view.name, run.view.crop, run.lighting)
        if key not in self.sample_seconds:
            view = run.view.middle(PILOT_SIDE)
            self.sample_seconds[key] = self.loaded.render(view, run.lighting, 1, seed=0).seconds / view.pixels
        return self.sample_seconds[key]

    def render(self, run, spp, seed):
        """Render, and note the speed."""
        rendering = self.loaded.render(run.view, run.lighting, spp, seed)
        self.sample_seconds[run.view.name, run.view.crop, run.lighting] = rendering.seconds / (run.view.pixels * spp)
        return rendering

    def fill(self, run, budget):
        """Samples per pixel that fill `budget` seconds; None if a single one takes too long.

        The cost of a sample depends on their number, with footprints that shrink: try, scale, and try again.
        """
        if self.predict(run, 1) > PILOT_TOLERANCE * budget:
            return None
        for share in (TRIAL, 1.0):
            self.render(run, max(1, int(share * budget / self.predict(run, 1))), seed=0)
            if self.predict(run, 1) > TOLERANCE * budget:
                return None
        return max(1, int(budget / self.predict(run, 1)))

    def finish(self, run, spp):
        """Carry out one run."""
        rendering = self.render(run, spp, run.seed)
        return Finished(
            run=run,
            image=rendering.image,
            spp=spp,
            seconds=rendering.seconds,
            cpu_seconds=rendering.cpu_seconds,
            load_seconds=self.loaded.load_seconds,
            date=provenance.now(),
            structure=self.loaded.structure,
            provenance=provenance.environment(),
        )


@dataclass(frozen=True)
class Wanted:
    """A reference to bring to a length."""

    key: ReferenceKey
    lighting: Lighting
    kept: Reference
    """What there is of it already."""
    seconds: float
    spp: int | None = None
    """Least samples per pixel, instead of the seconds of rendering."""

    @property
    def complete(self):
        """Whether nothing is missing."""
        return self.kept.enough(self.seconds, self.spp)

    @property
    def expected_seconds(self):
        """Rendering time that is missing, as far as it can be told."""
        if self.spp is not None:
            return max(0, self.spp - self.kept.spp) * self.key.view.pixels * SAMPLE_SECONDS
        return max(0.0, self.seconds - self.kept.seconds)


@dataclass(frozen=True)
class ReferenceJob:
    """References of one surface of one scene at one tiling."""

    name: str
    text: str
    wanted: tuple

    @property
    def expected_seconds(self):
        return LOAD_SECONDS + sum(item.expected_seconds for item in self.wanted)

    def carry_out(self, _seconds=math.inf):
        """Yields `Part`s, the last of each view complete."""
        loaded = LoadedScene(self.text)
        for item in self.wanted:
            yield from self.refine(loaded, item)

    @staticmethod
    def refine(loaded, item):
        """Add batches to one reference until it is long enough."""
        reference, handed_over = replace(item.kept), time.perf_counter()
        while not reference.enough(item.seconds, item.spp):
            reference.add(loaded.render(item.key.view, item.lighting, reference.batch_spp, reference.next_seed))
            if time.perf_counter() - handed_over > SNAPSHOT_SECONDS:
                handed_over = time.perf_counter()
                yield Part(item.key, replace(reference))
        yield Part(item.key, reference)
