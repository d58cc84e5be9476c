"""Particles at one moment, how their fluid behaves, and what a step has to report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .colliders import Collider, Vector

LARGEST = 1e60  # m, m/s, 1/s: squares and products of what is smaller are finite


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
            if not 1.0 / LARGEST <= getattr(self, name) <= LARGEST:
                raise ValueError(f"{name} = {getattr(self, name)!r} is not positive")
        if not 1.0 / LARGEST <= self.rest_density * self.smoothing_length**3 <= LARGEST:
            raise ValueError(f"rest_density = {self.rest_density!r} does not fit the smoothing length")
        for name in ("drag", "surface_drag", "tensile_strength", "viscosity", "vorticity_confinement"):
            if not 0.0 <= getattr(self, name) <= LARGEST:
                raise ValueError(f"{name} = {getattr(self, name)!r} is negative or not finite")
        for name in ("buoyancy", "wind"):
            vector = np.asarray(getattr(self, name), np.float64)
            if vector.shape != (3,) or not np.all(np.abs(vector) <= LARGEST):
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
