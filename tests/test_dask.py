"""The comparison on a Dask cluster: the same images as without, also when a worker is killed on the way."""

import os
import signal

import numpy as np
import pytest
from distributed import LocalCluster
from glints_harness import executors, jobs, plan, provenance, render, runs
from glints_harness.compare import Comparison
from glints_harness.methods import METHODS
from glints_harness.progress import Silent
from mini import SCRIPTS

FEW = ("glints_ibm", "normalmap", "roughconductor", "glints_unfiltered")


def settings(scene, folder):
    """A comparison of four methods at two tilings, eight jobs with references of a fixed length."""
    return plan.Settings(
        scenes=(scene,),
        methods=[METHODS[name] for name in FEW],
        tilings=(1.0, 2.0),
        spps=(1, 16),
        seeds=2,
        size=320,
        frame_size=32,
        lighting=render.Lighting(max_depth=2),
        reference_spp=64,
        out=folder / "out",
        cache=folder / "cache",
    )


@pytest.fixture
def cluster(monkeypatch):
    """Two workers, each a process with a nanny that starts another in its place."""
    monkeypatch.setenv("PYTHONPATH", str(SCRIPTS))
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as running:
        yield running


def digests(comparison):
    """Name of each image to the digest of its file."""
    return {record["image"]: record["image_digest"] for record in comparison.records.values()}


def busy_worker(cluster, client):
    """The nanny of a worker that is in the middle of a job."""
    busy = [address for address, tasks in client.processing().items() if tasks]
    assert busy, "no worker has anything to lose"
    return next(nanny for nanny in cluster.workers.values() if nanny.worker_address == busy[0])


def test_a_killed_worker_loses_nothing(mini, cluster, tmp_path, monkeypatch):
    local = Comparison(settings(mini, tmp_path / "local"), executors.Local(), Silent(), {})
    local.render()
    chosen = settings(mini, tmp_path / "dask")
    warnings = {}
    place = executors.Dask(cluster.scheduler_address, {mini.name: mini.text(METHODS["normalmap"], 1)}, warnings)
    assert [(count, "seconds are those of a shared machine" in text) for text, count in warnings.items()] == [
        (2, True)
    ]
    distributed = Comparison(chosen, place, Silent(), {})
    kept, killed = [], []
    receive = distributed.receive

    def kill_a_busy_worker(outcome):
        receive(outcome)
        kept.append(outcome)
        if isinstance(outcome, runs.Finished) and not killed:
            killed.append(busy_worker(cluster, place.client))
            os.kill(killed[0].pid, signal.SIGKILL)

    monkeypatch.setattr(distributed, "receive", kill_a_busy_worker)
    try:
        distributed.render()
    finally:
        place.close()
    assert killed
    rendered = [item.run for item in kept if isinstance(item, runs.Finished)]
    assert len(rendered) == len(set(rendered)) == len(distributed.plan.runs)
    assert digests(distributed) == digests(local)
    for key, reference in local.references.items():
        np.testing.assert_array_equal(reference.mean, distributed.references[key].mean)
    assert not [name for name in (tmp_path / "dask").rglob(".unfinished-*")]

    # The same cache: without the cluster, nothing is left to do.
    again = Comparison(chosen, executors.Local(), Silent(), {})
    assert again.reference_jobs() == [] and again.missing_runs() == []


def test_workers_that_differ_are_refused(mini, monkeypatch):
    with LocalCluster(n_workers=1, threads_per_worker=2, processes=True, dashboard_address=None) as running:
        with pytest.raises(ValueError, match="has 2 threads"):
            executors.Dask(running.scheduler_address, {}, {})
        monkeypatch.setattr(provenance, "plugin_digest", lambda: "another")
        with pytest.raises(ValueError, match="digest of the plugins of worker .* is .*, here another"):
            executors.Dask(running.scheduler_address, {}, {})


def test_a_cluster_without_workers_and_none_at_all_are_named():
    nobody = pytest.raises(ValueError, match="has no workers; start some")
    with LocalCluster(n_workers=0, dashboard_address=None) as running, nobody:
        executors.Dask(running.scheduler_address, {}, {})
    with pytest.raises(ValueError, match="no Dask scheduler answers there"):
        executors.Dask("tcp://127.0.0.1:9", {}, {})


def test_a_worker_with_other_plugins_renders_nothing():
    job = jobs.RenderJob("job", "<scene version='3.0.0'/>", ())
    expected = {"plugins": provenance.plugin_digest(), "machine": executors.kind(provenance.machine())}
    with pytest.raises(RuntimeError, match="this worker's plugins have the digest"):
        executors.work(job, {**expected, "plugins": "another"})
    with pytest.raises(RuntimeError, match="this worker's machine is .*, not .'another', 1"):
        executors.work(job, {**expected, "machine": ("another", 1)})


def test_references_travel_once(mini, tmp_path, monkeypatch):
    """However often they are handed over on the way."""
    monkeypatch.setattr(jobs, "SNAPSHOT_SECONDS", 0.0)
    (job, *_) = Comparison(settings(mini, tmp_path), executors.Local(), Silent(), {}).reference_jobs()
    expected = {"plugins": provenance.plugin_digest(), "machine": executors.kind(provenance.machine())}
    with monkeypatch.context() as patch:
        patch.setattr(render, "collect_warnings", dict)
        patch.setattr(executors, "_warnings", None)
        outcomes, _ = executors.work(job, expected)
    assert [item.key for item in outcomes] == [item.key for item in job.wanted]
    assert all(item.reference.enough(0, 64) for item in outcomes)
