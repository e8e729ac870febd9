"""What a normal map says about the surface as a whole, for models that throw the map away."""

from functools import cache

import mitsuba as mi
import numpy as np

from .files import digest_file


def slope_variances(path):
    """Variances of the slopes -n.x / n.z and -n.y / n.z over all texels of a map with n = 2c - 1."""
    return _slope_variances(str(path), digest_file(path))


@cache
def _slope_variances(path, _digest):
    normals = 2.0 * colours(path) - 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = -normals[..., :2] / normals[..., 2:3]
    if not np.isfinite(slopes).all():
        raise ValueError(f"{path}: a normal lies in the surface (z = 0), so that its slope is infinite")
    return tuple(float(value) for value in slopes.var(axis=(0, 1)))


def texels(path):
    """Number of texels of a map."""
    width, height = _size(str(path), digest_file(path))
    return width * height


@cache
def _size(path, _digest):
    return tuple(mi.Bitmap(path).size())


def colours(path):
    """A map's stored values as float64 of shape (height, width, 3): integers as parts of the largest one."""
    stored = np.array(mi.Bitmap(path))[..., :3]
    largest = np.iinfo(stored.dtype).max if np.issubdtype(stored.dtype, np.integer) else 1
    return stored.astype(np.float64) / largest
