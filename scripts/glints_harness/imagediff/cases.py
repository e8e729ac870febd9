"""What the image tests render: small crops of the scenes, one for each plugin and footprint rule.

A `Configuration`'s reference holds mean and variance over `REFERENCE_SEEDS`; the tests render `TEST_SEEDS`, which are
others, with the same settings.
"""

from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import render
from ..cli import ROOT, scene_assets
from ..methods import METHODS, SURFACES, Method
from ..scenes import View, find_scenes
from . import statistic, storage

FOLDER = ROOT / "tests" / "images"

ALPHA = "0.02"
"""Flake roughness: the scenes' own, a third of it, has tails so heavy that small changes drown in them."""

SIZE, SIDE, MARGIN = 800, 32, 24
"""Pixels of the frame, of the crop's sides, and from the corner of the scene's first crop to this one's."""

SPP = 16
TEST_SEEDS = range(16)
REFERENCE_SEEDS = range(1_000, 1_256)
CHANNELS = ("R", "G", "B")


@dataclass(frozen=True)
class Integrator:
    """`glints_path` as the image tests use it."""

    footprint: str
    """`pixel`, `sample` or a number of pixels."""
    max_depth: int = 2

    def load(self):
        """The Mitsuba integrator. The size of its blocks is fixed, so that no image depends on the number of cores."""
        return mi.load_dict({"type": "glints_path", "block_size": 8, **asdict(self)})


@cache
def open_scene(name):
    """A scene of this project; its files are generated where they are missing."""
    return find_scenes(ROOT / "mitsuba_scenes", [name], scene_assets(ROOT / ".cache"))[0]


@dataclass(frozen=True)
class Configuration:
    """What is rendered."""

    name: str
    """Its file's name."""
    scene: str
    method: Method
    integrator: Integrator
    values: dict = field(default_factory=dict)
    """The scene's parameters that are not its own."""

    def text(self):
        """The scene file's text."""
        scene = open_scene(self.scene)
        return replace(scene, values={**scene.values, "alpha": ALPHA, **self.values}).text(self.method, 1)

    def view(self):
        """The crop."""
        x, y = open_scene(self.scene).crops[0][:2]
        return View("test", SIZE, SIZE, (x + MARGIN, y + MARGIN, SIDE, SIDE))

    def images(self, seeds):
        """`Seeds` of this configuration."""
        loaded, view = render.LoadedScene(self.text()), self.view()
        images = [loaded.render(view, self.integrator, SPP, seed).image for seed in seeds]
        return statistic.Seeds(np.stack(images), CHANNELS)

    def with_parameters(self, **parameters):
        """The same with other parameters of the plugin."""
        return replace(self, method=replace(self.method, parameters={**self.method.parameters, **parameters}))

    def with_footprint(self, footprint):
        """The same with another footprint rule."""
        return replace(self, integrator=replace(self.integrator, footprint=footprint))

    def with_map(self, path):
        """The same with another normal map."""
        return replace(self, values={**self.values, "normalmap": str(path)})


VARIANTS = (
    # suffix, method, integrator
    ("ibm-pixel", METHODS["glints_ibm"], Integrator("pixel")),
    ("ibm-sample", METHODS["glints_ibm"], Integrator("sample")),
    ("ibm-2-pixels", METHODS["glints_ibm"], Integrator("2")),
    ("ibm-depth-4", METHODS["glints_ibm"], Integrator("pixel", 4)),
    ("yan16-flat", METHODS["glints_yan16_flat"], Integrator("pixel")),
    ("yan16-curved", METHODS["glints_yan16_curved"], Integrator("pixel")),
    ("direct", METHODS["glints_direct"], Integrator("pixel")),
    ("unfiltered", SURFACES["texels"], Integrator("pixel")),
    ("unfiltered-interpolated", SURFACES["interpolated"], Integrator("pixel")),
)

CONFIGURATIONS = {
    item.name: item
    for item in (
        Configuration(f"{scene}-{suffix}", scene, method, integrator)
        for scene in ("shoes", "kettle")
        for suffix, method, integrator in VARIANTS
    )
}


def stored(name, folder=FOLDER):
    """The stored reference of a configuration, `Moments`."""
    return storage.read_side([Path(folder) / f"{name}.exr"])[0]


def shifted_map(scene, bins, path):
    """Write a scene's map with all normals moved along x by so many bins of the tests' roughness; returns `path`.

    Half precision, quick to write, rounds normals by up to 3 % of a bin, and on the average by nothing.
    """
    normals = 2 * np.array(mi.Bitmap(str(open_scene(scene).normal_map)), dtype=np.float64)[..., :3] - 1
    normals[..., 0] += bins * bin_width(float(ALPHA))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    mi.Bitmap((0.5 * (normals + 1)).astype(np.float16)).write(str(path))
    return path


def bin_width(alpha):
    """Width of a bin in the projected disk: [-1, 1] has floor(5 / sin(theta_0)) of them (2021 paper, Table 4)."""
    tan = 3 * alpha / np.sqrt(2)
    return 2 / int(5 / (tan / np.sqrt(1 + tan * tan)))
