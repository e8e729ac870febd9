"""Data structures that are built for their own sake, not rendered with."""

from . import paper
from .render import structure_of
from .timer import glint_bsdf


def of_table_4(settings):
    """Inverse bin maps at the roughnesses of Table 4: (scene name, alpha) to their `render.STRUCTURE`.

    Empty if the comparison is without them.
    """
    if not any("glints_ibm" in method.plugins for method in settings.methods):
        return {}
    return {
        (scene.name, alpha): structure_of(str(glint_bsdf("glints_ibm", scene.normal_map, alpha)))
        for scene in settings.scenes
        for alpha in paper.TABLE_4
    }
