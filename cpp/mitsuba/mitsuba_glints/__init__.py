"""Glint BSDFs for Mitsuba 3.

Importing this package makes the plugins `glints_ibm`, `glints_direct`, `glints_unfiltered` and the integrator
`glints_path` loadable by any scene of the process, before or after `mitsuba.set_variant`:

    import mitsuba as mi
    mi.set_variant("scalar_rgb")
    import mitsuba_glints

They exist in the variants `scalar_rgb`, `scalar_spectral` and `scalar_spectral_polarized`.
"""

import os

import mitsuba

__version__ = "0.1.0"

# The one Mitsuba release the plugins are compiled for. Its C++ interface changes between minor versions, and a plugin
# of another release loads without complaint and renders garbage; CMakeLists.txt reads this line.
MITSUBA_VERSION = "3.9.1"


def plugin_dir() -> str:
    """The folder to hand to Mitsuba: `mitsuba -a FOLDER scene.xml`, or `mi.file_resolver().prepend(FOLDER)`.

    The plugin files are in its subfolder `plugins`, where Mitsuba looks for them.
    """
    return os.path.dirname(os.path.realpath(__file__))


def _check_mitsuba_version() -> None:
    if mitsuba.__version__ != MITSUBA_VERSION:
        raise ImportError(
            f"mitsuba_glints {__version__} works with Mitsuba {MITSUBA_VERSION} only, but Mitsuba "
            f"{mitsuba.__version__} is installed. Run: pip install mitsuba=={MITSUBA_VERSION}"
        )


def _check_plugins_are_built() -> None:
    if not os.path.isdir(os.path.join(plugin_dir(), "plugins")):
        raise ImportError(
            f"{plugin_dir()} holds the sources of mitsuba_glints, not the built plugins. Install the package "
            "(pip install . in the repository) and take its folder cpp/mitsuba off the Python path."
        )


def _make_plugins_loadable() -> None:
    resolver = mitsuba.file_resolver()
    if plugin_dir() not in [str(folder) for folder in resolver]:
        resolver.prepend(plugin_dir())


_check_mitsuba_version()
_check_plugins_are_built()
_make_plugins_loadable()
