"""The page of an image comparison: one HTML file with images, difference, p-values and verdict, without network."""

import base64
import io
from pathlib import Path

import jinja2
import matplotlib
import numpy as np
from matplotlib.image import imsave

from ..files import write_text
from ..images import INVALID_COLOUR, tone_map
from .statistic import BRIGHTNESS, FAMILIES, NOISE, PLACEMENT, Comparison, family
from .text import describe, side_text

GREY = 0.18
"""Tone-mapped brightness of the mean pixel: middle grey."""

STRONGEST = 6.0
"""-log10 of the corrected p-value at the end of the colour scale."""

SHOWN = 12
"""Rows of the table of conspicuous blocks."""

QUESTIONS = {
    BRIGHTNESS: "Is it as bright?",
    PLACEMENT: "Are the highlights where they belong?",
    NOISE: "Is it as noisy, that is, as well filtered?",
}


def write(path, results, arguments):
    """Write the page. `results` are pairs (name, comparison), `arguments` name to text what was compared and how."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    page = environment.get_template("imagediff.html.j2").render(
        sections=[section(name, comparison) for name, comparison in results],
        different=any(comparison.different for _, comparison in results),
        arguments=arguments,
        scale=png(np.linspace(0, 1, 64)[None], "inferno_r"),
        strongest=STRONGEST,
        questions=QUESTIONS,
    )
    write_text(path, page)


def section(name, comparison):
    """What the page shows of one comparison."""
    exposure = -np.log2(max(mean_of_finite(comparison.b.mean), 1e-30)) + np.log2(GREY)
    return {
        "name": name,
        "different": comparison.different,
        "verdict": describe(comparison),
        "sides": {key: side_text(side) for key, side in (("A", comparison.a), ("B", comparison.b))},
        "a": picture(comparison.a.mean, exposure),
        "b": picture(comparison.b.mean, exposure),
        "exposure": exposure,
        "difference": difference(comparison.a.mean, comparison.b.mean),
        "width": comparison.b.mean.shape[1],
        "maps": p_maps(comparison) if isinstance(comparison, Comparison) else differing_map(comparison),
        "findings": comparison.findings()[:SHOWN] if isinstance(comparison, Comparison) else [],
        "alpha": getattr(comparison, "alpha", None),
    }


def mean_of_finite(image):
    """Mean radiance of the pixels that have one; 0 if none has. For the exposure of pictures only."""
    finite = image[np.isfinite(image)]
    return float(np.abs(finite).mean()) if finite.size else 0.0


def picture(image, exposure):
    """A linear image (height, width, channels) as PNG."""
    return png(tone_map(np.broadcast_to(image, (*image.shape[:2], 3)), exposure))


def difference(a, b):
    """Signed difference over the mean of B, from -1 (blue) to 1 (red), as PNG; not finite: magenta."""
    with np.errstate(invalid="ignore"):
        relative = (a - b).mean(axis=-1) / max(mean_of_finite(b), 1e-30)
    return png(relative, "RdBu_r", -1, 1)


def p_maps(comparison):
    """A map of corrected p-values over the blocks for each family of features."""
    blocks = [test for test in comparison.tests if test.p.size > 1] or comparison.tests
    maps = {}
    for name in FAMILIES:
        mine = [test for test in blocks if family(test.feature) == name]
        if mine:
            smallest = comparison.corrected(np.min([test.p for test in mine], axis=0))
            strength = -np.log10(np.maximum(smallest, 1e-300))
            maps[name] = {
                "picture": png(over_pixels(strength, mine[0].grid), "inferno_r", 0, STRONGEST),
                "p": comparison.family_p(name),
            }
    return maps


def over_pixels(values, grid):
    """Values of blocks (rows, columns) spread over the image's pixels."""
    return np.repeat(np.repeat(values, np.diff(grid.rows), axis=0), np.diff(grid.columns), axis=1)


def differing_map(comparison):
    """The pixels in which two single images differ."""
    return {
        "black: pixels that differ": {"picture": png(comparison.differing.astype(float), "inferno_r", 0, 1), "p": None}
    }


def png(values, colours=None, low=None, high=None):
    """8-bit colours (height, width, 3), or numbers (height, width) through a colour map, as the URI of a PNG."""
    data = io.BytesIO()
    if colours is None:
        imsave(data, values, format="png")
    else:
        table = matplotlib.colormaps[colours].with_extremes(bad=np.array(INVALID_COLOUR) / 255)
        imsave(data, np.ma.masked_invalid(values), cmap=table, vmin=low, vmax=high, format="png")
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode("ascii")
