"""Processes that draw plots and compute FLIP maps while the report's pictures are packed."""

import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor


def pool():
    """A pool with a process for every processor."""
    workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
