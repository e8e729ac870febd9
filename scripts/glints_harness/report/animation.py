"""Sequences as animated pictures: methods side by side with captions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .. import images
from ..files import replacing

SCALE = 3
"""Screen pixels for each pixel of a small picture."""

COLUMNS = 4
MARGIN, CAPTION = 8, 22
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
    """One frame of the animation: captioned pictures in rows."""
    pictures = [enlarge(images.tone_map(images.read_exr(path), exposure)) for _, path in panels]
    width, height = pictures[0].size
    rows = -(-len(panels) // COLUMNS)
    columns = min(COLUMNS, len(panels))
    size = (columns * (width + MARGIN) + MARGIN, rows * (height + CAPTION + MARGIN) + MARGIN)
    sheet = Image.new("RGB", size, BACKGROUND)
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for index, ((caption, _), picture) in enumerate(zip(panels, pictures)):
        x = MARGIN + index % COLUMNS * (width + MARGIN)
        y = MARGIN + index // COLUMNS * (height + CAPTION + MARGIN)
        pen.text((x, y + 2), caption, fill=TEXT, font=font)
        sheet.paste(picture, (x, y + CAPTION))
    return sheet


def enlarge(picture):
    """A picture with squares for pixels."""
    return Image.fromarray(np.repeat(np.repeat(picture, SCALE, axis=0), SCALE, axis=1))
