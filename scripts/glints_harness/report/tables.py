"""The tables of the report, as data that one template macro lays out."""

from dataclasses import dataclass
from types import SimpleNamespace

from .. import paper
from ..structures import BIN_MAPS, bin_map_of
from ..summary import select
from ..tables import formula_bytes, mean_error_text
from .curves import METRIC_TITLES
from .text import (
    bytes_text,
    case_title,
    interval,
    method_label,
    number,
    sample_text,
    scene_title,
    seconds_text,
    signed,
    view_title,
)

COLUMNS_OF_FIGURE_7 = {
    "glints_ibm": "Ours",
    "glints_yan16_flat": "Yan (flat)",
    "glints_yan16_curved": "Yan (curved)",
    "glints_ibm_rough": "Ours (rough)",
}
"""Methods by the paper's names for them, in its order."""

COLUMNS_OF_TABLES = {
    "glints_ibm": "Ours, compact",
    "glints_ibm_paper": "Ours, published structure",
    "glints_yan16_flat": "Yan (flat)",
    "glints_yan16_curved": "Yan (curved)",
    "glints_ibm_rough": "Ours, compact (rough)",
}
"""Methods of Tables 2 and 3: the paper's, its own in both structures."""

ROWS_OF_TABLE_4 = {"glints_ibm": "compact", "glints_ibm_paper": "published structure"}
"""What `structures.BIN_MAPS` are called in Table 4."""

PRINTED_NAMES = {
    "glints_ibm": "Inverse bin map",
    "glints_ibm_paper": "Inverse bin map",
    "glints_yan16_flat": "Yan flat",
    "glints_yan16_curved": "Yan curved",
    "glints_ibm_rough": "Inverse bin map (rough)",
}
"""Methods by their names in `paper.TABLES_2_AND_3`."""

UNITS = {"rmse": "radiance", "relmse": "", "smape": "", "flip": "", "mean_error": "radiance"}


@dataclass(frozen=True)
class Column:
    """A heading with its unit; text is aligned to the left, numbers to the right."""

    heading: str
    unit: str = ""
    text: bool = False


@dataclass(frozen=True)
class Cell:
    """What stands in a table."""

    text: str
    note: str = ""
    """Smaller, below: an interval, the paper's number."""
    shares: tuple = ()
    """Shares of bias and variance in an error, drawn as a bar."""


@dataclass(frozen=True)
class Table:
    """Columns, and rows of cells; rows whose index is in `groups` begin a group."""

    columns: tuple
    rows: tuple
    groups: frozenset = frozenset()


def cell(value):
    """Text as a cell."""
    return value if isinstance(value, Cell) else Cell(value)


def table(columns, rows, group_by=None):
    """A `Table`; rows that differ in the cells `group_by` from the one before begin a group."""
    rows = tuple(tuple(map(cell, row)) for row in rows)
    starts = ()
    if group_by is not None:
        heads = [tuple(row[index] for index in group_by) for row in rows]
        starts = (index for index in range(1, len(rows)) if heads[index] != heads[index - 1])
    return Table(tuple(columns), rows, frozenset(starts))


def method_cell(item):
    """A method with its footprint rule below."""
    return Cell(method_label(item.method), "" if item.footprint == "none" else f"footprint: {item.footprint}")


# ---- Tables 2 to 4 of the 2021 paper ---------------------------------------------------------------------------------


def structures(results, scene):
    """{method: summary} of one scene at its first tiling: a structure does not depend on the tiling."""
    mine = select(results.summaries, scene=scene.name)
    return {item.method: item for item in reversed(mine) if item.structure_bytes is not None}


def table_2_or_3(results, quantity, ratio):
    """Table 2 (`quantity` = structure_bytes) or 3 (build_seconds): ours in both structures, and the paper's number below.

    `ratio` is what the paper says of Yan's flat elements over its own method, in the scenes of its tables.
    """
    shown = bytes_text if quantity == "structure_bytes" else seconds_text
    rows = []
    for scene in results.settings.scenes:
        mine = structures(results, scene)
        printed = f"paper {ratio}" if scene.name in paper.TABLES_2_AND_3 else ""
        cells = [Cell(f"{scene_title(scene.name)} scene")]
        for method in COLUMNS_OF_TABLES:
            measured = getattr(mine[method], quantity) if method in mine else None
            cells.append(Cell(shown(measured), printed_text(scene.name, method, quantity)))
        cells += [Cell(flat_over(mine, name, quantity), printed) for name in BIN_MAPS]
        rows.append(cells)
    headings = [*COLUMNS_OF_TABLES.values(), *(f"Yan (flat) ÷ {ROWS_OF_TABLE_4[name]}" for name in BIN_MAPS)]
    return table([Column("", text=True), *map(Column, headings)], rows)


def flat_over(mine, name, quantity):
    """Yan's flat elements over a bin map."""
    if not {name, "glints_yan16_flat"} <= set(mine):
        return "–"
    return f"{number(getattr(mine['glints_yan16_flat'], quantity) / getattr(mine[name], quantity), 2)}×"


def printed_text(scene, method, quantity):
    """What the paper prints for a method on a scene; empty for scenes that it does not have."""
    found = [item for item in paper.TABLES_2_AND_3.get(scene, ()) if item.method == PRINTED_NAMES.get(method)]
    if not found:
        return ""
    return f"paper {found[0].memory if quantity == 'structure_bytes' else found[0].build}"


def table_4(results):
    """Bins and memory of both bin maps by flake roughness, at the paper's roughnesses and at those that were rendered."""
    measured = {key: (item["bins"], item["structure_bytes"]) for key, item in results.table_4.items()}
    for scene in results.settings.scenes:
        found = structures(results, scene)
        for method in results.settings.of(scene).methods:
            if method.name in found and bin_map_of(method) is not None:
                item = found[method.name]
                alpha = method.parameters.get("alpha", scene.alpha)
                measured[scene.name, bin_map_of(method), alpha] = item.bins, item.structure_bytes
    alphas = sorted({*paper.TABLE_4, *(alpha for _, _, alpha in measured)})
    bins = {key[1:]: count for key, (count, _) in measured.items()}
    rows = []
    for name, title in ROWS_OF_TABLE_4.items():
        rows.append([f"bin resolution b², {title}", *(bins_cell(bins.get((name, alpha)), alpha) for alpha in alphas)])
    for scene in results.settings.scenes:
        for name, title in ROWS_OF_TABLE_4.items():
            cells = (memory_cell(measured.get((scene.name, name, alpha)), scene.name, alpha) for alpha in alphas)
            rows.append([f"{scene_title(scene.name)} scene, {title}", *cells])
    return table([Column("Beckmann roughness α", text=True), *(Column(number(alpha)) for alpha in alphas)], rows)


def bins_cell(bins, alpha):
    """Bins per side, measured and printed."""
    printed = f"paper {paper.TABLE_4[alpha].bins}²" if alpha in paper.TABLE_4 else ""
    return Cell("–" if bins is None else f"{bins}²", printed)


def memory_cell(measured, scene, alpha):
    """Memory, measured and printed; `measured` is a pair of bins and bytes, or None."""
    printed = ""
    if alpha in paper.TABLE_4 and scene in paper.TABLE_4[alpha].megabytes:
        printed = f"paper {paper.TABLE_4[alpha].megabytes[scene]} MB"
    return Cell("–" if measured is None else bytes_text(measured[1]), printed)


# ---- errors ----------------------------------------------------------------------------------------------------------


def error_table(results, summaries, metric):
    """One error of every summary of a case, split into bias and variance."""
    columns = [
        Column("method and footprint rule", text=True),
        Column("view", text=True),
        Column("samples", text=True),
        Column("seeds"),
        Column("time", "s"),
        Column(METRIC_TITLES[metric], UNITS[metric]),
        *split_columns(metric),
        Column("reference’s own noise", UNITS[metric]),
        Column("invalid pixels"),
    ]
    measured = [item for item in summaries if metric in item.errors]
    return table(columns, [error_row(results, item, metric) for item in measured], group_by=(0, 1))


def split_columns(metric):
    """The headings of the split, which differ by what adds up."""
    if metric == "mean_error":
        return [Column("of the mean"), Column("variance over seeds", "radiance²")]
    if metric == "rmse":
        parts = [Column("bias²", "radiance²"), Column("variance", "radiance²"), Column("shares", text=True)]
        return [*parts, Column("carried by the worst 1 % of pixels")]
    first = "of the mean image" if metric in ("smape", "flip") else "bias²"
    return [Column(first), Column("variance" if metric == "relmse" else "rest"), Column("shares", text=True)]


def error_row(results, item, metric):
    """One summary's error and its split."""
    split = item.errors[metric]
    noise_mark = " ≈" if item.at_reference_noise(metric) else ""
    shown = signed if metric == "mean_error" else number
    if metric == "mean_error":
        parts = [Cell(mean_error_text(results, [item])), estimate_cell(split.variance)]
    else:
        parts = [estimate_cell(split.bias), estimate_cell(split.variance), Cell("", shares=shares(split))]
    if metric == "rmse":
        share = item.top_percent_share
        parts.append("–" if share is None else f"{100 * share:.0f} %")
    return (
        method_cell(item),
        view_title(item.view),
        sample_text(item),
        str(len(item.runs)),
        Cell(number(item.seconds.value), interval(item.seconds)),
        Cell(shown(split.total.value) + noise_mark, interval(split.total)),
        *parts,
        number(split.noise),
        str(item.nonfinite),
    )


def estimate_cell(estimate):
    """An estimate with its interval below; a dash where a single seed cannot tell."""
    return Cell("–") if estimate is None else Cell(number(estimate.value), interval(estimate))


def shares(split):
    """Shares of bias and variance of their sum, as in a bar; a negative estimate is none. Empty if unknown."""
    if split.bias is None or split.variance is None:
        return ()
    parts = [max(0.0, split.bias.value), max(0.0, split.variance.value)]
    return tuple(part / sum(parts) for part in parts) if 0 < sum(parts) < float("inf") else ()


# ---- sweep, sequence, costs ------------------------------------------------------------------------------------------


def sweep_table(results):
    """Time per sample and errors at every tiling."""
    columns = [
        Column("scene", text=True),
        Column("method and footprint rule", text=True),
        Column("tiling"),
        Column("samples", text=True),
        Column("time per sample", "µs"),
        Column("RMSE", "radiance"),
        Column("relative MSE"),
        Column("HDR-FLIP"),
    ]
    rows = [
        (
            scene_title(item.scene),
            method_cell(item),
            f"×{item.tiling:g}",
            sample_text(item),
            estimate_cell(item.us_per_sample),
            *(estimate_cell(item.errors[name].total if item.errors else None) for name in ("rmse", "relmse", "flip")),
        )
        for item in results.sweep
    ]
    return table(columns, rows, group_by=(0, 1))


def prefiltering_table(results):
    """Errors with and without prefiltered environment light, split into bias and variance."""
    columns = [
        Column("method and footprint rule", text=True),
        Column("samples", text=True),
        Column("time", "s"),
        Column("RMSE", "radiance"),
        Column("bias²", "radiance²"),
        Column("variance", "radiance²"),
        Column("relative MSE"),
        Column("HDR-FLIP"),
    ]
    rows = [
        (
            method_cell(item),
            sample_text(item),
            Cell(number(item.seconds.value), interval(item.seconds)),
            estimate_cell(item.errors["rmse"].total),
            estimate_cell(item.errors["rmse"].bias),
            estimate_cell(item.errors["rmse"].variance),
            *(estimate_cell(item.errors[name].total) for name in ("relmse", "flip")),
        )
        for item in results.prefiltering
        if item.errors
    ]
    return table(columns, rows, group_by=(0,))


def temporal_table(results):
    """Excess variance over time of every sequence."""
    columns = [
        Column("scene", text=True),
        Column("method and footprint rule", text=True),
        Column("samples", text=True),
        Column("frames"),
        Column("variance over time", "radiance²"),
        Column("excess variance", "radiance²"),
        Column("largest luminance", "radiance"),
    ]
    rows = [
        (
            case_title(item.scene, item.tiling),
            method_cell(item),
            f"{item.spp} spp",
            str(item.frames),
            number(item.variance),
            Cell("–") if item.method == "reference" else estimate_cell(item.excess_variance),
            number(max(item.max_trace)),
        )
        for item in results.temporal
    ]
    return table(columns, rows, group_by=(0,))


def cost_table(results):
    """Build time, memory (measured and by formula), time per frame and per sample, by scene, tiling and method."""
    columns = [
        Column("scene", text=True),
        Column("method and footprint rule", text=True),
        Column("samples", text=True),
        Column("build", "s"),
        Column("memory, measured"),
        Column("memory, by formula"),
        Column("bins per side"),
        Column("frame", "s"),
        Column("time per sample", "µs"),
        Column("processor time ÷ stock normalmap"),
        Column("invalid pixels"),
    ]
    frames = [item for item in results.summaries if item.view == "frame" and item.frame is None]
    return table(columns, [cost_row(results, item, frames) for item in frames], group_by=(0,))


def cost_row(results, item, frames):
    """The costs of one frame."""
    stock = [
        other
        for other in select(frames, scene=item.scene, tiling=item.tiling, method="normalmap")
        if other.spp == item.spp
    ]
    ratio = item.cpu_seconds.value / stock[0].cpu_seconds.value if stock else None
    return (
        case_title(item.scene, item.tiling),
        method_cell(item),
        sample_text(item),
        number(item.build_seconds, 2),
        bytes_text(item.structure_bytes),
        bytes_text(formula_bytes(results, item)),
        number(item.bins),
        estimate_cell(item.seconds),
        estimate_cell(item.us_per_sample),
        number(ratio),
        str(item.nonfinite),
    )


def left_out_table(results):
    """Points without a picture, and why."""
    columns = [
        Column("scene", text=True),
        Column("method", text=True),
        Column("view", text=True),
        Column("samples", text=True),
        Column("reason", text=True),
        Column("predicted time", "s"),
    ]
    rows = [
        (
            case_title(item["scene"], item["tiling"]),
            method_cell(SimpleNamespace(**item)),
            view_title(item["view"]) + ("" if item["frame"] is None else ", sequence"),
            f"{item['spp']} spp" if item["time_budget"] is None else f"{item['time_budget']:g} s",
            item["reason"],
            number(item["predicted_seconds"], 2),
        )
        for item in results.left_out
    ]
    return table(columns, rows)
