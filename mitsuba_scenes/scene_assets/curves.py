"""Interpolating curves and the rotations and frames that lofts and sweeps need. Angles in radians."""

import numpy as np


def spline(knots: np.ndarray, values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Natural cubic spline through `values` (n, ...) at increasing `knots` (n), evaluated at `x`."""
    knots, values, x = (np.asarray(a, dtype=float) for a in (knots, values, x))
    n, h = len(knots), np.diff(knots)
    flat = values.reshape(n, -1)
    slope = np.diff(flat, axis=0) / h[:, None]
    system, right = np.eye(n), np.zeros_like(flat)
    for k in range(1, n - 1):
        system[k, k - 1 : k + 2] = h[k - 1], 2 * (h[k - 1] + h[k]), h[k]
        right[k] = 6 * (slope[k] - slope[k - 1])
    return _evaluate(knots, flat, np.linalg.solve(system, right), x).reshape(x.shape + values.shape[1:])


def periodic_spline(values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Closed cubic spline of period 1 through `values` (n, ...) at the knots 0, 1/n, 2/n ..., evaluated at `x`."""
    values, x = np.asarray(values, dtype=float), np.asarray(x, dtype=float)
    n = len(values)
    flat = values.reshape(n, -1)
    one = np.eye(n)
    system = 4 * one + np.roll(one, 1, axis=1) + np.roll(one, -1, axis=1)
    second = np.linalg.solve(system, 6 * n**2 * (np.roll(flat, -1, 0) - 2 * flat + np.roll(flat, 1, 0)))
    close = np.arange(n + 1) % n
    result = _evaluate(np.arange(n + 1) / n, flat[close], second[close], x % 1)
    return result.reshape(x.shape + values.shape[1:])


def _evaluate(knots: np.ndarray, values: np.ndarray, second: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Piecewise cubic from values and second derivatives at the knots; extrapolates with the end pieces."""
    x = x.reshape(-1)
    k = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
    h = knots[k + 1] - knots[k]
    b = ((x - knots[k]) / h)[:, None]
    a, h = 1 - b, h[:, None]
    curve = a * values[k] + b * values[k + 1]
    return curve + ((a**3 - a) * second[k] + (b**3 - b) * second[k + 1]) * h**2 / 6


def bezier(control: list[np.ndarray], t: np.ndarray) -> np.ndarray:
    """Cubic Bezier curves: four control arrays of shape (n, 3), parameters t (m); returns (m, n, 3)."""
    t = np.asarray(t)[:, None, None]
    p0, p1, p2, p3 = control
    return (1 - t) ** 3 * p0 + 3 * t * (1 - t) ** 2 * p1 + 3 * t**2 * (1 - t) * p2 + t**3 * p3


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def resample(points: np.ndarray, count: int) -> np.ndarray:
    """`count` points at equal arc length on the polyline `points` (n, d)."""
    length = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    target = np.linspace(0, length[-1], count)
    return np.stack([np.interp(target, length, points[:, k]) for k in range(points.shape[1])], axis=-1)


def profile_curve(points: np.ndarray, count: int) -> np.ndarray:
    """A smooth curve through points (n, 2), resampled at equal arc length; shape (count, 2)."""
    knots = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    return resample(spline(knots, points, np.linspace(0, knots[-1], 16 * count)), count)


def rotation_y(angle: float) -> np.ndarray:
    """4x4 rotation about the vertical axis that turns +x towards -z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])


def translation(x: float, y: float, z: float) -> np.ndarray:
    """4x4 translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def tube(
    path: np.ndarray, radius_side: np.ndarray, radius_up: np.ndarray, side: np.ndarray, columns: int
) -> np.ndarray:
    """Sweep an ellipse along `path` (n, 3); returns points (n, columns + 1, 3), the first column repeated at the end.

    `side` is a fixed direction that spans each cross-section together with tangent x side; the radii (n) lie along
    those two. Columns run counter-clockwise seen against the direction of travel.
    """
    tangent = unit(np.gradient(path, axis=0))
    first = unit(side - (tangent @ side)[:, None] * tangent)
    second = np.cross(tangent, first)
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    across = np.cos(angle)[None, :, None] * (radius_side[:, None] * first)[:, None, :]
    along = np.sin(angle)[None, :, None] * (radius_up[:, None] * second)[:, None, :]
    points = path[:, None, :] + across + along
    points[:, -1] = points[:, 0]
    return points
