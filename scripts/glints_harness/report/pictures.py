"""The pictures of the report as floating-point data, and which of them stand side by side.

A *shot* is one picture: a method's rendering, the mean of its seeds, or a reference. A page holds each shot once, as
packed data (see `images.pack`), and tone-maps it itself.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np

from .. import images
from ..files import digest_text
from ..flip import flip_map
from ..summary import select
from .text import (
    case_id,
    case_title,
    long_label,
    number,
    sample_text,
    seconds_text,
    view_title,
    with_interval,
)

CROP_MANTISSA = 7
"""Stored bits of the mantissa of a crop's pixels: values are right to 0.4 %, a third of an 8-bit step of brightness."""

FRAME_MANTISSA = 4
"""The same for frames, which are there to be looked at, are noisy, and make up two thirds of the page: 3 %."""

CROP_COLOURS = ("#ff5a36", "#ffd23f", "#3ddc97", "#4dabf7")
"""Outlines of the crops in the frame and of their enlargements."""


@dataclass
class Gallery:
    """What the page's scripts need to know about pictures."""

    pool: Executor
    """Where FLIP maps are computed."""
    cases: list = field(default_factory=list)
    shots: list = field(default_factory=list)
    data: dict = field(default_factory=dict)
    """Identifier of a script element to its base64 text."""
    awaited: dict = field(default_factory=dict)
    """The same to the future of a FLIP map."""

    def index(self):
        """For the page's scripts."""
        return {"cases": self.cases, "shots": self.shots}

    def case(self, identity):
        """One scene at one tiling."""
        return next(case for case in self.cases if case["id"] == identity)

    def add(self, image, mantissa, **described):
        """Keep a picture, once even if several shots are alike; returns the shot's number."""
        packed = images.pack(image, mantissa)
        identity = f"px/{digest_text(packed)[:16]}"
        self.data[identity] = packed
        height, width = image.shape[:2]
        invalid = int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))
        shape = {"width": width, "height": height, "mantissa": mantissa, "data": identity, "invalid": invalid}
        self.shots.append({**shape, "flip": None, "reference": None, **described})
        return len(self.shots) - 1

    def add_flip(self, index, image, reference):
        """Have the FLIP map of a shot computed, if it has one: an image with an infinite pixel has none."""
        if np.isfinite(image).all():
            identity = f"fl{index}"
            self.awaited[identity] = self.pool.submit(flip_map, image, reference)
            self.shots[index]["flip"] = identity

    def finish(self):
        """Wait for the FLIP maps."""
        while self.awaited:
            identity, future = self.awaited.popitem()
            self.data[identity] = images.pack_unit(future.result())


def gallery(results, pool):
    """All pictures of the report; their FLIP maps are computed in `pool` until `Gallery.finish`."""
    found = Gallery(pool)
    for scene, tiling in results.settings.cases:
        found.cases.append(case(results, found, scene, tiling))
    return found


def case(results, found, scene, tiling):
    """The pictures of one scene at one tiling."""
    views = scene.views(results.settings.size, results.settings.frame_size)
    mine = [item for item in select(results.summaries, scene=scene.name, tiling=tiling) if item.frame is None]
    shown = [show_view(results, found, scene, tiling, view, mine, views) for view in views.values()]
    return {
        "id": case_id(scene.name, tiling),
        "title": case_title(scene.name, tiling),
        "views": [view for view in shown if view["groups"]],
    }


def show_view(results, found, scene, tiling, view, summaries, views):
    """One view: groups of pictures with the same sample count, each with the references at its end."""
    references = add_references(results, found, scene, tiling, view)
    mine = select(summaries, view=view.name)
    wanted = {long_label(item): item.method for item in (*mine, *left_out(results, scene, tiling, view))}
    entries = [index for index, _ in references.values()]
    groups = []
    for title, members, mean in sample_groups(mine, view):
        shots = [add_summary(results, found, item, view, mean, references) for item in members]
        there = {long_label(item) for item in members}
        gaps = [{"label": label, "method": method} for label, method in wanted.items() if label not in there]
        groups.append({"title": title, "mean": mean, "shots": shots + entries, "absent": gaps})
    if entries and not groups:
        groups.append({"title": "reference only", "mean": False, "shots": entries, "absent": []})
    crops = [name for name in views if name != "frame"]
    colour = CROP_COLOURS[crops.index(view.name) % len(CROP_COLOURS)] if view.name in crops else None
    x, y, width, height = (value / view.width for value in view.crop)
    return {
        "name": view.name,
        "title": view_title(view.name),
        "colour": colour,
        "box": {"x": x, "y": y, "width": width, "height": height},
        "place": f"{view.crop[2]} × {view.crop[3]} pixels at ({view.crop[0]}, {view.crop[1]}) of {view.width} × {view.height}",
        "groups": groups,
    }


def left_out(results, scene, tiling, view):
    """The points of a view that have no picture."""
    points = [SimpleNamespace(**item) for item in results.left_out]
    return select(points, scene=scene.name, tiling=tiling, view=view.name, frame=None)


def sample_groups(summaries, view):
    """(title, summaries, whether the mean of the seeds is shown) of pictures that belong side by side: the fewest and
    the most samples, every time budget, and for crops the mean of the seeds, which shows bias without noise."""
    spps = sorted({item.spp for item in summaries if item.time_budget is None})
    groups = []
    for spp in dict.fromkeys((*spps[:1], *spps[-1:])):
        groups.append((f"{spp} spp", select(summaries, spp=spp, time_budget=None), False))
    for budget, build in sorted(
        {(item.time_budget, item.budget_includes_build) for item in summaries if item.time_budget}
    ):
        title = f"{budget:g} s" + (" with build" if build else "")
        groups.append((title, select(summaries, time_budget=budget, budget_includes_build=build), False))
    if view.name != "frame" and spps:
        most = select(summaries, spp=spps[-1], time_budget=None)
        seeds = max(len(item.runs) for item in most)
        if seeds > 1:
            groups.append((f"mean of {seeds} × {spps[-1]} spp", most, True))
    return groups


def add_summary(results, found, item, view, mean, references):
    """Keep a method's picture; returns its number."""
    image = images.read_exr(results.out / (item.mean_image if mean else item.image))
    rows = len(item.runs) if mean else 1
    index = found.add(
        image,
        FRAME_MANTISSA if view.name == "frame" else CROP_MANTISSA,
        method=item.method,
        label=long_label(item),
        detail=f"{f'{rows} × ' if mean else ''}{sample_text(item)} · {seconds_text(rows * item.seconds.value)}",
        errors={} if mean else {name: with_interval(split.total, 2) for name, split in item.errors.items()},
        noisy=[name for name in item.errors if item.at_reference_noise(name)],
    )
    if item.surface in references:
        number_of_reference, reference = references[item.surface]
        found.shots[index]["reference"] = number_of_reference
        if view.name != "frame":
            found.add_flip(index, image, reference.mean)
    return index


def add_references(results, found, scene, tiling, view):
    """Keep the references of a view; returns surface to (number, `Reference`)."""
    added = {}
    for (of_scene, of_tiling, surface, of_view), reference in results.references.items():
        if (of_scene, of_tiling, of_view) == (scene.name, tiling, view.name):
            index = found.add(
                reference.mean,
                FRAME_MANTISSA if view.name == "frame" else CROP_MANTISSA,
                method="reference",
                label=f"Reference · {surface}",
                detail=f"{reference.spp}\u00a0spp · {seconds_text(reference.seconds)}",
                errors={"rmse": number(root_mean_square(reference.standard_error), 2)},
                noisy=[],
            )
            found.shots[index]["reference"] = index
            added[surface] = (index, reference)
    return added


def root_mean_square(values):
    """Root of the mean of squares."""
    return float(np.sqrt(np.mean(np.square(values))))
