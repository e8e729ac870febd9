"""Normal maps with Gaussian random slopes: a sum of plane waves.

Recipe: E. Heitz, "Generating Procedural Beckmann Surfaces" (2015). A height field made of N waves of random phase,
direction and frequency has normally distributed slopes when N is large, so that its facets follow a Beckmann
distribution of roughness (alpha_x, alpha_y). Each wave separates into a product of two complex exponentials,
exp(i f_x x) exp(i (f_y y + phase)), which makes the whole map one small matrix product.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .exr import write_exr

WAVES = 1000
FULL_RESOLUTION = 2048  # texels per side that `side` below belongs to


@dataclass(frozen=True)
class MapRecipe:
    """One map: seed, Beckmann roughness per axis, side of the sampled square (at 2048 texels), slope noise."""

    seed: int
    alpha_x: float
    alpha_y: float
    side: float
    noise: float = 0.0


RECIPES = {
    "isotropic": MapRecipe(seed=1, alpha_x=0.6, alpha_y=0.6, side=1000.0),
    "brushed": MapRecipe(seed=3, alpha_x=0.001, alpha_y=0.8, side=10000.0, noise=0.04),
}


def wave_slopes(recipe: MapRecipe, resolution: int, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    """Height derivatives along x (columns) and y (rows), two arrays of shape (resolution, resolution).

    A map of another resolution covers a proportionally smaller square, so the texel spacing keeps its size.
    """
    u1, u2, u3 = (random.rand(WAVES) for _ in range(3))
    phase = 2 * np.pi * u1
    radius = np.sqrt(-np.log(1 - u3))
    frequency_x = radius * np.cos(2 * np.pi * u2) * recipe.alpha_x
    frequency_y = radius * np.sin(2 * np.pi * u2) * recipe.alpha_y

    position = np.linspace(0, recipe.side * resolution / FULL_RESOLUTION, resolution)
    wave_x = np.exp(1j * np.outer(frequency_x, position))
    wave_y = np.exp(1j * (np.outer(position, frequency_y) + phase))
    amplitude = np.sqrt(2 / WAVES)
    slope_x = -amplitude * ((wave_y * frequency_x) @ wave_x).imag
    slope_y = -amplitude * ((wave_y * frequency_y) @ wave_x).imag
    return slope_x, slope_y


def normal_map(recipe: MapRecipe, resolution: int = FULL_RESOLUTION) -> np.ndarray:
    """Unit normals (-slope_x + noise, -slope_y + noise, 1), normalised; shape (resolution, resolution, 3).

    The noise is uniform in +-`recipe.noise` and independent per texel, drawn column by column (x outer, y inner).
    """
    random = np.random.RandomState(recipe.seed)
    slope_x, slope_y = wave_slopes(recipe, resolution, random)
    normals = np.stack((-slope_x, -slope_y, np.ones_like(slope_x)), axis=-1)
    if recipe.noise:
        noise = recipe.noise * (2 * random.rand(resolution, resolution, 2) - 1)
        normals[:, :, :2] += noise.transpose(1, 0, 2)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def write_map(path: Path, name: str, resolution: int = FULL_RESOLUTION) -> None:
    """Write the map `name` of `RECIPES` as float EXR in the unsigned encoding c = (n + 1) / 2."""
    write_exr(path, (normal_map(RECIPES[name], resolution) + 1) / 2)
