"""Measures images: the errors of every run, and `Summary`s over seeds. Works on all processors, since FLIP is slow."""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import metrics, render
from .files import write_exr
from .images import read_exr
from .plan import ReferenceKey, is_measured
from .reference import Reference
from .summary import Summary

IMAGES_PER_PROCESS = 200
"""Fewer are not worth another process."""


@dataclass(frozen=True)
class Point:
    """Images to be measured together. Travels between processes."""

    images: tuple
    mean_image: Path
    """Where to write the mean."""
    reference: Reference | None
    """None: nothing to measure against."""


@dataclass(frozen=True)
class Measured:
    """What is found at a point."""

    runs: tuple
    """`metrics.errors` of each image; empty without a reference."""
    errors: dict
    top_percent_share: float | None


def image_seconds(settings, cores):
    """Seconds that measuring one more image takes, all in all: FLIP of a crop is tried once."""
    crop = settings.first_crop(settings.scenes[0]).crop
    image = np.random.default_rng(1).random((crop[3], crop[2], 3))
    start = time.perf_counter()
    metrics.flip(0.9 * image, image)
    return (time.perf_counter() - start) * (1 + 1 / settings.seeds) / cores


def summaries(comparison):
    """`Run.point` to `Summary` for all points outside of the sequence; completes the comparison's records.

    References get their `noise`, too.
    """
    groups = render.by_point(run for run in comparison.records if run.view.frame is None)
    cores = comparison.executor.machine["cores"]
    with workers(len(comparison.records), cores) as each:
        keys = [key for key in comparison.references if is_measured(key.view)]
        for key, noise in zip(keys, each(metrics.noise_of, [comparison.references[key] for key in keys])):
            comparison.references[key].noise = noise
        tasks = [point_of(comparison, runs) for runs in groups.values()]
        found = {}
        for (point, runs), task, measured in zip(groups.items(), tasks, each(measure, tasks)):
            for run, errors in zip(runs, measured.runs):
                comparison.records[run].update(errors)
            found[point] = summary(comparison, runs, task, measured)
            comparison.progress.advance(comparison.image_seconds * len(measured.runs))
    return found


@contextmanager
def workers(images, cores):
    """A `map` over processes, or the built-in one where there is little to do."""
    count = min(cores, images // IMAGES_PER_PROCESS)
    if count < 2:
        yield map
        return
    # Mitsuba's threads don't survive a fork.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, context, render.prepare_thread) as pool:
        yield pool.map


def point_of(comparison, runs):
    """The `Point` of runs that differ in their seed."""
    run, out = runs[0], comparison.settings.out
    surface = comparison.settings.method(run.method).surface
    key = ReferenceKey(run.scene, run.tiling, surface, run.view)
    return Point(
        images=tuple(out / comparison.records[run]["image"] for run in runs),
        mean_image=out / "runs" / run.file_of("mean"),
        reference=comparison.references.get(key) if is_measured(run.view) else None,
    )


def measure(point):
    """Carry out a `Point`; returns `Measured`, and writes the mean image."""
    images = np.stack([read_exr(path) for path in point.images]).astype(np.float64)
    with np.errstate(invalid="ignore"):
        write_exr(point.mean_image, images.mean(axis=0))
    if point.reference is None:
        return Measured(({},) * len(images), {}, None)
    truth = point.reference.mean
    runs = tuple(metrics.errors(image, truth) for image in images)
    split = metrics.split(images, point.reference, point.reference.noise, runs)
    return Measured(runs, split, metrics.top_percent_share(images, truth))


def summary(comparison, runs, point, measured):
    """The `Summary` of runs that differ in their seed."""
    run, out = runs[0], comparison.settings.out
    records = tuple(comparison.records[item] for item in runs)
    return Summary(
        scene=run.scene,
        tiling=run.tiling,
        surface=records[0]["surface"],
        method=run.method,
        footprint=run.lighting.footprint,
        view=run.view.name,
        spp=records[0]["spp"],
        time_budget=run.time_budget,
        budget_includes_build=run.budget_includes_build,
        frame=run.view.frame,
        runs=records,
        errors=measured.errors,
        top_percent_share=measured.top_percent_share,
        seconds=over_seeds(records, "seconds"),
        cpu_seconds=over_seeds(records, "cpu_seconds"),
        us_per_sample=over_seeds(records, "us_per_sample"),
        **{key: records[0][key] for key in render.STRUCTURE},
        nonfinite=sum(record["nonfinite"] for record in records),
        image=records[0]["image"],
        mean_image=point.mean_image.relative_to(out).as_posix(),
    )


def over_seeds(records, key):
    """Mean of a field over the runs of a point, with its interval."""
    return metrics.mean_estimate([record[key] for record in records])


def of_points(found, runs):
    """The summaries of the points of some runs, in their order."""
    return [found[point] for point in dict.fromkeys(run.point for run in runs) if point in found]
