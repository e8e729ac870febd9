"""A car's alloy wheel: rim, spokes and hub of scratched metal, brake disc, bolts and tyre. Lengths in cm.

Built with the axis on z, the face towards +z, round the origin; `build` stands it on the ground, turned for the picture.
"""

import numpy as np

from .curves import profile_curve, rotation_y, spline, translation, unit
from .mesh import Mesh, arc_length, grid_mesh, merge

PARTS = (
    *("car_wheel_metal", "car_wheel_dark", "car_wheel_disc", "car_wheel_tyre", "car_wheel_barrel"),
    "car_wheel_lights",
)
TILE = 7.0  # cm of surface per map tile (at tiling 1)
COLUMNS = 256
PAIRS = 5  # of spokes
RADIUS = 30.0  # of the tyre
TURN = np.radians(24)

# Profiles of the surfaces of revolution, (radius, z) from the face's side; corners are rounded by close points.
LIP = np.array(
    [(23.0, 6.6), (23.6, 7.4), (23.85, 8.2), (23.6, 8.65), (23.1, 8.6), (22.6, 8.1), (22.1, 7.3), (21.6, 6.2)]
    + [(21.2, 5.2), (20.9, 4.2)]
)
BARREL = np.array([(20.9, 4.2), (20.7, 2.0), (20.5, -1.0), (20.3, -4.0), (20.3, -9.0)])
HUB = np.array([(0.0, 4.35), (1.6, 4.35), (3.0, 4.33), (5.4, 4.15), (7.0, 3.7), (7.7, 2.6), (7.8, -1.0)])
CAP = np.array([(0.0, 4.95), (1.2, 4.93), (2.3, 4.82), (2.75, 4.55), (2.85, 4.1)])
DISC = np.array([(7.0, -3.4), (9.5, -3.4), (10.0, -4.2), (10.4, -4.2), (17.4, -4.2), (17.6, -4.35), (17.6, -5.4)])
BOLT = np.array([(0.0, 4.8), (0.5, 4.78), (0.72, 4.6), (0.8, 4.3), (0.82, 3.4)])
TYRE = np.array(
    [(22.7, 7.6), (23.5, 8.9), (24.6, 9.9), (26.0, 10.5), (27.4, 10.55), (28.5, 10.1), (29.4, 9.0), (29.8, 7.6)]
    + [(29.96, 5.9), (30.0, 4.2)]
)
BOLTS, BOLT_CIRCLE = 5, 5.0

LIGHTS = [(-64, 26), (-42, 44), (-24, 24), (-8, 52), (10, 34), (26, 58), (42, 30), (62, 46), (80, 28)]
"""Azimuth and elevation in degrees as seen from the hub: 0 is towards the camera, 90 to the right of the picture."""
LIGHT_DISTANCE, LIGHT_RADIUS = 300.0, 3.2


def revolve(profile: np.ndarray, tiles: int = 0, columns: int = COLUMNS, inward: bool = False) -> Mesh:
    """Surface of revolution of (radius, z) points; u goes round in `tiles` map tiles, v follows the profile.

    The outside is on the left of the profile, in the plane of radius and z, or on its right with `inward`.
    """
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    radius, z = profile[:, :1], profile[:, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), z), axis=-1)
    points[:, -1] = points[:, 0]
    u = np.broadcast_to(tiles * angle / (2 * np.pi), points.shape[:2])
    v = arc_length(points, axis=0) / TILE if tiles else np.zeros(points.shape[:2])
    return grid_mesh(points, np.stack((u, v), axis=-1), flip=not inward)


def lip() -> Mesh:
    """The rim as far as it is seen from outside; a whole number of tiles goes round, as near to `TILE` as it gets."""
    tiles = round(2 * np.pi * 22 / TILE)
    return revolve(profile_curve(LIP, 100), tiles, inward=True)


def barrel() -> Mesh:
    """The painted inside of the rim."""
    return revolve(profile_curve(BARREL, 40), inward=True)


def hub() -> Mesh:
    """The middle of the face. Its texture coordinates are polar ones about the axis, without seam."""
    mesh = revolve(profile_curve(HUB, 60))
    points = mesh.vertices.reshape(60, COLUMNS + 1, 3)
    angle = np.linspace(0, 2 * np.pi, COLUMNS + 1)
    around = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    mesh.uv = (arc_length(points, axis=0)[..., None] * around / TILE).reshape(-1, 2)
    return mesh


def spoke(side: int) -> Mesh:
    """One of a pair of spokes along +x, on the side +y or -y: a rounded bar that widens at both ends.

    u goes round the bar from the middle of its back, v along it.
    """
    t = np.linspace(0, 1, 121)
    knots = np.array([0.0, 0.2, 0.5, 0.8, 1.0])
    radius = 4.6 + t * (21.9 - 4.6)
    offset = side * spline(knots, np.array([1.3, 2.0, 2.9, 3.9, 4.7]), t)
    half = spline(knots, np.array([2.0, 1.62, 1.5, 1.85, 2.75]), t)
    face = spline(knots, np.array([3.7, 3.75, 4.5, 5.95, 7.1]), t)
    back = spline(knots, np.array([-1.2, -0.4, 0.7, 1.7, 2.0]), t)
    outline = _bar(96)
    y = offset[:, None] + half[:, None] * outline[:, 0] * (1 - 0.12 * outline[:, 1])
    z = (face + back)[:, None] / 2 + (face - back)[:, None] / 2 * outline[:, 1]
    points = np.stack((radius[:, None] + 0 * y, y, z), axis=-1)
    points[:, -1] = points[:, 0]
    middle = points[60:61]
    u = arc_length(middle, axis=1) / TILE
    v = arc_length(points, axis=0).mean(axis=1, keepdims=True) / TILE
    uv = np.stack(np.broadcast_arrays(u + 0.37 * side, v), axis=-1)
    return grid_mesh(points, uv)


def _bar(columns: int) -> np.ndarray:
    """A rounded square with half sides of 1, from the middle of its lower side; shape (columns + 1, 2)."""
    angle = np.linspace(-np.pi / 2, 1.5 * np.pi, columns + 1)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack((c, s), axis=-1) / (c**6 + s**6)[:, None] ** (1 / 6)


def spokes() -> Mesh:
    """All of them; every pair has its own place on the map."""
    pair = merge([spoke(1), spoke(-1)])
    copies = []
    for k in range(PAIRS):
        turned = pair.transformed(_rotation_z(np.pi / 2 + 2 * np.pi * k / PAIRS))
        turned.uv = turned.uv + np.array([0.29, 0.41]) * k
        copies.append(turned)
    return merge(copies)


def bolts() -> Mesh:
    """The wheel bolts, between the spokes."""
    bolt = revolve(profile_curve(BOLT, 24), columns=48)
    places = np.pi / 2 + 2 * np.pi * (np.arange(BOLTS) + 0.5) / BOLTS
    return merge([bolt.transformed(translation(*(BOLT_CIRCLE * _round(a)), 0.0)) for a in places])


def _round(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle)])


def tyre() -> Mesh:
    """Both walls and the tread with its grooves."""
    wall = profile_curve(TYRE, 120)
    raised = 0.12 * (np.abs(wall[:, 0] - 25.2) < 0.25) + 0.09 * (np.abs(wall[:, 0] - 27.8) < 0.18)
    wall = wall + raised[:, None] * np.array([0.0, 1.0])
    z = np.linspace(4.2, -4.2, 169)
    groove = np.any(np.abs(z[:, None] - np.array([-2.6, 0.0, 2.6])) < 0.45, axis=1)
    tread = np.stack((RADIUS - 0.7 * groove, z), axis=-1)
    profile = np.concatenate((wall[:-1], tread, (wall * np.array([1.0, -1.0]))[::-1][1:]))
    return revolve(profile)


def lights() -> Mesh:
    """Nine small discs that face the hub, in an arc above the camera."""
    discs = []
    for azimuth, elevation in LIGHTS:
        turn, tilt = np.radians(azimuth), np.radians(elevation)
        towards = np.array([np.cos(tilt) * np.sin(turn), np.sin(tilt), np.cos(tilt) * np.cos(turn)])
        right = unit(np.cross([0.0, 1.0, 0.0], towards))
        angle, radius = np.linspace(0, 2 * np.pi, 33), np.linspace(0, LIGHT_RADIUS, 2)
        across = radius[:, None, None] * np.cos(angle)[None, :, None] * right
        along = radius[:, None, None] * np.sin(angle)[None, :, None] * np.cross(towards, right)
        points = np.array([0, RADIUS, 0]) + LIGHT_DISTANCE * towards + across + along
        discs.append(grid_mesh(points, np.zeros((2, 33, 2))))
    return merge(discs)


def _rotation_z(angle: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return matrix


def build() -> dict[str, Mesh]:
    """The meshes by name, the wheel standing on the ground."""
    pose = translation(0, RADIUS, 0) @ rotation_y(TURN) @ _rotation_z(np.radians(9))
    meshes = {
        "car_wheel_metal": merge([lip(), hub(), spokes()]),
        "car_wheel_dark": merge([revolve(profile_curve(CAP, 30)), bolts()]),
        "car_wheel_disc": revolve(DISC),
        "car_wheel_tyre": tyre(),
        "car_wheel_barrel": barrel(),
    }
    meshes = {name: mesh.transformed(pose) for name, mesh in meshes.items()}
    return {**meshes, "car_wheel_lights": lights()}
