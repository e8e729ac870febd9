"""Procedural studio environments: a soft gradient, softboxes and small intense lamps, as latitude-longitude images.

Directions are given as seen from the object: azimuth 0 degrees is +z (towards the camera), 90 degrees is +x (to the
right of the picture), elevation 90 degrees is straight up. Radiances are RGB, linear, without unit.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .curves import unit
from .exr import write_exr
from .mesh import FLOOR_HALF_SIZE

HEIGHT = 1024  # rows of the image; a texel is 0.18 degrees high


@dataclass(frozen=True)
class Lamp:
    """A disc of light: direction and angular radius in degrees, colour, irradiance on a surface that faces it."""

    azimuth: float
    elevation: float
    radius: float
    irradiance: float
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Softbox:
    """A rectangle of light: direction and half extents in degrees, radiance; `feather` is the edge's share of it."""

    azimuth: float
    elevation: float
    half_width: float
    half_height: float
    radiance: float
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    feather: float = 0.35


@dataclass(frozen=True)
class Studio:
    """A sky from `horizon` to `zenith` over `ground`, and its lights."""

    ground: tuple[float, float, float]
    horizon: tuple[float, float, float]
    zenith: tuple[float, float, float]
    softboxes: tuple[Softbox, ...]
    lamps: tuple[Lamp, ...]


def _ring(count: int, elevation: float, radius: float, irradiance: float, first: float = 0.0) -> tuple[Lamp, ...]:
    """`count` equal lamps around the horizon."""
    return tuple(Lamp(first + 360 * k / count, elevation, radius, irradiance) for k in range(count))


STUDIOS = {
    "kettle_studio": Studio(
        ground=(0.05, 0.05, 0.05),
        horizon=(0.30, 0.31, 0.33),
        zenith=(0.12, 0.13, 0.15),
        softboxes=(
            Softbox(-72, 30, 14, 28, 2.8, (1.0, 0.96, 0.90)),
            Softbox(84, 28, 11, 30, 2.4, (0.88, 0.94, 1.0)),
            Softbox(178, 22, 30, 12, 0.8, (1.0, 0.97, 0.94)),
            Softbox(8, 58, 12, 14, 1.0, (1.0, 0.98, 0.95)),
        ),
        lamps=(
            Lamp(40, 42, 1.0, 2.4, (1.0, 0.95, 0.88)),
            Lamp(-25, 35, 0.9, 0.6, (1.0, 0.93, 0.84)),
            *_ring(7, 25, 0.8, 0.12, 12.0),
        ),
    ),
    "shoes_studio": Studio(
        ground=(0.06, 0.06, 0.06),
        horizon=(0.32, 0.30, 0.30),
        zenith=(0.15, 0.14, 0.15),
        softboxes=(
            Softbox(-75, 32, 18, 26, 3.0, (1.0, 0.95, 0.88)),
            Softbox(80, 30, 14, 30, 2.2, (0.96, 0.97, 1.0)),
            Softbox(10, 66, 24, 12, 1.8, (1.0, 0.97, 0.92)),
            Softbox(175, 25, 40, 14, 0.6),
        ),
        lamps=(
            Lamp(-42, 46, 1.0, 4.2, (1.0, 0.94, 0.86)),
            Lamp(35, 36, 0.9, 1.8, (1.0, 0.95, 0.88)),
            Lamp(-8, 28, 0.9, 0.9, (1.0, 0.92, 0.82)),
            *_ring(7, 30, 0.8, 0.2, 20.0),
        ),
    ),
    # Outdoors, and without the sun, which is a light of its own: a clear sky with thin clouds.
    "wing_mirror_sky": Studio(
        ground=(0.045, 0.042, 0.04),
        horizon=(0.95, 0.80, 0.66),
        zenith=(0.07, 0.15, 0.36),
        softboxes=(
            Softbox(-50, 34, 26, 9, 0.7, (1.0, 0.97, 0.93), 1.0),
            Softbox(64, 22, 30, 6, 0.6, (1.0, 0.96, 0.92), 1.0),
            Softbox(20, 52, 22, 10, 0.5, (1.0, 0.98, 0.96), 1.0),
            Softbox(150, 30, 40, 12, 0.6, (1.0, 0.97, 0.94), 1.0),
        ),
        lamps=(),
    ),
    # Large softboxes; the small lamps are lights of their own.
    "car_wheel_studio": Studio(
        ground=(0.05, 0.05, 0.055),
        horizon=(0.16, 0.175, 0.20),
        zenith=(0.07, 0.08, 0.095),
        softboxes=(
            Softbox(-58, 26, 24, 36, 2.0, (0.90, 0.95, 1.0)),
            Softbox(82, 20, 20, 36, 2.0, (1.0, 0.95, 0.88)),
            Softbox(20, 70, 40, 14, 2.2, (1.0, 0.99, 0.97)),
        ),
        lamps=(),
    ),
    # A hall with long ceiling lights; the small lamp is a light of its own.
    "car_bonnet_studio": Studio(
        ground=(0.03, 0.03, 0.035),
        horizon=(0.17, 0.19, 0.23),
        zenith=(0.05, 0.055, 0.07),
        softboxes=(
            Softbox(-168, 34, 7, 26, 1.25, (0.92, 0.96, 1.0), 0.3),
            Softbox(150, 40, 5, 24, 1.1, (1.0, 0.98, 0.95), 0.3),
            Softbox(-140, 27, 15, 10, 0.75, (1.0, 0.97, 0.93), 1.0),
            Softbox(95, 20, 40, 7, 1.0, (1.0, 0.95, 0.88), 0.5),
            Softbox(20, 34, 26, 9, 0.8, (1.0, 0.97, 0.94), 0.5),
        ),
        lamps=(),
    ),
    "kettle_mirror_studio": Studio(
        ground=(0.05, 0.05, 0.05),
        horizon=(0.26, 0.28, 0.31),
        zenith=(0.10, 0.11, 0.14),
        softboxes=(
            Softbox(-70, 32, 14, 26, 2.6, (1.0, 0.95, 0.88)),
            Softbox(80, 30, 12, 28, 2.2, (0.86, 0.93, 1.0)),
            Softbox(176, 40, 26, 12, 1.4, (1.0, 0.97, 0.94)),
        ),
        lamps=(
            Lamp(36, 44, 1.0, 2.2, (1.0, 0.95, 0.88)),
            Lamp(-150, 34, 0.9, 1.6, (1.0, 0.93, 0.84)),
            Lamp(142, 30, 0.8, 0.9, (0.90, 0.95, 1.0)),
            *_ring(7, 25, 0.8, 0.12, 12.0),
        ),
    ),
}


def _direction(azimuth: float, elevation: float) -> np.ndarray:
    azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    flat = np.cos(elevation)
    return np.array([flat * np.sin(azimuth), np.sin(elevation), flat * np.cos(azimuth)])


def texel_directions(height: int) -> np.ndarray:
    """Unit directions at texel centres, shape (height, 2 height, 3), in the convention of Mitsuba's `envmap`.

    There, u = atan2(x, -z) / 2 pi and v = acos(y) / pi.
    """
    theta = np.pi * (np.arange(height) + 0.5)[:, None] / height
    phi = np.pi * (np.arange(2 * height) + 0.5)[None, :] / height
    flat = np.sin(theta)
    return np.stack((flat * np.sin(phi), np.cos(theta) + 0 * phi, -flat * np.cos(phi)), axis=-1)


def _smoothstep(edge0: float, edge1: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - edge0) / (edge1 - edge0), 0, 1)
    return t * t * (3 - 2 * t)


def _gradient(studio: Studio, up: np.ndarray) -> np.ndarray:
    """Radiance of the empty studio for the directions' vertical components `up`."""
    horizon = np.array(studio.horizon)
    sky = horizon + (np.array(studio.zenith) - horizon) * np.sqrt(np.clip(up, 0, 1))[..., None]
    ground = np.array(studio.ground)
    return ground + (sky - ground) * _smoothstep(-0.2, 0.05, up)[..., None]


def _softbox_mask(box: Softbox, directions: np.ndarray) -> np.ndarray:
    """Coverage in [0, 1]: a rectangle with soft edges in the plane tangent to the box's direction."""
    centre = _direction(box.azimuth, box.elevation)
    right = unit(np.cross([0.0, 1.0, 0.0], centre))
    above = np.cross(centre, right)
    depth = directions @ centre
    safe = np.maximum(depth, 1e-3)
    across = np.abs(directions @ right) / safe / np.tan(np.radians(box.half_width))
    along = np.abs(directions @ above) / safe / np.tan(np.radians(box.half_height))
    edge = 1 - box.feather
    return (1 - _smoothstep(edge, 1, across)) * (1 - _smoothstep(edge, 1, along)) * (depth > 0)


def _lamp_radiance(lamp: Lamp, directions: np.ndarray, solid_angle: np.ndarray) -> np.ndarray:
    """A disc with a slightly soft rim, scaled so that its irradiance is exact on the texel grid."""
    cosine = directions @ _direction(lamp.azimuth, lamp.elevation)
    radius = np.radians(lamp.radius)
    near = cosine > np.cos(1.25 * radius)
    disc = np.zeros_like(cosine)
    disc[near] = 1 - _smoothstep(0.75 * radius, 1.25 * radius, np.arccos(np.minimum(cosine[near], 1)))
    return (lamp.irradiance / np.sum(disc * solid_angle)) * disc


def studio_image(studio: Studio, height: int = HEIGHT) -> np.ndarray:
    """Radiance image of a studio, shape (height, 2 height, 3)."""
    directions = texel_directions(height)
    solid_angle = np.sqrt(1 - directions[:, :1, 1] ** 2) * (np.pi / height) ** 2
    image = _gradient(studio, directions[:, :, 1])
    for box in studio.softboxes:
        image += (box.radiance * _softbox_mask(box, directions))[..., None] * np.array(box.colour)
    for lamp in studio.lamps:
        image += _lamp_radiance(lamp, directions, solid_angle)[..., None] * np.array(lamp.colour)
    return image


@dataclass(frozen=True)
class Pool:
    """Reflectance of a floor under a pool of light: colours in the middle and far away, radius in cm."""

    centre: tuple[float, float, float]
    far: tuple[float, float, float]
    radius: float


FLOORS = {
    "kettle_floor": Pool((0.40, 0.125, 0.055), (0.030, 0.008, 0.006), 48.0),
    "car_wheel_floor": Pool((0.16, 0.17, 0.19), (0.012, 0.013, 0.016), 95.0),
    "bent_quad_floor": Pool((0.10, 0.13, 0.17), (0.010, 0.013, 0.018), 60.0),
    "shoes_floor": Pool((0.095, 0.021, 0.095), (0.014, 0.003, 0.020), 46.0),
}


def floor_image(pool: Pool, half_size: float = FLOOR_HALF_SIZE, resolution: int = 512) -> np.ndarray:
    """Reflectance of the floor square of `half_size` cm, brightest in the middle; (resolution, resolution, 3)."""
    side = half_size * (2 * (np.arange(resolution) + 0.5) / resolution - 1)
    squared = (side[:, None] ** 2 + side[None, :] ** 2) / pool.radius**2
    weight = (1 / (1 + squared**1.5))[..., None]
    return np.array(pool.far) + weight * (np.array(pool.centre) - np.array(pool.far))


def write_floor(path: Path, name: str) -> None:
    """Write the floor texture `name` of `FLOORS` as float EXR."""
    write_exr(path, floor_image(FLOORS[name]))


def write_environment(path: Path, name: str) -> None:
    """Write the studio `name` of `STUDIOS` as float EXR."""
    write_exr(path, studio_image(STUDIOS[name]))
