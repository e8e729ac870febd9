"""A stove-top kettle: body and lid of revolution, a swept spout with a fillet, an arched handle. Lengths in cm.

Built with the axis on y, standing on y = 0, the spout towards +x; `build` turns it for the picture. The brush
direction (u) goes round the body, round the lid and round the spout, a whole number of tiles each time.
"""

import numpy as np

from .curves import profile_curve, resample, rotation_y, spline, tube, unit
from .mesh import Mesh, arc_length, grid_mesh, merge

COLUMNS = 192
TILE_HEIGHT = 9.0  # cm of surface along v per map tile (at tiling 1)
BODY_TILES, LID_TILES, SPOUT_TILES = 2, 1, 1  # map tiles around (at tiling 1)
TURN = np.radians(212)  # spout to the left, a little towards the camera
SEAM = np.pi - TURN  # u = 0 lies on the left outline in the picture, and the middle one of two tiles on the right
PARTS = ("kettle_metal", "kettle_trim", "kettle_black")

# Profiles of the surfaces of revolution: (radius, height), from below.
BODY = np.array(
    [(9.55, 0.75), (9.95, 1.15), (10.3, 2.4), (10.3, 4.2), (9.75, 6.8)]
    + [(8.6, 9.3), (7.1, 11.3), (5.75, 12.5), (5.05, 12.9)]
)
LID = np.array(
    [(5.1, 12.7), (5.2, 12.98), (5.22, 13.2), (4.95, 13.38), (4.2, 13.72), (3.0, 14.25), (1.7, 14.62), (0.45, 14.75)]
)
BASE = np.array([(8.9, 0.0), (9.45, 0.08), (9.6, 0.4), (9.5, 0.8)])
STEM = np.array([(0.9, 14.66), (0.62, 14.85), (0.55, 15.2), (0.62, 15.6)])
FOOT = np.array([(1.2, -0.2), (1.2, 0.1), (1.08, 0.26), (0.7, 0.36), (0.0, 0.4)])  # where the handle stands
KNOB = np.array([(0.3, 15.5), (0.9, 15.55), (1.55, 16.0), (1.72, 16.6), (1.4, 17.15), (0.7, 17.4), (0.0, 17.45)])


def revolve(profile: np.ndarray, tiles: int, columns: int = COLUMNS) -> Mesh:
    """Surface of revolution of (radius, height) points; u goes round in `tiles` map tiles, v follows the profile."""
    around = np.linspace(0, 2 * np.pi, columns + 1)
    angle = around + SEAM
    radius, height = profile[:, :1], profile[:, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), height, -radius * np.sin(angle)), axis=-1)
    points[:, -1] = points[:, 0]
    u = np.broadcast_to(tiles * around / (2 * np.pi), points.shape[:2])
    return grid_mesh(points, np.stack((u, arc_length(points, axis=0) / TILE_HEIGHT), axis=-1))


def body_radius(height: np.ndarray) -> np.ndarray:
    """Radius of the body at a height."""
    profile = profile_curve(BODY, 400)
    return np.interp(height, profile[:, 1], profile[:, 0])


def spout_tube(rows: int, shrink: float = 0.0) -> np.ndarray:
    """The plain swept spout, its root deep inside the body, its lip cut level; radii smaller by `shrink`."""
    t = np.linspace(0, 1, rows)
    knots = np.linspace(0, 1, 4)
    path = np.zeros((rows, 3))
    path[:, :2] = spline(knots, np.array([(6.0, 6.6), (10.6, 8.7), (12.9, 11.3), (14.6, 14.4)]), t)
    radius = spline(knots, np.array([3.3, 2.35, 1.65, 1.42]), t) - shrink
    return tube(path, radius, radius, np.array([0.0, 0.0, 1.0]), 96)


def spout_fillet(grid: np.ndarray, size: float = 1.3, rows: int = 14) -> np.ndarray:
    """Cut the tube where it leaves the body and round the joint; returns points with one row count for all columns."""
    centre = grid[:, :-1].mean(axis=1, keepdims=True)
    columns = []
    for k in range(grid.shape[1]):
        line = resample(grid[:, k], 800)
        outside = np.hypot(line[:, 0], line[:, 2]) - body_radius(line[:, 1])
        cut = int(np.nonzero(outside < 0)[0].max())
        joint = line[cut]
        along = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(line[cut:], axis=0), axis=1))))
        upper = line[cut:][np.searchsorted(along, size) :]
        lower = _slide_on_body(
            joint, joint - centre[np.argmin(np.linalg.norm(centre[:, 0] - joint, axis=-1)), 0], size
        )
        s = np.linspace(0, 1, rows)[:-1, None]
        bend = (1 - s) ** 2 * lower + 2 * s * (1 - s) * joint + s**2 * upper[0]
        columns.append(np.concatenate((bend, resample(upper, 60))))
    columns[-1] = columns[0]
    return np.stack(columns, axis=1)


def _slide_on_body(point: np.ndarray, direction: np.ndarray, distance: float) -> np.ndarray:
    """Move `point` on the body by `distance` in `direction`, and just below its surface so that no gap opens."""
    slope = (body_radius(point[1] + 0.05) - body_radius(point[1] - 0.05)) / 0.1
    radial = unit(np.array([point[0], 0, point[2]]))
    normal = unit(radial - np.array([0, slope, 0]))
    moved = point + distance * unit(direction - (direction @ normal) * normal)
    radius = np.hypot(moved[0], moved[2])
    return moved * np.array([1, 0, 1]) * (body_radius(moved[1]) - 0.03) / radius + moved * np.array([0, 1, 0])


def spout() -> Mesh:
    """Outer surface of the spout, with uv measured from the lip."""
    points = spout_fillet(spout_tube(80))
    length = arc_length(points[::-1], axis=0)[::-1]
    u = np.broadcast_to(np.linspace(0, SPOUT_TILES, points.shape[1]), length.shape)
    return grid_mesh(points, np.stack((u, -length / TILE_HEIGHT), axis=-1))


def spout_lip() -> Mesh:
    """The rolled edge of the spout and its inside."""
    outer, inner = spout_tube(80)[-1], spout_tube(80, 0.22)[-1]
    axis = unit(np.cross(outer[24] - outer[0], outer[48] - outer[0]))
    axis = axis if axis[1] > 0 else -axis
    angle = np.linspace(0, np.pi, 9)[:, None, None]
    middle, half = (outer + inner) / 2, (outer - inner) / 2
    roll = middle + np.cos(angle) * half + np.sin(angle) * 0.13 * axis
    points = np.concatenate((roll, spout_tube(80, 0.22)[-2:20:-1]))
    return _plain(points)


def handle() -> Mesh:
    """The arch over the lid: a thick grip, the two straps that hold it, and their feet on the body."""
    half = [(6.45, 11.85), (7.7, 13.8), (8.3, 16.6), (7.3, 19.9), (4.2, 22.0)]
    control = np.array(half + [(0.0, 22.6)] + [(-x, y) for x, y in half[::-1]])
    arch = np.zeros((400, 3))
    arch[:, :2] = spline(np.linspace(0, 1, len(control)), control, np.linspace(0, 1, 400))
    side = np.array([0.0, 0.0, 1.0])

    s = np.linspace(-1, 1, 120)
    end = np.sqrt(np.clip(1 - np.abs(s) ** 16, 0, 1))
    wide, high = end * (1.25 + 0.15 * np.cos(np.pi * s)), end * (0.85 + 0.1 * np.cos(np.pi * s))
    meshes = [_plain(tube(resample(arch[105:296], 120), wide, high, side, 64))]
    for part in (arch[:118], arch[282:]):
        meshes.append(_plain(tube(resample(part, 60), np.full(60, 0.8), np.full(60, 0.28), side, 48)))
    foot = revolve(profile_curve(FOOT, 24), 1, 64)
    for sign in (1, -1):
        meshes.append(foot.transformed(_stand_on_body(sign * 6.7)))
    return merge(meshes)


def _plain(points: np.ndarray) -> Mesh:
    return grid_mesh(points, np.zeros((*points.shape[:2], 2)))


def _stand_on_body(x: float) -> np.ndarray:
    """4x4 matrix that puts the origin on the shoulder of the body at (x, z = 0), with y along the normal there."""
    profile = profile_curve(BODY, 400)
    k = np.nonzero(profile[:, 0] > abs(x))[0].max()
    tangent = unit(profile[k + 1] - profile[k - 1])
    up = np.array([np.sign(x) * tangent[1], -tangent[0], 0.0])
    across = np.array([up[1], -up[0], 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack((across, up, [0.0, 0.0, 1.0]), axis=1)
    matrix[:3, 3] = np.sign(x) * profile[k, 0], profile[k, 1], 0
    return matrix


def build() -> dict[str, Mesh]:
    """The meshes of the kettle by name."""
    metal = merge([revolve(profile_curve(BODY, 120), BODY_TILES), revolve(profile_curve(LID, 60), LID_TILES), spout()])
    trim = merge([spout_lip(), revolve(profile_curve(STEM, 20), 1, 64)])
    black = merge([handle(), revolve(profile_curve(KNOB, 40), 1, 64), revolve(profile_curve(BASE, 20), 1)])
    turn = rotation_y(TURN)
    meshes = {"kettle_metal": metal, "kettle_trim": trim, "kettle_black": black}
    return {name: mesh.transformed(turn) for name, mesh in meshes.items()}
