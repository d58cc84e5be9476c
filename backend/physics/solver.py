"""The parts of a substep, in units of the smoothing length h and the substep: motion [h per substep], density [1/h^3]."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .colliders import Collider, deflect, push_out
from .kernels import SPIKY_SQUARED_GRADIENT
from .neighbours import Neighbours, find_neighbours
from .projection import COINCIDENT, approach, blend, confine, constrain, correct, curl, part
from .state import FluidParameters

MAX_TRAVEL = 0.4  # smoothing lengths a substep
MAX_SHIFT = 0.1  # smoothing lengths a projection
SKIN = 0.1  # smoothing lengths by which neighbour lists reach further, so that they last
EPSILON_SHARE = 0.1  # of the sum of squared gradients of points at random with rest density, in lambda's denominator
RELAXATION = 0.75  # of each correction: all particles correct at once and would overshoot


def squares(
    vectors: np.ndarray,  # [N, 3]
) -> np.ndarray:  # [N]
    """Squared lengths. numpy sums short rows slowly; einsum does not."""
    return np.einsum("ni,ni->n", vectors, vectors)


def norms(
    vectors: np.ndarray,  # [N, 3]
) -> np.ndarray:  # [N]
    """Lengths, without squaring what is too large to be squared."""
    largest = float(np.abs(vectors).max(initial=0.0))
    return largest * np.sqrt(squares(vectors / largest)) if largest > 0.0 else np.zeros(len(vectors))


def largest_norm(vectors: np.ndarray) -> float:
    return float(norms(vectors).max(initial=0.0))


def pull(parameters: FluidParameters) -> np.ndarray:  # [3] m/s^2
    """Acceleration of a particle at rest."""
    return np.array(parameters.buoyancy) + parameters.drag * np.array(parameters.wind)


def forced(
    motion: np.ndarray,  # [N, 3] h per substep
    parameters: FluidParameters,
    seconds: float,
) -> np.ndarray:
    """Motion after buoyancy and drag, with the drag of the end of the substep: stable for every drag and every dt."""
    gained = pull(parameters) * seconds * (seconds / parameters.smoothing_length)
    return (motion + gained) / (1.0 + parameters.drag * seconds)


def limited(
    motion: np.ndarray,  # [N, 3] h per substep
) -> tuple[np.ndarray, int]:
    """Motion with nothing faster than MAX_TRAVEL, and how many had to be slowed."""
    lengths = norms(motion)
    is_fast = lengths > MAX_TRAVEL * (1.0 + 1e-9)
    factors = np.where(is_fast, MAX_TRAVEL / np.where(is_fast, lengths, 1.0), 1.0)
    return motion * factors[:, None], int(is_fast.sum())


def caused_share(
    rates: np.ndarray,  # [N] dC/dt per substep
    excess: np.ndarray,  # [N] C
) -> np.ndarray:  # [N] 0 .. 1
    """The part of the over-density that this substep's motion has brought about; the rest was there before."""
    rates = np.maximum(rates, 0.0)
    return np.where(rates > 0.0, rates / np.maximum(excess, np.maximum(rates, 1e-300)), 0.0)


def energy_share(
    motion: np.ndarray,  # [N, 3]
    impulses: np.ndarray,  # [N, 3]
) -> float:
    """Largest s in 0 .. 1 with |motion + s impulses|^2 <= |motion|^2: a projection never adds kinetic energy.

    The impulses sum to zero, so that a common velocity of all particles changes nothing.
    """
    squared = float((impulses * impulses).sum())
    return min(1.0, max(0.0, -2.0 * float((motion * impulses).sum()) / squared)) if squared > 0.0 else 0.0


class Solver:
    """The buffers of one step, in units of the smoothing length and the substep."""

    def __init__(self, positions: np.ndarray, ids: np.ndarray, *, rest_density: float) -> None:
        num = len(positions)
        self.positions = positions
        self.ids = ids
        self.rest_density = rest_density
        self.squares_at_rest = SPIKY_SQUARED_GRADIENT / rest_density  # of the constraint's gradients
        self.densities, self.lambdas, self.shares = np.zeros(num), np.zeros(num), np.zeros(num)
        self.shifts, self.impulses = np.zeros((num, 3)), np.zeros((num, 3))
        self.factors, self.scale = np.ones(num), RELAXATION  # by which the last correction was limited, each and all
        self.overdensity = 0.0
        self.list_builds = 0
        self._listed: np.ndarray | None = None  # positions when the lists were made
        self._confirmed: np.ndarray | None = None  # positions that they are known to be complete for
        self._lists: Neighbours | None = None

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """Neighbour lists that are complete for where the particles are now."""
        if self._lists is None or self._listed is None or self._is_outdated(self._listed):
            self._lists = find_neighbours(self.positions, 1.0 + SKIN)
            self._listed = self.positions
            self.list_builds += 1
        self._confirmed = self.positions
        return self._lists.starts, self._lists.indices

    def _is_outdated(self, listed: np.ndarray) -> bool:
        """Some particle has moved by more than half the skin. Positions are replaced, never written into."""
        if self.positions is self._confirmed:
            return False
        return float(squares(self.positions - listed).max(initial=0.0)) > (0.5 * SKIN) ** 2

    def rates(self, motion: np.ndarray) -> np.ndarray:  # [N]
        """How fast the motion compresses, per substep. Parts coincident particles first."""
        rates, nearest = np.empty(len(motion)), np.empty(len(motion))
        approach(self.positions, motion, *self.lists(), self.rest_density, rates, nearest)
        if nearest.min(initial=1.0) < COINCIDENT**2:
            parted = np.empty_like(self.positions)
            part(self.positions, self.ids, *self.lists(), parted)
            self.positions = parted
            approach(self.positions, motion, *self.lists(), self.rest_density, rates, nearest)
        return rates

    def constrain(self, *, pulls: bool) -> None:
        """Densities and lambdas."""
        epsilon = EPSILON_SHARE * self.squares_at_rest
        constrain(
            self.positions, *self.lists(), self.rest_density, epsilon, pulls, self.densities, self.lambdas
        )  # fmt: skip

    def correct(self, parameters: FluidParameters) -> None:
        """Shifts and impulses, none longer than MAX_SHIFT: first pair by pair, then, if need be, all alike."""
        tensile = parameters.tensile_strength / self.squares_at_rest
        moving = self.lambdas * self.shares
        factors = np.ones(len(self.positions))
        largest = 0.0
        for attempt in range(2):
            correct(
                self.positions, *self.lists(), self.rest_density, self.lambdas, moving, factors,
                tensile, parameters.tensile_exponent, self.shifts, self.impulses,
            )  # fmt: skip
            lengths = RELAXATION * np.sqrt(squares(self.shifts))
            largest = float(lengths.max(initial=0.0))
            if largest <= MAX_SHIFT or attempt == 1:
                break
            factors = MAX_SHIFT / np.maximum(lengths, MAX_SHIFT)
        self.factors, self.scale = factors, RELAXATION * min(1.0, MAX_SHIFT / max(largest, 1e-300))
        self.shifts *= self.scale
        self.impulses *= self.scale

    def advance(self, motion: np.ndarray, parameters: FluidParameters, seconds: float) -> np.ndarray:
        """One substep from a motion that holds the forces. Returns the motion after it."""
        length, colliders = parameters.smoothing_length, parameters.colliders
        self.positions = pushed_out(self.positions + motion, colliders, length)
        total = np.zeros_like(motion)
        rates = self.rates(motion)
        for iteration in range(parameters.solver_iterations):
            self.constrain(pulls=parameters.pulls_when_sparse)
            if iteration == 0:
                excess = self.densities / self.rest_density - 1.0
                self.overdensity = float(np.maximum(excess, 0.0).mean())
                self.shares = caused_share(rates, excess)
            self.correct(parameters)
            total += self.impulses
            self.positions = pushed_out(self.positions + self.shifts, colliders, length)
        motion = motion + energy_share(motion, total) * total
        motion = self.stirred(motion, parameters, seconds)
        if colliders:
            motion = deflect(motion, self.positions * length, colliders, margin=1e-6 * length)
        return motion

    def stirred(self, motion: np.ndarray, parameters: FluidParameters, seconds: float) -> np.ndarray:
        """Drag at the surface, viscosity and vorticity confinement, where wanted."""
        if max(parameters.surface_drag, parameters.viscosity, parameters.vorticity_confinement) == 0.0:
            return motion
        self.constrain(pulls=False)
        if parameters.surface_drag > 0.0:
            exposed = np.maximum(1.0 - self.densities / self.rest_density, 0.0)
            drag = (parameters.surface_drag * seconds * exposed)[:, None]
            air = np.array(parameters.wind) * (seconds / parameters.smoothing_length)
            motion = (motion + drag * air) / (1.0 + drag)
        shared = (*self.lists(), self.densities)
        if parameters.viscosity > 0.0:
            result = np.empty_like(motion)
            blend(self.positions, motion, *shared, -math.expm1(-parameters.viscosity * seconds), result)
            motion = result
        if parameters.vorticity_confinement > 0.0:
            curls, pushes = np.empty_like(motion), np.empty_like(motion)
            curl(self.positions, motion, *shared, curls)
            confine(self.positions, *shared, curls, pushes)
            motion = motion + min(parameters.vorticity_confinement * seconds, 1.0) * pushes
        return motion


def pushed_out(positions: np.ndarray, colliders: Sequence[Collider], length: float) -> np.ndarray:
    """Positions [N, 3] in smoothing lengths, outside the colliders, which are in metres."""
    return push_out(positions * length, colliders) / length if colliders else positions
