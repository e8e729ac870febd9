"""A minimal OpenEXR writer: single part, scan lines, no compression, 32-bit float RGB.

Format: https://openexr.com/en/latest/OpenEXRFileLayout.html. Writing the file here keeps the generators free of any
dependency but numpy, and an uncompressed 2K map is written in a fraction of a second.
"""

import struct
from pathlib import Path

import numpy as np

_MAGIC = struct.pack("<ii", 20000630, 2)
_FLOAT = 2  # pixel type code of 32-bit floats


def _attribute(name: str, kind: str, payload: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(payload)) + payload


def _header(width: int, height: int) -> bytes:
    """The mandatory attributes; channels are sorted by name (B, G, R), as the format asks."""
    channels = b"".join(c + b"\0" + struct.pack("<iB3xii", _FLOAT, 0, 1, 1) for c in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    return _MAGIC + b"".join(
        (
            _attribute("channels", "chlist", channels),
            _attribute("compression", "compression", b"\0"),
            _attribute("dataWindow", "box2i", window),
            _attribute("displayWindow", "box2i", window),
            _attribute("lineOrder", "lineOrder", b"\0"),
            _attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
            _attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
            _attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
            b"\0",
        )
    )


def write_exr(path: Path, image: np.ndarray) -> None:
    """Write `image`, shape (height, width, 3), row 0 at the top, as 32-bit float RGB."""
    height, width, channels = image.shape
    if channels != 3:
        raise ValueError(f"{path}: expected 3 channels, got {channels}")
    header = _header(width, height)
    line_bytes = 8 + 3 * 4 * width  # line number, byte count, B, G and R rows
    first_line = len(header) + 8 * height
    offsets = first_line + line_bytes * np.arange(height, dtype="<u8")

    lines = np.empty(height, dtype=[("y", "<i4"), ("size", "<i4"), ("bgr", "<f4", (3, width))])
    lines["y"] = np.arange(height)
    lines["size"] = 3 * 4 * width
    lines["bgr"] = image[:, :, ::-1].transpose(0, 2, 1)
    with open(path, "wb") as file:
        file.write(header)
        file.write(offsets.tobytes())
        file.write(lines.tobytes())
