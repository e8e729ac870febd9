"""The tables that a comparison ends with on the terminal; the report has them in full."""

from rich.box import SIMPLE_HEAD
from rich.table import Table

from . import paper
from .report.text import bytes_text, number, percent, seconds_text
from .structures import BIN_MAPS
from .summary import common_spp, select

FLAT = "glints_yan16_flat"


def unprepared(settings):
    """(methods, scenes, command that makes it), as names, of what was left out since its precomputation is not kept."""
    scenes = {}
    for scene, methods in settings.unprepared.items():
        for method in methods:
            scenes.setdefault(method, []).append(scene)
    groups = {}
    for method, names in scenes.items():
        groups.setdefault(tuple(names), []).append(method)
    return [
        (methods, names, f"./scripts/compare --scene {','.join(names)} --methods {methods[0]}")
        for names, methods in groups.items()
    ]


def cost_table(results):
    """Build time, memory, times and errors by scene, tiling, method and footprint rule."""
    counts = {scene.name: count_of(results, scene.name) for scene in results.settings.scenes}
    caption = (
        f"s/frame, µs/sample: frames. Errors: crops at {counts_text(counts)}; ≈: mostly the reference's own noise."
    )
    result = Table(caption=caption, box=SIMPLE_HEAD, padding=(0, 1, 0, 0), caption_justify="left")
    for name in ("scene", "method", "footprint"):
        result.add_column(name, no_wrap=True)
    for name in ("build", "memory", "formula", "s/frame", "µs/sample", "RMSE", "rel. MSE", "FLIP", "mean error"):
        result.add_column(name, justify="right", no_wrap=True)
    previous = None
    for curve, items in curves(results.summaries).items():
        if previous not in (None, curve[:2]):
            result.add_section()
        previous = curve[:2]
        result.add_row(*cost_row(results, items, counts[items[0].scene]))
    return result


def count_of(results, scene):
    """The largest sample count that all methods have in a scene, but for those that are rendered at few points."""
    mine = select(results.summaries, scene=scene)
    return common_spp([item for item in mine if not results.settings.method(item.method).sparse])


def counts_text(counts):
    """Sample counts by scene: "4 spp", or "4 spp (shoes, kettle), 1 spp (car_wheel)"."""
    scenes = {}
    for scene, spp in counts.items():
        scenes.setdefault(spp, []).append(scene)
    if len(scenes) < 2:
        return f"{next(iter(scenes), None)} spp"
    return ", ".join(f"{spp} spp ({', '.join(names)})" for spp, names in scenes.items())


def curves(summaries):
    """(scene, tiling, method, footprint) to summaries."""
    found = {}
    for item in summaries:
        found.setdefault((item.scene, item.tiling, item.method, item.footprint), []).append(item)
    return found


def cost_row(results, items, spp):
    """One row's texts."""
    first = items[0]
    name = first.method
    if results.settings.method(name).sparse:
        spp = common_spp(items)
        name = f"{name} ({spp} spp)"
    frame = next((item for item in items if item.view == "frame"), None)
    crops = [item for item in items if item.errors and item.spp == spp and item.time_budget is None]
    return (
        f"{first.scene} x{first.tiling:g}",
        name,
        first.footprint,
        seconds_text(first.build_seconds),
        bytes_text(first.structure_bytes),
        bytes_text(formula_bytes(results, first)),
        number(frame and frame.seconds.value),
        number(frame and frame.us_per_sample.value),
        error_text(crops, "rmse") + noise_mark(crops, "rmse"),
        error_text(crops, "relmse") + noise_mark(crops, "relmse"),
        error_text(crops, "flip") + noise_mark(crops, "flip"),
        mean_error_text(results, crops) + noise_mark(crops, "mean_error") + invalid_text(items),
    )


def formula_bytes(results, item):
    """What a method's formula says about its memory; None without one."""
    method, scene = results.settings.method(item.method), results.settings.scene(item.scene)
    return method.memory and round(method.memory.structure_bytes(scene.texels, item.bins, item.refinement))


def error_text(crops, metric):
    """Mean of an error over the crops."""
    return number(sum(item.errors[metric].total.value for item in crops) / len(crops) if crops else None)


def noise_mark(crops, metric):
    """A mark where an error is mostly the reference's own noise in every crop."""
    return " ≈" if crops and all(item.at_reference_noise(metric) for item in crops) else ""


def mean_error_text(results, crops):
    """Mean error relative to the mean of the references, over the crops."""
    if not crops:
        return "–"
    keys = [(item.scene, item.tiling, item.surface, item.view) for item in crops]
    mean = sum(results.references[key].mean.mean() for key in keys)
    return percent(sum(item.errors["mean_error"].total.value for item in crops) / mean)


def invalid_text(items):
    """How many pixels are not finite, if any are."""
    count = sum(item.nonfinite for item in items)
    return f" ({count} invalid pixels)" if count else ""


def ratio_lines(results):
    """The bin maps beside Yan's flat elements and the paper's ratios, a line for each scene of its tables and bin map."""
    lines = []
    for scene in results.settings.scenes:
        flat = select(results.summaries, scene=scene.name, method=FLAT)
        for name in BIN_MAPS:
            ours = select(results.summaries, scene=scene.name, method=name)
            if flat and ours and scene.name in paper.TABLES_2_AND_3:
                memory = flat[0].structure_bytes / ours[0].structure_bytes
                build = flat[0].build_seconds / ours[0].build_seconds
                lines.append(
                    f"{scene.name}: {FLAT} takes {number(memory, 2)} times the memory of {name} (paper: {paper.MEMORY_RATIO}) "
                    f"and {number(build, 2)} times the build time (paper: {paper.BUILD_RATIO})"
                )
    return lines
