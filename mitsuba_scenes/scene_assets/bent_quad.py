"""A rectangular strip of metal, bent like an S lying down: highlights run across it. Lengths in cm, y is up.

Texture coordinates are lengths along the strip and across it: it is bent, not stretched.
"""

import numpy as np

from .curves import profile_curve, rotation_y, unit
from .mesh import Mesh, grid_mesh, merge

PARTS = ("bent_quad_metal", "bent_quad_edge")
TILE = 5.0  # cm of surface per map tile (at tiling 1)
WIDTH = 16.0
THICKNESS = 0.16
TURN = np.radians(-24)

# Profile of the upper face, (x, y), from the left.
PROFILE = np.array(
    [
        (-13.6, 1.1),
        (-11.6, 4.9),
        (-8.2, 7.3),
        (-4.4, 6.7),
        (-1.4, 4.0),
        (1.6, 1.4),
        (5.2, 0.62),
        (8.8, 2.2),
        (11.4, 5.6),
    ]
    + [(12.8, 9.8)]
)
ROWS, COLUMNS = 65, 257


def _rails() -> tuple[np.ndarray, np.ndarray]:
    """Upper and lower face's profile, shape (COLUMNS, 2)."""
    upper = profile_curve(PROFILE, COLUMNS)
    tangent = unit(np.gradient(upper, axis=0))
    return upper, upper - THICKNESS * np.stack((-tangent[:, 1], tangent[:, 0]), axis=-1)


def _sheet(profile: np.ndarray, z: np.ndarray) -> np.ndarray:
    points = np.empty((len(z), len(profile), 3))
    points[..., :2], points[..., 2] = profile[None], z[:, None]
    return points


def face() -> Mesh:
    """The upper face; u along the strip, v across it, away from the camera."""
    upper, _ = _rails()
    z = np.linspace(WIDTH / 2, -WIDTH / 2, ROWS)
    length = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(upper, axis=0), axis=1))))
    u, v = np.broadcast_arrays(length[None, :], (WIDTH / 2 - z)[:, None])
    return grid_mesh(_sheet(upper, z), np.stack((u, v), axis=-1) / TILE)


def edge() -> Mesh:
    """The lower face and the four narrow sides."""
    upper, lower = _rails()
    z = np.linspace(WIDTH / 2, -WIDTH / 2, ROWS)
    sides = [np.stack((_sheet(upper, z[[k]])[0], _sheet(lower, z[[k]])[0])) for k in (0, -1)]
    ends = [np.stack((_sheet(upper[[k]], z)[:, 0], _sheet(lower[[k]], z)[:, 0])) for k in (0, -1)]
    faces = [(_sheet(lower, z), True), (sides[0], True), (sides[1], False), (ends[0], True), (ends[1], False)]
    return merge([grid_mesh(points, np.zeros((*points.shape[:2], 2)), flip) for points, flip in faces])


def build() -> dict[str, Mesh]:
    """The meshes by name, turned for the picture."""
    turn = rotation_y(TURN)
    return {"bent_quad_metal": face().transformed(turn), "bent_quad_edge": edge().transformed(turn)}
