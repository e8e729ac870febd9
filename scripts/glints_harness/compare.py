"""The comparison: every method on every scene, tiling and view, each image measured against its surface's reference.

The plan's runs are gathered into jobs that load one scene with one method once. What the caches hold is taken from there; an
executor carries out the rest. Every result is kept the moment it arrives, so that an interrupted comparison goes on
where it stopped. Errors are measured at the end, from the images.
"""

import math
import time
from dataclasses import asdict
from pathlib import Path

from . import measure, provenance, structures, temporal
from .files import Damaged, duplicate, write_csv, write_exr, write_json
from .jobs import LOAD_SECONDS, LeftOut, Part, ReferenceJob, RenderJob, Wanted
from .methods import SURFACES
from .plan import (
    PREFILTERING,
    PREFILTERING_REFERENCE_SPP,
    ReferenceKey,
    RunPlan,
    Settings,
    Texts,
    is_measured,
    references,
)
from .reference import Reference, ReferenceStore
from .render import STRUCTURE
from .runs import RunCache, description
from .summary import Results

__all__ = ["Comparison", "Settings"]

REPORT_SECONDS = 28.0
"""Kept back from the time limit for what follows the measurements."""


class Comparison:
    """Carries out a comparison."""

    def __init__(self, settings, executor, progress, warnings):
        """`executor` as in `executors`; `progress` has `expect(seconds)`, `advance(seconds)`, `say(text)`; `warnings`
        counts messages."""
        self.settings, self.executor, self.progress, self.warnings = settings, executor, progress, warnings
        self.plan = RunPlan(settings)
        self.store = ReferenceStore(settings.cache / "references")
        self.cache = RunCache(settings.cache / "runs", settings.fresh)
        self.texts = Texts()
        self.references = {}
        """`ReferenceKey` to `Reference`."""
        self.records = {}
        """`Run` to record, flat."""
        self.alphas = {scene.name: scene.alpha for scene in settings.scenes}
        """Flake roughness of each scene's slot."""
        self.provenances = {}
        """What records name by a digest."""
        self.left_out = []
        """`LeftOut`s."""
        self.image_seconds = measure.image_seconds(settings, executor.machine["cores"])
        self.start = time.perf_counter()

    def run(self):
        """Render what is missing, and measure everything; returns `Results`, which then are in the output folder, too."""
        self.render()
        self.progress.say("errors")
        self.records = {run: self.records[run] for run in self.plan.runs if run in self.records}
        found = measure.summaries(self)
        for key, reference in self.references.items():
            write_exr(self.settings.out / "runs" / key.file_name, reference.mean)
        results = Results(
            settings=self.settings,
            summaries=measure.of_points(found, self.plan.main),
            records=list(self.records.values()),
            references={
                (key.scene, key.tiling, key.surface, key.view.name): reference
                for key, reference in self.references.items()
                if key.view.frame is None
            },
            sweep=measure.of_points(found, self.plan.sweep),
            temporal=temporal.results(self),
            prefiltering=measure.of_points(found, self.plan.prefiltering),
            table_4=structures.of_table_4(self.settings),
            left_out=[item.record() for item in self.left_out],
            provenance=provenance.provenance(),
            warnings=self.warnings,
            exposure=0.0,
            seconds=time.perf_counter() - self.start,
            out=self.settings.out,
        )
        self.write(results)
        return results

    def render(self):
        """Render what is missing; afterwards `records`, `references` and `left_out` are complete."""
        reference_jobs, render_jobs = self.reference_jobs(), self.render_jobs(self.missing_runs())
        expected = sum(job.expected_seconds for job in (*reference_jobs, *render_jobs))
        self.progress.expect(expected + self.image_seconds * len(self.plan.runs) + REPORT_SECONDS)
        self.carry_out(reference_jobs, lambda _jobs: math.inf)
        self.carry_out(render_jobs, self.share)
        self.use_what_is_left()

    def use_what_is_left(self):
        """Give the time that quick methods did not need to points that were left out, until nothing more fits."""
        before = None
        while self.settings.limit is not None:
            left = self.time_left()
            again = [item for item in self.left_out if not item.final and item.predicted_seconds < left]
            points = {item.run.point for item in again}
            jobs = self.render_jobs(run for run in self.plan.runs if run.point in points and run not in self.records)
            if len(points) in (0, before) or left < 2 * LOAD_SECONDS * len(jobs):
                return
            before, self.left_out = len(points), [item for item in self.left_out if item not in again]
            self.carry_out(jobs, self.share)

    def carry_out(self, jobs, share):
        """Hand jobs to the executor, and keep what comes back."""
        waiting = list(jobs)

        def finished(job):
            waiting.remove(job)
            self.write_records()
            self.progress.advance(job.expected_seconds)
            if waiting:
                self.progress.say(waiting[0].name)

        if jobs:
            self.progress.say(jobs[0].name)
            self.executor.execute(jobs, self.receive, finished, share)

    def share(self, jobs):
        """Seconds for the first of the jobs that are left, by their expected times."""
        if self.settings.limit is None:
            return math.inf
        return self.time_left() * jobs[0].expected_seconds / sum(job.expected_seconds for job in jobs)

    def time_left(self):
        """Seconds of the limit that are not owed to what comes after rendering."""
        owed = REPORT_SECONDS + self.image_seconds * sum(is_measured(run.view) for run in self.records)
        return max(0.0, self.settings.limit - owed - (time.perf_counter() - self.start))

    def receive(self, outcome):
        """Keep one result."""
        if isinstance(outcome, Part):
            self.store.keep(self.describe_reference(outcome.key), outcome.reference)
            self.references[outcome.key] = outcome.reference
        elif isinstance(outcome, LeftOut):
            self.left_out.append(outcome)
        else:
            self.list_run(outcome.run, self.cache.keep(self.describe(outcome.run), outcome))

    def recover(self, find, *arguments):
        """What `find` finds; what is damaged is reported, and counts as missing."""
        try:
            return find(*arguments)
        except Damaged as damage:
            message = f"damaged, rendered again: {damage}"
            self.warnings[message] = self.warnings.get(message, 0) + 1
            self.progress.say(message)
            return None

    # ---- references --------------------------------------------------------------------------------------------------

    def reference_jobs(self):
        """A job for each scene, tiling and surface that lacks something; what is complete comes from the store."""
        settings, groups = self.settings, {}
        for key, share in references(settings):
            kept = self.recover(self.store.find, self.describe_reference(key)) or Reference.empty(key.view)
            lighting, seconds = self.reference_lighting(key), settings.reference_seconds * share
            wanted = Wanted(key, lighting, kept, seconds, self.reference_spp(key))
            self.references[key] = kept
            if not wanted.complete:
                groups.setdefault((key.scene, key.tiling, key.surface), []).append(wanted)
        return [self.reference_job(*case, wanted) for case, wanted in groups.items()]

    def reference_job(self, scene, tiling, surface, wanted):
        """The job of one group."""
        text, _ = self.texts.of(self.settings.scene(scene), SURFACES[surface], tiling)
        return ReferenceJob(f"{scene} x{tiling:g}: reference ({surface})", text, tuple(wanted))

    def reference_spp(self, key):
        """Least samples per pixel of a reference, or None: then it has a least rendering time."""
        spp = self.settings.reference_spp
        return max(spp or 0, PREFILTERING_REFERENCE_SPP) if key.view.name == PREFILTERING else spp

    def reference_lighting(self, key):
        """The integrator of a reference: that of the runs that are held against it."""
        return self.settings.lighting_of(self.settings.scene(key.scene), key.view)

    def describe_reference(self, key: ReferenceKey):
        """What the store knows a reference by."""
        _, digest = self.texts.of(self.settings.scene(key.scene), SURFACES[key.surface], key.tiling)
        return self.store.describe(key, self.reference_lighting(key), digest)

    # ---- runs --------------------------------------------------------------------------------------------------------

    def missing_runs(self):
        """The runs that are not in the cache; those that are get listed."""
        missing = []
        for run in self.plan.runs:
            kept = self.recover(self.cache.find, self.describe(run))
            if kept is None:
                missing.append(run)
            else:
                self.list_run(run, kept)
        return missing

    def render_jobs(self, runs):
        """A job for each scene, tiling and method of these runs."""
        groups = {}
        for run in runs:
            groups.setdefault((run.scene, run.tiling, run.method), []).append(run)
        return [self.render_job(*case, members) for case, members in groups.items()]

    def render_job(self, scene, tiling, method, runs):
        """The job of one group."""
        text, _ = self.texts.of(self.settings.scene(scene), self.settings.method(method), tiling)
        return RenderJob(f"{scene} x{tiling:g}: {method}", text, tuple(runs), self.image_seconds)

    def describe(self, run):
        """What the cache knows a run by."""
        scene, method = self.settings.scene(run.scene), self.settings.method(run.method)
        return description(run, self.texts.of(scene, method, run.tiling)[1], self.executor.machine)

    def list_run(self, run, kept):
        """Put a kept run's image into the output folder, and its record on the list."""
        image = Path("runs") / run.file_name
        duplicate(self.cache.path(kept["run"]), self.settings.out / image)
        method = self.settings.method(run.method)
        self.provenances[kept["provenance_digest"]] = kept["provenance"]
        self.records[run] = {
            **run.record(),
            "spp": kept["spp"],
            "label": method.label,
            "model": method.model,
            "surface": method.surface,
            "alpha": method.parameters.get("alpha", self.alphas[run.scene]),
            "parameters": dict(method.parameters),
            "nonfinite": kept["nonfinite"],
            "seconds": kept["seconds"],
            "cpu_seconds": kept["cpu_seconds"],
            "us_per_sample": 1e6 * kept["seconds"] / (run.view.pixels * kept["spp"]),
            "load_seconds": kept["load_seconds"],
            **{key: kept["structure"].get(key) for key in STRUCTURE},
            "image": image.as_posix(),
            "image_digest": kept["image_digest"],
            "scene_digest": kept["run"]["scene_digest"],
            "date": kept["date"],
            "provenance": kept["provenance_digest"],
        }

    # ---- what is written ---------------------------------------------------------------------------------------------

    def write_records(self):
        """Write results.json and results.csv as far as they have come, the errors still missing."""
        records = list(self.records.values())
        write_json(self.settings.out / "results.json", {"records": records, "provenances": self.provenances})
        write_csv(self.settings.out / "results.csv", records)

    def write(self, results):
        """Write results.json and results.csv."""
        write_csv(self.settings.out / "results.csv", results.records)
        write_json(
            self.settings.out / "results.json",
            {
                "records": results.records,
                "provenances": self.provenances,
                "summaries": [listed(summary) for summary in results.summaries],
                "sweep": [listed(summary) for summary in results.sweep],
                "prefiltering": [listed(summary) for summary in results.prefiltering],
                "table_4": [
                    {"scene": scene, "method": method, "alpha": alpha, **item}
                    for (scene, method, alpha), item in results.table_4.items()
                ],
                "temporal": [asdict(item) for item in results.temporal],
                "references": [self.listed_reference(*item) for item in self.references.items()],
                "left_out": results.left_out,
                "unprepared": {scene: list(names) for scene, names in self.settings.unprepared.items()},
                "warnings": results.warnings,
                "provenance": results.provenance,
                "seconds": results.seconds,
            },
        )

    @staticmethod
    def listed_reference(key, reference):
        """A reference's line in results.json."""
        noise = {f"noise_{name}": value for name, value in reference.noise.items()}
        return {
            **asdict(key),
            "spp": reference.spp,
            "batches": reference.batches,
            "seconds": reference.seconds,
            **noise,
        }


def listed(summary):
    """A summary's line in results.json: the runs by their seeds."""
    noisy = [name for name in summary.errors if summary.at_reference_noise(name)]
    return {**asdict(summary), "runs": [run["seed"] for run in summary.runs], "at_reference_noise": noisy}
