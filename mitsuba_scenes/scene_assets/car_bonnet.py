"""The front corner of a car: bonnet and wing of one body panel, its gaps, a headlight and the windscreen. Lengths in cm.

x points to the car's left, y up and z ahead, towards the camera. The body is a translational surface: a profile
along the car, from the windscreen over the bonnet down the nose, is moved along a section across it, from the middle
over the wing's crest down the side. Texture coordinates are the lengths along the two curves.
"""

import numpy as np

from .curves import profile_curve, tube, unit
from .mesh import Mesh, grid_mesh, merge

PARTS = ("car_bonnet_paint", "car_bonnet_black", "car_bonnet_chrome", "car_bonnet_lens", "car_bonnet_window")
TILE = 0.13  # cm of surface per map tile (at tiling 1): about 1000 of them across the picture
ACROSS, ALONG = 421, 301  # vertices of the body

# Section across the car, (x, fall) from its middle outwards, and how far the nose lies back there.
SECTION = np.array(
    [(-82.0, -1.6), (-60.0, 0.4), (-45.0, 0.9), (-25.0, 1.1), (0.0, 1.2), (25.0, 1.1), (45.0, 0.9), (54.0, 0.35)]
    + [(60.0, -1.1), (65.0, -1.9), (70.5, -1.2), (77.0, -0.9), (83.0, -3.2), (87.0, -9.5), (88.6, -19.0)]
    + [(88.4, -32.0), (86.5, -48.0), (85.0, -70.0)]
)
SWEEP = 0.0036  # cm per square cm of x
# Profile along the car, (z, y) from the windscreen to below the bumper.
PROFILE = np.array(
    [
        (-112.0, 15.8),
        (-85.0, 13.6),
        (-50.0, 10.6),
        (-10.0, 6.4),
        (25.0, 1.4),
        (50.0, -3.6),
        (64.0, -8.3),
        (72.0, -14.0),
    ]
    + [(76.0, -22.0), (77.0, -36.0), (75.0, -60.0)]
)
GAP = 0.5  # radius of the dark gaps between panels
GAP_X = 63.5  # where the gap between bonnet and wing is
FRONT = 124.0  # length along the profile to where the bonnet ends


def _curves() -> tuple[np.ndarray, np.ndarray]:
    """Section and profile as dense polylines of equal steps, (x, fall) and (z, y)."""
    return profile_curve(SECTION, 2001), profile_curve(PROFILE, 2001)


def _lengths(curve: np.ndarray) -> np.ndarray:
    return np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))))


def body_points(across: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Points of the body at lengths in cm along section and profile, which broadcast; shape (..., 3)."""
    section, profile = _curves()
    x, fall = (np.interp(across, _lengths(section), section[:, k]) for k in range(2))
    z, y = (np.interp(along, _lengths(profile), profile[:, k]) for k in range(2))
    return np.stack(np.broadcast_arrays(x, y + fall, z - SWEEP * x * x), axis=-1)


def across_at(x: float) -> float:
    """Length along the section at which the top of the body has this x."""
    section, _ = _curves()
    return float(_lengths(section)[np.argmax(section[:, 0] >= x)])


def body() -> Mesh:
    """The painted panels, one surface."""
    section, profile = _curves()
    across = np.linspace(0, _lengths(section)[-1], ACROSS)
    along = np.linspace(0, _lengths(profile)[-1], ALONG)
    points = body_points(across[None, :], along[:, None])
    u, v = np.broadcast_arrays(across[None, :], -along[:, None])
    return grid_mesh(points, np.stack((u, v), axis=-1) / TILE, flip=True)


def gap(across: np.ndarray, along: np.ndarray) -> Mesh:
    """A dark gap along a line of the body (lengths along section and profile): a tube that hardly stands out of it."""
    path = body_points(across, along)
    radius = np.full(len(path), GAP)
    normal = body_normals(across, along).mean(axis=0)
    return _plain(tube(path - 0.78 * GAP * body_normals(across, along), radius, radius, normal, 16))


def body_normals(across: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Outward unit normals of the body."""
    step = 0.05
    first = body_points(across + step, along) - body_points(across - step, along)
    second = body_points(across, along + step) - body_points(across, along - step)
    return unit(np.cross(second, first))


def gaps() -> Mesh:
    """Round the bonnet: along both wings, and across the front with round corners."""
    right, left = across_at(-GAP_X), across_at(GAP_X)
    t = np.linspace(0, 1, 160)
    sides = [gap(np.full(160, a), 4 + (FRONT - 12 - 4) * t) for a in (right, left)]
    turn = 0.5 * np.pi * np.linspace(0, 1, 24)
    corner_left = (left - 12 * (1 - np.cos(turn)), FRONT - 12 * (1 - np.sin(turn)))
    corner_right = (right + 12 * (1 - np.cos(turn)), FRONT - 12 * (1 - np.sin(turn)))
    front = gap(np.linspace(right + 12, left - 12, 200), np.full(200, FRONT))
    return merge([*sides, gap(*corner_left), gap(*corner_right), front])


def lamp_outline(angle: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Lengths along section and profile of a headlight's outline: blunt inside, drawn out along the wing outside."""
    c, s = np.cos(angle), np.sin(angle)
    across = 21.0 * size * c
    along = size * s * (5.6 - 3.4 * c) - 0.5 * (across + 21.0 * size) ** 2 / 42.0
    return across_at(72.0) + across, FRONT + 17.0 + along


def lamp_pad(size: float, height: float, rows: int = 24, columns: int = 161) -> Mesh:
    """The headlight's outline filled as a cushion, `height` cm above the body in the middle, its border sunk."""
    angle = np.linspace(0, 2 * np.pi, columns)
    radius = np.linspace(1e-3, 1, rows)[:, None]
    middle, border = lamp_outline(angle, 0.0), lamp_outline(angle, size)
    across, along = (m + (b - m) * radius for m, b in zip(middle, border))
    rise = height * (1.1 * np.sqrt(1 - radius**6) - 0.1)
    points = body_points(across, along) + rise[..., None] * body_normals(across, along)
    points[:, -1] = points[:, 0]
    return _plain(points, flip=True)


def lamp_ring() -> Mesh:
    """A bright frame inside the headlight's border."""
    angle = np.linspace(0, 2 * np.pi, 321)
    across, along = lamp_outline(angle, 0.93)
    path = body_points(across, along) + 0.35 * body_normals(across, along)
    side = body_normals(across, along).mean(axis=0)
    return _plain(tube(path, np.full(321, 0.22), np.full(321, 0.22), side, 12))


def projectors() -> Mesh:
    """Three round reflectors behind the lens, as rings and bowls that lie on it."""
    meshes = []
    for offset, radius in ((-11.5, 2.7), (-3.2, 2.5), (4.6, 2.1)):
        across, along = across_at(72.0) + offset, FRONT + 17.0 - 0.5 * (offset + 21.0) ** 2 / 42.0
        centre = body_points(np.array([across]), np.array([along]))[0]
        normal = body_normals(np.array([across]), np.array([along]))[0]
        first = unit(np.cross(normal, np.array([0.0, 1.0, 0.0])))
        second = np.cross(normal, first)
        angle = np.linspace(0, 2 * np.pi, 97)
        round_ = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        radii = np.array([1.0, 0.97, 0.9, 0.84, 0.8, 0.6, 0.35, 1e-3]) * radius
        heights = np.array([0.35, 0.75, 0.9, 0.8, 0.45, 0.75, 0.95, 1.02])
        points = centre + radii[:, None, None] * round_[None] + heights[:, None, None] * normal
        points[:, -1] = points[:, 0]
        meshes.append(_plain(points))
    return merge(meshes)


def window() -> Mesh:
    """The windscreen."""
    x = np.linspace(-78, 78, 61)[None, :]
    t = np.linspace(0, 1, 31)[:, None]
    z = -106.0 - 70.0 * t - 0.0046 * x * x
    y = 15.0 + 42.0 * t - 6.0 * t * t - 0.0012 * x * x
    return _plain(np.stack(np.broadcast_arrays(x, y, z), axis=-1), flip=True)


def cowl() -> Mesh:
    """The black trough between bonnet and windscreen, and the frame of the screen."""
    x = np.linspace(-84, 84, 81)
    lower = np.stack((x, 15.2 - 0.0016 * x * x, -104.0 - 0.0044 * x * x), axis=-1)
    bar = tube(lower, np.full(81, 5.0), np.full(81, 1.6), np.array([0.0, 0.0, 1.0]), 32)
    t = np.linspace(0, 1, 31)
    pillars = []
    for side in (-1, 1):
        z = -106.0 - 70.0 * t - 0.0046 * 80**2
        y = 15.0 + 42.0 * t - 6.0 * t * t - 0.0012 * 80**2
        path = np.stack((side * np.full(31, 80.0), y, z), axis=-1)
        pillars.append(_plain(tube(path, np.full(31, 3.2), np.full(31, 2.2), np.array([1.0, 0.0, 0.0]), 24)))
    return merge([_plain(bar), *pillars])


def _plain(points: np.ndarray, flip: bool = False) -> Mesh:
    return grid_mesh(points, np.zeros((*points.shape[:2], 2)), flip)


def build() -> dict[str, Mesh]:
    """The meshes by name."""
    return {
        "car_bonnet_paint": body(),
        "car_bonnet_black": merge([gaps(), cowl()]),
        "car_bonnet_chrome": merge([lamp_ring(), projectors()]),
        "car_bonnet_lens": lamp_pad(1.0, 0.3),
        "car_bonnet_window": window(),
    }
