"""The report: one HTML file with Figure 7 of the 2021 paper for these scenes, the plots, the tables and provenance."""

from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np

from . import images, metrics, paper, plots
from .files import write_text
from .methods import METHODS
from .summary import common_spp, select, summarise

CROP_COLOURS = ("#ff5a36", "#ffd23f", "#3ddc97", "#4dabf7")
"""Outlines of the crops in the frame and of their enlargements."""

PLOTS = (("rmse", "spp"), ("rmse", "seconds"), ("relmse", "spp"), ("relmse", "seconds"))


@dataclass(frozen=True)
class Context:
    """What a report is made of."""

    settings: object
    records: list
    references: dict
    """(scene, tiling, view name) to `Reference`."""
    left_out: list
    provenance: dict
    warnings: dict
    exposure: float
    seconds: float

    @property
    def out(self):
        return self.settings.out


def write(context):
    """Write index.html and the pictures and plots in it; returns its path."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters.update(number=number, signed=signed, bytes=bytes_text, percent=percent)
    summaries = summarise(context.records)
    page = environment.get_template("report.html.j2").render(
        context=context,
        settings=context.settings,
        methods=context.settings.methods,
        epsilon=metrics.RELMSE_EPSILON,
        sections=[
            section(context, summaries, scene, tiling)
            for scene in context.settings.scenes
            for tiling in context.settings.tilings
        ],
        costs=costs(context, summaries),
        paper=paper,
        spp=common_spp(summaries),
    )
    path = context.out / "index.html"
    write_text(path, page)
    return path


def section(context, summaries, scene, tiling):
    """One scene at one tiling: a row of Figure 7."""
    mine = select(summaries, scene=scene.name, tiling=tiling)
    views = scene.views(context.settings.size, context.settings.frame_size)
    return {
        "scene": scene,
        "tiling": tiling,
        "tiles": scene.base_tiles * tiling,
        "frames": frames(context, mine, scene, tiling),
        "outlines": [outline(view, colour) for view, colour in crop_views(views)],
        "crops": [crop(context, mine, scene, tiling, view, colour) for view, colour in crop_views(views)],
        "rows": [item for item in mine if item.view != "frame"],
        "frame_rows": select(mine, view="frame"),
        "left_out": [item for item in context.left_out if (item["scene"], item["tiling"]) == (scene.name, tiling)],
    }


def crop_views(views):
    """The crops with their colours."""
    crops = [view for view in views.values() if view.name != "frame"]
    return list(zip(crops, CROP_COLOURS))


def outline(view, colour):
    """Place of a crop in the frame, in percent of the frame."""
    x, y, width, height = (100 * value / view.width for value in view.crop)
    return {"x": x, "y": y, "width": width, "height": height, "colour": colour, "name": view.name}


def frames(context, summaries, scene, tiling):
    """Pictures of the frame, one for each method that has one, and the reference."""
    shown = [
        {"method": item.method, "title": title(item), "uri": picture(context, context.out / item.image)}
        for item in select(summaries, view="frame")
    ]
    return [*shown, reference_picture(context, scene, tiling, "frame")]


def crop(context, summaries, scene, tiling, view, colour):
    """Enlargements and plots of one crop."""
    mine = select(summaries, view=view.name)
    return {
        "name": view.name,
        "colour": colour,
        "place": f"{view.crop[2]} × {view.crop[3]} pixels at ({view.crop[0]}, {view.crop[1]}) of {view.width} × {view.height}",
        "strips": strips(context, mine),
        "reference": reference_picture(context, scene, tiling, view.name),
        "plots": [plot(context, mine, scene, tiling, view, *axes) for axes in PLOTS] if mine else [],
    }


def strips(context, summaries):
    """Rows of enlargements: few samples, many samples, then each time budget; methods side by side."""
    spps = sorted({item.spp for item in summaries if item.time_budget is None})
    groups = [(f"{spp} spp", {"spp": spp, "time_budget": None}) for spp in dict.fromkeys((*spps[:1], *spps[-1:]))]
    budgets = sorted({item.time_budget for item in summaries if item.time_budget is not None})
    groups += [(f"{budget:g} s", {"time_budget": budget}) for budget in budgets]
    return [
        {
            "title": heading,
            "pictures": [strip_picture(context, summaries, method, wanted) for method in context.settings.methods],
        }
        for heading, wanted in groups
    ]


def strip_picture(context, summaries, method, wanted):
    """One method's enlargement, or a gap if the method was left out there."""
    found = select(summaries, method=method.name, **wanted)
    if not found:
        return {"method": method.name, "item": None}
    item = found[0]
    return {
        "method": item.method,
        "title": title(item),
        "uri": picture(context, context.out / item.image),
        "item": item,
    }


def title(item):
    """A picture's caption for pointing devices and screen readers."""
    label = METHODS[item.method].label
    return f"{label}, {item.spp} spp, {item.seconds:.2f} s, RMSE {number(item.rmse)}"


def picture(context, exr):
    """A rendering as PNG beside its EXR, as a URI."""
    path = exr.with_suffix(".png")
    images.write_png(path, images.tone_map(images.read_exr(exr), context.exposure))
    return images.data_uri(path)


def reference_picture(context, scene, tiling, view):
    """The reference as PNG, as a URI."""
    reference = context.references[scene.name, tiling, view]
    path = context.out / "runs" / f"{scene.name}-x{tiling:g}" / view / f"reference-{reference.spp}spp.png"
    images.write_png(path, images.tone_map(reference.mean.astype(np.float32), context.exposure))
    caption = f"Reference, {reference.spp} spp, {reference.batches} seeds, {reference.seconds:.1f} s"
    return {"method": "reference", "title": caption, "uri": images.data_uri(path), "spp": reference.spp}


def plot(context, summaries, scene, tiling, view, y, x):
    """A convergence plot as SVG file and URI."""
    path = context.out / "plots" / f"{scene.name}-x{tiling:g}-{view.name}-{y}-over-{x}.svg"
    plots.convergence(path, summaries, x, y)
    return {"uri": images.data_uri(path), "title": f"{y} over {x}, {scene.name} x{tiling:g} {view.name}"}


def costs(context, summaries):
    """Rows of the table of costs: one for each scene, tiling and method."""
    rows = []
    for scene in context.settings.scenes:
        for tiling in context.settings.tilings:
            for method in context.settings.methods:
                mine = select(summaries, scene=scene.name, tiling=tiling, method=method.name)
                if mine:
                    rows.append(cost(scene, tiling, method, mine, summaries))
    return rows


def cost(scene, tiling, method, mine, summaries):
    """Build time, memory, time per frame and per sample, and the errors at the sample count that all methods have."""
    frame = next(iter(select(mine, view="frame")), None)
    stock = next(iter(select(summaries, scene=scene.name, tiling=tiling, method="normalmap", view="frame")), None)
    spp = common_spp(summaries)
    measured = [item for item in mine if item.view != "frame" and item.time_budget is None and item.spp == spp]
    run = mine[0].runs[0]
    return {
        "scene": scene.name,
        "tiling": tiling,
        "method": method,
        "paper": paper_column(scene.name, method.name),
        "build_seconds": run["build_seconds"],
        "structure_bytes": run["structure_bytes"],
        "bins": run["bins"],
        "frame_seconds": frame and frame.seconds,
        "frame_spp": frame and frame.spp,
        "us_per_sample": frame and frame.mean("us_per_sample"),
        "ratio": frame.mean("cpu_seconds") / stock.mean("cpu_seconds") if frame and stock else None,
        "rmse": metrics.root_mean_square([item.rmse for item in measured]) if measured else None,
        "relmse": sum(item.relmse for item in measured) / len(measured) if measured else None,
        "mean_error": sum(item.mean("mean_error") for item in measured) / len(measured) if measured else None,
        "mean_reference": sum(item.mean("mean_reference") for item in measured) / len(measured) if measured else None,
        "at_reference_noise": bool(measured) and all(item.at_reference_noise for item in measured),
        "nonfinite": sum(item.nonfinite for item in mine),
    }


def paper_column(scene, method):
    """What the paper's Tables 2 and 3 print for a method on a scene, or None."""
    if method != "glints_ibm" or scene not in paper.TABLES_2_AND_3:
        return None
    return paper.TABLES_2_AND_3[scene][0]


def number(value, digits=3):
    """A number with some significant digits; a dash for none."""
    return "–" if value is None else f"{value:.{digits}g}"


def signed(value, digits=2):
    """A number with its sign."""
    return "–" if value is None else f"{value:+.{digits}g}"


def percent(value):
    """A share in percent with its sign."""
    return "–" if value is None else f"{100 * value:+.1f} %"


def bytes_text(value):
    """Bytes in decimal megabytes, as in the paper; a dash for none."""
    if value is None:
        return "–"
    return f"{value / 1e6:.1f} MB" if value >= 1e5 else f"{value} B"
