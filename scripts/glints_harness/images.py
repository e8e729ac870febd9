"""Pictures for people: linear radiance to sRGB, the same way for every method of a scene, and to compact floating-point
data that a web page decodes and tone-maps itself."""

import base64
import zlib

import mitsuba as mi
import numpy as np
from PIL import Image

from .files import replacing

INVALID_COLOUR = (255, 0, 255)
"""Colour of infinite and undefined pixels."""

FLOAT_MANTISSA = 23
"""Stored bits of a float32's mantissa."""


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


def data_uri(path):
    """A file's content as a URI for an HTML page that needs no other file."""
    kind = {".png": "image/png", ".webp": "image/webp"}[path.suffix]
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def rounded(image, mantissa):
    """`image` as float32 with `mantissa` stored bits of its mantissa, rounded to nearest; relative error at most
    2^-(mantissa + 1). The exponent is kept whole, so no finite value becomes infinite or the other way round."""
    image = np.ascontiguousarray(image, dtype=np.float32)
    bits = image.view(np.uint32)
    dropped = FLOAT_MANTISSA - mantissa
    magnitude = bits & np.uint32(0x7FFFFFFF)
    largest = np.uint32(0x7F800000 - (1 << dropped))
    shortened = np.minimum(magnitude + np.uint32(1 << (dropped - 1)), largest) >> dropped << dropped
    special = np.where(np.isnan(image), np.uint32(0x7FC00000), magnitude)
    kept = np.where(np.isfinite(image), shortened, special) | (bits & np.uint32(0x80000000))
    return kept.astype(np.uint32).view(np.float32)


def pack(image, mantissa):
    """A linear image (height, width, 3) as base64 text that `unpackImage` in report_data.js reads.

    Floating-point numbers of one sign are ordered like their bits read as integers, and these are close to a logarithm.
    So: round (see `rounded`), take the bits as integers, store green and the differences of red and blue to it, each
    minus the mean of its left and upper neighbours, as zigzag numbers in three byte planes, deflated.
    """
    codes = (rounded(image, mantissa).view(np.uint32) >> (FLOAT_MANTISSA - mantissa)).astype(np.int64)
    red, green, blue = np.moveaxis(codes, -1, 0)
    residuals = np.stack([residual(plane) for plane in (green, red - green, blue - green)])
    zigzag = np.where(residuals < 0, -2 * residuals - 1, 2 * residuals)
    planes = np.stack([(zigzag >> shift) & 255 for shift in (16, 8, 0)]).astype(np.uint8)
    return deflated(planes.tobytes())


def residual(plane):
    """Integers (height, width) minus the mean, rounded down, of the left and upper neighbour; zero beyond the edge."""
    padded = np.pad(plane, ((1, 0), (1, 0)))
    return plane - ((padded[1:, :-1] + padded[:-1, 1:]) >> 1)


def pack_unit(values):
    """Numbers of [0, 1] (height, width) as base64 text of 8 bits each, deflated."""
    return deflated(np.round(np.asarray(values) * 255).astype(np.uint8).tobytes())


def picture_uri(file, image, exposure=0.0):
    """Write a linear image as PNG, whole or not at all; returns it as a URI."""
    with replacing(file) as temporary:
        Image.fromarray(tone_map(image, exposure)).save(temporary)
    return data_uri(file)


def deflated(data):
    """Bytes as base64 text of their zlib stream. The strategy for residuals that are mostly small and random."""
    packer = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_FILTERED)
    return base64.b64encode(packer.compress(data) + packer.flush()).decode("ascii")
