"""Which plots the report has."""

from ..summary import select
from . import plots
from .text import (
    case_id,
    case_title,
    number,
    sample_text,
    scene_title,
    seconds_text,
    short_label,
    view_title,
    with_interval,
)

METRIC_TITLES = {
    "rmse": "RMSE",
    "relmse": "relative MSE",
    "smape": "SMAPE",
    "flip": "HDR-FLIP",
    "mean_error": "mean error",
}

METRIC_LABELS = {**METRIC_TITLES, "rmse": "RMSE (radiance)", "mean_error": "mean error (radiance)"}

AXES = {
    "spp": "samples per pixel",
    "seconds": "rendering time of the crop (s)",
    "build": "rendering and preprocessing time (s)",
}
"""What an error is plotted over, and the label of the axis."""


def convergence_plots(results):
    """{(case id, view, metric, axis): `Plot`} of every crop."""
    found = {}
    for scene, tiling in results.settings.cases:
        mine = [item for item in select(results.summaries, scene=scene.name, tiling=tiling) if item.frame is None]
        for view in dict.fromkeys(item.view for item in mine if item.view != "frame"):
            points = [item for item in select(mine, view=view) if item.errors]
            for metric in METRIC_TITLES:
                for axis in AXES if metric != "mean_error" else ("spp",):
                    key = (case_id(scene.name, tiling), view, metric, axis)
                    found[key] = convergence(points, scene.name, tiling, view, metric, axis)
    return {key: plot for key, plot in found.items() if plot.series}


def convergence(summaries, scene, tiling, view, metric, axis):
    """Error `metric` of the summaries of one crop over `axis`."""
    shown = [item for item in summaries if belongs(item, axis)]
    noise = [item.errors[metric].noise for item in shown if item.surface == "texels"]
    return plots.Plot(
        name=f"{case_id(scene, tiling)}-{view}-{metric}-over-{'seconds-with-build' if axis == 'build' else axis}",
        title=f"{case_title(scene, tiling)}, {view_title(view)}",
        x_label=AXES[axis],
        y_label=METRIC_LABELS[metric],
        series=curves(shown, lambda item: error_point(item, metric, axis)),
        x_base=2 if axis == "spp" else 10,
        y_log=metric != "mean_error",
        noise=noise[0] if noise else None,
    )


def belongs(item, axis):
    """Whether a summary is a point over this axis. One whose budget had to pay for the structure, too, belongs there."""
    return item.time_budget is None or not item.budget_includes_build or axis == "build"


def error_point(item, metric, axis):
    """A summary's error over `axis`."""
    total = item.errors[metric].total
    x = {"spp": item.spp, "seconds": item.seconds.value, "build": item.seconds_with_build}[axis]
    text = (
        f"{short_label(item)}\n{sample_text(item)}, {len(item.runs)} seeds\n"
        f"{METRIC_TITLES[metric]} {with_interval(total)}\n"
        f"reference’s own noise {number(item.errors[metric].noise)} ({item.surface})\n{seconds_text(item.seconds.value, 3)} rendering"
    )
    if item.build_seconds is not None:
        text += f" + {seconds_text(item.build_seconds, 3)} preprocessing"
    return plots.Point(x, total.value, total.low, total.high, text)


def curves(summaries, point):
    """One `Series` for each method and footprint rule; a method's second rule has hollow markers."""
    series = []
    for label in dict.fromkeys(map(short_label, summaries)):
        mine = [item for item in summaries if short_label(item) == label]
        hollow = mine[0].method in {other.method for other in series}
        series.append(plots.Series(mine[0].method, label, tuple(point(item) for item in mine), hollow))
    return tuple(series)


def sweep_plots(results):
    """{(scene, quantity): `Plot`} of time per sample and RMSE over the texture tiling."""
    found = {}
    for scene in dict.fromkeys(item.scene for item in results.sweep):
        mine = select(results.sweep, scene=scene)
        for quantity, label, point in (
            ("time", "time per sample (µs)", time_point),
            ("rmse", "RMSE (radiance)", lambda item: sweep_error(item, "rmse")),
            ("flip", "HDR-FLIP", lambda item: sweep_error(item, "flip")),
        ):
            measured = [item for item in mine if quantity == "time" or (item.errors and item.surface == "texels")]
            found[scene, quantity] = plots.Plot(
                name=f"{scene}-{quantity}-over-tiling",
                title=f"{scene_title(scene)}, {view_title(mine[0].view)}, {mine[0].spp} spp",
                x_label="texture tiling (texels per pixel ∝ its square)",
                y_label=label,
                series=curves(measured, point),
                x_base=2,
            )
    return found


def prefiltering_plots(results):
    """{quantity: `Plot`} of environment light with and without prefiltering over samples per pixel: errors, and the
    noise alone, as the root of the variance over seeds."""
    shown = [item for item in results.prefiltering if item.errors]
    if not shown:
        return {}
    first = shown[0]
    quantities = {
        "rmse": ("RMSE (radiance)", lambda item: error_point(item, "rmse", "spp")),
        "relmse": ("relative MSE", lambda item: error_point(item, "relmse", "spp")),
        "noise": ("deviation over seeds (radiance)", noise_point),
    }
    return {
        quantity: plots.Plot(
            name=f"prefiltering-{quantity}-over-spp",
            title=f"{case_title(first.scene, first.tiling)}, middle of crop 1",
            x_label=AXES["spp"],
            y_label=label,
            series=curves(shown, point),
            x_base=2,
            noise=None if quantity == "noise" else first.errors[quantity].noise,
        )
        for quantity, (label, point) in quantities.items()
        if quantity != "noise" or all(item.errors["rmse"].variance for item in shown)
    }


def noise_point(item):
    """The root of the variance of one image over its samples per pixel."""
    variance = item.errors["rmse"].variance
    value, low, high = (max(0.0, part) ** 0.5 for part in (variance.value, variance.low, variance.high))
    text = f"{short_label(item)}\n{sample_text(item)}, {len(item.runs)} seeds\nstandard deviation {number(value)}"
    return plots.Point(item.spp, value, low, high, text)


def time_point(item):
    """Microseconds per sample over the tiling."""
    estimate = item.us_per_sample
    text = f"{short_label(item)}\ntiling ×{item.tiling:g}\n{with_interval(estimate)} µs per sample"
    return plots.Point(item.tiling, estimate.value, estimate.low, estimate.high, text)


def sweep_error(item, metric):
    """An error over the tiling."""
    total = item.errors[metric].total
    text = f"{short_label(item)}\ntiling ×{item.tiling:g}\n{METRIC_TITLES[metric]} {with_interval(total)}"
    return plots.Point(item.tiling, total.value, total.low, total.high, text)


def trace_plots(results):
    """{case id: `Plot`} of the brightest pixel of every frame of a sequence, as in Figure 12 of the 2016 paper."""
    found = {}
    for scene, tiling in dict.fromkeys((item.scene, item.tiling) for item in results.temporal):
        mine = [item for item in results.temporal if (item.scene, item.tiling) == (scene, tiling)]
        found[case_id(scene, tiling)] = plots.Plot(
            name=f"{case_id(scene, tiling)}-maximum-over-frames",
            title=f"{case_title(scene, tiling)}: brightest pixel of each frame",
            x_label="frame",
            y_label="largest luminance (radiance)",
            series=tuple(trace(item) for item in mine),
            x_base=0,
        )
    return found


def trace(item):
    """The curve of one method."""
    label = "Reference" if item.method == "reference" else short_label(item)
    points = (
        plots.Point(frame, value, value, value, f"{label}\nframe {frame}\nlargest luminance {number(value)}")
        for frame, value in enumerate(item.max_trace, 1)
    )
    return plots.Series(item.method, label, tuple(points), item.footprint == "pixel")
