"""What `imagediff` reads and writes: OpenEXR files of renderings, groups of them by seed, and stored references.

A stored reference is an OpenEXR file with the channels `mean.F` and `variance.F` for every feature F of `statistic`,
as 32-bit floats, and the header attribute `imagediff` (JSON): the number of seeds, the constant of the compression,
the order of the features, and where the images came from.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..files import replacing
from .statistic import BadInput, Moments, Seeds

ATTRIBUTE = "imagediff"
"""Header attribute of stored references."""

MAGIC = b"\x76\x2f\x31\x01"
"""The first bytes of every OpenEXR file."""

SEED = re.compile(r"^(?P<name>.*?)[-_.]?seed[-_]?\d+$")
"""A file name without suffix of one seed of several, such as `shoes-seed3`; the image's name is what stands before."""


@dataclass(frozen=True)
class Exr:
    """A file's content."""

    channels: dict
    """Name to an array of shape (height, width), float32 or float16 as stored."""
    attribute: dict
    """What a stored reference says of itself; None for a rendering."""


def check_exr(path):
    """Refuse what is no OpenEXR file."""
    if not path.is_file():
        raise BadInput(f"{path} does not exist; give an OpenEXR file or a folder of them")
    with open(path, "rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise BadInput(f"{path} is not an OpenEXR file; save the rendering as .exr, before any tone mapping")


def read_exr(path):
    """Read a file, or say what is wrong with it."""
    path = Path(path)
    check_exr(path)
    try:
        bitmap = mi.Bitmap(str(path))
    except RuntimeError as error:
        raise BadInput(f"{path} cannot be read, it may be incomplete: {error}") from error
    pixels = np.array(bitmap)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    names = [field.name for field in bitmap.struct_()]
    metadata = bitmap.metadata()
    try:
        attribute = json.loads(metadata[ATTRIBUTE]) if ATTRIBUTE in metadata else None
    except ValueError as error:
        raise BadInput(f"{path} is a stored reference with a broken header; make it again with --store") from error
    return Exr({name: pixels[..., index] for index, name in enumerate(names)}, attribute)


def colour_channels(path, content):
    """The names of the channels of a rendering that are compared: R, G and B, or Y."""
    for names in (("R", "G", "B"), ("Y",)):
        if all(name in content.channels for name in names):
            return names
    raise BadInput(f"{path} has the channels {', '.join(content.channels)}; needed are R, G and B, or Y")


def read_side(paths):
    """`Moments` of a stored reference, or `Seeds` of renderings of one size; and the names of unused channels."""
    contents = [read_exr(path) for path in paths]
    references = [path for path, content in zip(paths, contents) if content.attribute is not None]
    if references and len(paths) > 1:
        raise BadInput(f"{references[0]} is a stored reference, and cannot be one of several seeds; rename it")
    if references:
        return read_moments(paths[0], contents[0]), ()
    channels = colour_channels(paths[0], contents[0])
    images = []
    for path, content in zip(paths, contents):
        if colour_channels(path, content) != channels:
            raise BadInput(f"{path} and {paths[0]} are seeds of one image, but have different channels")
        images.append(np.stack([content.channels[name] for name in channels], axis=-1))
        if images[-1].shape != images[0].shape:
            raise BadInput(f"{path} and {paths[0]} are seeds of one image, but have different sizes")
    unused = tuple(name for name in contents[0].channels if name not in channels)
    return Seeds(np.stack(images), channels), unused


def read_moments(path, content):
    """The `Moments` in a stored reference."""
    described = content.attribute
    try:
        names = tuple(described["features"])
        means, variances = (
            np.stack([content.channels[f"{kind}.{name}"] for name in names], axis=-1).astype(np.float64)
            for kind in ("mean", "variance")
        )
        return Moments(names, means, variances, int(described["seeds"]), float(described["scale"]))
    except KeyError as error:
        raise BadInput(f"{path} is a stored reference without {error}; make it again with --store") from error


def provenance_of(path):
    """What a stored reference says about its origin."""
    return read_exr(path).attribute["provenance"]


def write_moments(path, moments, provenance):
    """Store a reference, whole or not at all; `provenance` is a dictionary for JSON."""
    kinds = {"mean": moments.means, "variance": moments.variances}
    names = [f"{kind}.{name}" for kind in kinds for name in moments.names]
    pixels = np.concatenate(list(kinds.values()), axis=-1).astype(np.float32)
    bitmap = mi.Bitmap(pixels, pixel_format=mi.Bitmap.PixelFormat.MultiChannel, channel_names=names)
    described = {"seeds": moments.count, "scale": moments.scale, "features": moments.names, "provenance": provenance}
    bitmap.metadata()[ATTRIBUTE] = json.dumps(described)
    with replacing(path) as temporary:
        bitmap.write(str(temporary))


def entries(path):
    """The images under a path, name to the files of their seeds: of one file, or of a folder and those in it."""
    path = Path(path)
    if not path.is_dir():
        check_exr(path)
        return {image_name(path, path.parent): [path]}
    found = {}
    for file in sorted(path.rglob("*")):
        if file.suffix.lower() == ".exr" and not any(part.startswith(".") for part in file.relative_to(path).parts):
            found.setdefault(image_name(file, path), []).append(file)
    if not found:
        raise BadInput(f"{path} holds no .exr file")
    for name, files in found.items():
        plain = [file for file in files if not SEED.match(file.stem)]
        if plain and len(files) > 1:
            raise BadInput(f"{plain[0]} lies beside seeds of the same name, {name}; move one of them away")
    return found


def image_name(file, folder):
    """A file's name relative to its folder, without suffix and seed; `seed3.exr` has its folder's name."""
    match = SEED.match(file.stem)
    stem = match["name"] if match else file.stem
    relative = (
        (file.parent / stem).relative_to(folder).as_posix() if stem else file.parent.relative_to(folder).as_posix()
    )
    return folder.resolve().name if relative == "." else relative


def pairs(a, b):
    """Triples (name, files of A, files of B) of two paths, each a file or a folder.

    Two paths of one image each belong together whatever their names; otherwise images pair by name, and none may lack
    its partner.
    """
    of_a, of_b = entries(a), entries(b)
    if len(of_a) == len(of_b) == 1:
        (files_a,), ((name, files_b),) = of_a.values(), of_b.items()
        return [(name, files_a, files_b)]
    if not Path(a).is_dir() and set(of_a) <= set(of_b):
        of_b = {name: of_b[name] for name in of_a}
    if not Path(b).is_dir() and set(of_b) <= set(of_a):
        of_a = {name: of_a[name] for name in of_b}
    for side, other, lacking in (("A", b, sorted(set(of_a) - set(of_b))), ("B", a, sorted(set(of_b) - set(of_a)))):
        if lacking:
            raise BadInput(f"{other} lacks {', '.join(lacking)}, which {side} has; add it there or remove it here")
    return [(name, of_a[name], of_b[name]) for name in of_a]
