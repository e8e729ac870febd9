"""Runs that differ only in their seed, taken together."""

from dataclasses import dataclass

from . import metrics


@dataclass(frozen=True)
class Summary:
    """One method on one view at one sample count (or time budget), over its seeds."""

    scene: str
    tiling: float
    method: str
    view: str
    spp: int
    time_budget: float
    runs: tuple
    """The records, by ascending seed."""

    def mean(self, key):
        """Mean of a field over the seeds; None if a run lacks it."""
        values = [run[key] for run in self.runs]
        return None if any(value is None for value in values) else sum(values) / len(values)

    @property
    def rmse(self):
        return metrics.root_mean_square([run["rmse"] for run in self.runs])

    @property
    def relmse(self):
        return self.mean("relmse")

    @property
    def seconds(self):
        return self.mean("seconds")

    @property
    def mean_error_uncertainty(self):
        """Standard error of the mean signed error: spread over the seeds and the reference's own; None for one seed."""
        spread = metrics.standard_error([run["mean_error"] for run in self.runs])
        return None if spread is None else (spread**2 + self.runs[0]["reference_mean_error"] ** 2) ** 0.5

    @property
    def at_reference_noise(self):
        """Whether the squared error, over the seeds, is at most twice the reference's own."""
        return self.rmse**2 <= 2 * self.runs[0]["reference_rmse"] ** 2

    @property
    def nonfinite(self):
        """Infinite or undefined pixels of all seeds."""
        return sum(run["nonfinite"] for run in self.runs)

    @property
    def image(self):
        """The image of the first seed."""
        return self.runs[0]["image"]


def summarise(records):
    """Summaries in the order of the records."""
    keys = ("scene", "tiling", "method", "view", "spp", "time_budget")
    groups = {}
    for record in records:
        groups.setdefault(tuple(record[key] for key in keys), []).append(record)
    return [Summary(*key, tuple(runs)) for key, runs in groups.items()]


def select(summaries, **wanted):
    """The summaries whose fields have these values."""
    return [item for item in summaries if all(getattr(item, key) == value for key, value in wanted.items())]


def common_spp(summaries):
    """The largest sample count of crops that every method has in every scene; None if there is none."""
    counts = {}
    for item in summaries:
        if item.view != "frame" and item.time_budget is None:
            counts.setdefault((item.scene, item.tiling, item.method, item.view), set()).add(item.spp)
    shared = set.intersection(*counts.values()) if counts else set()
    return max(shared, default=None)
