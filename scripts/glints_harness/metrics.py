"""Errors of images against a reference, split into bias and variance over seeds, with confidence intervals.

Images are float arrays of shape (height, width, 3), linear radiance; means run over all pixels and channels. With an
image x and the reference r:

    rmse        sqrt(mean (x - r)^2), in radiance
    relmse      mean (x - r)^2 / (r^2 + epsilon), epsilon = `RELMSE_EPSILON` in radiance squared
    smape       mean |x - r| / (|x| + |r|), from 0 to 1; a pixel that is black in both counts as 0
    flip        mean HDR-FLIP error (Andersson et al. 2021), from 0 to 1, see `flip_map`
    mean_error  mean (x - r), with its sign, in radiance

**No value is replaced**, but for negative radiance, which FLIP takes as zero. An infinite pixel gives errors that are not
finite, and is counted.

**Split of the squared errors.** With weights w (1, or 1 / (r^2 + epsilon)), N seeds x_i of mean m and variance v per pixel,
and the reference's own variance s^2 (its squared standard error), the mean over seeds of the weighted squared error is

    mean w (x_i - r)^2  =  bias + variance + noise,     averaged over i, exactly, with
    bias     = mean w ((m - r)^2 - v / N - s^2)         unbiased for the squared bias; may come out negative
    variance = mean w v                                 of one image
    noise    = mean w s^2                               what an exact image would measure.

The weights are taken as given: where the reference is as noisy as it is bright, they are off.

SMAPE and FLIP have no exact split: their bias is the error of the mean image m (which still has 1/N of the variance),
and the rest of the total is called variance.

**Intervals** hold 95 %: Student's t with N - 1 degrees of freedom on standard errors by the jackknife over seeds (for a mean
over seeds, the usual ones). That of the squared bias also has the reference's noise, 4 sum (w |m - r| s)^2 + 2 sum
(w s^2)^2 over pixels by their number squared, the three channels taken as fully correlated. Where few pixels carry
most of the error (`top_percent_share`), a few seeds see too little of the tail, and intervals can be too short. The bias of
FLIP has none.
"""

import functools
import math

import numpy as np
from scipy import stats

from .flip import flip_map
from .summary import ErrorSplit, Estimate

CONFIDENCE = 0.95

RELMSE_EPSILON = 0.01
"""Added to the squared reference in the relative MSE, so that black pixels do not divide by zero (radiance squared)."""

NOISE_SEED = 1
"""Of the simulated reference noise in `noise_of`."""


# ---- one image -------------------------------------------------------------------------------------------------------


def rmse(image, reference):
    """Root mean squared difference."""
    return float(np.sqrt(np.mean(squared_difference(image, reference))))


def relmse(image, reference):
    """Mean of the squared difference by the squared reference plus epsilon."""
    return float(np.mean(squared_difference(image, reference) * relative_weight(reference)))


def smape(image, reference):
    """Symmetric mean absolute error: mean of |x - r| / (|x| + |r|), 0 / 0 being no error."""
    image, reference = np.asarray(image, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        scale = np.abs(image) + np.abs(reference)
        return float(np.mean(np.abs(image - reference) / np.where(scale == 0, 1, scale)))


def flip(image, reference):
    """Mean HDR-FLIP error (see `flip_map`); NaN if a pixel is not finite."""
    return math.nan if nonfinite(image) else float(flip_map(image, reference).mean(dtype=np.float64))


def mean_error(image, reference):
    """Mean difference with its sign."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.asarray(image, dtype=np.float64) - reference))


def nonfinite(image):
    """Number of pixels with an infinite or undefined channel."""
    return int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))


def squared_difference(image, reference):
    """(image - reference)^2 in double precision; infinite where `image` is infinite, undefined where it is."""
    with np.errstate(invalid="ignore", over="ignore"):
        return (np.asarray(image, dtype=np.float64) - reference) ** 2


def relative_weight(reference):
    """What the relative MSE weighs squared differences with."""
    return 1 / (np.asarray(reference, dtype=np.float64) ** 2 + RELMSE_EPSILON)


def errors(image, reference):
    """All errors of an image against the array `reference`, by metric name."""
    return {measure.__name__: measure(image, reference) for measure in (rmse, relmse, smape, flip, mean_error)}


def noise_of(reference):
    """What an exact image would be expected to measure against this `Reference`, by metric name.

    From the standard errors for the squared errors and the mean; for SMAPE and FLIP from one simulated reference with this
    one's noise (normal, the same in all channels; FLIP takes negative radiance as zero).
    """
    variance = reference.standard_error**2
    gauss = np.random.default_rng(NOISE_SEED).standard_normal((*variance.shape[:2], 1))
    other = reference.mean + reference.standard_error * gauss
    return {
        "rmse": float(np.sqrt(np.mean(variance))),
        "relmse": float(np.mean(variance * relative_weight(reference.mean))),
        "smape": smape(other, reference.mean),
        "flip": flip(other, reference.mean),
        "mean_error": float(np.sqrt(np.mean(np.sum(variance, axis=(0, 1)))) / variance[..., 0].size),
    }


# ---- several seeds ---------------------------------------------------------------------------------------------------


def split(images, reference, noise, runs):
    """Metric name to `ErrorSplit` for the images of several seeds, shape (seeds, height, width, 3).

    `noise` is `noise_of(reference)`; `runs` are the `errors` of the images.
    """
    with np.errstate(all="ignore"):  # what is not finite stays so
        images = np.asarray(images, dtype=np.float64)
        ones = np.ones_like(reference.mean)
        squared = squared_split(images, reference, ones)
        total = squared["total"]
        rooted = Estimate(root(total.value), root(total.low), root(total.high))
        relative = squared_split(images, reference, relative_weight(reference.mean))
        return {
            "rmse": ErrorSplit(rooted, squared["bias"], squared["variance"], noise["rmse"]),
            "relmse": ErrorSplit(relative["total"], relative["bias"], relative["variance"], noise["relmse"]),
            "smape": smape_split(images, reference.mean, noise["smape"]),
            "flip": flip_split(images, reference.mean, [run["flip"] for run in runs], noise["flip"]),
            "mean_error": mean_error_split([run["mean_error"] for run in runs], noise["mean_error"]),
        }


def root(value):
    """Square root; zero for the lower end of an interval that reaches below zero."""
    return 0.0 if value < 0 else math.sqrt(value)


def squared_split(images, reference, weight):
    """Total, bias and variance of a weighted squared error, see above; a dictionary of estimates."""
    count = len(images)
    differences = images - reference.mean
    totals = (differences**2 * weight).mean(axis=(1, 2, 3))
    if count < 2:
        return {"total": mean_estimate(totals), "bias": None, "variance": None}
    own = float(np.mean(weight * reference.standard_error**2))
    first, second = differences.sum(axis=0), (differences**2).sum(axis=0)

    def bias(a, b, n):
        """From the sums a, b of n differences and of their squares: the mean product of two different seeds'."""
        return float(np.mean(weight * (a**2 - b))) / (n * (n - 1)) - own

    def variance(a, b, n):
        return float(np.mean(weight * (b - a**2 / n))) / (n - 1)

    without = [(first - item, second - item**2) for item in differences]
    uncertainty = reference_uncertainty(first / count, reference.standard_error, weight)
    return {
        "total": mean_estimate(totals),
        "bias": jackknife(
            bias(first, second, count), [bias(*sums, count - 1) for sums in without if count > 2], uncertainty
        ),
        "variance": jackknife(
            variance(first, second, count), [variance(*sums, count - 1) for sums in without if count > 2]
        ),
    }


def reference_uncertainty(bias, standard_error, weight):
    """Standard error that the reference's noise gives to the mean weighted squared bias."""
    linear = (weight * np.abs(bias) * standard_error).sum(axis=-1)
    quadratic = (weight * standard_error**2).sum(axis=-1)
    return math.sqrt(float(np.sum(4 * linear**2 + 2 * quadratic**2))) / bias.size


def smape_split(images, reference, noise):
    """Of SMAPE: the total, the error of the mean image, and the rest."""
    totals = np.array([smape(image, reference) for image in images])
    count = len(images)
    if count < 2:
        return ErrorSplit(mean_estimate(totals), None, None, noise)
    mean = images.mean(axis=0)
    bias = smape(mean, reference)
    biases = [smape((count * mean - image) / (count - 1), reference) for image in images]
    rests = [(totals.sum() - total) / (count - 1) - item for total, item in zip(totals, biases)]
    return ErrorSplit(
        mean_estimate(totals), jackknife(bias, biases), jackknife(float(totals.mean()) - bias, rests), noise
    )


def flip_split(images, reference, totals, noise):
    """Of FLIP: the total, the error of the mean image, and the rest, both without interval."""
    total = mean_estimate(totals)
    if len(images) < 2:
        return ErrorSplit(total, None, None, noise)
    bias = flip(images.mean(axis=0), reference)
    return ErrorSplit(total, exactly(bias), exactly(total.value - bias), noise)


def mean_error_split(totals, noise):
    """Of the mean error: bias and total are the same; the interval has the reference's noise, too."""
    total = mean_estimate(totals, noise)
    if len(totals) < 2:
        return ErrorSplit(total, None, None, noise)
    totals = np.asarray(totals)
    others = [float(np.delete(totals, index).var(ddof=1)) for index in range(len(totals)) if len(totals) > 2]
    return ErrorSplit(total, total, jackknife(float(totals.var(ddof=1)), others), noise)


def exactly(value):
    """An estimate without interval."""
    return Estimate(value, value, value)


def mean_estimate(values, uncertainty=0.0):
    """Mean of independent values with its interval; `uncertainty` is another standard error, independent of theirs."""
    values = np.asarray(values, dtype=np.float64)
    value = float(values.mean())
    if len(values) < 2:
        return exactly(value)
    return interval(value, math.hypot(float(values.std(ddof=1)) / math.sqrt(len(values)), uncertainty), len(values))


def jackknife(value, without, uncertainty=0.0):
    """`value` with the interval that the values `without` one seed each give, and another standard error."""
    if len(without) < 2:
        return exactly(value)
    count = len(without)
    spread = math.sqrt((count - 1) * float(np.var(without)))
    return interval(value, math.hypot(spread, uncertainty), count)


def interval(value, standard_error, count):
    """Student's interval from `count` seeds; none if it is not finite."""
    half = t_quantile(count - 1) * standard_error
    return Estimate(value, value - half, value + half) if math.isfinite(value + half) else exactly(value)


@functools.cache
def t_quantile(degrees):
    """Student's quantile of the two-sided interval."""
    return float(stats.t.ppf((1 + CONFIDENCE) / 2, degrees))


def top_percent_share(images, reference):
    """Share of the squared error that the worst 1 % of all pixels of all seeds carry; None if it is not finite."""
    squares = np.sort(squared_difference(images, reference).sum(axis=-1), axis=None)
    total = float(squares.sum())
    if not math.isfinite(total) or total == 0:
        return None
    return float(squares[-max(1, len(squares) // 100) :].sum()) / total
