"""A solver that remembers what its gradient needs: where the particles were at each pass, which lists it used, what it
limited. All in units of the smoothing length and the substep, in the solver's order of particles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .solver import Solver
from .state import FluidParameters


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What a pass over neighbours saw: positions [N, 3] h and the lists, in compressed rows."""

    positions: np.ndarray
    starts: np.ndarray
    indices: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Projection:
    """One iteration of the density projection.

    densities [N] 1/h^3, lambdas [N] h^2. factors [N] and scale: by which corrections were limited, each and all.
    shifts and impulses [N, 3] h, as they were applied.
    """

    seen: Seen
    densities: np.ndarray
    lambdas: np.ndarray
    factors: np.ndarray
    scale: float
    shifts: np.ndarray
    impulses: np.ndarray


@dataclass(frozen=True, slots=True, kw_only=True)
class Stirring:
    """The last part of a substep. motion [N, 3]: before it. densities [N] 1/h^3, where it needed them."""

    seen: Seen | None
    motion: np.ndarray
    densities: np.ndarray | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Substep:
    """start [N, 3] h; motion [N, 3] h per substep, with the forces and limited; approached: where rates [N] were taken.

    shares [N]: of the over-density that this motion has caused. stopped [N, 3]: motion just before the colliders.
    after [N, 3]: the motion at the end; positions [N, 3] h there.
    """

    start: np.ndarray
    motion: np.ndarray
    approached: Seen
    rates: np.ndarray
    shares: np.ndarray
    projections: tuple[Projection, ...]
    stirring: Stirring
    stopped: np.ndarray
    after: np.ndarray
    positions: np.ndarray


class RecordingSolver(Solver):
    """The solver, which appends a Substep to `tape` for each `advance`. Its results are the solver's."""

    def __init__(self, positions: np.ndarray, ids: np.ndarray, *, rest_density: float) -> None:
        super().__init__(positions, ids, rest_density=rest_density)
        self.tape: list[Substep] = []
        self._approached: tuple[Seen, np.ndarray] | None = None
        self._projections: list[Projection] = []
        self._stirring: tuple[Stirring, np.ndarray] | None = None

    def _seen(self) -> Seen:
        starts, indices = self.lists()
        return Seen(positions=self.positions, starts=starts, indices=indices)

    def rates(self, motion: np.ndarray) -> np.ndarray:
        found = super().rates(motion)
        self._approached = (self._seen(), found)
        return found

    def correct(self, parameters: FluidParameters) -> None:
        super().correct(parameters)
        self._projections.append(
            Projection(
                seen=self._seen(),
                densities=self.densities.copy(),
                lambdas=self.lambdas.copy(),
                factors=self.factors,
                scale=self.scale,
                shifts=self.shifts.copy(),
                impulses=self.impulses.copy(),
            )
        )

    def stirred(self, motion: np.ndarray, parameters: FluidParameters, seconds: float) -> np.ndarray:
        result = super().stirred(motion, parameters, seconds)
        touched = parameters.surface_drag > 0.0 or parameters.viscosity > 0.0
        stirring = Stirring(
            seen=self._seen() if touched else None, motion=motion, densities=self.densities.copy() if touched else None
        )
        self._stirring = (stirring, result)
        return result

    def advance(self, motion: np.ndarray, parameters: FluidParameters, seconds: float) -> np.ndarray:
        start, self._projections = self.positions, []
        after = super().advance(motion, parameters, seconds)
        assert self._approached is not None and self._stirring is not None  # advance has been through both
        self.tape.append(
            Substep(
                start=start,
                motion=motion,
                approached=self._approached[0],
                rates=self._approached[1],
                shares=self.shares,
                projections=tuple(self._projections),
                stirring=self._stirring[0],
                stopped=self._stirring[1],
                after=after,
                positions=self.positions,
            )
        )
        return after
