"""HDR-FLIP (Andersson et al. 2021). Imports neither Mitsuba nor the rest of the harness, so that processes which compute
nothing else start quickly."""

import flip_evaluator
import numpy as np

EXPOSURES = 3
"""Exposures that HDR-FLIP takes the largest error of, evenly spaced in stops over the range that the reference gives.
The published default, about one a stop, costs two to four times as much and reads up to a fifth higher on glints."""


def flip_map(image, reference):
    """HDR-FLIP of every pixel at 67 pixels a degree, array (height, width) of [0, 1]; negative radiance counts as zero.

    The images are to be finite: FLIP passes over other pixels in silence. The exposures depend on the reference alone.
    """
    pair = (np.ascontiguousarray(np.maximum(item, 0), dtype=np.float32) for item in (reference, image))
    found, _, _ = flip_evaluator.evaluate(*pair, "HDR", applyMagma=False, parameters={"numExposures": EXPOSURES})
    return found[..., 0]
