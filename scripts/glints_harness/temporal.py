"""Temporal stability: how much pixels flicker while the camera goes round, beyond what the reference does.

Every frame of the sequence has a reference of its own. With x_t a method's frames, r_t the references', s_t^2 their own
variance, and var_t the unbiased variance over time, the excess variance of a pixel is

    var_t(x_t) - (var_t(r_t) - mean_t s_t^2).

It counts noise and everything that a footprint lets slip; a filter that blurs too much comes out below zero. Its mean over pixels
and channels has a 95 % interval by the bootstrap over blocks of pixels, since neighbours share glints. The largest
luminance of each frame is the trace of Figure 12 of the 2016 paper on filtering normal distributions.
"""

import numpy as np

from .files import write_exr
from .images import read_exr
from .plan import ReferenceKey
from .render import by_point
from .summary import Estimate, TemporalResult

BLOCK = 8
"""Pixels a side of the bootstrap's blocks."""

RESAMPLES = 1000
SEED = 1
"""Of the bootstrap."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Of linear sRGB (Rec. 709)."""


def results(comparison):
    """The sequence's `TemporalResult`s, the reference's first; none if there is no sequence.

    Methods some frames of which were left out have none.
    """
    settings = comparison.settings
    scene, tiling = settings.scenes[0], settings.tilings[0]
    views = settings.sequence(scene, tiling)
    if not views:
        return []
    keys = [ReferenceKey(scene.name, tiling, "texels", view) for view in views]
    references = [comparison.references[key] for key in keys]
    truth = true_variance(references)
    found = [of_reference(keys, references, truth)]
    sequences = by_point(run for run in comparison.records if run.view.frame is not None)
    return found + [
        of_method(settings.out, f"runs/{point.file_of('excess')}", [comparison.records[run] for run in runs], truth)
        for point, runs in sequences.items()
        if len(runs) == len(views)
    ]


def true_variance(references):
    """Variance over time of the exact sequence, per pixel and channel; unbiased, so that it may be negative."""
    means = np.stack([reference.mean for reference in references])
    noise = np.mean([reference.standard_error**2 for reference in references], axis=0)
    return variance_over_time(means) - noise


def variance_over_time(images):
    """Unbiased variance over the first axis; zero for a single frame."""
    return images.var(axis=0, ddof=1) if len(images) > 1 else np.zeros(images.shape[1:])


def of_reference(keys, references, truth):
    """The reference's own trace."""
    return TemporalResult(
        scene=keys[0].scene,
        tiling=keys[0].tiling,
        method="reference",
        footprint="none",
        spp=min(reference.spp for reference in references),
        frames=len(keys),
        variance=float(truth.mean()),
        excess_variance=Estimate(0.0, 0.0, 0.0),
        max_trace=trace(np.stack([reference.mean for reference in references])),
        images=tuple(f"runs/{key.file_name}" for key in keys),
        excess_image=None,
    )


def of_method(out, excess_image, records, truth):
    """One method's excess and trace; writes the excess of every pixel to `excess_image`, a path relative to `out`."""
    images = np.stack([read_exr(out / record["image"]) for record in records]).astype(np.float64)
    with np.errstate(invalid="ignore"):
        variance = variance_over_time(images)
        excess = variance - truth
        write_exr(out / excess_image, excess)
        mean_excess = block_bootstrap(excess.mean(axis=-1))
    return TemporalResult(
        scene=records[0]["scene"],
        tiling=records[0]["tiling"],
        method=records[0]["method"],
        footprint=records[0]["footprint"],
        spp=records[0]["spp"],
        frames=len(records),
        variance=float(variance.mean()),
        excess_variance=mean_excess,
        max_trace=trace(images),
        images=tuple(record["image"] for record in records),
        excess_image=excess_image,
    )


def trace(images):
    """Largest luminance of each image."""
    return tuple(float(value) for value in (images @ LUMINANCE).max(axis=(1, 2)))


def block_bootstrap(pixels):
    """Mean of an array (height, width) with its interval over blocks of `BLOCK` pixels a side."""
    height, width = pixels.shape
    rows, columns = np.arange(height) // BLOCK, np.arange(width) // BLOCK
    index = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    sums, counts = np.bincount(index, pixels.ravel()), np.bincount(index)
    value = float(pixels.mean())
    if not np.isfinite(value) or len(sums) < 2:
        return Estimate(value, value, value)
    drawn = np.random.default_rng(SEED).integers(len(sums), size=(RESAMPLES, len(sums)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return Estimate(value, float(low), float(high))
