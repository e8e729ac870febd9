"""Pictures for people: linear radiance to sRGB, the same way for every method of a scene."""

import base64

import mitsuba as mi
import numpy as np

from .files import replacing

INVALID_COLOUR = (255, 0, 255)
"""Colour of infinite and undefined pixels."""


def tone_map(image, exposure=0.0):
    """8-bit sRGB of a linear image (height, width, 3); `exposure` in stops, no other change."""
    invalid = ~np.isfinite(image).all(axis=-1)
    linear = np.clip(np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0) * 2.0**exposure, 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)
    picture = (curved * 255 + 0.5).astype(np.uint8)
    picture[invalid] = INVALID_COLOUR
    return picture


def read_exr(path):
    """A linear image (height, width, 3) from a file."""
    return np.array(mi.Bitmap(str(path)), dtype=np.float32)[..., :3]


def write_png(path, picture):
    """Write an 8-bit sRGB picture, whole or not at all."""
    with replacing(path) as temporary:
        mi.Bitmap(np.ascontiguousarray(picture)).write(str(temporary))


def data_uri(path):
    """A file's content as a URI for an HTML page that needs no other file."""
    kind = {".png": "image/png", ".svg": "image/svg+xml"}[path.suffix]
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
