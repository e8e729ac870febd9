"""Sequences as animated pictures, and what flickers in them: methods side by side with captions."""

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .. import images
from ..files import replacing

PANEL = 200
"""Least width of a panel in screen pixels: room for the captions, and pixels that can be told apart."""

COLUMNS = 4
MARGIN, CAPTION = 8, 36
"""Screen pixels."""

FRAME_MILLISECONDS = 100

BACKGROUND, TEXT = (20, 23, 28), (227, 231, 236)


@dataclass(frozen=True)
class Animation:
    """A file, its first frame as a file, and its size in pixels."""

    path: Path
    still: Path
    width: int
    height: int


def write(path, sequences, exposure):
    """Write an animated WebP of `sequences`, pairs (caption, list of EXR paths of equal size), and its first frame."""
    frames = [compose(panels, exposure) for panels in zip(*(tagged(*sequence) for sequence in sequences))]
    still = path.with_suffix(".png")
    with replacing(still) as temporary:
        frames[0].save(temporary)
    with replacing(path) as temporary:
        frames[0].save(
            temporary,
            save_all=True,
            append_images=frames[1:],
            duration=FRAME_MILLISECONDS,
            loop=0,
            lossless=True,
            quality=30,
            method=2,
        )
    return Animation(path, still, *frames[0].size)


def tagged(caption, paths):
    """The pictures of one sequence, each with the caption."""
    return [(caption, path) for path in paths]


def compose(panels, exposure):
    """One frame of the animation: captioned pictures."""
    return sheet([(caption, images.tone_map(images.read_exr(path), exposure)) for caption, path in panels])


def write_excess(path, panels):
    """Write a picture of `panels`, pairs (caption, EXR path of an excess variance); returns its limit.

    Shown is the root of the mean over channels with its sign, in radiance: red flickers more than the surface does, blue
    less. Full colour is the limit, which 1 % of all pixels exceed.
    """
    roots = [signed_root(images.read_exr(excess)) for _, excess in panels]
    finite = [np.abs(values[np.isfinite(values)]) for values in roots]
    limit = float(np.percentile(np.concatenate(finite), 99)) if any(map(len, finite)) else 0.0
    coloured = [signed_colours(values, limit) for values in roots]
    with replacing(path) as temporary:
        sheet([(caption, picture) for (caption, _), picture in zip(panels, coloured)]).save(temporary)
    return limit


def signed_root(excess):
    """Root of the channels' mean with its sign, of an array (height, width, 3)."""
    with np.errstate(invalid="ignore"):
        mean = excess.mean(axis=-1, dtype=np.float64)
        return np.sign(mean) * np.sqrt(np.abs(mean))


def signed_colours(values, limit):
    """8-bit colours of an array (height, width): blue below zero, white, red above, full at `limit`."""
    shares = np.clip(np.nan_to_num(values / (limit or 1.0)), -1, 1)
    colours = (matplotlib.colormaps["RdBu_r"]((shares + 1) / 2)[..., :3] * 255 + 0.5).astype(np.uint8)
    colours[~np.isfinite(values)] = images.INVALID_COLOUR
    return colours


def sheet(panels):
    """Captioned pictures in rows, from pairs (caption, array of 8-bit colours)."""
    pictures = [enlarge(picture) for _, picture in panels]
    width, height = pictures[0].size
    rows = -(-len(panels) // COLUMNS)
    columns = min(COLUMNS, len(panels))
    size = (columns * (width + MARGIN) + MARGIN, rows * (height + CAPTION + MARGIN) + MARGIN)
    sheet = Image.new("RGB", size, BACKGROUND)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for index, ((caption, _), picture) in enumerate(zip(panels, pictures)):
        x = MARGIN + index % COLUMNS * (width + MARGIN)
        y = MARGIN + index // COLUMNS * (height + CAPTION + MARGIN)
        pen.multiline_text((x, y + 2), caption.replace(" · ", "\n", 1), fill=TEXT, font=font, spacing=2)
        sheet.paste(picture, (x, y + CAPTION))
    return sheet


def enlarge(picture):
    """A picture with squares for pixels, of at least the width of a panel."""
    scale = -(-PANEL // picture.shape[1])
    return Image.fromarray(np.repeat(np.repeat(picture, scale, axis=0), scale, axis=1))
