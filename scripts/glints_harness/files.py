"""Files that are either complete or absent, and digests of what a result depends on."""

import csv
import hashlib
import json
import math
import os
import shutil
import tempfile
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np


class Damaged(Exception):
    """A kept result whose files are broken or don't fit together; the message names the file."""


@contextmanager
def replacing(path):
    """Yield a temporary path beside `path` and rename it to `path` on success.

    After an error or an interruption the old file, if any, is still there, whole, and the temporary one is gone.
    The temporary name keeps the suffix of `path`, since writers of images go by it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=".unfinished-", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path, text):
    """Write `text` as UTF-8, whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def duplicate(source, target):
    """Make `target` the same file as `source`, whole or not at all: a hard link where one file system holds both."""
    with replacing(target) as temporary:
        temporary.unlink()
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def write_json(path, value):
    """Write `value` as standard JSON, whole or not at all; see `json_ready` for numbers that JSON lacks."""
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


def write_exr(path, image):
    """Write a linear image (height, width, 3) as 32-bit floats, whole or not at all."""
    with replacing(path) as temporary:
        mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32)).write(str(temporary))


def write_csv(path, rows):
    """Write dictionaries as a table with a heading, whole or not at all: lists with spaces, dictionaries as JSON, None as nothing."""
    with replacing(path) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
        table.writeheader()
        for row in rows:
            table.writerow({key: csv_text(item) for key, item in row.items()})


def csv_text(value):
    """What stands in a cell of a table."""
    if isinstance(value, dict):
        return json.dumps(value)
    return " ".join(map(str, value)) if isinstance(value, list) else value


def json_ready(value):
    """Spell non-finite numbers as the strings "Infinity", "-Infinity" and "NaN": shown, never replaced by a number."""
    if isinstance(value, dict):
        return {key: json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    if isinstance(value, Path):
        return value.as_posix()
    return value


def digest_text(text):
    """SHA-256 of a text, in hexadecimal."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def digest_file(path):
    """SHA-256 of a file's content, in hexadecimal; read once per process unless the file changes."""
    status = os.stat(path)
    return _digest_file(str(path), status.st_mtime_ns, status.st_size)


@cache
def _digest_file(path, _modified, _size):
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        for block in iter(lambda: file.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def digest_files(paths):
    """SHA-256 over the names and contents of several files, in hexadecimal, whatever their order."""
    lines = sorted(f"{Path(path).name} {digest_file(path)}" for path in paths)
    return digest_text("\n".join(lines))
