"""Normal maps: Gaussian random slopes, metallic flakes, scratches. All repeat without seam but the Gaussian ones.

Gaussian random slopes are a sum of plane waves, by the recipe of E. Heitz, "Generating Procedural Beckmann Surfaces"
(2015). A height field made of N waves of random phase, direction and frequency has normally distributed slopes when N
is large, so that its facets follow a Beckmann distribution of roughness (alpha_x, alpha_y). Each wave separates into a
product of two complex exponentials, exp(i f_x x) exp(i (f_y y + phase)), which makes the whole map one small matrix
product.

Flakes are Voronoi cells of constant normal, tilted as the GTR distribution has it (B. Burley, "Physically-Based Shading
at Disney", 2012). Scratches are grooves along straight lines and arcs, each cut into what was there before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .exr import write_exr

WAVES = 1000


@dataclass(frozen=True)
class WaveRecipe:
    """Gaussian random slopes: seed, Beckmann roughness per axis, side of the sampled square, slope noise."""

    seed: int
    alpha_x: float
    alpha_y: float
    side: float  # of a map of the full resolution
    noise: float = 0.0
    full_resolution: int = 2048

    def normals(self, resolution: int) -> np.ndarray:
        """Unit normals (-slope_x + noise, -slope_y + noise, 1), normalised; shape (resolution, resolution, 3).

        The noise is uniform in +-`noise` and independent per texel, drawn column by column (x outer, y inner).
        """
        random = np.random.RandomState(self.seed)
        slope_x, slope_y = self._slopes(resolution, random)
        normals = np.stack((-slope_x, -slope_y, np.ones_like(slope_x)), axis=-1)
        if self.noise:
            noise = self.noise * (2 * random.rand(resolution, resolution, 2) - 1)
            normals[:, :, :2] += noise.transpose(1, 0, 2)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def _slopes(self, resolution: int, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Height derivatives along x (columns) and y (rows), two arrays of shape (resolution, resolution).

        A map of another resolution covers a proportionally smaller square, so the texel spacing keeps its size.
        """
        u1, u2, u3 = (random.rand(WAVES) for _ in range(3))
        phase = 2 * np.pi * u1
        radius = np.sqrt(-np.log(1 - u3))
        frequency_x = radius * np.cos(2 * np.pi * u2) * self.alpha_x
        frequency_y = radius * np.sin(2 * np.pi * u2) * self.alpha_y

        position = np.linspace(0, self.side * resolution / self.full_resolution, resolution)
        wave_x = np.exp(1j * np.outer(frequency_x, position))
        wave_y = np.exp(1j * (np.outer(position, frequency_y) + phase))
        amplitude = np.sqrt(2 / WAVES)
        slope_x = -amplitude * ((wave_y * frequency_x) @ wave_x).imag
        slope_y = -amplitude * ((wave_y * frequency_y) @ wave_x).imag
        return slope_x, slope_y


@dataclass(frozen=True)
class FlakeRecipe:
    """Flakes: seed, exponent (not 1) and roughness of the GTR distribution of their normals, width in texels.

    The tail of GTR reaches into the surface's plane, where no flake lies in a layer of paint: tilts end at `steepest`
    degrees. Of gamma 1.5 and alpha 0.002, that takes away the last 0.03 %.
    """

    seed: int
    gamma: float
    alpha: float
    width: float
    steepest: float = 60.0
    full_resolution: int = 2048

    def normals(self, resolution: int) -> np.ndarray:
        """Unit normals, shape (resolution, resolution, 3). A flake has the same width in texels at any resolution."""
        random = np.random.default_rng(self.seed)
        side = max(1, round(resolution / self.width))
        flake = nearest_points(random.random((side, side, 2)), resolution)
        sine_squared = self.sine_squared(random.random(side * side))
        azimuth = 2 * np.pi * random.random(side * side)
        sine = np.sqrt(sine_squared)
        normals = np.stack((sine * np.cos(azimuth), sine * np.sin(azimuth), np.sqrt(1 - sine_squared)), axis=-1)
        return normals[flake]

    def sine_squared(self, xi: np.ndarray) -> np.ndarray:
        """Squared sines of tilts from uniform numbers in [0, 1): the inverse of the distribution D(n) cos(n).

        That is how much of the surface's projected area has a tilt, and so how many texels (Burley 2012, appendix B).
        """
        square, power = self.alpha**2, 1 - self.gamma
        cosine = np.cos(np.radians(self.steepest))
        last = (square**power - (1 - (1 - square) * cosine**2) ** power) / (square**power - 1)
        base = (square**power * (1 - last * xi) + last * xi) ** (1 / power)
        return np.clip((base - square) / (1 - square), 0, 1)


def nearest_points(jitter: np.ndarray, resolution: int) -> np.ndarray:
    """For every texel the nearest of points that lie one in each cell of a grid, all repeated periodically.

    `jitter` (side, side, 2) has the places (x, y) of the points in their cells, in [0, 1). Returns flat indices of
    cells, shape (resolution, resolution).
    """
    side = len(jitter)
    position = (np.arange(resolution, dtype=np.float32) + 0.5) * (side / resolution)
    cell = position.astype(np.int64)
    best = np.full((resolution, resolution), np.inf, dtype=np.float32)
    nearest = np.zeros((resolution, resolution), dtype=np.int64)
    points = jitter.astype(np.float32)
    for down in (-1, 0, 1):
        rows = (cell + down)[:, None]
        for across in (-1, 0, 1):
            columns = (cell + across)[None, :]
            index = rows % side * side + columns % side
            place = points.reshape(-1, 2)[index]
            distance = (columns + place[..., 0] - position[None, :]) ** 2
            distance += (rows + place[..., 1] - position[:, None]) ** 2
            closer = distance < best
            best = np.where(closer, distance, best)
            nearest = np.where(closer, index, nearest)
    return nearest


@dataclass(frozen=True)
class ScratchRecipe:
    """Scratches: seed and how many there are in a map of the full resolution; ranges are (least, most).

    Lengths, widths and radii (of the arcs) are in texels; slopes are the steepest of a groove's sides, drawn evenly on a
    logarithmic scale. The ground between has normally distributed slopes of deviation `ground`.
    """

    seed: int
    count: int
    length: tuple[float, float]
    width: tuple[float, float]
    slope: tuple[float, float]
    radius: tuple[float, float]
    straight: float  # share of straight ones
    ground: float
    full_resolution: int = 1024

    def normals(self, resolution: int) -> np.ndarray:
        """Unit normals, shape (resolution, resolution, 3). Scratches have the same size in texels at any resolution."""
        random = np.random.default_rng(self.seed)
        slopes = random.normal(scale=self.ground, size=(resolution, resolution, 2))
        for _ in range(round(self.count * (resolution / self.full_resolution) ** 2)):
            self._cut(slopes, random)
        normals = np.concatenate((-slopes, np.ones((resolution, resolution, 1))), axis=-1)
        return normals / np.linalg.norm(normals, axis=-1, keepdims=True)

    def _cut(self, slopes: np.ndarray, random: np.random.Generator) -> None:
        """Cut one scratch: h = -d cos^2(pi t / w) over the distance t from its middle line, shallower at both ends."""
        resolution = len(slopes)
        length, width, radius = (random.uniform(*r) for r in (self.length, self.width, self.radius))
        steepest = np.exp(random.uniform(*np.log(self.slope)))
        bend = 0.0 if random.random() < self.straight else random.choice((-1, 1)) / radius
        start, heading = random.uniform(0, resolution, 2), random.uniform(0, 2 * np.pi)

        along = np.arange(0.25, length, 0.5)[:, None]
        across = np.arange(-width / 2, width / 2, 0.5)[None, :] + 0.25
        chord = along * np.sinc(bend * along / (2 * np.pi))
        direction, middle = heading + bend * along, heading + bend * along / 2
        x = start[0] + chord * np.cos(middle) - across * np.sin(direction)
        y = start[1] + chord * np.sin(middle) + across * np.cos(direction)
        slope = steepest * np.sin(2 * np.pi * across / width) * np.sqrt(np.sin(np.pi * along / length))
        column, row = (np.floor(value).astype(np.int64) % resolution for value in (x, y))
        slopes[row, column, 0] = -slope * np.sin(direction)
        slopes[row, column, 1] = slope * np.cos(direction)


RECIPES = {
    "isotropic": WaveRecipe(seed=1, alpha_x=0.6, alpha_y=0.6, side=1000.0),
    "brushed": WaveRecipe(seed=3, alpha_x=0.001, alpha_y=0.8, side=10000.0, noise=0.04),
    "flakes": FlakeRecipe(seed=5, gamma=1.5, alpha=0.002, width=1.6),
    "scratches": ScratchRecipe(
        seed=7,
        count=1500,
        length=(100, 800),
        width=(1.5, 4.5),
        slope=(0.03, 0.45),
        radius=(150, 1500),
        straight=0.5,
        ground=0.012,
    ),
}


def write_map(path: Path, name: str, resolution: int) -> None:
    """Write the map `name` of `RECIPES` as float EXR in the unsigned encoding c = (n + 1) / 2."""
    write_exr(path, (RECIPES[name].normals(resolution) + 1) / 2)
