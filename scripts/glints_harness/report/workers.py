"""Processes that draw plots and compute FLIP maps while the report's pictures are packed. What they run imports neither
Mitsuba nor the rest of the harness, so that they start quickly."""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor

import numpy as np


def pool():
    """A pool with a process for every processor."""
    workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def flip_map(image, reference, exposures):
    """HDR-FLIP of every pixel, array (height, width) of [0, 1]; its mean is `metrics.flip`."""
    import flip_evaluator

    pair = (np.ascontiguousarray(np.maximum(item, 0), dtype=np.float32) for item in (reference, image))
    found, _, _ = flip_evaluator.evaluate(*pair, "HDR", applyMagma=False, parameters={"numExposures": exposures})
    return found[..., 0]
