"""Vector-Jacobian product of one substep, hand-written: solver.py read backwards from what fluid_tape.py has kept.

What is differentiated is what the substep computes: also the share of the impulses that is let through so that no
kinetic energy appears, the limits of a correction, and the colliders. What is held fixed is every choice: who is whose
neighbour, which side of a minimum or maximum holds, how many substeps, who is parted from whom.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .collider_gradient import deflect_gradient, push_out_gradient
from .fluid_tape import Projection, Stirring, Substep
from .gradient_kernels import (
    approach_gradient,
    blend_gradient,
    constrain_gradient,
    correct_gradient,
    density_gradient,
)
from .kernels import SPIKY_SLOPE, SPIKY_SQUARED_GRADIENT
from .projection import correct
from .solver import EPSILON_SHARE, MAX_SHIFT, MAX_TRAVEL, RELAXATION, forced, norms
from .state import FluidParameters

_FLAT = 1e-200  # squared impulses below have no slope that a number could hold


@dataclass(frozen=True, slots=True, kw_only=True)
class AirGradients:
    """By the buoyancy [3] per m/s^2, the wind [3] per m/s and the drag, per 1/s."""

    buoyancy: np.ndarray
    wind: np.ndarray
    drag: float

    def __add__(self, other: AirGradients) -> AirGradients:
        return AirGradients(buoyancy=self.buoyancy + other.buoyancy, wind=self.wind + other.wind, drag=self.drag + other.drag)


def no_air_gradients() -> AirGradients:
    return AirGradients(buoyancy=np.zeros(3), wind=np.zeros(3), drag=0.0)


def substep_gradient(
    tape: Substep,
    before: np.ndarray,  # [N, 3] h per substep, the motion before the forces
    position_bars: np.ndarray,  # [N, 3], by the positions after, in h
    motion_bars: np.ndarray,  # [N, 3], by the motion after, in h per substep
    *,
    parameters: FluidParameters,
    seconds: float,
) -> tuple[np.ndarray, np.ndarray, AirGradients]:
    """The same by the positions and the motion before, and by what the air does."""
    length, colliders = parameters.smoothing_length, parameters.colliders
    if colliders:
        motion_bars, touched = deflect_gradient(
            tape.stopped, tape.positions * length, colliders, motion_bars, margin=1e-6 * length, smoothing_length=length
        )
        position_bars = position_bars + touched * length
    position_bars, motion_bars, wind = _stirring_gradient(tape.stirring, position_bars, motion_bars, parameters, seconds)
    motion_bars, impulse_bars = _energy_gradient(tape, motion_bars)
    position_bars, motion_bars = _projections_gradient(tape, position_bars, motion_bars, impulse_bars, parameters)
    position_bars = _pushed_out_gradient(tape.start + tape.motion, position_bars, parameters)
    motion_bars, air = _forces_gradient(before, motion_bars + position_bars, parameters, seconds)
    return position_bars, motion_bars, AirGradients(buoyancy=air.buoyancy, wind=air.wind + wind, drag=air.drag)


def _pushed_out_gradient(positions: np.ndarray, bars: np.ndarray, parameters: FluidParameters) -> np.ndarray:
    """positions [N, 3] in h, before; bars per h, before and after."""
    length, colliders = parameters.smoothing_length, parameters.colliders
    return push_out_gradient(positions * length, colliders, bars, smoothing_length=length) if colliders else bars


def _forces_gradient(
    before: np.ndarray,  # [N, 3]
    bars: np.ndarray,  # [N, 3], by the motion after forces and limit
    parameters: FluidParameters,
    seconds: float,
) -> tuple[np.ndarray, AirGradients]:
    """Of limited(forced(before)): u' = (u + (b + k w) s^2 / h) / (1 + k s), then none longer than MAX_TRAVEL."""
    motion = forced(before, parameters, seconds)
    lengths = norms(motion)
    is_fast = lengths > MAX_TRAVEL * (1.0 + 1e-9)
    safe = np.where(is_fast, lengths, 1.0)
    direction = motion / safe[:, None]
    across = bars - np.einsum("ni,ni->n", bars, direction)[:, None] * direction
    bars = np.where(is_fast[:, None], (MAX_TRAVEL / safe)[:, None] * across, bars)
    slowed = 1.0 + parameters.drag * seconds
    before_bars = bars / slowed
    gained = before_bars.sum(axis=0) * seconds * (seconds / parameters.smoothing_length)  # per m/s^2
    wind = np.array(parameters.wind)
    return before_bars, AirGradients(
        buoyancy=gained,
        wind=parameters.drag * gained,
        drag=float(wind @ gained) - seconds * float((before_bars * motion).sum()),
    )


def _stirring_gradient(
    tape: Stirring,
    position_bars: np.ndarray,
    motion_bars: np.ndarray,
    parameters: FluidParameters,
    seconds: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # [N, 3], [N, 3], [3] by the wind
    """Of viscosity and surface drag, backwards: u1 = (u + q a) / (1 + q), q = k s max(1 - rho / rho_0, 0)."""
    wind_bar = np.zeros(3)
    if tape.seen is None or tape.densities is None:
        return position_bars, motion_bars, wind_bar
    seen, density_bars = tape.seen, np.zeros(len(motion_bars))
    lists = (seen.starts, seen.indices)
    position_bars = position_bars.copy()
    rest_density = parameters.rest_density * parameters.smoothing_length**3
    exposed = np.maximum(1.0 - tape.densities / rest_density, 0.0)
    drag = (parameters.surface_drag * seconds * exposed)[:, None]
    air = np.array(parameters.wind) * (seconds / parameters.smoothing_length)
    motion = (tape.motion + drag * air) / (1.0 + drag)
    if parameters.viscosity > 0.0:
        share, bars = -math.expm1(-parameters.viscosity * seconds), np.zeros_like(motion_bars)
        blend_gradient(
            seen.positions, motion, *lists, tape.densities, share, motion_bars, position_bars, bars, density_bars
        )  # fmt: skip
        motion_bars = bars
    if parameters.surface_drag > 0.0:
        motion_bars = motion_bars / (1.0 + drag)
        wind_bar = (drag * motion_bars).sum(axis=0) * (seconds / parameters.smoothing_length)
        exposed_bars = parameters.surface_drag * seconds * np.einsum("ni,ni->n", motion_bars, air - motion)
        density_bars -= np.where(exposed > 0.0, exposed_bars, 0.0) / rest_density
    density_gradient(seen.positions, *lists, density_bars, position_bars)
    return position_bars, motion_bars, wind_bar


def _energy_gradient(tape: Substep, bars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of u' = u + e T with the impulses T and e = min(1, max(0, -2 u.T / T.T)): bars by u and by T, both [N, 3]."""
    total = np.zeros_like(bars)
    for projection in tape.projections:
        total += projection.impulses
    squared = float((total * total).sum())
    if squared == 0.0:
        return bars, np.zeros_like(bars)
    share = -2.0 * float((tape.motion * total).sum()) / squared
    if not 0.0 < share < 1.0 or squared < _FLAT:
        share = min(1.0, max(0.0, share))
        return bars, share * bars
    share_bar = float((bars * total).sum())
    to_motion = -2.0 * share_bar / squared
    return bars + to_motion * total, share * bars + to_motion * (tape.motion + share * total)


def _projections_gradient(
    tape: Substep,
    position_bars: np.ndarray,
    motion_bars: np.ndarray,
    impulse_bars: np.ndarray,  # [N, 3], by the sum of the impulses
    parameters: FluidParameters,
) -> tuple[np.ndarray, np.ndarray]:
    """Of all iterations, backwards, and of the rates before them: bars by the positions and the motion they began with."""
    rest_density = parameters.rest_density * parameters.smoothing_length**3
    share_bars = np.zeros(len(position_bars))
    for number in reversed(range(len(tape.projections))):
        projection = tape.projections[number]
        moved = projection.seen.positions + projection.shifts
        bars = _pushed_out_gradient(moved, position_bars, parameters)
        position_bars, lambda_bars, moving_bars, sums = _correct_gradient(
            projection, tape.shares, bars, impulse_bars, parameters, rest_density
        )
        lambda_bars += tape.shares * moving_bars
        share_bars += projection.lambdas * moving_bars
        density_bars = np.zeros(len(position_bars))
        if number == 0:
            rate_bars, density_bars = _share_gradient(tape, projection, share_bars, rest_density)
            _lambda_gradient(projection, lambda_bars, density_bars, sums, position_bars, parameters, rest_density)
            motion_bars = motion_bars.copy()
            seen = tape.approached
            approach_gradient(
                seen.positions, tape.motion, seen.starts, seen.indices, rest_density, rate_bars, position_bars, motion_bars
            )  # fmt: skip
        else:
            _lambda_gradient(projection, lambda_bars, density_bars, sums, position_bars, parameters, rest_density)
    return position_bars, motion_bars


def _share_gradient(
    tape: Substep, projection: Projection, bars: np.ndarray, rest_density: float
) -> tuple[np.ndarray, np.ndarray]:  # [N] by the rates, [N] by the densities
    """Of share = rate / excess where 0 < rate < excess; elsewhere it is 0 or 1."""
    excess = projection.densities / rest_density - 1.0
    is_between = (tape.rates > 0.0) & (tape.rates < excess)
    safe = np.where(is_between, excess, 1.0)
    rate_bars = np.where(is_between, bars / safe, 0.0)
    return rate_bars, -rate_bars * tape.shares / rest_density


def _lambda_gradient(
    projection: Projection,
    lambda_bars: np.ndarray,  # [N]
    density_bars: np.ndarray,  # [N], besides what comes by the lambdas
    sums: tuple[np.ndarray, np.ndarray],  # [N, 3] and [N], see correct_gradient
    position_bars: np.ndarray,  # [N, 3], is added to
    parameters: FluidParameters,
    rest_density: float,
) -> None:
    """lambda = -C / D, D = c^2 (|gradients|^2 + squares) + epsilon, c = SPIKY_SLOPE / rho_0, C = rho / rho_0 - 1."""
    gradients, squares = sums
    scale = (SPIKY_SLOPE / rest_density) ** 2
    epsilon = EPSILON_SHARE * SPIKY_SQUARED_GRADIENT / rest_density
    denominators = scale * (np.einsum("ni,ni->n", gradients, gradients) + squares) + epsilon
    is_active = parameters.pulls_when_sparse | (projection.densities > rest_density)
    lambda_bars = np.where(is_active, lambda_bars, 0.0)
    square_bars = -scale * lambda_bars * projection.lambdas / denominators
    constrain_gradient(
        projection.seen.positions,
        projection.seen.starts,
        projection.seen.indices,
        density_bars - lambda_bars / (rest_density * denominators),
        2.0 * square_bars[:, None] * gradients,
        square_bars,
        position_bars,
    )


def _correct_gradient(
    projection: Projection,
    shares: np.ndarray,
    shift_bars: np.ndarray,  # [N, 3], by the shifts as they were applied
    impulse_bars: np.ndarray,
    parameters: FluidParameters,
    rest_density: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Bars by the positions [N, 3], lambdas [N] and moving lambdas [N]; and the sums that constrain had made."""
    num, seen = len(shares), projection.seen
    position_bars, lambda_bars, moving_bars, factor_bars = shift_bars.copy(), np.zeros(num), np.zeros(num), np.zeros(num)
    sums = (np.empty((num, 3)), np.empty(num))
    moving = projection.lambdas * shares
    squares_at_rest = SPIKY_SQUARED_GRADIENT / rest_density
    tensile = parameters.tensile_strength / squares_at_rest
    shared = (seen.positions, seen.starts, seen.indices, rest_density, projection.lambdas, moving)
    kind = (tensile, parameters.tensile_exponent)
    scaled = _scale_gradient(projection, shift_bars, impulse_bars)
    correct_gradient(
        *shared, projection.factors, *kind, *scaled, position_bars, lambda_bars, moving_bars, factor_bars, *sums
    )  # fmt: skip
    if (projection.factors < 1.0).any():
        free, shifts, impulses = np.ones(num), np.empty((num, 3)), np.empty((num, 3))
        correct(*shared, free, *kind, shifts, impulses)
        first_bars = _factor_gradient(projection.factors, shifts, factor_bars)
        unmoved, unused = np.empty(num), np.empty(num)
        correct_gradient(
            *shared, free, *kind, first_bars, np.zeros((num, 3)), position_bars, lambda_bars, unmoved, unused, *sums
        )  # fmt: skip
    return position_bars, lambda_bars, moving_bars, sums


def _scale_gradient(projection: Projection, shift_bars: np.ndarray, impulse_bars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bars by shifts and impulses before they were scaled, all alike, so that the longest shift is MAX_SHIFT."""
    scale = projection.scale
    shifts, impulses = scale * shift_bars, scale * impulse_bars
    if scale < RELAXATION:
        lengths = norms(projection.shifts)
        longest = int(np.argmax(lengths))
        # per relative change of the scale, and the longest shift's relative change is the scale's with the other sign
        relative = float((shift_bars * projection.shifts).sum()) + float((impulse_bars * projection.impulses).sum())
        direction = projection.shifts[longest] / lengths[longest]
        shifts[longest] -= relative * scale / lengths[longest] * direction
    return shifts, impulses


def _factor_gradient(
    factors: np.ndarray,  # [N]
    shifts: np.ndarray,  # [N, 3], without limits and before RELAXATION
    bars: np.ndarray,  # [N], by the factors
) -> np.ndarray:  # [N, 3], by the shifts
    """Of factor = MAX_SHIFT / (RELAXATION |shift|) where that is below one."""
    is_limited = factors < 1.0
    lengths = np.where(is_limited, norms(shifts), 1.0)
    slopes = np.where(is_limited, -MAX_SHIFT / (RELAXATION * lengths * lengths), 0.0) * bars
    return (slopes / lengths)[:, None] * shifts
