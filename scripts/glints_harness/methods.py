"""Methods: a name and what it puts into a scene's glint slot. A new method is one more row of `METHODS`."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Callable
from xml.etree import ElementTree as xml

GLINTS = "glints"
"""Reflectance model of this project's plugins (Eq. 4 and 5 of the 2021 paper). The reference has it, too."""


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
    note: str = ""

    def element(self, slot):
        """The BSDF element that takes the slot's place, with the slot's identity so that shapes still find it."""
        element = self.fill(slot, self.parameters)
        for key in ("id", "name"):
            element.attrib.pop(key, None)
            if key in slot.element.attrib:
                element.set(key, slot.element.get(key))
        return element


def keep(slot, _parameters):
    """The slot as it is: stock `normalmap` over `roughconductor`."""
    return copy.deepcopy(slot.element)


def without_map(slot, _parameters):
    """The nested `roughconductor` alone."""
    return copy.deepcopy(slot.conductor)


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


METHODS = {
    method.name: method
    for method in (
        Method("glints_ibm", "Inverse bin map", GLINTS, plugin("glints_ibm"), plugins=("glints_ibm",)),
        Method("glints_direct", "Direct sum", GLINTS, plugin("glints_direct"), plugins=("glints_direct",)),
        Method("glints_unfiltered", "Unfiltered", GLINTS, plugin("glints_unfiltered"), plugins=("glints_unfiltered",)),
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
            note="Plain roughconductor ignores the map: it is here for its time, and its error says what the map adds.",
        ),
    )
}

REFERENCE = METHODS["glints_unfiltered"]
"""The method of the reference: no footprint, no data structure, only many samples."""


def choose(names):
    """The methods of these names, in this order."""
    unknown = [name for name in names if name not in METHODS]
    if unknown:
        raise ValueError(f"unknown method {', '.join(unknown)}; there are {', '.join(METHODS)}")
    return [METHODS[name] for name in dict.fromkeys(names)]
