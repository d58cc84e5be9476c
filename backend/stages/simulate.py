"""A physical rollout from the last fitted frame: the fluid goes on by itself, the source goes on emitting.

For looks and editing, not for prediction: wind, buoyancy and colliders are the artist's. Visual particles ride on the
physical ones; at the source both are born again as they were during the fit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from backend.contract.errors import BackendError
from backend.contract.job import PhysicalConfig
from backend.fit.carry import as_fluid, carry, with_velocities
from backend.fit.lift import wind_of
from backend.fit.limits import warn_of_substeps
from backend.fit.population import take
from backend.fit.replay import births_at_foot, born_again
from backend.fit.series import Series
from backend.fit.state import PhysicalRecord, VisualRecord
from backend.physics import fluid as fluids
from backend.reporting import Report

SURFACE_DRAG = 3.0  # 1/s, where smoke borders on air: shears the edge of a plume
VISCOSITY = 1.0  # 1/s
VORTICITY_CONFINEMENT = 2.0  # 1/s
MOST_FRAMES = 10_000
LARGEST = 1e6  # m/s of wind, times the learned buoyancy; more is a mistake
LIFETIME_REACH = 3.0  # heights of the smoke beyond which a particle is dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollout:
    """What the artist chose. wind m/s or None for the learned one; buoyancy: times the learned one; colliders: of the fluid."""

    num_frames: int
    wind: tuple[float, float, float] | None = None
    buoyancy: float = 1.0
    colliders: tuple = ()


def run(
    fluid: Series[PhysicalRecord],
    seen: Series[VisualRecord],
    config: PhysicalConfig,
    rollout: Rollout,
    report: Report,
    *,
    seconds: float,
) -> Iterator[VisualRecord]:
    """Yields rollout.num_frames records behind the last frame. seconds: of a frame. Raises BackendError."""
    _check(rollout)
    record, look = fluid[len(fluid) - 1], seen[len(seen) - 1]
    if len(record.positions) == 0:
        raise BackendError("nothing_to_simulate", "The last fitted frame holds no smoke.", hint="Fit other frames.")
    parameters = fluids.derive_parameters(
        record.positions,
        drag=config.drag,
        solver_iterations=config.solver_iterations,
        max_substeps=config.max_substeps,
    )
    parameters = replace(
        parameters,
        smoothing_length=float(record.smoothing_length),
        rest_density=float(record.rest_density),
        buoyancy=tuple(rollout.buoyancy * record.buoyancy),
        wind=tuple(wind_of(record, drag=config.drag)) if rollout.wind is None else rollout.wind,
        surface_drag=SURFACE_DRAG,
        viscosity=VISCOSITY,
        vorticity_confinement=VORTICITY_CONFINEMENT,
        colliders=rollout.colliders,
    )
    emitted = (births_at_foot(fluid), births_at_foot(seen))
    low, high = look.positions.min(axis=0), look.positions.max(axis=0)
    reach = LIFETIME_REACH * float((high - low).max())
    for step in range(rollout.num_frames):
        report.progress(step, rollout.num_frames)
        state, taken = fluids.step(as_fluid(record), parameters, seconds)
        warn_of_substeps(report, taken, len(record.positions), allowed=parameters.max_substeps)
        record = replace(record, positions=state.positions, velocities=state.velocities)
        look = carry(look, record, seconds=seconds)
        record = born_again(record, emitted[0], step)
        look = born_again(look, emitted[1], step)
        middle = 0.5 * (low + high)
        record = take(record, np.linalg.norm(record.positions - middle, axis=1) < reach)
        look = take(look, np.linalg.norm(look.positions - middle, axis=1) < reach)
        yield with_velocities(look, record)
    report.progress(rollout.num_frames, rollout.num_frames)


def _check(rollout: Rollout) -> None:
    """Raises BackendError where a number that the artist chose is none, or beyond all measure."""
    if not 1 <= rollout.num_frames <= MOST_FRAMES:
        raise BackendError(
            "bad_frame_range", f"{rollout.num_frames} frames cannot be simulated.", hint=f"Give 1 to {MOST_FRAMES} frames."
        )
    for name, values in (("wind", rollout.wind or ()), ("buoyancy", (rollout.buoyancy,))):
        if not all(abs(value) <= LARGEST for value in values):
            raise BackendError(
                "bad_rollout",
                f"A {name} of {', '.join(f'{value:g}' for value in values)} cannot be simulated.",
                hint=f"Give numbers of at most {LARGEST:g}.",
            )
