"""What moves the air: buoyancy of hot smoke, vorticity confinement, and the sources' exit velocity and stirring."""

from __future__ import annotations

import numpy as np

from synthetic.scenes import AIR_TEMPERATURE, GRAVITY


def buoyancy(temperature: np.ndarray) -> np.ndarray:  # [nx, ny, nz] K -> m/s^2
    """Upward acceleration of air that is hotter by `temperature`: g dT / T0 (Boussinesq 1903)."""
    return temperature * np.float32(GRAVITY / AIR_TEMPERATURE)


def vorticity_confinement(
    velocity: np.ndarray,  # [nx, ny, nz, 3] m/s, cell centres
    *,
    strength: float,
    voxel_size: float,  # m
) -> np.ndarray:
    """Acceleration [nx, ny, nz, 3] m/s^2 that feeds the small swirls which the grid damps. Fedkiw 2001 eqs. 9-11.

    strength * h * (N x omega), N the direction in which |omega| grows.
    """
    h = np.float32(voxel_size)
    du, dv, dw = (np.gradient(velocity[..., axis], h) for axis in range(3))
    omega = np.stack([dw[1] - dv[2], du[2] - dw[0], dv[0] - du[1]], axis=-1)
    size = np.sqrt((omega * omega).sum(axis=-1))
    slope = np.stack(np.gradient(size, h), axis=-1)
    steepness = np.sqrt((slope * slope).sum(axis=-1, keepdims=True))
    # Where |omega| has no slope the direction is undefined and the force must vanish.
    direction = slope / (steepness + np.float32(1e-6) / h)
    return np.float32(strength) * h * np.cross(direction, omega)


def add_to_faces(
    velocity: tuple[np.ndarray, np.ndarray, np.ndarray], acceleration: np.ndarray, *, time_step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The face velocities after an acceleration [nx, ny, nz, 3] m/s^2 in the cells: each inner face takes the mean of
    the cells beside it."""
    faces = []
    for axis, component in enumerate(velocity):
        push = acceleration[..., axis]
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        inner = [slice(None)] * 3
        low[axis], high[axis], inner[axis] = slice(None, -1), slice(1, None), slice(1, -1)
        moved = component.copy()
        moved[tuple(inner)] += np.float32(0.5 * time_step) * (push[tuple(low)] + push[tuple(high)])
        faces.append(moved)
    return faces[0], faces[1], faces[2]
