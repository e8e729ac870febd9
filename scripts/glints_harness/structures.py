"""Data structures that are built for their own sake, not rendered with."""

from . import paper
from .methods import METHODS
from .render import structure_of
from .timer import glint_bsdf

BIN_MAPS = ("glints_ibm", "glints_ibm_paper")
"""Methods whose data structures stand in Table 4, at the flake roughness of the scene."""


def bin_map_of(method):
    """Which of `BIN_MAPS` has the data structure of a method; None if it has another one."""
    if "glints_ibm" not in method.plugins:
        return None
    same = (name for name in BIN_MAPS if structure_parameter(METHODS[name]) == structure_parameter(method))
    return next(same, None)


def structure_parameter(method):
    """What a method asks the plugin for, if for anything."""
    return method.parameters.get("structure")


def of_table_4(settings):
    """Bin maps at the roughnesses of Table 4: (scene name, name in `BIN_MAPS`, alpha) to their `render.STRUCTURE`.

    Empty if the comparison is without them.
    """
    if not any(bin_map_of(method) for method in settings.methods):
        return {}
    return {
        (scene.name, name, alpha): structure_of(
            str(glint_bsdf("glints_ibm", scene.normal_map, alpha, **METHODS[name].parameters))
        )
        for scene in settings.scenes
        for name in BIN_MAPS
        for alpha in paper.TABLE_4
    }
