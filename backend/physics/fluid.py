"""Position-based smoke: the state, its parameters, and one step of time.

A particle is a parcel of air of the same volume as every other, so density is a number density [1/m^3]: smoke that
fades makes a parcel lighter to the eye, not smaller. What a particle's mass means is up to the caller; it is carried.

A step: split so that no particle crosses more than 0.4 h; forces and drag, semi-implicit; positions predicted; density
projected (projection.py); what the projection changed is a change of velocity, as far as it opposes this motion, and
never more than takes kinetic energy away, because the projection of a flow onto the incompressible ones cannot add
any. Macklin & Mueller 2013; Macklin et al. 2014, "Unified Particle Physics" for gas (buoyancy, drag towards the air).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from backend.contract.errors import BackendError

from .colliders import Collider, Vector, deflect, push_out
from .kernels import POLY6, SPIKY_SQUARED_GRADIENT
from .neighbours import Neighbours, build_grid, find_neighbours
from .projection import COINCIDENT, approach, blend, confine, constrain, correct, curl, part
from .threads import threads_for

MAX_TRAVEL = 0.4  # smoothing lengths a substep
MAX_SHIFT = 0.1  # smoothing lengths a projection
SKIN = 0.1  # smoothing lengths by which neighbour lists reach further, so that they last
EPSILON_SHARE = 0.1  # of the sum of squared gradients of points at random with rest density, in lambda's denominator
RELAXATION = 0.75  # of each correction: all particles correct at once and would overshoot
SPACINGS_PER_LENGTH = 2.2  # smoothing length over particle spacing
_LARGEST = 1e60  # m, m/s, 1/s: squares and products of what is smaller are finite


@dataclass(frozen=True, slots=True, kw_only=True)
class FluidState:
    """Particles at one moment."""

    positions: np.ndarray  # [N, 3] float64 m
    velocities: np.ndarray  # [N, 3] float64 m/s
    masses: np.ndarray  # [N] float64, whatever they stand for
    ids: np.ndarray  # [N] int64, never used twice
    born: np.ndarray  # [N] int32, frame

    def __post_init__(self) -> None:
        num = len(self.positions)
        shapes = {"positions": (num, 3), "velocities": (num, 3), "masses": (num,), "ids": (num,), "born": (num,)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise ValueError(f"{name} has shape {np.shape(getattr(self, name))}, not {shape}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FluidParameters:
    """How the fluid behaves.

    smoothing_length: m. rest_density: particles/m^3 beyond which they push each other apart. buoyancy: m/s^2, a vector.
    wind: velocity of the surrounding air, m/s. drag: towards the wind, 1/s. surface_drag: the same where the smoke
    borders on air, in proportion to 1 - rho / rho_0 (Macklin 2014, gases), 1/s; shears the edge, so that it rolls up.
    solver_iterations: projections a substep.
    max_substeps: a step. tensile_strength: of the artificial pressure that keeps particles from clumping, relative to
    the pressure of an over-density of one; tensile_exponent: how suddenly it sets in. viscosity: how fast neighbours'
    velocities become equal (XSPH), 1/s. vorticity_confinement: how fast it spins eddies up, 1/s.
    pulls_when_sparse: under-dense particles attract, as in a liquid. colliders: solids.
    """

    smoothing_length: float
    rest_density: float
    buoyancy: Vector = (0.0, 0.0, 0.0)
    wind: Vector = (0.0, 0.0, 0.0)
    drag: float = 0.0
    surface_drag: float = 0.0
    solver_iterations: int = 3
    max_substeps: int = 4
    tensile_strength: float = 0.01
    tensile_exponent: int = 4
    viscosity: float = 0.0
    vorticity_confinement: float = 0.0
    pulls_when_sparse: bool = False
    colliders: tuple[Collider, ...] = ()

    def __post_init__(self) -> None:
        for name in ("smoothing_length", "rest_density"):
            if not 1.0 / _LARGEST <= getattr(self, name) <= _LARGEST:
                raise ValueError(f"{name} = {getattr(self, name)!r} is not positive")
        if not 1.0 / _LARGEST <= self.rest_density * self.smoothing_length**3 <= _LARGEST:
            raise ValueError(f"rest_density = {self.rest_density!r} does not fit the smoothing length")
        for name in ("drag", "surface_drag", "tensile_strength", "viscosity", "vorticity_confinement"):
            if not 0.0 <= getattr(self, name) <= _LARGEST:
                raise ValueError(f"{name} = {getattr(self, name)!r} is negative or not finite")
        for name in ("buoyancy", "wind"):
            vector = np.asarray(getattr(self, name), np.float64)
            if vector.shape != (3,) or not np.all(np.abs(vector) <= _LARGEST):
                raise ValueError(f"{name} = {getattr(self, name)!r} is no finite vector")
        if self.solver_iterations < 0 or self.max_substeps < 1 or not 1 <= self.tensile_exponent <= 15:
            raise ValueError("solver_iterations start at 0, max_substeps at 1; tensile_exponent is 1 to 15")


@dataclass(frozen=True, slots=True, kw_only=True)
class StepReport:
    """What a step went through.

    substeps: taken; wanted_substeps: so that none moves further than 0.4 smoothing lengths. num_clamped: times that
    a particle was slowed because max_substeps did not suffice. overdensity: mean of max(rho / rho_0 - 1, 0) when the
    last substep began its projections. list_builds: neighbour lists made.
    """

    substeps: int
    wanted_substeps: float
    num_clamped: int
    overdensity: float
    list_builds: int

    @property
    def is_limited(self) -> bool:
        """The limit of substeps was hit and velocities were clamped."""
        return self.num_clamped > 0


def derive_parameters(
    positions: np.ndarray,  # [N, 3] m
    *,
    drag: float = 0.0,  # 1/s
    solver_iterations: int = 3,
    max_substeps: int = 4,
) -> FluidParameters:
    """Smoothing length and rest density that fit these particles, whatever their scale.

    The rest density is that of a cubic lattice of the same spacing or, if larger, the upper quartile of what these
    particles have: points at random are uneven, and a cloud should not swell because it was drawn at random. Raises
    BackendError with fewer than two distinct particles.
    """
    spacing = typical_spacing(positions)
    length = SPACINGS_PER_LENGTH * spacing
    rest_density = max(lattice_density(spacing, length), float(np.quantile(number_density(positions, length), 0.75)))
    return FluidParameters(
        smoothing_length=length,
        rest_density=rest_density,
        drag=drag,
        solver_iterations=solver_iterations,
        max_substeps=max_substeps,
    )


def typical_spacing(
    positions: np.ndarray,  # [N, 3] m
) -> float:  # m
    """Edge of the cube that one particle has to itself, the median over particles.

    From the ball up to the 21st neighbour, which holds 22 particles: on a lattice that is right within 0.4 %, and for
    random points it depends far less on chance than the nearest neighbour does.
    """
    positions = np.asarray(positions, np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.all(np.abs(positions) <= _LARGEST):
        raise ValueError("positions are not [N, 3] finite numbers")
    distinct = np.unique(positions, axis=0)
    if len(distinct) < 2:
        raise BackendError(
            "too_few_particles",
            f"{len(distinct)} distinct particles are not enough to tell their spacing.",
            hint="Ask for more particles or for frames that show more smoke.",
        )
    rank = min(21, len(distinct) - 1)
    distances, _ = KDTree(distinct).query(distinct, k=rank + 1)
    return float(np.median(distances[:, -1])) * (4.0 / 3.0 * math.pi / (rank + 1)) ** (1.0 / 3.0)


def lattice_density(
    spacing: float,  # m
    smoothing_length: float,  # m
) -> float:  # 1/m^3
    """Poly6 number density at a particle of an infinite cubic lattice."""
    reach = math.ceil(smoothing_length / spacing)
    axis = np.arange(-reach, reach + 1) * (spacing / smoothing_length)
    squared = axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2
    return POLY6 * float((np.maximum(1.0 - squared, 0.0) ** 3).sum()) / smoothing_length**3


def number_density(
    positions: np.ndarray,  # [N, 3] m
    smoothing_length: float,  # m
) -> np.ndarray:  # [N] 1/m^3
    """Poly6 number density at each particle, its own share included."""
    solver = _Solver(np.asarray(positions, np.float64) / smoothing_length, np.arange(len(positions)), rest_density=1.0)
    with threads_for(len(positions)):
        solver.constrain(pulls=False)
    return solver.densities / smoothing_length**3


def step(
    state: FluidState,
    parameters: FluidParameters,
    dt: float,  # s
) -> tuple[FluidState, StepReport]:
    """The state `dt` seconds later. Raises ValueError if a number is not finite. Equal input, equal bytes."""
    _check(state, dt)
    num = len(state.positions)
    wanted = _wanted_substeps(state, parameters, dt)
    substeps = int(min(wanted, parameters.max_substeps))
    if num == 0:
        return state, StepReport(substeps=1, wanted_substeps=1.0, num_clamped=0, overdensity=0.0, list_builds=0)
    with threads_for(num):
        positions, velocities, num_clamped, solver = _substeps(state, parameters, dt / substeps, substeps)
    report = StepReport(
        substeps=substeps,
        wanted_substeps=wanted,
        num_clamped=num_clamped,
        overdensity=solver.overdensity,
        list_builds=solver.list_builds,
    )
    return replace(state, positions=positions, velocities=velocities), report


def _substeps(
    state: FluidState, parameters: FluidParameters, seconds: float, substeps: int
) -> tuple[np.ndarray, np.ndarray, int, _Solver]:
    """Positions [N, 3] m and velocities [N, 3] m/s after `substeps` of `seconds` each, and how many were clamped."""
    num, length = len(state.positions), parameters.smoothing_length
    order = build_grid(state.positions / length, 1.0).order  # neighbours near each other in memory
    solver = _Solver(
        state.positions[order] / length,
        np.asarray(state.ids, np.int64)[order],
        rest_density=parameters.rest_density * length**3,
    )
    motion = state.velocities[order] * (seconds / length)
    num_clamped = 0
    for _ in range(substeps):
        motion, num_slowed = limited(forced(motion, parameters, seconds))
        num_clamped += num_slowed
        motion = solver.advance(motion, parameters, seconds)
    positions, velocities = np.empty((num, 3)), np.empty((num, 3))
    positions[order] = solver.positions * length
    velocities[order] = motion * (length / seconds)
    return positions, velocities, num_clamped, solver


def _check(state: FluidState, dt: float) -> None:
    for name in ("positions", "velocities", "masses"):
        if not np.all(np.abs(getattr(state, name)) <= _LARGEST):
            raise ValueError(f"{name} hold NaN, infinity or more than {_LARGEST:g}")
    if not 1.0 / _LARGEST <= dt <= _LARGEST:
        raise ValueError(f"dt = {dt!r} is not a positive number of seconds")


def _wanted_substeps(state: FluidState, parameters: FluidParameters, dt: float) -> float:
    """Substeps so that no particle moves further than MAX_TRAVEL, by the speeds before and after the forces."""
    after = (state.velocities + dt * _pull(parameters)) / (1.0 + parameters.drag * dt)
    fastest = max(_largest_norm(state.velocities), _largest_norm(after))
    return max(1.0, math.ceil(fastest * (dt / (MAX_TRAVEL * parameters.smoothing_length)) - 1e-9))


def _largest_norm(vectors: np.ndarray) -> float:
    return float(np.sqrt(np.square(vectors).sum(axis=1)).max(initial=0.0))


def _pull(parameters: FluidParameters) -> np.ndarray:  # [3] m/s^2
    """Acceleration of a particle at rest."""
    return np.array(parameters.buoyancy) + parameters.drag * np.array(parameters.wind)


def forced(
    motion: np.ndarray,  # [N, 3] h per substep
    parameters: FluidParameters,
    seconds: float,
) -> np.ndarray:
    """Motion after buoyancy and drag, with the drag of the end of the substep: stable for every drag and every dt."""
    gained = _pull(parameters) * seconds * (seconds / parameters.smoothing_length)
    return (motion + gained) / (1.0 + parameters.drag * seconds)


def limited(
    motion: np.ndarray,  # [N, 3] h per substep
) -> tuple[np.ndarray, int]:
    """Motion with nothing faster than MAX_TRAVEL, and how many had to be slowed."""
    lengths = np.sqrt(np.square(motion).sum(axis=1))
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


class _Solver:
    """The buffers of one step, in units of the smoothing length and the substep."""

    def __init__(self, positions: np.ndarray, ids: np.ndarray, *, rest_density: float) -> None:
        num = len(positions)
        self.positions = positions
        self.ids = ids
        self.rest_density = rest_density
        self.squares_at_rest = SPIKY_SQUARED_GRADIENT / rest_density  # of the constraint's gradients
        self.densities, self.lambdas, self.shares = np.zeros(num), np.zeros(num), np.zeros(num)
        self.shifts, self.impulses = np.zeros((num, 3)), np.zeros((num, 3))
        self.overdensity = 0.0
        self.list_builds = 0
        self._listed: np.ndarray | None = None  # positions when the lists were made
        self._lists: Neighbours | None = None

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """Neighbour lists that are complete for where the particles are now."""
        if self._lists is None or self._listed is None or _largest_norm(self.positions - self._listed) > 0.5 * SKIN:
            self._lists = find_neighbours(self.positions, 1.0 + SKIN)
            self._listed = self.positions
            self.list_builds += 1
        return self._lists.starts, self._lists.indices

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
            lengths = RELAXATION * np.sqrt(np.square(self.shifts).sum(axis=1))
            largest = float(lengths.max(initial=0.0))
            if largest <= MAX_SHIFT or attempt == 1:
                break
            factors = MAX_SHIFT / np.maximum(lengths, MAX_SHIFT)
        scale = RELAXATION * min(1.0, MAX_SHIFT / max(largest, 1e-300))
        self.shifts *= scale
        self.impulses *= scale

    def advance(self, motion: np.ndarray, parameters: FluidParameters, seconds: float) -> np.ndarray:
        """One substep from a motion that holds the forces. Returns the motion after it."""
        length, colliders = parameters.smoothing_length, parameters.colliders
        self.positions = _pushed_out(self.positions + motion, colliders, length)
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
            self.positions = _pushed_out(self.positions + self.shifts, colliders, length)
        motion = motion + energy_share(motion, total) * total
        motion = self._stirred(motion, parameters, seconds)
        if colliders:
            motion = deflect(motion, self.positions * length, colliders, margin=1e-6 * length)
        return motion

    def _stirred(self, motion: np.ndarray, parameters: FluidParameters, seconds: float) -> np.ndarray:
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


def _pushed_out(positions: np.ndarray, colliders: Sequence[Collider], length: float) -> np.ndarray:
    """Positions [N, 3] in smoothing lengths, outside the colliders, which are in metres."""
    return push_out(positions * length, colliders) / length if colliders else positions
