"""What stands beside the kettle in `kettle_mirror`: a round mirror in a steel frame. Lengths in cm, y is up."""

import numpy as np

from .curves import tube, unit
from .mesh import Mesh, grid_mesh, merge

PARTS = ("kettle_mirror_glass", "kettle_mirror_frame")
RADIUS, BAR = 20.4, 0.75  # of the glass, of the frame's bar
FACING = unit(np.array([-10.0, -2.2, 34.0]))  # leans back a little
CENTRE = np.array([11.0, 20.9, -24.0])


def _circle(radius: float, count: int) -> np.ndarray:
    right = unit(np.cross([0.0, 1.0, 0.0], FACING))
    angle = np.linspace(0, 2 * np.pi, count)[:, None]
    points = CENTRE + radius * (np.cos(angle) * right + np.sin(angle) * np.cross(FACING, right))
    points[-1] = points[0]
    return points


def glass() -> Mesh:
    """The mirror."""
    rim = _circle(RADIUS, 193)
    share = np.array([1e-3, 0.5, 1.0])[:, None, None]
    return grid_mesh(CENTRE + share * (rim - CENTRE), np.zeros((3, 193, 2)), flip=True)


def frame() -> Mesh:
    """A ring of round bar, and the block that it stands in."""
    ring = _circle(RADIUS + 0.4 * BAR, 257)
    meshes = [_plain(tube(ring, np.full(257, BAR), np.full(257, BAR), FACING, 32))]
    foot = ring[np.argmin(ring[:, 1])] * np.array([1.0, 0.0, 1.0])
    radius, height = np.array([5.6, 5.6, 5.4, 5.0, 0.0]), np.array([0.0, 1.0, 1.25, 1.35, 1.35])
    angle = np.linspace(0, 2 * np.pi, 129)
    around = np.stack((np.cos(angle), 0 * angle, -np.sin(angle)), axis=-1)
    block = foot + radius[:, None, None] * around + height[:, None, None] * np.array([0.0, 1.0, 0.0])
    block[:, -1] = block[:, 0]
    return merge([*meshes, _plain(block)])


def _plain(points: np.ndarray) -> Mesh:
    return grid_mesh(points, np.zeros((*points.shape[:2], 2)))


def build() -> dict[str, Mesh]:
    """The meshes by name; the kettle itself is that of `kettle`."""
    return {"kettle_mirror_glass": glass(), "kettle_mirror_frame": frame()}
