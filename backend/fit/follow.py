"""Particles brought to the density of a volume: moved first, then made heavier or lighter; newborn ones at its depth.

What the volume proposes for one frame is right in the mean and blurred; what particles bring along is sharp and drifts.
Densities are compared on the volume's own voxels, each particle shared among the eight around it; what has to move, on voxels as
large as the prior's.
"""

from __future__ import annotations

import math

import numpy as np

from backend.field.lookup import deposited, trilinear
from backend.field.poisson import weighted_poisson
from backend.fit.guide import Guide
from backend.geometry.camera import View
from backend.prior.window import SHAPE

FOLLOW_PLACES = 0.8  # share of the flow that turns the particles' density into the volume's, a frame
_FLOOR = 0.02  # of the volume's largest density, added to both sides of a ratio
_THIN = 0.02  # of the largest density, added everywhere: what is next to empty does not fly away
MOST_RATIO = 4.0  # by which a mass grows or shrinks in a round
_ROUNDS = 3  # in which masses follow, a frame


class Balance:
    """What the particles at positions [N, 3] m of masses [N] m^2 show in a guide's voxels, against what it proposes."""

    def __init__(self, guide: Guide, positions: np.ndarray, masses: np.ndarray) -> None:
        self.guide, self.masses = guide, masses
        self.places = guide.stand.voxels(positions)  # [N, 3]

    def displacement(self) -> np.ndarray:
        """[N, 3] m: the shortest flow that turns the carried density into the wanted one, both of one total.

        First order of optimal transport (Benamou and Brenier 2000): the displacement is a gradient, and the divergence of
        density times displacement is what there is too much. At most a larger voxel.
        """
        fine = self.guide.density
        larger = max(1.0, fine.shape[2] / SHAPE[2])
        width, depth, height = (math.ceil(size / larger) for size in fine.shape)
        voxels, places = (
            (at + 0.5) / larger - 0.5 for at in (np.moveaxis(np.indices(fine.shape), 0, -1).reshape(-1, 3), self.places)
        )
        wanted = deposited(voxels, fine.ravel(), (width, depth, height))
        carried = deposited(places, self.masses, (width, depth, height))
        if not wanted.sum() > 0.0 or not carried.any():
            return np.zeros(self.places.shape)
        wanted *= carried.sum() / wanted.sum()
        weight = 0.5 * (carried + wanted) + _THIN * wanted.max()
        potential = weighted_poisson(weight, carried - wanted)
        steps = np.moveaxis(np.array(np.gradient(potential)), 0, -1)
        steps /= np.maximum(np.linalg.norm(steps, axis=-1, keepdims=True), 1.0)
        moved = trilinear(steps.astype(np.float32), places, outside="grid-constant")
        return larger * self.guide.lattice.voxel_size * moved @ self.guide.stand.from_world[:3, :3]

    def ratios(self) -> np.ndarray:
        """[N]: how many times its mass the volume asks of each particle, within MOST_RATIO; none more from one voxel beyond the
        outermost on, where a volume says nothing: particles there are not counted, and would grow without end."""
        wanted, volume = self.guide.density, self.guide.lattice.voxel_size**3
        carried = (deposited(self.places, self.masses, wanted.shape) / volume).astype(np.float32)
        floor = _FLOOR * max(float(wanted.max(initial=0.0)), 1e-12)
        more = (wanted - carried) / (carried + floor)
        return np.clip(1.0 + trilinear(more, self.places, outside="grid-constant"), 1.0 / MOST_RATIO, MOST_RATIO)


def drawn_near(guide: Guide, positions: np.ndarray, masses: np.ndarray, is_led: np.ndarray) -> np.ndarray:
    """Positions [N, 3] m of masses [N] m^2, most of the way to the volume's density.

    is_led [N] bool: the others stay, and do not count. Beside its frame's picture a volume has next to nothing left, whatever
    is there; what particles were when the picture showed them tells more.
    """
    moved = positions.copy()
    moved[is_led] += FOLLOW_PLACES * Balance(guide, positions[is_led], masses[is_led].astype(np.float64)).displacement()
    return moved


def drawn_level(guide: Guide, positions: np.ndarray, masses: np.ndarray, is_led: np.ndarray) -> np.ndarray:
    """Masses [N] m^2 at positions [N, 3] m brought to the volume's density, those that are led, see above; of the type that
    they had."""
    led, exact = positions[is_led], masses[is_led].astype(np.float64)
    for _ in range(_ROUNDS):
        exact = exact * Balance(guide, led, exact).ratios()
    levelled = masses.copy()
    levelled[is_led] = exact
    return levelled


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
