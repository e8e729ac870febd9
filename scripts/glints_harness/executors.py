"""Where jobs are carried out: in this process, or by the workers of a Dask cluster. Both run the same function.

Only the process of the comparison writes files; workers send images and numbers back. A worker needs the project's
environment and the scenes' files under the same paths, which is checked before anything is rendered, and each
process again, since workers may join later.
"""

import math
import os
import platform
from collections import Counter

from . import provenance, render
from .jobs import Part
from .scenes import scene_digest

RETRIES = 3
"""How often a job that failed is tried again. One whose worker died starts again on another in any case."""

CONNECT_SECONDS = 5
"""How long to wait for the scheduler."""

START_WORKERS = "PYTHONPATH=scripts .venv/bin/dask worker ADDRESS --nthreads 1, started in this project's folder"


class Local:
    """Carries jobs out in this process, one after the other."""

    def __init__(self):
        self.machine = provenance.machine()

    def execute(self, jobs, receive, finished, share):
        """`receive` gets each job's outcomes one by one as they come, `finished` each job that is through.

        `share` gives the seconds that the next job may take; it is called with the jobs that are left, that one first.
        """
        for index, job in enumerate(jobs):
            for outcome in job.carry_out(share(jobs[index:])):
                receive(outcome)
            finished(job)

    def close(self):
        """Nothing to do."""


class Dask:
    """Carries jobs out on the workers of an existing Dask cluster."""

    def __init__(self, address, texts, warnings):
        """`texts` are resolved scenes by name, whose files the workers have to have; `warnings` counts theirs, too."""
        try:
            from distributed import Client
        except ModuleNotFoundError as error:
            raise ValueError("--dask needs the package distributed; run scripts/setup") from error
        try:
            self.client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except OSError as error:
            raise ValueError(f"--dask {address}: no Dask scheduler answers there ({error})") from error
        self.warnings = warnings
        try:
            self.machine = self.check(address, texts)
        except ValueError:
            self.close()
            raise

    def check(self, address, texts):
        """The workers' kind of machine, if all have what this process has."""
        try:
            found = self.client.run(describe_worker, texts)
        except Exception as error:
            raise ValueError(
                f"--dask {address}: a worker cannot run this project's code ({type(error).__name__}: {error}); "
                f"workers are to be {START_WORKERS}"
            ) from error
        if not found:
            raise ValueError(f"--dask {address}: the scheduler has no workers; start some: {START_WORKERS}")
        own = describe(texts)
        for worker, described in found.items():
            for key, value in own.items():
                if described[key] != value:
                    raise ValueError(f"--dask {address}: {key} of worker {worker} is {described[key]}, here {value}")
        threads = self.client.nthreads()
        crowded = [worker for worker, count in threads.items() if count != 1]
        if crowded:
            raise ValueError(
                f"--dask {address}: worker {crowded[0]} has {threads[crowded[0]]} threads; renderings at the same time "
                f"in one process would share their timings; workers are to be {START_WORKERS}"
            )
        shared = sum(count for count in Counter(item["host"] for item in found.values()).values() if count > 1)
        if shared:
            self.warnings[
                "Dask workers that share a machine with others: their seconds are those of a shared machine"
            ] = shared
        machines = {kind(item["machine"]) for item in found.values()}
        if len(machines) > 1:
            raise ValueError(
                f"--dask {address}: the workers are different machines ({sorted(machines)}), whose seconds cannot be "
                "compared; use a cluster of one kind"
            )
        return next(iter(found.values()))["machine"]

    def execute(self, jobs, receive, finished, _share):
        """As `Local.execute`, but results come a job at a time, in any order, and no job has a time limit."""
        from distributed import as_completed

        expected = {"plugins": provenance.plugin_digest(), "machine": kind(self.machine)}
        futures = {
            self.client.submit(work, job, expected, key=f"{job.name}-{os.urandom(8).hex()}", retries=RETRIES): job
            for job in jobs
        }
        failures = []
        try:
            for future in as_completed(futures, loop=self.client.loop):
                if future.status == "finished":
                    outcomes, warnings = future.result()
                    for outcome in outcomes:
                        receive(outcome)
                    for message, count in warnings.items():
                        self.warnings[message] = self.warnings.get(message, 0) + count
                    finished(futures[future])
                else:
                    failures.append(f"{futures[future].name}: {future.exception()}")
                future.release()
        finally:
            self.client.cancel(list(futures))
        if failures:
            raise RuntimeError(
                "; ".join([f"{len(failures)} jobs failed on the cluster, the others are kept", *failures])
            )

    def close(self):
        """Leave the cluster as it was."""
        self.client.close()


def describe(texts):
    """What has to be the same on every worker."""
    versions = {f"version of {name}": value for name, value in provenance.versions().items()}
    digests = {f"digest of the files of {name}": scene_digest(text) for name, text in texts.items()}
    return {**versions, "digest of the plugins": provenance.plugin_digest(), **digests}


def describe_worker(texts):
    """`describe`, the machine, and its name."""
    return {**describe(texts), "machine": provenance.machine(), "host": platform.node()}


def kind(machine):
    """What of a machine has to be the same for seconds to be comparable."""
    return machine["processor"], machine["cores"]


_warnings = None


def work(job, expected):
    """Carry out a job in a worker: its outcomes, and the warnings on the way, message to count.

    A worker that has joined since the others were checked has to have the `expected` plugins and kind of machine.
    """
    global _warnings
    render.prepare_thread()
    if _warnings is None:
        _warnings = render.collect_warnings()
    if provenance.plugin_digest() != expected["plugins"]:
        raise RuntimeError(
            f"this worker's plugins have the digest {provenance.plugin_digest()}, not {expected['plugins']}"
        )
    if kind(provenance.machine()) != expected["machine"]:
        raise RuntimeError(
            f"this worker's machine is {kind(provenance.machine())}, not {expected['machine']}; "
            "seconds of different machines cannot be compared"
        )
    _warnings.clear()
    return last_of_each(job.carry_out(math.inf)), dict(_warnings)


def last_of_each(outcomes):
    """The outcomes, of each reference the last `Part` alone: those before are on the way to it."""
    kept = {}
    for outcome in outcomes:
        kept[outcome.key if isinstance(outcome, Part) else outcome.run] = outcome
    return list(kept.values())
