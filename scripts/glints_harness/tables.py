"""The table that a comparison ends with on the terminal."""

from rich.box import SIMPLE_HEAD
from rich.table import Table

from .report import bytes_text, number, percent, signed


def cost_table(rows, spp):
    """The rows of `report.costs` as a table."""
    caption = f"s/frame, µs/sample, × normalmap (processor time): frames. Errors: crops at {spp} spp, ≈ mostly the reference's own noise."
    table = Table(caption=caption, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), caption_justify="left")
    table.add_column("scene", no_wrap=True)
    table.add_column("method", no_wrap=True)
    for name in ("build", "memory", "s/frame", "µs/sample", "× normalmap", "RMSE", "rel. MSE", "mean error"):
        table.add_column(name, justify="right", no_wrap=name != "× normalmap")
    previous = None
    for row in rows:
        if previous not in (None, (row["scene"], row["tiling"])):
            table.add_section()
        previous = (row["scene"], row["tiling"])
        table.add_row(*cells(row))
    return table


def cells(row):
    """One row's texts."""
    build = row["build_seconds"]
    relative = row["mean_error"] / row["mean_reference"] if row["mean_reference"] else None
    invalid = f" ({row['nonfinite']} invalid pixels)" if row["nonfinite"] else ""
    return (
        f"{row['scene']} x{row['tiling']:g}",
        row["method"].name,
        "–" if build is None else f"{build:.2f} s",
        bytes_text(row["structure_bytes"]),
        number(row["frame_seconds"]),
        number(row["us_per_sample"]),
        number(row["ratio"]),
        number(row["rmse"]) + (" ≈" if row["at_reference_noise"] else ""),
        number(row["relmse"]),
        (percent(relative) if relative is not None else signed(row["mean_error"])) + invalid,
    )
