"""A chain of steps of the fluid, and its vector-Jacobian product: what a loss on where and how fast particles are says
about where and how fast they started, and about buoyancy, wind and drag.

    moved = rollout(state, parameters, 1.0 / 24.0, num_steps=5)
    gradients = moved.backward([None] * 5 + [2.0 * (moved.states[-1].positions - wanted)])
    gradients.buoyancy  # [3], by the buoyancy in m/s^2

The forward pass is fluid.step to the last byte. It keeps twelve numbers a particle for each projection and the lists of
neighbours for each substep (`Rollout.num_bytes`); for a chain too long for that, roll out in parts and pass one part's gradients
on to the part before. The backward pass is written by hand (substep_gradient.py), compiled, the same bytes for any
number of threads, and agrees with autograd of the twin (fluid_torch.py).

The step is smooth in pieces. Held fixed are its choices: neighbours, number of substeps, sides of minima and maxima,
pairs that are parted, particles that touch a collider. On one piece nothing else is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .emission import joined
from .fluid import step_with
from .fluid_tape import RecordingSolver, Substep
from .gradient_kernels import density_gradient
from .neighbours import find_neighbours
from .state import FluidParameters, FluidState, StepReport
from .substep_gradient import AirGradients, no_air_gradients, substep_gradient
from .threads import threads_for


@dataclass(frozen=True, slots=True, kw_only=True)
class StartGradients:
    """By positions [N, 3] per m and velocities [N, 3] per m/s of particles as they were given."""

    positions: np.ndarray
    velocities: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class FluidGradients:
    """start: by the first state. births: by the particles that joined before each step, None where there were none.

    buoyancy: [3] per m/s^2. wind: [3] per m/s. drag: per 1/s.
    """

    start: StartGradients
    births: tuple[StartGradients | None, ...]
    buoyancy: np.ndarray
    wind: np.ndarray
    drag: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Step:
    """What one step leaves for its gradient. order [N]: the particles as the solver held them. num_born: joined before."""

    order: np.ndarray
    velocities: np.ndarray  # [N, 3] m/s, before
    tape: tuple[Substep, ...]
    num_born: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Rollout:
    """states: the first and one after each step; particles keep their rows, newborn ones are behind. reports: of the steps."""

    states: tuple[FluidState, ...]
    reports: tuple[StepReport, ...]
    parameters: FluidParameters
    seconds: float
    steps: tuple[_Step, ...]

    @property
    def num_bytes(self) -> int:
        """Memory that the backward pass needs kept; arrays that several records share are counted once."""
        arrays: dict[int, int] = {}
        for step in self.steps:
            for tape in step.tape:
                records = (tape, tape.approached, tape.stirring, *tape.projections, *(p.seen for p in tape.projections))
                for record in records:
                    for name in record.__slots__:
                        value = getattr(record, name)
                        if isinstance(value, np.ndarray):
                            arrays[id(value)] = value.nbytes
        return sum(arrays.values())

    def backward(
        self,
        position_gradients: Sequence[np.ndarray | None],  # a state: [N, 3] per m, or None for zeros
        velocity_gradients: Sequence[np.ndarray | None] | None = None,  # a state: [N, 3] per m/s
    ) -> FluidGradients:
        """Gradients of the loss that has these gradients by the states. Raises ValueError for what is not finite."""
        by_position = self._checked("position_gradients", position_gradients)
        by_velocity = self._checked("velocity_gradients", velocity_gradients or [None] * len(self.states))
        positions, velocities, air = by_position[-1], by_velocity[-1], no_air_gradients()
        births: list[StartGradients | None] = []
        for number in reversed(range(len(self.steps))):
            step = self.steps[number]
            positions, velocities, step_air = _step_gradient(step, positions, velocities, self.parameters, self.seconds)
            air = air + step_air
            num_before = len(positions) - step.num_born
            newborn = StartGradients(positions=positions[num_before:], velocities=velocities[num_before:])
            births.append(newborn if step.num_born else None)
            positions = positions[:num_before] + by_position[number]
            velocities = velocities[:num_before] + by_velocity[number]
        return FluidGradients(
            start=StartGradients(positions=positions, velocities=velocities),
            births=tuple(reversed(births)),
            buoyancy=air.buoyancy,
            wind=air.wind,
            drag=air.drag,
        )

    def _checked(self, name: str, gradients: Sequence[np.ndarray | None]) -> list[np.ndarray]:
        """One array a state."""
        if len(gradients) != len(self.states):
            raise ValueError(f"{name} has {len(gradients)} entries for {len(self.states)} states")
        found = []
        for state, gradient in zip(self.states, gradients, strict=True):
            values = np.zeros(state.positions.shape) if gradient is None else np.asarray(gradient, np.float64)
            if values.shape != state.positions.shape or not np.isfinite(values).all():
                raise ValueError(f"{name} of shape {values.shape} are not {state.positions.shape} finite numbers")
            found.append(values)
        return found


def rollout(
    state: FluidState,
    parameters: FluidParameters,
    seconds: float,  # s, a step
    *,
    num_steps: int = 1,
    births: Sequence[FluidState | None] = (),  # who joins before each step; none where it is shorter
) -> Rollout:
    """The states after each of `num_steps` steps, with what their gradient needs. Raises ValueError as `step` does."""
    if num_steps < 0 or len(births) > num_steps:
        raise ValueError(f"num_steps = {num_steps} with {len(births)} births")
    if parameters.vorticity_confinement > 0.0:
        raise ValueError("vorticity_confinement has no gradient: it adds energy for looks; a fit leaves it at 0")
    states, reports, steps = [state], [], []
    for number in range(num_steps):
        newborn = births[number] if number < len(births) else None
        num_born = len(newborn.positions) if newborn is not None else 0
        before = joined(states[-1], newborn) if newborn is not None else states[-1]
        after, report, solver, order = step_with(RecordingSolver, before, parameters, seconds)
        states.append(after)
        reports.append(report)
        steps.append(_Step(order=order, velocities=before.velocities, tape=tuple(solver.tape), num_born=num_born))
    return Rollout(states=tuple(states), reports=tuple(reports), parameters=parameters, seconds=seconds, steps=tuple(steps))


def number_density_gradient(
    positions: np.ndarray,  # [N, 3] m
    smoothing_length: float,  # m
    density_gradients: np.ndarray,  # [N], by fluid.number_density, per 1/m^3
) -> np.ndarray:  # [N, 3], by the positions
    """Vector-Jacobian product of fluid.number_density."""
    gradients = np.zeros((len(positions), 3))
    scaled = np.ascontiguousarray(positions / smoothing_length)
    with threads_for(len(positions)):
        lists = find_neighbours(scaled, 1.0)
        density_gradient(scaled, lists.starts, lists.indices, density_gradients / smoothing_length**3, gradients)
    return gradients / smoothing_length


def _step_gradient(
    step: _Step,
    positions: np.ndarray,  # [N, 3], by the positions after, per m
    velocities: np.ndarray,  # [N, 3], by the velocities after, per m/s
    parameters: FluidParameters,
    seconds: float,
) -> tuple[np.ndarray, np.ndarray, AirGradients]:
    """The same by what was before one step, and by the air."""
    air = no_air_gradients()
    if not step.tape:
        return positions, velocities, air
    length, order, duration = parameters.smoothing_length, step.order, seconds / len(step.tape)
    position_bars, motion_bars = positions[order] * length, velocities[order] * (length / duration)
    before = [step.velocities[order] * (duration / length), *(tape.after for tape in step.tape[:-1])]
    with threads_for(len(order)):
        for tape, motion in zip(reversed(step.tape), reversed(before), strict=True):
            position_bars, motion_bars, gained = substep_gradient(
                tape, motion, position_bars, motion_bars, parameters=parameters, seconds=duration
            )
            air = air + gained
    to_positions, to_velocities = np.empty_like(positions), np.empty_like(velocities)
    to_positions[order] = position_bars / length
    to_velocities[order] = motion_bars * (duration / length)
    return to_positions, to_velocities, air
