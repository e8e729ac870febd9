"""Nanoseconds per BSDF call, measured in a C++ loop inside this process: `libglints_timer.so` of the plugin package."""

import ctypes
import re
from pathlib import Path

import mitsuba as mi

WIDEST_ANGLE = 1.16
"""Viewing directions are uniform in a cone of this half angle (radians): the cosine goes down to 0.4."""


class Settings(ctypes.Structure):
    """`GlintsTimerSettings` of cpp/mitsuba/timer/timer.h."""

    _fields_ = [
        ("footprint_width_u", ctypes.c_float),
        ("footprint_width_v", ctypes.c_float),
        ("max_angle_wi", ctypes.c_float),
        ("sampled_wo", ctypes.c_float),
        ("interactions", ctypes.c_uint32),
        ("repetitions", ctypes.c_uint32),
        ("seed", ctypes.c_uint32),
    ]


class Timings(ctypes.Structure):
    """`GlintsTimerTimings` of cpp/mitsuba/timer/timer.h."""

    _fields_ = [
        (name, ctypes.c_double)
        for name in ("eval_ns", "pdf_ns", "sample_ns", "eval_pdf_ns", "overhead_ns", "valid_samples", "checksum")
    ]


def library_call():
    """`glints_time_bsdf` itself: BSDF address, settings and timings to an error text or None."""
    import mitsuba_glints

    library = ctypes.CDLL(str(Path(mitsuba_glints.plugin_dir()) / "plugins" / "libglints_timer.so"))
    call = library.glints_time_bsdf
    call.argtypes = [ctypes.c_void_p, ctypes.POINTER(Settings), ctypes.POINTER(Timings)]
    call.restype = ctypes.c_char_p
    return call


def load():
    """The timer, a function from BSDF, footprint width in uv and number of shading points to `Timings`."""
    call = library_call()

    def measure(bsdf, width, interactions, repetitions=3):
        settings = Settings(width, width, WIDEST_ANGLE, 1.0, interactions, repetitions, 1)
        timings = Timings()
        error = call(bsdf.ptr, settings, timings)
        if error:
            raise RuntimeError(error.decode())
        return timings

    return measure


def texels_per_side(path):
    """Width in texels of a map, as a glint BSDF prints it."""
    return int(re.search(r"resolution = (\d+) x", str(glint_bsdf("glints_unfiltered", path, 0.01))).group(1))


def glint_bsdf(plugin, path, alpha, **parameters):
    """A glint BSDF of this project over a map of stock `normalmap`'s encoding."""
    return mi.load_dict({"type": plugin, "filename": str(path), "encoding": "unsigned", "alpha": alpha, **parameters})
