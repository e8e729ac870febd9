"""Triangle meshes made of parameter grids: normals, uv coordinates, binary PLY output. Lengths in centimetres."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .curves import unit

FLOOR_HALF_SIZE = 500.0


@dataclass
class Mesh:
    """Vertices (n, 3), unit normals (n, 3), texture coordinates (n, 2) and triangles (m, 3), counter-clockwise."""

    vertices: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray

    def transformed(self, matrix: np.ndarray) -> "Mesh":
        """Apply a 4x4 affine matrix.

        A reflection turns the triangles round, so that normals keep pointing outward, and mirrors u, so that
        (dp/du, dp/dv, normal) stays right-handed and a normal map keeps its sense.
        """
        linear = matrix[:3, :3]
        vertices = self.vertices @ linear.T + matrix[:3, 3]
        normals = self.normals @ np.linalg.inv(linear)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        if np.linalg.det(linear) < 0:
            return Mesh(vertices, normals, self.uv * np.array([-1, 1]), self.faces[:, ::-1])
        return Mesh(vertices, normals, self.uv, self.faces)


def merge(meshes: list[Mesh]) -> Mesh:
    """One mesh of several, vertices not shared."""
    starts = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts)]),
    )


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Two triangles per cell of a (rows, columns) grid of vertices, oriented along d/dcolumn x d/drow."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    triangles = np.stack((np.stack((a, b, c), -1), np.stack((a, c, d), -1)), -2)
    return triangles.reshape(-1, 3)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted vertex normals. Vertices at one position share theirs: a uv seam doesn't show in the shading."""
    corner = vertices[faces]
    face_normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    _, position = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    position = position.reshape(-1)
    total = np.zeros((position.max() + 1, 3))
    for k in range(3):
        np.add.at(total, position[faces[:, k]], face_normal)
    normals = total[position]
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def grid_mesh(points: np.ndarray, uv: np.ndarray, flip: bool = False) -> Mesh:
    """Mesh of a grid of points (rows, columns, 3) with uv (rows, columns, 2).

    The outside is that of d/dcolumn x d/drow, the other one with `flip`. Closed grids repeat their first column (or
    row) at the end with another uv. Triangles that collapse to a line (a pole) are left out.
    """
    rows, columns, _ = points.shape
    vertices = points.reshape(-1, 3)
    faces = grid_faces(rows, columns)
    if flip:
        faces = faces[:, ::-1]
    corner = vertices[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    faces = faces[area > 1e-9]
    return Mesh(vertices, smooth_normals(vertices, faces), uv.reshape(-1, 2), faces)


def floor(half_size: float = FLOOR_HALF_SIZE) -> Mesh:
    """The square |x|, |z| <= `half_size` of the plane y = 0, facing up; uv in [0, 1]."""
    side = np.linspace(-half_size, half_size, 9)
    points = np.stack(np.broadcast_arrays(side[None, :], 0.0, -side[:, None]), axis=-1)
    return grid_mesh(points, (points[..., ::2] + half_size) / (2 * half_size))


def arc_length(points: np.ndarray, axis: int) -> np.ndarray:
    """Cumulative length along `axis` of a grid of points (rows, columns, 3), starting at 0; shape (rows, columns)."""
    step = np.linalg.norm(np.diff(points, axis=axis), axis=-1)
    start = np.zeros_like(np.take(step, [0], axis=axis))
    return np.concatenate((start, np.cumsum(step, axis=axis)), axis=axis)


def unroll(points: np.ndarray, row: int, smoothing: float) -> np.ndarray:
    """Texture coordinates in cm, (rows, columns, 2), for a closed band of points whose columns lean against its rows.

    u is the length along the given row; away from it, u moves on by the part of each step from row to row that goes
    sideways, and v by the part square to it. That is free of stretch where rows keep their distance. The sideways part
    is smoothed round the band (Gaussian, standard deviation in columns), or u would fold back in tight bends.
    """
    step = np.diff(points, axis=0)
    along = np.gradient(points, axis=1)
    along[:, [0, -1]] = (points[:, 1:2] - points[:, -2:-1]) / 2
    along = unit(unit(along[1:]) + unit(along[:-1]))
    sideways = np.sum(step * along, axis=-1)
    square = np.linalg.norm(step - sideways[..., None] * along, axis=-1)
    start = np.zeros((1, points.shape[1]))
    sideways = np.concatenate((start, np.cumsum(sideways, axis=0)))
    square = np.concatenate((start, np.cumsum(square, axis=0)))
    u = arc_length(points[row : row + 1], axis=1) + smooth_closed(sideways - sideways[row], smoothing)
    return np.stack((u, square - square[row]), axis=-1)


def smooth_closed(values: np.ndarray, deviation: float) -> np.ndarray:
    """Gaussian smoothing along closed rows (their first column repeated at the end); deviation in columns."""
    period = values.shape[1] - 1
    response = np.exp(-0.5 * (2 * np.pi * deviation * np.fft.rfftfreq(period)) ** 2)
    smooth = np.fft.irfft(np.fft.rfft(values[:, :-1], axis=1) * response, n=period, axis=1)
    return np.concatenate((smooth, smooth[:, :1]), axis=1)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a binary little-endian PLY with normals and uv, as Mitsuba's `ply` shape reads it."""
    fields = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in fields]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    vertex = np.concatenate((mesh.vertices, mesh.normals, mesh.uv), axis=1).astype("<f4")
    face = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    face["count"] = 3
    face["index"] = mesh.faces
    with open(path, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(vertex.tobytes())
        file.write(face.tobytes())
