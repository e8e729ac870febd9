"""A pair of high-heeled pumps. Lengths in cm.

A shoe is built along x (heel at 0, toe towards +x) with the ground at y = 0, as the right shoe of the pair: the inner
side is at -z. Its upper is a loft of cubic Bezier profiles that run from the feather edge (where upper and sole meet)
to the topline (the rim of the opening); the four control points of the profiles are closed curves round the shoe.
"""

import numpy as np

from .curves import bezier, periodic_spline, resample, rotation_y, spline, translation, unit
from .mesh import Mesh, arc_length, grid_mesh, merge, unroll

PARTS = ("shoe_upper", "shoe_lining", "shoe_rim", "shoe_sole", "shoe_tip")
ROUND, PROFILE = 320, 48  # cells of the upper around the shoe and from feather edge to topline
UV_ROW = PROFILE // 2  # row of the upper along which u is measured
TILES_AROUND = 5  # map tiles round the upper at tiling 1; the same density is used everywhere
LEATHER = 0.16  # thickness of the upper

# Side view of the feather edge: (x, y), from the heel seat over the shank to the toe.
SIDE = np.array(
    [(-0.5, 10.75), (1.5, 10.3), (3.5, 9.55), (5.5, 8.35), (7.5, 6.6), (9.5, 4.5), (11.5, 2.5)]
    + [(13.4, 1.1), (15.3, 0.42), (17.5, 0.34), (20.0, 0.5), (22.0, 0.78), (24.0, 1.15)]
)

# Control curves, from the back of the heel round the outer side to the toe and back along the inner side. One row is
# one place on the shoe: feather edge (x, z), the handle that leaves it (outward, up), topline (x, y, z) and the handle
# that arrives there (along x, down, along z).
CONTROL = np.array(
    [
        # feather edge   leaving       topline               arriving
        (0.00, 0.00, 0.85, 2.1, 1.05, 16.30, 0.00, -0.55, 2.4, 0.00),  # back of the heel
        (0.80, 1.80, 0.70, 2.1, 1.55, 16.00, 1.15, -0.45, 2.2, 0.40),
        (2.90, 2.60, 0.55, 1.9, 3.20, 14.60, 2.05, -0.15, 1.9, 0.55),
        (6.00, 2.50, 0.45, 1.5, 5.70, 11.75, 2.55, 0.00, 1.5, 0.45),
        (9.30, 2.35, 0.35, 1.2, 8.60, 8.20, 2.75, 0.25, 1.1, 0.30),
        (12.6, 2.95, 0.30, 1.3, 11.7, 5.45, 2.95, 0.50, 0.9, 0.30),
        (15.7, 3.50, 0.25, 1.6, 14.4, 4.30, 2.70, 1.20, 0.7, 0.45),
        (18.8, 2.75, 0.25, 1.5, 16.3, 4.05, 1.85, 2.20, 0.6, 0.50),
        (21.6, 1.25, 0.25, 0.9, 17.2, 4.05, 0.80, 2.80, 0.6, 0.25),
        (23.6, -0.35, 0.20, 0.7, 17.45, 4.05, -0.20, 3.00, 0.6, 0.00),  # toe
        (22.0, -1.45, 0.25, 0.9, 17.2, 4.05, -1.15, 2.80, 0.6, -0.25),
        (19.2, -2.70, 0.25, 1.5, 16.3, 4.05, -2.00, 2.20, 0.6, -0.50),
        (15.8, -3.20, 0.25, 1.6, 14.4, 4.30, -2.60, 1.20, 0.7, -0.45),
        (12.4, -2.70, 0.30, 1.3, 11.7, 5.45, -2.70, 0.50, 0.9, -0.30),
        (9.20, -1.95, 0.40, 1.2, 8.60, 8.20, -2.50, 0.25, 1.1, -0.30),
        (6.00, -2.20, 0.45, 1.5, 5.70, 11.75, -2.40, 0.00, 1.5, -0.45),
        (2.90, -2.50, 0.55, 1.9, 3.20, 14.60, -2.00, -0.15, 1.9, -0.55),
        (0.80, -1.80, 0.70, 2.1, 1.55, 16.00, -1.15, -0.45, 2.2, -0.40),
    ]
)
FEATHER, LEAVING, TOPLINE, ARRIVING = np.split(CONTROL, [2, 4, 7], axis=1)


def seat_height(x: np.ndarray) -> np.ndarray:
    """Height of the feather edge above the ground."""
    return spline(SIDE[:, 0], SIDE[:, 1], x)


def sole_thickness(x: np.ndarray) -> np.ndarray:
    """Thickness of the sole: thin above the heel, full under the ball of the foot."""
    return 0.12 + 0.18 * np.clip((x - 5) / 5, 0, 1)


def feather_edge(s: np.ndarray) -> np.ndarray:
    """The closed curve where the upper meets the sole; s in [0, 1) from the back of the heel round the outer side."""
    plan = periodic_spline(FEATHER, s)
    return np.stack((plan[:, 0], seat_height(plan[:, 0]), plan[:, 1]), axis=-1)


def outward(s: np.ndarray) -> np.ndarray:
    """Horizontal unit normal of the feather edge's outline."""
    step = 1e-4
    tangent = (periodic_spline(FEATHER, s + step) - periodic_spline(FEATHER, s - step)) / (2 * step)
    return unit(np.stack((-tangent[:, 1], np.zeros(len(s)), tangent[:, 0]), axis=-1))


def upper_points(s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Points of the upper's outside, (len(t), len(s), 3); t runs from the feather edge (0) to the topline (1)."""
    feather, top = feather_edge(s), periodic_spline(TOPLINE, s)
    leaving, arriving = periodic_spline(LEAVING, s), periodic_spline(ARRIVING, s)
    first = feather + leaving[:, :1] * outward(s) + leaving[:, 1:] * np.array([0.0, 1.0, 0.0])
    second = top + arriving * np.array([1.0, -1.0, 1.0])
    return bezier([feather, first, second, top], t)


def _around() -> np.ndarray:
    return np.linspace(0, 1, ROUND + 1)


def tile_size() -> float:
    """Size in cm of a map tile on the shoe, chosen so that a whole number of tiles goes round the upper."""
    row = upper_points(_around(), np.array([UV_ROW / PROFILE]))
    return arc_length(row, axis=1)[0, -1] / TILES_AROUND


def upper() -> Mesh:
    """The outside of the upper."""
    points = upper_points(_around(), np.linspace(0, 1, PROFILE + 1))
    points[:, -1] = points[:, 0]
    return grid_mesh(points, unroll(points, UV_ROW, smoothing=14.0) / tile_size())


def lining_points() -> np.ndarray:
    """The upper moved inwards by the thickness of the leather."""
    points = upper_points(_around(), np.linspace(0, 1, PROFILE + 1))
    points[:, -1] = points[:, 0]
    normals = upper().normals.reshape(points.shape)
    return points - LEATHER * normals


def lining() -> Mesh:
    """The inside of the upper and the insole."""
    inside = lining_points()
    insole = _across(feather_edge(np.linspace(0, 1, 161)) + np.array([0, 0.12, 0]))
    return merge([_plain(inside, flip=True), _plain(insole, flip=True)])


def _plain(points: np.ndarray, flip: bool = False) -> Mesh:
    return grid_mesh(points, np.zeros((*points.shape[:2], 2)), flip)


def _across(edge: np.ndarray, columns: int = 13) -> np.ndarray:
    """Rows from the outer to the inner side of a closed edge (2n + 1 points), back of the heel to toe."""
    half = (len(edge) - 1) // 2
    outer, inner = edge[: half + 1], edge[half:][::-1]
    w = np.linspace(0, 1, columns)[None, :, None]
    return (1 - w) * outer[:, None] + w * inner[:, None]


def rim() -> Mesh:
    """The binding round the opening: a closed tube."""
    s = _around()
    edge = (upper_points(s, np.array([1.0]))[0] + lining_points()[-1]) / 2
    tangent = unit(np.roll(edge[:-1], -1, 0) - np.roll(edge[:-1], 1, 0))
    tangent = np.concatenate((tangent, tangent[:1]))
    across = unit(upper_points(s, np.array([1.0]))[0] - edge)
    across = unit(across - np.sum(across * tangent, -1, keepdims=True) * tangent)
    other = np.cross(tangent, across)
    angle = np.linspace(0, 2 * np.pi, 17)[None, :, None]
    points = edge[:, None] + 0.13 * (np.cos(angle) * across[:, None] + np.sin(angle) * other[:, None])
    points[:, -1], points[-1] = points[:, 0], points[0]
    return _plain(points)


def sole() -> Mesh:
    """Edge and underside of the sole."""
    edge = feather_edge(np.linspace(0, 1, 321))
    down = sole_thickness(edge[:, :1]) * np.array([0.0, -1.0, 0.0])
    angle = np.linspace(0, np.pi, 9)[:, None, None]
    bulge = 0.06 * np.sin(angle) * outward(np.linspace(0, 1, 321)) + (1 - np.cos(angle)) / 2 * down
    side = edge[None] + bulge
    side[:, -1] = side[:, 0]
    return merge([_plain(side, flip=True), _plain(_across((edge + down)[::2]))])


def _heel_seat(front: float, columns: int) -> np.ndarray:
    """Outline (x, z) of the heel under the sole: the feather edge behind x = `front`, closed by a straight line.

    `columns` + 1 points at equal arc length, from the middle of the front round the outer side.
    """
    s = np.linspace(-0.5, 0.5, 4001)
    edge = periodic_spline(FEATHER, s)
    edge = edge[(edge[:, 0] < front)]  # from the inner side round the back to the outer side
    middle = (edge[:1] + edge[-1:]) / 2 + np.array([[0.35, 0.0]])
    return resample(np.concatenate((middle, edge[::-1], middle)), columns + 1)


def _heel_column(back: np.ndarray, front: np.ndarray, half: np.ndarray, columns: int) -> np.ndarray:
    """Cross-sections (x, z) of the heel's stem: round behind, blunt in front; shape (rows, columns + 1, 2)."""
    angle = np.linspace(0, 2 * np.pi, 8 * columns + 1)
    c, n = np.cos(angle), np.sin(angle)
    along = np.sign(c) * np.abs(c) ** np.where(c > 0, 0.55, 1.0)
    across = np.sign(n) * np.abs(n) ** np.where(c > 0, 0.75, 1.0)
    x = (back + front)[:, None] / 2 + (front - back)[:, None] / 2 * along
    outlines = np.stack((x, half[:, None] * across), axis=-1)
    return np.stack([resample(outline, columns + 1) for outline in outlines])


def heel_points(h: np.ndarray, columns: int = 96) -> np.ndarray:
    """The stiletto: rings at relative heights h (0 ground, 1 seat); shape (len(h), columns + 1, 3)."""
    knots = np.array([0, 0.15, 0.35, 0.55, 0.75, 0.9, 1.0])
    back = spline(knots, np.array([1.75, 1.68, 1.5, 1.2, 0.75, 0.35, 0.05]), h)
    front = spline(knots, np.array([2.65, 2.6, 2.52, 2.55, 2.95, 3.75, 4.7]), h)
    half = spline(knots, np.array([0.44, 0.44, 0.48, 0.66, 1.15, 1.85, 2.45]), h)
    stem = _heel_column(back, front, half, columns)
    blend = np.clip((h - 0.6) / 0.4, 0, 1)[:, None, None] ** 2
    plan = (1 - blend) * stem + blend * (_heel_seat(4.4, columns) + np.array([0.3, 0.0]) * (1 - h)[:, None, None])
    seat = seat_height(plan[..., 0]) - sole_thickness(plan[..., 0])
    points = np.stack((plan[..., 0], h[:, None] * seat, plan[..., 1]), axis=-1)
    points[:, -1] = points[:, 0]
    return points


def heel() -> Mesh:
    """The covered part of the heel, above its rubber tip.

    u is the length round the heel seen from above, from the middle of its back, v the height; the seam runs down the
    front, where the map (a random one) just starts anew.
    """
    points = heel_points(np.linspace(0.07, 1.0, 81))
    around = arc_length(points * np.array([1, 0, 1]), axis=1)
    u = around[:, -1:] / 2 - around
    return grid_mesh(points, np.stack((u, points[..., 1]), axis=-1) / tile_size(), flip=True)


def tip() -> Mesh:
    """The rubber tip of the heel."""
    return _plain(heel_points(np.linspace(0.0, 0.07, 5)), flip=True)


def single_shoe() -> dict[str, Mesh]:
    """The right shoe by parts."""
    return {
        "shoe_upper": merge([upper(), heel()]),
        "shoe_lining": lining(),
        "shoe_rim": rim(),
        "shoe_sole": sole(),
        "shoe_tip": tip(),
    }


def build() -> dict[str, Mesh]:
    """The meshes of both shoes in their poses, by name."""
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    centre = translation(-11.5, 0, 0)
    poses = (
        translation(6.3, 0, -2.0) @ rotation_y(np.radians(-55)) @ centre,
        translation(-5.3, 0, 3.0) @ rotation_y(np.radians(52)) @ mirror @ centre,
    )
    parts = single_shoe()
    return {name: merge([part.transformed(pose) for pose in poses]) for name, part in parts.items()}
