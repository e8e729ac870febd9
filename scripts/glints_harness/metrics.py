"""Errors of an image against a reference. Images are float arrays of shape (height, width, 3), linear radiance.

Nothing is clipped and no value is replaced: an infinite pixel gives an infinite error, and is counted.
"""

import numpy as np

RELMSE_EPSILON = 0.01
"""Added to the squared reference in the relative MSE, so that black pixels do not divide by zero (radiance squared)."""


def rmse(image, reference):
    """Root mean squared difference over all pixels and channels, in radiance."""
    return float(np.sqrt(np.mean(squared_difference(image, reference))))


def relmse(image, reference):
    """Mean of (image - reference)^2 / (reference^2 + epsilon) over all pixels and channels."""
    reference = np.asarray(reference, dtype=np.float64)
    return float(np.mean(squared_difference(image, reference) / (reference**2 + RELMSE_EPSILON)))


def mean_error(image, reference):
    """Mean of image - reference over all pixels and channels, with its sign, in radiance."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.asarray(image, dtype=np.float64) - reference))


def nonfinite(image):
    """Number of pixels with an infinite or undefined channel."""
    return int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))


def squared_difference(image, reference):
    """(image - reference)^2 in double precision; infinite where `image` is infinite, undefined where it is."""
    with np.errstate(invalid="ignore", over="ignore"):
        return (np.asarray(image, dtype=np.float64) - reference) ** 2


def errors(image, reference):
    """All errors of `image` against a `Reference`, beside those that the reference's own noise would give.

    `at_reference_noise` says that at least half of the measured squared error is expected to be the reference's own:
    then the measurement is an upper bound, and a longer reference is needed to tell methods apart.
    """
    measured = rmse(image, reference.mean)
    noise = reference_noise(reference)
    return {
        "rmse": measured,
        "relmse": relmse(image, reference.mean),
        "mean_error": mean_error(image, reference.mean),
        "mean_reference": float(np.mean(reference.mean)),
        "nonfinite": nonfinite(image),
        **noise,
        "at_reference_noise": bool(measured**2 <= 2 * noise["reference_rmse"] ** 2),
    }


def reference_noise(reference):
    """What an exact image would measure against this reference: expected RMSE, relative MSE, |mean error|."""
    variance = reference.standard_error**2
    return {
        "reference_rmse": float(np.sqrt(np.mean(variance))),
        "reference_relmse": float(np.mean(variance / (reference.mean**2 + RELMSE_EPSILON))),
        "reference_mean_error": float(np.sqrt(np.mean(np.sum(variance, axis=(0, 1)))) / variance[..., 0].size),
    }


def root_mean_square(values):
    """Root of the mean of squares: how RMSEs of several seeds combine."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(np.square(np.asarray(values, dtype=np.float64)))))


def standard_error(values):
    """Standard error of the mean of independent `values`; None for fewer than two."""
    values = np.asarray(values, dtype=np.float64)
    return None if values.size < 2 else float(values.std(ddof=1) / np.sqrt(values.size))
