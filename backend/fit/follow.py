"""Particles brought to the density of a volume: moved first, then made heavier or lighter; newborn ones at its depth.

What the volume proposes for one frame is right in the mean and blurred; what particles bring along is sharp and drifts.
Densities are compared on the volume's own voxels, each particle shared among the eight around it.
"""

from __future__ import annotations

import numpy as np
from scipy import fft, ndimage

from backend.fit.guide import Guide
from backend.geometry.camera import View

FOLLOW_PLACES = 0.8  # share of the flow that turns the particles' density into the volume's, a frame
_FLOOR = 0.02  # of the volume's largest density, added to both sides of a ratio
_THIN = 0.02  # of the largest density, added everywhere: what is next to empty does not fly away
_PRECISION = 0.002  # of the potential; with ten times that a rounding that ends it a step earlier can be seen in the pictures
_MOST_ITERATIONS = 60
MOST_RATIO = 4.0  # by which a mass grows or shrinks in a round
_ROUNDS = 3  # in which masses follow, a frame


class Balance:
    """What the particles at positions [N, 3] m of masses [N] m^2 show in a guide's voxels, against what it proposes."""

    def __init__(self, guide: Guide, positions: np.ndarray, masses: np.ndarray) -> None:
        self.guide = guide
        self.places = guide.places(positions)  # [3, N] voxels
        volume = guide.lattice.voxel_size**3
        self.carried = (deposited(self.places, masses, guide.lattice.shape) / volume).astype(np.float32)  # [X, Y, Z] 1/m
        self.wanted = guide.density

    def displacement(self) -> np.ndarray:
        """[N, 3] m: the shortest flow that turns the carried density into the wanted one, both of one total.

        First order of optimal transport (Benamou and Brenier 2000): the displacement is a gradient, and the divergence of
        density times displacement is what there is too much. At most a voxel.
        """
        total = float(self.wanted.sum(dtype=np.float64))
        if not total > 0.0 or not self.carried.any():
            return np.zeros((self.places.shape[1], 3))
        wanted = self.wanted * (float(self.carried.sum(dtype=np.float64)) / total)
        weight = 0.5 * (self.carried + wanted) + _THIN * wanted.max()
        potential = weighted_poisson(weight.astype(np.float64), (self.carried - wanted).astype(np.float64))
        steps = np.moveaxis(np.array(np.gradient(potential)), 0, -1)
        steps /= np.maximum(np.linalg.norm(steps, axis=-1, keepdims=True), 1.0)
        moved = np.stack([_looked_up(steps[..., axis], self.places, outside=0.0) for axis in range(3)], axis=1)
        return self.guide.lattice.voxel_size * moved @ self.guide.stand.from_world[:3, :3]

    def ratios(self) -> np.ndarray:
        """[N]: how many times its mass the volume asks of each particle, within MOST_RATIO."""
        floor = _FLOOR * max(float(self.wanted.max(initial=0.0)), 1e-12)
        ratio = (self.wanted + floor) / (self.carried + floor)
        return np.clip(_looked_up(ratio, self.places, outside=1.0), 1.0 / MOST_RATIO, MOST_RATIO)


def weighted_poisson(weight: np.ndarray, divergence: np.ndarray) -> np.ndarray:
    """p [X, Y, Z] with div(weight grad p) = divergence between closed walls, lengths in voxels; divergence must sum to zero.

    Conjugate gradients; the solution for an even weight, by cosines, is the preconditioner.
    """
    faces = [0.5 * (np.delete(weight, 0, axis) + np.delete(weight, -1, axis)) for axis in range(3)]
    mean = float(weight.mean())
    curvature = np.zeros(weight.shape)
    for axis, size in enumerate(weight.shape):
        curvature += np.reshape(2.0 - 2.0 * np.cos(np.pi * np.arange(size) / size), np.roll(np.array([size, 1, 1]), axis))
    curvature.flat[0] = np.inf  # the mean is nobody's business

    def stiffness(values: np.ndarray) -> np.ndarray:
        total = np.zeros_like(values)
        for axis, face in enumerate(faces):
            flux = face * np.diff(values, axis=axis)
            total -= np.diff(flux, axis=axis, prepend=0.0, append=0.0)
        return total

    def even(values: np.ndarray) -> np.ndarray:
        return np.asarray(fft.idctn(np.asarray(fft.dctn(values)) / (mean * curvature)))

    found = np.zeros_like(weight)
    residual = -(divergence - divergence.mean())
    step = guess = even(residual)
    slope = float((residual * guess).sum())
    goal = _PRECISION**2 * slope
    for _ in range(_MOST_ITERATIONS):
        if not slope > goal:
            break
        pushed = stiffness(step)
        length = slope / float((step * pushed).sum())
        found += length * step
        residual = residual - length * pushed
        guess = even(residual)
        slope, before = float((residual * guess).sum()), slope
        step = guess + (slope / before) * step
    return found


def drawn_near(guide: Guide, positions: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Positions [N, 3] m of masses [N] m^2, most of the way to the volume's density."""
    return positions + FOLLOW_PLACES * Balance(guide, positions, masses.astype(np.float64)).displacement()


def drawn_level(guide: Guide, positions: np.ndarray, masses: np.ndarray) -> np.ndarray:
    """Masses [N] m^2 at positions [N, 3] m brought to the volume's density; of the type that they had."""
    exact = masses.astype(np.float64)
    for _ in range(_ROUNDS):
        exact = exact * Balance(guide, positions, exact).ratios()
    return exact.astype(masses.dtype)


def points_on_rays(guide: Guide, view: View, pixels: np.ndarray, otherwise: np.ndarray, *, seed: int) -> np.ndarray:
    """A point [N, 3] m on the ray of each pixel [N, 2], drawn from the volume's density along it.

    otherwise [N, 3] m: the points of rays that meet no smoke of the volume.
    """
    count = len(pixels)
    if count == 0:
        return otherwise
    random = np.random.default_rng(seed)
    quantiles = random.permutation((random.random() + np.arange(count) * 0.6180339887498949) % 1.0)
    depths = guide.depths(view)
    points = view.unproject(np.repeat(pixels, len(depths), axis=0), np.tile(depths, count))
    density = guide.density_at(points).reshape(count, len(depths)).astype(np.float64)
    summed = np.cumsum(density, axis=1)
    wanted = quantiles * summed[:, -1]
    index = np.minimum((summed < wanted[:, None]).sum(axis=1), len(depths) - 1)
    rows = np.arange(count)
    here = density[rows, index]
    within = np.clip(1.0 - (summed[rows, index] - wanted) / np.maximum(here, 1e-12), 0.0, 1.0)
    depth = depths[index] + (depths[1] - depths[0]) * (within - 0.5)
    return np.where((summed[:, -1] > 1e-9)[:, None], view.unproject(pixels, depth), otherwise)


def deposited(places: np.ndarray, masses: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Masses [N] shared among the eight voxels around their places [3, N] -> [X, Y, Z] float64; what is outside is lost."""
    low = np.floor(places).astype(np.int64)
    share = places - low
    total = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        index = low + np.array(corner)[:, None]
        weight = np.prod(np.where(np.array(corner)[:, None] == 1, share, 1 - share), axis=0) * masses
        inside = ((index >= 0) & (index < np.array(shape)[:, None])).all(axis=0)
        flat = np.ravel_multi_index(tuple(index[:, inside]), shape)
        total += np.bincount(flat, weight[inside], minlength=total.size)
    return total.reshape(shape)


def _looked_up(values: np.ndarray, places: np.ndarray, *, outside: float) -> np.ndarray:
    """Values [X, Y, Z] at places [3, N] voxels -> [N]; `outside` from one voxel beyond the outermost on, where a volume says
    nothing: particles there are not counted, so that growing for its sake they would grow without end."""
    return ndimage.map_coordinates(values, places, order=1, mode="grid-constant", cval=outside)
