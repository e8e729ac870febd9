"""The wing mirror of a car: a painted shell, its glass, the foot, and the door that it stands on. Lengths in cm.

x points outboard, y up and z ahead, towards the camera. The shell is a dome of superelliptic meridians over a closed
outline; texture coordinates are polar ones about its apex (length along the meridian, in the meridian's direction),
which have no seam.
"""

import numpy as np

from .curves import periodic_spline, spline, tube, unit
from .mesh import Mesh, arc_length, grid_mesh, merge

PARTS = ("wing_mirror_paint", "wing_mirror_black", "wing_mirror_lens", "wing_mirror_glass", "wing_mirror_window")
TILE = 5.0  # cm of surface per map tile (at tiling 1)
AROUND, MERIDIAN = 256, 96  # cells of the shell
DEPTH = 8.6  # of the dome, from the outline to the apex
ROUNDNESS = 0.66  # exponent of the meridians: 1 is an ellipse, smaller is boxier
LAST_ANGLE = np.radians(112)  # where the meridians end, turned in behind the outline
WALL = 0.35  # thickness of the shell, in parts of a unit outline scaled inwards

# The outline seen from ahead, counter-clockwise from the outboard end, at equal steps of the parameter.
OUTLINE = np.array(
    [(12.3, 0.8), (11.9, 5.0), (9.2, 7.7), (4.4, 8.5), (-0.9, 8.4), (-6.2, 7.6), (-10.2, 5.2), (-11.8, 0.9)]
    + [(-10.9, -3.2), (-7.4, -5.9), (-2.0, -6.9), (3.4, -6.9), (8.4, -6.1), (11.6, -3.4)]
)


def shell_points(s: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points of the shell, (len(angle), len(s), 3): s in [0, 1] round the outline, angle from the apex in radians.

    The outboard end and the top are swept back, as the wind would have it.
    """
    plan = periodic_spline(OUTLINE, s)
    wide = np.sin(angle)[:, None] ** ROUNDNESS
    cosine = np.cos(angle)[:, None]
    x, y = plan[:, 0] * wide, plan[:, 1] * wide
    z = DEPTH * np.sign(cosine) * np.abs(cosine) ** ROUNDNESS
    z = z - 0.011 * (x + 9) ** 2 * (x > -9) - 0.012 * np.maximum(y + 2, 0) ** 2
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def _closed(points: np.ndarray) -> np.ndarray:
    points[:, -1] = points[:, 0]
    return points


def shell() -> Mesh:
    """The painted shell."""
    s = np.linspace(0, 1, AROUND + 1)
    points = _closed(shell_points(s, np.linspace(0, LAST_ANGLE, MERIDIAN + 1)))
    direction = unit(periodic_spline(OUTLINE, s))
    uv = arc_length(points, axis=0)[..., None] * direction / TILE
    return grid_mesh(points, uv, flip=True)


def inside() -> Mesh:
    """The black inside of the shell, seen from behind, down to the glass."""
    s = np.linspace(0, 1, AROUND + 1)
    rim = shell_points(s, np.array([LAST_ANGLE]))[0]
    scale = np.array([1.0, 0.97, 0.94, 0.94])[:, None, None]
    ahead = np.array([0.0, -0.3, 0.0, 1.4])[:, None, None]
    points = rim[None] * np.where(np.arange(3) < 2, scale, 1.0) + ahead * np.array([0.0, 0.0, 1.0])
    return _plain(_closed(points))


def glass() -> Mesh:
    """The mirror itself, facing back."""
    s = np.linspace(0, 1, AROUND + 1)
    rim = shell_points(s, np.array([LAST_ANGLE]))[0]
    size = np.linspace(0, 0.95, 5)[:, None, None]
    points = size * (rim * np.array([1.0, 1.0, 0.0]))
    points[..., 2] = rim[:, 2].mean() + 0.6 - 0.05 * points[..., 0]
    return _plain(_closed(points), flip=True)


def on_shell(s: np.ndarray, angle: np.ndarray, height: float, edge: int = 5) -> Mesh:
    """A pad on the shell over a grid of its parameters, `height` cm thick, its border sunk under the surface.

    `s` and `angle` have shape (rows, columns).
    """
    step = 1e-4

    def at(s, angle):
        rows = [shell_points(s[k], angle[k, :]) for k in range(len(s))]
        return np.stack([np.diagonal(row, axis1=0, axis2=1).T for row in rows])

    points = at(s, angle)
    around = at(s + step, angle) - at(s - step, angle)
    down = at(s, angle + step) - at(s, angle - step)
    normal = unit(np.cross(down, around))
    rows, columns = s.shape
    from_edge = np.minimum.outer(
        np.minimum(np.arange(rows), np.arange(rows)[::-1]), np.minimum(np.arange(columns), np.arange(columns)[::-1])
    )
    rise = height * (1.15 * np.sqrt(1 - (1 - np.clip(from_edge / edge, 0, 1)) ** 2) - 0.15)
    return _plain(points + rise[..., None] * normal, flip=True)


def skirt() -> Mesh:
    """The unpainted lower part of the housing."""
    w = np.linspace(0, 1, 161)[None, :]
    s = 0.555 + 0.40 * w + np.zeros((49, 1))
    top = np.radians(63 + 30 * (2 * np.abs(w - 0.5)) ** 3)
    angle = top + np.linspace(0, 1, 49)[:, None] * (LAST_ANGLE - top)
    return on_shell(s, angle, 0.10)


def lens() -> Mesh:
    """The indicator: a narrow strip across the front that bends round the outboard end."""
    w = np.linspace(0, 1, 161)[:, None]
    half = 0.0115 * np.sqrt(1 - (1 - np.clip(8 * w, 0, 1)) ** 2)
    middle = 0.985 - 0.035 * w**2
    s = middle + np.linspace(-1, 1, 25)[None, :] * half / np.sin(np.radians(34 + 66 * w)) ** ROUNDNESS
    angle = np.radians(34 + 66 * w) + np.zeros((1, 25))
    return on_shell(s, angle, 0.12)


def foot() -> Mesh:
    """The stalk from the housing to the door, and the plate where it stands."""
    t = np.linspace(0, 1, 60)
    path = spline(
        np.linspace(0, 1, 4),
        np.array([(-3.5, -3.5, 0.5), (-8.5, -7.6, -0.5), (-13.5, -9.6, -1.0), (-20.0, -10.2, -1.5)]),
        t,
    )
    wide = spline(np.linspace(0, 1, 4), np.array([4.4, 3.8, 4.6, 8.5]), t)
    high = spline(np.linspace(0, 1, 4), np.array([3.4, 2.0, 1.8, 2.2]), t)
    return _plain(tube(path, wide, high, np.array([0.0, 0.0, 1.0]), 64))


def door_points(y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Points of the door's skin, (len(y), len(z), 3); it bulges, and a crease runs along it."""
    height = y[:, None] + 0 * z[None, :]
    x = -17.0 - 0.0022 * (height + 20) ** 2 - 0.9 / (1 + np.exp(-(height + 27) / 0.9)) - 0.00012 * z[None, :] ** 2
    return np.stack((x, height, z[None, :] + 0 * height), axis=-1)


def door() -> Mesh:
    """The painted door below the window."""
    points = door_points(np.linspace(-70, BELT, 121), np.linspace(50, -130, 91))
    uv = np.stack((-points[..., 2], arc_length(points, axis=0)), axis=-1) / TILE
    return grid_mesh(points, uv)


BELT = -6.0  # height of the door's upper edge


def window() -> Mesh:
    """The side window, which leans inwards."""
    lower = door_points(np.array([BELT]), np.linspace(50, -130, 46))[0] - np.array([0.8, 0, 0])
    rise = np.linspace(0, 1, 21)[:, None, None]
    return _plain(lower + rise * np.array([-24.0, 46.0, 0.0]) + np.sin(np.pi * rise) * np.array([1.6, 0.0, 0.0]))


def belt() -> Mesh:
    """The rubber strip between door and window."""
    path = door_points(np.array([BELT]), np.linspace(50, -130, 61))[0] - np.array([0.4, 0.0, 0.0])
    return _plain(tube(path, np.full(61, 0.7), np.full(61, 0.75), np.array([0.0, 1.0, 0.0]), 24))


def _plain(points: np.ndarray, flip: bool = False) -> Mesh:
    return grid_mesh(points, np.zeros((*points.shape[:2], 2)), flip)


def build() -> dict[str, Mesh]:
    """The meshes by name."""
    return {
        "wing_mirror_paint": merge([shell(), door()]),
        "wing_mirror_black": merge([inside(), skirt(), foot(), belt()]),
        "wing_mirror_lens": lens(),
        "wing_mirror_glass": glass(),
        "wing_mirror_window": window(),
    }
