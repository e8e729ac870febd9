"""Plots, in one style: colours that colour-blind people tell apart (Okabe and Ito's), markers and lines that tell the
methods apart without colour, 95 % confidence intervals as bars.

A `Plot` is data only. `draw` writes it as SVG and PDF and returns what a page needs to show it with values on hover.
"""

import io
import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.ticker import FuncFormatter, LogLocator

from ..files import replacing, write_text

STYLES = {
    "glints_ibm": ("#0072B2", "o", "-"),
    "glints_ibm_paper": ("#994F00", "p", "-"),
    "glints_ibm_rough": ("#56B4E9", "P", "-"),
    "glints_yan16_flat": ("#D55E00", "X", "-"),
    "glints_yan16_curved": ("#E69F00", "s", "-"),
    "glints_direct": ("#009E73", "^", "-"),
    "glints_tensor": ("#B8860B", "d", "-"),
    "glints_tensor_prefiltered": ("#00A5A5", ">", "-"),
    "glints_unfiltered": ("#7A5195", "*", "-"),
    "normalmap": ("#CC79A7", "D", "--"),
    "roughconductor": ("#808080", "v", ":"),
    "reference": ("#000000", "", "-"),
    "isotropic": ("#0072B2", "o", "-"),
    "brushed": ("#D55E00", "X", "-"),
    "flakes": ("#009E73", "^", "-"),
}
"""Colour, marker, line of each method, and of each map in plots over rank; dashed and dotted: another reflectance model."""

SPARE_STYLES = (("#F0E442", "h", "-"), ("#4B0092", "<", "-"))

INK, LINE, FAINT, NOISE = "#000000", "#d4d8dd", "#eceef1", "#dfe3e8"
"""Colours of text and axes, of the grid, and of the reference's noise. A page replaces them by its own scheme's."""

WIDTH, AXES_HEIGHT, LEGEND_ROW = 4.4, 3.1, 0.128
"""Inches."""


@dataclass(frozen=True)
class Point:
    """One point of a curve. An infinite or undefined `y` is drawn as a mark at the upper edge."""

    x: float
    y: float
    low: float
    high: float
    text: str
    """What to show on hover."""


@dataclass(frozen=True)
class Series:
    """One curve."""

    method: str
    label: str
    points: tuple
    hollow: bool = False
    """Whether the markers are hollow: the second footprint rule of a method."""


@dataclass(frozen=True)
class Plot:
    """Everything there is to draw."""

    name: str
    """File name without suffix."""
    title: str
    x_label: str
    y_label: str
    series: tuple
    x_base: int = 10
    """Base of the logarithmic x axis; 0 for a linear one."""
    y_log: bool = True
    legend: str = "method · footprint rule"
    """What the labels of the curves say."""
    noise: float = None
    """Below this, a measurement says more about the reference than about the method."""


def style(method):
    """Colour, marker and line of a method."""
    return STYLES.get(method) or SPARE_STYLES[sum(map(ord, method)) % len(SPARE_STYLES)]


def draw(plot, folder):
    """Write `folder`/`plot.name`.svg and .pdf; returns {"svg": text, "points": {group id: [hover text, ...]}}."""
    settings = {"font.size": 10, "svg.hashsalt": plot.name, "svg.fonttype": "none", "font.family": "DejaVu Sans"}
    with plt.rc_context(settings):
        figure, points = compose(plot)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None}, transparent=True)
        write_text(Path(folder) / f"{plot.name}.svg", text.getvalue())
        with replacing(Path(folder) / f"{plot.name}.pdf") as temporary:
            figure.savefig(temporary, metadata={"CreationDate": None})
        plt.close(figure)
    return {"svg": text.getvalue(), "points": points}


def compose(plot):
    """The figure and the hover texts of its groups of markers."""
    rows = 1 + math.ceil((len(plot.series) + (plot.noise is not None)) / 2)
    height = AXES_HEIGHT + LEGEND_ROW * rows
    figure = plt.figure(figsize=(WIDTH, height))
    bottom = (LEGEND_ROW * rows + 0.55) / height
    axes = figure.add_axes((0.155, bottom, 0.825, (height - 0.32) / height - bottom))
    # Not `set_title`, which measures everything in order to find its place.
    axes.text(0, 1.02, plot.title, fontsize=9, transform=axes.transAxes)
    if plot.noise is not None:
        axes.axhspan(
            0 if plot.y_log else -plot.noise, plot.noise, color=NOISE, lw=0, label="reference’s own noise (texels)"
        )
    finish_axes(axes, plot)
    points = {}
    for index, series in enumerate(plot.series):
        points[f"points-{index}"] = draw_series(axes, series, f"points-{index}")
    limit_axes(axes, plot)
    figure.legend(
        fontsize=6.4,
        frameon=False,
        loc="lower center",
        ncols=2,
        handlelength=2.4,
        columnspacing=0.8,
        borderaxespad=0.1,
        title=plot.legend,
        title_fontsize=6.4,
    )
    return figure, points


def draw_series(axes, series, group):
    """One curve by ascending x, with interval bars; returns the hover texts of the markers in the group."""
    colour, marker, line = style(series.method)
    points = sorted(series.points, key=lambda point: point.x)
    finite = [point for point in points if math.isfinite(point.y)]
    endless = [point for point in points if not math.isfinite(point.y)]
    fill = {"markerfacecolor": "none"} if series.hollow else {}
    ys = [point.y for point in points if math.isfinite(point.y)]
    axes.plot(
        [point.x for point in points],
        [point.y if math.isfinite(point.y) else math.nan for point in points],
        color=colour,
        ls=(0, (4, 1.5)) if series.hollow and line == "-" else line,
        marker=marker,
        ms=5,
        lw=1.5,
        label=series.label,
        **fill,
    )
    bars = [[max(0.0, point.y - point.low) for point in finite], [max(0.0, point.high - point.y) for point in finite]]
    if any(bars[0]) or any(bars[1]):
        axes.errorbar(
            [point.x for point in finite], ys, yerr=bars, fmt="none", ecolor=colour, elinewidth=0.9, capsize=2
        )
    # Invisible markers of their own, since those of a curve have no name in an SVG file.
    axes.plot([point.x for point in finite], ys, "o", ms=9, alpha=0, gid=group)
    edge = axes.get_xaxis_transform()
    for point in endless:
        axes.plot([point.x], [0.97], marker=marker or "o", color=colour, ms=5, transform=edge, clip_on=False)
        axes.annotate("∞", (point.x, 0.97), xycoords=edge, color=colour, xytext=(4, -4), textcoords="offset points")
    return [point.text for point in finite]


def finish_axes(axes, plot):
    """Scales, labels, plain numbers, a quiet grid."""
    if plot.x_base:
        axes.set_xscale("log", base=plot.x_base)
    if plot.y_log:
        axes.set_yscale("log", nonpositive="clip")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    else:
        axes.axhline(0, color=LINE, lw=1, zorder=0)
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)
    axes.minorticks_off()
    axes.grid(True, which="major", color=FAINT, lw=0.7)
    axes.set_axisbelow(True)
    plain = FuncFormatter(lambda value, _position: f"{value:g}")
    axes.xaxis.set_major_formatter(plain)
    axes.yaxis.set_major_formatter(plain)
    axes.spines[["top", "right"]].set_visible(False)


def limit_axes(axes, plot):
    """Fit a logarithmic y axis to the finite values and the top of the grey area; intervals may leave it."""
    if not plot.y_log:
        return
    values = [point.y for series in plot.series for point in series.points]
    values = [value for value in [*values, plot.noise or 0.0] if math.isfinite(value) and value > 0]
    if values:
        axes.set_ylim(min(values) / 1.6, max(values) * 1.6)
