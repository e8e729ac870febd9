"""Files that are either complete or absent, and digests of what a result depends on."""

import hashlib
import json
import math
import os
import tempfile
from contextlib import contextmanager
from functools import cache
from pathlib import Path


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


def write_json(path, value):
    """Write `value` as standard JSON, whole or not at all; see `json_ready` for numbers that JSON lacks."""
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


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
