"""Where numbers come from: versions, plugin digests, machine."""

import datetime
import os
import platform
from functools import cache
from importlib import metadata, util
from pathlib import Path

from .files import digest_files

PACKAGES = ("mitsuba", "drjit", "mitsuba-glints", "numpy", "scipy", "flip-evaluator", "matplotlib", "distributed")


@cache
def versions():
    """Installed versions of what decides a result, name to version; None for a package that is not there."""
    return {**{name: version(name) for name in PACKAGES}, "python": platform.python_version()}


@cache
def version(package):
    """The installed version of a package, or None."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


@cache
def plugin_digest():
    """Digest of this project's installed plugins and libraries, or None if they are not installed."""
    found = util.find_spec("mitsuba_glints")
    if found is None:
        return None
    return digest_files(Path(found.origin).parent.rglob("*.so"))


@cache
def machine():
    """Processor, cores, memory and system of this machine."""
    return {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "system": platform.platform(terse=True),
    }


def processor():
    """The processor's model name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def now():
    """Date and time with time zone, to the second."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def environment():
    """What decides a result beside its parameters: versions, plugins, machine."""
    return {"versions": versions(), "plugins": plugin_digest(), "machine": machine()}


def provenance():
    """The environment, and the date."""
    return {"date": now(), **environment()}
