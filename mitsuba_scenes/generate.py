#!/usr/bin/env python3
"""Generate the meshes, environments and normal maps of this folder's scenes into a cache folder.

    python mitsuba_scenes/generate.py [--cache DIR] [--map-resolution 2048] [--force]

Everything is made by committed scripts (`scene_assets/`), needs numpy only, and is written once: each group of files
has a stamp with a hash of the scripts that made it, and is made again when one of them changes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

SCENES_DIR = Path(__file__).resolve().parent
if str(SCENES_DIR) not in sys.path:
    sys.path.insert(0, str(SCENES_DIR))

from scene_assets import (
    bent_quad,
    car_bonnet,
    car_wheel,
    environment,
    kettle,
    kettle_mirror,
    maps,
    mesh,
    shoe,
    wing_mirror,
)

DEFAULT_CACHE = SCENES_DIR.parent / ".cache" / "scenes"
MAPS = tuple(maps.RECIPES)


@dataclass(frozen=True)
class Group:
    """Files that are generated together: their names, the scripts they depend on, and what writes them.

    `write` yields (file name, function that writes to a path) pairs.
    """

    name: str
    files: tuple[str, ...]
    sources: tuple[str, ...]
    write: Callable[[], Iterator[tuple[str, Callable[[Path], None]]]]

    def stamp(self) -> str:
        """Hash of the scripts and of the file names."""
        digest = hashlib.sha256("\n".join(self.files).encode())
        for source in self.sources:
            digest.update((SCENES_DIR / "scene_assets" / source).read_bytes())
        return digest.hexdigest()


def map_file(name: str, resolution: int | None = None) -> str:
    """File name of a normal map in the cache folder; None: at its full resolution."""
    return f"{name}_{resolution or maps.RECIPES[name].full_resolution}.exr"


def _map_group(name: str, resolution: int | None) -> Group:
    file = map_file(name, resolution)
    resolution = resolution or maps.RECIPES[name].full_resolution
    return Group(
        name=f"{name}_{resolution}",
        files=(file,),
        sources=("maps.py", "exr.py"),
        write=lambda: iter([(file, lambda path: maps.write_map(path, name, resolution))]),
    )


def _image_group(name: str, write_image: Callable[[Path, str], None]) -> Group:
    return Group(
        name=name,
        files=(f"{name}.exr",),
        sources=("environment.py", "curves.py", "exr.py", "mesh.py"),
        write=lambda: iter([(f"{name}.exr", lambda path: write_image(path, name))]),
    )


def _mesh_group(name: str, module, parts: tuple[str, ...]) -> Group:
    def write():
        for part, part_mesh in module.build().items():
            yield f"{part}.ply", lambda path, m=part_mesh: mesh.write_ply(path, m)

    files = tuple(f"{part}.ply" for part in parts)
    return Group(name, files, (f"{name}.py", "curves.py", "mesh.py"), write)


def _floor_group() -> Group:
    return Group(
        name="floor",
        files=("floor.ply",),
        sources=("mesh.py", "curves.py"),
        write=lambda: iter([("floor.ply", lambda path: mesh.write_ply(path, mesh.floor()))]),
    )


def groups(map_resolution: int | None = None) -> list[Group]:
    """All groups of files that the scenes need."""
    return [
        *(_map_group(name, map_resolution) for name in MAPS),
        *(_image_group(name, environment.write_environment) for name in environment.STUDIOS),
        *(_image_group(name, environment.write_floor) for name in environment.FLOORS),
        _floor_group(),
        _mesh_group("kettle", kettle, kettle.PARTS),
        _mesh_group("shoe", shoe, shoe.PARTS),
        _mesh_group("car_wheel", car_wheel, car_wheel.PARTS),
        _mesh_group("wing_mirror", wing_mirror, wing_mirror.PARTS),
        _mesh_group("car_bonnet", car_bonnet, car_bonnet.PARTS),
        _mesh_group("kettle_mirror", kettle_mirror, kettle_mirror.PARTS),
        _mesh_group("bent_quad", bent_quad, bent_quad.PARTS),
    ]


def is_current(group: Group, cache: Path) -> bool:
    """True if the group's files exist and were made by the scripts as they are now."""
    try:
        stamp = json.loads((cache / f"{group.name}.stamp").read_text())["stamp"]
    except (OSError, ValueError, KeyError):
        return False
    return stamp == group.stamp() and all((cache / file).is_file() for file in group.files)


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: nobody ever sees half a file."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def generate_group(group: Group, cache: Path) -> None:
    """Write the files of a group, then its stamp."""
    written = []
    for file, write in group.write():
        write_atomically(cache / file, write)
        written.append(file)
    if sorted(written) != sorted(group.files):
        raise RuntimeError(f"{group.name}: wrote {sorted(written)}, expected {sorted(group.files)}")
    text = json.dumps({"stamp": group.stamp(), "files": list(group.files)})
    write_atomically(cache / f"{group.name}.stamp", lambda path: path.write_text(text))


def ensure_assets(
    cache_dir: str | os.PathLike | None = None,
    map_resolution: int | None = None,
    force: bool = False,
    log: Callable[[str], None] = print,
) -> dict:
    """Generate what is missing or outdated in `cache_dir` (default: `.cache/scenes` of the repository).

    Returns {"assets": folder, "maps": {name: path}}, names as in `maps.RECIPES`. `map_resolution` in texels per side of
    every map; None: each at its own full resolution.
    """
    if map_resolution is not None and map_resolution < 1:
        raise ValueError(f"map_resolution must be at least 1, got {map_resolution}")
    cache = Path(cache_dir) if cache_dir is not None else DEFAULT_CACHE
    cache = cache.resolve()
    cache.mkdir(parents=True, exist_ok=True)
    missing = [group for group in groups(map_resolution) if force or not is_current(group, cache)]
    start = time.perf_counter()
    # Threads are enough: most of the time goes into numpy's loops over large arrays, which let others run.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for group, done in [(group, pool.submit(generate_group, group, cache)) for group in missing]:
            done.result()
            log(f"scene assets: {group.name}")
    if missing:
        log(f"scene assets: {len(missing)} groups of files made in {time.perf_counter() - start:.1f} s")
    return {"assets": cache, "maps": {name: cache / map_file(name, map_resolution) for name in MAPS}}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Generate the assets of this folder's scenes.")
    parser.add_argument("--cache", type=Path, default=None, help=f"folder to write to (default {DEFAULT_CACHE})")
    parser.add_argument("--map-resolution", type=int, help="texels per side of every map (default: each its own)")
    parser.add_argument("--force", action="store_true", help="generate everything again")
    arguments = parser.parse_args()
    assets = ensure_assets(arguments.cache, arguments.map_resolution, arguments.force)
    print(f"scene assets are up to date in {assets['assets']}")


if __name__ == "__main__":
    main()
