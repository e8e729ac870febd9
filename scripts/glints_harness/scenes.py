"""Scene files with a glint slot: find them, fill the slot, and make them independent of their folder.

The slot is a stock `<bsdf type="normalmap">` over `<bsdf type="roughconductor">`, so that the file renders anywhere.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from xml.etree import ElementTree as xml

from . import maps
from .files import digest_file, digest_text
from .methods import Slot, choose

FULL_SIZE = 800
"""Width and height in pixels of the frames in the paper's Figure 7; crops are given in pixels of such a frame."""

PAPER_CROPS = {
    "shoes": ((160, 600, 80, 80), (320, 160, 80, 80)),
    "kettle": ((330, 400, 80, 80), (390, 200, 80, 80)),
}
"""The crops of Figure 7 (x, y, width, height), for scenes whose folder does not name its own."""

CENTRAL_CROPS = ((320, 360, 80, 80), (400, 360, 80, 80))
"""Crops of a scene that nobody has chosen crops for."""

CROP_SIZE = (80, 80)
"""Width and height of a crop that is given by its corner alone."""


@dataclass(frozen=True)
class View:
    """What of a scene is rendered: the whole film, or a crop of it, both in pixels."""

    name: str
    width: int
    height: int
    crop: tuple
    """(x, y, width, height)"""
    frame: int | None = None
    """Number of the frame in a sequence of turned views; None outside of one."""
    turn: float = 0.0
    """Degrees by which the camera goes round what the view's centre shows, about its own upward direction."""

    @property
    def pixels(self):
        return self.crop[2] * self.crop[3]

    @property
    def folder(self):
        """Where images of this view lie, among those of a scene at a tiling."""
        return self.name if self.frame is None else f"{self.name}-sequence"

    def middle(self, side):
        """The part of at most `side` by `side` pixels around the centre, for a quick look at a view's cost."""
        x, y, width, height = self.crop
        across, down = min(side, width), min(side, height)
        return replace(self, crop=(x + (width - across) // 2, y + (height - down) // 2, across, down))


@dataclass(frozen=True)
class Reduced:
    """What a comparison of all scenes has of one that is not asked for by name: entry `reduced` of `scenes.json`."""

    methods: tuple
    """Names."""
    frame_methods: tuple
    """Names of those that render the frame, too."""
    crops: int
    tilings: int
    spps: int
    times: int
    """How many of the crops, and of the comparison's tilings, sample counts and time budgets: the first ones."""

    @classmethod
    def read(cls, entry, where):
        """From an entry; `where` says in errors whose it is."""
        names = [field.name for field in fields(cls)]
        if sorted(entry) != sorted(names):
            raise ValueError(f"{where}: reduced needs the entries {', '.join(names)}, and no others")
        lists = ("methods", "frame_methods")
        counts = {name: entry[name] for name in names if name not in lists}
        wrong = [name for name, count in counts.items() if type(count) is not int or count < (name == "crops")]
        if wrong:
            raise ValueError(f"{where}: reduced has to give {', '.join(wrong)} as numbers, and crops as at least 1")
        try:
            chosen = {name: tuple(method.name for method in choose(entry[name])) for name in lists}
        except ValueError as error:
            raise ValueError(f"{where}: reduced: {error}") from error
        return cls(**chosen, **counts)


@dataclass(frozen=True)
class Scene:
    """A scene file with a glint slot."""

    name: str
    path: Path
    values: dict
    """The file's parameters (`<default>`), name to text, with the places of generated files put in."""
    crops: tuple
    """(x, y, width, height) in pixels of a frame of `FULL_SIZE` pixels."""
    reduced: Reduced | None = None
    """None: everything is compared."""
    max_depth: int = 0
    """Paths are at least as long as this many segments wherever the scene is rendered: entry `max_depth` of
    `scenes.json`, for a scene that is there to show light that comes round a corner. 0: as long as anywhere."""

    @property
    def base_tiles(self):
        """Repetitions of the map over the unit square at tiling x1."""
        return float(self.values.get("tiles", 1))

    @property
    def alpha(self):
        """Beckmann roughness of a flake."""
        return self.first_slot().alpha

    @property
    def normal_map(self):
        """Path of the normal map."""
        return Path(self.first_slot().filename)

    @property
    def texels(self):
        """Number of texels of the normal map."""
        return maps.texels(self.normal_map)

    @property
    def has_environment(self):
        """Whether light comes from all around, from an image or a constant one."""
        emitters = self.resolved(1).iter("emitter")
        return any(emitter.get("type") in ("envmap", "constant") for emitter in emitters)

    def has_method(self, name):
        """Whether the scene is compared with a method at all; a reduced one has few."""
        return self.reduced is None or name in self.reduced.methods

    def first_slot(self):
        """The first glint slot, with parameters put in."""
        return slots(self.resolved(1))[0][1]

    def views(self, size, frame_size):
        """The frame at `frame_size` pixels, and the crops of a frame of `size` pixels, keyed by name."""
        views = [View("frame", frame_size, frame_size, (0, 0, frame_size, frame_size))]
        for index, crop in enumerate(self.crops, 1):
            views.append(View(f"crop{index}", size, size, scale_crop(crop, size)))
        return {view.name: view for view in views}

    def text(self, method, tiling):
        """The scene with `method` in its slot, as XML without parameters and with absolute file names."""
        root = self.resolved(tiling)
        fill_slots(root, method)
        return xml.tostring(root, encoding="unicode")

    def resolved(self, tiling):
        """The scene's XML at a tiling, its slot untouched."""
        values = {**self.values, "tiles": f"{self.base_tiles * tiling:g}"}
        return resolve(xml.parse(self.path).getroot(), values, self.path.parent)


def scale_crop(crop, size):
    """A crop given for a frame of `FULL_SIZE` pixels in a frame of `size` pixels; at least one pixel."""
    scale = size / FULL_SIZE
    x, y = (min(int(value * scale), size - 1) for value in crop[:2])
    width, height = (max(1, round(value * scale)) for value in crop[2:])
    return (x, y, min(width, size - x), min(height, size - y))


def substitute(text, values):
    """`text` with `$name` replaced, also in what was put in."""
    for name in sorted(values, key=len, reverse=True):
        if f"${name}" in text:
            rest = {key: value for key, value in values.items() if key != name}
            text = text.replace(f"${name}", substitute(values[name], rest))
    return text


def resolve(root, values, folder):
    """Put parameters in and make the names of files that lie beside the scene absolute; changes `root`."""
    for default in root.findall("default"):
        root.remove(default)
    for element in root.iter():
        for key, text in element.attrib.items():
            element.set(key, substitute(text, values))
        if element.get("name") == "filename" and (folder / element.get("value", "")).is_file():
            element.set("value", str((folder / element.get("value")).resolve()))
    return root


def slots(root):
    """Pairs (parent, slot) of every glint slot under `root`."""
    found = []
    for parent in root.iter():
        for element in parent:
            if element.tag == "bsdf" and element.get("type") == "normalmap":
                bitmap = element.find("texture[@name='normalmap']")
                conductor = element.find("bsdf[@type='roughconductor']")
                filename = None if bitmap is None else bitmap.find("string[@name='filename']")
                if filename is not None and conductor is not None:
                    to_uv = bitmap.find("transform[@name='to_uv']")
                    found.append((parent, Slot(element, filename.get("value"), to_uv, conductor)))
    return found


def fill_slots(root, method):
    """Put `method` into every slot under `root`; returns how many there were."""
    found = slots(root)
    for parent, slot in found:
        position = list(parent).index(slot.element)
        parent.remove(slot.element)
        parent.insert(position, method.element(slot))
    return len(found)


def scene_digest(text):
    """Digest of a resolved scene: its text, with the content of every file in place of the file's name.

    Where a plugin keeps what it precomputes (`cache`) decides nothing.
    """
    root = xml.fromstring(text)
    for parent in list(root.iter("bsdf")):
        for element in parent.findall("string[@name='cache']"):
            parent.remove(element)
    for element in root.iter():
        if element.get("name") == "filename" and Path(element.get("value", "")).is_file():
            element.set("value", digest_file(element.get("value")))
    return digest_text(xml.tostring(root, encoding="unicode"))


def find_scenes(folder, wanted, assets):
    """Scenes with a slot in `folder` and below, by file name.

    `wanted` is a list of names, or ["all"]: then scenes may be reduced. `assets` is called without arguments when a
    scene needs generated files; it returns {"assets": folder, "maps": {name: path}}.
    """
    folder = Path(folder)
    files = {}
    for path in sorted(folder.rglob("*.xml")):
        if slots(xml.parse(path).getroot()):
            files.setdefault(path.stem, path)
    names = list(files) if wanted == ["all"] else wanted
    missing = [name for name in names if name not in files]
    if missing or not names:
        there = ", ".join(files) or "none"
        raise ValueError(f"no scene {', '.join(missing)} with a glint slot in {folder}; there are: {there}")
    found = [open_scene(files[name], folder, assets) for name in sorted(names, key=paper_order)]
    return [reduce(scene, folder) for scene in found] if wanted == ["all"] else found


def paper_order(name):
    """The order of Figure 7 for its scenes, then the alphabet."""
    known = list(PAPER_CROPS)
    return (known.index(name) if name in known else len(known), name)


def open_scene(path, folder, assets):
    """Read a scene file's parameters; have the files generated that it names and that are not there."""
    values = {item.get("name"): item.get("value") for item in xml.parse(path).getroot().findall("default")}
    if "assets" in values:
        values["assets"] = str(assets()["assets"])
    scene = Scene(path.stem, path, values, find_crops(path.stem, folder), max_depth=find_depth(path.stem, folder))
    if not (path.parent / scene.normal_map).is_file():
        if "normalmap" not in values:
            raise ValueError(f"{path}: the normal map {scene.normal_map} does not exist")
        generated = assets()["maps"]
        values["normalmap"] = str(generated[map_kind(scene.normal_map, generated)])
    return scene


def map_kind(path, generated):
    """Which of the generated maps stands in for a map of this name: one whose name is in it, or the isotropic one."""
    return next((name for name in generated if name in path.stem), "isotropic")


def listed(name, folder):
    """What the folder's `scenes.json` says of a scene; empty if nothing."""
    listing = Path(folder) / "scenes.json"
    entry = json.loads(listing.read_text(encoding="utf-8")).get(name) if listing.is_file() else None
    return entry if isinstance(entry, dict) else {}


def find_crops(name, folder):
    """Crops from the folder's `scenes.json` if it has them, else the paper's, else two in the middle."""
    entry = listed(name, folder)
    if "crops" in entry:
        return tuple((*crop, *CROP_SIZE)[:4] for crop in entry["crops"])
    return PAPER_CROPS.get(name, CENTRAL_CROPS)


def find_depth(name, folder):
    """Least length of the longest paths from the folder's `scenes.json`; 0 if it has none."""
    depth = listed(name, folder).get("max_depth", 0)
    if type(depth) is not int or depth < 0:
        raise ValueError(
            f"{Path(folder) / 'scenes.json'}: {name}: max_depth is {depth!r}; it has to be a number, 1 or more"
        )
    return depth


def reduce(scene, folder):
    """A scene with the reduced plan that the folder's `scenes.json` may have for it."""
    entry = listed(scene.name, folder).get("reduced")
    if entry is None:
        return scene
    reduced = Reduced.read(entry, f"{Path(folder) / 'scenes.json'}: {scene.name}")
    return replace(scene, crops=scene.crops[: reduced.crops], reduced=reduced)
