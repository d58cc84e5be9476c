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
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial import KDTree

from backend.contract.errors import BackendError

from .kernels import POLY6
from .neighbours import build_grid
from .solver import MAX_TRAVEL, Solver, forced, largest_norm, limited, pull
from .state import LARGEST, FluidParameters, FluidState, StepReport
from .threads import threads_for

__all__ = ["FluidParameters", "FluidState", "StepReport", "derive_parameters", "lattice_density", "number_density", "step"]

S = TypeVar("S", bound=Solver)

SPACINGS_PER_LENGTH = 2.2  # smoothing length over particle spacing


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
    if positions.ndim != 2 or positions.shape[1] != 3 or not np.all(np.abs(positions) <= LARGEST):
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
    solver = Solver(np.asarray(positions, np.float64) / smoothing_length, np.arange(len(positions)), rest_density=1.0)
    with threads_for(len(positions)):
        solver.constrain(pulls=False)
    return solver.densities / smoothing_length**3


def step(
    state: FluidState,
    parameters: FluidParameters,
    dt: float,  # s
) -> tuple[FluidState, StepReport]:
    """The state `dt` seconds later. Raises ValueError if a number is not finite. Equal input, equal bytes."""
    after, report, _, _ = step_with(Solver, state, parameters, dt)
    return after, report


def step_with(
    make_solver: Callable[..., S],  # Solver, or a kind of it that watches
    state: FluidState,
    parameters: FluidParameters,
    dt: float,  # s
) -> tuple[FluidState, StepReport, S, np.ndarray]:  # order [N]
    """`step`, with the solver it went through and the order [N] in which that held the particles."""
    _check(state, dt)
    num = len(state.positions)
    wanted = _wanted_substeps(state, parameters, dt)
    substeps = int(min(wanted, parameters.max_substeps))
    order = build_grid(state.positions / parameters.smoothing_length, 1.0).order  # neighbours near each other in memory
    solver = make_solver(
        state.positions[order] / parameters.smoothing_length,
        np.asarray(state.ids, np.int64)[order],
        rest_density=parameters.rest_density * parameters.smoothing_length**3,
    )
    if num == 0:
        report = StepReport(substeps=1, wanted_substeps=1.0, num_clamped=0, overdensity=0.0, list_builds=0)
        return state, report, solver, order
    with threads_for(num):
        positions, velocities, num_clamped = _substeps(solver, state.velocities, order, parameters, dt / substeps, substeps)
    report = StepReport(
        substeps=substeps,
        wanted_substeps=wanted,
        num_clamped=num_clamped,
        overdensity=solver.overdensity,
        list_builds=solver.list_builds,
    )
    return replace(state, positions=positions, velocities=velocities), report, solver, order


def _substeps(
    solver: Solver,
    velocities: np.ndarray,  # [N, 3] m/s
    order: np.ndarray,  # [N]
    parameters: FluidParameters,
    seconds: float,
    substeps: int,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Positions [N, 3] m and velocities [N, 3] m/s after `substeps` of `seconds` each, and how many were clamped."""
    length = parameters.smoothing_length
    motion = velocities[order] * (seconds / length)
    num_clamped = 0
    for _ in range(substeps):
        motion, num_slowed = limited(forced(motion, parameters, seconds))
        num_clamped += num_slowed
        motion = solver.advance(motion, parameters, seconds)
    positions_after, velocities_after = np.empty((len(order), 3)), np.empty((len(order), 3))
    positions_after[order] = solver.positions * length
    velocities_after[order] = motion * (length / seconds)
    return positions_after, velocities_after, num_clamped


def _check(state: FluidState, dt: float) -> None:
    for name in ("positions", "velocities", "masses"):
        if not np.all(np.abs(getattr(state, name)) <= LARGEST):
            raise ValueError(f"{name} hold NaN, infinity or more than {LARGEST:g}")
    if not 1.0 / LARGEST <= dt <= LARGEST:
        raise ValueError(f"dt = {dt!r} is not a positive number of seconds")


def _wanted_substeps(state: FluidState, parameters: FluidParameters, dt: float) -> float:
    """Substeps so that no particle moves further than MAX_TRAVEL, by the speeds before and after the forces."""
    after = (state.velocities + dt * pull(parameters)) / (1.0 + parameters.drag * dt)
    fastest = max(largest_norm(state.velocities), largest_norm(after))
    return max(1.0, math.ceil(fastest * (dt / (MAX_TRAVEL * parameters.smoothing_length)) - 1e-9))
