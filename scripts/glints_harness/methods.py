"""Methods: a name and what it puts into a scene's glint slot. A new method is one more row of `METHODS`."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Callable
from xml.etree import ElementTree as xml

import mitsuba as mi

from . import maps
from .files import digest_file, digest_text

GLINTS = "glints"
"""Reflectance model of this project's plugins (Eq. 4 and 5 of the 2021 paper). The references have it, too."""

ROUGH_ALPHA = 0.05
"""Flake roughness of the column "Ours (rough)" in Figure 7 of the 2021 paper."""


@dataclass(frozen=True)
class Slot:
    """A scene's glint slot: stock `normalmap` over `roughconductor`, taken to pieces."""

    element: xml.Element
    """The whole `<bsdf type="normalmap">`."""
    filename: str
    """The normal map. Stock `normalmap` decodes n = 2c - 1."""
    to_uv: xml.Element
    """The bitmap's uv transform (the tiling), or None."""
    conductor: xml.Element
    """The nested `<bsdf type="roughconductor">`."""

    @property
    def alpha(self):
        """Beckmann roughness of a flake."""
        found = self.conductor.find("float[@name='alpha']")
        if found is None:
            raise ValueError('the glint slot\'s roughconductor has no alpha; give it <float name="alpha" .../>')
        return float(found.get("value"))


@dataclass(frozen=True)
class Formula:
    """What a data structure's memory should be."""

    text: str
    """For people: N texels, b bins a side, r x r elements a texel."""
    structure_bytes: Callable[[int, int, int], float]
    """Bytes, from N, b and r."""


@dataclass(frozen=True)
class Method:
    """A named way to fill the slot. `fill` gets the slot and the parameters and returns the new element."""

    name: str
    label: str
    model: str
    """Reflectance model. Methods of another model than the reference's keep a bias however many samples they take."""
    fill: Callable[[Slot, Mapping[str, object]], xml.Element]
    parameters: Mapping[str, object] = field(default_factory=dict)
    plugins: tuple = ()
    """Plugins of this project that it needs."""
    surface: str = "texels"
    """What it approximates, a key of `SURFACES`: its errors are taken against that surface's reference."""
    filters: bool = False
    """Whether it looks at the footprint; if not, the footprint rule means nothing to it."""
    memory: Formula | None = None
    sparse: bool = False
    """Whether it is rendered at few points only, unless it is asked for by name: the crops at the first sample count and
    at equal time, with one footprint rule."""
    note: str = ""
    environment_prefilter: bool = False
    """Whether `glints_path` has it answer for environment light over directions, too, and not only over the footprint."""
    precomputed: bool = False
    """Whether its data structure takes minutes to make, and is kept in a folder of `store`."""
    store: Path | None = None
    """Where precomputations are kept; None: where the plugin keeps them by itself."""
    if_kept: bool = False
    """Whether it is left out of scenes whose precomputation is not kept yet, unless it is asked for by name."""

    def element(self, slot):
        """The BSDF element that takes the slot's place, with the slot's identity so that shapes still find it."""
        element = self.fill(slot, self.parameters)
        if self.precomputed and self.store is not None:
            add_property(element, "cache", str(self.precomputation(slot)))
        for key in ("id", "name"):
            element.attrib.pop(key, None)
            if key in slot.element.attrib:
                element.set(key, slot.element.get(key))
        return element

    def precomputation(self, slot):
        """The folder of the slot's precomputation, named by all that decides it: the map's content and parameters."""
        decisive = [*self.plugins, digest_file(slot.filename), slot.alpha, dict(self.parameters)]
        return self.store.resolve() / digest_text(json.dumps(decisive, sort_keys=True))[:24]

    def is_kept(self, slot):
        """Whether the slot's precomputation is there already: a file that is no unfinished one (these begin with a dot)."""
        folder = self.precomputation(slot)
        return folder.is_dir() and any(path.is_file() and path.name[0] != "." for path in folder.iterdir())


def keep(slot, _parameters):
    """The slot as it is: stock `normalmap` over `roughconductor`."""
    return copy.deepcopy(slot.element)


def without_map(slot, _parameters):
    """The nested `roughconductor`, widened by the map's slopes: alpha_u^2 = alpha^2 + 2 var(slope_u), and so for v.

    A Beckmann surface of roughness alpha has slopes of variance alpha^2 / 2, and variances add. The covariance of the
    two slopes has no place in `roughconductor`, nor has their mean.
    """
    element = copy.deepcopy(slot.conductor)
    alpha = slot.alpha
    element.remove(element.find("float[@name='alpha']"))
    for axis, variance in zip("uv", maps.slope_variances(slot.filename)):
        add_property(element, f"alpha_{axis}", math.sqrt(alpha**2 + 2 * variance))
    return element


def plugin(kind):
    """One of this project's BSDFs over the slot's map, with its roughness, its conductor and its tiling."""

    def fill(slot, parameters):
        element = xml.Element("bsdf", type=kind)
        add_property(element, "filename", slot.filename)
        add_property(element, "encoding", "unsigned")
        if slot.to_uv is not None:
            element.append(copy.deepcopy(slot.to_uv))
        for item in slot.conductor:
            if item.get("name") not in parameters and is_shared_property(item):
                element.append(copy.deepcopy(item))
        for name, value in parameters.items():
            add_property(element, name, value)
        return element

    return fill


def is_shared_property(item):
    """Whether a property of `roughconductor` means the same to a glint BSDF. "No material" is their default."""
    name, value = item.get("name"), item.get("value")
    if name in ("alpha_u", "alpha_v"):
        raise ValueError("the glint slot's roughconductor has alpha_u or alpha_v; flakes are isotropic, give it alpha")
    if name == "distribution" and value != "beckmann":
        raise ValueError(f"the glint slot's roughconductor has distribution {value}; flakes are beckmann")
    return name not in ("distribution", "sample_visible") and (name, value) != ("material", "none")


def add_property(element, name, value):
    """Append a scene-file property, whose tag follows from the Python type."""
    tags = {bool: "boolean", int: "integer", float: "float", str: "string"}
    text = str(value).lower() if isinstance(value, bool) else str(value)
    xml.SubElement(element, tags[type(value)], name=name, value=text)


def glints(name, label, kind, memory, parameters=None, **more):
    """A method that is one of this project's BSDFs, `kind`."""
    return Method(name, label, GLINTS, plugin(kind), parameters or {}, (kind,), memory=memory, **more)


COMPACT_MEMORY = Formula(
    "at most 4.35 N, from 2.5 N on: normals in 20 to 32 bits a texel, the rest counts",
    lambda texels, *_: 4.35 * texels,
)
BIN_MAP_MEMORY = Formula(
    "8 N + 4.2 b² + 0.6 N: two maps of 4 bytes a texel, the index, and a forest of 3 bytes a leaf of about 5 texels",
    lambda texels, bins, _: 8.6 * texels + 4.2 * bins**2,
)
NORMALS_MEMORY = Formula("12 N: one normal a texel", lambda texels, *_: 12 * texels)
FLAT_MEMORY = Formula("14 N: one element a texel, with its tree", lambda texels, *_: 14 * texels)
CURVED_MEMORY = Formula(
    "30 r² N: r² elements a texel, with their tree", lambda texels, _bins, refinement: 30 * refinement**2 * texels
)

TENSOR = {"filters": True, "precomputed": True, "if_kept": True}
TENSOR_NOTE = (
    "Its precomputation takes minutes for a large map and is kept; build times of later runs are those of loading it. Its "
    "footprint is a Gaussian of half a pixel's deviation, as that of Yan et al., so it blurs more than a box."
)

METHODS = {
    method.name: method
    for method in (
        glints("glints_ibm", "Inverse bin map", "glints_ibm", COMPACT_MEMORY, filters=True),
        glints(
            "glints_ibm_paper",
            "Inverse bin map, published structure",
            "glints_ibm",
            BIN_MAP_MEMORY,
            {"structure": "paper"},
            filters=True,
            sparse=True,
        ),
        glints(
            "glints_ibm_rough",
            "Inverse bin map (rough)",
            "glints_ibm",
            COMPACT_MEMORY,
            {"alpha": ROUGH_ALPHA},
            surface="rough",
            filters=True,
            note=f"Rough: flakes of roughness {ROUGH_ALPHA}, measured against a surface of such flakes.",
        ),
        glints(
            "glints_yan16_flat",
            "Yan et al. 2016, flat elements",
            "glints_yan16",
            FLAT_MEMORY,
            {"elements": "flat"},
            filters=True,
        ),
        glints(
            "glints_yan16_curved",
            "Yan et al. 2016, curved elements",
            "glints_yan16",
            CURVED_MEMORY,
            {"elements": "curved"},
            surface="interpolated",
            filters=True,
            note="Curved elements interpolate the map, and are measured against the interpolated surface.",
        ),
        glints("glints_direct", "Direct sum", "glints_direct", NORMALS_MEMORY, filters=True),
        glints("glints_tensor", "Tensor decomposition", "glints_tensor", None, note=TENSOR_NOTE, **TENSOR),
        glints(
            "glints_tensor_prefiltered",
            "Tensor decomposition, prefiltered light",
            "glints_tensor",
            None,
            environment_prefilter=True,
            note="Prefiltered light: a sample of environment light stands for a range of directions, and so does the answer. "
            "Its times are without the fit of the environment, some seconds once a scene, as `glints environment` makes it.",
            **TENSOR,
        ),
        glints("glints_unfiltered", "Unfiltered", "glints_unfiltered", NORMALS_MEMORY),
        Method(
            "normalmap",
            "Stock normalmap",
            "stock normal mapping",
            keep,
            note="Stock normalmap over roughconductor is another reflectance model (cosine at the perturbed normal, "
            "no shadowing of the map): it keeps a distance to the reference that more samples do not remove.",
        ),
        Method(
            "roughconductor",
            "Plain roughconductor",
            "smooth surface",
            without_map,
            note="Plain roughconductor has the roughness that the map's slopes give on the average (their variances, "
            "without their covariance): what remains when the map is thrown away.",
        ),
    )
}

SURFACES = {
    "texels": METHODS["glints_unfiltered"],
    "rough": glints(
        "surface_rough", "Unfiltered (rough)", "glints_unfiltered", NORMALS_MEMORY, {"alpha": ROUGH_ALPHA}
    ),
    "interpolated": glints(
        "surface_interpolated",
        "Unfiltered (interpolated)",
        "glints_unfiltered",
        NORMALS_MEMORY,
        {"interpolation": "bilinear"},
    ),
}
"""The surfaces that methods approximate, as methods without footprint or data structure: those of the references.

`texels`: every texel a flat mirror patch, as in the 2021 paper; `rough`: the same with rough flakes; `interpolated`: the
map interpolated bilinearly. To measure a method against a surface that it does not have would count as an error what
it does on purpose.
"""


def choose(names):
    """The methods of these names, in this order; a method that is named is not sparse, and is precomputed if need be."""
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise ValueError(f"unknown method {', '.join(unknown)}; there are {', '.join(METHODS)}")
    return [replace(METHODS[name], sparse=False, if_kept=False) for name in dict.fromkeys(names)]


def check_plugins(methods):
    """Refuse methods whose plugins are not installed."""
    for name in dict.fromkeys(name for method in methods for name in method.plugins):
        if not any((Path(str(folder)) / "plugins" / f"{name}.so").is_file() for folder in mi.file_resolver()):
            users = ", ".join(method.name for method in methods if name in method.plugins)
            raise ValueError(
                f"the plugin {name} is not installed; run scripts/setup, or leave out {users} (--methods)"
            )
