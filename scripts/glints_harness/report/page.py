"""The report: one HTML file with Figure 7 and Tables 2 to 4 of the 2021 paper for these scenes, a viewer of all
pictures, all errors, costs and provenance. It needs no network and no other file."""

import json
from pathlib import Path

import jinja2
import matplotlib
import numpy as np
from markupsafe import Markup

from .. import flip, images, metrics, paper
from ..files import json_ready, write_text
from ..summary import select
from ..tables import unprepared
from . import animation, curves, pictures, plots, ranks, tables, workers
from .curves import AXES, METRIC_TITLES
from .text import case_id, case_title, long_label, method_label, number, scene_title, short_label

TEMPLATES = Path(__file__).parent / "templates"

SCRIPTS = ("report_data.js", "report_colour.js", "report_viewer.js", "report_page.js")
"""In the order in which they use each other."""

COLOUR_TABLES = {"inferno": "inferno", "magma": "magma", "signed": "RdBu_r"}
"""The page's names of matplotlib's colour tables."""

KINDS = ("sweep", "prefiltering", "rank")
"""What plots outside of the scenes' own sections are of: the beginning of their identifiers."""

SCHEME = {
    plots.INK: "currentColor",
    plots.LINE: "var(--line)",
    plots.FAINT: "var(--faint)",
    plots.NOISE: "var(--noise)",
}
"""Colours of a plot that follow the page's light or dark scheme."""


def write(results):
    """Write index.html, plots/ and animations/ into the results' folder; returns the path of index.html."""
    chosen = all_plots(results)
    with workers.pool() as pool:
        drawn = {identity: pool.submit(plots.draw, plot, results.out / "plots") for identity, plot in chosen.items()}
        gallery = pictures.gallery(results, pool)
        sequences = [sequence(results, *case) for case in temporal_cases(results)]
        packed = {identity: packed_plot(future.result()) for identity, future in drawn.items()}
        gallery.finish()
    page = environment().get_template("report.html.j2")
    text = page.render(
        results=results,
        settings=results.settings,
        epsilon=metrics.RELMSE_EPSILON,
        exposures=flip.EXPOSURES,
        paper=paper,
        precision=precision(),
        metrics=METRIC_TITLES,
        axes=AXES,
        figure=[figure_row(results, gallery, chosen, scene, tiling) for scene, tiling in results.settings.cases],
        **page_tables(results),
        **{f"{kind}_plots": [identity for identity in chosen if identity.startswith(f"{kind}/")] for kind in KINDS},
        prefiltering=prefiltering(results),
        unprepared=[
            {"labels": map(method_label, methods), "scenes": map(scene_title, scenes), "command": command}
            for methods, scenes, command in unprepared(results.settings)
        ],
        ranks=rank_section(results),
        largest_tiling=max((item.tiling for item in results.sweep), default=1),
        sequences=sequences,
        css=Markup((TEMPLATES / "report.css").read_text(encoding="utf-8")),
        javascript=Markup("\n".join((TEMPLATES / name).read_text(encoding="utf-8") for name in SCRIPTS)),
        index=script_json({**gallery.index(), **viewer_settings(results)}),
        data={**gallery.data, **packed},
    )
    path = results.out / "index.html"
    write_text(path, text)
    return path


def precision():
    """How far a picture's pixels may be off, in percent: half of the last stored bit."""
    bits = {"crop": pictures.CROP_MANTISSA, "frame": pictures.FRAME_MANTISSA}
    return {view: number(100 * 2.0 ** -(mantissa + 1), 2) for view, mantissa in bits.items()}


def environment():
    """The templates."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )


def script_json(value):
    """JSON that may stand in a script element."""
    return Markup(json.dumps(json_ready(value), allow_nan=False).replace("<", "\\u003c"))


def viewer_settings(results):
    """What the viewer's scripts have to know beside the pictures."""
    return {"exposure": results.exposure, "epsilon": metrics.RELMSE_EPSILON, "colours": colour_tables()}


def colour_tables():
    """Colour tables of 256 entries as hexadecimal text."""
    steps = np.linspace(0, 1, 256)
    return {
        name: (matplotlib.colormaps[source](steps)[:, :3] * 255 + 0.5).astype(np.uint8).tobytes().hex()
        for name, source in COLOUR_TABLES.items()
    }


# ---- plots -----------------------------------------------------------------------------------------------------------


def all_plots(results):
    """{identifier of the page's script element: `plots.Plot`}."""
    found = {f"plot/{'/'.join(key)}": plot for key, plot in curves.convergence_plots(results).items()}
    found.update({f"sweep/{'/'.join(key)}": plot for key, plot in curves.sweep_plots(results).items()})
    found.update({f"trace/{case}": plot for case, plot in curves.trace_plots(results).items()})
    found.update({f"prefiltering/{key}": plot for key, plot in curves.prefiltering_plots(results).items()})
    found.update({f"rank/{key}": plot for key, plot in ranks.rank_plots(results.ranks).items()})
    return found


def packed_plot(drawn):
    """A plot for the page: scalable, in the page's colours, its hover groups findable among many plots."""
    svg = drawn["svg"][drawn["svg"].index("<svg") :]
    head, body = svg.split(">", 1)
    box = head[head.index("viewBox") :].split('"')[1]
    for colour, name in SCHEME.items():
        body = body.replace(f": {colour}", f": {name}")
    svg = f'<svg viewBox="{box}" role="img">{body}'.replace('id="points-', 'data-points="points-')
    return images.deflated(json.dumps({"svg": svg, "points": drawn["points"]}).encode("utf-8"))


# ---- Figure 7 --------------------------------------------------------------------------------------------------------


def figure_row(results, gallery, chosen, scene, tiling):
    """A row of Figure 7: the frame, and for each crop the enlargements in the paper's order and one of the `chosen` plots."""
    case = gallery.case(case_id(scene.name, tiling))
    frame = next((view for view in case["views"] if view["name"] == "frame"), None)
    crops = [view for view in case["views"] if view is not frame]
    return {
        "title": f"{scene_title(scene.name)}, texture tiling ×{tiling:g}",
        "name": scene.name,
        "reduced": scene.reduced is not None,
        "tiles": scene.base_tiles * tiling,
        "map": scene.normal_map.name,
        "alpha": number(scene.alpha, 4),
        "frame": frame_entry(gallery, frame),
        "outlines": [{**view["box"], "colour": view["colour"]} for view in crops],
        "crops": [
            {
                "title": view["title"].capitalize(),
                "colour": view["colour"],
                "place": view["place"],
                "strips": [strip(gallery, group) for group in view["groups"] if not group["mean"]],
                "plot": identity if identity in chosen else "",
            }
            for view in crops
            for identity in [f"plot/{case['id']}/{view['name']}/rmse/seconds"]
        ],
    }


def frame_entry(gallery, view):
    """The frame of the method that the figure is about, or of the first one that has a frame; None without any."""
    if view is None:
        return None
    shots = [index for group in view["groups"] for index in group["shots"]]
    mine = [index for index in shots if gallery.shots[index]["method"] == "glints_ibm"] or shots
    return {"shot": mine[0], **gallery.shots[mine[0]]} if mine else None


def strip(gallery, group):
    """The paper's four methods and the reference at one sample count."""
    entries = []
    for method, name in tables.COLUMNS_OF_FIGURE_7.items():
        mine = [index for index in group["shots"] if gallery.shots[index]["method"] == method]
        gone = "left out" if any(absent["method"] == method for absent in group["absent"]) else "not compared"
        entries.append(strip_entry(gallery, name, mine, gone))
    references = [index for index in group["shots"] if gallery.shots[index]["method"] == "reference"]
    return [*entries, strip_entry(gallery, "Reference", references, "not compared")]


def strip_entry(gallery, name, shots, gone):
    """One enlargement; without one, `gone` says why."""
    if not shots:
        return {"shot": None, "name": name, "label": name, "detail": gone}
    shot = gallery.shots[shots[0]]
    error = f"RMSE {shot['errors']['rmse'].split(' ')[0]}" if "rmse" in shot["errors"] else ""
    if shot["method"] == "reference":
        error = ""
    return {"shot": shots[0], "name": name, "label": shot["label"], "detail": shot["detail"], "error": error}


# ---- tables and sequences --------------------------------------------------------------------------------------------


def page_tables(results):
    """All tables of the page by the names that its template has for them."""
    formulas = {}
    for method in results.settings.methods:
        if method.memory is not None:
            formulas.setdefault(method.memory.text, []).append(method.label)
    return {
        "table_2": tables.table_2_or_3(results, "structure_bytes", f"{paper.MEMORY_RATIO}×"),
        "table_3": tables.table_2_or_3(results, "build_seconds", f"nearly {paper.BUILD_RATIO}×"),
        "table_4": tables.table_4(results),
        "error_cases": error_cases(results),
        "sweep_table": tables.sweep_table(results),
        "temporal_table": tables.temporal_table(results),
        "cost_table": tables.cost_table(results),
        "formulas": formulas,
        "left_out": tables.left_out_table(results),
    }


def error_cases(results):
    """The error tables of every scene and tiling, and the crops that have plots."""
    cases = []
    for scene, tiling in results.settings.cases:
        mine = select(results.summaries, scene=scene.name, tiling=tiling)
        mine = [item for item in mine if item.frame is None and item.errors]
        order = list(dict.fromkeys(map(long_label, mine)))
        mine.sort(key=lambda item: (order.index(long_label(item)), item.view, item.time_budget or 0, item.spp))
        cases.append(
            {
                "id": case_id(scene.name, tiling),
                "title": case_title(scene.name, tiling),
                "views": sorted({item.view for item in mine if item.view != "frame"}),
                "tables": {metric: tables.error_table(results, mine, metric) for metric in METRIC_TITLES},
            }
        )
    return cases


def prefiltering(results):
    """Figure 11 of the 2022 paper: pictures of the most samples, and all numbers; None where it was not compared."""
    shown = [item for item in results.prefiltering if item.errors]
    if not shown:
        return None
    first, most = shown[0], max(item.spp for item in shown)
    key = (first.scene, first.tiling, first.surface, first.view)
    truth = results.references[key]
    panels = [(f"{short_label(item)}, {item.spp} spp", images.read_exr(results.out / item.image)) for item in shown]
    panels = [panel for panel, item in zip(panels, shown) if item.spp == most]
    panels.append((f"Reference, {truth.spp} spp", truth.mean))
    folder = results.out / "plots"
    return {
        "title": case_title(first.scene, first.tiling),
        "shots": [
            {"title": title, "uri": images.picture_uri(folder / f"prefiltering-{index}.png", image, results.exposure)}
            for index, (title, image) in enumerate(panels)
        ],
        "table": tables.prefiltering_table(results),
    }


def rank_section(results):
    """Figures 18 to 20 of the 2022 paper from the last benchmark; None without one."""
    if results.ranks is None:
        return None
    kept = results.ranks.provenance
    return {
        "date": kept["date"],
        "processor": f"{kept['machine']['processor']}, {kept['machine']['cores']} cores",
        "same_plugins": kept["plugins"] == results.provenance["plugins"],
        "rows": ranks.rank_pictures(results.ranks, results.out / "plots", results.exposure),
        "table": ranks.rank_table(results.ranks),
    }


def temporal_cases(results):
    """Scenes and tilings that have a sequence."""
    return list(dict.fromkeys((item.scene, item.tiling) for item in results.temporal))


def sequence(results, scene, tiling):
    """The animation of one scene at one tiling."""
    mine = [item for item in results.temporal if (item.scene, item.tiling) == (scene, tiling)]
    captions = ["Reference" if item.method == "reference" else short_label(item) for item in mine]
    paths = [[results.out / image for image in item.images] for item in mine]
    file = results.out / "animations" / f"{case_id(scene, tiling)}.webp"
    made = animation.write(file, list(zip(captions, paths)), results.exposure)
    flickering = [(short_label(item), results.out / item.excess_image) for item in mine if item.excess_image]
    return {
        "title": case_title(scene, tiling),
        "plot": f"trace/{case_id(scene, tiling)}",
        "uri": images.data_uri(made.path),
        "still": images.data_uri(made.still),
        "width": made.width,
        "height": made.height,
        "alt": ", ".join(captions),
        "file": file.name,
        "excess": excess_picture(file.with_name(f"{file.stem}-excess.png"), flickering) if flickering else None,
    }


def excess_picture(file, panels):
    """The excess variance of one scene at one tiling, from pairs (caption, path)."""
    limit = animation.write_excess(file, panels)
    alt = ", ".join(caption for caption, _ in panels)
    return {"uri": images.data_uri(file), "limit": number(limit, 2), "alt": alt}
