"""What several tests share: maps, interactions, scenes, and a view into Mitsuba's log."""

import contextlib
import math

import drjit as dr
import mitsuba as mi
import numpy as np

FILTERED = ("glints_ibm", "glints_yan16", "glints_direct")
BSDFS = FILTERED + ("glints_unfiltered",)
NEEDS_DIFFERENTIALS = 0x20000  # BSDFFlags::NeedsDifferentials, which Mitsuba does not export to Python


def unit(v):
    v = np.asarray(v, dtype=np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def random_normals(width, height, slope, seed=0):
    """`height x width` unit normals, uncorrelated, whose slopes have the standard deviation `slope` along each axis."""
    rng = np.random.default_rng(seed)
    slopes = rng.normal(scale=slope, size=(height, width, 2))
    return unit(np.concatenate([-slopes, np.ones((height, width, 1))], axis=-1)).astype(np.float32)


def write_exr(path, normals):
    mi.Bitmap(np.ascontiguousarray(normals, dtype=np.float32)).write(str(path))
    return str(path)


def bsdf(plugin, filename, **parameters):
    return mi.load_dict({"type": plugin, "filename": str(filename), **parameters})


def interaction(uv=(0.5, 0.5), wi=(0, 0, 1), duv_dx=(0, 0), duv_dy=(0, 0)):
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.uv, si.duv_dx, si.duv_dy = uv, duv_dx, duv_dy
    si.wi = mi.ScalarVector3f(*unit(wi))
    return si


def random_direction(rng, max_angle=1.2):
    cos = 1 - rng.random() * (1 - math.cos(max_angle))
    phi, sin = 2 * math.pi * rng.random(), math.sqrt(1 - cos * cos)
    return np.array([sin * math.cos(phi), sin * math.sin(phi), cos])


def value(bsdf, si, wo):
    """`eval` in scalar_rgb, first channel."""
    return float(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*wo))[0])


def plane_scene(material, integrator, resolution=16, samples=4, light=None, **objects):
    """The unit square of uv seen from above by an orthographic camera: one pixel is 1 / resolution in u and v."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator if isinstance(integrator, dict) else {"type": integrator},
            "plane": {"type": "rectangle", "bsdf": material},
            "light": light or {"type": "constant"},
            "camera": {
                "type": "orthographic",
                "to_world": mi.ScalarTransform4f().look_at(origin=(0, 0, 3), target=(0, 0, 0), up=(0, 1, 0)),
                "film": {
                    "type": "hdrfilm",
                    "width": resolution,
                    "height": resolution,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                },
                "sampler": {"type": "independent", "sample_count": samples},
            },
            **objects,
        }
    )


@contextlib.contextmanager
def captured_log(level=mi.LogLevel.Warn):
    """A list that collects the messages of Mitsuba's log."""

    class Collector(mi.Appender):
        def __init__(self):
            super().__init__()
            self.lines = []

        def append(self, level, text):
            self.lines.append(text)

        def log_progress(self, *_):
            pass

    logger = mi.logger()
    collector, old_level = Collector(), logger.log_level()
    logger.add_appender(collector)
    logger.set_log_level(level)
    try:
        yield collector.lines
    finally:
        logger.set_log_level(old_level)
        logger.remove_appender(collector)
