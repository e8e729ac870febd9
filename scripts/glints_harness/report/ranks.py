"""The report's plots and pictures of ranks of the tensor decomposition, from the last benchmark (see `..ranks`)."""

from .. import images
from ..ranks import TILING, UNCOMPRESSED
from . import plots
from .tables import Column, table
from .text import bytes_text, number, seconds_text

QUANTITIES = {
    "precompute": ("value", "precomputation", "seconds", seconds_text),
    "storage": ("ratio", "storage ÷ uncompressed images", "ratio", number),
    "ndf_error": ("value", "error of the finest images", "relative L1", number),
    "frame_error": ("ratio", "squared error of the picture ÷ its mean square", "ratio", number),
    "frame_eval_ratio": ("value", "evaluation only: time ÷ roughconductor", "ratio", number),
    "frame_sample_ratio": ("value", "sampling only: time ÷ roughconductor", "ratio", number),
}
"""Name of a record, after `tensor/`: which of its numbers is plotted, the title, the axis, and how it is written."""


def rank_plots(ranks):
    """{quantity: `plots.Plot`}, a curve for each map; without a benchmark none."""
    found = {}
    for quantity, (field, title, axis, shown) in QUANTITIES.items() if ranks else ():
        mine = [record for record in of_all_ranks(ranks) if record["name"] == f"tensor/{quantity}"]
        if mine:
            found[quantity] = plots.Plot(
                name=f"tensor-{quantity}-over-rank",
                title=title,
                x_label="rank",
                y_label=axis,
                series=tuple(series(mine, label, field, shown) for label in labels(mine)),
                x_base=2,
                legend="map",
            )
    return found


def of_all_ranks(ranks):
    """The records that all ranks have: at further tilings frames are timed with the default rank alone."""
    return [record for record in ranks.records if record["params"].get("tiling", TILING) == TILING]


def labels(records):
    """The maps of records, in their order."""
    return list(dict.fromkeys(record["params"]["map"] for record in records))


def series(records, label, field, shown):
    """The curve of one map."""
    mine = [record for record in records if record["params"]["map"] == label]
    points = tuple(
        plots.Point(
            record["params"]["rank"],
            record[field],
            record[field],
            record[field],
            f"{label}, rank {record['params']['rank']}\n{shown(record[field])}",
        )
        for record in mine
    )
    return plots.Series(label, label, points)


def rank_table(ranks):
    """All numbers, a row for each map and rank."""
    rows = {}
    for record in of_all_ranks(ranks):
        params = record["params"]
        rows.setdefault((params["map"], params["side"], params["rank"]), {})[record["name"]] = record
    columns = [
        Column("map", text=True),
        Column("rank"),
        Column("precomputation", "s"),
        Column("compressed images"),
        Column("÷ uncompressed"),
        Column("error of the finest images", "relative L1"),
        Column("error of the picture", "radiance²"),
        Column("÷ its mean square"),
        Column("evaluation", "÷ roughconductor"),
        Column("sampling", "÷ roughconductor"),
    ]
    cells = [
        (
            f"{label}, {side} × {side}",
            str(rank),
            number(found["tensor/precompute"]["value"]),
            bytes_text(found["tensor/storage"]["value"]),
            number(found["tensor/storage"]["ratio"]),
            number(found["tensor/ndf_error"]["value"]),
            number(found["tensor/frame_error"]["value"]),
            number(found["tensor/frame_error"]["ratio"]),
            number(found["tensor/frame_eval_ratio"]["value"]),
            number(found["tensor/frame_sample_ratio"]["value"]),
        )
        for (label, side, rank), found in rows.items()
    ]
    return table(columns, cells, group_by=(0,))


def rank_pictures(ranks, folder, exposure):
    """Rows of pictures, one for each map: {"map", "shots": [{"title", "uri"}]}; PNGs are written to `folder`."""
    rows = {}
    for item in ranks.pictures:
        file = folder / f"{item['map']}-{item['rank']}.png"
        uri = images.picture_uri(file, images.read_exr(ranks.folder / item["file"]), exposure)
        title = "not compressed" if item["rank"] == UNCOMPRESSED else f"rank {item['rank']}"
        rows.setdefault(item["map"], []).append({"title": title, "uri": uri})
    return [{"map": label, "shots": shots} for label, shots in rows.items()]
