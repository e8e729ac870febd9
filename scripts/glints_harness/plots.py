"""Convergence plots: error over samples per pixel and over time, log-log, in colours that colour-blind people tell
apart (Okabe and Ito's), with markers that tell the methods apart without colour."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from .files import replacing
from .methods import METHODS

STYLES = {
    "glints_ibm": ("#0072B2", "o", "-"),
    "glints_direct": ("#E69F00", "s", "-"),
    "glints_unfiltered": ("#009E73", "^", "-"),
    "normalmap": ("#CC79A7", "D", "--"),
    "roughconductor": ("#666666", "v", ":"),
}
"""Colour, marker, line of each method; dashed and dotted: another reflectance model."""

SPARE_STYLES = (("#56B4E9", "P", "-"), ("#D55E00", "X", "-"), ("#F0E442", "*", "-"))

X_LABELS = {"spp": "samples per pixel", "seconds": "rendering time of the crop (s)"}
Y_LABELS = {"rmse": "RMSE (radiance)", "relmse": "relative MSE"}
NOISE_FIELDS = {"rmse": "reference_rmse", "relmse": "reference_relmse"}


def style(method):
    """Colour, marker and line of a method."""
    if method in STYLES:
        return STYLES[method]
    extra = [name for name in METHODS if name not in STYLES]
    return SPARE_STYLES[extra.index(method) % len(SPARE_STYLES)]


def convergence(path, summaries, x, y):
    """Write a plot of error `y` over `x` for the summaries of one view as SVG.

    Lines join the means over seeds, dots are the seeds. The grey area is where a measurement says more about the
    reference than about the method.
    """
    with plt.rc_context({"font.size": 10, "svg.hashsalt": "glints"}):
        figure, axes = plt.subplots(figsize=(4.4, 3.7), layout="constrained")
        noise = summaries[0].runs[0][NOISE_FIELDS[y]]
        axes.axhspan(0, noise, color="#e4e4e4", lw=0, label="noise of the reference")
        for method in dict.fromkeys(item.method for item in summaries):
            draw_method(axes, [item for item in summaries if item.method == method], x, y)
        finish_axes(axes, x, y)
        limit_axes(axes, summaries, noise, y)
        figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=2)
        with replacing(path) as temporary:
            figure.savefig(temporary, metadata={"Date": None})
        plt.close(figure)


def draw_method(axes, points, x, y):
    """One method's line, by ascending `x`, and the dots of its seeds. Non-finite errors leave a gap."""
    colour, marker, line = style(points[0].method)
    points = sorted(points, key=lambda item: getattr(item, x))
    label = METHODS[points[0].method].label if points[0].method in METHODS else points[0].method
    runs = [run for item in points for run in item.runs]
    axes.plot([run[x] for run in runs], [run[y] for run in runs], ".", color=colour, alpha=0.35, ms=4, mew=0)
    axes.plot(
        [getattr(item, x) for item in points],
        [getattr(item, y) for item in points],
        color=colour,
        marker=marker,
        ls=line,
        ms=5,
        lw=1.6,
        label=label,
    )


def finish_axes(axes, x, y):
    """Log-log axes with plain numbers."""
    axes.set_xscale("log", base=2 if x == "spp" else 10)
    axes.set_yscale("log")
    axes.set_xlabel(X_LABELS[x])
    axes.set_ylabel(Y_LABELS[y])
    axes.grid(True, which="major", color="#dddddd", lw=0.6)
    axes.grid(True, which="minor", axis="y", color="#eeeeee", lw=0.4)
    axes.set_axisbelow(True)
    plain = FuncFormatter(lambda value, _position: f"{value:g}")
    axes.xaxis.set_major_formatter(plain)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.spines[["top", "right"]].set_visible(False)


def limit_axes(axes, summaries, noise, y):
    """Fit the y axis to the finite errors and the top of the grey area."""
    values = [run[y] for item in summaries for run in item.runs]
    values = [value for value in values if np.isfinite(value) and value > 0] + ([noise] if noise > 0 else [])
    if values:
        axes.set_ylim(min(values) / 1.5, max(values) * 1.5)
