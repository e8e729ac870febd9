"""What a comparison finds: runs that differ only in their seed, taken together, and everything a report is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

METRICS = ("rmse", "relmse", "smape", "flip", "mean_error")
"""Names of the errors, as they stand in records and in `Summary.errors`."""


@dataclass(frozen=True)
class Estimate:
    """A number and its 95 % confidence interval; `low == high == value` where no interval can be told."""

    value: float
    low: float
    high: float

    @property
    def certain(self):
        """Whether the interval is known: one seed, or an infinite pixel, tells none."""
        return self.low < self.high


@dataclass(frozen=True)
class ErrorSplit:
    """One error of a method at one point, over its seeds; see `metrics` for how each is defined and estimated.

    For `rmse`, `total` and `noise` are roots, `bias` and `variance` are squares (radiance squared), so that
    total^2 = bias + variance + noise^2. For `relmse`, total = bias + variance + noise. An estimate of a squared bias may
    be negative: then it is not told from zero. For `smape` and `flip`, `bias` is the error of the seeds' mean image and
    `variance` the rest of the total. For `mean_error`, `bias` is the total and `variance` the variance over seeds.
    """

    total: Estimate
    bias: Estimate | None
    """None for a single seed, as is `variance`."""
    variance: Estimate | None
    noise: float
    """What an exact image would measure against this reference."""

    def at_noise(self, metric):
        """Whether this error, that of `metric`, is mostly the reference's own noise.

        Of the squared errors, at least half of the total; of SMAPE and FLIP, where noise and error do not add up, a
        total of at most 1.5 times the noise; of the mean error, at most two standard errors of the reference's mean.
        """
        total = abs(self.total.value)
        if metric == "rmse":
            return total**2 <= 2 * self.noise**2
        return total <= (1.5 if metric in ("smape", "flip") else 2) * self.noise


@dataclass(frozen=True)
class Summary:
    """One method with one footprint rule on one view at one sample count (or time budget), over its seeds."""

    scene: str
    tiling: float
    surface: str
    """Which reference it is measured against, a key of `methods.SURFACES`."""
    method: str
    footprint: str
    """`sample`, `pixel`, a number of pixels, or `none` for a method that ignores the footprint."""
    view: str
    spp: int
    """Of an equal-time point: of the first seed (all seeds have the same)."""
    time_budget: float | None
    budget_includes_build: bool
    """Whether the time budget has to pay for the data structure, too."""
    frame: int | None
    """Number of the frame in the temporal sequence; None outside of it."""
    runs: tuple
    """The records, by ascending seed."""
    errors: dict
    """Metric name to `ErrorSplit`; empty for a view without a reference of this surface (see `compare`)."""
    top_percent_share: float | None
    """Share of the squared error that the worst 1 % of all pixels of all seeds carry. Near one, the tail is heavy:
    intervals from a few seeds are wide, and may still be too narrow."""
    seconds: Estimate
    """Wall-clock seconds of rendering alone."""
    cpu_seconds: Estimate
    us_per_sample: Estimate
    build_seconds: float | None
    """Of the method's data structure; None for a method without one, as are the next two."""
    structure_bytes: int | None
    bins: int | None
    refinement: int | None
    nonfinite: int
    """Infinite or undefined pixels of all seeds."""
    image: str
    """EXR of the first seed, relative to the output folder."""
    mean_image: str
    """EXR of the mean over seeds, relative to the output folder."""

    @property
    def seconds_with_build(self):
        """Seconds of rendering and of building the data structure."""
        return self.seconds.value + (self.build_seconds or 0.0)

    def at_reference_noise(self, metric):
        """Whether an error says more about the reference than about the method; False where it is not measured."""
        return metric in self.errors and self.errors[metric].at_noise(metric)


@dataclass(frozen=True)
class TemporalResult:
    """One method over a sequence of frames of an orbiting camera."""

    scene: str
    tiling: float
    method: str
    """A method's name, or `reference`."""
    footprint: str
    spp: int
    frames: int
    variance: float
    """Mean over pixels and channels of the variance over time (radiance squared); the reference's without its noise: where
    that comes out negative, the references are too noisy to tell it from zero."""
    excess_variance: Estimate
    """Mean over pixels and channels of the variance over time, minus that of the reference; zero for the reference itself."""
    max_trace: tuple
    """Largest luminance in each frame."""
    images: tuple
    """EXRs of the frames, relative to the output folder."""
    excess_image: str | None
    """EXR of every pixel's excess variance, relative to the output folder; None for the reference."""


@dataclass
class Results:
    """Everything a report is made of."""

    settings: object
    """`compare.Settings`."""
    summaries: list
    records: list
    """Every run, as in results.json."""
    references: dict
    """(scene, tiling, surface, view name) to `reference.Reference`."""
    sweep: list
    """Summaries of the first crop at every tiling of the sweep."""
    temporal: list
    """`TemporalResult`s, the reference's first."""
    table_4: dict
    """(scene, method, flake roughness) to what `render.STRUCTURE` names of a bin map, at the paper's roughnesses."""
    left_out: list
    provenance: dict
    warnings: dict
    """Message to how often it came."""
    exposure: float
    """Stops, for pictures."""
    seconds: float
    """Wall-clock seconds so far."""
    out: Path
    prefiltering: list = field(default_factory=list)
    """Summaries of the comparison of environment light with and without prefiltering."""
    ranks: object = None
    """`ranks.Ranks` of the last benchmark, if there is one."""


def select(summaries, **wanted):
    """The summaries whose fields have these values."""
    return [item for item in summaries if all(getattr(item, key) == value for key, value in wanted.items())]


def common_spp(summaries):
    """The largest sample count of crops that every method has in every scene; None if there is none."""
    counts = {}
    for item in summaries:
        if item.view != "frame" and item.time_budget is None:
            counts.setdefault((item.scene, item.tiling, item.method, item.footprint, item.view), set()).add(item.spp)
    shared = set.intersection(*counts.values()) if counts else set()
    return max(shared, default=None)
